//! What operators have decided and what the executor has reported.

use std::time::Duration;

use step_protocol::{
    Confirmation, ProposalId, ProposalStatus, RefusalKind, StepOutcome, StepResult,
};

use super::answer::Unanswered;
use super::{Decision, PastStep, Run, STEPS, Status};
use crate::refusal::{advice, advice_for, advice_of_oracle};

impl Run {
    /// An operator has decided, here or elsewhere.
    pub fn on_confirmation(&mut self, confirmation: &Confirmation, now: Duration) {
        let id = confirmation.proposal_id;
        let Some(decision) = Decision::of(confirmation.decision) else {
            return;
        };
        if decision == Decision::Stop {
            self.stopped = self.goal.as_ref().is_some_and(|goal| !goal.complete);
            self.unanswered = None;
            return;
        }
        if let (Decision::Advance | Decision::Retry, Some(step)) = (
            decision,
            self.steps.iter_mut().rfind(|step| step.proposal.id == id),
        ) {
            step.decision = Some(decision);
            step.decided_by.clone_from(&confirmation.operator_name);
        }
        if let Some(offered) = self.offered(id) {
            let status = match (decision, &offered.status) {
                (Decision::Approve, Status::Open) => Status::Approved,
                (Decision::Reject, Status::Open) => Status::Closed,
                (Decision::Advance | Decision::Retry, Status::Moved { fault }) => {
                    Status::Confirmed { fault: *fault }
                }
                _ => return,
            };
            let before = std::mem::replace(&mut offered.status, status);
            self.unanswered = Some(Unanswered {
                proposal_id: id,
                decision,
                before,
                since: now,
            });
        }
    }

    /// The executor has reported.
    pub fn on_result(&mut self, result: &StepResult, now: Duration) {
        let id = result.proposal_id;
        // What is said of a rejection or of the next step is the oracle's to answer.
        self.unanswered
            .take_if(|asked| asked.proposal_id == id && asked.decision == Decision::Approve);
        match result.outcome {
            StepOutcome::Refused => {
                let carried_out = result.was_carried_out();
                if let Some(offered) = self.offered(id) {
                    offered.status = match (&offered.status, result.status) {
                        // The result was lost, for instance while the console was not there.
                        (Status::Approved, _) if carried_out => Status::Moved { fault: false },
                        (Status::Open | Status::Approved, Some(status)) => match status {
                            ProposalStatus::Moving => Status::Approved,
                            ProposalStatus::Superseded
                            | ProposalStatus::Rejected
                            | ProposalStatus::Withdrawn => Status::Closed,
                            ProposalStatus::Pending | ProposalStatus::Done => Status::Open,
                        },
                        (Status::Approved, None) => Status::Open,
                        (status, _) => (*status).clone(),
                    };
                }
                // A stop that found nothing to stop has stopped the run all the same.
                if self.stopped && self.offered(id).is_none() {
                    return;
                }
                let advice = advice_for(result.status, &result.reason);
                self.note("refusal", sentence(&result.reason), advice, now);
                return;
            }
            StepOutcome::Rejected => {
                if let Some(offered) = self.offered(id) {
                    offered.status = Status::Closed;
                }
                return;
            }
            StepOutcome::Stopped => {
                self.stopped = true;
                self.note(
                    "note",
                    "The run was stopped.",
                    "Look at the cell. When it is safe, bring the arm home, then continue with the present step.",
                    now,
                );
            }
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
                self.note("note", "The arm is at home.", "", now);
                return;
            }
            StepOutcome::NotHome => {
                let text = format!("The arm did not go home: {}", result.reason);
                self.note("refusal", text, advice(&result.reason), now);
                return;
            }
            StepOutcome::Placed
            | StepOutcome::NoContact
            | StepOutcome::GraspFailed
            | StepOutcome::Dropped
            | StepOutcome::LagAborted => {}
        }
        let Some(offered) = self.offered(id) else {
            return;
        };
        if !result.arm_moved() {
            offered.status = Status::Closed;
            return;
        }
        offered.status = Status::Moved {
            fault: result.outcome == StepOutcome::Fault,
        };
        let proposal = offered.proposal.clone();
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
        self.unanswered.take_if(|asked| asked.proposal_id == id);
        match kind {
            // The question is still open.
            Some(RefusalKind::Unknown) => {
                if let Some(offered) = self.offered(id)
                    && let Status::Confirmed { fault } = offered.status
                {
                    offered.status = Status::Moved { fault };
                }
            }
            Some(RefusalKind::Stopped) => {
                self.stopped = self.goal.as_ref().is_some_and(|goal| !goal.complete);
            }
            _ => {}
        }
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
