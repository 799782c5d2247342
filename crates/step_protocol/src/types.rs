//! What the parties of a step say to each other.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use heightmap::Heightmap;
use nalgebra::UnitComplex;
use pick_place::{Outcome, PickPlace, PrimitiveSettings};
use strum::{FromRepr, VariantArray};

/// Identifies a proposal; equal contents have equal ids.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ProposalId(pub u64);

impl fmt::Display for ProposalId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(formatter)
    }
}

/// What became of a proposal, as the executor reports it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, FromRepr, VariantArray)]
#[repr(u8)]
pub enum StepOutcome {
    /// Something was picked and released at the place pose.
    Placed = 1,
    /// The descent met nothing to pick.
    NoContact = 2,
    /// Suction held nothing.
    GraspFailed = 3,
    /// The object was lost between grasp and release.
    Dropped = 4,
    /// The tip lagged too far behind: stopped and released.
    LagAborted = 5,
    /// The confirmation or the proposal was not valid: nothing moved.
    Refused = 6,
    /// The operator rejected the proposal: nothing moved.
    Rejected = 7,
    /// The robot failed or stopped itself.
    Fault = 8,
    /// The operator stopped the motion, or withdrew the proposal.
    Stopped = 9,
    /// The way home was carried out.
    AtHome = 10,
    /// The way home was broken off by a stop or a fault.
    NotHome = 11,
}

impl StepOutcome {
    /// All of them, in the order of their codes.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// The constant of the message `StepResult`.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// Whether the arm may have moved: heightmaps from before are no ground for another motion. The only outcomes without
    /// motion are `Refused` and `Rejected`; a stop may come in the middle of a motion.
    pub const fn arm_moved(self) -> bool {
        !matches!(self, Self::Refused | Self::Rejected)
    }

    /// Whether it speaks of a way home, which is no step of a run.
    pub const fn is_of_home(self) -> bool {
        matches!(self, Self::AtHome | Self::NotHome)
    }

    /// [`Self::arm_moved`] where it is known where the proposal stands: a stop that only withdrew it moved nothing.
    pub fn arm_moved_for(self, status: Option<ProposalStatus>) -> bool {
        let withdrawn = status == Some(ProposalStatus::Withdrawn);
        self.arm_moved() && !(self == Self::Stopped && withdrawn)
    }

    /// How the primitive ended, if it ran to its end, the arm being back home.
    pub const fn motion(self) -> Option<Outcome> {
        match self {
            Self::Placed => Some(Outcome::Placed),
            Self::NoContact => Some(Outcome::NoContact),
            Self::GraspFailed => Some(Outcome::GraspFailed),
            Self::Dropped => Some(Outcome::Dropped),
            Self::LagAborted => Some(Outcome::LagAborted),
            Self::Refused
            | Self::Rejected
            | Self::Fault
            | Self::Stopped
            | Self::AtHome
            | Self::NotHome => None,
        }
    }

    /// In words.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Placed => "placed",
            Self::NoContact => "no contact",
            Self::GraspFailed => "grasp failed",
            Self::Dropped => "dropped",
            Self::LagAborted => "stopped by lag",
            Self::Refused => "refused",
            Self::Rejected => "rejected",
            Self::Fault => "fault",
            Self::Stopped => "stopped",
            Self::AtHome => "at home",
            Self::NotHome => "not at home",
        }
    }
}

impl From<Outcome> for StepOutcome {
    fn from(outcome: Outcome) -> Self {
        match outcome {
            Outcome::Placed => Self::Placed,
            Outcome::NoContact => Self::NoContact,
            Outcome::GraspFailed => Self::GraspFailed,
            Outcome::Dropped => Self::Dropped,
            Outcome::LagAborted => Self::LagAborted,
        }
    }
}

/// What an operator decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, FromRepr, VariantArray)]
#[repr(u8)]
pub enum OperatorDecision {
    /// Carry the proposal out.
    Approve = 1,
    /// Do not; propose something else for this step.
    Reject = 2,
    /// The step was carried out and succeeded: go on with the next.
    Advance = 3,
    /// The step was carried out and failed: try it again.
    Retry = 4,
    /// End the run.
    Stop = 5,
    /// The step was carried out and undid an earlier one: go back to the goal before.
    StepBack = 6,
}

impl OperatorDecision {
    /// All of them, in the order of their codes.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// The constant of the message `StepConfirmation`.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// In words.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Approve => "approve",
            Self::Reject => "reject",
            Self::Advance => "advance",
            Self::Retry => "retry",
            Self::Stop => "stop",
            Self::StepBack => "step back",
        }
    }
}

