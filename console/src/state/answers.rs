//! What the graph has answered to what the operator has asked for.

use std::path::Path;
use std::time::Duration;

use step_protocol::{ProposalId, RECOVERY_TIMEOUT, Recovery, RefusalReason};

use super::home::no_recovery;
use super::{PolicyState, State};
use crate::refusal::Refusal;

/// What a service has answered: something, or why not.
pub type Answer<T> = Result<T, String>;

impl State {
    /// Whether a recovery is to be called again, which was first called at `begun`: the executor has refused it only because it has not
    /// heard yet that the operator is present. The call and what is said of the operator come by different ways.
    pub fn repeats_recovery<T>(&self, answer: &Answer<T>, begun: Duration, now: Duration) -> bool {
        let is_present = self
            .sessions
            .presence(now)
            .is_some_and(|(_, present)| present);
        let reason = answer
            .as_ref()
            .err()
            .map(|text| RefusalReason::of_text(text));
        let is_unheard = is_present && reason == Some(RefusalReason::NobodyPresent);
        is_unheard && now.saturating_sub(begun) < RECOVERY_TIMEOUT
    }

    /// The executor has proposed a recovery, which needs an approval or not; or it says why there is none.
    pub fn on_recovery_answer(
        &mut self,
        recovery: Recovery,
        answer: Answer<(ProposalId, bool)>,
        now: Duration,
    ) {
        match answer {
            Ok((proposal_id, needs_approval)) => {
                self.on_recovery(recovery, proposal_id, needs_approval);
            }
            Err(reason) => self.refuse(no_recovery(recovery, &reason), now),
        }
    }

    /// The goal oracle goes on with the step that it was asked for.
    pub fn on_set_step_answer(&mut self, answer: Answer<()>, now: Duration) {
        match answer {
            Ok(()) => self.run.on_continued(),
            Err(reason) => {
                let reason = format!("The run did not continue: {reason}");
                let advice = "Look whether the goal oracle is at work.";
                self.refuse(Refusal::new(reason, advice), now);
            }
        }
    }

    /// The goal oracle has loaded a demonstration of the library, and says what it repeats. `goals`: the demonstration's name in
    /// the goals, where it could be read.
    pub fn on_load_answer(
        &mut self,
        demonstration: String,
        goals: Option<String>,
        answer: Answer<String>,
        now: Duration,
    ) {
        match answer {
            Ok(repeated) => {
                if let Some(goals) = goals {
                    self.on_loaded(demonstration, goals);
                }
                let text = format!("The run repeats {repeated}.");
                self.run.note("note", text, "", now);
            }
            Err(reason) => {
                let reason = format!("The demonstration was not loaded: {reason}");
                let advice =
                    "Choose another demonstration, or look whether the goal oracle is at work.";
                self.refuse(Refusal::new(reason, advice), now);
            }
        }
    }

    /// The policy uses the checkpoint at `path` from now on, and says which one it used before.
    pub fn on_checkpoint_answer(
        &mut self,
        path: &Path,
        answer: Answer<PolicyState>,
        now: Duration,
    ) {
        match answer {
            Ok(policy) => {
                let shown = path.file_stem().unwrap_or_default().to_string_lossy();
                let text = format!("The policy uses {shown} from its next proposal on.");
                self.run.note("note", text, "", now);
                self.policy = Some(policy);
            }
            Err(reason) => {
                let reason = format!("The policy has kept its checkpoint: {reason}.");
                let advice = "Choose another checkpoint, or look whether the policy is at work.";
                self.refuse(Refusal::new(reason, advice), now);
            }
        }
    }

    /// Something of the library was written, or not.
    pub(crate) fn on_written(&mut self, what: &str, written: Result<(), String>, now: Duration) {
        match written {
            Ok(()) => self.library_changed(),
            Err(error) => {
                let reason =
                    format!("What was learned from the run was not kept ({what}): {error}");
                let advice = "Look at the parameter library and at the disk.";
                self.run.note("fault", reason, advice, now);
            }
        }
    }

    fn refuse(&mut self, Refusal { reason, advice }: Refusal, now: Duration) {
        self.run.note("refusal", reason, advice, now);
    }
}
