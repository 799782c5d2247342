//! The robot behind the UR driver's topics, service and actions.

use std::sync::Arc;
use std::time::{Duration, Instant};

use msgs::control_msgs::{
    FollowJointTrajectory, FollowJointTrajectoryGoal, FollowJointTrajectoryResult, JointTolerance,
};
use msgs::trajectory_msgs;
use msgs::ur_msgs::{
    FollowJointTrajectoryUntil, FollowJointTrajectoryUntilGoal, FollowJointTrajectoryUntilResult,
    SetIO, SetIORequest,
};
use msgs::{Action, convert};
use node_kit::{
    ActionClient, CallError, CallOptions, Clock, GoalStatus, Node, SentGoal, ServiceClient,
};
use pick_place::Robot;
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_util::sync::CancellationToken;
use tracing::{debug, warn};
use ur5::{JointTrajectory, Joints};

use crate::parameters::Driver;
use crate::status::DriverStatus;

/// How often a motion is looked after.
const WATCH_PERIOD: Duration = Duration::from_millis(20);

/// Why the robot does not go on. Suction stays as it is: holding is safer than dropping.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum DriverError {
    /// The operator said stop.
    #[error("stopped by the operator")]
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
pub(crate) struct Link {
    follow: ActionClient<FollowJointTrajectory>,
    until: ActionClient<FollowJointTrajectoryUntil>,
    set_io: ServiceClient<SetIO>,
    status: watch::Receiver<DriverStatus>,
    parameters: Driver,
    joint_names: [String; 6],
    clock: Clock,
    /// Origin of the times of arrival in the status.
    origin: Instant,
}

