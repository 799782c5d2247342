//! The primitive as a state machine: reports in, commands out, no robot inside.

use crate::{PrimitiveSettings, SettingsError, Touchdown};
use nalgebra::{Isometry2, Isometry3};
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_PI_2, PI};
use ur5::{Arm, JointTrajectory, Joints, PlanError, Unreachable};

/// An action: where the end effector grasps and where it releases, in the world's xy-plane
/// (paper, section III-A).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PickPlace {
    /// Pose at which to grasp.
    pub pick: Isometry2<f64>,
    /// Pose at which to release.
    pub place: Isometry2<f64>,
}

/// Where the primitive stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum Phase {
    Approach,
    DescendToPick,
    Grasp,
    Lift,
    CheckGrasp,
    Transfer,
    DescendToPlace,
    Release,
    Retreat,
    Home,
}

/// How a primitive ended, the arm being back home.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Outcome {
    /// Something was picked and released at the place pose.
    Placed,
    /// The descent met nothing to pick.
    NoContact,
    /// Suction held nothing.
    GraspFailed,
    /// The object was lost between grasp and release.
    Dropped,
    /// The tip lagged too far behind (over-pulling a cable): stopped and released.
    LagAborted,
}

/// What the robot shall do next.
#[derive(Clone, Debug, PartialEq)]
pub enum Command {
    /// Follow to the end. Answered by [`Report::Arrived`] or [`Report::Lagged`].
    Follow(JointTrajectory),
    /// Follow until the tool touches something. Answered by [`Report::Contact`] or
    /// [`Report::NoContact`].
    FollowUntilContact(JointTrajectory),
    /// Switch suction. Answered by [`Report::SuctionSet`].
    SetSuction(bool),
    /// Read the vacuum sensor. Answered by [`Report::Holds`].
    ReadVacuum,
}

/// What the robot did; joint positions are those where it came to rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Report {
    /// The trajectory ended.
    Arrived(Joints),
    /// The lag rule stopped the motion half-way.
    Lagged(Joints),
    /// The tool touched something and the motion stopped.
    Contact(Joints),
    /// The trajectory ended without contact.
    NoContact(Joints),
    /// Suction is switched.
    SuctionSet,
    /// Whether something is held.
    Holds(bool),
}

/// What comes after a report.
#[derive(Clone, Debug, PartialEq)]
pub enum Next {
    /// Go on with this.
    Do(Command),
    /// The primitive has ended, the arm is home.
    Done(Outcome),
}

/// Why a primitive cannot start or go on. Nothing must move after one.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum PrimitiveError {
    /// A setting is out of range.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A pose has a coordinate that is not finite.
    #[error("the {which} pose is not finite")]
    NotFinite { which: &'static str },
    /// A pose that the arm cannot work at.
    #[error("the {which} pose is out of reach: {reason}")]
    OutOfReach {
        which: &'static str,
        reason: Unreachable,
    },
    /// A motion cannot be planned.
    #[error("{phase:?}: {reason}")]
    Plan { phase: Phase, reason: PlanError },
    /// Suction already holds something.
    #[error("the gripper already holds something, expected it to be empty")]
    AlreadyHolding,
    /// There is nothing to put down.
    #[error("the gripper holds nothing, expected something to put down")]
    HoldsNothing,
    /// The arm lagged behind with nothing held: something is in its way.
    #[error("{phase:?}: the arm lags behind although it holds nothing, something is in its way")]
    Blocked { phase: Phase },
    /// The tip met something where nothing was seen.
    #[error(
        "{phase:?}: contact at a height of {height_m:.4} m, expected at most {highest_m:.4} m: something is in the way"
    )]
    UnexpectedContact {
        phase: Phase,
        height_m: f64,
        highest_m: f64,
    },
    /// What is held met nothing where contact was expected.
    #[error(
        "{phase:?}: no contact down to a height of {height_m:.4} m, which ends the window in which it is expected: what is held stays held"
    )]
    MissedContact { phase: Phase, height_m: f64 },
    /// A report that does not answer the last command.
    #[error("{phase:?}: {report:?} does not answer the last command")]
    UnexpectedReport { phase: Phase, report: Report },
}

/// A descent ends here when it meets nothing: a little below the table's top.
const LOWEST_M: f64 = -0.01;
/// The arm must be able to rise to this height over a pose to work there.
const LEAST_RISE_M: f64 = 0.05;
/// The arm counts as home within this distance of each joint.
const AT_HOME_RAD: f64 = 1e-2;
/// The arm keeps this far below its highest point over a pose, where it would be stretched out.
const STRETCH_MARGIN_M: f64 = 0.005;

