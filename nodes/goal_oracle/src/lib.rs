//! Node that holds the demonstration sequence and latches the next-step goal.
//!
//! Which goal is next is decided in [`Oracle`], which knows no ROS node.

mod oracle;
mod parameters;

use std::time::Duration;

use anyhow::Context as _;
use bags::Demonstration;
use msgs::{
    convert,
    sctn_msgs::{Goal, Heightmap, PickPlace, StepConfirmation, StepResult},
    std_msgs::Header,
};
use node_kit::{Level, Node, Qos};
use tracing::{info, warn};

pub use oracle::{Change, Decider, Oracle, Refusal, SequenceError, sequence};
pub use parameters::{GoalModule, GoalOracleParameters};

/// How long the first goal waits for policy and executor, so that none of their first words is lost.
const PEERS: Duration = Duration::from_secs(5);

/// Runs the node.
pub async fn run(node: Node, parameters: GoalOracleParameters) -> anyhow::Result<()> {
    let path = parameters.demonstration()?.to_owned();
    let demonstration = Demonstration::read(&path).context("parameter demonstration")?;
    let goals = sequence(&demonstration, &parameters.world_frame)
        .with_context(|| format!("parameter demonstration: {}", path.display()))?;
    let decider = match (parameters.goal_module, parameters.require_confirmation) {
        (GoalModule::ImageDistance, _) => Decider::Image,
        (GoalModule::Oracle, true) => Decider::Operator,
        (GoalModule::Oracle, false) => Decider::Outcome,
    };
    let mut oracle = Oracle::new(goals, decider);

    let goal = node.publisher::<Goal>("goal", Qos::Latched)?;
    let refusals = node.publisher::<StepResult>("step_result", Qos::Event)?;
    let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
    let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
    let mut confirmations =
        node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;

    // Images to compare with: before the first step, then of each goal.
    let mut matcher = match decider {
        Decider::Image => Some(Matcher {
            heightmaps: node.subscription::<Heightmap>("heightmap", Qos::Latched)?,
            images: std::iter::once(demonstration.observation(0))
                .chain(demonstration.goals())
                .cloned()
                .collect(),
            newest: None,
        }),
        Decider::Operator | Decider::Outcome => None,
    };

    for topic in [proposals.topic(), results.topic()] {
        if !node.graph().wait_for_publisher(topic, PEERS).await {
            info!("nobody publishes {topic} yet; the first goal is latched all the same");
        }
    }
    latch(&node, &goal, &oracle);
    loop {
        let change = tokio::select! {
            proposal = proposals.recv() => {
                oracle.proposed(&proposal);
                Change::None
            }
            result = results.recv() => oracle.result(&result),
            () = observed(&mut matcher) => Change::None,
            confirmation = confirmations.recv() => {
                oracle.confirmed(&confirmation).unwrap_or_else(|refusal| {
                    warn!("confirmation refused: {refusal}");
                    confirmations.reject(format_args!("refused: {refusal}"));
                    refusals.publish(refused(&node, &parameters, &confirmation, &refusal));
                    Change::None
                })
            }
        };
        let change = match (change, &matcher) {
            (Change::None, Some(matcher)) => matcher.decide(&mut oracle),
            (change, _) => change,
        };
        match change {
            Change::None => {}
            Change::Goal(_) => latch(&node, &goal, &oracle),
            Change::Stopped => {
                info!("stopped by the operator");
                report(&node, &oracle);
            }
        }
    }
}

/// The goal module *image distance*.
struct Matcher {
    heightmaps: node_kit::Subscription<Heightmap>,
    images: Vec<heightmap::Heightmap>,
    /// With its stamp.
    newest: Option<(Duration, heightmap::Heightmap)>,
}

impl Matcher {
    /// Decides by the newest heightmap, if it was seen after the motion that waits for one.
    fn decide(&self, oracle: &mut Oracle) -> Change {
        let moved = oracle.waits_for_image();
        let moved = moved.and_then(|stamp| convert::time_from_msg(&stamp).ok());
        match (moved, &self.newest) {
            (Some(moved), Some((seen, heightmap))) if *seen >= moved => {
                match heightmap.nearest(&self.images) {
                    Some(reached) => oracle.matched(reached),
                    None => Change::None,
                }
            }
            _ => Change::None,
        }
    }
}

/// Waits for a heightmap; for ever where none is asked for.
async fn observed(matcher: &mut Option<Matcher>) {
    let Some(matcher) = matcher else {
        return std::future::pending().await;
    };
    let message = matcher.heightmaps.recv().await;
    let read = convert::time_from_msg(&message.header.stamp)
        .and_then(|stamp| Ok((stamp, convert::heightmap_from_msg(message)?)));
    match read {
        // One of another table would be infinitely far from all images alike.
        Ok((_, heightmap)) if heightmap.workspace != matcher.images[0].workspace => {
            matcher.heightmaps.reject(format_args!(
                "workspace is {:?}, expected that of the demonstration, {:?}",
                heightmap.workspace, matcher.images[0].workspace
            ));
        }
        Ok(read) => matcher.newest = Some(read),
        Err(error) => matcher.heightmaps.reject(error),
    }
}

fn latch(node: &Node, goal: &node_kit::Publisher<Goal>, oracle: &Oracle) {
    goal.publish(oracle.goal());
    let (step, count, attempt) = oracle.progress();
    if oracle.is_complete() {
        info!("all {count} steps are done");
    } else {
        info!("goal: step {step} of {count}, attempt {attempt}");
    }
    report(node, oracle);
}

fn report(node: &Node, oracle: &Oracle) {
    let (step, count, attempt) = oracle.progress();
    let message = if oracle.is_stopped() {
        format!("stopped at step {step} of {count}")
    } else if oracle.is_complete() {
        format!("all {count} steps are done")
    } else {
        format!("step {step} of {count}, attempt {attempt}")
    };
    node.diagnostics().set("goal", Level::Ok, message, []);
}

/// The operator's tools see a refusal where they see the executor's.
fn refused(
    node: &Node,
    parameters: &GoalOracleParameters,
    confirmation: &StepConfirmation,
    refusal: &Refusal,
) -> StepResult {
    StepResult {
        header: Header {
            stamp: node.now(),
            frame_id: parameters.world_frame.clone(),
        },
        proposal_id: confirmation.proposal_id,
        outcome: StepResult::REFUSED,
        reason: refusal.to_string(),
        ..StepResult::default()
    }
}
