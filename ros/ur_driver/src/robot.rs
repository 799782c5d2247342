//! The robot of one primitive: joints, suction, vacuum, and ways along trajectories.

use std::future::Future;
use std::sync::Arc;
use std::time::Duration;

use msgs::control_msgs::{FollowJointTrajectoryGoal, FollowJointTrajectoryResult};
use msgs::ur_msgs::{
    FollowJointTrajectoryUntilGoal, FollowJointTrajectoryUntilResult, SetIORequest,
};
use node_kit::GoalStatus;
use pick_place::{ContactSign, Robot};
use tokio::runtime::Handle;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tokio_util::sync::CancellationToken;
use tracing::debug;
use ur5::{JointTrajectory, Joints};

use crate::motion::WATCH_PERIOD;
use crate::readiness::Readiness;
use crate::status::DriverStatus;
use crate::{DriverClient, DriverError};

/// The robot for one primitive. Its methods block: not for the runtime's own threads.
pub struct DriverRobot {
    client: Arc<DriverClient>,
    runtime: Handle,
    stop: CancellationToken,
    /// When the primitive began, as the times of arrival in the status.
    begun: Duration,
    /// Stamp of the joint reading before the motion whose end has not been read yet.
    left: Option<Duration>,
    /// Stamps of the first and the last joint reading.
    pub stamps: Option<(Duration, Duration)>,
}

impl DriverRobot {
    /// For one primitive, which begins now; `stop` ends its motions.
    pub fn new(client: Arc<DriverClient>, runtime: Handle, stop: CancellationToken) -> Self {
        Self {
            begun: client.origin.elapsed(),
            client,
            runtime,
            stop,
            left: None,
            stamps: None,
        }
    }

    /// Refuses to go on where it must not.
    fn check(&self) -> Result<(), DriverError> {
        if self.stop.is_cancelled() || self.client.is_disabled_since(self.begun) {
            return Err(DriverError::Stopped);
        }
        if let Some(obstacle) = self.client.obstacle() {
            return Err(DriverError::Fault(obstacle));
        }
        let interrupted_at = self.client.status.borrow().interrupted_at;
        if interrupted_at.is_some_and(|at| at > self.begun) {
            return Err(DriverError::Fault(format!(
                "joint_states were interrupted for more than {:.1} s since the motion began: this process or the driver stood still",
                self.client.parameters.status_max_age_s
            )));
        }
        Ok(())
    }

    /// Waits until the robot must not go on.
    async fn forbidden(&self) -> DriverError {
        let mut ticks = interval(WATCH_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            if let Err(reason) = self.check() {
                return reason;
            }
            tokio::select! {
                () = self.stop.cancelled() => {}
                _ = ticks.tick() => {}
            }
        }
    }

    /// Refuses to go on with a driver that lacks something, or whose answer to an earlier goal is still to come. Soon after the start the
    /// checks may still be under way.
    async fn ready(&self) -> Result<(), DriverError> {
        self.check()?;
        let mut readiness = self.client.readiness.clone();
        let limit = Duration::from_secs_f64(self.client.parameters.reading_timeout_s);
        let checked = async {
            self.client.heartbeat.idle().await;
            // An error: what was found last counts.
            let unchecked = |found: &Readiness| matches!(found, Readiness::Unchecked(_));
            let _ = readiness.wait_for(|found| !unchecked(found)).await;
        };
        let checked = tokio::select! {
            checked = timeout(limit, checked) => checked,
            () = self.stop.cancelled() => return Err(DriverError::Stopped),
        };
        if let Some(reason) = self.client.readiness.borrow().obstacle() {
            return Err(DriverError::Fault(reason));
        }
        checked.map_err(|_| {
            DriverError::fault("the driver has not answered the goal of an earlier motion yet")
        })
    }

    /// Waits until the status is as it should be.
    async fn wait_for<T>(
        &self,
        what: &str,
        mut look: impl FnMut(&DriverStatus) -> Option<T>,
    ) -> Result<T, DriverError> {
        let mut status = self.client.status.clone();
        let limit = Duration::from_secs_f64(self.client.parameters.reading_timeout_s);
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
        let called = self.client.origin.elapsed();
        let left = self.left.take();
        let client = Arc::clone(&self.client);
        let reading = self
            .wait_for("the joints have not come to rest", |status| {
                let joints = status.joints?;
                let after_motion = left.is_none_or(|left| joints.value.stamp > left);
                let at_rest = client.rests_since(status, called);
                (after_motion && at_rest).then_some(joints.value)
            })
            .await?;
        debug!(
            "at rest after {:?}",
            self.client.origin.elapsed().saturating_sub(called)
        );
        let first = self.stamps.map_or(reading.stamp, |(first, _)| first);
        self.stamps = Some((first, reading.stamp));
        Ok(reading.positions_rad)
    }