/// One pick and place. Ask [`Self::start`] once, then [`Self::next`] with each report.
///
/// Approach and way home are straight in joint space, everything between is straight lines of the
/// tip, which points down all the time. Over the far corners of the workspace the arm cannot rise
/// to the clearance: there it works as high as it can.
#[derive(Clone, Debug)]
pub struct Primitive<'a> {
    arm: &'a Arm,
    /// Where to grasp and release, with the yaw of the tip there.
    pick: Isometry2<f64>,
    place: Isometry2<f64>,
    settings: PrimitiveSettings,
    /// Highest that the arm shall go over pick and place.
    ceiling_m: (f64, f64),
    phase: Phase,
    /// Whether the approach's last motion, the one to above the pick, has begun.
    approaching: bool,
    /// Where the arm is, as last reported.
    joints: Joints,
    /// Height of the transfer, known since the contact.
    carry_m: f64,
    /// Height of the tip at the contact with the object.
    contact_m: f64,
    /// How the tip comes down, where the surfaces are known.
    touchdown: Option<Touchdown>,
    descent: Descent,
    outcome: Outcome,
}

/// Where a descent in several parts stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Descent {
    /// Fast, to above the surface.
    Fast,
    /// Slowly, until contact.
    Slow,
    /// Down by a little more, to press the cup on.
    Press,
}

impl PickPlace {
    /// x (m), y (m), yaw (rad) of the pick, then of the place.
    ///
    /// ```
    /// let action = pick_place::PickPlace::from_array([0.3, 0.1, 0.0, 0.5, -0.2, 1.5]);
    /// assert_eq!(action.to_array()[3..], [0.5, -0.2, 1.5]);
    /// ```
    pub fn to_array(&self) -> [f64; 6] {
        let pose = |pose: &Isometry2<f64>| {
            let position = pose.translation.vector;
            [position.x, position.y, pose.rotation.angle()]
        };
        let ([a, b, c], [d, e, f]) = (pose(&self.pick), pose(&self.place));
        [a, b, c, d, e, f]
    }

    /// The action of [`PickPlace::to_array`].
    pub fn from_array([x, y, yaw, to_x, to_y, to_yaw]: [f64; 6]) -> Self {
        Self {
            pick: Isometry2::new([x, y].into(), yaw),
            place: Isometry2::new([to_x, to_y].into(), to_yaw),
        }
    }

    /// Poses of the tip at pick and place. The cup is round: only the turn from pick to place counts. Half of it before and half after keeps
    /// wrist 3 away from its limits.
    pub fn tips(&self) -> (Isometry2<f64>, Isometry2<f64>) {
        let mut half_turn = 0.5 * self.pick.rotation.angle_to(&self.place.rotation);
        // A full half-circle may go either way. Begun from this side, both are within the limits.
        if half_turn < -FRAC_PI_2 + 1e-6 {
            half_turn += PI;
        }
        let turned =
            |pose: &Isometry2<f64>, yaw_rad| Isometry2::new(pose.translation.vector, yaw_rad);
        (
            turned(&self.pick, -half_turn),
            turned(&self.place, half_turn),
        )
    }
}

impl<'a> Primitive<'a> {
    /// Checks settings and reach before anything moves. `joints` is where the arm is.
    ///
    /// # Errors
    /// When a setting or pose cannot be worked with.
    pub fn new(
        arm: &'a Arm,
        action: &PickPlace,
        settings: &PrimitiveSettings,
        joints: &Joints,
    ) -> Result<Self, PrimitiveError> {
        settings.check()?;
        let ceiling = |which, pose: &Isometry2<f64>, wanted_m: f64| {
            let values = [
                pose.translation.x,
                pose.translation.y,
                pose.rotation.re,
                pose.rotation.im,
            ];
            if !values.iter().all(|value| value.is_finite()) {
                return Err(PrimitiveError::NotFinite { which });
            }
            ceiling_m(arm, pose, wanted_m)
                .map_err(|reason| PrimitiveError::OutOfReach { which, reason })
        };
        // The object may stand on others: as high as lift and clearance together could ask for.
        let wanted_m = settings.clearance_m + settings.lift_m;
        let ceilings_m = (
            ceiling("pick", &action.pick, wanted_m)?,
            ceiling("place", &action.place, wanted_m)?,
        );
        let (pick, place) = action.tips();
        Ok(Self {
            arm,
            pick,
            place,
            settings: *settings,
            ceiling_m: ceilings_m,
            phase: Phase::Approach,
            approaching: false,
            joints: *joints,
            carry_m: settings.lift_m,
            contact_m: 0.0,
            touchdown: None,
            descent: Descent::Slow,
            outcome: Outcome::Placed,
        })
    }

