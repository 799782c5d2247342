//! The robot as the primitive sees it.

use crate::primitive::{Command, Next, Primitive, plan_rise};
use crate::{Outcome, Phase, PickPlace, PrimitiveError, PrimitiveSettings, Report, Touchdown};
use ur5::{Arm, JointTrajectory, Joints};

/// The robot as the UR driver shows it: joint trajectories, move until contact, suction.
pub trait Robot {
    /// Why the robot could not do what it was told (driver fault, protective stop, lost connection).
    type Error;
    /// Present joint positions.
    fn joints(&mut self) -> Result<Joints, Self::Error>;
    /// Follows a trajectory to its end. `false`: stopped half-way by the lag rule.
    fn follow(&mut self, trajectory: &JointTrajectory) -> Result<bool, Self::Error>;
    /// Follows a trajectory until the tool touches something. `false`: no contact up to its end.
    fn follow_until_contact(&mut self, trajectory: &JointTrajectory) -> Result<bool, Self::Error>;
    /// Switches suction.
    fn set_suction(&mut self, on: bool) -> Result<(), Self::Error>;
    /// Whether the vacuum sensor says that something is held.
    fn holds(&mut self) -> Result<bool, Self::Error>;
}

/// Why a primitive broke off. The arm is where it was; suction is as it was, because holding is
/// safer than dropping.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum ExecuteError<E> {
    /// The primitive cannot start or go on.
    #[error(transparent)]
    Primitive(#[from] PrimitiveError),
    /// The robot did not do what it was told.
    #[error("{phase:?}: {error}")]
    Robot { phase: Phase, error: E },
}

/// Carries out one pick and place; `observe` is called with each phase as it begins.
///
/// # Errors
/// Returns at once, without another command to the robot.
pub fn execute<R: Robot>(
    robot: &mut R,
    arm: &Arm,
    action: &PickPlace,
    settings: &PrimitiveSettings,
    observe: impl FnMut(Phase),
) -> Result<Outcome, ExecuteError<R::Error>> {
    execute_on(robot, arm, action, settings, None, observe)
}

/// The same; with a `touchdown` the heights of the surfaces are known, and the tip comes down slowly at the end.
///
/// # Errors
/// Returns at once, without another command to the robot.
pub fn execute_on<R: Robot>(
    robot: &mut R,
    arm: &Arm,
    action: &PickPlace,
    settings: &PrimitiveSettings,
    touchdown: Option<&Touchdown>,
    mut observe: impl FnMut(Phase),
) -> Result<Outcome, ExecuteError<R::Error>> {
    let mut phase = Phase::Approach;
    let joints = robot
        .joints()
        .map_err(|error| ExecuteError::Robot { phase, error })?;
    let mut primitive = Primitive::new(arm, action, settings, &joints)?;
    if let Some(touchdown) = touchdown {
        primitive = primitive.with_touchdown(touchdown)?;
    }
    observe(phase);
    let mut command = primitive.start();
    loop {
        let report =
            carry_out(robot, &command).map_err(|error| ExecuteError::Robot { phase, error })?;
        match primitive.next(report)? {
            Next::Do(next) => command = next,
            Next::Done(outcome) => return Ok(outcome),
        }
        if primitive.phase() != phase {
            phase = primitive.phase();
            observe(phase);
        }
    }
}

/// Takes the arm home from wherever it stands, straight up first, and leaves suction as it is: the
/// way back after a fault, once a person has allowed it.
///
/// # Errors
/// Returns at once, without another command to the robot.
pub fn go_home<R: Robot>(
    robot: &mut R,
    arm: &Arm,
    settings: &PrimitiveSettings,
) -> Result<(), ExecuteError<R::Error>> {
    settings.check().map_err(PrimitiveError::from)?;
    let plan_error = |phase| move |reason| PrimitiveError::Plan { phase, reason };
    let robot_error = |phase| move |error| ExecuteError::Robot { phase, error };
    rise_of(robot, arm, settings)?;
    let phase = Phase::Home;
    let joints = robot.joints().map_err(robot_error(phase))?;
    let way = JointTrajectory::joint_space_within(arm, &joints, &arm.home, settings.travel_m_s)
        .map_err(plan_error(phase))?;
    if !robot.follow(&way).map_err(robot_error(phase))? {
        return Err(PrimitiveError::Blocked { phase }.into());
    }
    // At home is an arm that rests there.
    robot.joints().map_err(robot_error(phase))?;
    Ok(())
}

/// Straight up to the clearance, from wherever the arm stands.
pub(crate) fn rise_of<R: Robot>(
    robot: &mut R,
    arm: &Arm,
    settings: &PrimitiveSettings,
) -> Result<(), ExecuteError<R::Error>> {
    let phase = Phase::Retreat;
    let joints = robot
        .joints()
        .map_err(|error| ExecuteError::Robot { phase, error })?;
    let rise = plan_rise(arm, settings, &joints)
        .map_err(|reason| PrimitiveError::Plan { phase, reason })?;
    if let Some(rise) = rise {
        let followed = robot.follow(&rise);
        if !followed.map_err(|error| ExecuteError::Robot { phase, error })? {
            return Err(PrimitiveError::Blocked { phase }.into());
        }
    }
    Ok(())
}

/// Has a robot carry out one command of a primitive, and says what the primitive hears of it.
///
/// # Errors
/// The robot did not do what it was told.
pub fn carry_out<R: Robot>(robot: &mut R, command: &Command) -> Result<Report, R::Error> {
    Ok(match command {
        Command::Follow(trajectory) => match robot.follow(trajectory)? {
            true => Report::Arrived(robot.joints()?),
            false => Report::Lagged(robot.joints()?),
        },
        Command::FollowUntilContact(trajectory) => match robot.follow_until_contact(trajectory)? {
            true => Report::Contact(robot.joints()?),
            false => Report::NoContact(robot.joints()?),
        },
        Command::SetSuction(on) => {
            robot.set_suction(*on)?;
            Report::SuctionSet
        }
        Command::ReadVacuum => Report::Holds(robot.holds()?),
    })
}
