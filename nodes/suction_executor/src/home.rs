//! The way home after a stop or a fault.

use pick_place::{ExecuteError, Phase, PrimitiveError, Robot};
use ur5::{Arm, JointTrajectory, Joints, PlanError};

/// The tip rises this high first, or as high as it can.
const CLEARANCE_M: [f64; 3] = [0.24, 0.16, 0.08];
/// Slow: something may be held, or in the way.
const SPEED_M_S: f64 = 0.25;
const ACCELERATION_M_S2: f64 = 0.5;

/// Straight up, then home; suction stays as it is.
pub(crate) fn go_home<R: Robot>(robot: &mut R, arm: &Arm) -> Result<(), ExecuteError<R::Error>> {
    let joints = read(robot)?;
    if let Some(rise) = rise(arm, &joints).map_err(plan_error)? {
        follow(robot, &rise)?;
    }
    let joints = read(robot)?;
    let home = JointTrajectory::joint_space_within(arm, &joints, &arm.home, SPEED_M_S)
        .map_err(plan_error)?;
    follow(robot, &home)?;
    read(robot).map(|_| ())
}

/// None where the tip is high enough.
fn rise(arm: &Arm, joints: &Joints) -> Result<Option<JointTrajectory>, PlanError> {
    let tip = arm.tip(joints);
    let mut planned = Ok(None);
    for height_m in CLEARANCE_M {
        if tip.translation.z >= height_m {
            return Ok(None);
        }
        let mut to = tip;
        to.translation.z = height_m;
        planned = JointTrajectory::line(arm, joints, &to, SPEED_M_S, ACCELERATION_M_S2).map(Some);
        if planned.is_ok() {
            break;
        }
    }
    planned
}

fn plan_error<E>(reason: PlanError) -> ExecuteError<E> {
    ExecuteError::Primitive(PrimitiveError::Plan {
        phase: Phase::Home,
        reason,
    })
}

fn read<R: Robot>(robot: &mut R) -> Result<Joints, ExecuteError<R::Error>> {
    robot.joints().map_err(|error| ExecuteError::Robot {
        phase: Phase::Home,
        error,
    })
}

fn follow<R: Robot>(
    robot: &mut R,
    trajectory: &JointTrajectory,
) -> Result<(), ExecuteError<R::Error>> {
    match robot.follow(trajectory) {
        Ok(true) => Ok(()),
        Ok(false) => Err(ExecuteError::Primitive(PrimitiveError::Blocked {
            phase: Phase::Home,
        })),
        Err(error) => Err(ExecuteError::Robot {
            phase: Phase::Home,
            error,
        }),
    }
}
