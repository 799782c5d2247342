//! Why something was not done, in words for a person, with what to do next.

use serde::Serialize;
use step_protocol::{ProposalStatus, RefusalKind};

/// Something that was asked for and not done.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, thiserror::Error)]
#[error("{reason} {advice}")]
pub struct Refusal {
    /// Why.
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

/// What a person should do about a reason why a proposal that stands may not be carried out now: part of the reason, advice.
const ADVICE: [(&str, &str); 13] = [
    (
        "no operator is present",
        "Keep the page of the operator open and in sight while the arm moves.",
    ),
    (
        "the observation has changed",
        "Something moved on the table since the proposal. Wait for the new proposal and look at it again.",
    ),
    (
        "before the last motion ended",
        "It was made from an old view. Wait for the new proposal.",
    ),
    (
        "has not arrived",
        "The cameras' view has not come through. Wait a moment and approve again; if it stays, look at the streams below.",
    ),
    (
        "outside the workspace",
        "Reject it: the policy will propose something else.",
    ),
    (
        "out of reach",
        "The arm cannot get there. Reject it: the policy will propose something else.",
    ),
    (
        "the way home: ",
        "Free the arm with the teach pendant, then call it home again.",
    ),
    (
        "on its way home",
        "Wait until the arm is at home, then approve again.",
    ),
    (
        "already holds",
        "Take the object from the gripper, or bring the arm home, then look at the table again.",
    ),
    (
        "robot mode",
        "Look at the teach pendant: power the arm on and release its brakes.",
    ),
    (
        "safety mode",
        "Look at the teach pendant: unlock the protective stop when it is safe.",
    ),
    (
        "robot program",
        "Start the External Control program on the teach pendant.",
    ),
    (
        "s old, expected at most",
        "The robot's driver has fallen silent. Look at its process and its network.",
    ),
];

/// What to do next about why the robot may not move now.
pub fn advice(reason: &str) -> &'static str {
    let mut known = ADVICE.iter();
    known.find(|(part, _)| reason.contains(part)).map_or(
        "Look at the cell. If it is safe, wait for the next proposal or continue with the present step.",
        |(_, advice)| advice,
    )
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
        Some(ProposalStatus::Pending) | None => advice(reason),
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
        assert!(advice(reason).contains("Wait for the new proposal"));
        assert!(advice("something nobody thought of").contains("Look at the cell"));
    }

    #[test]
    fn where_the_proposal_stands_decides_over_the_words_of_the_reason() {
        let reason = "proposal 7: the observation has changed since: 0.31 % of the cells";
        let superseded = advice_for(Some(ProposalStatus::Superseded), reason);
        assert!(superseded.contains("replaced"), "{superseded}");
        for status in [Some(ProposalStatus::Pending), None] {
            assert_eq!(advice_for(status, reason), advice(reason));
        }
    }

    #[test]
    fn every_reason_of_the_oracle_has_its_own_advice() {
        let kinds = RefusalKind::ALL.iter().copied().map(Some);
        let all: std::collections::BTreeSet<_> = kinds.map(advice_of_oracle).collect();
        assert_eq!(all.len(), 7);
    }
}
