//! The primitive.

use nalgebra::Isometry2;
use serde::{Deserialize, Serialize};
use ur5::{Arm, JointTrajectory, Joints};

/// An action: where the end effector grasps and where it releases, in the world's xy-plane
/// (paper, section III-A).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PickPlace {
    /// Pose at which to grasp.
    pub pick: Isometry2<f64>,
    /// Pose at which to release.
    pub place: Isometry2<f64>,
}

/// Heights and speeds of the primitive; they change with the task module (Ravens).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrimitiveSettings {
    /// Height of approach and retreat over the table.
    pub clearance_m: f64,
    /// Height over the contact at which a held object travels.
    pub lift_m: f64,
    /// Tip speed in free motion.
    pub travel_m_s: f64,
    /// Tip speed while it holds something.
    pub carry_m_s: f64,
    /// Tip speed while it descends to contact.
    pub descend_m_s: f64,
    /// Tip acceleration.
    pub acceleration_m_s2: f64,
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

/// Carries out one pick and place; `observe` is told each phase as it begins.
pub fn execute<R: Robot>(
    _robot: &mut R,
    _arm: &Arm,
    _action: &PickPlace,
    _settings: &PrimitiveSettings,
    _observe: impl FnMut(Phase),
) -> Result<Outcome, R::Error> {
    todo!()
}
