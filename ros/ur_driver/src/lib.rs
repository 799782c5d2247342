#![doc = include_str!("../README.md")]

mod claim;
mod exclusion;
mod heartbeat;
mod motion;
mod parameters;
pub mod planted;
mod readiness;
mod robot;
mod running_motion;
pub mod status;
mod stop_file;
mod streams;
#[cfg(test)]
mod tests;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use msgs::control_msgs::{FollowJointTrajectory, JointTolerance};
use msgs::ur_msgs::{FollowJointTrajectoryUntil, SetIO};
use msgs::{convert, trajectory_msgs};
use node_kit::{ActionClient, CallOptions, Clock, Node, NodeError, ServiceClient, TaskGroup};
use tokio::sync::watch;
use ur5::{JointTrajectory, WorkCell};

use self::exclusion::Exclusion;
use self::readiness::{Readiness, watch_readiness};
use self::status::DriverStatus;
use self::streams::follow_status;

pub use self::exclusion::{ActivateError, ActiveExecutor};
pub use self::heartbeat::Heartbeat;
pub use self::parameters::DriverParameters;
pub use self::readiness::driver_obstacle;
pub use self::robot::DriverRobot;
pub use self::running_motion::{MotionEvent, RunningMotion};
pub use self::stop_file::StopFile;

/// Why the robot does not go on. Suction stays as it is: holding is safer than dropping.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DriverError {
    /// The motion was stopped: whoever stopped it knows why; or the enabling input was low.
    #[error("stopped")]
    Stopped,
    /// The driver failed, stopped by itself, or was lost.
    #[error("{0}")]
    Fault(String),
}

impl DriverError {
    fn fault(reason: impl std::fmt::Display) -> Self {
        Self::Fault(reason.to_string())
    }
}

/// The way to the driver.
pub struct DriverClient {
    follow: Arc<ActionClient<FollowJointTrajectory>>,
    until: Arc<ActionClient<FollowJointTrajectoryUntil>>,
    set_io: ServiceClient<SetIO>,
    readiness: watch::Receiver<Readiness>,
    /// The newest status of the driver.
    pub status: watch::Receiver<DriverStatus>,
    /// What the watchdog hears.
    pub heartbeat: Heartbeat,
    exclusion: Exclusion,
    parameters: DriverParameters,
    joint_names: [String; 6],
    clock: Clock,
    /// Whether it was told that the driver answers late.
    is_late: AtomicBool,
    /// Origin of the times of arrival in the status.
    pub origin: Instant,
    /// They go on until a motion under way is stopped, whatever becomes of the node.
    tasks: TaskGroup,
}

impl DriverClient {
    /// Looks for the driver's topics, services and actions, and follows its status.
    ///
    /// # Errors
    /// A name in the parameters is not a ROS name, or the middleware refuses.
    pub fn new(
        node: &Node,
        parameters: &DriverParameters,
        work_cell: &WorkCell,
    ) -> Result<Self, NodeError> {
        let origin = Instant::now();
        let tasks = node.task_group();
        Ok(Self {
            follow: Arc::new(node.action_client(&parameters.follow_action)?),
            until: Arc::new(node.action_client(&parameters.until_action)?),
            set_io: node.service_client(&format!("{}/set_io", parameters.io_and_status))?,
            readiness: watch_readiness(node, parameters)?,
            status: follow_status(node, &tasks, parameters, work_cell, origin)?,
            heartbeat: Heartbeat::new(node, &tasks)?,
            exclusion: Exclusion::new(node)?,
            parameters: parameters.clone(),
            joint_names: work_cell.joint_names.clone(),
            clock: node.clock().clone(),
            is_late: AtomicBool::new(false),
            origin,
            tasks,
        })
    }

    /// Makes this the executor that may move the arm.
    ///
    /// # Errors
    /// Another one is active.
    pub async fn activate(&self, node: &Node) -> Result<ActiveExecutor, ActivateError> {
        self.exclusion.activate(node).await
    }

    fn options(&self) -> CallOptions {
        CallOptions {
            attempts: self.parameters.call_attempts,
            timeout: Duration::from_secs_f64(self.parameters.call_timeout_s),
        }
    }

    /// What the driver was found to lack.
    fn refusal(&self) -> Option<String> {
        match &*self.readiness.borrow() {
            Readiness::Refused(reason) => Some(reason.clone()),
            Readiness::Ready | Readiness::Unchecked(_) => None,
        }
    }

    /// Whether the enabling input is low, or has been since a time.
    pub fn is_disabled_since(&self, since: Duration) -> bool {
        self.status.borrow().is_disabled_since(since)
    }

    /// Why the arm must not move now, if there is a reason.
    fn obstacle(&self) -> Option<String> {
        let max_age = Duration::from_secs_f64(self.parameters.status_max_age_s);
        self.status
            .borrow()
            .obstacle(self.origin.elapsed(), max_age)
    }

    /// Why nothing may begin to move, as far as is known. Where the driver's checks are still under way, a motion waits for them.
    pub fn obstacle_to_begin(&self) -> Option<String> {
        self.obstacle().or_else(|| self.refusal())
    }

    /// The same, and that it is not known yet what the driver lacks.
    pub fn unready(&self) -> Option<String> {
        self.obstacle()
            .or_else(|| self.readiness.borrow().obstacle())
    }

    /// Whether the arm has stood still since a time, as far as is known.
    fn rests_since(&self, status: &DriverStatus, since: Duration) -> bool {
        let (Some(joints), Some(still)) = (status.joints, status.still) else {
            return false;
        };
        let rest = Duration::from_secs_f64(self.parameters.rest_time_s);
        let rested = joints.at.saturating_sub(still.since.max(since));
        let at_rest = if self.clock.is_simulated() {
            // A simulator may be slow, and its time may run on. Where it stands still, so does the arm.
            rested >= 10 * rest || status.stands_in_time(self.clock.now_ns(), rest)
        } else {
            rested >= rest
        };
        joints.at >= since && at_rest
    }

    fn tolerances(&self, position_rad: f64) -> Vec<JointTolerance> {
        let tolerance = |name: &String| JointTolerance {
            name: name.clone(),
            position: position_rad,
            ..Default::default()
        };
        self.joint_names.iter().map(tolerance).collect()
    }

    fn trajectory(
        &self,
        trajectory: &JointTrajectory,
    ) -> Result<trajectory_msgs::JointTrajectory, DriverError> {
        convert::joint_trajectory_to_msg(trajectory, &self.joint_names).map_err(DriverError::fault)
    }
}
