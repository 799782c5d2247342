//! A proposal as a goal of the action.

use msgs::sctn_msgs::{self, ExecutePickPlace, ExecutePickPlaceFeedback, ExecutePickPlaceResult};
use msgs::{convert, std_msgs};
use node_kit::{NewGoal, RunningGoal};
use pick_place::Phase;
use step_protocol::{OperatorDecision, ProposalId, Proposed, Report, StepOutcome, StopCause};
use tracing::info;

use super::Executor;
use super::proposals::read_proposal;

/// A goal of the action, from its acceptance to its end.
pub(super) struct Goal {
    /// Its proposal.
    pub(super) id: ProposalId,
    pub(super) running: RunningGoal<ExecutePickPlace>,
    pub(super) moving: bool,
    pub(super) cancelling: bool,
}

impl Executor<'_> {
    /// A goal of the action is a proposal whose way its client follows; it goes through the same gate.
    pub(super) fn on_goal(&mut self, new: NewGoal<ExecutePickPlace>) {
        let id = ProposalId(new.goal.proposal.id);
        let busy = match (&self.goal, &self.motion) {
            (Some(goal), _) => Some(format!("a goal for proposal {} is active", goal.id)),
            (None, Some(motion)) => Some(motion.cause.busy_text()),
            (None, None) => None,
        };
        let pending = match busy {
            Some(busy) => Err(busy),
            None => {
                let proposal = read_proposal(&new.goal.proposal);
                let proposed = self.gate.on_proposal(id, proposal);
                if matches!(proposed, Proposed::Pending) {
                    self.rehearse_next();
                }
                match proposed {
                    Proposed::Invalid(reason) => Err(reason.to_string()),
                    Proposed::Pending | Proposed::Repeated => self
                        .gate
                        .check_pending(id)
                        .map_err(|refusal| refusal.to_string()),
                }
            }
        };
        if let Err(reason) = pending {
            let reason = format!("goal for proposal {id} rejected: {reason}");
            new.reject(&reason);
            let refusal = self.result(self.refusal(id, reason), None);
            self.results.publish(refusal);
            return;
        }
        info!("proposal {id}: a goal of the action");
        let (goal, running) = new.accept();
        // Before anything is asked about it or done for it.
        self.accepted.publish(goal.proposal);
        self.goal = Some(Goal {
            id,
            running,
            moving: false,
            cancelling: false,
        });
        if self.gate.moves_unasked(id) {
            self.confirm(id, OperatorDecision::Approve);
        } else {
            self.feedback(ExecutePickPlaceFeedback::AWAITING_APPROVAL);
        }
        self.ask_again();
    }

    pub(super) fn on_goal_cancel(&mut self) {
        let Some(goal) = &mut self.goal else {
            return;
        };
        goal.cancelling = true;
        let (id, moving) = (goal.id, goal.moving);
        info!("proposal {id}: its goal is cancelled");
        match &mut self.motion {
            Some(motion) if moving => motion.stop(StopCause::GoalCancelled),
            _ => {
                self.gate.withdraw(id);
                let reason = "the goal was cancelled; nothing was moving".to_owned();
                let stopped = Report {
                    outcome: StepOutcome::Stopped,
                    ..self.refusal(id, reason)
                };
                self.report(stopped, None);
            }
        }
    }

    /// Ends a goal whose proposal can no longer be approved.
    pub(super) fn look_after_goal(&mut self) {
        if let Some(goal) = &self.goal
            && !goal.moving
            && let Err(refusal) = self.gate.check_pending(goal.id)
        {
            self.report(self.refusal(goal.id, refusal.to_string()), None);
        }
    }

    /// Ends the goal of a proposal with its result, if it has one and this is its end.
    pub(super) fn finish_goal(
        &mut self,
        outcome: StepOutcome,
        result: sctn_msgs::StepResult,
        moved: bool,
    ) {
        let id = ProposalId(result.proposal_id);
        let is_end = |goal: &mut Goal| goal.id == id && (moved || !goal.moving);
        let Some(goal) = self.goal.take_if(is_end) else {
            return;
        };
        // Nothing moves for a goal that has ended.
        self.gate.withdraw(goal.id);
        let cancelled = goal.running.is_cancel_requested();
        let result = ExecutePickPlaceResult { result };
        match outcome {
            StepOutcome::Placed => goal.running.succeed(result),
            StepOutcome::Stopped if cancelled => goal.running.cancelled(result),
            _ => goal.running.abort(result),
        }
    }

    pub(super) fn say_phase(&self, phase: Phase) {
        if self.goal.as_ref().is_some_and(|goal| goal.moving) {
            self.feedback(convert::phase_to_msg(phase));
        }
    }

    pub(super) fn feedback(&self, phase: u8) {
        if let Some(goal) = &self.goal {
            goal.running.feedback(ExecutePickPlaceFeedback {
                header: std_msgs::Header {
                    stamp: self.node.now(),
                    frame_id: self.parameters.world_frame.clone(),
                },
                proposal_id: goal.id.0,
                phase,
            });
        }
    }
}

/// Waits until the client of a goal wants it cancelled; says so once.
pub(super) async fn cancel_of(goal: &Option<Goal>) {
    match goal {
        Some(goal) if !goal.cancelling => goal.running.cancel_requested().await,
        _ => std::future::pending().await,
    }
}
