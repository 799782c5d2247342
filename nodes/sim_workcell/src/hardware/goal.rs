//! A goal of one of the two trajectory actions, and how it ends.

use msgs::control_msgs::{
    FollowJointTrajectory, FollowJointTrajectoryFeedback, FollowJointTrajectoryResult,
};
use msgs::std_msgs::Header;
use msgs::trajectory_msgs::JointTrajectoryPoint;
use msgs::ur_msgs::{
    FollowJointTrajectoryUntil, FollowJointTrajectoryUntilFeedback,
    FollowJointTrajectoryUntilResult,
};
use multiravens::MotionEnd;
use node_kit::RunningGoal;

use crate::driver::Failure;

/// A goal that is being carried out.
pub(super) enum Activity {
    Follow(RunningGoal<FollowJointTrajectory>),
    Until(RunningGoal<FollowJointTrajectoryUntil>),
}

/// How a goal ends.
pub(super) enum End {
    Motion(MotionEnd),
    Failed(Failure),
    Cancelled,
    /// The driver has ended it, as its controllers do.
    Withdrawn(Failure),
}

impl Activity {
    pub(super) fn is_cancel_requested(&self) -> bool {
        match self {
            Self::Follow(goal) => goal.is_cancel_requested(),
            Self::Until(goal) => goal.is_cancel_requested(),
        }
    }

    pub(super) fn feedback(
        &self,
        header: Header,
        joint_names: Vec<String>,
        point: JointTrajectoryPoint,
    ) {
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
    }

    pub(super) fn end(self, end: End) {
        let lag = || {
            Failure::new(
                FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED,
                format!(
                    "the suction tip was more than {} m behind the arm",
                    multiravens::MAX_LAG_M
                ),
            )
        };
        let withdrawn = matches!(end, End::Withdrawn(_));
        let (cancelled, failure, triggered) = match end {
            End::Motion(MotionEnd::Reached) => (false, None, false),
            End::Motion(MotionEnd::Contact) => (false, None, true),
            End::Motion(MotionEnd::Lag) => (false, Some(lag()), false),
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

pub(super) fn withdrawn(reason: &str) -> End {
    let code = FollowJointTrajectoryResult::INVALID_GOAL;
    End::Withdrawn(Failure::new(code, reason))
}
