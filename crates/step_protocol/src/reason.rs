//! Why the executor refuses: one reason for each thing that a person can do about it, in words and back.

use std::fmt;

use strum::{FromRepr, VariantArray};

/// Why something is not carried out. Messages carry its words; [`RefusalReason::of_text`] finds it in them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, FromRepr, VariantArray)]
#[repr(u8)]
pub enum RefusalReason {
    /// None of the others.
    Other = 0,
    /// The executor has not received the proposal.
    Unknown = 1,
    /// The proposal was superseded, rejected, withdrawn or carried out: see [`ProposalStatus`](crate::ProposalStatus).
    NotPending = 2,
    /// The message is no proposal that could be approved.
    InvalidProposal = 3,
    /// A pose lies outside the workspace.
    OutsideWorkspace = 4,
    /// Another proposal is being carried out.
    Busy = 5,
    /// The arm is on its way home.
    OnItsWayHome = 6,
    /// The arm, what is held or what is seen has changed since the way home was proposed.
    HomeFromElsewhere = 7,
    /// The proposal was made from what was seen before the last motion ended.
    OldObservation = 8,
    /// The heightmap that the proposal was made from has not arrived.
    NoSourceHeightmap = 9,
    /// The cameras cover another workspace now.
    OtherWorkspace = 10,
    /// The workspace does not look as it did.
    ObservationChanged = 11,
    /// The motion was not checked for collisions in time.
    NotRehearsed = 12,
    /// A stop or a fault came before it.
    Stopped = 13,
    /// No operator is present.
    NobodyPresent = 14,
    /// The robot is not switched on, or its brakes are not released.
    RobotMode = 15,
    /// The robot's safety system does not let it move.
    SafetyMode = 16,
    /// The robot's program does not run.
    RobotProgram = 17,
    /// The robot's driver has fallen silent.
    DriverSilent = 18,
    /// No heightmap is new enough.
    NoFreshHeightmap = 19,
    /// The arm was in the cameras' view when the heightmap was taken.
    ArmInView = 20,
    /// A pose cannot be reached.
    OutOfReach = 21,
    /// The motion would hit something.
    Collision = 22,
    /// The way home cannot be planned, or would hit something.
    WayHome = 23,
    /// What is held cannot be put down without hitting something.
    PuttingDown = 24,
    /// Nobody saw where what is held was picked.
    PickUnseen = 25,
    /// The gripper holds nothing.
    HoldsNothing = 26,
    /// The gripper already holds something.
    AlreadyHolds = 27,
    /// The enabling input is low.
    Disabled = 28,
    /// The driver is not set up as the executor needs it: controllers, software, tool voltage.
    DriverSetup = 29,
    /// Whoever has decided is none of the operators.
    NotAnOperator = 30,
}

