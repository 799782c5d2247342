//! Topics in, motion and results out.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use heightmap::{ChangeRules, Heightmap};
use msgs::convert;
use msgs::sctn_msgs::{self, ExecutePickPlace, ExecutePickPlaceFeedback, ExecutePickPlaceResult};
use msgs::std_srvs::{Trigger, TriggerResponse};
use node_kit::{
    ActionServer, Active, Level, NewGoal, Node, Publisher, Qos, RequestId, RunningGoal,
    ServiceServer, Subscription,
};
use pick_place::{ExecuteError, Outcome, Phase};
use step_protocol::{
    ApprovalGate, GateAction, GateRules, OperatorDecision, Proposal, ProposalId, Proposed, Report,
    StepOutcome, StepResult,
};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::timeout_at;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use ur5::WorkCell;

use crate::driver::{DriverError, DriverRobot, Link};
use crate::home::go_home;
use crate::parameters::SuctionExecutorParameters;
use crate::presence::Presence;
use crate::rehearsal::{PlannedPrimitive, RobotNow, planned_motion};
use crate::status::DriverStatus;
use crate::stop_memory::StopMemory;
use crate::surface::touchdown;

/// Calls of `home` that are answered when the arm is there; more fail at once.
const WAITING_CALLS: usize = 16;
/// How long a motion may take to stop when the node is deactivated.
const STOP_GRACE: Duration = Duration::from_millis(1500);
/// How long the result of a motion that was stopped at the end takes to be sent.
const LAST_WORD: Duration = Duration::from_millis(100);
const DIAGNOSTICS_PERIOD: Duration = Duration::from_millis(500);

/// Loads the work cell and listens to the driver; returns the node that executes proposals.
pub async fn configure(
    node: Node,
    parameters: SuctionExecutorParameters,
) -> anyhow::Result<ExecutorNode> {
    let work_cell = match parameters.urdf.as_path() {
        path if path == Path::new("") => WorkCell::builtin(),
        path => WorkCell::load(path),
    }
    .context("parameter urdf")?;
    if let Some(warning) = work_cell.warning() {
        warn!("parameter urdf: {warning}");
    }
    let link = Link::new(&node, &parameters.driver, &work_cell)?;
    let mut gate = ApprovalGate::new(rules(&parameters));
    let stop_memory = StopMemory::new(parameters.stop_file.clone());
    if let Some(reason) = stop_memory.recall().context("parameter stop_file")? {
        warn!("stopped before this start: {reason}. Nothing moves by itself before an approval");
        gate.remember_stop();
    }
    Ok(ExecutorNode {
        results: node.publisher("step_result", Qos::Event)?,
        planned: node.publisher("planned_motion", Qos::Latched)?,
        gate,
        stop_memory,
        link: Arc::new(link),
        work_cell,
    })
}

fn rules(parameters: &SuctionExecutorParameters) -> GateRules {
    GateRules {
        frame: parameters.world_frame.clone(),
        limits: parameters.limits.settings(),
        changes: ChangeRules::new(
            parameters.observation_tolerance_m,
            1e-6 * parameters.observation_changed_area_mm2,
        ),
        confirmation_grace: Duration::from_secs_f64(parameters.confirmation_grace_s),
        require_approval: parameters.require_approval(),
    }
}

/// The configured node. What was used or stopped stays so while it is inactive.
pub struct ExecutorNode {
    results: Publisher<sctn_msgs::StepResult>,
    planned: Publisher<sctn_msgs::PlannedMotion>,
    gate: ApprovalGate,
    stop_memory: StopMemory,
    link: Arc<Link>,
    work_cell: WorkCell,
}

impl Active for ExecutorNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let _active = self.link.heartbeat.activate(node).await?;
        let parameters = node.parameters::<SuctionExecutorParameters>();
        let (phase_sender, phases) = mpsc::unbounded_channel();
        let executor = Executor {
            proposals: node.subscription("pick_place", Qos::Latched)?,
            confirmations: node.subscription("step_confirmation", Qos::Event)?,
            heightmaps: node.subscription("heightmap", Qos::Latched)?,
            presences: node.subscription("operator_presence", Qos::Event)?,
            presence: Presence::new(Duration::from_secs_f64(
                parameters.borrow().presence_timeout_s,
            )),
            results: &self.results,
            planned: &self.planned,
            unplanned: None,
            home: node.service_server("~/home")?,
            home_calls: Vec::new(),
            goals: node.action_server("execute_pick_place")?,
            goal: None,
            phase_sender,
            phases,
            gate: &mut self.gate,
            stop_memory: self.stop_memory.clone(),
            seen: None,
            motion: None,
            link: Arc::clone(&self.link),
            node: node.clone(),
            parameters: parameters.borrow().clone(),
            work_cell: self.work_cell.clone(),
            status: self.link.status.clone(),
            origin: self.link.origin,
        };
        executor.run(parameters).await
    }
}

