//! Causes and stops of motions, and the reported results.

use std::time::Duration;

use pick_place::{Outcome, Phase};

use crate::{Proposal, ProposalId, StepOutcome};

/// A motion that may begin.
#[derive(Clone, Debug, PartialEq)]
pub enum MotionOrder {
    /// Carry out this proposal.
    Proposal(Box<Proposal>),
    /// Bring the arm home, straight up first; suction stays as it is.
    Home(ProposalId),
    /// Put down what is held where it was picked, and bring the arm home.
    PutDown(ProposalId),
}

impl MotionOrder {
    /// What moves the arm then.
    pub fn cause(&self) -> MotionCause {
        match self {
            Self::Proposal(proposal) => MotionCause::Proposal(proposal.id),
            Self::Home(id) => MotionCause::Home(*id),
            Self::PutDown(id) => MotionCause::PutDown(*id),
        }
    }
}

/// What moves the arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotionCause {
    /// An approved proposal.
    Proposal(ProposalId),
    /// An approved way home.
    Home(ProposalId),
    /// What is held is put down first.
    PutDown(ProposalId),
}

impl MotionCause {
    /// What was approved.
    pub fn id(self) -> ProposalId {
        match self {
            Self::Proposal(id) | Self::Home(id) | Self::PutDown(id) => id,
        }
    }

    /// The motion, for people.
    pub fn name(self) -> String {
        match self {
            Self::Proposal(id) => format!("the motion of proposal {id}"),
            Self::Home(_) => "the way home".to_owned(),
            Self::PutDown(_) => "putting down what is held".to_owned(),
        }
    }

    /// What the arm does, for people.
    pub fn text(self) -> String {
        match self {
            Self::Proposal(id) => format!("carries out proposal {id}"),
            Self::Home(_) => "goes home".to_owned(),
            Self::PutDown(_) => "puts down what is held".to_owned(),
        }
    }

    /// Why nothing else can be carried out, for people.
    pub fn busy_text(self) -> String {
        match self {
            Self::Proposal(id) => format!("proposal {id} is being carried out"),
            Self::Home(_) => "the arm is on its way home".to_owned(),
            Self::PutDown(_) => "what is held is being put down".to_owned(),
        }
    }
}

/// Why a motion is stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopCause {
    /// Somebody said STOP.
    Operator,
    /// The client of an action has cancelled its goal.
    GoalCancelled,
    /// Nobody is present.
    NobodyPresent,
    /// The enabling input was low.
    Disabled,
    /// The executor was deactivated.
    Deactivated,
    /// The executor was told to end.
    Shutdown,
}

impl StopCause {
    /// For people.
    pub const fn text(self) -> &'static str {
        match self {
            Self::Operator => "stopped by the operator",
            Self::GoalCancelled => "stopped because its goal was cancelled",
            Self::NobodyPresent => "stopped because no operator is present",
            Self::Disabled => "stopped because the enabling input was low (driver.enable_pin)",
            Self::Deactivated => "stopped because the executor was deactivated",
            Self::Shutdown => "stopped because the executor was told to end",
        }
    }
}

/// When a motion ended and how long it took, in ROS time. Heightmaps from `until` on show its result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MotionTimes {
    /// Its end.
    pub until: Duration,
    /// From its first to its last joint reading.
    pub duration: Duration,
}

impl MotionTimes {
    /// `stamps`: of the first and the last joint reading; of a motion without one nothing is known. `now`: simulated time may still be on its way.
    pub fn new(stamps: Option<(Duration, Duration)>, now: Duration) -> Self {
        let (first, last) = stamps.unwrap_or((now, now));
        Self {
            until: last.max(now),
            duration: last.saturating_sub(first),
        }
    }
}

/// How a motion ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MotionEnd {
    /// As planned; the way home has no outcome of its own.
    Done(Option<Outcome>),
    /// The robot was stopped in this phase.
    Stopped(Phase),
    /// It was broken off, for this reason.
    Failed(String),
}

/// The executor's word on a motion that has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MotionWord {
    /// What became of what was approved.
    pub outcome: StepOutcome,
    /// Why, for people.
    pub reason: String,
    /// Why it was broken off, where it was: nothing goes on by itself then.
    pub broken_off: Option<String>,
}