    /// Comes down on surfaces whose heights are known: fast, then slowly, and only contact near the surface is taken for it.
    ///
    /// # Errors
    /// When one of the heights, speeds or distances is out of range.
    pub fn with_touchdown(mut self, touchdown: &Touchdown) -> Result<Self, PrimitiveError> {
        touchdown.check()?;
        self.touchdown = Some(*touchdown);
        Ok(self)
    }

    /// Where the primitive stands.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// The first command.
    pub fn start(&self) -> Command {
        Command::ReadVacuum
    }

    /// The command after a report.
    ///
    /// # Errors
    /// When the primitive cannot go on; nothing must move then.
    pub fn next(&mut self, report: Report) -> Result<Next, PrimitiveError> {
        if let Report::Arrived(joints)
        | Report::Lagged(joints)
        | Report::Contact(joints)
        | Report::NoContact(joints) = report
        {
            self.joints = joints;
        }
        let command = match (self.phase, report) {
            (Phase::Approach, Report::Holds(true)) => return Err(PrimitiveError::AlreadyHolding),
            (Phase::Approach, Report::Holds(false)) => match self.rise()? {
                Some(rise) => rise,
                None => self.approach()?,
            },
            (Phase::Approach, Report::Arrived(_)) if !self.approaching => self.approach()?,
            (Phase::Approach, Report::Arrived(_)) => {
                self.phase = Phase::DescendToPick;
                self.begin_descent()?
            }
            (Phase::DescendToPick | Phase::DescendToPlace, Report::Arrived(_))
                if self.descent == Descent::Fast =>
            {
                self.descend_slowly()?
            }
            (Phase::DescendToPick, Report::Contact(_)) => {
                self.check_contact()?;
                self.contact_m = self.height_m();
                match self.press()? {
                    Some(press) => press,
                    None => self.grasp(),
                }
            }
            (Phase::DescendToPick, Report::Arrived(_)) if self.descent == Descent::Press => {
                self.grasp()
            }
            (Phase::DescendToPick, Report::NoContact(_)) => {
                self.outcome = Outcome::NoContact;
                self.retreat()?
            }
            (Phase::Grasp, Report::SuctionSet) => {
                self.phase = Phase::Lift;
                self.carry_m = self.contact_m + self.settings.lift_m;
                let height_m = self.carry_m.min(self.ceiling_m.0);
                self.line(
                    &Arm::tip_down(&self.pick, height_m),
                    self.settings.carry_m_s,
                )?
            }
            (Phase::Lift, Report::Arrived(_)) => {
                self.phase = Phase::CheckGrasp;
                Command::ReadVacuum
            }
            (Phase::CheckGrasp, Report::Holds(true)) => {
                self.phase = Phase::Transfer;
                let height_m = self.carry_m.min(self.ceiling_m.1);
                self.line(
                    &Arm::tip_down(&self.place, height_m),
                    self.settings.carry_m_s,
                )?
            }
            (Phase::CheckGrasp, Report::Holds(false)) => self.give_up(Outcome::GraspFailed),
            (Phase::Transfer, Report::Arrived(_)) => Command::ReadVacuum,
            (Phase::Transfer, Report::Holds(true)) => {
                self.phase = Phase::DescendToPlace;
                self.begin_descent()?
            }
            (Phase::DescendToPlace, Report::Contact(_)) => {
                self.check_contact()?;
                self.phase = Phase::Release;
                Command::ReadVacuum
            }
            (Phase::DescendToPlace, Report::NoContact(_)) => {
                if self.window().is_none() {
                    self.phase = Phase::Release;
                }
                Command::ReadVacuum
            }
            // Down to the end of the window, and still in the air: it would fall.
            (Phase::DescendToPlace, Report::Holds(true)) => {
                return Err(PrimitiveError::MissedContact {
                    phase: self.phase,
                    height_m: self.height_m(),
                });
            }
            (Phase::Transfer | Phase::DescendToPlace | Phase::Release, Report::Holds(false)) => {
                self.give_up(Outcome::Dropped)
            }
            (Phase::Release, Report::Holds(true)) => Command::SetSuction(false),
            (Phase::Release, Report::SuctionSet) => self.retreat()?,
            (Phase::Retreat, Report::Arrived(_)) => self.go_home()?,
            (Phase::Home, Report::Arrived(_)) => return Ok(Next::Done(self.outcome)),
            (Phase::Approach | Phase::Lift | Phase::Transfer, Report::Lagged(_)) => {
                self.give_up(Outcome::LagAborted)
            }
            (
                phase @ (Phase::DescendToPick
                | Phase::DescendToPlace
                | Phase::Retreat
                | Phase::Home),
                Report::Lagged(_),
            ) => {
                return Err(PrimitiveError::Blocked { phase });
            }
            (phase, report) => return Err(PrimitiveError::UnexpectedReport { phase, report }),
        };
        Ok(Next::Do(command))
    }