/// What moves the arm.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Cause {
    /// An approved proposal.
    Proposal(ProposalId),
    /// A call of the service `home`.
    Home,
}

/// A primitive, or the way home, under way.
struct Motion {
    cause: Cause,
    stop: CancellationToken,
    task: JoinHandle<Ended>,
}

/// A goal of the action, from its acceptance to its end.
struct Goal {
    /// Its proposal.
    id: ProposalId,
    running: RunningGoal<ExecutePickPlace>,
    moving: bool,
    cancelling: bool,
}

/// How a motion ended.
struct Ended {
    /// Nothing at home without a primitive.
    result: Result<Option<Outcome>, ExecuteError<DriverError>>,
    /// Stamps of the first and the last joint reading.
    stamps: Option<(Duration, Duration)>,
}

struct Executor<'a> {
    node: Node,
    parameters: SuctionExecutorParameters,
    work_cell: WorkCell,
    proposals: Subscription<sctn_msgs::PickPlace>,
    confirmations: Subscription<sctn_msgs::StepConfirmation>,
    heightmaps: Subscription<sctn_msgs::Heightmap>,
    presences: Subscription<sctn_msgs::OperatorPresence>,
    presence: Presence,
    results: &'a Publisher<sctn_msgs::StepResult>,
    planned: &'a Publisher<sctn_msgs::PlannedMotion>,
    /// The pending proposal, while its motion could not be planned.
    unplanned: Option<Proposal>,
    home: ServiceServer<Trigger>,
    /// Calls of `home` to be answered when the arm is there.
    home_calls: Vec<RequestId>,
    goals: ActionServer<ExecutePickPlace>,
    goal: Option<Goal>,
    phase_sender: mpsc::UnboundedSender<Phase>,
    /// Phases of the motion under way.
    phases: mpsc::UnboundedReceiver<Phase>,
    gate: &'a mut ApprovalGate,
    stop_memory: StopMemory,
    /// The newest heightmap and its stamp.
    seen: Option<(Arc<Heightmap>, Duration)>,
    motion: Option<Motion>,
    link: Arc<Link>,
    status: watch::Receiver<DriverStatus>,
    origin: Instant,
}