    /// Waits until the driver counts as lost.
    async fn lost(&self) -> DriverError {
        let max_age = Duration::from_secs_f64(self.client.parameters.status_max_age_s);
        let mut ticks = interval(WATCH_PERIOD);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let now = self.client.origin.elapsed();
            if let Some(silence) = self.client.status.borrow().silence(now, max_age) {
                return DriverError::Fault(silence);
            }
            ticks.tick().await;
        }
    }

    /// Switches an output and waits until the driver says that it is switched. A driver that has fallen silent is not asked again: when
    /// it comes back, what it was asked before does not count any more.
    async fn switch_pin(&self, pin: u8, on: bool) -> Result<(), DriverError> {
        self.switch_pin_unless(pin, on, self.forbidden()).await
    }

    /// The same, until there is a reason not to go on asking.
    async fn switch_pin_unless(
        &self,
        pin: u8,
        on: bool,
        unless: impl Future<Output = DriverError>,
    ) -> Result<(), DriverError> {
        let request = SetIORequest {
            fun: SetIORequest::FUN_SET_DIGITAL_OUT,
            pin: pin as i8,
            state: f32::from(u8::from(on)),
        };
        let options = self.client.options();
        let response = tokio::select! {
            response = self.client.set_io.call(&request, &options) => response,
            reason = unless => return Err(reason),
        };
        if !response.map_err(DriverError::fault)?.success {
            let level = if on { "on" } else { "off" };
            return Err(DriverError::Fault(format!(
                "set_io refused to switch pin {pin} {level}"
            )));
        }
        Ok(())
    }

    async fn switch_suction(&self, on: bool) -> Result<(), DriverError> {
        self.ready().await?;
        let parameters = &self.client.parameters;
        let called = self.client.origin.elapsed();
        self.switch_pin(parameters.suction_pin, on).await?;
        self.wait_for("io_states have not confirmed the suction pin", |status| {
            let pins = status.pins?;
            (pins.at >= called && pins.value.suction == on).then_some(())
        })
        .await?;
        if on {
            // Whether something is held is asked later.
            self.vacuum_within(parameters.grasp_wait_s, true).await?;
            return Ok(());
        }
        let released = match u8::try_from(parameters.blow_off_pin) {
            Ok(pin) => self.blow_off(pin).await?,
            Err(_) => self.vacuum_within(parameters.release_wait_s, false).await?,
        };
        if released {
            return Ok(());
        }
        Err(DriverError::Fault(format!(
            "the vacuum sensor says that something is held {:.1} s after suction was switched off",
            parameters.release_wait_s
        )))
    }

    /// Blows off until the vacuum sensor says that nothing is held; `false`: it does not in time. Whatever happens meanwhile, a stop too, the output
    /// is switched off after that.
    async fn blow_off(&self, pin: u8) -> Result<bool, DriverError> {
        let limit_s = self.client.parameters.release_wait_s;
        let released = match self.switch_pin(pin, true).await {
            Ok(()) => self.vacuum_within(limit_s, false).await,
            Err(error) => Err(error),
        };
        match self.switch_pin_unless(pin, false, self.lost()).await {
            Ok(()) => released,
            Err(off) => Err(DriverError::Fault(match released {
                Ok(_) => format!("pin {pin} may still blow off: {off}"),
                Err(reason) => format!("{reason}; pin {pin} may still blow off: {off}"),
            })),
        }
    }

    /// Whether the vacuum sensor says so within a time (s), read after now.
    async fn vacuum_within(&self, limit_s: f64, held: bool) -> Result<bool, DriverError> {
        let mut status = self.client.status.clone();
        let seen = status.borrow().pins.map_or(0, |pins| pins.count);
        let waiting = async {
            loop {
                let pins = status.borrow_and_update().pins;
                if pins.is_some_and(|pins| pins.count >= seen + 2 && pins.value.vacuum == held) {
                    return Ok(true);
                }
                tokio::select! {
                    () = self.stop.cancelled() => return Err(DriverError::Stopped),
                    changed = status.changed() => changed.map_err(DriverError::fault)?,
                }
            }
        };
        let limit = Duration::from_secs_f64(limit_s);
        timeout(limit, waiting).await.unwrap_or(Ok(false))
    }

    /// What was sent before the call may still arrive after it; what comes second was sent later.
    async fn read_vacuum(&self) -> Result<bool, DriverError> {
        self.check()?;
        let seen = self
            .client
            .status
            .borrow()
            .pins
            .map_or(0, |pins| pins.count);
        self.wait_for("no io_states have arrived", |status| {
            let pins = status.pins?;
            (pins.count >= seen + 2).then_some(pins.value.vacuum)
        })
        .await
    }

    /// Whether the goal was reached; `false` where the lag rule says that the object was pulled too hard. Without that rule an arm
    /// that leaves its path may have met something: a fault, and the object stays held.
    async fn reached(
        &self,
        name: &str,
        status: GoalStatus,
        code: i32,
        reason: &str,
    ) -> Result<bool, DriverError> {
        let violated = code == FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED;
        if (status, code)
            == (
                GoalStatus::Succeeded,
                FollowJointTrajectoryResult::SUCCESSFUL,
            )
        {
            return Ok(true);
        }
        if violated && self.client.parameters.lag_rule {
            return Ok(false);
        }
        let what = if violated {
            " (path tolerance violated: something may be in the way)"
        } else {
            ""
        };
        let reason = if reason.is_empty() {
            "no reason given"
        } else {
            reason
        };
        // Why the robot has stopped is the better reason.
        let fault = DriverError::Fault(match self.client.obstacle() {
            Some(obstacle) => format!("{obstacle}; {name} ended as {status:?}: {reason}"),
            None => format!("{name} ended as {status:?} with error code {code}{what}: {reason}"),
        });
        Err(self.client.break_off(fault).await)
    }

    async fn move_along(&self, trajectory: &JointTrajectory) -> Result<bool, DriverError> {
        self.ready().await?;
        let (client, parameters) = (&self.client, &self.client.parameters);
        let goal = FollowJointTrajectoryGoal {
            trajectory: client.trajectory(trajectory)?,
            path_tolerance: client.tolerances(parameters.path_tolerance_rad),
            goal_tolerance: client.tolerances(parameters.goal_tolerance_rad),
            ..Default::default()
        };
        let motion = client.carry_out(&client.follow, goal, trajectory.duration(), &self.stop);
        let (status, result) = motion.await?;
        let name = client.follow.name();
        self.reached(name, status, result.error_code, &result.error_string)
            .await
    }

    /// The driver's own way: an action that stops the arm at contact.
    async fn move_until_contact(&self, trajectory: &JointTrajectory) -> Result<bool, DriverError> {
        self.ready().await?;
        let (client, parameters) = (&self.client, &self.client.parameters);
        let goal = FollowJointTrajectoryUntilGoal {
            trajectory: client.trajectory(trajectory)?,
            path_tolerance: client.tolerances(parameters.path_tolerance_rad),
            goal_tolerance: client.tolerances(parameters.goal_tolerance_rad),
            until_type: FollowJointTrajectoryUntilGoal::TOOL_CONTACT,
            ..Default::default()
        };
        let motion = client.carry_out(&client.until, goal, trajectory.duration(), &self.stop);
        let (status, result) = motion.await?;
        let name = client.until.name();
        let reached = self
            .reached(name, status, result.error_code, &result.error_string)
            .await?;
        let triggered =
            result.until_condition_result == FollowJointTrajectoryUntilResult::TRIGGERED;
        Ok(reached && triggered)
    }

    /// Suction is on while the tip comes down, and vacuum is the sign of contact. Where something is held already, there is no sign:
    /// the end of the way is where it is put down.
    async fn move_until_vacuum(&self, trajectory: &JointTrajectory) -> Result<bool, DriverError> {
        let parameters = &self.client.parameters;
        if self.read_vacuum().await? {
            return self.move_along(trajectory).await.map(|_| false);
        }
        self.ready().await?;
        self.switch_pin(parameters.suction_pin, true).await?;
        let motion = self.move_along(trajectory);
        tokio::pin!(motion);
        let mut status = self.client.status.clone();
        let held = async {
            while !status
                .borrow_and_update()
                .pins
                .is_some_and(|pins| pins.value.vacuum)
            {
                if status.changed().await.is_err() {
                    std::future::pending::<()>().await;
                }
            }
        };
        let touched = tokio::select! {
            ended = &mut motion => {
                ended?;
                // Vacuum takes time.
                self.vacuum_within(parameters.grasp_wait_s, true).await?
            }
            () = held => {
                self.client.stop_arm().await.map_err(DriverError::Fault)?;
                self.check()?;
                true
            }
        };
        if !touched {
            self.switch_pin(parameters.suction_pin, false).await?;
        }
        Ok(touched)
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
        let runtime = self.runtime.clone();
        runtime.block_on(self.move_along(trajectory))
    }

    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, DriverError> {
        self.leave();
        let runtime = self.runtime.clone();
        match self.client.parameters.contact {
            ContactSign::UntilAction => runtime.block_on(self.move_until_contact(trajectory)),
            ContactSign::Vacuum => runtime.block_on(self.move_until_vacuum(trajectory)),
            // Where the surface is known, the end of the way is the contact.
            ContactSign::Height => runtime.block_on(self.move_along(trajectory)),
        }
    }

    fn set_suction(&mut self, on: bool) -> Result<(), DriverError> {
        self.runtime.block_on(self.switch_suction(on))
    }

    fn holds(&mut self) -> Result<bool, DriverError> {
        self.runtime.block_on(self.read_vacuum())
    }
}
