//! Where planted faults act.

use std::sync::Arc;

use pick_place::Robot as _;
use step_protocol::{OperatorDecision, Proposal, ProposalId, ProposalStatus, StepOutcome};
use tokio_util::sync::CancellationToken;
use ur_driver::DriverRobot;
use ur_driver::planted::{Planted, is_planted};

use super::Executor;

/// What planted faults remember.
#[derive(Debug, Default)]
pub(super) struct Memory {
    proposals: Vec<Proposal>,
    begins_again: Option<Proposal>,
}

impl Executor<'_> {
    /// A proposal has arrived that can be approved.
    pub(super) fn plant_at_proposal(&mut self) {
        let Some(proposal) = self.gate.pending().cloned() else {
            return;
        };
        let id = proposal.id;
        self.planted.proposals.push(proposal);
        if is_planted(Planted::MovesUnapproved) {
            self.confirm(id, OperatorDecision::Approve);
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
                    self.confirm(newest, decision);
                }
                true
            }
            OperatorDecision::Approve
                if self.motion.is_none()
                    && self.gate.status(id) != Some(ProposalStatus::Pending)
                    && (is_planted(Planted::ApprovesTwice) && is_newest
                        || is_planted(Planted::ApprovesSuperseded) && !is_newest) =>
            {
                let mut known = self.planted.proposals.iter();
                match known.find(|known| known.id == id).cloned() {
                    Some(proposal) => {
                        self.begin(proposal);
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
    pub(super) fn plant_at_end(&mut self, outcome: StepOutcome) {
        let newest = self.planted.proposals.last().cloned();
        match outcome {
            StepOutcome::Stopped if is_planted(Planted::GoesOnAfterStop) => {
                newest.into_iter().for_each(|newest| self.begin(newest));
            }
            StepOutcome::Fault if is_planted(Planted::GoesOnAfterFault) => {
                self.planted.begins_again = newest;
            }
            StepOutcome::Stopped if is_planted(Planted::DropsOnStop) => {
                let (driver, runtime) =
                    (Arc::clone(&self.driver), tokio::runtime::Handle::current());
                let mut robot = DriverRobot::new(driver, runtime, CancellationToken::new());
                self.node.spawn_blocking(move || robot.set_suction(false));
            }
            _ => {}
        }
    }

    /// Now and then.
    pub(super) fn plant_now_and_then(&mut self) {
        if self.driver.unready().is_none()
            && self.motion.is_none()
            && let Some(proposal) = self.planted.begins_again.take()
        {
            self.begin(proposal);
        }
    }
}
