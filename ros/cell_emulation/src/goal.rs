//! A goal of one of the two motion actions, what it asks for, and how it ends.

use std::time::Duration;

use msgs::control_msgs::{
    FollowJointTrajectory, FollowJointTrajectoryFeedback, FollowJointTrajectoryResult,
};
use msgs::convert::{self, ConvertError};
use msgs::std_msgs::Header;
use msgs::trajectory_msgs::JointTrajectoryPoint;
use msgs::ur_msgs::{
    FollowJointTrajectoryUntil, FollowJointTrajectoryUntilFeedback,
    FollowJointTrajectoryUntilResult,
};
use multiravens::MotionEnd;
use node_kit::{NewGoal, RunningGoal};
use simulated_cell::Step;
use ur5::{JointTrajectory, Joints, WorkCell};

use crate::trajectory::{Failure, follow_trajectory, path_tolerances, until_trajectory};

/// A goal that is being carried out.
pub enum Goal {
    /// Of the trajectory controller.
    Follow(RunningGoal<FollowJointTrajectory>),
    /// Of `trajectory_until_node`.
    Until(RunningGoal<FollowJointTrajectoryUntil>),
}

/// The motion that a goal asks for.
pub struct Motion {
    /// Joint positions over time, within the arm's limits.
    pub trajectory: JointTrajectory,
    /// Whether it ends where the tool touches something.
    pub until_contact: bool,
    /// How far each joint may be from the trajectory; a negative tolerance allows everything.
    pub tolerances_rad: Joints,
}

/// How a goal ends.
pub enum End {
    /// The trajectory's end is reached.
    Reached,
    /// The tool has touched something.
    Contact,
    /// The driver aborts it.
    Failed(Failure),
    /// The client has cancelled it.
    Cancelled,
    /// The driver has ended it, as its controllers do.
    Withdrawn(Failure),
}

impl End {
    /// The driver ends a goal for this reason.
    pub fn withdrawn(reason: &str) -> Self {
        Self::Withdrawn(Failure::goal(reason))
    }

    /// How a step of the cell ends a goal; `None` where the arm is still on its way.
    pub fn of_step(step: Step) -> Option<Self> {
        let code = FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED;
        Some(match step {
            Step::Moving => return None,
            Step::Ended(MotionEnd::Reached) => Self::Reached,
            Step::Ended(MotionEnd::Contact) => Self::Contact,
            Step::Ended(MotionEnd::Lag) => {
                let limit_m = multiravens::MAX_LAG_M;
                let reason = format!("the suction tip was more than {limit_m} m behind the arm");
                Self::Failed(Failure::new(code, reason))
            }
            Step::Deviated(deviation) => Self::Failed(Failure::new(code, deviation.to_string())),
            Step::Failed(reason) => Self::Failed(Failure::goal(reason)),
        })
    }
}

impl Goal {
    /// Accepts a goal of the trajectory controller. A bad trajectory is accepted too, since only a result can carry the reason.
    pub(crate) fn follow(
        goal: NewGoal<FollowJointTrajectory>,
        cell: &WorkCell,
        path_tolerance_rad: f64,
    ) -> (Self, Result<Motion, Failure>) {
        let (goal, running) = goal.accept();
        let names = &cell.joint_names;
        let motion = follow_trajectory(&goal, &cell.arm, names).map(|trajectory| Motion {
            trajectory,
            until_contact: false,
            tolerances_rad: path_tolerances(&goal.path_tolerance, names, path_tolerance_rad),
        });
        (Self::Follow(running), motion)
    }

    /// [`Self::follow`] for `trajectory_until_node`.
    pub(crate) fn until(
        goal: NewGoal<FollowJointTrajectoryUntil>,
        cell: &WorkCell,
        path_tolerance_rad: f64,
    ) -> (Self, Result<Motion, Failure>) {
        let (goal, running) = goal.accept();
        let names = &cell.joint_names;
        let motion = until_trajectory(&goal, &cell.arm, names).map(|trajectory| Motion {
            trajectory,
            until_contact: true,
            tolerances_rad: path_tolerances(&goal.path_tolerance, names, path_tolerance_rad),
        });
        (Self::Until(running), motion)
    }

