//! Proposals and the operator's confirmations.

use msgs::{convert, sctn_msgs};
use step_protocol::{
    GateAction, Judgement, OperatorDecision, Proposal, ProposalId, Proposed, StopCause,
};
use tracing::info;
use ur_driver::planted::{Planted, is_planted};

use super::Executor;

impl Executor<'_> {
    pub(super) fn on_proposal(&mut self, message: sctn_msgs::PickPlace) {
        let id = ProposalId(message.id);
        match self.gate.on_proposal(id, read_proposal(&message)) {
            Proposed::Pending => {
                info!("proposal {id}");
                #[cfg(feature = "planted_faults")]
                self.plant_at_proposal();
                self.rehearse_next();
                if self.gate.moves_unasked(id) {
                    self.confirm(id, OperatorDecision::Approve);
                }
            }
            Proposed::Repeated => {}
            Proposed::Invalid(reason) => {
                self.proposals.reject(&reason);
                // Who looks at it sees why it cannot be approved.
                self.publish_plan(Err(reason.to_string()), id);
                if self.gate.is_automatic() {
                    self.report(self.refusal(id, reason.to_string()), None);
                }
            }
        }
        self.look_after_goal();
        self.ask_again();
    }

    pub(super) fn on_confirmation(&mut self, message: sctn_msgs::StepConfirmation) {
        // DDS may deliver messages of several topics in another order than they were sent: take what has arrived first.
        while let Some(heightmap) = self.heightmaps.try_recv() {
            self.on_heightmap(heightmap);
        }
        while let Some(proposal) = self.proposals.try_recv() {
            self.on_proposal(proposal);
        }
        let id = ProposalId(message.proposal_id);
        let decision = match convert::confirmation_from_msg(&message) {
            Ok(confirmation) => confirmation.decision,
            Err(refusal) => {
                self.confirmations.reject(refusal);
                self.report(self.refusal(id, refusal.to_string()), None);
                return;
            }
        };
        if Judgement::from_decision(decision).is_some() {
            // For the goal oracle.
            return;
        }
        info!(
            "{} of proposal {id} by `{}`",
            decision.name(),
            message.operator_name
        );
        #[cfg(feature = "planted_faults")]
        if self.plant_at_confirmation(id, decision) {
            return;
        }
        if let Err(refusal) = self
            .gate
            .check_operator(id, decision, &message.operator_name)
            && !is_planted(Planted::AnyOperator)
        {
            self.report(self.refusal(id, refusal.to_string()), None);
            return;
        }
        self.confirm(id, decision);
    }

    pub(super) fn confirm(&mut self, id: ProposalId, decision: OperatorDecision) {
        if decision == OperatorDecision::Stop {
            self.stop_memory
                .remember(&format!("{} of proposal {id}", decision.name()));
        }
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let actions = self.gate.on_confirmation(id, decision, &robot, now);
        self.act(actions);
        self.rehearse_next();
    }

    /// Confirmations whose proposal or heightmap was still on its way.
    pub(super) fn ask_again(&mut self) {
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let actions = self.gate.on_news(&robot, now);
        self.act(actions);
    }

    pub(super) fn act(&mut self, actions: Vec<GateAction>) {
        for action in actions {
            match action {
                GateAction::Move(proposal) => self.begin(*proposal),
                GateAction::GoHome(id) => self.begin_home(id),
                GateAction::PutDown(id) => self.begin_put_down(id),
                GateAction::Cancel => {
                    if let Some(motion) = &mut self.motion {
                        motion.stop(StopCause::Operator);
                    }
                }
                GateAction::Report(report) => self.report(report, None),
            }
        }
        self.look_after_goal();
    }
}

/// Says what is wrong with a message and in which field.
pub(super) fn read_proposal(message: &sctn_msgs::PickPlace) -> Result<Proposal, String> {
    let id = message.id;
    convert::proposal_from_msg(message).map_err(|error| format!("proposal {id}: {error}"))
}
