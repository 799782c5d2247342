//! Why something was not done, in words for a person, with what to do next.

use serde::Serialize;
use step_protocol::{ProposalStatus, RefusalKind, RefusalReason};

/// Something that was asked for and not done.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, thiserror::Error)]
#[error("{reason} {advice}")]
pub struct Refusal {
    /// The reason.
    pub reason: String,
    /// What to do next.
    pub advice: String,
}

impl Refusal {
    /// Both are sentences.
    pub fn new(reason: impl Into<String>, advice: impl Into<String>) -> Self {
        Self {
            reason: reason.into(),
            advice: advice.into(),
        }
    }
}

/// What to do next about why something may not be carried out now.
pub fn advice(reason: RefusalReason) -> &'static str {
    match reason {
        RefusalReason::NobodyPresent => {
            "Keep the page of the operator open and in sight while the arm moves."
        }
        RefusalReason::ObservationChanged | RefusalReason::OtherWorkspace => {
            "Something moved on the table since the proposal. Wait for the new proposal and look at it again."
        }
        RefusalReason::OldObservation => "It was made from an old view. Wait for the new proposal.",
        RefusalReason::NoSourceHeightmap | RefusalReason::NoFreshHeightmap => {
            "The cameras' view has not come through. Wait a moment and approve again; if it stays, look at the streams below."
        }
        RefusalReason::NotRehearsed => {
            "The executor is busy planning. Wait a moment and approve again."
        }
        RefusalReason::Unknown => {
            "The executor has not heard of it. Wait a moment and decide again; if it stays, reject it."
        }
        RefusalReason::OutsideWorkspace | RefusalReason::InvalidProposal => {
            "Reject it: the policy will propose something else."
        }
        RefusalReason::OutOfReach => {
            "The arm cannot get there. Reject it: the policy will propose something else."
        }
        RefusalReason::Collision => {
            "The arm would hit something. Take it away, or reject the proposal."
        }
        RefusalReason::WayHome => "Free the arm with the teach pendant, then call it home again.",
        RefusalReason::PuttingDown => {
            "Take away what stands in the way, or bring the arm home with what it holds."
        }
        RefusalReason::PickUnseen => {
            "Bring the arm home, and take the part from the gripper by hand."
        }
        RefusalReason::HoldsNothing | RefusalReason::ArmInView => "Bring the arm home.",
        RefusalReason::HomeFromElsewhere => "Call the arm home again.",
        RefusalReason::Busy => "Wait until the arm has finished, or stop it.",
        RefusalReason::OnItsWayHome => "Wait until the arm is at home, then approve again.",
        RefusalReason::AlreadyHolds => {
            "Take the object from the gripper, or bring the arm home, then look at the table again."
        }
        RefusalReason::RobotMode => {
            "Look at the teach pendant: power the arm on and release its brakes."
        }
        RefusalReason::SafetyMode => {
            "Look at the teach pendant: unlock the protective stop when it is safe."
        }
        RefusalReason::RobotProgram => "Start the External Control program on the teach pendant.",
        RefusalReason::Disabled => "Close the enabling switch when it is safe.",
        RefusalReason::NotAnOperator => {
            "Ask one of those who are named, or have your name added to the executor's parameter operators."
        }
        RefusalReason::DriverSetup => {
            "The driver is not set up as the executor needs it: docs/guide/real_cell.md."
        }
        RefusalReason::DriverSilent => {
            "The robot's driver has fallen silent. Look at its process and its network."
        }
        RefusalReason::NotPending | RefusalReason::Stopped | RefusalReason::Other => {
            "Look at the cell. If it is safe, wait for the next proposal or continue with the present step."
        }
    }
}

/// The same for a reason in the words of a message.
pub fn advice_on(text: &str) -> &'static str {
    advice(RefusalReason::of_text(text))
}

/// What to do next about a refusal of the executor, which says where the proposal stands.
pub fn advice_for(status: Option<ProposalStatus>, reason: &str) -> &'static str {
    match status {
        Some(ProposalStatus::Superseded) => "A newer proposal has replaced it. Look at that one.",
        Some(ProposalStatus::Moving) => "Wait until the arm has finished, or stop it.",
        Some(ProposalStatus::Done) => "Say whether the step succeeded.",
        Some(ProposalStatus::Rejected) => "Wait for the next proposal.",
        Some(ProposalStatus::Withdrawn) => {
            "Bring the arm home if it stands in the way, then continue the run."
        }
        Some(ProposalStatus::Pending) | None => advice_on(reason),
    }
}

/// What to do next about a refusal of the goal oracle; none is a kind that this version does not know.
pub fn advice_of_oracle(kind: Option<RefusalKind>) -> &'static str {
    match kind {
        Some(RefusalKind::Unknown) => {
            "The goal oracle has not heard of that proposal. Wait a moment, then say it again."
        }
        Some(RefusalKind::Stale) => {
            "It was about a step that is over. Look at the present proposal."
        }
        Some(RefusalKind::Twice) => "Wait until the arm has finished.",
        Some(RefusalKind::Stopped) => "Continue the run with the present step.",
        Some(RefusalKind::Complete) => "Nothing is left to do.",
        Some(RefusalKind::NotAsked) => {
            "You only approve and stop: the goal module says which step is next."
        }
        Some(RefusalKind::NoDecision) | None => {
            "Look whether console and goal oracle are of the same version."
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_of_the_executor_comes_with_what_to_do() {
        let reason = "proposal 7: the observation has changed since: 0.31 % of the cells";
        assert!(advice_on(reason).contains("Wait for the new proposal"));
        assert!(advice_on("something nobody thought of").contains("Look at the cell"));
        // Of a heightmap that is too old the driver is not to blame.
        let old = "the newest heightmap is 3.1 s old, expected at most 1.0 s";
        assert!(advice_on(old).contains("cameras"));
    }

    #[test]
    fn where_the_proposal_stands_decides_over_the_words_of_the_reason() {
        let reason = "proposal 7: the observation has changed since: 0.31 % of the cells";
        let superseded = advice_for(Some(ProposalStatus::Superseded), reason);
        assert!(superseded.contains("replaced"), "{superseded}");
        for status in [Some(ProposalStatus::Pending), None] {
            assert_eq!(advice_for(status, reason), advice_on(reason));
        }
    }

    #[test]
    fn every_reason_of_the_oracle_has_its_own_advice() {
        let kinds = RefusalKind::ALL.iter().copied().map(Some);
        let all: std::collections::BTreeSet<_> = kinds.map(advice_of_oracle).collect();
        assert_eq!(all.len(), 7);
    }
}
