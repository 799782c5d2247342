//! Node that holds the demonstration sequence and latches the next-step goal.
//!
//! Which goal is next is decided in [`Oracle`], which knows no ROS node.

mod oracle;
mod parameters;

use std::time::Duration;

use anyhow::Context as _;
use bags::Demonstration;
use msgs::{
    sctn_msgs::{Goal, PickPlace, StepConfirmation, StepResult},
    std_msgs::Header,
};
use node_kit::{Level, Node, Qos};
use tracing::{info, warn};

pub use oracle::{Change, Oracle, Refusal, SequenceError, sequence};
pub use parameters::GoalOracleParameters;

/// How long the first goal waits for policy and executor, so that none of their first words is lost.
const PEERS: Duration = Duration::from_secs(5);

/// Runs the node.
pub async fn run(node: Node, parameters: GoalOracleParameters) -> anyhow::Result<()> {
    let path = parameters.demonstration()?.to_owned();
    let demonstration = Demonstration::read(&path).context("parameter demonstration")?;
    let goals = sequence(&demonstration, &parameters.world_frame)
        .with_context(|| format!("parameter demonstration: {}", path.display()))?;
    let mut oracle = Oracle::new(goals, parameters.require_confirmation);

    let goal = node.publisher::<Goal>("goal", Qos::Latched)?;
    let refusals = node.publisher::<StepResult>("step_result", Qos::Event)?;
    let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
    let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
    let mut confirmations =
        node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;

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
            confirmation = confirmations.recv() => {
                oracle.confirmed(&confirmation).unwrap_or_else(|refusal| {
                    warn!("confirmation refused: {refusal}");
                    confirmations.reject(format_args!("refused: {refusal}"));
                    refusals.publish(refused(&node, &parameters, &confirmation, &refusal));
                    Change::None
                })
            }
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