impl Link {
    pub(crate) fn new(
        node: &Node,
        parameters: &Driver,
        joint_names: &[String; 6],
        status: watch::Receiver<DriverStatus>,
        origin: Instant,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            follow: node.action_client(&parameters.follow_action)?,
            until: node.action_client(&parameters.until_action)?,
            set_io: node.service_client(&format!("{}/set_io", parameters.io_and_status))?,
            status,
            parameters: parameters.clone(),
            joint_names: joint_names.clone(),
            clock: node.clock().clone(),
            origin,
        })
    }

    fn options(&self) -> CallOptions {
        CallOptions {
            attempts: self.parameters.call_attempts,
            timeout: Duration::from_secs_f64(self.parameters.call_timeout_s),
        }
    }

    fn obstacle(&self) -> Option<String> {
        let max_age = Duration::from_secs_f64(self.parameters.status_max_age_s);
        self.status
            .borrow()
            .obstacle(self.origin.elapsed(), max_age)
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

/// The robot for one primitive. Its methods block: not for the runtime's own threads.
pub(crate) struct DriverRobot {
    link: Arc<Link>,
    runtime: Handle,
    stop: CancellationToken,
    /// Stamp of the joint reading before the motion whose end has not been read yet.
    left: Option<Duration>,
    /// Stamps of the first and the last joint reading.
    pub(crate) stamps: Option<(Duration, Duration)>,
}

impl DriverRobot {
    pub(crate) fn new(link: Arc<Link>, runtime: Handle, stop: CancellationToken) -> Self {
        Self {
            link,
            runtime,
            stop,
            left: None,
            stamps: None,
        }
    }

    /// Refuses to go on where it must not.
    fn check(&self) -> Result<(), DriverError> {
        if self.stop.is_cancelled() {
            return Err(DriverError::Stopped);
        }
        self.link
            .obstacle()
            .map_or(Ok(()), |obstacle| Err(DriverError::Fault(obstacle)))
    }

    /// Has a goal carried out, under watch.
    async fn carry_out<A: Action + 'static>(
        &self,
        client: &ActionClient<A>,
        goal: &A::Goal,
        planned: Duration,
    ) -> Result<(GoalStatus, A::Result), DriverError> {
        self.check()?;
        let begin = Instant::now();
        let options = self.link.options();
        let sent = match client.send_goal(goal, &options).await {
            Ok(sent) => sent,
            Err(error) => {
                // Its reply may be what was lost.
                if !matches!(error, CallError::Rejected { .. })
                    && let Err(error) = client.cancel_all(&options).await
                {
                    warn!("goals of unknown state not cancelled: {error}");
                }
                return Err(DriverError::fault(error));
            }
        };
        let accepted = begin.elapsed();
        let trouble = tokio::select! {
            end = sent.result() => match end {
                Ok(end) => {
                    debug!("motion of {planned:?}: accepted after {accepted:?}, ended after {:?}", begin.elapsed());
                    return Ok(end);
                }
                Err(error) => DriverError::fault(error),
            },
            trouble = self.trouble(planned) => trouble,
        };
        self.cancel(&sent).await.map_err(|reason| {
            DriverError::Fault(format!("{trouble}; the motion may go on: {reason}"))
        })?;
        Err(trouble)
    }

    /// Waits for a reason to break a motion off.
    async fn trouble(&self, planned: Duration) -> DriverError {
        let Driver {
            motion_time_factor,
            motion_time_margin_s,
            ..
        } = self.link.parameters;
        let margin = Duration::from_secs_f64(motion_time_margin_s);
        let limit = planned.mul_f64(motion_time_factor) + margin;
        let begin_ns = self.link.clock.now_ns();
        let mut ticks = interval(WATCH_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                () = self.stop.cancelled() => return DriverError::Stopped,
                _ = ticks.tick() => {}
            }
            if let Some(obstacle) = self.link.obstacle() {
                return DriverError::Fault(obstacle);
            }
            let elapsed_ns = self.link.clock.now_ns() - begin_ns;
            if u128::try_from(elapsed_ns).is_ok_and(|elapsed| elapsed > limit.as_nanos()) {
                return DriverError::Fault(format!(
                    "a motion of {:.1} s has not ended after {:.1} s",
                    planned.as_secs_f64(),
                    limit.as_secs_f64()
                ));
            }
        }
    }

    /// Cancels a goal and waits for its end; says why it may still be active.
    async fn cancel<A: Action + 'static>(&self, sent: &SentGoal<A>) -> Result<(), String> {
        let options = self.link.options();
        let cancelled = sent.cancel(&options).await;
        match timeout(options.timeout, sent.result()).await {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(error)) => Err(error.to_string()),
            Err(_) => Err(match cancelled {
                Ok(()) => "it was cancelled but has not ended".into(),
                Err(error) => error.to_string(),
            }),
        }
    }

    /// Waits until the status is as it should be.
    async fn wait_for<T>(
        &self,
        what: &str,
        mut look: impl FnMut(&DriverStatus) -> Option<T>,
    ) -> Result<T, DriverError> {
        let mut status = self.link.status.clone();
        let limit = Duration::from_secs_f64(self.link.parameters.reading_timeout_s);
        let waiting = async {
            loop {
                if let Some(found) = look(&status.borrow_and_update()) {
                    return Ok(found);
                }
                tokio::select! {
                    () = self.stop.cancelled() => return Err(DriverError::Stopped),
                    changed = status.changed() => changed.map_err(DriverError::fault)?,
                }
            }
        };
        timeout(limit, waiting).await.unwrap_or_else(|_| {
            Err(DriverError::Fault(format!(
                "{what} within {:.1} s",
                limit.as_secs_f64()
            )))
        })
    }

    async fn read_joints(&mut self) -> Result<Joints, DriverError> {
        let called = self.link.origin.elapsed();
        let left = self.left.take();
        let simulated = self.link.clock.is_simulated();
        let rest = Duration::from_secs_f64(self.link.parameters.rest_time_s);
        // A simulator may be slow, and its time may run on.
        let rest = if simulated { 10 * rest } else { rest };
        let reading = self
            .wait_for("the joints have not come to rest", |status| {
                let (joints, still) = (status.joints?, status.still?);
                let after_motion = left.is_none_or(|left| joints.value.stamp > left);
                // Where simulated time stands still, so does the arm.
                let at_rest = (simulated && still.in_time)
                    || joints.at.saturating_sub(still.since.max(called)) >= rest;
                (joints.at >= called && after_motion && at_rest).then_some(joints.value)
            })
            .await?;
        debug!(
            "at rest after {:?}",
            self.link.origin.elapsed().saturating_sub(called)
        );
        let first = self.stamps.map_or(reading.stamp, |(first, _)| first);
        self.stamps = Some((first, reading.stamp));
        Ok(reading.positions_rad)
    }

    async fn switch_suction(&self, on: bool) -> Result<(), DriverError> {
        self.check()?;
        let request = SetIORequest {
            fun: SetIORequest::FUN_SET_DIGITAL_OUT,
            pin: self.link.parameters.suction_pin as i8,
            state: f32::from(u8::from(on)),
        };
        let called = self.link.origin.elapsed();
        let response = self.link.set_io.call(&request, &self.link.options()).await;
        if !response.map_err(DriverError::fault)?.success {
            return Err(DriverError::Fault(format!(
                "set_io refused to switch pin {} {}",
                request.pin,
                if on { "on" } else { "off" }
            )));
        }
        self.wait_for("io_states have not confirmed the suction pin", |status| {
            let pins = status.pins?;
            (pins.at >= called && pins.value.suction == on).then_some(())
        })
        .await
    }

    /// What was sent before the call may still arrive after it; what comes second was sent later.
    async fn read_vacuum(&self) -> Result<bool, DriverError> {
        self.check()?;
        let seen = self.link.status.borrow().pins.map_or(0, |pins| pins.count);
        self.wait_for("no io_states have arrived", |status| {
            let pins = status.pins?;
            (pins.count >= seen + 2).then_some(pins.value.vacuum)
        })
        .await
    }

    /// Whether the goal was reached; `false` where the robot could not keep to the path.
    fn reached(
        &self,
        name: &str,
        status: GoalStatus,
        code: i32,
        reason: &str,
    ) -> Result<bool, DriverError> {
        match (status, code) {
            (GoalStatus::Succeeded, FollowJointTrajectoryResult::SUCCESSFUL) => Ok(true),
            (_, FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED) => Ok(false),
            _ => Err(DriverError::Fault(format!(
                "{name} ended as {status:?} with error code {code}: {}",
                if reason.is_empty() {
                    "no reason given"
                } else {
                    reason
                }
            ))),
        }
    }

    fn leave(&mut self) {
        self.left = self.stamps.map(|(_, last)| last);
    }
}

