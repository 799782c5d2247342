//! Why something was not done, in words for a person, with what to do next.

use serde::Serialize;

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

/// What a person should do about a reason that executor or oracle gave: part of the reason, advice.
const ADVICE: [(&str, &str); 21] = [
    (
        "no operator is present",
        "Keep the page of the operator open and in sight while the arm moves.",
    ),
    (
        "the observation has changed",
        "Something moved on the table since the proposal. Wait for the new proposal and look at it again.",
    ),
    (
        "was superseded",
        "A newer proposal has replaced it. Look at that one.",
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
    ("was already carried out", "Say whether the step succeeded."),
    ("was already rejected", "Wait for the next proposal."),
    (
        "was withdrawn by a stop",
        "Bring the arm home if it stands in the way, then continue the run.",
    ),
    (
        "is being carried out",
        "Wait until the arm has finished, or stop it.",
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
        "the run was stopped",
        "Continue the run with the present step.",
    ),
    ("all steps are done", "Nothing is left to do."),
    (
        "is of an earlier goal",
        "It was about a step that is over. Look at the present proposal.",
    ),
    (
        "decides by itself",
        "You only approve and stop: the goal module says which step is next.",
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

/// What to do next about a reason of the executor or the oracle.
pub fn advice(reason: &str) -> &'static str {
    let mut known = ADVICE.iter();
    known.find(|(part, _)| reason.contains(part)).map_or(
        "Look at the cell. If it is safe, wait for the next proposal or continue with the present step.",
        |(_, advice)| advice,
    )
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
}
