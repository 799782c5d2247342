//! Proposals and the operator's confirmations.

use msgs::{convert, sctn_msgs, std_msgs};
use step_protocol::{GateAction, Judgement, OperatorDecision, Proposal, ProposalId, Proposed};
use tracing::{info, warn};

use super::Executor;
use super::motion::StopCause;
use crate::dry_run::{PlannedPrimitive, planned_motion};

impl Executor<'_> {
    pub(super) fn on_proposal(&mut self, message: sctn_msgs::PickPlace) {
        let id = ProposalId(message.id);
        let proposal = read_proposal(&message);
        match self.gate.on_proposal(id, proposal.clone()) {
            Proposed::Pending => {
                info!("proposal {id}");
                #[cfg(feature = "planted_faults")]
                proposal
                    .iter()
                    .for_each(|proposal| self.plant_at_proposal(proposal.clone()));
                self.show_plan(proposal.ok());
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

    /// Publishes how a pending proposal would be carried out, or why it cannot be; in the latter case once more when it can.
    pub(super) fn show_plan(&mut self, proposal: Option<Proposal>) {
        let Some(proposal) = proposal else {
            return;
        };
        let planned = self.robot().dry_run(&proposal);
        let is_planned = planned.is_ok();
        self.publish_plan(planned, proposal.id);
        self.unplanned = (!is_planned).then_some(proposal);
    }

    /// The robot's state or a heightmap may have arrived since the last plan failed.
    pub(super) fn plan_again(&mut self) {
        let proposal = self.unplanned.take_if(|_| self.motion.is_none());
        let Some(proposal) = proposal else {
            return;
        };
        match self.robot().dry_run(&proposal) {
            Ok(planned) => self.publish_plan(Ok(planned), proposal.id),
            Err(_) => self.unplanned = Some(proposal),
        }
    }

    pub(super) fn publish_plan(&self, planned: Result<PlannedPrimitive, String>, id: ProposalId) {
        let header = std_msgs::Header {
            stamp: self.node.now(),
            frame_id: self.parameters.world_frame.clone(),
        };
        match planned_motion(planned, id.0, &self.work_cell.joint_names, header) {
            Ok(motion) => self.planned.publish(motion),
            Err(error) => warn!("the motion of proposal {id}: {error}"),
        }
    }

    pub(super) fn on_confirmation(&mut self, message: sctn_msgs::StepConfirmation) {
        // What was sent before it is to be known before it.
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
