//! Trajectories of goals, checked as the driver's controllers check them.

use msgs::control_msgs::{FollowJointTrajectoryGoal, FollowJointTrajectoryResult, JointTolerance};
use msgs::convert::{ConvertError, joint_trajectory_from_msg};
use msgs::trajectory_msgs;
use msgs::ur_msgs::FollowJointTrajectoryUntilGoal;
use ur5::{Arm, JointTrajectory, Joints};

/// Why a goal fails: an error code of `FollowJointTrajectory`, and the reason for people.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{reason} (error code {code})")]
pub struct Failure {
    /// An error code of `FollowJointTrajectory`.
    pub code: i32,
    /// The reason.
    pub reason: String,
}

impl Failure {
    /// With an error code of `FollowJointTrajectory`.
    pub fn new(code: i32, reason: impl Into<String>) -> Self {
        Self {
            code,
            reason: reason.into(),
        }
    }

    /// With the code of a goal that makes no sense.
    pub fn goal(reason: impl Into<String>) -> Self {
        Self::new(FollowJointTrajectoryResult::INVALID_GOAL, reason)
    }
}

/// What the tolerances of a goal mean: 0 keeps the controller's, a negative one allows everything (rad).
pub(crate) fn path_tolerances(
    tolerances: &[JointTolerance],
    joint_names: &[String; 6],
    default_rad: f64,
) -> Joints {
    let mut all = Joints::repeat(default_rad);
    for (index, name) in joint_names.iter().enumerate() {
        let asked = tolerances.iter().find(|tolerance| tolerance.name == *name);
        if let Some(tolerance) = asked.filter(|tolerance| tolerance.position != 0.0) {
            all[index] = tolerance.position;
        }
    }
    all
}

/// The trajectory of a goal of `FollowJointTrajectory`.
pub(crate) fn follow_trajectory(
    goal: &FollowJointTrajectoryGoal,
    arm: &Arm,
    joint_names: &[String; 6],
) -> Result<JointTrajectory, Failure> {
    let multi_dof = &goal.multi_dof_trajectory;
    if !(multi_dof.points.is_empty() && multi_dof.joint_names.is_empty()) {
        return Err(Failure::goal(
            "multi_dof_trajectory is not empty: the arm has no such joints",
        ));
    }
    if !(goal.component_path_tolerance.is_empty() && goal.component_goal_tolerance.is_empty()) {
        return Err(Failure::goal(
            "component tolerances are not empty: the arm has no such joints",
        ));
    }
    check_tolerances("path_tolerance", &goal.path_tolerance, joint_names)?;
    check_tolerances("goal_tolerance", &goal.goal_tolerance, joint_names)?;
    trajectory(&goal.trajectory, arm, joint_names)
}

/// The trajectory of a goal of `FollowJointTrajectoryUntil`.
pub(crate) fn until_trajectory(
    goal: &FollowJointTrajectoryUntilGoal,
    arm: &Arm,
    joint_names: &[String; 6],
) -> Result<JointTrajectory, Failure> {
    if goal.until_type != FollowJointTrajectoryUntilGoal::TOOL_CONTACT {
        return Err(Failure::goal(format!(
            "until_type is {}, expected TOOL_CONTACT ({})",
            goal.until_type,
            FollowJointTrajectoryUntilGoal::TOOL_CONTACT
        )));
    }
    check_tolerances("path_tolerance", &goal.path_tolerance, joint_names)?;
    check_tolerances("goal_tolerance", &goal.goal_tolerance, joint_names)?;
    trajectory(&goal.trajectory, arm, joint_names)
}

fn trajectory(
    message: &trajectory_msgs::JointTrajectory,
    arm: &Arm,
    joint_names: &[String; 6],
) -> Result<JointTrajectory, Failure> {
    let stamp = &message.header.stamp;
    if (stamp.sec, stamp.nanosec) != (0, 0) {
        return Err(Failure::new(
            FollowJointTrajectoryResult::OLD_HEADER_TIMESTAMP,
            format!(
                "trajectory.header.stamp is {}.{:09} s, expected 0: start at once",
                stamp.sec, stamp.nanosec
            ),
        ));
    }
    let trajectory = joint_trajectory_from_msg(message, joint_names).map_err(|error| {
        let code = match error {
            ConvertError::Unexpected {
                field: "joint_names",
                ..
            } => FollowJointTrajectoryResult::INVALID_JOINTS,
            _ => FollowJointTrajectoryResult::INVALID_GOAL,
        };
        Failure::new(code, format!("trajectory.{error}"))
    })?;
    trajectory
        .check_limits(arm)
        .map_err(|error| Failure::goal(error.to_string()))?;
    Ok(trajectory)
}