    /// Lets go and heads home.
    fn give_up(&mut self, outcome: Outcome) -> Command {
        self.outcome = outcome;
        self.phase = Phase::Release;
        Command::SetSuction(false)
    }

    /// Tip pose from which to descend to the pick.
    fn over_pick(&self) -> Isometry3<f64> {
        Arm::tip_down(&self.pick, self.settings.clearance_m.min(self.ceiling_m.0))
    }

    /// Straight through joint space to above the pick.
    fn approach(&mut self) -> Result<Command, PrimitiveError> {
        self.approaching = true;
        let above = self
            .arm
            .solve(&self.over_pick(), &self.arm.ready)
            .map_err(|reason| self.plan_error(reason.into()))?;
        self.joint_space(&above)
    }

    /// Height of the tip where the arm is.
    fn height_m(&self) -> f64 {
        self.arm.tip(&self.joints).translation.z
    }

    /// Where the descent under way leads to.
    fn below(&self) -> &Isometry2<f64> {
        match self.phase {
            Phase::DescendToPlace => &self.place,
            _ => &self.pick,
        }
    }

    /// Whether the robot senses the contact of the descent under way.
    fn senses(&self, touchdown: &Touchdown) -> bool {
        match self.phase {
            Phase::DescendToPlace => touchdown.senses_place,
            _ => touchdown.senses_pick,
        }
    }

    /// Height of the tip at which contact is expected, at most.
    fn expected_m(&self, touchdown: &Touchdown) -> f64 {
        match self.phase {
            // The object is as high as it stood over what is lowest beside it.
            Phase::DescendToPlace => {
                touchdown.place_m + (self.contact_m - touchdown.pick_ground_m).max(0.0)
            }
            _ => touchdown.pick_m,
        }
    }

    /// Down to where the surface is near, where it is known; else straight to contact.
    fn begin_descent(&mut self) -> Result<Command, PrimitiveError> {
        let Some(touchdown) = self.touchdown else {
            self.descent = Descent::Slow;
            let to = Arm::tip_down(self.below(), LOWEST_M);
            return self
                .plan_line(&to, self.settings.descend_m_s)
                .map(Command::FollowUntilContact);
        };
        let slow_m = self.expected_m(&touchdown) + touchdown.slow_from_m;
        if self.height_m() <= slow_m {
            return self.descend_slowly();
        }
        self.descent = Descent::Fast;
        self.line(
            &Arm::tip_down(self.below(), slow_m),
            self.settings.descend_m_s,
        )
    }

    fn descend_slowly(&mut self) -> Result<Command, PrimitiveError> {
        self.descent = Descent::Slow;
        let Some(touchdown) = self.touchdown else {
            return self.begin_descent();
        };
        let end_m = match (self.phase, self.senses(&touchdown)) {
            // An object may be lower than it seemed.
            (Phase::DescendToPlace, true) => touchdown.place_m - touchdown.window_m,
            (Phase::DescendToPlace, false) => self.expected_m(&touchdown),
            (_, true) => touchdown.pick_m - touchdown.window_m,
            (_, false) => touchdown.pick_m - touchdown.press_m,
        };
        let end_m = end_m.max(LOWEST_M).min(self.height_m());
        let speed_m_s = touchdown.slow_m_s.min(self.settings.descend_m_s);
        self.plan_line(&Arm::tip_down(self.below(), end_m), speed_m_s)
            .map(Command::FollowUntilContact)
    }

    /// Where the contact of the descent under way is expected, and sensed.
    fn window(&self) -> Option<Touchdown> {
        self.touchdown.filter(|touchdown| self.senses(touchdown))
    }

    /// Refuses contact above the surface that was seen.
    fn check_contact(&self) -> Result<(), PrimitiveError> {
        let Some(touchdown) = self.window() else {
            return Ok(());
        };
        let (height_m, highest_m) = (
            self.height_m(),
            self.expected_m(&touchdown) + touchdown.window_m,
        );
        if height_m > highest_m {
            return Err(PrimitiveError::UnexpectedContact {
                phase: self.phase,
                height_m,
                highest_m,
            });
        }
        Ok(())
    }