/// Where a proposal stands at the executor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, FromRepr, VariantArray)]
#[repr(u8)]
pub enum ProposalStatus {
    /// It can be approved.
    Pending = 1,
    /// A newer one has taken its place.
    Superseded = 2,
    /// It is being carried out.
    Moving = 3,
    /// It was carried out, to whatever end.
    Done = 4,
    /// The operator rejected it.
    Rejected = 5,
    /// A stop, or the cancellation of its action goal, took it back.
    Withdrawn = 6,
}

impl ProposalStatus {
    /// All of them, in the order of their codes.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// The constant of the message `StepResult`.
    pub const fn code(self) -> u8 {
        self as u8
    }
}

impl fmt::Display for ProposalStatus {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Pending => "is pending",
            Self::Superseded => "was superseded by a newer one",
            Self::Moving => "is already being carried out",
            Self::Done => "was already carried out",
            Self::Rejected => "was already rejected",
            Self::Withdrawn => "was withdrawn",
        })
    }
}

/// How much of the workspace the cameras saw; all 0 where that is not known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coverage {
    /// Number of views fused.
    pub views: u32,
    /// Fraction of the cells that some view saw, 0 to 1.
    pub fraction: f32,
}

/// A heightmap and when it was seen.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// Capture time of its newest view.
    pub stamp: Duration,
    /// Frame of the heightmap: the world.
    pub frame: String,
    /// What was seen.
    pub heightmap: Arc<Heightmap>,
    /// How much of it was seen.
    pub coverage: Coverage,
}

/// What is to be reached next: an image of a demonstration.
#[derive(Clone, Debug, PartialEq)]
pub struct Goal {
    /// Only heightmaps not older than this may be acted on.
    pub stamp: Duration,
    /// Name of the problem.
    pub problem: String,
    /// Name of the demonstration.
    pub demonstration: String,
    /// Step that this goal ends, 1 to `step_count`.
    pub step: u32,
    /// Number of goals of the demonstration.
    pub step_count: u32,
    /// 0 for the first try of this step, one more after each rejection or retry.
    pub attempt: u32,
    /// Whether nothing is left to do.
    pub complete: bool,
    /// Task module of this step.
    pub module: String,
    /// Heights and speeds for this step.
    pub settings: PrimitiveSettings,
    /// The workspace after this step, v_k.
    pub image: Arc<Heightmap>,
    /// How much of `image` was seen.
    pub coverage: Coverage,
    /// The workspace before this step in the demonstration, v_(k-1); v_0 is what was seen before the first step. None where
    /// a taught sequence has no image of its start.
    pub previous: Option<Arc<Heightmap>>,
}

/// Where to grasp and where to release. Nothing moves before it is approved.
#[derive(Clone, Debug, PartialEq)]
pub struct Proposal {
    /// Identifies it.
    pub id: ProposalId,
    /// Frame of its poses: the world.
    pub frame: String,
    /// Stamp of the heightmap that it was made from.
    pub stamp: Duration,
    /// Name of the problem, from the goal.
    pub problem: String,
    /// Step, from the goal.
    pub step: u32,
    /// Attempt, from the goal.
    pub attempt: u32,
    /// Task module, from the goal.
    pub module: String,
    /// Where to grasp and where to release, in the world's xy-plane.
    pub action: PickPlace,
    /// Heights and speeds, from the goal.
    pub settings: PrimitiveSettings,
    /// Probability of the pick cell, 0 to 1.
    pub pick_score: f32,
    /// Probability of the place cell and rotation, 0 to 1.
    pub place_score: f32,
    /// Probability that the step succeeds, 0 to 1; `None` where nothing estimates it.
    pub success_probability: Option<f32>,
    /// Name of the checkpoint that made it; empty where a person did.
    pub checkpoint: String,
    /// Who made it: a node or a person.
    pub author: String,
    /// Probability that the goal is reached already, 0 to 1; `None` where nothing estimates it.
    pub done_probability: Option<f32>,
}

/// What a proposal's estimates say of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It is worth carrying out, as far as anything estimates it.
    Act,
    /// The goal is probably reached already: there is nothing to do.
    Done,
    /// It fails more probably than it succeeds: the policy does not know what to do.
    Unknown,
}

impl Verdict {
    /// What to tell the operator; empty for [`Verdict::Act`].
    pub const fn text(self) -> &'static str {
        match self {
            Self::Act => "",
            Self::Done => "the goal of this step looks reached already",
            Self::Unknown => "the policy does not know how to reach the goal",
        }
    }
}

