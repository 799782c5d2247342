//! Topics in, motion and results out.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use heightmap::Workspace;
use msgs::convert::{self, ConvertError};
use msgs::sctn_msgs::{self, ExecutePickPlace, ExecutePickPlaceFeedback, ExecutePickPlaceResult};
use msgs::sensor_msgs::JointState;
use msgs::std_msgs::Bool;
use msgs::std_srvs::{Trigger, TriggerResponse};
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::{Digital, IOStates};
use node_kit::{
    ActionServer, Active, Level, NewGoal, Node, Publisher, Qos, RequestId, RunningGoal,
    ServiceServer, Subscription,
};
use pick_place::{ExecuteError, Outcome, Phase, PickPlace};
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::{error, info, warn};
use ur5::WorkCell;

use crate::driver::{DriverError, DriverRobot, Link};
use crate::gate::{Answer, Decision, Gate, Proposal, Proposed, Rules, Verdict};
use crate::home::go_home;
use crate::parameters::{Driver, SuctionExecutorParameters};
use crate::presence::Presence;
use crate::rehearsal::rehearse;
use crate::status::{DriverStatus, JointReading, Pins, StillRule};

/// Confirmations that wait for their proposal; more are refused at once.
const WAITING_CONFIRMATIONS: usize = 16;
/// Calls of `home` that are answered when the arm is there; more fail at once.
const WAITING_CALLS: usize = 16;
/// Joints move less than this from one reading to the next while they stand still: the noise of
/// encoders.
const STILL_STEP_RAD: f64 = 1e-4;
/// How long a motion may take to stop when the node is deactivated.
const STOP_GRACE: Duration = Duration::from_millis(1500);
const DIAGNOSTICS_PERIOD: Duration = Duration::from_millis(500);

/// Loads the work cell and listens to the driver; what it returns moves.
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
    let origin = Instant::now();
    let status = follow_status(&node, &parameters.driver, &work_cell.joint_names, origin)?;
    let link = Link::new(
        &node,
        &parameters.driver,
        &work_cell.joint_names,
        status.clone(),
        origin,
    )?;
    Ok(ExecutorNode {
        results: node.publisher("step_result", Qos::Event)?,
        gate: Gate::new(rules(&parameters)),
        automatic: !parameters.require_approval,
        link: Arc::new(link),
        work_cell,
        status,
        origin,
    })
}

fn rules(parameters: &SuctionExecutorParameters) -> Rules {
    Rules {
        frame: parameters.world_frame.clone(),
        workspace: Workspace::RAVENS,
        most: parameters.limits.settings(),
        observation_tolerance_m: parameters.observation_tolerance_m as f32,
        observation_changed_fraction: parameters.observation_changed_fraction,
        status_max_age: Duration::from_secs_f64(parameters.driver.status_max_age_s),
    }
}

/// The configured node. What was used or stopped stays so while it is inactive.
pub struct ExecutorNode {
    results: Publisher<sctn_msgs::StepResult>,
    gate: Gate,
    /// Whether new proposals move by themselves.
    automatic: bool,
    link: Arc<Link>,
    work_cell: WorkCell,
    status: watch::Receiver<DriverStatus>,
    origin: Instant,
}

impl Active for ExecutorNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
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
            home: node.service_server("~/home")?,
            home_calls: Vec::new(),
            goals: node.action_server("execute_pick_place")?,
            goal: None,
            phase_sender,
            phases,
            gate: &mut self.gate,
            automatic: &mut self.automatic,
            waiting: VecDeque::new(),
            motion: None,
            link: Arc::clone(&self.link),
            node: node.clone(),
            parameters: parameters.borrow().clone(),
            work_cell: self.work_cell.clone(),
            status: self.status.clone(),
            origin: self.origin,
        };
        executor.run(parameters).await
    }
}