impl RefusalReason {
    /// All of them, in the order of their codes.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// A number that stays the same.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// Words that only texts of this reason have; the first stand before a text that has none of them.
    pub const fn words(self) -> &'static [&'static str] {
        match self {
            Self::Other => &[],
            Self::Unknown => &["is unknown"],
            Self::NotPending => &[
                "cannot be approved any more",
                "is pending",
                "was superseded",
                "is already being carried out",
                "was already carried out",
                "was already rejected",
                "was withdrawn",
            ],
            Self::InvalidProposal => &[
                "not a valid proposal",
                "frame is `",
                "is not finite",
                "settings.",
                "came twice with different contents",
            ],
            Self::OutsideWorkspace => &["outside the workspace"],
            Self::Busy => &["is being carried out", "is being put down"],
            Self::OnItsWayHome => &["on its way home"],
            Self::HomeFromElsewhere => {
                &["since its way home was proposed", "has changed meanwhile"]
            }
            Self::OldObservation => &["before the last motion ended"],
            Self::NoSourceHeightmap => &["has not arrived"],
            Self::OtherWorkspace => &["covers another workspace"],
            Self::ObservationChanged => &["the observation has changed"],
            Self::NotRehearsed => &["has not been checked for collisions"],
            Self::Stopped => &["a stop came before it", "was broken off before it"],
            Self::NobodyPresent => &["no operator is present"],
            Self::RobotMode => &["robot mode"],
            Self::SafetyMode => &["safety mode"],
            Self::RobotProgram => &["robot program"],
            Self::DriverSilent => &[
                "the driver is silent",
                "the driver has not",
                "the newest joint_states",
                "the newest io_states",
                "no joint_states",
                "no io_states",
                "the robot's state is not known",
            ],
            Self::NoFreshHeightmap => &[
                "the newest heightmap is",
                "no heightmap has arrived",
                "nobody publishes heightmaps",
            ],
            Self::ArmInView => &["not at home and at rest when the heightmap was taken"],
            Self::OutOfReach => &["out of reach"],
            Self::Collision => &["the motion brings"],
            Self::WayHome => &["the way home"],
            Self::PuttingDown => &["putting down"],
            Self::PickUnseen => &["nobody saw where"],
            Self::HoldsNothing => &["holds nothing"],
            Self::AlreadyHolds => &["already holds"],
            Self::Disabled => &["enabling input"],
            Self::DriverSetup => &[
                "the driver's set-up",
                "controller `",
                "controllers",
                "nobody serves the action",
                "the robot has software",
                "robot software",
                "tool_output_voltage",
                "no tool_data",
            ],
            Self::NotAnOperator => &["does not decide here"],
        }
    }

    /// The reason whose words stand first in a text.
    pub fn of_text(text: &str) -> Self {
        let place = |reason: &Self| {
            reason
                .words()
                .iter()
                .filter_map(|words| text.find(words))
                .min()
        };
        let reasons = Self::ALL.iter().copied();
        let found = reasons.filter_map(|reason| Some((place(&reason)?, reason)));
        found.min().map_or(Self::Other, |(_, reason)| reason)
    }

    /// What stands in the way, in words from which [`Self::of_text`] finds this reason.
    pub fn because(self, text: impl Into<String>) -> Obstacle {
        let text = text.into();
        let text = match self.words().first() {
            Some(words) if Self::of_text(&text) != self => format!("{words}: {text}"),
            _ => text,
        };
        Obstacle { reason: self, text }
    }
}

/// What stands in the way of a motion: the robot's state, or the motion itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Obstacle {
    reason: RefusalReason,
    text: String,
}

impl Obstacle {
    /// What a person can do something about.
    pub fn reason(&self) -> RefusalReason {
        self.reason
    }

    /// In words, with what was found and what was expected.
    pub fn text(&self) -> &str {
        &self.text
    }
}

impl fmt::Display for Obstacle {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.text)
    }
}

impl From<String> for Obstacle {
    fn from(text: String) -> Self {
        Self {
            reason: RefusalReason::of_text(&text),
            text,
        }
    }
}

impl From<Obstacle> for String {
    fn from(obstacle: Obstacle) -> Self {
        obstacle.text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_reason_is_found_in_its_own_words_and_has_its_own_code() {
        for &reason in RefusalReason::ALL {
            for words in reason.words() {
                assert_eq!(RefusalReason::of_text(words), reason, "{words}");
                let named = format!("proposal 7: {words} 0.31");
                assert_eq!(RefusalReason::of_text(&named), reason, "{named}");
            }
            assert_eq!(RefusalReason::from_repr(reason.code()), Some(reason));
        }
        let nothing = RefusalReason::of_text("something nobody thought of");
        assert_eq!(nothing, RefusalReason::Other);
    }

    #[test]
    fn the_words_that_stand_first_decide() {
        let text = "putting down: the place pose is out of reach: 1.1 m";
        assert_eq!(RefusalReason::of_text(text), RefusalReason::PuttingDown);
    }

    proptest! {
        #[test]
        fn a_reason_comes_back_from_its_text_whatever_else_that_says(
            which in 0..RefusalReason::ALL.len(),
            other in 0..RefusalReason::ALL.len(),
            detail in ".{0,20}",
        ) {
            let reason = RefusalReason::ALL[which];
            let words = RefusalReason::ALL[other].words().first().copied().unwrap_or_default();
            let obstacle = reason.because(format!("{detail}{words}"));
            if reason != RefusalReason::Other {
                prop_assert_eq!(RefusalReason::of_text(obstacle.text()), reason);
                prop_assert_eq!(Obstacle::from(obstacle.to_string()), obstacle);
            }
        }
    }
}
