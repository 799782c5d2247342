//! Node that proposes pick and place poses.
//!
//! When to propose is decided in [`ProposalPlanner`], which knows no ROS node; the network runs on a thread of
//! its own.

mod arm_view;
mod parameters;
mod picture;

use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use anyhow::{Context as _, bail};
use gctn::{Decision, Device, GoalConditioning, Policy, Precision};
use msgs::{
    convert,
    sctn_msgs::{
        Goal, Heightmap, LoadCheckpoint, LoadCheckpointRequest, LoadCheckpointResponse, PickPlace,
        StepConfirmation, StepResult,
    },
    sensor_msgs::Image,
    visualization_msgs::MarkerArray,
};
use node_kit::{Active, Level, NewRequest, Node, Publisher, Qos, ReplyCache};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use step_protocol::{Job, PlannerRules, Prediction, Proposal, ProposalPlanner};
use tokio::sync::mpsc;
use tracing::{info, warn};

use arm_view::ArmView;

pub use parameters::GctnPolicyParameters;
pub use picture::{markers, score_image};

/// A policy, and where it was read from.
struct LoadedPolicy {
    policy: Policy,
    checkpoint: PathBuf,
}

/// What the network says to a job, and how long it took.
struct Answer {
    job: Job,
    /// Checkpoint that decided.
    checkpoint: PathBuf,
    decision: Result<Decision, String>,
    took: Duration,
}

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("gctn_policy", arguments, configure)
}

/// Loads the checkpoint; returns the node that proposes.
pub async fn configure(node: Node, parameters: GctnPolicyParameters) -> anyhow::Result<PolicyNode> {
    let path = parameters.checkpoint()?.to_owned();
    let outputs = Outputs {
        node: node.clone(),
        last_proposal: None,
        proposals: node.publisher("pick_place", Qos::Latched)?,
        markers: node.publisher("pick_place/markers", Qos::Latched)?,
        scores: node.publisher("pick_place/scores", Qos::Latched)?,
    };
    let (threads, device) = (parameters.threads, parameters.device);
    device.check().context("parameter device")?;
    let reading = path.clone();
    let policy = node
        .spawn_blocking(move || {
            gctn::set_threads(threads);
            load(&reading, device)
        })
        .await
        .context("loading the checkpoint")?
        .context("parameter checkpoint")?;
    info!("checkpoint {} loaded", path.display());
    Ok(PolicyNode {
        policy: Arc::new(Mutex::new(LoadedPolicy {
            policy,
            checkpoint: path.clone(),
        })),
        checkpoint: path,
        device,
        loads: ReplyCache::default(),
        outputs,
    })
}

/// A policy that can follow the goals of the graph.
fn load(path: &Path, device: Device) -> anyhow::Result<Policy> {
    let policy = Policy::load_for(path, device, Precision::F32)?;
    let conditioning = policy.config().conditioning;
    if !matches!(
        conditioning,
        GoalConditioning::NextStep | GoalConditioning::Sequence
    ) {
        bail!(
            "{} is conditioned on {conditioning:?}, but the goals of the graph are next-step goals: \
             expected a checkpoint trained with conditioning next_step or sequence",
            path.display()
        );
    }
    Ok(policy)
}

/// The configured node.
pub struct PolicyNode {
    policy: Arc<Mutex<LoadedPolicy>>,
    /// The checkpoint in use.
    checkpoint: PathBuf,
    device: Device,
    /// Answers to calls of `load_checkpoint`.
    loads: ReplyCache<LoadCheckpointResponse>,
    outputs: Outputs,
}

/// A call of `load_checkpoint`, and what came of reading it.
type Loaded = (NewRequest, LoadCheckpointRequest, anyhow::Result<()>);

