//! What is kept on disk of runs: how repetitions of tasks went, and the operator's corrections that succeeded.

use std::time::Duration;

use step_protocol::{Goal, ProposalId};

use super::{Command, State};
use crate::history::RunEvent;
use crate::run::InvalidMessage;

/// A demonstration of the library is repeated.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Repetition {
    /// Its name in the library.
    demonstration: String,
    /// Its name in the goals.
    goals: String,
    /// Names the run, once the policy's first motion was carried out.
    run: Option<u64>,
    /// A goal of it has come.
    is_seen: bool,
}

impl State {
    /// The goal oracle has loaded a demonstration of the library.
    pub fn on_loaded(&mut self, demonstration: String, goals: String) {
        let goal = self.run.goal();
        let is_seen = goal.is_some_and(|goal| goal.demonstration == goals && !goal.complete);
        self.repetition = Some(Repetition {
            demonstration,
            goals,
            run: None,
            is_seen,
        });
    }

    /// A run that was begun before the console was started goes on.
    pub fn resume_run(&mut self, event: RunEvent) {
        if let RunEvent::Began {
            run,
            demonstration,
            goals,
            ..
        } = event
        {
            self.repetition = Some(Repetition {
                demonstration,
                goals,
                run: Some(run),
                is_seen: false,
            });
        }
    }

    /// A goal has been latched.
    ///
    /// # Errors
    /// When there is no such step.
    pub fn on_goal(&mut self, goal: Goal, now: Duration) -> Result<(), InvalidMessage> {
        self.run.on_goal(goal, now)?;
        let (Some(repetition), Some(goal)) = (&mut self.repetition, self.run.goal()) else {
            return Ok(());
        };
        if goal.demonstration != repetition.goals {
            // Another one was loaded; or this one is loaded, and its first goal has not come.
            if repetition.is_seen || repetition.run.is_some() {
                self.repetition = None;
            }
            return Ok(());
        }
        repetition.is_seen |= !goal.complete;
        if goal.complete
            && let Some(run) = repetition.run
        {
            self.repetition = None;
            self.record(RunEvent::Completed { run });
        }
        Ok(())
    }

    /// A motion was carried out: the policy's first one begins the run.
    pub(super) fn count_run(&mut self, proposal_id: ProposalId) {
        let (Some(proposal), Some(goal)) = (self.run.proposal(proposal_id), self.run.goal()) else {
            return;
        };
        let Some(repetition) = &mut self.repetition else {
            return;
        };
        let is_policys = !proposal.checkpoint.is_empty();
        if repetition.run.is_none() && is_policys && goal.demonstration == repetition.goals {
            repetition.run = Some(proposal_id.0);
            let began = RunEvent::Began {
                run: proposal_id.0,
                demonstration: repetition.demonstration.clone(),
                goals: repetition.goals.clone(),
                checkpoint: proposal.checkpoint.clone(),
            };
            self.record(began);
        }
    }

    fn record(&self, event: RunEvent) {
        // While the console is inactive no run goes on.
        let _ = self.send(Command::Record(event));
    }

    /// Keeps corrections that the operator has confirmed, once what they have led to is in view.
    pub(super) fn keep_corrections(&mut self) {
        for correction in self.run.take_corrections() {
            let _ = self.send(Command::Keep(Box::new(correction)));
        }
    }

    /// What is in the library has changed.
    pub fn library_changed(&mut self) {
        self.library_version += 1;
    }
}
