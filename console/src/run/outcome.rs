//! What operators have decided and what the executor has reported.

use std::time::Duration;

use step_protocol::{
    Confirmation, OperatorDecision, Proposal, ProposalId, RefusalKind, StepOutcome, StepResult,
};

use super::{Decision, PastStep, Run, STEPS};
use crate::refusal::{advice_for, advice_of_oracle, advice_on};

impl Run {
    /// The operator decides here: the confirmation is being published.
    pub fn decide(&mut self, confirmation: &Confirmation, now: Duration) {
        self.operator.decide(confirmation, now);
        self.record_decision(confirmation);
    }

    /// A decision has come on the topic. Returns whether it is news: one that was made here is known already.
    pub fn on_confirmation(&mut self, confirmation: &Confirmation, now: Duration) -> bool {
        let is_news = self.operator.on_confirmation(confirmation, now);
        if is_news {
            self.record_decision(confirmation);
        }
        is_news
    }

    fn record_decision(&mut self, confirmation: &Confirmation) {
        let decision = Decision::of(confirmation.decision);
        let mut steps = self.steps.iter_mut();
        let step = steps.rfind(|step| step.proposal.id == confirmation.proposal_id);
        if let (Some(Decision::Advance | Decision::Retry), Some(step)) = (decision, step) {
            step.decision = decision;
            step.decided_by.clone_from(&confirmation.operator_name);
        }
        self.compare();
    }

    /// The goal oracle goes on with the present step.
    pub fn on_continued(&mut self) {
        self.operator.on_continued();
    }

    /// The executor moves the arm, or has ended a motion.
    pub fn on_motion(&mut self, moves: bool, now: Duration) {
        if moves {
            self.operator.on_motion(now);
        }
    }

    /// Opens the question again where a decision was not heard. Returns the proposal that the decision was about.
    pub fn ask_again(&mut self, now: Duration) -> Option<ProposalId> {
        let (id, decision) = self.operator.ask_again(now)?;
        self.compare();
        let (who, what) = match decision {
            OperatorDecision::Approve => ("executor", "approval"),
            OperatorDecision::Reject => ("goal oracle", "rejection"),
            _ => ("goal oracle", "decision on the step"),
        };
        let reason = format!("The {who} has not answered the {what}: it may have been lost.");
        let advice = format!("Look whether the {who} is at work, then decide again.");
        self.note("refusal", reason, advice, now);
        Some(id)
    }

    /// The proposal to be rejected once more by the console itself: see [`Operator::probe`](step_protocol::Operator::probe).
    pub fn probe(&mut self, now: Duration) -> Option<ProposalId> {
        let id = self.operator.probe(now)?;
        self.probed = Some(id);
        Some(id)
    }

    /// The executor has reported.
    pub fn on_result(&mut self, result: &StepResult, now: Duration) {
        let id = result.proposal_id;
        let was_stopped = self.operator.is_stopped();
        self.operator.on_result(result.clone());
        self.compare();
        match result.outcome {
            StepOutcome::Refused => {
                let is_probe = self.probed.take_if(|probed| *probed == id).is_some();
                // A stop that found nothing to stop has stopped the run all the same.
                let is_of_stop = was_stopped && self.proposal(id).is_none();
                if !is_probe && !is_of_stop {
                    let advice = advice_for(result.status, &result.reason);
                    self.note("refusal", sentence(&result.reason), advice, now);
                }
            }
            StepOutcome::Stopped => self.note(
                "note",
                "The run was stopped.",
                "Look at the cell. When it is safe, bring the arm home, then continue with the present step.",
                now,
            ),
            StepOutcome::Fault => self.note(
                "fault",
                format!(
                    "The robot broke the motion off: {}",
                    sentence(&result.reason)
                ),
                "Look at the cell. When it is safe, bring the arm home, then try the step again.",
                now,
            ),
            StepOutcome::AtHome => {
                let text = match result.reason.as_str() {
                    "" => "The arm is at home.".to_owned(),
                    reason => sentence(&format!("the arm is at home: {reason}")),
                };
                self.note("note", text, "", now);
            }
            StepOutcome::NotHome => {
                let text = format!("The arm did not go home: {}", result.reason);
                self.note("refusal", text, advice_on(&result.reason), now);
            }
            StepOutcome::Rejected
            | StepOutcome::Placed
            | StepOutcome::NoContact
            | StepOutcome::GraspFailed
            | StepOutcome::Dropped
            | StepOutcome::LagAborted => {}
        }
        if result.arm_moved()
            && let Some(proposal) = self.proposal(id).cloned()
        {
            self.record_step(proposal, result);
        }
    }

    fn record_step(&mut self, proposal: Proposal, result: &StepResult) {
        let is_same =
            |step: &PastStep| (step.proposal.id, step.ended) == (proposal.id, result.stamp);
        if self.steps.iter().any(is_same) {
            return;
        }
        let mut views = self.views.iter();
        let before = views.rfind(|view| view.stamp == proposal.stamp).cloned();
        self.step_count += 1;
        if self.steps.len() == STEPS {
            self.steps.pop_front();
        }
        let ended = result.stamp;
        self.steps.push_back(PastStep {
            number: self.step_count,
            proposal,
            outcome: result.outcome,
            reason: result.reason.clone(),
            duration: result.duration,
            ended,
            decision: None,
            decided_by: String::new(),
            before,
            after: self.views.iter().find(|view| view.stamp >= ended).cloned(),
            is_kept: false,
        });
    }

    /// The oracle has refused a decision on a step that was carried out: it has changed nothing.
    pub fn on_confirmation_refused(
        &mut self,
        id: ProposalId,
        kind: Option<RefusalKind>,
        reason: &str,
        now: Duration,
    ) {
        self.operator.on_confirmation_refused(id, kind);
        self.note("refusal", sentence(reason), advice_of_oracle(kind), now);
    }
}

pub(crate) fn outcome_words(outcome: StepOutcome) -> &'static str {
    match outcome {
        StepOutcome::Placed => "placed",
        StepOutcome::NoContact => "found nothing to pick",
        StepOutcome::GraspFailed => "suction held nothing",
        StepOutcome::Dropped => "lost the object on the way",
        StepOutcome::LagAborted => "stopped: the arm lagged behind",
        StepOutcome::Fault => "broke off by a fault",
        StepOutcome::Stopped => "stopped by the operator",
        StepOutcome::AtHome => "at home",
        StepOutcome::NotHome => "not at home",
        StepOutcome::Refused => "refused",
        StepOutcome::Rejected => "rejected",
    }
}

/// First letter large, full stop at the end.
pub(super) fn sentence(text: &str) -> String {
    let text = text.trim();
    let mut characters = text.chars();
    let mut sentence: String = characters.next().map_or(String::new(), |first| {
        first.to_uppercase().chain(characters).collect()
    });
    if !sentence.ends_with(['.', '!', '?']) {
        sentence.push('.');
    }
    sentence
}