/// Tolerances must make sense, whether or not the arm follows exactly.
fn check_tolerances(
    field: &str,
    tolerances: &[JointTolerance],
    joint_names: &[String; 6],
) -> Result<(), Failure> {
    for (index, tolerance) in tolerances.iter().enumerate() {
        if !joint_names.contains(&tolerance.name) {
            return Err(Failure::new(
                FollowJointTrajectoryResult::INVALID_JOINTS,
                format!(
                    "{field}[{index}].name is {:?}, expected one of {joint_names:?}",
                    tolerance.name
                ),
            ));
        }
        for (name, value) in [
            ("position", tolerance.position),
            ("velocity", tolerance.velocity),
            ("acceleration", tolerance.acceleration),
        ] {
            // As in control_msgs: -1 removes the tolerance, 0 keeps the controller's.
            if !(value.is_finite() && (value >= 0.0 || value == -1.0)) {
                return Err(Failure::goal(format!(
                    "{field}[{index}].{name} is {value}, expected 0 or more, or -1"
                )));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use msgs::convert::joint_trajectory_to_msg;
    use std::time::Duration;
    use ur5::{Joints, TrajectoryPoint, WorkCell};

    /// Turns the base by a tenth of a rad in a second, from home.
    pub(crate) fn turn(cell: &WorkCell) -> FollowJointTrajectoryGoal {
        let mut end = cell.arm.home;
        end[0] += 0.1;
        let point = |time, positions_rad| TrajectoryPoint {
            time,
            positions_rad,
            velocities_rad_s: Joints::zeros(),
        };
        let points = vec![
            point(Duration::ZERO, cell.arm.home),
            point(Duration::from_secs(1), end),
        ];
        let trajectory = JointTrajectory::new(points).unwrap();
        FollowJointTrajectoryGoal {
            trajectory: joint_trajectory_to_msg(&trajectory, &cell.joint_names).unwrap(),
            ..Default::default()
        }
    }

    #[test]
    fn a_goal_that_is_none_is_refused_with_its_field_and_code() {
        let cell = WorkCell::builtin().unwrap();
        let good = turn(&cell);
        assert!(follow_trajectory(&good, &cell.arm, &cell.joint_names).is_ok());
        type Spoil = fn(&mut FollowJointTrajectoryGoal);
        let cases: [(Spoil, i32, &str); 9] = [
            (|g| g.trajectory.joint_names.swap(0, 1), -2, "joint_names"),
            (|g| g.trajectory.joint_names.truncate(5), -2, "joint_names"),
            (|g| g.trajectory.points.clear(), -1, "points"),
            (
                |g| g.trajectory.points[1].positions[2] = f64::NAN,
                -1,
                "positions",
            ),
            (
                |g| g.trajectory.points[1].positions[0] = 100.0,
                -1,
                "joint 0",
            ),
            (
                |g| g.trajectory.points[1].time_from_start.sec = -1,
                -1,
                "duration",
            ),
            (|g| g.trajectory.points.swap(0, 1), -1, "time after"),
            (|g| g.trajectory.header.stamp.sec = 7, -3, "header.stamp"),
            (
                |g| g.multi_dof_trajectory.joint_names.push("tail".into()),
                -1,
                "multi_dof",
            ),
        ];
        for (spoil, code, expected) in cases {
            let mut goal = good.clone();
            spoil(&mut goal);
            let failure = follow_trajectory(&goal, &cell.arm, &cell.joint_names).unwrap_err();
            assert_eq!(failure.code, code, "{failure}");
            assert!(failure.reason.contains(expected), "{failure}");
        }
    }

    #[test]
    fn tolerances_of_other_joints_or_without_sense_are_refused() {
        let cell = WorkCell::builtin().unwrap();
        let tolerance = |name: &str, position| JointTolerance {
            name: name.into(),
            position,
            ..Default::default()
        };
        for (bad, code) in [
            (tolerance("tail", 0.1), -2),
            (tolerance(&cell.joint_names[3], f64::NAN), -1),
        ] {
            let mut goal = turn(&cell);
            goal.path_tolerance = vec![tolerance(&cell.joint_names[0], -1.0), bad];
            let failure = follow_trajectory(&goal, &cell.arm, &cell.joint_names).unwrap_err();
            assert_eq!(failure.code, code);
            assert!(failure.reason.contains("path_tolerance[1]"), "{failure}");
        }
    }

    #[test]
    fn a_tolerance_of_zero_is_the_controllers_and_a_negative_one_allows_everything() {
        let names = ["a", "b", "c", "d", "e", "f"].map(String::from);
        let tolerance = |name: &str, position| JointTolerance {
            name: name.into(),
            position,
            ..Default::default()
        };
        let asked = [
            tolerance("c", 0.05),
            tolerance("a", -1.0),
            tolerance("f", 0.0),
        ];
        assert_eq!(
            path_tolerances(&asked, &names, 0.2),
            Joints::new(-1.0, 0.2, 0.05, 0.2, 0.2, 0.2)
        );
    }

    #[test]
    fn only_contact_is_a_condition() {
        let cell = WorkCell::builtin().unwrap();
        let mut goal = FollowJointTrajectoryUntilGoal {
            trajectory: turn(&cell).trajectory,
            ..Default::default()
        };
        assert!(until_trajectory(&goal, &cell.arm, &cell.joint_names).is_ok());
        goal.until_type = 9;
        let failure = until_trajectory(&goal, &cell.arm, &cell.joint_names).unwrap_err();
        assert!(failure.reason.contains("until_type is 9"), "{failure}");
    }
}