    /// Whether the client wants it to end.
    pub fn is_cancel_requested(&self) -> bool {
        match self {
            Self::Follow(goal) => goal.is_cancel_requested(),
            Self::Until(goal) => goal.is_cancel_requested(),
        }
    }

    /// Says where the arm is and how fast it moves, `elapsed` after the motion began.
    ///
    /// # Errors
    /// When that time is none of ROS.
    pub fn feedback(
        &self,
        header: Header,
        joint_names: &[String; 6],
        [positions_rad, velocities_rad_s]: [&Joints; 2],
        elapsed: Duration,
    ) -> Result<(), ConvertError> {
        let point = JointTrajectoryPoint {
            positions: positions_rad.iter().copied().collect(),
            velocities: velocities_rad_s.iter().copied().collect(),
            time_from_start: convert::duration_to_msg(elapsed)?,
            ..Default::default()
        };
        let joint_names = joint_names.to_vec();
        // The arm is where it should be.
        let error = JointTrajectoryPoint {
            positions: vec![0.0; point.positions.len()],
            velocities: vec![0.0; point.velocities.len()],
            time_from_start: point.time_from_start,
            ..Default::default()
        };
        match self {
            Self::Follow(goal) => goal.feedback(FollowJointTrajectoryFeedback {
                header,
                joint_names,
                desired: point.clone(),
                actual: point,
                error,
                ..Default::default()
            }),
            Self::Until(goal) => goal.feedback(FollowJointTrajectoryUntilFeedback {
                header,
                joint_names,
                desired: point.clone(),
                actual: point,
                error,
            }),
        }
        Ok(())
    }

    /// Ends it, with the result that the driver's controllers send.
    pub fn end(self, end: End) {
        let withdrawn = matches!(end, End::Withdrawn(_));
        let (cancelled, failure, triggered) = match end {
            End::Reached => (false, None, false),
            End::Contact => (false, None, true),
            End::Failed(failure) | End::Withdrawn(failure) => (false, Some(failure), false),
            End::Cancelled => (true, None, false),
        };
        let failed = failure.is_some() && !withdrawn;
        let cancelled = cancelled || withdrawn;
        let (error_code, error_string) = match failure {
            Some(Failure { code, reason }) => (code, reason),
            None if cancelled => (0, "cancelled".to_owned()),
            None => (0, String::new()),
        };
        match self {
            Self::Follow(goal) => {
                let result = FollowJointTrajectoryResult {
                    error_code,
                    error_string,
                };
                match (cancelled, failed) {
                    (true, _) => goal.cancelled(result),
                    (_, true) => goal.abort(result),
                    _ => goal.succeed(result),
                }
            }
            Self::Until(goal) => {
                let result = FollowJointTrajectoryUntilResult {
                    error_code,
                    until_condition_result: if triggered {
                        FollowJointTrajectoryUntilResult::TRIGGERED
                    } else {
                        FollowJointTrajectoryUntilResult::NOT_TRIGGERED
                    },
                    error_string,
                };
                match (cancelled, failed) {
                    (true, _) => goal.cancelled(result),
                    (_, true) => goal.abort(result),
                    _ => goal.succeed(result),
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_ends_a_goal_with_the_code_of_its_reason() {
        assert!(End::of_step(Step::Moving).is_none());
        let reached = End::of_step(Step::Ended(MotionEnd::Reached));
        assert!(matches!(reached, Some(End::Reached)));
        let contact = End::of_step(Step::Ended(MotionEnd::Contact));
        assert!(matches!(contact, Some(End::Contact)));
        for (step, code, expected) in [
            (Step::Ended(MotionEnd::Lag), -4, "more than 0.02 m behind"),
            (Step::Failed("no motion".into()), -1, "no motion"),
        ] {
            let Some(End::Failed(failure)) = End::of_step(step) else {
                panic!("expected a failure");
            };
            assert_eq!(failure.code, code);
            assert!(failure.reason.contains(expected), "{failure}");
        }
    }
}
