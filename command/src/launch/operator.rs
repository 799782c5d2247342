//! Operators: who approves proposals and confirms steps, and what a terminal asks them.

use anyhow::{Context as _, Result};
use clap::ValueEnum;
use msgs::{convert, sctn_msgs};
use node_kit::Node;
use step_protocol::{Confirmation, OperatorDecision, Proposal, ProposalId, Question, Verdict};

/// Which proposals an operator approves before they are carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RequireApproval {
    /// Every one
    Always,
    /// Those that are not sure to succeed
    Unsure,
    /// None, until a stop or a fault
    Never,
}

impl RequireApproval {
    /// As the executor's parameter of that name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Always => "always",
            Self::Unsure => "unsure",
            Self::Never => "never",
        }
    }
}

/// Who decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OperatorKind {
    /// Approves every proposal, and confirms steps by the simulator's reward
    Auto,
    /// Asks the person at the terminal
    Terminal,
    /// Serves a page on which a person decides, and prints its address
    Web,
    /// A person who only watches: every proposal is carried out, and the goal module, or with the oracle the motion's
    /// outcome, says which goal is next. Ctrl-C ends the run
    Watch,
    /// Nobody here: another program on the topics decides
    None,
}

/// A question at a terminal, and the keys that answer it.
#[derive(Clone, Copy, Debug)]
pub struct Prompt {
    /// What is asked.
    pub text: &'static str,
    answers: &'static [(&'static str, OperatorDecision)],
}

impl Prompt {
    /// May this proposal be carried out?
    pub const APPROVE: Self = Self {
        text: "carry it out? [y]es, [n]o, [s]top",
        answers: &[
            ("y", OperatorDecision::Approve),
            ("n", OperatorDecision::Reject),
            ("s", OperatorDecision::Stop),
        ],
    };
    /// Has this step succeeded?
    pub const CONFIRM: Self = Self {
        text: "did the step succeed? [y]es, [n]o: try again, it undid an earlier step: go [b]ack, [s]top",
        answers: &[
            ("y", OperatorDecision::Advance),
            ("n", OperatorDecision::Retry),
            ("b", OperatorDecision::StepBack),
            ("s", OperatorDecision::Stop),
        ],
    };

    pub fn of(question: &Question) -> Self {
        match question {
            Question::Approve(_) => Self::APPROVE,
            Question::Confirm { .. } => Self::CONFIRM,
        }
    }

    /// What a typed line decides; `None` where it is none of the keys.
    pub fn decision(&self, line: &str) -> Option<OperatorDecision> {
        let key = line.trim().to_lowercase();
        let mut answers = self.answers.iter();
        answers
            .find(|answer| answer.0 == key)
            .map(|answer| answer.1)
    }
}

/// A proposal in one line.
pub fn described(proposal: &Proposal, step_count: u32) -> String {
    let (pick, place) = (&proposal.action.pick, &proposal.action.place);
    let probability = proposal.success_probability;
    let probability = probability.map(|probability| format!(", success {probability:.2}"));
    let probability = probability.unwrap_or_default();
    let verdict = match proposal.verdict() {
        Verdict::Act => String::new(),
        verdict => format!(". {}", verdict.text()),
    };
    format!(
        "step {}/{step_count} attempt {}: {} pick ({:.3}, {:.3}) place ({:.3}, {:.3}, {:.0} deg), scores {:.2} {:.2}{probability}{verdict}",
        proposal.step,
        proposal.attempt,
        proposal.module,
        pick.translation.x,
        pick.translation.y,
        place.translation.x,
        place.translation.y,
        place.rotation.angle().to_degrees(),
        proposal.pick_score,
        proposal.place_score
    )
}

/// A decision of now, as a message.
pub fn confirmation(
    node: &Node,
    proposal_id: ProposalId,
    decision: OperatorDecision,
    operator_name: &str,
) -> Result<sctn_msgs::StepConfirmation> {
    let confirmation = Confirmation {
        stamp: node.clock().time(),
        proposal_id,
        decision,
        operator_name: operator_name.into(),
    };
    convert::confirmation_to_msg(&confirmation).context("step_confirmation")
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use nalgebra::Isometry2;
    use pick_place::{PickPlace, PrimitiveSettings};

    use super::*;

    #[test]
    fn a_line_decides_by_its_key_and_anything_else_decides_nothing() {
        assert_eq!(
            Prompt::APPROVE.decision(" Y\n"),
            Some(OperatorDecision::Approve)
        );
        assert_eq!(
            Prompt::CONFIRM.decision("y"),
            Some(OperatorDecision::Advance)
        );
        assert_eq!(
            Prompt::CONFIRM.decision("b"),
            Some(OperatorDecision::StepBack)
        );
        for line in ["", "yes", "b", "ys"] {
            assert_eq!(Prompt::APPROVE.decision(line), None, "{line}");
        }
    }

    #[test]
    fn a_proposal_whose_goal_looks_reached_says_so_in_its_line() {
        let proposal = |done: f32, success: f32| Proposal {
            id: ProposalId(1),
            frame: "world".into(),
            stamp: Duration::ZERO,
            problem: "stacking".into(),
            step: 2,
            attempt: 0,
            module: "stacking".into(),
            action: PickPlace {
                pick: Isometry2::identity(),
                place: Isometry2::identity(),
            },
            settings: PrimitiveSettings::RIGID,
            pick_score: 0.5,
            place_score: 0.5,
            success_probability: Some(success),
            checkpoint: String::new(),
            author: String::new(),
            done_probability: Some(done),
        };
        let done = described(&proposal(0.9, 0.1), 3);
        assert!(
            done.ends_with("success 0.10. the goal of this step looks reached already"),
            "{done}"
        );
        let unknown = described(&proposal(0.1, 0.1), 3);
        assert!(
            unknown.ends_with("the policy does not know how to reach the goal"),
            "{unknown}"
        );
        assert!(described(&proposal(0.1, 0.9), 3).ends_with("success 0.90"));
    }
}
