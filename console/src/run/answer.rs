//! What becomes of a decision: one that nobody has heard is asked for again, never lost in silence.

use std::time::Duration;

use step_protocol::ProposalId;

use super::{Decision, Run, Status};

/// The executor says in this time that it carries an approved proposal out, and the oracle what the next goal is.
const ANSWERED_WITHIN: Duration = Duration::from_secs(5);

/// A decision that nothing has come of yet.
#[derive(Debug)]
pub(super) struct Unanswered {
    pub(super) proposal_id: ProposalId,
    pub(super) decision: Decision,
    /// Where the proposal stood before it.
    pub(super) before: Status,
    pub(super) since: Duration,
}

impl Run {
    /// Opens the question again where the newest decision was not heard. Returns whether it was not.
    pub fn ask_again(&mut self, now: Duration) -> bool {
        let Some(asked) = &self.unanswered else {
            return false;
        };
        let is_late = now.saturating_sub(asked.since) > ANSWERED_WITHIN;
        if !is_late || self.is_carried_out(asked, now) {
            return false;
        }
        let Some(Unanswered {
            proposal_id,
            decision,
            before,
            ..
        }) = self.unanswered.take()
        else {
            return false;
        };
        if self.newest == Some(proposal_id)
            && let Some(offered) = self.offered(proposal_id)
        {
            offered.status = before;
        }
        let (who, what) = match decision {
            Decision::Approve => ("executor", "approval"),
            Decision::Reject => ("goal oracle", "rejection"),
            _ => ("goal oracle", "decision on the step"),
        };
        let reason = format!("The {who} has not answered the {what}: it may have been lost.");
        let advice = format!("Look whether the {who} is at work, then decide again.");
        self.note("refusal", reason, advice, now);
        true
    }

    /// Whether the executor carries an approved proposal out, or does not say.
    fn is_carried_out(&self, asked: &Unanswered, now: Duration) -> bool {
        if asked.decision != Decision::Approve {
            return false;
        }
        let health = self.health.get(&self.watch.executor);
        let moving = health
            .filter(|health| now.saturating_sub(health.heard) <= self.watch.stale_after)
            .and_then(|health| health.states.get("motion"));
        moving.is_none_or(|(_, message)| {
            *message == format!("carries out proposal {}", asked.proposal_id)
        })
    }
}
