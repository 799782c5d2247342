//! Where planted faults act.

use pick_place::Robot as _;
use step_protocol::{
    ExecutorAction, MotionOrder, OperatorDecision, Proposal, ProposalId, ProposalStatus,
    StepOutcome,
};
use ur_driver::RunningMotion;
use ur_driver::planted::{Planted, is_planted};

use super::ActiveNode;

/// What planted faults remember.
#[derive(Debug, Default)]
pub(super) struct Memory {
    proposals: Vec<Proposal>,
    begins_again: Option<Proposal>,
}

impl ActiveNode<'_> {
    /// A proposal has arrived that can be approved.
    pub(super) fn plant_at_proposal(&mut self) {
        let Some(proposal) = self.configured.protocol.pending().cloned() else {
            return;
        };
        let id = proposal.id;
        self.planted.proposals.push(proposal);
        if is_planted(Planted::MovesUnapproved) {
            self.confirm(id, OperatorDecision::Approve, self.first_operator());
        }
    }

    /// A confirmation has arrived; whether it is to count no more.
    pub(super) fn plant_at_confirmation(
        &mut self,
        id: ProposalId,
        decision: OperatorDecision,
    ) -> bool {
        let newest = self.planted.proposals.last().map(|newest| newest.id);
        let is_newest = newest == Some(id);
        match decision {
            OperatorDecision::Approve if is_planted(Planted::AnyApproval) && !is_newest => {
                if let Some(newest) = newest {
                    self.confirm(newest, decision, self.first_operator());
                }
                true
            }
            OperatorDecision::Approve
                if self.motion.is_none()
                    && self.configured.protocol.status(id) != Some(ProposalStatus::Pending)
                    && (is_planted(Planted::ApprovesTwice) && is_newest
                        || is_planted(Planted::ApprovesSuperseded) && !is_newest) =>
            {
                let mut known = self.planted.proposals.iter();
                match known.find(|known| known.id == id).cloned() {
                    Some(proposal) => {
                        self.begin_again(proposal);
                        true
                    }
                    None => false,
                }
            }
            OperatorDecision::Stop if is_planted(Planted::IgnoresStopOfAnother) => !is_newest,
            OperatorDecision::Stop => is_planted(Planted::IgnoresStop),
            _ => false,
        }
    }

    /// A motion has ended.
    pub(super) fn plant_at_end(&mut self, outcome: Option<StepOutcome>) {
        let newest = self.planted.proposals.last().cloned();
        match outcome {
            Some(StepOutcome::Stopped) if is_planted(Planted::GoesOnAfterStop) => {
                newest
                    .into_iter()
                    .for_each(|newest| self.begin_again(newest));
            }
            Some(StepOutcome::Fault) if is_planted(Planted::GoesOnAfterFault) => {
                self.planted.begins_again = newest;
            }
            Some(StepOutcome::Stopped) if is_planted(Planted::DropsOnStop) => {
                // Nobody waits for it.
                RunningMotion::begin(&self.node, &self.configured.driver, |robot, _| {
                    let _ = robot.set_suction(false);
                    Ok(None)
                });
            }
            _ => {}
        }
    }

    /// Now and then.
    pub(super) fn plant_now_and_then(&mut self) {
        if self.configured.driver.unready().is_none()
            && self.motion.is_none()
            && let Some(proposal) = self.planted.begins_again.take()
        {
            self.begin_again(proposal);
        }
    }

    /// Moves past the gate.
    fn begin_again(&mut self, proposal: Proposal) {
        let order = MotionOrder::Proposal(Box::new(proposal));
        self.configured.protocol.on_motion_begin(order.cause());
        self.keep_stop();
        self.begin(order);
    }
}

/// How the motion ended of whose end these actions speak.
pub(super) fn outcome(actions: &[ExecutorAction]) -> Option<StepOutcome> {
    actions.iter().find_map(|action| match action {
        ExecutorAction::Say(said) if said.motion.is_some() => Some(said.report.outcome),
        _ => None,
    })
}
