//! What arrives, and what is done then.

use std::sync::Arc;
use std::time::Duration;

use msgs::sctn_msgs::ExecutePickPlaceFeedback;
use msgs::{convert, sctn_msgs};
use node_kit::{Level, NewGoal, RequestId};
use rehearsal::{Reading, Rehearsed, RobotNow, Subject};
use step_protocol::{
    ExecutorAction, Judgement, MotionOrder, MotionTimes, OperatorDecision, Proposal, ProposalId,
    Proposed, Recovery,
};
use tokio::task::JoinError;
use tracing::{info, warn};
use ur_driver::planted::{Planted, is_planted};
use ur_driver::{DriverError, MotionEvent, RunningMotion};

use super::ActiveNode;

impl ActiveNode<'_> {
    pub(super) fn on_heightmap(&mut self, message: sctn_msgs::Heightmap) {
        let frame_id = &message.header.frame_id;
        let expected = &self.configured.parameters.world_frame;
        if frame_id != expected {
            self.heightmaps.reject(format_args!(
                "header.frame_id is `{frame_id}`, expected `{expected}`"
            ));
            return;
        }
        match convert::observation_from_msg(message) {
            Ok(seen) => {
                let at_home = self.configured.driver.status.borrow().at_home;
                let (publishers, stamp) = (self.publishers(), seen.stamp);
                let heightmap = &seen.heightmap;
                self.rehearsals
                    .on_heightmap(stamp, heightmap, publishers, &at_home);
                let protocol = &mut self.configured.protocol;
                protocol.on_heightmap(stamp, seen.heightmap);
                if self.rehearsals.was_unseen() {
                    self.rehearse_next();
                }
                self.on_time();
            }
            Err(error) => self.heightmaps.reject(error),
        }
    }

    pub(super) fn on_proposal(&mut self, message: sctn_msgs::PickPlace) {
        let id = ProposalId(message.id);
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let protocol = &mut self.configured.protocol;
        let (proposed, actions) = protocol.on_proposal(id, read_proposal(&message), &robot, now);
        match proposed {
            Proposed::Pending => {
                info!("proposal {id}");
                #[cfg(feature = "planted_faults")]
                self.plant_at_proposal();
                self.rehearse_next();
            }
            Proposed::Repeated => {}
            Proposed::Invalid(reason) => {
                self.proposals.reject(&reason);
                // Who looks at it sees why it cannot be approved.
                self.publish_plan(Err(&reason.to_string()), id);
            }
        }
        self.act(actions);
    }

    pub(super) fn on_goal(&mut self, new: NewGoal<sctn_msgs::ExecutePickPlace>) {
        let id = ProposalId(new.goal.proposal.id);
        let proposal = read_proposal(&new.goal.proposal);
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let protocol = &mut self.configured.protocol;
        match protocol.on_goal(id, proposal, &robot, now) {
            Ok(actions) => {
                info!("proposal {id}: a goal of the action");
                let (goal, running) = new.accept();
                // Before anything is asked about it or done for it.
                self.configured.accepted.publish(goal.proposal);
                self.goal = Some(running);
                self.act(actions);
                self.rehearse_next();
            }
            Err(said) => {
                new.reject(&said.report.reason);
                self.publish_result(said);
            }
        }
    }

    pub(super) fn on_goal_cancel(&mut self) {
        let protocol = &mut self.configured.protocol;
        if let Some(goal) = protocol.goal() {
            info!("proposal {}: its goal is cancelled", goal.id);
        }
        let actions = protocol.on_goal_cancel();
        self.act(actions);
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
                let protocol = &mut self.configured.protocol;
                let actions = protocol.refuse(id, refusal.to_string());
                return self.act(actions);
            }
        };
        if Judgement::from_decision(decision).is_some() {
            // For the goal oracle.
            return;
        }
        let name = message.operator_name;
        info!("{} of proposal {id} by `{name}`", decision.name());
        #[cfg(feature = "planted_faults")]
        if self.plant_at_confirmation(id, decision) {
            return;
        }
        self.confirm(id, decision, name);
    }

    pub(super) fn confirm(&mut self, id: ProposalId, decision: OperatorDecision, name: String) {
        let name = match is_planted(Planted::AnyOperator) {
            true => self.first_operator(),
            false => name,
        };
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let protocol = &mut self.configured.protocol;
        let actions = protocol.on_confirmation(id, decision, &name, &robot, now);
        self.act(actions);
        self.rehearse_next();
    }

    /// One who decides, for planted faults.
    pub(super) fn first_operator(&self) -> String {
        let operators = &self.configured.parameters.operators;
        operators.first().cloned().unwrap_or_default()
    }

    pub(super) fn on_presence(&mut self, message: &sctn_msgs::OperatorPresence) {
        let now = self.origin.elapsed();
        let protocol = &mut self.configured.protocol;
        let actions = protocol.on_presence(message.is_present, now);
        self.act(actions);
    }

    pub(super) fn on_time(&mut self) {
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let actions = self.configured.protocol.on_time(&robot, now);
        self.act(actions);
    }

    /// The robot as the gate sees it now.
    pub(super) fn robot(&self) -> RobotNow {
        let driver = &self.configured.driver;
        let obstacle = driver.obstacle_to_begin();
        let status = driver.status.borrow();
        self.rehearsals.robot(Reading {
            obstacle,
            joints_rad: status.joints.map(|joints| joints.value.positions_rad),
            holds: status.pins.map(|pins| pins.value.vacuum),
            at_home: status.at_home,
            time: self.time(),
            publishers: self.publishers(),
        })
    }

    /// How many publish heightmaps.
    fn publishers(&self) -> usize {
        self.node.graph().publishers(self.heightmaps.topic())
    }

    /// ROS time.
    pub(super) fn time(&self) -> Duration {
        self.node.clock().time()
    }

    pub(super) fn act(&mut self, actions: Vec<ExecutorAction>) {
        self.keep_stop();
        for action in actions {
            match action {
                ExecutorAction::Begin(order) => self.begin(order),
                ExecutorAction::Stop(cause) => {
                    if let Some(motion) = &self.motion {
                        warn!("{} while moving", cause.text());
                        motion.stop();
                    }
                }
                ExecutorAction::Say(said) => self.say(said),
                ExecutorAction::AwaitApproval(id) => {
                    self.feedback(id, ExecutePickPlaceFeedback::AWAITING_APPROVAL)
                }
            }
        }
    }

    /// What has stopped the executor, or that it moves, outlives this process.
    pub(super) fn keep_stop(&mut self) {
        let record = self.configured.protocol.stop_record();
        self.configured.stop_file.keep(record);
    }

    /// Moves the arm on a thread of its own.
    pub(super) fn begin(&mut self, order: MotionOrder) {
        let cause = order.cause();
        info!("proposal {}: the arm {}", cause.id(), cause.text());
        let driver = &self.configured.driver;
        let at_home = driver.status.borrow().at_home;
        self.rehearsals.on_motion(&order, &at_home);
        let robot_now = self.robot();
        let motion = RunningMotion::begin(&self.node, driver, move |robot, observe| {
            robot_now.carry_out(&order, robot, DriverError::Fault, observe)
        });
        self.motion = Some(motion);
    }

    pub(super) fn on_motion(&mut self, event: MotionEvent) {
        let (end, stamps) = match event {
            MotionEvent::Phase(phase) => {
                let cause = self.configured.protocol.moving();
                let id = cause.map(|cause| ("proposal_id", cause.id().to_string()));
                let diagnostics = self.node.diagnostics();
                diagnostics.set("motion", Level::Ok, format!("{phase:?}"), id);
                let goal = self.configured.protocol.goal();
                if let Some(goal) = goal.filter(|goal| goal.is_moving) {
                    self.feedback(goal.id, convert::phase_to_msg(phase));
                }
                return;
            }
            MotionEvent::Ended { end, stamps } => (end, stamps),
        };
        self.motion = None;
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let times = MotionTimes::new(stamps, self.time());
        let protocol = &mut self.configured.protocol;
        let actions = protocol.on_motion_end(end, times, &robot, now);
        #[cfg(feature = "planted_faults")]
        let outcome = super::planted::outcome(&actions);
        self.act(actions);
        #[cfg(feature = "planted_faults")]
        self.plant_at_end(outcome);
        self.rehearse_next();
    }

    /// Begins the next rehearsal that is due. None is while the arm moves: it would begin elsewhere.
    pub(super) fn rehearse_next(&mut self) {
        if self.motion.is_some() {
            return;
        }
        let robot = self.robot();
        let pending = self.configured.protocol.pending();
        if let Some(subject) = self.rehearsals.next(pending, &robot) {
            let task = self.node.spawn_blocking(move || robot.rehearse(subject));
            self.rehearsing = Some(task);
        }
    }

    pub(super) fn on_rehearsed(&mut self, rehearsed: Result<Rehearsed, JoinError>) {
        self.rehearsing = None;
        let rehearsed = match rehearsed {
            Ok(rehearsed) => Arc::new(rehearsed),
            Err(error) => {
                // A call is answered at the next tick, from what is known then.
                warn!("the thread of a rehearsal panicked: {error}");
                self.rehearsals.ended(None);
                return self.answer_calls(None);
            }
        };
        self.rehearsals.ended(Some(Arc::clone(&rehearsed)));
        let recovery = match &rehearsed.subject {
            Subject::Proposal(proposal) => {
                let pending = self.configured.protocol.pending();
                if pending.is_some_and(|pending| pending.id == proposal.id) {
                    self.publish_plan(rehearsed.planned.as_ref(), proposal.id);
                }
                None
            }
            Subject::Recovery(recovery) => Some(*recovery),
        };
        self.answer_calls(recovery);
        self.on_time();
        self.rehearse_next();
    }

    pub(super) fn on_recovery_call(&mut self, recovery: Recovery, call: RequestId) {
        self.rehearsals.call(recovery, call);
        self.answer_calls(None);
        self.rehearse_next();
    }

    fn answer_calls(&mut self, rehearsed: Option<Recovery>) {
        let robot = self.robot();
        let propose = |recovery| {
            let now = self.origin.elapsed();
            let new = ProposalId::of_recovery(robot.time, now, robot.joints_rad.as_ref());
            let protocol = &mut self.configured.protocol;
            protocol.propose_recovery(new, recovery, &robot, now)
        };
        for (recovery, call, answer) in self.rehearsals.answers(rehearsed, propose) {
            let response = match answer {
                Ok(proposed) => {
                    let id = proposed.id;
                    info!("proposal {id}: {recovery:?}");
                    if let Some(rehearsed) = self.rehearsals.recovery() {
                        self.publish_plan(rehearsed.planned.as_ref(), id);
                    }
                    self.act(proposed.actions);
                    let is_planted = is_planted(Planted::HomeUnasked);
                    if is_planted {
                        self.confirm(id, OperatorDecision::Approve, self.first_operator());
                    }
                    sctn_msgs::ProposeHomeResponse {
                        success: true,
                        message: String::new(),
                        proposal_id: id.0,
                        needs_approval: proposed.needs_approval && !is_planted,
                    }
                }
                Err(reason) => {
                    warn!("{recovery:?}: {reason}");
                    sctn_msgs::ProposeHomeResponse {
                        success: false,
                        message: reason,
                        ..Default::default()
                    }
                }
            };
            match recovery {
                Recovery::Home => self.home.respond(call, response),
                Recovery::PutDown => self.put_down.respond(call, response),
            }
        }
    }
}

/// Says what is wrong with a message and in which field.
fn read_proposal(message: &sctn_msgs::PickPlace) -> Result<Proposal, String> {
    let id = message.id;
    convert::proposal_from_msg(message).map_err(|error| format!("proposal {id}: {error}"))
}
