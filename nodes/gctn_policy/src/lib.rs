//! Node that proposes pick and place poses.
//!
//! When to propose is decided in [`Proposer`], which knows no ROS node; the network runs on a thread of
//! its own.

mod parameters;
mod picture;
mod proposer;

use std::{
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use anyhow::{Context as _, bail};
use gctn::{Decision, GoalConditioning, Policy};
use msgs::{
    sctn_msgs::{Goal, Heightmap, PickPlace, StepConfirmation, StepResult},
    sensor_msgs::Image,
    visualization_msgs::MarkerArray,
};
use node_kit::{Active, Level, Node, Publisher, Qos};
use tokio::sync::mpsc;
use tracing::{info, warn};

pub use parameters::GctnPolicyParameters;
pub use picture::{markers, score_image};
pub use proposer::{ChangeRule, Job, Proposer};

/// What the network says to a job, and how long it took.
struct Answer {
    job: Job,
    decision: Result<Decision, String>,
    took: Duration,
}

/// Loads the checkpoint; what it returns proposes.
pub async fn configure(node: Node, parameters: GctnPolicyParameters) -> anyhow::Result<PolicyNode> {
    let path = parameters.checkpoint()?.to_owned();
    let outputs = Outputs {
        node: node.clone(),
        said: None,
        proposals: node.publisher("pick_place", Qos::Latched)?,
        markers: node.publisher("pick_place/markers", Qos::Latched)?,
        scores: node.publisher("pick_place/scores", Qos::Latched)?,
    };
    let radius_m = parameters.exclusion_radius_m;
    let threads = parameters.threads;
    let shown = path.display().to_string();
    let policy = node
        .spawn_blocking(move || {
            gctn::set_threads(threads);
            Policy::load(&path).map(|policy| policy.with_exclusion_radius_m(radius_m))
        })
        .await
        .context("loading the checkpoint")?
        .context("parameter checkpoint")?;
    let conditioning = policy.config().conditioning;
    if conditioning != GoalConditioning::NextStep {
        bail!(
            "parameter checkpoint: {shown} is conditioned on {conditioning:?}, but the goals of the graph are next-step goals: \
             expected a checkpoint trained with conditioning next_step"
        );
    }
    info!("checkpoint {shown} loaded");
    Ok(PolicyNode {
        policy: Arc::new(Mutex::new(policy)),
        outputs,
    })
}

/// The configured node.
pub struct PolicyNode {
    policy: Arc<Mutex<Policy>>,
    outputs: Outputs,
}

impl Active for PolicyNode {
    /// Begins anew: goal and heightmap are latched, so what is open is proposed again, under the same id.
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut confirmations =
            node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;
        let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
        let mut goals = node.subscription::<Goal>("goal", Qos::Latched)?;
        let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
        // One job at a time: the proposer gives the next when it has the answer.
        let (jobs, mut answers) = start_network(node, Arc::clone(&self.policy));
        let mut changes = node.parameters::<GctnPolicyParameters>();
        let mut proposer = Proposer::new(change_rule(&changes.borrow_and_update()));
        loop {
            let job = tokio::select! {
                heightmap = heightmaps.recv() => proposer.observed(heightmap).unwrap_or_else(|error| {
                    heightmaps.reject(error);
                    None
                }),
                goal = goals.recv() => proposer.wanted(goal).unwrap_or_else(|error| {
                    goals.reject(error);
                    None
                }),
                confirmation = confirmations.recv() => {
                    proposer.confirmed(&confirmation);
                    None
                }
                result = results.recv() => {
                    if proposer.is_overlooked(&result) {
                        self.outputs.say_again();
                    }
                    proposer.result(&result)
                }
                answer = answers.recv() => {
                    let answer = answer.context("the network's thread has ended")?;
                    let decision = answer.decision.as_ref().map_err(Clone::clone);
                    let (proposal, job) = proposer.decided(decision);
                    if let Some(proposal) = proposal {
                        self.outputs.publish(proposal, &answer);
                    }
                    job
                }
                Ok(()) = changes.changed() => {
                    proposer.set_change_rule(change_rule(&changes.borrow_and_update()));
                    None
                }
            };
            if let Some(job) = job {
                jobs.send(job)
                    .await
                    .context("the network's thread has ended")?;
            }
        }
    }
}

fn change_rule(parameters: &GctnPolicyParameters) -> ChangeRule {
    ChangeRule {
        tolerance_m: parameters.observation_tolerance_m as f32,
        fraction: parameters.observation_changed_fraction,
    }
}

/// Decides on a thread of its own until the sender is dropped.
fn start_network(
    node: &Node,
    policy: Arc<Mutex<Policy>>,
) -> (mpsc::Sender<Job>, mpsc::Receiver<Answer>) {
    let (jobs, mut waiting) = mpsc::channel::<Job>(1);
    let (answers, answered) = mpsc::channel(1);
    node.spawn_blocking(move || {
        while let Some(job) = waiting.blocking_recv() {
            // Held by the thread of an earlier activation until its last decision is made.
            let policy = policy.lock().unwrap_or_else(PoisonError::into_inner);
            let start = Instant::now();
            let decision = policy
                .decide(&job.observation, &*job.goal, &job.exclude)
                .map_err(|error| error.to_string());
            let took = start.elapsed();
            drop(policy);
            let answer = Answer {
                job,
                decision,
                took,
            };
            if answers.blocking_send(answer).is_err() {
                return;
            }
        }
    });
    (jobs, answered)
}

struct Outputs {
    node: Node,
    /// The last proposal.
    said: Option<PickPlace>,
    proposals: Publisher<PickPlace>,
    markers: Publisher<MarkerArray>,
    scores: Publisher<Image>,
}

impl Outputs {
    /// The same proposal once more; who knows it notices nothing.
    fn say_again(&self) {
        if let Some(proposal) = &self.said {
            info!("proposal {} still stands", proposal.id);
            self.proposals.publish(proposal.clone());
        }
    }

    fn publish(&mut self, proposal: Result<PickPlace, String>, answer: &Answer) {
        let took_s = ("network_s", format!("{:.3}", answer.took.as_secs_f64()));
        let reason = match (proposal, &answer.decision) {
            (Ok(proposal), Ok(decision)) => {
                let header = proposal.header.clone();
                let message = format!(
                    "proposal {} for step {}, attempt {}",
                    proposal.id, proposal.step, proposal.attempt
                );
                self.said = Some(proposal.clone());
                self.proposals.publish(proposal);
                info!("{message}");
                self.node
                    .diagnostics()
                    .set("policy", Level::Ok, message, [took_s]);
                let observation = &answer.job.observation;
                self.markers
                    .publish(picture::markers(&header, observation, decision));
                self.scores
                    .publish(picture::score_image(header, observation, decision));
                return;
            }
            (Err(reason), _) => reason,
            (_, Err(reason)) => reason.clone(),
        };
        warn!("no proposal: {reason}");
        let diagnostics = self.node.diagnostics();
        diagnostics.set("policy", Level::Error, reason, [took_s]);
    }
}