impl Executor<'_> {
    async fn run(
        mut self,
        mut changes: watch::Receiver<SuctionExecutorParameters>,
    ) -> anyhow::Result<()> {
        let node = self.node.clone();
        let mut diagnostics = tokio::time::interval(DIAGNOSTICS_PERIOD);
        loop {
            let deadline = self.gate.deadline().map(|deadline| self.origin + deadline);
            let absence = self.absence();
            tokio::select! {
                message = self.heightmaps.recv() => self.on_heightmap(message),
                message = self.proposals.recv() => self.on_proposal(message),
                message = self.confirmations.recv() => self.on_confirmation(message),
                message = self.presences.recv() => self.on_presence(&message),
                () = sleep_until(absence) => self.on_absence(),
                (call, _) = self.home.recv() => self.on_home(call),
                goal = self.goals.recv() => self.on_goal(goal),
                () = cancel_of(&self.goal) => self.on_goal_cancel(),
                Some(phase) = self.phases.recv() => self.say_phase(phase),
                (cause, stopped, ended) = end_of(&mut self.motion) => self.on_end(cause, stopped, ended),
                () = sleep_until(deadline) => self.ask_again(),
                _ = diagnostics.tick() => {
                    self.diagnose();
                    self.plan_again();
                }
                Ok(()) = changes.changed() => {
                    self.parameters = changes.borrow_and_update().clone();
                    self.gate.set_rules(rules(&self.parameters));
                }
                () = node.deactivated() => break,
            }
        }
        self.gate.deactivate();
        for call in std::mem::take(&mut self.home_calls) {
            let response = TriggerResponse {
                success: false,
                message: "the executor is deactivated".to_owned(),
            };
            self.home.respond(call, response);
        }
        let deadline = tokio::time::Instant::now() + STOP_GRACE;
        if let Some(motion) = &self.motion {
            warn!("deactivated while moving: stopping");
            motion.stop.cancel();
            let (cause, stopped, ended) = timeout_at(deadline, end_of(&mut self.motion))
                .await
                .with_context(|| format!("the arm has not stopped after {STOP_GRACE:?}"))?;
            self.on_end(cause, stopped, ended);
            // The process may end at once.
            tokio::time::sleep(LAST_WORD).await;
        }
        // A goal that is accepted late is cancelled; where this process ends before that, by the watchdog.
        let quiet = timeout_at(deadline, self.link.heartbeat.quiet()).await;
        if quiet.is_err() {
            warn!("the driver has not answered a goal within {STOP_GRACE:?}");
        }
        Ok(())
    }

    fn on_presence(&mut self, message: &sctn_msgs::OperatorPresence) {
        self.presence.on_message(message.is_present, Instant::now());
        if self
            .absence()
            .is_some_and(|absence| absence <= Instant::now())
        {
            self.on_absence();
        }
    }

    /// When a motion is to stop because nobody is present; never where that is not asked for.
    fn absence(&self) -> Option<Instant> {
        let motion = self.motion.as_ref()?;
        let watched = self.parameters.require_presence && !motion.stop.is_cancelled();
        watched.then(|| self.presence.deadline().unwrap_or_else(Instant::now))
    }

    fn on_absence(&mut self) {
        if let Some(motion) = &self.motion {
            warn!("no operator is present: stopping");
            motion.stop.cancel();
        }
    }

    /// Why nothing may begin to move: nobody is present.
    fn unattended(&self) -> Option<String> {
        let absent = self.parameters.require_presence && !self.presence.is_present(Instant::now());
        absent.then(|| "no operator is present (require_presence)".to_owned())
    }

    fn on_heightmap(&mut self, message: sctn_msgs::Heightmap) {
        let frame_id = message.header.frame_id.clone();
        if frame_id != self.parameters.world_frame {
            let expected = &self.parameters.world_frame;
            self.heightmaps.reject(format_args!(
                "header.frame_id is `{frame_id}`, expected `{expected}`"
            ));
            return;
        }
        match convert::observation_from_msg(message) {
            Ok(seen) => {
                self.seen = Some((Arc::clone(&seen.heightmap), seen.stamp));
                self.gate.on_heightmap(seen.stamp, seen.heightmap);
                self.plan_again();
                self.ask_again();
            }
            Err(error) => self.heightmaps.reject(error),
        }
    }

    fn on_proposal(&mut self, message: sctn_msgs::PickPlace) {
        let id = ProposalId(message.id);
        let proposal = read_proposal(&message);
        match self.gate.on_proposal(id, proposal.clone()) {
            Proposed::Pending => {
                info!("proposal {id}");
                self.show_plan(proposal.ok());
                if self.gate.moves_unasked(id) {
                    self.confirm(id, OperatorDecision::Approve);
                }
            }
            Proposed::Repeated => {}
            Proposed::Invalid(reason) => {
                self.proposals.reject(&reason);
                if self.gate.is_automatic() {
                    self.report(self.refusal(id, reason.to_string()), None);
                }
            }
        }
        self.look_after_goal();
        self.ask_again();
    }

    /// Publishes how a pending proposal would be carried out, or why it cannot be; in the latter case once more when it can.
    fn show_plan(&mut self, proposal: Option<Proposal>) {
        let Some(proposal) = proposal else {
            return;
        };
        let planned = self.robot().rehearse(&proposal);
        let is_planned = planned.is_ok();
        self.publish_plan(planned, proposal.id);
        self.unplanned = (!is_planned).then_some(proposal);
    }

    /// The robot's state or a heightmap may have arrived since the last plan failed.
    fn plan_again(&mut self) {
        let proposal = self.unplanned.take_if(|_| self.motion.is_none());
        let Some(proposal) = proposal else {
            return;
        };
        match self.robot().rehearse(&proposal) {
            Ok(planned) => self.publish_plan(Ok(planned), proposal.id),
            Err(_) => self.unplanned = Some(proposal),
        }
    }

    fn publish_plan(&self, planned: Result<PlannedPrimitive, String>, id: ProposalId) {
        let header = msgs::std_msgs::Header {
            stamp: self.node.now(),
            frame_id: self.parameters.world_frame.clone(),
        };
        match planned_motion(planned, id.0, &self.work_cell.joint_names, header) {
            Ok(motion) => self.planned.publish(motion),
            Err(error) => warn!("the motion of proposal {id}: {error}"),
        }
    }

    /// A goal of the action is a proposal whose way its client follows; it goes through the same gate.
    fn on_goal(&mut self, new: NewGoal<ExecutePickPlace>) {
        let id = ProposalId(new.goal.proposal.id);
        let busy = match (&self.goal, &self.motion) {
            (Some(goal), _) => Some(format!("a goal for proposal {} is active", goal.id)),
            (None, Some(motion)) => Some(match motion.cause {
                Cause::Proposal(moving) => format!("proposal {moving} is being carried out"),
                Cause::Home => "the arm is on its way home".to_owned(),
            }),
            (None, None) => None,
        };
        let pending = match busy {
            Some(busy) => Err(busy),
            None => {
                let proposal = read_proposal(&new.goal.proposal);
                let proposed = self.gate.on_proposal(id, proposal.clone());
                if matches!(proposed, Proposed::Pending) {
                    self.show_plan(proposal.ok());
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
        self.goal = Some(Goal {
            id,
            running: new.accept().1,
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

    fn on_goal_cancel(&mut self) {
        let Some(goal) = &mut self.goal else {
            return;
        };
        goal.cancelling = true;
        let (id, moving) = (goal.id, goal.moving);
        info!("proposal {id}: its goal is cancelled");
        match &self.motion {
            Some(motion) if moving => motion.stop.cancel(),
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
    fn look_after_goal(&mut self) {
        if let Some(goal) = &self.goal
            && !goal.moving
            && let Err(refusal) = self.gate.check_pending(goal.id)
        {
            self.report(self.refusal(goal.id, refusal.to_string()), None);
        }
    }

    /// Ends the goal of a proposal with its result, if it has one and this is its end.
    fn finish_goal(&mut self, outcome: StepOutcome, result: sctn_msgs::StepResult, moved: bool) {
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

    fn say_phase(&self, phase: Phase) {
        if self.goal.as_ref().is_some_and(|goal| goal.moving) {
            self.feedback(convert::phase_to_msg(phase));
        }
    }

    fn feedback(&self, phase: u8) {
        if let Some(goal) = &self.goal {
            goal.running.feedback(ExecutePickPlaceFeedback {
                header: msgs::std_msgs::Header {
                    stamp: self.node.now(),
                    frame_id: self.parameters.world_frame.clone(),
                },
                proposal_id: goal.id.0,
                phase,
            });
        }
    }

    fn on_confirmation(&mut self, message: sctn_msgs::StepConfirmation) {
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
        if step_protocol::Judgement::from_decision(decision).is_some() {
            // For the goal oracle.
            return;
        }
        info!(
            "{} of proposal {id} by `{}`",
            decision.name(),
            message.operator_name
        );
        self.confirm(id, decision);
    }

    fn confirm(&mut self, id: ProposalId, decision: OperatorDecision) {
        if decision == OperatorDecision::Stop {
            self.stop_memory
                .remember(&format!("{} of proposal {id}", decision.name()));
        }
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let actions = self.gate.on_confirmation(id, decision, &robot, now);
        self.act(actions);
    }

    /// Confirmations whose proposal or heightmap was still on its way.
    fn ask_again(&mut self) {
        let (robot, now) = (self.robot(), self.origin.elapsed());
        let actions = self.gate.on_news(&robot, now);
        self.act(actions);
    }

    fn robot(&self) -> RobotNow {
        RobotNow {
            arm: self.work_cell.arm.clone(),
            status: self.status.borrow().clone(),
            now: self.origin.elapsed(),
            max_age: Duration::from_secs_f64(self.parameters.driver.status_max_age_s),
            unattended: self.unattended(),
            refused: self.link.refusal(),
            needs_home: self.parameters.observation_needs_home,
            time: Duration::from_nanos(self.node.clock().now_ns().max(0) as u64),
            seen: self.seen.clone(),
            observation_max_age: Duration::from_secs_f64(self.parameters.observation_max_age_s),
            contact: self.parameters.contact,
            sign: self.parameters.driver.contact,
        }
    }

    fn act(&mut self, actions: Vec<GateAction>) {
        for action in actions {
            match action {
                GateAction::Move(proposal) => self.begin(*proposal),
                GateAction::Cancel => {
                    if let Some(motion) = &self.motion {
                        motion.stop.cancel();
                    }
                }
                GateAction::Report(report) => self.report(report, None),
            }
        }
        self.look_after_goal();
    }

    /// A refusal with where the proposal stands.
    fn refusal(&self, id: ProposalId, reason: String) -> Report {
        Report {
            id,
            outcome: StepOutcome::Refused,
            reason,
            status: self.gate.status(id),
        }
    }

    fn begin(&mut self, proposal: Proposal) {
        info!("proposal {}: moving", proposal.id);
        self.stop_memory.forget();
        if let Some(goal) = &mut self.goal {
            goal.moving = goal.id == proposal.id;
        }
        let phases = self.phase_sender.clone();
        let arm = self.work_cell.arm.clone();
        let diagnostics = self.node.diagnostics().clone();
        let id = proposal.id;
        let (contact, sign) = (self.parameters.contact, self.parameters.driver.contact);
        let seen = self.seen.clone();
        let observe = move |phase: Phase| {
            let values = [("proposal_id", id.to_string())];
            diagnostics.set("motion", Level::Ok, format!("{phase:?}"), values);
            // The receiver lives as long as the node.
            let _ = phases.send(phase);
        };
        self.start(Cause::Proposal(id), move |robot| {
            let Proposal {
                action, settings, ..
            } = &proposal;
            // The gate has asked for it before: it is there.
            let touchdown = seen.map(|(seen, _)| touchdown(&seen, action, &contact, sign));
            let touchdown = touchdown
                .transpose()
                .map_err(|reason| ExecuteError::Robot {
                    phase: Phase::Approach,
                    error: DriverError::Fault(reason),
                })?;
            let touchdown = touchdown.flatten();
            pick_place::execute_on(robot, &arm, action, settings, touchdown.as_ref(), observe)
                .map(Some)
        });
    }

    /// Brings the arm home, for after a stop or a fault. The call may come again because its
    /// answer was lost.
    fn on_home(&mut self, call: RequestId) {
        let at_work = self
            .motion
            .as_ref()
            .is_some_and(|motion| motion.cause == Cause::Home);
        if !at_work {
            if let Err(reason) = self.gate.go_home(&self.robot()) {
                warn!("home: {reason}");
                self.home.respond(
                    call,
                    TriggerResponse {
                        success: false,
                        message: reason,
                    },
                );
                return;
            }
            info!("home: moving");
            let arm = self.work_cell.arm.clone();
            self.start(Cause::Home, move |robot| {
                go_home(robot, &arm).map(|()| None)
            });
        }
        if self.home_calls.len() < WAITING_CALLS {
            self.home_calls.push(call);
        } else {
            let message = format!("{WAITING_CALLS} other calls wait");
            self.home.respond(
                call,
                TriggerResponse {
                    success: false,
                    message,
                },
            );
        }
    }

    /// Moves the arm on a thread of its own.
    fn start(
        &mut self,
        cause: Cause,
        work: impl FnOnce(&mut DriverRobot) -> Result<Option<Outcome>, ExecuteError<DriverError>>
        + Send
        + 'static,
    ) {
        let stop = CancellationToken::new();
        let mut robot = DriverRobot::new(Arc::clone(&self.link), Handle::current(), stop.clone());
        let task = self.node.spawn_blocking(move || Ended {
            result: work(&mut robot),
            stamps: robot.stamps,
        });
        self.motion = Some(Motion { cause, stop, task });
    }

    fn on_end(&mut self, cause: Cause, stopped: bool, ended: anyhow::Result<Ended>) {
        while let Ok(phase) = self.phases.try_recv() {
            self.say_phase(phase);
        }
        let (result, stamps) = match ended {
            Ok(ended) => (Ok(ended.result), ended.stamps),
            Err(error) => (Err(error), None),
        };
        let (outcome, mut reason) = match result {
            Ok(Ok(Some(outcome))) => (StepOutcome::from(outcome), why(outcome).to_owned()),
            Ok(Ok(None)) => (StepOutcome::Placed, "at home".to_owned()),
            Ok(Err(ExecuteError::Robot {
                phase,
                error: DriverError::Stopped,
            })) => (
                StepOutcome::Stopped,
                format!("{phase:?}: {}", DriverError::Stopped),
            ),
            Ok(Err(error)) => (StepOutcome::Fault, one_line(&error.to_string())),
            Err(error) => (StepOutcome::Fault, format!("{error:#}")),
        };
        let broken_off = matches!(outcome, StepOutcome::Stopped | StepOutcome::Fault);
        if broken_off {
            self.stop_memory.remember(&reason);
            reason += "; the arm stands where it is, suction is as it was; a new observation and approval are needed";
        } else if stopped {
            reason = format!("the stop came after the end. {reason}")
                .trim()
                .to_owned();
        }
        let level = if outcome == StepOutcome::Fault {
            Level::Error
        } else {
            Level::Ok
        };
        self.node.diagnostics().set("motion", level, &reason, []);
        // Observations from then on show the result. Simulated time may still be on its way.
        let now = Duration::from_nanos(self.node.clock().now_ns().max(0) as u64);
        let end = stamps.map_or(now, |(_, last)| last.max(now));
        let duration = stamps.map_or(Duration::ZERO, |(first, last)| last - first.min(last));
        let actions = self.gate.finish(end, broken_off);
        match cause {
            Cause::Proposal(id) => {
                let report = Report {
                    id,
                    outcome,
                    reason,
                    status: self.gate.status(id),
                };
                self.report(report, Some((end, duration)));
            }
            Cause::Home => {
                info!("home: {reason}");
                for call in std::mem::take(&mut self.home_calls) {
                    let response = TriggerResponse {
                        success: !broken_off,
                        message: reason.clone(),
                    };
                    self.home.respond(call, response);
                }
            }
        }
        self.act(actions);
        self.ask_again();
    }

    /// `motion`: when it ended and how long it took.
    fn report(&mut self, report: Report, motion: Option<(Duration, Duration)>) {
        let Report {
            id,
            outcome,
            reason,
            ..
        } = &report;
        let (outcome, name) = (*outcome, outcome.name());
        match outcome {
            StepOutcome::Placed | StepOutcome::Rejected => {
                info!("proposal {id}: {name}. {reason}")
            }
            StepOutcome::Fault => error!("proposal {id}: {name}: {reason}"),
            _ => warn!("proposal {id}: {name}: {reason}"),
        }
        let result = self.result(report, motion);
        self.results.publish(result.clone());
        self.finish_goal(outcome, result, motion.is_some());
    }

    fn result(
        &self,
        report: Report,
        motion: Option<(Duration, Duration)>,
    ) -> sctn_msgs::StepResult {
        let now = Duration::from_nanos(self.node.clock().now_ns().max(0) as u64);
        let (stamp, duration) = motion.unwrap_or((now, Duration::ZERO));
        let result = StepResult {
            stamp,
            proposal_id: report.id,
            outcome: report.outcome,
            reason: report.reason,
            duration,
            status: report.status,
        };
        convert::result_to_msg(&result, &self.parameters.world_frame).unwrap_or_else(|error| {
            // A clock beyond what a stamp can hold.
            error!("the result of proposal {}: {error}", result.proposal_id);
            sctn_msgs::StepResult {
                proposal_id: result.proposal_id.0,
                outcome: result.outcome.code(),
                reason: result.reason.clone(),
                ..Default::default()
            }
        })
    }

    fn diagnose(&self) {
        let (level, message) = match self.link.unready() {
            None => (Level::Ok, "ready".to_owned()),
            Some(obstacle) => (Level::Warn, obstacle),
        };
        self.node.diagnostics().set("driver", level, message, []);
    }
}

/// Waits for the end of a motion, and takes it; for ever when there is none.
async fn end_of(motion: &mut Option<Motion>) -> (Cause, bool, anyhow::Result<Ended>) {
    match motion {
        Some(running) => {
            let ended = (&mut running.task).await;
            let ended = ended.context("the motion's thread panicked");
            let (cause, stopped) = (running.cause, running.stop.is_cancelled());
            *motion = None;
            (cause, stopped, ended)
        }
        None => std::future::pending().await,
    }
}

/// Waits until the client of a goal wants it cancelled; says so once.
async fn cancel_of(goal: &Option<Goal>) {
    match goal {
        Some(goal) if !goal.cancelling => goal.running.cancel_requested().await,
        _ => std::future::pending().await,
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}

/// Says what is wrong with a message and in which field.
fn read_proposal(message: &sctn_msgs::PickPlace) -> Result<Proposal, String> {
    let id = message.id;
    convert::proposal_from_msg(message).map_err(|error| format!("proposal {id}: {error}"))
}

fn why(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Placed => "",
        Outcome::NoContact => "the descent met nothing to pick",
        Outcome::GraspFailed => "suction held nothing",
        Outcome::Dropped => "the object was lost on the way",
        Outcome::LagAborted => "the tip lagged too far behind; the object was released",
    }
}

/// Poses print themselves over several lines.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