/// Keeps the newest status of the driver.
fn follow_status(
    node: &Node,
    driver: &Driver,
    joint_names: &[String; 6],
    origin: Instant,
) -> anyhow::Result<watch::Receiver<DriverStatus>> {
    let topic = |name| format!("{}/{name}", driver.io_and_status);
    let mut joint_states = node.subscription::<JointState>("joint_states", Qos::Event)?;
    let mut io_states = node.subscription::<IOStates>(&topic("io_states"), Qos::Event)?;
    let mut robot_modes = node.subscription::<RobotMode>(&topic("robot_mode"), Qos::Latched)?;
    let mut safety_modes = node.subscription::<SafetyMode>(&topic("safety_mode"), Qos::Latched)?;
    let mut running = node.subscription::<Bool>(&topic("robot_program_running"), Qos::Latched)?;
    let joint_names = joint_names.clone();
    let (suction_pin, vacuum_pin) = (driver.suction_pin, driver.vacuum_pin);
    let rule = StillRule {
        speed_rad_s: driver.rest_speed_rad_s,
        step_rad: STILL_STEP_RAD,
    };
    let (sender, receiver) = watch::channel(DriverStatus::default());
    node.spawn(async move {
        loop {
            tokio::select! {
                message = joint_states.recv() => match JointReading::from_msg(&message, &joint_names) {
                    Ok(reading) => sender.send_modify(|status| {
                        status.read_joints(reading, origin.elapsed(), &rule);
                    }),
                    Err(error) => joint_states.reject(error),
                },
                message = io_states.recv() => {
                    let suction = level(&message.digital_out_states, suction_pin);
                    let vacuum = level(&message.digital_in_states, vacuum_pin);
                    match (suction, vacuum) {
                        (Some(suction), Some(vacuum)) => sender.send_modify(|status| {
                            status.read_pins(Pins { suction, vacuum }, origin.elapsed());
                        }),
                        _ => io_states.reject(format_args!(
                            "expected digital_out_states of pin {suction_pin} and digital_in_states of pin {vacuum_pin}"
                        )),
                    }
                }
                message = robot_modes.recv() => {
                    sender.send_modify(|status| status.robot_mode = Some(message.mode));
                }
                message = safety_modes.recv() => {
                    sender.send_modify(|status| status.safety_mode = Some(message.mode));
                }
                message = running.recv() => {
                    sender.send_modify(|status| status.program_running = Some(message.data));
                }
            }
        }
    });
    Ok(receiver)
}

fn level(states: &[Digital], pin: u8) -> Option<bool> {
    states
        .iter()
        .find(|state| state.pin == pin)
        .map(|state| state.state)
}

/// A confirmation that may be ahead of what it speaks of.
struct Waiting {
    id: u64,
    decision: Decision,
    until: Instant,
}