impl MotionEnd {
    /// What to say of it. `stopped`: what has stopped it first, where something has.
    pub fn word(self, cause: MotionCause, stopped: Option<StopCause>) -> MotionWord {
        let is_proposal = matches!(cause, MotionCause::Proposal(_));
        let (fault, reason) = match self {
            Self::Done(outcome) => {
                let (outcome, mut reason) = match (outcome, cause) {
                    (Some(outcome), _) => (outcome.into(), why(outcome).to_owned()),
                    (None, MotionCause::PutDown(_)) => (
                        StepOutcome::AtHome,
                        "what was held is put down where it was picked".to_owned(),
                    ),
                    (None, _) => (StepOutcome::AtHome, String::new()),
                };
                if stopped.is_some() {
                    reason = format!("the stop came after the end. {reason}")
                        .trim()
                        .to_owned();
                }
                return MotionWord {
                    outcome,
                    reason,
                    broken_off: None,
                };
            }
            // Who else would stop it has said so.
            Self::Stopped(phase) => {
                let stopped = stopped.unwrap_or(StopCause::Disabled);
                (
                    StepOutcome::Stopped,
                    format!("{phase:?}: {}", stopped.text()),
                )
            }
            Self::Failed(reason) => (StepOutcome::Fault, reason),
        };
        MotionWord {
            outcome: if is_proposal {
                fault
            } else {
                StepOutcome::NotHome
            },
            reason: format!(
                "{reason}; the arm stands where it is, suction is as it was; a new observation and approval are needed"
            ),
            broken_off: Some(reason),
        }
    }
}

fn why(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Placed => "",
        Outcome::NoContact => "the descent met nothing to pick",
        Outcome::GraspFailed => "suction held nothing",
        Outcome::Dropped => "the object was lost on the way",
        Outcome::LagAborted => "the tip lagged too far behind; the object was released",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ID: ProposalId = ProposalId(7);

    #[test]
    fn a_motion_that_was_broken_off_is_remembered_and_needs_a_new_approval() {
        let cause = MotionCause::Proposal(ID);
        let stopped = MotionEnd::Stopped(Phase::Lift).word(cause, Some(StopCause::Operator));
        assert_eq!(stopped.outcome, StepOutcome::Stopped);
        let remembered = stopped.broken_off.unwrap();
        assert_eq!(remembered, "Lift: stopped by the operator");
        assert!(stopped.reason.contains("approval are needed"));
        // Nobody has said why: the enabling input.
        let disabled = MotionEnd::Stopped(Phase::Home).word(MotionCause::Home(ID), None);
        assert_eq!(disabled.outcome, StepOutcome::NotHome);
        assert!(disabled.reason.contains("enable_pin"));
        let failed = MotionEnd::Failed("lost".into()).word(cause, None);
        assert_eq!(failed.outcome, StepOutcome::Fault);
        assert_eq!(failed.broken_off.as_deref(), Some("lost"));
    }

    #[test]
    fn a_motion_ends_with_its_last_joint_reading_or_now() {
        let second = Duration::from_secs;
        let times = |stamps, now| {
            let times = MotionTimes::new(stamps, second(now));
            (times.until.as_secs(), times.duration.as_secs())
        };
        assert_eq!(times(Some((second(2), second(5))), 4), (5, 3));
        assert_eq!(times(Some((second(2), second(5))), 9), (9, 3));
        assert_eq!(times(Some((second(5), second(2))), 9), (9, 0));
        assert_eq!(times(None, 9), (9, 0));
    }

    #[test]
    fn a_stop_after_the_end_changes_the_words_only() {
        let end = MotionEnd::Done(Some(Outcome::GraspFailed));
        let word = end.word(MotionCause::Proposal(ID), Some(StopCause::Operator));
        assert_eq!(word.outcome, StepOutcome::GraspFailed);
        assert_eq!(
            word.reason,
            "the stop came after the end. suction held nothing"
        );
        assert_eq!(word.broken_off, None);
        let home = MotionEnd::Done(None).word(MotionCause::PutDown(ID), None);
        assert_eq!(home.outcome, StepOutcome::AtHome);
        assert!(home.reason.contains("put down where it was picked"));
    }
}
