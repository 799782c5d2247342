//! Motions: the physics stepped through a goal, paced by the wall clock where that is asked for.

use std::thread;
use std::time::Instant;

use msgs::sctn_msgs::Reward;
use simulated_cell::{MotionTicks, Pace, Step};
use tracing::{error, info, warn};

use crate::goal::{End, Goal, Motion};
use crate::server::Request;
use crate::trajectory::Failure;

use super::{Command, Emulator, EmulatorError};

impl Emulator {
    /// Carries a goal out to its end.
    pub(super) fn carry_out(
        &mut self,
        goal: Goal,
        motion: Result<Motion, Failure>,
    ) -> Result<(), EmulatorError> {
        // Where the arm still brakes, it brakes no longer.
        self.cell.halt();
        let begun = motion.and_then(|motion| {
            let tolerances_rad = &motion.tolerances_rad;
            let begun = self
                .cell
                .begin(motion.trajectory, motion.until_contact, tolerances_rad);
            begun.map_err(|error| Failure::goal(error.to_string()))
        });
        if let Err(failure) = begun {
            warn!("goal aborted: {failure}");
            goal.end(End::Failed(failure));
            return Ok(());
        }
        self.cameras.hide();
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
    pub(super) fn coast(&mut self) -> Result<(), EmulatorError> {
        if !self.cell.is_moving() {
            return Ok(());
        }
        let pace = self.pace();
        while self.cell.is_moving() {
            match self.cell.step(self.now()) {
                Step::Moving | Step::Deviated(_) => {}
                Step::Ended(_) => break,
                Step::Failed(reason) => {
                    error!("braking: {reason}");
                    break;
                }
            }
            if self.schedule.is_status_due(Instant::now()) {
                self.publish_state()?;
            }
            self.wait(&pace);
        }
        self.publish_state()
    }

    /// Steps the physics to the goal's end.
    fn drive(&mut self, goal: &Goal) -> Result<End, EmulatorError> {
        let pace = self.pace();
        let mut ticks = MotionTicks::new(self.cell.time(), self.settings.joint_states_rate_hz);
        loop {
            while let Ok(command) = self.commands.try_recv() {
                match self.handle_while_moving(command) {
                    None => {}
                    Some(Command::Driver(Request::Die)) => self.driver().end(),
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
                // An arm whose driver is gone brakes by itself.
                self.cell.cancel();
                self.coast()?;
                self.cell.halt();
                return Ok(End::withdrawn("the driver is gone"));
            }
            if let Some(end) = self.acceptance.withdrawal() {
                self.cell.cancel();
                return Ok(end);
            }
            let step = self.cell.step(self.now());
            if matches!(step, Step::Deviated(_) | Step::Failed(_)) {
                self.cell.cancel();
            }
            if let Some(end) = End::of_step(step) {
                return Ok(end);
            }
            let time = self.cell.time();
            if ticks.are_states_due(time) {
                self.take_settings();
                self.publish_state()?;
            }
            if let Some(elapsed) = ticks.feedback(time) {
                self.publish_feedback(goal, elapsed)?;
            }
            if self.schedule.are_pins_due(Instant::now()) {
                self.publish_pins();
            }
            self.wait(&pace);
        }
    }

    /// Simulated time beside the wall clock's, from now on.
    fn pace(&self) -> Pace {
        Pace::new(Instant::now(), self.cell.time())
    }

    /// Waits where simulated time is to run no faster than a multiple of the wall clock's.
    fn wait(&self, pace: &Pace) {
        let factor = match self.settings.real_time_factor {
            0.0 if self.settings.hardware.free_running => 1.0,
            factor => factor,
        };
        thread::sleep(pace.wait(Instant::now(), self.cell.time(), factor));
    }
}