/// What moves the arm.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Cause {
    /// An approved proposal.
    Proposal(u64),
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
    id: u64,
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
    home: ServiceServer<Trigger>,
    /// Calls of `home` to be answered when the arm is there.
    home_calls: Vec<RequestId>,
    goals: ActionServer<ExecutePickPlace>,
    goal: Option<Goal>,
    phase_sender: mpsc::UnboundedSender<Phase>,
    /// Phases of the motion under way.
    phases: mpsc::UnboundedReceiver<Phase>,
    gate: &'a mut Gate,
    /// Whether new proposals move by themselves.
    automatic: &'a mut bool,
    waiting: VecDeque<Waiting>,
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
            let deadline = self.waiting.front().map(|waiting| waiting.until);
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
                _ = diagnostics.tick() => self.diagnose(),
                Ok(()) = changes.changed() => {
                    self.parameters = changes.borrow_and_update().clone();
                    self.gate.set_rules(rules(&self.parameters));
                }
                () = node.deactivated() => break,
            }
        }
        for call in std::mem::take(&mut self.home_calls) {
            let response = TriggerResponse {
                success: false,
                message: "the executor is deactivated".to_owned(),
            };
            self.home.respond(call, response);
        }
        if let Some(motion) = &self.motion {
            warn!("deactivated while moving: stopping");
            motion.stop.cancel();
            let (cause, stopped, ended) =
                tokio::time::timeout(STOP_GRACE, end_of(&mut self.motion))
                    .await
                    .with_context(|| format!("the arm has not stopped after {STOP_GRACE:?}"))?;
            self.on_end(cause, stopped, ended);
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
        let stamp = convert::time_from_msg(&message.header.stamp);
        let frame_id = message.header.frame_id.clone();
        if frame_id != self.parameters.world_frame {
            let expected = &self.parameters.world_frame;
            self.heightmaps.reject(format_args!(
                "header.frame_id is `{frame_id}`, expected `{expected}`"
            ));
            return;
        }
        match stamp.and_then(|stamp| Ok((stamp, convert::heightmap_from_msg(message)?))) {
            Ok((stamp, heightmap)) => {
                self.gate.observe(stamp, heightmap);
                self.ask_again();
            }
            Err(error) => self.heightmaps.reject(error),
        }
    }

    fn on_proposal(&mut self, message: sctn_msgs::PickPlace) {
        let id = message.id;
        match self.gate.propose(id, read_proposal(&message)) {
            Proposed::Open => {
                info!("proposal {id}");
                if *self.automatic {
                    self.confirm(id, Decision::Approve, None);
                }
            }
            Proposed::Repeated => {}
            Proposed::Invalid(reason) => {
                self.proposals.reject(&reason);
                if *self.automatic {
                    self.report(id, sctn_msgs::StepResult::REFUSED, reason, None);
                }
            }
        }
        self.look_after_goal();
        self.ask_again();
    }

    /// A goal of the action is a proposal whose way its client follows; it goes through the same gate.
    fn on_goal(&mut self, new: NewGoal<ExecutePickPlace>) {
        let id = new.goal.proposal.id;
        let busy = match (&self.goal, &self.motion) {
            (Some(goal), _) => Some(format!("a goal for proposal {} is active", goal.id)),
            (None, Some(motion)) => Some(match motion.cause {
                Cause::Proposal(moving) => format!("proposal {moving} is being carried out"),
                Cause::Home => "the arm is on its way home".to_owned(),
            }),
            (None, None) => None,
        };
        let open = match busy {
            Some(busy) => Err(busy),
            None => match self.gate.propose(id, read_proposal(&new.goal.proposal)) {
                Proposed::Invalid(reason) => Err(reason),
                Proposed::Open | Proposed::Repeated => self.gate.open(id),
            },
        };
        if let Err(reason) = open {
            let reason = format!("goal for proposal {id} rejected: {reason}");
            new.reject(&reason);
            let refusal = self.result(id, sctn_msgs::StepResult::REFUSED, reason, None);
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
        if *self.automatic {
            self.confirm(id, Decision::Approve, None);
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
                self.report(id, sctn_msgs::StepResult::STOPPED, reason, None);
            }
        }
    }

    /// Ends a goal whose proposal can no longer be approved.
    fn look_after_goal(&mut self) {
        if let Some(goal) = &self.goal
            && !goal.moving
            && let Err(reason) = self.gate.open(goal.id)
        {
            self.report(goal.id, sctn_msgs::StepResult::REFUSED, reason, None);
        }
    }

    /// Ends the goal of a proposal with its result, if it has one and this is its end.
    fn finish_goal(&mut self, result: sctn_msgs::StepResult, motion_ended: bool) {
        use sctn_msgs::StepResult;
        let is_end =
            |goal: &mut Goal| goal.id == result.proposal_id && (motion_ended || !goal.moving);
        let Some(goal) = self.goal.take_if(is_end) else {
            return;
        };
        // Nothing moves for a goal that has ended.
        self.gate.withdraw(goal.id);
        let (outcome, cancelled) = (result.outcome, goal.running.is_cancel_requested());
        let result = ExecutePickPlaceResult { result };
        match outcome {
            StepResult::PLACED => goal.running.succeed(result),
            StepResult::STOPPED if cancelled => goal.running.cancelled(result),
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
                proposal_id: goal.id,
                phase,
            });
        }
    }

    fn on_confirmation(&mut self, message: sctn_msgs::StepConfirmation) {
        use sctn_msgs::StepConfirmation;
        // What was sent before it is to be known before it.
        while let Some(heightmap) = self.heightmaps.try_recv() {
            self.on_heightmap(heightmap);
        }
        while let Some(proposal) = self.proposals.try_recv() {
            self.on_proposal(proposal);
        }
        let id = message.proposal_id;
        let decision = match message.decision {
            StepConfirmation::APPROVE => Decision::Approve,
            StepConfirmation::REJECT => Decision::Reject,
            StepConfirmation::STOP => Decision::Stop,
            // For the goal oracle.
            StepConfirmation::ADVANCE | StepConfirmation::RETRY => return,
            other => {
                let reason = format!(
                    "decision is {other}, expected APPROVE (1), REJECT (2), ADVANCE (3), RETRY (4) or STOP (5)"
                );
                self.confirmations.reject(&reason);
                self.report(id, sctn_msgs::StepResult::REFUSED, reason, None);
                return;
            }
        };
        info!(
            "{decision:?} of proposal {id} by `{}`",
            message.operator_name
        );
        self.confirm(id, decision, None);
    }

    /// Confirmations whose proposal or heightmap was still on its way.
    fn ask_again(&mut self) {
        for waiting in std::mem::take(&mut self.waiting) {
            self.confirm(waiting.id, waiting.decision, Some(waiting.until));
        }
    }

    /// `until`: how long it may wait, where it has waited already.
    fn confirm(&mut self, id: u64, decision: Decision, until: Option<Instant>) {
        use sctn_msgs::StepResult;
        if decision == Decision::Stop {
            // Nothing goes on by itself after a stop.
            *self.automatic = false;
            for waiting in std::mem::take(&mut self.waiting) {
                let reason = format!("proposal {}: a stop came before it", waiting.id);
                self.report(waiting.id, StepResult::REFUSED, reason, None);
            }
        }
        if decision == Decision::Approve
            && let Some(reason) = self.unattended()
        {
            self.report(
                id,
                StepResult::REFUSED,
                format!("proposal {id}: {reason}"),
                None,
            );
            return;
        }
        let arm = &self.work_cell.arm;
        let verdict = self.gate.confirm(
            id,
            decision,
            &self.status.borrow(),
            self.origin.elapsed(),
            |status, proposal| rehearse(arm, status, proposal),
        );
        match verdict {
            Verdict::Move(proposal) => {
                // After a stop or a fault an approval lets things go on.
                *self.automatic = !self.parameters.require_approval;
                self.begin(*proposal);
            }
            Verdict::Cancel => {
                if let Some(motion) = &self.motion {
                    motion.stop.cancel();
                }
            }
            Verdict::Answer(answer, reason) => {
                let outcome = match answer {
                    Answer::Refused => StepResult::REFUSED,
                    Answer::Rejected => StepResult::REJECTED,
                    Answer::Stopped => StepResult::STOPPED,
                };
                self.report(id, outcome, reason, None);
            }
            Verdict::Wait(reason) => {
                let grace = Duration::from_secs_f64(self.parameters.confirmation_grace_s);
                let until = until.unwrap_or_else(|| Instant::now() + grace);
                if Instant::now() >= until || self.waiting.len() >= WAITING_CONFIRMATIONS {
                    self.report(id, StepResult::REFUSED, reason, None);
                } else {
                    self.waiting.push_back(Waiting {
                        id,
                        decision,
                        until,
                    });
                }
            }
            Verdict::Nothing => {}
        }
        self.look_after_goal();
    }

    fn begin(&mut self, proposal: Proposal) {
        info!("proposal {}: moving", proposal.id);
        if let Some(goal) = &mut self.goal {
            goal.moving = goal.id == proposal.id;
        }
        let phases = self.phase_sender.clone();
        let arm = self.work_cell.arm.clone();
        let diagnostics = self.node.diagnostics().clone();
        let id = proposal.id;
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
            pick_place::execute(robot, &arm, action, settings, observe).map(Some)
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
            let allowed = match self.unattended() {
                Some(reason) => Err(reason),
                None => self
                    .gate
                    .go_home(&self.status.borrow(), self.origin.elapsed()),
            };
            if let Err(reason) = allowed {
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
        use sctn_msgs::StepResult;
        while let Ok(phase) = self.phases.try_recv() {
            self.say_phase(phase);
        }
        let (result, stamps) = match ended {
            Ok(ended) => (Ok(ended.result), ended.stamps),
            Err(error) => (Err(error), None),
        };
        let (outcome, mut reason) = match result {
            Ok(Ok(Some(outcome))) => (convert::outcome_to_msg(outcome), why(outcome).to_owned()),
            Ok(Ok(None)) => (StepResult::PLACED, "at home".to_owned()),
            Ok(Err(ExecuteError::Robot {
                phase,
                error: DriverError::Stopped,
            })) => (
                StepResult::STOPPED,
                format!("{phase:?}: {}", DriverError::Stopped),
            ),
            Ok(Err(error)) => (StepResult::FAULT, one_line(&error.to_string())),
            Err(error) => (StepResult::FAULT, format!("{error:#}")),
        };
        let broken_off = matches!(outcome, StepResult::STOPPED | StepResult::FAULT);
        if broken_off {
            // Nothing goes on by itself.
            *self.automatic = false;
            reason += "; the arm stands where it is, suction is as it was; a new observation and approval are needed";
        } else if stopped {
            reason = format!("the stop came after the end. {reason}")
                .trim()
                .to_owned();
        }
        let level = if outcome == StepResult::FAULT {
            Level::Error
        } else {
            Level::Ok
        };
        self.node.diagnostics().set("motion", level, &reason, []);
        // Observations from then on show the result. Simulated time may still be on its way.
        let now = Duration::from_nanos(self.node.clock().now_ns().max(0) as u64);
        let end = stamps.map_or(now, |(_, last)| last.max(now));
        let duration = stamps.map_or(Duration::ZERO, |(first, last)| last - first.min(last));
        self.gate.finish(end);
        match cause {
            Cause::Proposal(id) => self.report(id, outcome, reason, Some((end, duration))),
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
        self.ask_again();
    }

    /// `motion`: when it ended and how long it took.
    fn report(
        &mut self,
        id: u64,
        outcome: u8,
        reason: String,
        motion: Option<(Duration, Duration)>,
    ) {
        use sctn_msgs::StepResult;
        match outcome {
            StepResult::PLACED | StepResult::REJECTED => {
                info!("proposal {id}: {}. {reason}", name(outcome))
            }
            StepResult::FAULT => error!("proposal {id}: {}: {reason}", name(outcome)),
            _ => warn!("proposal {id}: {}: {reason}", name(outcome)),
        }
        let result = self.result(id, outcome, reason, motion);
        self.results.publish(result.clone());
        self.finish_goal(result, motion.is_some());
    }

    fn result(
        &self,
        id: u64,
        outcome: u8,
        reason: String,
        motion: Option<(Duration, Duration)>,
    ) -> sctn_msgs::StepResult {
        let (end, duration) = match motion {
            Some((end, duration)) => (convert::time_to_msg(end).ok(), duration),
            None => (None, Duration::ZERO),
        };
        sctn_msgs::StepResult {
            header: msgs::std_msgs::Header {
                stamp: end.unwrap_or_else(|| self.node.now()),
                frame_id: self.parameters.world_frame.clone(),
            },
            proposal_id: id,
            outcome,
            reason,
            duration: convert::duration_to_msg(duration).unwrap_or_default(),
        }
    }

    fn diagnose(&self) {
        let max_age = Duration::from_secs_f64(self.parameters.driver.status_max_age_s);
        let obstacle = self
            .status
            .borrow()
            .obstacle(self.origin.elapsed(), max_age);
        let (level, message) = match obstacle {
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
    let of =
        |field: &'static str| move |error: ConvertError| format!("proposal {id}: {field}.{error}");
    Ok(Proposal {
        id,
        frame: message.header.frame_id.clone(),
        stamp: convert::time_from_msg(&message.header.stamp).map_err(of("header"))?,
        action: PickPlace {
            pick: convert::pose2d_from_msg(&message.pick).map_err(of("pick"))?,
            place: convert::pose2d_from_msg(&message.place).map_err(of("place"))?,
        },
        settings: convert::settings_from_msg(&message.settings).map_err(of("settings"))?,
    })
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

fn name(outcome: u8) -> &'static str {
    use sctn_msgs::StepResult;
    match outcome {
        StepResult::PLACED => "PLACED",
        StepResult::NO_CONTACT => "NO_CONTACT",
        StepResult::GRASP_FAILED => "GRASP_FAILED",
        StepResult::DROPPED => "DROPPED",
        StepResult::LAG_ABORTED => "LAG_ABORTED",
        StepResult::REFUSED => "REFUSED",
        StepResult::REJECTED => "REJECTED",
        StepResult::FAULT => "FAULT",
        StepResult::STOPPED => "STOPPED",
        _ => "unknown outcome",
    }
}

/// Poses print themselves over several lines.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}