impl Robot for DriverRobot {
    type Error = DriverError;

    fn joints(&mut self) -> Result<Joints, DriverError> {
        let runtime = self.runtime.clone();
        runtime.block_on(self.read_joints())
    }

    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, DriverError> {
        self.leave();
        let (link, parameters) = (&self.link, &self.link.parameters);
        let goal = FollowJointTrajectoryGoal {
            trajectory: link.trajectory(trajectory)?,
            path_tolerance: link.tolerances(parameters.path_tolerance_rad),
            goal_tolerance: link.tolerances(parameters.goal_tolerance_rad),
            ..Default::default()
        };
        let motion = self.carry_out(&link.follow, &goal, trajectory.duration());
        let (status, result) = self.runtime.block_on(motion)?;
        self.reached(
            link.follow.name(),
            status,
            result.error_code,
            &result.error_string,
        )
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, DriverError> {
        self.leave();
        let (link, parameters) = (&self.link, &self.link.parameters);
        let goal = FollowJointTrajectoryUntilGoal {
            trajectory: link.trajectory(trajectory)?,
            path_tolerance: link.tolerances(parameters.path_tolerance_rad),
            goal_tolerance: link.tolerances(parameters.goal_tolerance_rad),
            until_type: FollowJointTrajectoryUntilGoal::TOOL_CONTACT,
            ..Default::default()
        };
        let motion = self.carry_out(&link.until, &goal, trajectory.duration());
        let (status, result) = self.runtime.block_on(motion)?;
        let reached = self.reached(
            link.until.name(),
            status,
            result.error_code,
            &result.error_string,
        )?;
        let triggered =
            result.until_condition_result == FollowJointTrajectoryUntilResult::TRIGGERED;
        Ok(reached && triggered)
    }

    fn set_suction(&mut self, on: bool) -> Result<(), DriverError> {
        self.runtime.block_on(self.switch_suction(on))
    }

    fn holds(&mut self) -> Result<bool, DriverError> {
        self.runtime.block_on(self.read_vacuum())
    }
}
