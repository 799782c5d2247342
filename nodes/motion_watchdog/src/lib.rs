//! Node that cancels the robot's trajectory when the executor that asked for it dies.

pub mod watch;

use std::sync::Arc;
use std::time::{Duration, Instant};

use msgs::Action;
use msgs::control_msgs::FollowJointTrajectory;
use msgs::std_msgs::Bool;
use msgs::ur_msgs::FollowJointTrajectoryUntil;
use node_kit::{
    ActionClient, Active, CallOptions, Level, Node, Parameters, Qos, Range, Subscription, when,
};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use serde::{Deserialize, Serialize};
use tokio::time::sleep_until;
use tracing::{error, warn};

use crate::watch::Watch;

/// Parameters of the node; `config/motion_watchdog.yaml` explains each.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionWatchdogParameters {
    /// Action that follows a trajectory.
    pub follow_action: String,
    /// Action that follows a trajectory until the tool touches something.
    pub until_action: String,
    /// Wall seconds after which an executor that has said nothing in the middle of a motion is dead.
    pub timeout_s: f64,
    /// For how many wall seconds goals are cancelled again and again.
    pub insist_s: f64,
}

impl Default for MotionWatchdogParameters {
    fn default() -> Self {
        Self {
            follow_action: "scaled_joint_trajectory_controller/follow_joint_trajectory".into(),
            until_action: "trajectory_until_node/execute".into(),
            timeout_s: 0.2,
            insist_s: 3.0,
        }
    }
}

impl Parameters for MotionWatchdogParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/motion_watchdog.yaml");
    const RANGES: &'static [(&'static str, Range)] = &[
        // Twice the period of the heartbeat, at least.
        ("timeout_s", Range::Float(0.1, 10.0)),
        ("insist_s", Range::Float(0.1, 60.0)),
    ];
    const CHANGEABLE: &'static [&'static str] = &[];
}

/// How often goals are cancelled again.
const CANCEL_PERIOD: Duration = Duration::from_millis(100);

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("motion_watchdog", arguments, configure)
}

/// Sets up the clients of the driver's actions.
pub async fn configure(
    node: Node,
    parameters: MotionWatchdogParameters,
) -> anyhow::Result<WatchdogNode> {
    Ok(WatchdogNode {
        follow: Arc::new(node.action_client(&parameters.follow_action)?),
        until: Arc::new(node.action_client(&parameters.until_action)?),
        parameters,
    })
}

/// The configured node.
pub struct WatchdogNode {
    follow: Arc<ActionClient<FollowJointTrajectory>>,
    until: Arc<ActionClient<FollowJointTrajectoryUntil>>,
    parameters: MotionWatchdogParameters,
}

impl Active for WatchdogNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut heartbeats: Subscription<Bool> =
            node.subscription("motion_heartbeat", Qos::Event)?;
        let mut watch = Watch::new(Duration::from_secs_f64(self.parameters.timeout_s));
        node.diagnostics()
            .set("executor", Level::Ok, "watched".to_owned(), []);
        loop {
            let deadline = watch.deadline();
            tokio::select! {
                biased;
                message = heartbeats.recv() => watch.on_heartbeat(message.data, Instant::now()),
                () = when(deadline.map(|deadline| sleep_until(deadline.into()))) => {}
                () = node.deactivated() => return Ok(()),
            }
            if watch.has_died(Instant::now()) {
                error!(
                    "no heartbeat of the executor for {:.2} s in the middle of a motion: cancelling it",
                    self.parameters.timeout_s
                );
                node.diagnostics().set(
                    "executor",
                    Level::Error,
                    "died in the middle of a motion, which was cancelled".to_owned(),
                    [],
                );
                self.cancel(node);
            }
        }
    }
}

impl WatchdogNode {
    /// Cancels all goals of both actions, again and again for a while.
    fn cancel(&self, node: &Node) {
        let insist = Duration::from_secs_f64(self.parameters.insist_s);
        insist_on_cancel(node, Arc::clone(&self.follow), insist);
        insist_on_cancel(node, Arc::clone(&self.until), insist);
    }
}

fn insist_on_cancel<A: Action + 'static>(
    node: &Node,
    client: Arc<ActionClient<A>>,
    insist: Duration,
) {
    let once = CallOptions {
        attempts: 1,
        timeout: Duration::from_millis(500),
    };
    node.spawn(async move {
        let begin = Instant::now();
        while begin.elapsed() < insist {
            if let Err(error) = client.cancel_all(&once).await {
                warn!("{error}");
            }
            tokio::time::sleep(CANCEL_PERIOD).await;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes =
            node_kit::mistakes_in_documentation::<MotionWatchdogParameters>("motion_watchdog");
        assert_eq!(mistakes, [""; 0]);
    }
}