impl Active for PolicyNode {
    /// Begins anew: goal and heightmap are latched, so what is open is proposed again, under the same id.
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut confirmations =
            node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;
        let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
        let mut goals = node.subscription::<Goal>("goal", Qos::Latched)?;
        let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
        // One job at a time: the planner gives the next when it has the answer.
        let (jobs, mut answers) = start_network(node, Arc::clone(&self.policy));
        let mut load_calls =
            node.idempotent_server::<LoadCheckpoint>("~/load_checkpoint", &self.loads)?;
        let (loaded_sender, mut loaded) = mpsc::unbounded_channel::<Loaded>();
        let mut changes = node.parameters::<GctnPolicyParameters>();
        let rules = rules_of(&changes.borrow_and_update(), &self.checkpoint, node);
        let mut planner = ProposalPlanner::new(rules);
        let mut arm_view = ArmView::new(node, &changes.borrow())?;
        loop {
            let job = tokio::select! {
                message = heightmaps.recv() => match convert::observation_from_msg(message) {
                    Ok(observation) if arm_view.may_show_arm(observation.stamp) => None,
                    Ok(observation) => planner.on_heightmap(observation),
                    Err(error) => {
                        heightmaps.reject(error);
                        None
                    }
                },
                () = arm_view.follow() => None,
                message = goals.recv() => match convert::goal_from_msg(message) {
                    Ok(goal) => {
                        // What was published before the goal is to be known before it: confirmations and results lead to goals.
                        while let Some(message) = confirmations.try_recv() {
                            confirm(&mut planner, &message);
                        }
                        let mut job = None;
                        while let Some(message) = results.try_recv() {
                            match convert::result_from_msg(&message) {
                                Ok(result) => job = job.or(planner.on_result(&result)),
                                Err(error) => results.reject(error),
                            }
                        }
                        let next = planner.on_goal(goal);
                        job.or(next)
                    }
                    Err(error) => {
                        goals.reject(error);
                        None
                    }
                },
                message = confirmations.recv() => {
                    confirm(&mut planner, &message);
                    None
                }
                message = results.recv() => match convert::result_from_msg(&message) {
                    Ok(result) => {
                        if planner.needs_republish(&result) {
                            self.outputs.republish();
                        }
                        planner.on_result(&result)
                    }
                    Err(error) => {
                        results.reject(error);
                        None
                    }
                },
                answer = answers.recv() => {
                    let answer = answer.context("the network's thread has ended")?;
                    // A checkpoint may have been loaded since.
                    planner.set_rules(rules_of(&changes.borrow(), &answer.checkpoint, node));
                    let prediction = answer.decision.as_ref().map(prediction);
                    let prediction = prediction.as_ref().map_err(|reason| String::clone(reason));
                    let (proposal, job) = planner.on_prediction(prediction);
                    if let Some(proposal) = proposal {
                        self.outputs.publish(proposal, &answer);
                    }
                    job
                }
                Ok(()) = changes.changed() => {
                    planner.set_rules(rules_of(&changes.borrow_and_update(), &self.checkpoint, node));
                    None
                }
                (call, request) = load_calls.recv(|reason| refused_load(&self.checkpoint, reason)) => {
                    let (policy, device) = (Arc::clone(&self.policy), self.device);
                    let sender = loaded_sender.clone();
                    node.spawn_blocking(move || {
                        let path = Path::new(&request.path);
                        let read = load(path, device).map(|read| {
                            // What is being decided is decided first.
                            let mut policy = policy.lock().unwrap_or_else(PoisonError::into_inner);
                            *policy = LoadedPolicy {
                                policy: read,
                                checkpoint: path.to_owned(),
                            };
                        });
                        // Nobody waits where the node was deactivated meanwhile.
                        let _ = sender.send((call, request, read));
                    });
                    None
                }
                Some((call, request, read)) = loaded.recv() => {
                    load_calls.respond(call, self.answer_of_load(request.path, read));
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

impl PolicyNode {
    /// The answer to a call of `load_checkpoint`; where it was read, it is the one in use from now on.
    fn answer_of_load(&mut self, path: String, read: anyhow::Result<()>) -> LoadCheckpointResponse {
        if let Err(error) = read {
            return refused_load(&self.checkpoint, format!("{error:#}"));
        }
        info!("checkpoint {path} loaded");
        let previous = std::mem::replace(&mut self.checkpoint, PathBuf::from(&path));
        LoadCheckpointResponse {
            success: true,
            message: format!("checkpoint {path} is in use"),
            path,
            previous: previous.display().to_string(),
        }
    }
}

/// The checkpoint in use stays.
fn refused_load(checkpoint: &Path, message: String) -> LoadCheckpointResponse {
    warn!("load_checkpoint: {message}");
    let path = checkpoint.display().to_string();
    LoadCheckpointResponse {
        success: false,
        message,
        path: path.clone(),
        previous: path,
    }
}

/// Tells the planner of a confirmation; an invalid one is ignored here, the executor refuses it.
fn confirm(planner: &mut ProposalPlanner, message: &StepConfirmation) {
    if let Ok(confirmation) = convert::confirmation_from_msg(message) {
        planner.on_confirmation(&confirmation);
    }
}

fn rules_of(parameters: &GctnPolicyParameters, checkpoint: &Path, node: &Node) -> PlannerRules {
    let checkpoint = checkpoint.file_stem().unwrap_or_default();
    PlannerRules {
        changes: parameters.changes.rules(),
        rejected_radius_m: parameters.exclusion_radius_m,
        checkpoint: checkpoint.to_string_lossy().into_owned(),
        author: node.name().to_owned(),
    }
}

fn prediction(decision: &Decision) -> Prediction {
    Prediction {
        pick: decision.pick,
        place: decision.place,
        pick_score: decision.pick_score as f32,
        place_score: decision.place_score as f32,
        success_probability: decision.success.map(|probability| probability as f32),
        done_probability: decision.done.map(|probability| probability as f32),
    }
}

/// The images that the network is conditioned on.
fn goal_for<'a>(policy: &Policy, job: &'a Job) -> Result<gctn::Goal<'a>, String> {
    match (policy.config().conditioning, &job.previous) {
        (GoalConditioning::Sequence, Some(previous)) => Ok(gctn::Goal::step(previous, &job.goal)),
        (GoalConditioning::Sequence, None) => Err(
            "the goal has no image before it, which the checkpoint is conditioned on: load a demonstration".to_owned(),
        ),
        _ => Ok((&*job.goal).into()),
    }
}

/// Decides on a thread of its own until the sender is dropped.
fn start_network(
    node: &Node,
    policy: Arc<Mutex<LoadedPolicy>>,
) -> (mpsc::Sender<Job>, mpsc::Receiver<Answer>) {
    let (jobs, mut waiting) = mpsc::channel::<Job>(1);
    let (answers, answered) = mpsc::channel(1);
    node.spawn_blocking(move || {
        while let Some(job) = waiting.blocking_recv() {
            // Held by the thread of an earlier activation until its last decision is made.
            let loaded = policy.lock().unwrap_or_else(PoisonError::into_inner);
            let LoadedPolicy { policy, checkpoint } = &*loaded;
            let start = Instant::now();
            let decision = goal_for(policy, &job).and_then(|goal| {
                let decision = policy.decide(&job.observation, goal, &job.exclude);
                decision.map_err(|error| error.to_string())
            });
            let took = start.elapsed();
            let checkpoint = checkpoint.clone();
            drop(loaded);
            let answer = Answer {
                job,
                checkpoint,
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
    last_proposal: Option<PickPlace>,
    proposals: Publisher<PickPlace>,
    markers: Publisher<MarkerArray>,
    scores: Publisher<Image>,
}

impl Outputs {
    /// The same proposal once more: it changes nothing where it is known.
    fn republish(&self) {
        if let Some(proposal) = &self.last_proposal {
            info!("proposal {} still stands", proposal.id);
            self.proposals.publish(proposal.clone());
        }
    }

    fn publish(&mut self, proposal: Result<Proposal, String>, answer: &Answer) {
        let took_s = ("network_s", format!("{:.3}", answer.took.as_secs_f64()));
        let message = proposal.and_then(|proposal| {
            convert::proposal_to_msg(&proposal).map_err(|error| error.to_string())
        });
        let reason = match (message, &answer.decision) {
            (Ok(proposal), Ok(decision)) => {
                let header = proposal.header.clone();
                let message = format!(
                    "proposal {} for step {}, attempt {}",
                    proposal.id, proposal.step, proposal.attempt
                );
                self.last_proposal = Some(proposal.clone());
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
