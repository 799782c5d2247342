//! Putting down what is held, for after a fault.

use crate::primitive::ceiling_m;
use crate::robot::rise_of;
use crate::{
    ExecuteError, Phase, PrimitiveError, PrimitiveSettings, Robot, SettingsError, go_home,
};
use nalgebra::Isometry2;
use ur5::{Arm, JointTrajectory};

/// Where something that is held is put down, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PutDown {
    /// Tip pose in the world's xy-plane.
    pub at: Isometry2<f64>,
    /// Height of the tip at which the object is expected to stand (m).
    pub contact_m: f64,
    /// So far above it the tip slows down (m).
    pub slow_from_m: f64,
    /// Speed of the tip from there on (m/s).
    pub slow_m_s: f64,
    /// Contact higher than expected by more is a fault, and so is none down to so far below, where the descent ends (m).
    pub window_m: f64,
    /// Whether the robot senses contact of what it holds. Where it does not, the expected height is taken for it.
    pub senses: bool,
}

impl PutDown {
    /// Checks every range.
    ///
    /// # Errors
    /// The first value outside its range, not-a-number included.
    pub fn check(&self) -> Result<(), SettingsError> {
        for (name, value, low, high) in [
            ("contact_m", self.contact_m, -0.1, 1.0),
            ("slow_from_m", self.slow_from_m, 0.005, 0.2),
            ("slow_m_s", self.slow_m_s, 0.005, 0.5),
            ("window_m", self.window_m, 0.001, 0.1),
        ] {
            if !(low..=high).contains(&value) {
                return Err(SettingsError {
                    name,
                    value,
                    low,
                    high,
                });
            }
        }
        Ok(())
    }
}

/// Lowers what is held, lets it go, and takes the arm home: straight up first, from wherever it stands. The tip turns as it was turned
/// at the pick where `at` is the pose of the tip at the pick: then the object stands as it stood.
///
/// # Errors
/// Returns at once, without another command to the robot; nothing is held, contact came where nothing was expected, or none where it was.
pub fn put_down<R: Robot>(
    robot: &mut R,
    arm: &Arm,
    what: &PutDown,
    settings: &PrimitiveSettings,
) -> Result<(), ExecuteError<R::Error>> {
    settings.check().map_err(PrimitiveError::from)?;
    what.check().map_err(PrimitiveError::from)?;
    let out_of_reach = |reason| PrimitiveError::OutOfReach {
        which: "put-down",
        reason,
    };
    let plan_error = |phase| move |reason| PrimitiveError::Plan { phase, reason };
    let robot_error = |phase| move |error| ExecuteError::Robot { phase, error };
    let wanted_m = settings.clearance_m.max(what.contact_m + what.slow_from_m);
    let above_m = ceiling_m(arm, &what.at, wanted_m).map_err(out_of_reach)?;
    let phase = Phase::CheckGrasp;
    if !robot.holds().map_err(robot_error(phase))? {
        return Err(PrimitiveError::HoldsNothing.into());
    }
    rise_of(robot, arm, settings)?;
    // Through joint space: the arm may have been stopped on its way home.
    let phase = Phase::Transfer;
    let joints = robot.joints().map_err(robot_error(phase))?;
    let above = arm
        .solve(&Arm::tip_down(&what.at, above_m), &arm.ready)
        .map_err(out_of_reach)?;
    let way = JointTrajectory::joint_space_within(arm, &joints, &above, settings.travel_m_s)
        .map_err(plan_error(phase))?;
    if !robot.follow(&way).map_err(robot_error(phase))? {
        return Err(PrimitiveError::Blocked { phase }.into());
    }
    let phase = Phase::DescendToPlace;
    let line = |robot: &mut R, height_m: f64, speed_m_s: f64| {
        let joints = robot.joints().map_err(robot_error(phase))?;
        let to = Arm::tip_down(&what.at, height_m);
        let line = JointTrajectory::line(arm, &joints, &to, speed_m_s, settings.acceleration_m_s2);
        line.map_err(|reason| ExecuteError::from(plan_error(phase)(reason)))
    };
    let slow_m = what.contact_m + what.slow_from_m;
    if above_m > slow_m {
        let descent = line(robot, slow_m, settings.descend_m_s)?;
        if !robot.follow(&descent).map_err(robot_error(phase))? {
            return Err(PrimitiveError::Blocked { phase }.into());
        }
    }
    let end_m = what.contact_m - if what.senses { what.window_m } else { 0.0 };
    let speed_m_s = what.slow_m_s.min(settings.descend_m_s);
    let descent = line(robot, end_m, speed_m_s)?;
    let touched = robot
        .follow_until_contact(&descent)
        .map_err(robot_error(phase))?;
    let joints = robot.joints().map_err(robot_error(phase))?;
    let (height_m, highest_m) = (
        arm.tip(&joints).translation.z,
        what.contact_m + what.window_m,
    );
    if touched && what.senses && height_m > highest_m {
        return Err(PrimitiveError::UnexpectedContact {
            phase,
            height_m,
            highest_m,
        }
        .into());
    }
    if !touched && what.senses {
        return Err(PrimitiveError::MissedContact { phase, height_m }.into());
    }
    let phase = Phase::Release;
    robot.set_suction(false).map_err(robot_error(phase))?;
    go_home(robot, arm, settings)
}
