//! Whether and when the driver takes a goal.

use std::sync::Arc;
use std::time::Duration;

use driver_model::{AcceptanceQueue, Answer, HardwareSettings};
use msgs::control_msgs::FollowJointTrajectory;
use msgs::ur_msgs::FollowJointTrajectoryUntil;
use node_kit::NewGoal;
use ur5::WorkCell;

use crate::goal::{End, Goal, Motion};
use crate::server::{ActionNames, DriverState};
use crate::trajectory::Failure;

/// Detects contact; only robots with software 5 or later have it.
const TOOL_CONTACT: &str = "tool_contact_controller";

/// Takes goals or rejects them. The trajectory controller answers at once; `trajectory_until_node` takes its time, works on one
/// request after the other, and rejects what has its turn while another goal is active.
pub struct Acceptance {
    state: Arc<DriverState>,
    /// The controller that follows trajectories.
    controller: String,
    work_cell: WorkCell,
    path_tolerance_rad: f64,
    /// Goals of `trajectory_until_node` that wait for their answer.
    unanswered: AcceptanceQueue<NewGoal<FollowJointTrajectoryUntil>>,
}

impl Acceptance {
    /// Draws how long answers take from a seed.
    pub fn new(
        state: Arc<DriverState>,
        actions: &ActionNames,
        work_cell: &WorkCell,
        hardware: &HardwareSettings,
        seed: u64,
    ) -> Self {
        let (min, max) = answer_range(hardware);
        Self {
            state,
            controller: actions.controller().to_owned(),
            work_cell: work_cell.clone(),
            path_tolerance_rad: hardware.path_tolerance_rad,
            unanswered: AcceptanceQueue::new(min, max, seed),
        }
    }

    /// Takes over how long answers take from now on.
    pub fn set_hardware(&mut self, hardware: &HardwareSettings) {
        let (min, max) = answer_range(hardware);
        self.unanswered.set_range(min, max);
    }

    /// Accepts a goal of the trajectory controller, or rejects it.
    pub fn follow(
        &self,
        goal: NewGoal<FollowJointTrajectory>,
    ) -> Option<(Goal, Result<Motion, Failure>)> {
        if let Some(reason) = self.inactive(&self.controller) {
            goal.reject(reason);
            return None;
        }
        Some(Goal::follow(goal, &self.work_cell, self.path_tolerance_rad))
    }

    /// A goal of `trajectory_until_node` has come: it waits for its answer.
    pub fn wait(&mut self, goal: NewGoal<FollowJointTrajectoryUntil>, now: Duration) {
        self.unanswered.push(goal, now);
    }

    /// When the next answer is due.
    pub fn due(&self) -> Option<Duration> {
        self.unanswered.due()
    }

    /// The next goal of `trajectory_until_node` that is accepted now, no goal being active. Rejects on the way what the controllers do
    /// not take.
    pub fn next(&mut self, now: Duration) -> Option<(Goal, Result<Motion, Failure>)> {
        loop {
            let (Answer::Accept(goal) | Answer::Busy(goal)) = self.unanswered.pop(now, false)?;
            let inactive = self
                .inactive(&self.controller)
                .or_else(|| self.inactive(TOOL_CONTACT));
            match inactive {
                Some(reason) => goal.reject(reason),
                None => {
                    return Some(Goal::until(goal, &self.work_cell, self.path_tolerance_rad));
                }
            }
        }
    }

    /// Rejects the goals of `trajectory_until_node` whose time has come while another goal is active.
    pub fn reject_due(&mut self, now: Duration) {
        while let Some(answer) = self.unanswered.pop(now, true) {
            let (Answer::Accept(goal) | Answer::Busy(goal)) = answer;
            goal.reject("another goal is active");
        }
    }

    /// The driver was started again: it knows nothing of what waited.
    pub fn restart(&mut self) {
        for goal in self.unanswered.clear() {
            goal.reject("the driver was started again");
        }
    }

    /// The end of the goal under way, where nobody has asked for it: its controller was deactivated, or the robot has stopped.
    pub fn withdrawal(&self) -> Option<End> {
        if !self.state.controllers().is_active(&self.controller) {
            let reason = format!("{} was deactivated", self.controller);
            return Some(End::withdrawn(&reason));
        }
        let fault = self.state.fault();
        let reason = || format!("the robot has stopped: {fault:?}");
        (!fault.lets_move()).then(|| End::withdrawn(&reason()))
    }

    /// Why a controller takes no goals.
    fn inactive(&self, controller: &str) -> Option<String> {
        let fault = self.state.fault();
        if !fault.modes().program_running {
            return Some(format!("{controller} does not run: {fault:?}"));
        }
        let active = self.state.controllers().is_active(controller);
        (!active).then(|| format!("{controller} is not active"))
    }
}

/// Shortest and longest time until `trajectory_until_node` answers.
fn answer_range(hardware: &HardwareSettings) -> (Duration, Duration) {
    (
        Duration::from_secs_f64(hardware.until_answer_min_s),
        Duration::from_secs_f64(hardware.until_answer_max_s),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use driver_model::Fault;

    #[test]
    fn a_goal_ends_where_its_controller_is_deactivated_or_the_robot_stops() {
        let actions = ActionNames {
            follow: "/arm/follow".into(),
            until: "until".into(),
        };
        let mut hardware = HardwareSettings::default();
        let state = Arc::new(DriverState::new(&actions, &hardware));
        let work_cell = WorkCell::builtin().unwrap();
        let acceptance =
            Acceptance::new(Arc::clone(&state), &actions, &work_cell, &hardware, 10_000);
        let reason = || match acceptance.withdrawal() {
            None => String::new(),
            Some(End::Withdrawn(failure)) => failure.reason,
            Some(_) => panic!("not withdrawn"),
        };
        assert_eq!(reason(), "");
        state.set_fault(Fault::ProtectiveStop);
        assert_eq!(reason(), "the robot has stopped: ProtectiveStop");
        state.set_fault(Fault::None);
        hardware.inactive_controllers = vec!["arm".into()];
        state.set_controllers(&actions, &hardware);
        assert_eq!(reason(), "arm was deactivated");
    }
}
