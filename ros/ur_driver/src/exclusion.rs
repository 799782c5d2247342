//! One executor for each arm: those that want to move it tell each other so before one of them may.

use std::hash::{BuildHasher as _, RandomState};
use std::sync::Arc;
use std::time::{Duration, Instant};

use msgs::unique_identifier_msgs::UUID;
use node_kit::{Node, NodeError, Publisher, Qos, Subscription, TaskGroup};
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval};

use crate::claim::{Claim, ExecutorId, PERIOD, Standing, Word};
use crate::planted::{Planted, is_planted};

/// Who wants to move the arm.
const CANDIDATE_TOPIC: &str = "executor_candidate";
/// Who may.
const ACTIVE_TOPIC: &str = "executor_active";

/// Keeps two executors from moving one arm.
pub(crate) struct Exclusion {
    id: ExecutorId,
    publishers: Arc<Publishers>,
}

struct Publishers {
    candidate: Publisher<UUID>,
    active: Publisher<UUID>,
}

impl Publishers {
    fn say(&self, word: Word) {
        match word {
            Word::Candidate(uuid) => self.candidate.publish(UUID { uuid }),
            Word::Active(uuid) => self.active.publish(UUID { uuid }),
        }
    }
}

/// The executor that may move the arm, until this is dropped.
pub struct ActiveExecutor {
    standing: watch::Receiver<Standing>,
    /// It listens and says that this one is active.
    _task: TaskGroup,
}

impl ActiveExecutor {
    /// Waits until this executor must not move the arm any more: another one is active, of which it had not heard.
    pub async fn deposed(&self) {
        let mut standing = self.standing.clone();
        let yielded = standing.wait_for(|standing| *standing == Standing::Yielded);
        if yielded.await.is_err() {
            // The node ends.
            std::future::pending::<()>().await;
        }
    }
}

/// Why this executor must not move the arm.
#[derive(Debug, thiserror::Error)]
pub enum ActivateError {
    /// Others cannot be heard.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// One executor for each arm.
    #[error(
        "another executor is active: it says so on {ACTIVE_TOPIC}, expected one executor for each arm"
    )]
    AnotherIsActive,
}

impl Exclusion {
    pub(crate) fn new(node: &Node) -> Result<Self, NodeError> {
        let random = || RandomState::new().hash_one(std::process::id());
        let number = (u128::from(random()) << 64) | u128::from(random());
        Ok(Self {
            id: number.to_be_bytes(),
            publishers: Arc::new(Publishers {
                candidate: node.publisher(CANDIDATE_TOPIC, Qos::Event)?,
                active: node.publisher(ACTIVE_TOPIC, Qos::Event)?,
            }),
        })
    }

    /// Makes this the executor that may move the arm.
    ///
    /// # Errors
    /// Another one is active.
    pub(crate) async fn activate(&self, node: &Node) -> Result<ActiveExecutor, ActivateError> {
        let claim = Claiming {
            claim: Claim::new(self.id, Duration::ZERO),
            origin: Instant::now(),
            candidates: node.subscription(CANDIDATE_TOPIC, Qos::Event)?,
            actives: node.subscription(ACTIVE_TOPIC, Qos::Event)?,
            publishers: Arc::clone(&self.publishers),
        };
        let (sender, mut standing) = watch::channel(Standing::Candidate);
        // It outlives the active state, in which a motion may still be stopped.
        let task = node.task_group();
        task.spawn(claim.run(sender));
        let decided = standing.wait_for(|standing| *standing != Standing::Candidate);
        // An error: the node ends.
        let decided = decided.await.map_or(Standing::Yielded, |decided| *decided);
        match decided {
            Standing::Active => Ok(ActiveExecutor {
                standing,
                _task: task,
            }),
            Standing::Candidate | Standing::Yielded => Err(ActivateError::AnotherIsActive),
        }
    }
}

/// A claim that listens and speaks.
struct Claiming {
    claim: Claim,
    /// Of its times.
    origin: Instant,
    candidates: Subscription<UUID>,
    actives: Subscription<UUID>,
    publishers: Arc<Publishers>,
}

impl Claiming {
    async fn run(mut self, standing: watch::Sender<Standing>) {
        let mut ticks = interval(PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let before = self.claim.standing();
            tokio::select! {
                message = self.candidates.recv() => self.hear(Word::Candidate(message.uuid)),
                message = self.actives.recv() => self.hear(Word::Active(message.uuid)),
                _ = ticks.tick() => {
                    while let Some(message) = self.candidates.try_recv() {
                        self.hear(Word::Candidate(message.uuid));
                    }
                    while let Some(message) = self.actives.try_recv() {
                        self.hear(Word::Active(message.uuid));
                    }
                    self.claim.look(self.origin.elapsed());
                    if let Some(word) = self.claim.word() {
                        self.publishers.say(word);
                    }
                }
            }
            let now = self.claim.standing();
            if now != before {
                standing.send_replace(now);
            }
            if now == Standing::Yielded {
                return;
            }
        }
    }

    fn hear(&mut self, word: Word) {
        if !is_planted(Planted::SecondExecutor) {
            self.claim.hear(word, self.origin.elapsed());
        }
    }
}
