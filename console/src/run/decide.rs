//! How far the run is, and which decisions would be taken now.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use step_protocol::{OperatorDecision, RunPhase};

use super::Run;
use super::outcome::sentence;
use super::view::TableChange;
use crate::refusal::{Refusal, advice_on};

/// What an operator decides, as the API names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Decision {
    /// Carry the proposal out.
    Approve,
    /// Do not; propose something else.
    Reject,
    /// The step succeeded: go on with the next one.
    Advance,
    /// The step failed: try it again.
    Retry,
    /// Stop what moves, and end the run.
    Stop,
}

impl Decision {
    /// All of them.
    pub const ALL: [Self; 5] = [
        Self::Approve,
        Self::Reject,
        Self::Advance,
        Self::Retry,
        Self::Stop,
    ];

    /// The decision that the page offers; a step back is none.
    pub(super) fn of(decision: OperatorDecision) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|known| OperatorDecision::from(*known) == decision)
    }
}

impl From<Decision> for OperatorDecision {
    fn from(decision: Decision) -> Self {
        match decision {
            Decision::Approve => Self::Approve,
            Decision::Reject => Self::Reject,
            Decision::Advance => Self::Advance,
            Decision::Retry => Self::Retry,
            Decision::Stop => Self::Stop,
        }
    }
}

impl Run {
    /// Whether a decision would be taken now; else why not.
    ///
    /// # Errors
    /// The words for the operator.
    pub fn check(&self, decision: Decision, now: Duration) -> Result<(), Refusal> {
        let phase = self.phase();
        let allowed = match decision {
            Decision::Approve | Decision::Reject => phase == RunPhase::Proposed,
            Decision::Advance | Decision::Retry => {
                matches!(phase, RunPhase::AwaitingConfirmation | RunPhase::Fault)
            }
            Decision::Stop => !matches!(phase, RunPhase::Complete | RunPhase::NoGoal),
        };
        if !allowed {
            return Err(out_of_phase(phase));
        }
        if decision == Decision::Approve
            && let Some(refusal) = self.staleness(now).or_else(|| self.unplanned())
        {
            return Err(refusal);
        }
        Ok(())
    }

    /// Why what is shown may not be what is there.
    pub(super) fn staleness(&self, now: Duration) -> Option<Refusal> {
        self.obstacle(now).or_else(|| self.change())
    }

    /// Why the present proposal cannot be approved yet, or not at all: an executor that has not planned it does not know it, and
    /// an approval would be lost.
    fn unplanned(&self) -> Option<Refusal> {
        let Some(motion) = self.motion() else {
            return Some(Refusal::new(
                "The executor has not planned the motion yet.",
                "Wait a moment. If it stays so, look whether suction_executor is active.",
            ));
        };
        let reason = &motion.reason;
        (!reason.is_empty()).then(|| {
            Refusal::new(
                format!("The motion cannot be planned: {}", sentence(reason)),
                advice_on(reason),
            )
        })
    }

    /// Why the present proposal is stale: the table has changed since the heightmap that it was made from.
    fn change(&self) -> Option<Refusal> {
        let reason = match self.present_change()? {
            TableChange::Blob(change) => format!(
                "The proposal is stale: the table has changed about ({:.3}, {:.3}) m since the picture that it was made from.",
                change.center_m.x, change.center_m.y
            ),
            TableChange::Workspace => {
                "The proposal is stale: the picture that it was made from shows another workspace."
                    .to_owned()
            }
        };
        Some(Refusal::new(reason, "Wait for the new proposal."))
    }

    /// Why nothing can be approved: something is stale, or the robot is not ready.
    pub(crate) fn obstacle(&self, now: Duration) -> Option<Refusal> {
        let executor = self.watch.executor.trim_start_matches('/');
        for stream in self.streams(now) {
            if stream.required && stream.stale {
                if stream.name == executor && stream.age_s.is_none() {
                    return Some(Refusal::new(
                        format!("No executor is there: nothing has come from {executor} yet."),
                        "Start it, or wait until it is ready; the buttons come back by themselves.",
                    ));
                }
                let reason = match stream.age_s {
                    Some(age_s) => format!(
                        "{} is stale: the newest is {age_s:.1} s old, expected at most {:.1} s.",
                        stream.name,
                        self.watch.stale_after.as_secs_f64()
                    ),
                    None => format!("Nothing has come from {} yet.", stream.name),
                };
                return Some(Refusal::new(
                    reason,
                    "What you see may not be what is there. Look at that node or camera; the buttons come back by themselves.",
                ));
            }
        }
        let executor = self.health.get(&self.watch.executor)?;
        let (_, message) = executor.states.get("driver")?;
        (message != "ready").then(|| {
            Refusal::new(
                format!("The robot is not ready: {}", sentence(message)),
                advice_on(message),
            )
        })
    }

    pub(super) fn headline(&self, phase: RunPhase) -> (String, &'static str) {
        let step = match self.goal() {
            Some(goal) if goal.attempt > 0 => format!(
                "Step {} of {}, attempt {}",
                goal.step,
                goal.step_count,
                goal.attempt + 1
            ),
            Some(goal) => format!("Step {} of {}", goal.step, goal.step_count),
            None => String::new(),
        };
        match phase {
            RunPhase::NoGoal => (
                "No goal yet".into(),
                "The goal oracle has no demonstration. Load one, or start it with one.",
            ),
            RunPhase::AwaitingProposal => (
                format!("{step}: waiting for a proposal"),
                "The policy looks at the table.",
            ),
            RunPhase::Proposed => (
                format!("{step}: the policy proposes a move"),
                "Look at pick and place in the picture. Approve it if it brings the table closer to the goal, else reject it.",
            ),
            RunPhase::Moving => (
                format!("{step}: the arm moves"),
                "Watch the cell. Stop if anything is wrong.",
            ),
            RunPhase::AwaitingConfirmation => (
                format!("{step}: did it succeed?"),
                "Compare the present view with the goal. Next step if it succeeded, try again if not.",
            ),
            RunPhase::Fault => (
                format!("{step}: the robot broke the motion off"),
                "Look at the cell. When it is safe, bring the arm home, then try the step again.",
            ),
            RunPhase::Stopped => (
                format!("{step}: stopped"),
                "Look at the cell. When it is safe, bring the arm home, then continue.",
            ),
            RunPhase::Complete => ("All steps are done".into(), "Nothing is left to do."),
        }
    }
}

pub(super) fn out_of_phase(phase: RunPhase) -> Refusal {
    let (reason, advice) = match phase {
        RunPhase::NoGoal => ("There is no goal.", "Load a demonstration first."),
        RunPhase::AwaitingProposal => (
            "There is no proposal to decide on.",
            "Wait for the policy's next proposal.",
        ),
        RunPhase::Proposed => (
            "The proposal has not been carried out.",
            "Approve it or reject it first.",
        ),
        RunPhase::Moving => ("The arm is moving.", "Wait until it is back, or stop it."),
        RunPhase::AwaitingConfirmation => (
            "The proposal was already carried out.",
            "Say whether the step succeeded.",
        ),
        RunPhase::Fault => (
            "The robot broke the motion off.",
            "Bring the arm home, then try the step again.",
        ),
        RunPhase::Stopped => (
            "The run is stopped.",
            "Continue the run with the present step.",
        ),
        RunPhase::Complete => ("All steps are done.", "Nothing is left to do."),
    };
    Refusal::new(reason, advice)
}
