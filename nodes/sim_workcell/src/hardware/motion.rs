//! Motions: the physics stepped through a goal, paced by the wall clock where that is asked for.

use std::thread;
use std::time::{Duration, Instant};

use cell_emulation::{End, Failure, Goal, Motion, Request};
use msgs::control_msgs::FollowJointTrajectoryResult;
use msgs::sctn_msgs::Reward;
use multiravens::MotionEnd;
use simulated_cell::Step;
use tracing::{error, info, warn};

use super::Hardware;
use crate::node::Command;

/// The most that simulated time catches up at once.
const MOST_CATCH_UP: Duration = Duration::from_millis(200);
/// Simulated time between feedback messages, as the driver's controllers have it.
const FEEDBACK_PERIOD: Duration = Duration::from_millis(50);

impl Hardware {
    /// Carries a goal out to its end.
    pub(super) fn carry_out(
        &mut self,
        goal: Goal,
        motion: Result<Motion, Failure>,
    ) -> anyhow::Result<()> {
        // Where the arm still brakes, it brakes no longer.
        self.cell.halt();
        let begun = motion.and_then(|motion| {
            let Motion {
                trajectory,
                until_contact,
                tolerances_rad,
            } = motion;
            let begun = self.cell.begin(trajectory, until_contact, &tolerances_rad);
            begun.map_err(|error| Failure::goal(error.to_string()))
        });
        if let Err(failure) = begun {
            warn!("goal aborted: {failure}");
            goal.end(End::Failed(failure));
            return Ok(());
        }
        self.forget_scene();
        let end = self.drive(&goal)?;
        match &end {
            End::Failed(failure) => error!("goal aborted: {failure}"),
            End::Reached | End::Contact => {}
            End::Cancelled => info!("goal cancelled, the arm stops"),
            End::Withdrawn(failure) => warn!("goal withdrawn: {failure}"),
        }
        if self.is_dead() {
            // Nobody hears how it ends.
            self.orphans.push(goal);
            return Ok(());
        }
        // Whoever hears of the end can know where it led to.
        self.publish_changed_pins();
        self.publish_state()?;
        if let Some(assessment) = self.cell.assess() {
            self.reward.publish(Reward {
                header: self.header()?,
                delta: assessment.delta_reward,
                total: assessment.total_reward,
                complete: assessment.complete,
            });
        }
        goal.end(end);
        self.coast()?;
        if self.cell.is_at_rest() {
            self.publish_scene()?;
        }
        Ok(())
    }

    /// Lets an arm that brakes come to rest.
    pub(super) fn coast(&mut self) -> anyhow::Result<()> {
        if !self.cell.is_moving() {
            return Ok(());
        }
        let begin = (Instant::now(), self.cell.time());
        while self.cell.is_moving() {
            match self.cell.step(self.now()) {
                Step::Moving | Step::Deviated(_) => {}
                Step::Ended(_) => break,
                Step::Failed(reason) => {
                    error!("braking: {reason}");
                    break;
                }
            }
            if Instant::now() >= self.next_status {
                self.publish_state()?;
            }
            self.pace(begin);
        }
        self.publish_state()
    }

    /// Lets time go on with the wall clock where nothing moves.
    pub(super) fn run_on(&mut self) -> anyhow::Result<()> {
        let now = self.now();
        if !self.parameters.hardware.free_running {
            // The vacuum takes its time all the same.
            self.cell.update_vacuum(now, false);
            return Ok(());
        }
        // A host that is behind catches up little by little.
        let due = (self.origin.1 + now).min(self.cell.time() + MOST_CATCH_UP);
        while self.cell.time() < due {
            self.cell.pass_time(now)?;
        }
        Ok(())
    }

    /// Steps the physics to the goal's end.
    pub(super) fn drive(&mut self, goal: &Goal) -> anyhow::Result<End> {
        let begin = (Instant::now(), self.cell.time());
        let rate_hz = self.parameters.joint_states_rate_hz;
        let tick_of = |time: Duration, rate_hz: f64| (time.as_secs_f64() * rate_hz) as u64;
        let mut said = tick_of(begin.1, rate_hz);
        let mut next_feedback = begin.1 + FEEDBACK_PERIOD;
        loop {
            while let Ok(command) = self.commands.try_recv() {
                match self.handle_while_moving(command) {
                    None => {}
                    Some(Command::Driver(Request::Die)) => self.end_driver(),
                    Some(command) => {
                        self.cell.halt();
                        self.next = Some(command);
                        return Ok(End::withdrawn("a newer trajectory has come"));
                    }
                }
            }
            self.acceptance.reject_due(self.now());
            if goal.is_cancel_requested() || self.is_stopped() {
                self.cell.cancel();
                return Ok(End::Cancelled);
            }
            if self.is_dead() {
                self.cell.cancel();
                self.coast_unheard();
                return Ok(End::withdrawn("the driver is gone"));
            }
            if let Some(reason) = self.acceptance.lost_controller() {
                self.cell.cancel();
                return Ok(End::withdrawn(&reason));
            }
            if !self.fault.lets_move() {
                self.cell.cancel();
                return Ok(End::withdrawn(&format!(
                    "the robot has stopped: {:?}",
                    self.fault
                )));
            }
            match self.cell.step(self.now()) {
                Step::Moving => {}
                Step::Ended(MotionEnd::Reached) => return Ok(End::Reached),
                Step::Ended(MotionEnd::Contact) => return Ok(End::Contact),
                Step::Ended(MotionEnd::Lag) => return Ok(End::Failed(lag())),
                Step::Deviated(deviation) => {
                    self.cell.cancel();
                    let code = FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED;
                    return Ok(End::Failed(Failure::new(code, deviation.to_string())));
                }
                Step::Failed(reason) => {
                    self.cell.cancel();
                    let code = FollowJointTrajectoryResult::INVALID_GOAL;
                    return Ok(End::Failed(Failure::new(code, reason)));
                }
            }
            let time = self.cell.time();
            let tick = tick_of(time, rate_hz);
            if tick != said {
                said = tick;
                self.take_parameters();
                self.publish_state()?;
            }
            if time >= next_feedback {
                next_feedback += FEEDBACK_PERIOD;
                self.publish_feedback(goal, time - begin.1)?;
            }
            if Instant::now() >= self.next_pins {
                self.publish_pins();
            }
            self.pace(begin);
        }
    }

    /// An arm whose driver is gone brakes by itself.
    pub(super) fn coast_unheard(&mut self) {
        let begin = (Instant::now(), self.cell.time());
        while self.cell.is_moving() {
            if !matches!(self.cell.step(self.now()), Step::Moving | Step::Deviated(_)) {
                break;
            }
            self.pace(begin);
        }
        self.cell.halt();
    }

    /// Waits where simulated time is to run no faster than a multiple of the wall clock's.
    pub(super) fn pace(&self, begin: (Instant, Duration)) {
        let factor = match self.parameters.real_time_factor {
            0.0 if self.parameters.hardware.free_running => 1.0,
            factor => factor,
        };
        if factor > 0.0 {
            let due = (self.cell.time() - begin.1).div_f64(factor);
            thread::sleep(due.saturating_sub(begin.0.elapsed()));
        }
    }
}

/// The suction tip cannot follow the arm.
fn lag() -> Failure {
    let reason = format!(
        "the suction tip was more than {} m behind the arm",
        multiravens::MAX_LAG_M
    );
    Failure::new(FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED, reason)
}
