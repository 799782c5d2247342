//! The executor's heartbeat: the watchdog hears that this process lives while a motion is under way, other executors that there is one.

use std::time::Duration;

use msgs::std_msgs::Bool;
use node_kit::{Node, NodeError, Publisher, Qos, TaskGroup};
use tokio::sync::watch;
use tokio::time::timeout;

use crate::planted::{Planted, is_planted};

/// Topic of the heartbeat: whether a motion is under way.
const TOPIC: &str = "motion_heartbeat";
/// How often the watchdog hears that a motion is under way.
const PERIOD: Duration = Duration::from_millis(50);
/// How often other executors hear that this one is active.
const IDLE_PERIOD: Duration = Duration::from_millis(200);
/// How long others are listened for before this executor becomes active, and how many heartbeats of theirs it takes.
const LISTENING: Duration = Duration::from_millis(700);
const HEARTBEATS_OF_ANOTHER: usize = 2;

/// What the heartbeat says.
#[derive(Clone, Copy, Debug, Default)]
struct Beating {
    /// Whether this executor may move the arm.
    active: bool,
    /// How many motions are under way, goals that are not answered yet included.
    moving: usize,
}

/// Says on a topic what this executor is at.
pub struct Heartbeat {
    beating: watch::Sender<Beating>,
    /// Whether the last heartbeat said that a motion is under way.
    said: watch::Receiver<bool>,
}

/// A motion is under way until this is dropped.
pub(crate) struct Moving(watch::Sender<Beating>);

impl Drop for Moving {
    fn drop(&mut self) {
        self.0.send_modify(|beating| beating.moving -= 1);
    }
}

/// The executor is active until this is dropped.
pub struct ActiveExecutor(watch::Sender<Beating>);

impl Drop for ActiveExecutor {
    fn drop(&mut self) {
        self.0.send_modify(|beating| beating.active = false);
    }
}

/// Why this executor must not move the arm.
#[derive(Debug, thiserror::Error)]
pub enum ActivateError {
    /// The heartbeat of others cannot be heard.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// One executor for each arm.
    #[error(
        "another executor is active: its heartbeat is on {TOPIC}, expected one executor for each arm"
    )]
    AnotherIsActive,
}

impl Heartbeat {
    pub(crate) fn new(node: &Node, tasks: &TaskGroup) -> Result<Self, NodeError> {
        let beating = watch::Sender::new(Beating::default());
        let (saying, said) = watch::channel(false);
        let heartbeats = node.publisher::<Bool>(TOPIC, Qos::Event)?;
        tasks.spawn(beat(heartbeats, beating.subscribe(), saying));
        Ok(Self { beating, said })
    }

    /// A motion begins.
    pub(crate) fn moving(&self) -> Moving {
        self.beating.send_modify(|beating| beating.moving += 1);
        Moving(self.beating.clone())
    }

    /// Waits until no motion is under way and no goal is unanswered.
    pub(crate) async fn idle(&self) {
        let mut beating = self.beating.subscribe();
        // The sender lives as long as this.
        let _ = beating.wait_for(|beating| beating.moving == 0).await;
    }

    /// The same, and until the watchdog was told so.
    pub async fn quiet(&self) {
        self.idle().await;
        let mut said = self.said.clone();
        // An error: nothing is said any more.
        let _ = said.wait_for(|moving| !moving).await;
    }

    /// Makes this the executor that may move the arm.
    ///
    /// # Errors
    /// Another one is active.
    pub async fn activate(&self, node: &Node) -> Result<ActiveExecutor, ActivateError> {
        let mut heartbeats = node.subscription::<Bool>(TOPIC, Qos::Event)?;
        let listening = async {
            for _ in 0..HEARTBEATS_OF_ANOTHER {
                heartbeats.recv().await;
            }
        };
        if timeout(LISTENING, listening).await.is_ok() && !is_planted(Planted::SecondExecutor) {
            return Err(ActivateError::AnotherIsActive);
        }
        self.beating.send_modify(|beating| beating.active = true);
        Ok(ActiveExecutor(self.beating.clone()))
    }
}

async fn beat(
    heartbeats: Publisher<Bool>,
    mut beating: watch::Receiver<Beating>,
    saying: watch::Sender<bool>,
) {
    let mut silent = true;
    loop {
        let Beating { active, moving } = *beating.borrow_and_update();
        let is_moving = moving > 0;
        // Once more after the last motion.
        if (is_moving || active || !silent) && !is_planted(Planted::NoHeartbeat) {
            heartbeats.publish(Bool { data: is_moving });
        }
        saying.send_replace(is_moving);
        silent = !(is_moving || active);
        let pause = match (is_moving, active) {
            (true, _) => PERIOD,
            (false, true) => IDLE_PERIOD,
            (false, false) => Duration::MAX,
        };
        if let Ok(Err(_)) = timeout(pause, beating.changed()).await {
            return;
        }
    }
}