    /// Presses the cup on the object, where that is asked for.
    fn press(&mut self) -> Result<Option<Command>, PrimitiveError> {
        let Some(touchdown) = self
            .touchdown
            .filter(|touchdown| touchdown.senses_pick && touchdown.press_m > 0.0)
        else {
            return Ok(None);
        };
        self.descent = Descent::Press;
        let end_m = self.contact_m - touchdown.press_m;
        self.line(&Arm::tip_down(&self.pick, end_m), touchdown.slow_m_s)
            .map(Some)
    }

    fn grasp(&mut self) -> Command {
        self.phase = Phase::Grasp;
        Command::SetSuction(true)
    }

    fn retreat(&mut self) -> Result<Command, PrimitiveError> {
        self.phase = Phase::Retreat;
        match self.rise()? {
            Some(rise) => Ok(rise),
            None => self.go_home(),
        }
    }

    fn go_home(&mut self) -> Result<Command, PrimitiveError> {
        self.phase = Phase::Home;
        self.joint_space(&self.arm.home)
    }

    fn rise(&self) -> Result<Option<Command>, PrimitiveError> {
        plan_rise(self.arm, &self.settings, &self.joints)
            .map(|rise| rise.map(Command::Follow))
            .map_err(|reason| self.plan_error(reason))
    }

    fn line(&self, to: &Isometry3<f64>, speed_m_s: f64) -> Result<Command, PrimitiveError> {
        self.plan_line(to, speed_m_s).map(Command::Follow)
    }

    fn plan_line(
        &self,
        to: &Isometry3<f64>,
        speed_m_s: f64,
    ) -> Result<JointTrajectory, PrimitiveError> {
        JointTrajectory::line(
            self.arm,
            &self.joints,
            to,
            speed_m_s,
            self.settings.acceleration_m_s2,
        )
        .map_err(|reason| self.plan_error(reason))
    }

    fn joint_space(&self, to: &Joints) -> Result<Command, PrimitiveError> {
        JointTrajectory::joint_space_within(self.arm, &self.joints, to, self.settings.travel_m_s)
            .map(Command::Follow)
            .map_err(|reason| self.plan_error(reason))
    }

    fn plan_error(&self, reason: PlanError) -> PrimitiveError {
        PrimitiveError::Plan {
            phase: self.phase,
            reason,
        }
    }
}

/// The highest that the tip can go over a pose, at most `wanted_m`.
pub(crate) fn ceiling_m(
    arm: &Arm,
    pose: &Isometry2<f64>,
    wanted_m: f64,
) -> Result<f64, Unreachable> {
    arm.solve(&Arm::tip_down(pose, LOWEST_M), &arm.ready)?;
    let least = Arm::tip_down(pose, LEAST_RISE_M + STRETCH_MARGIN_M);
    arm.solve(&least, &arm.ready)?;
    Ok(highest_m(arm, &least, wanted_m, &arm.ready))
}

/// The highest, up to `wanted_m`, that a tip pose can be lifted to, less the margin. The heights
/// at which the arm reaches a vertical line with the tool down are one interval.
fn highest_m(arm: &Arm, tip: &Isometry3<f64>, wanted_m: f64, near: &Joints) -> f64 {
    let reaches = |height_m: f64| {
        let mut raised = *tip;
        raised.translation.z = height_m;
        arm.solve(&raised, near).is_ok()
    };
    if reaches(wanted_m + STRETCH_MARGIN_M) {
        return wanted_m;
    }
    let (mut low, mut high) = (tip.translation.z, wanted_m + STRETCH_MARGIN_M);
    for _ in 0..20 {
        let middle = 0.5 * (low + high);
        if reaches(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low - STRETCH_MARGIN_M
}

/// Straight up to the clearance, or as far as the arm reaches; none when the tip is that high or
/// the arm at home.
pub(crate) fn plan_rise(
    arm: &Arm,
    settings: &PrimitiveSettings,
    joints: &Joints,
) -> Result<Option<JointTrajectory>, PlanError> {
    let mut tip = arm.tip(joints);
    let height_m = tip.translation.z;
    if height_m >= settings.clearance_m || (joints - arm.home).amax() < AT_HOME_RAD {
        return Ok(None);
    }
    tip.translation.z = highest_m(arm, &tip, settings.clearance_m, joints);
    if tip.translation.z <= height_m {
        return Ok(None);
    }
    let (speed, acceleration) = (settings.travel_m_s, settings.acceleration_m_s2);
    JointTrajectory::line(arm, joints, &tip, speed, acceleration).map(Some)
}