impl Proposal {
    /// The verdict of its estimates.
    pub fn verdict(&self) -> Verdict {
        let estimates = (self.done_probability, self.success_probability);
        match estimates {
            (Some(done), _) if done > 0.5 => Verdict::Done,
            (_, Some(success)) if success < 0.5 => Verdict::Unknown,
            _ => Verdict::Act,
        }
    }

    /// Whether two messages ask for the same motion for the same goal.
    pub fn is_same_motion(&self, other: &Self) -> bool {
        let goal = |proposal: &Self| (proposal.step, proposal.attempt, proposal.stamp);
        goal(self) == goal(other)
            && self.frame == other.frame
            && self.problem == other.problem
            && self.action == other.action
            && self.settings == other.settings
    }
}

/// The executor's word on a proposal.
#[derive(Clone, Debug, PartialEq)]
pub struct StepResult {
    /// When it ended: heightmaps from then on show the result.
    pub stamp: Duration,
    /// The proposal.
    pub proposal_id: ProposalId,
    /// What became of it.
    pub outcome: StepOutcome,
    /// Why, for people; empty when there is nothing to say.
    pub reason: String,
    /// How long the motion took.
    pub duration: Duration,
    /// Where the proposal stands after this word; none if the executor does not know it.
    pub status: Option<ProposalStatus>,
}

impl StepResult {
    /// Whether the arm may have moved for this proposal.
    pub fn arm_moved(&self) -> bool {
        self.outcome.arm_moved_for(self.status)
    }

    /// Whether the proposal was carried out, to whatever end: the executor reports the motion, or it refuses to carry the
    /// proposal out once more, which stands for a result that was lost.
    pub fn was_carried_out(&self) -> bool {
        let done = self.status == Some(ProposalStatus::Done);
        self.arm_moved() || (self.outcome == StepOutcome::Refused && done)
    }
}

/// An operator's word on one proposal.
#[derive(Clone, Debug, PartialEq)]
pub struct Confirmation {
    /// When the operator decided.
    pub stamp: Duration,
    /// The proposal it speaks of.
    pub proposal_id: ProposalId,
    /// What was decided.
    pub decision: OperatorDecision,
    /// Who decided.
    pub operator_name: String,
}

/// What the simulator measured at rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reward {
    /// Time of the measurement [ROS time].
    pub stamp: Duration,
    /// Change since the one before.
    pub delta: f64,
    /// Sum, 0 to 1.
    pub total: f64,
    /// Whether nothing is left to do.
    pub complete: bool,
}

/// The angle of a rotation; among its neighbours the one whose sine and cosine are exactly the rotation's, so that a pose
/// passes through its angle bit for bit.
pub fn yaw_rad(rotation: &UnitComplex<f64>) -> f64 {
    use std::f64::consts::{PI, TAU};
    use std::iter::successors;
    let angle = rotation.angle();
    let turned = if angle < 0.0 {
        angle + TAU
    } else {
        angle - TAU
    };
    for near in [angle, turned] {
        let up = successors(Some(near), |yaw| Some(yaw.next_up()));
        let down = successors(Some(near), |yaw| Some(yaw.next_down()));
        let exact = |yaw: &f64| yaw.abs() <= TAU && UnitComplex::new(*yaw) == *rotation;
        if let Some(yaw) = up.take(5).chain(down.take(5)).find(exact) {
            return yaw;
        }
    }
    angle.clamp(-PI, PI)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_stand_for_what_they_are_made_of_and_nothing_else() {
        for code in 0..=u8::MAX {
            match StepOutcome::from_repr(code) {
                Some(outcome) => assert_eq!(outcome.code(), code),
                None => assert!(!(1..=9).contains(&code)),
            }
            match OperatorDecision::from_repr(code) {
                Some(decision) => assert_eq!(decision.code(), code),
                None => assert!(!(1..=6).contains(&code)),
            }
            match ProposalStatus::from_repr(code) {
                Some(status) => assert_eq!(status.code(), code),
                None => assert!(!(1..=6).contains(&code)),
            }
        }
    }

    #[test]
    fn every_outcome_of_a_primitive_is_a_motion_and_comes_back() {
        for &outcome in StepOutcome::ALL {
            if let Some(motion) = outcome.motion() {
                assert_eq!(StepOutcome::from(motion), outcome);
                assert!(outcome.arm_moved());
            }
        }
        assert!(!StepOutcome::Refused.arm_moved() && !StepOutcome::Rejected.arm_moved());
    }
}
