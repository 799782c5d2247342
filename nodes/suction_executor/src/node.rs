//! Topics in, motion and results out.

mod action;
mod motion;
#[cfg(feature = "planted_faults")]
mod planted;
mod proposals;
mod rehearsals;
mod report;

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use collision::{CollisionChecker, Margins};
use heightmap::{ChangeRules, Heightmap};
use msgs::{convert, sctn_msgs};
use node_kit::{ActionServer, Active, Node, Publisher, Qos, ServiceServer, Subscription};
use pick_place::Phase;
use rehearsal::{Picked, RobotNow};
use step_protocol::{ApprovalGate, GateRules, Presence, Recovery, StopCause};
use tokio::sync::{mpsc, watch};
use tokio::time::timeout_at;
use tracing::warn;
use ur_driver::status::DriverStatus;
use ur_driver::{ActivateError, ActiveExecutor, DriverClient};
use ur5::WorkCell;

use self::action::{Goal, cancel_of};
use self::motion::{Motion, end_of};
use self::rehearsals::Rehearsals;
use crate::cell;
use crate::parameters::SuctionExecutorParameters;
use crate::stop_memory::StopMemory;

/// How long a motion may take to stop when the node is deactivated.
const STOP_GRACE: Duration = Duration::from_millis(1500);
/// Where the process ends while a goal is unanswered, so long it waits for the answer, to cancel the goal: UR's released drivers take 2 s.
const ANSWER_GRACE: Duration = Duration::from_secs(3);
/// How long the result of a motion that was stopped at the end takes to be sent.
const LAST_WORD: Duration = Duration::from_millis(100);
const DIAGNOSTICS_PERIOD: Duration = Duration::from_millis(500);

/// Loads the work cell and listens to the driver; returns the node that executes proposals.
pub async fn configure(
    node: Node,
    parameters: SuctionExecutorParameters,
) -> anyhow::Result<ExecutorNode> {
    ur_driver::planted::check()?;
    let work_cell = cell::load(&parameters)?;
    if let Some(warning) = work_cell.warning() {
        warn!("parameter urdf: {warning}");
    }
    let margins = Margins {
        obstacle_m: parameters.collision_margin_m,
        ..Margins::default()
    };
    let checker =
        CollisionChecker::new(&work_cell, margins).context("parameter collision_margin_m")?;
    let driver = DriverClient::new(&node, &parameters.driver, &work_cell)?;
    let mut gate = ApprovalGate::new(rules(&parameters));
    let stop_file = &parameters.stop_file;
    let stop_memory = StopMemory::open(stop_file)
        .with_context(|| format!("parameter stop_file: {}", stop_file.display()))?;
    if let Some(reason) = stop_memory.stopped() {
        warn!("stopped before this start: {reason}. Nothing moves by itself before an approval");
        gate.remember_stop();
    }
    Ok(ExecutorNode {
        results: node.publisher("step_result", Qos::Event)?,
        planned: node.publisher("planned_motion", Qos::Latched)?,
        accepted: node.publisher("pick_place_goal", Qos::Event)?,
        gate,
        stop_memory,
        driver: Arc::new(driver),
        work_cell,
        checker: Arc::new(checker),
        parameters,
    })
}

fn rules(parameters: &SuctionExecutorParameters) -> GateRules {
    GateRules {
        frame: parameters.world_frame.clone(),
        limits: parameters.limits.settings(),
        changes: changes(parameters),
        confirmation_grace: Duration::from_secs_f64(parameters.confirmation_grace_s),
        require_approval: parameters.require_approval(),
        operators: parameters.operators.clone(),
    }
}

fn changes(parameters: &SuctionExecutorParameters) -> ChangeRules {
    ChangeRules::new(
        parameters.observation_tolerance_m,
        1e-6 * parameters.observation_changed_area_mm2,
    )
}

/// The configured node. What was used or stopped stays so while it is inactive.
pub struct ExecutorNode {
    results: Publisher<sctn_msgs::StepResult>,
    planned: Publisher<sctn_msgs::PlannedMotion>,
    accepted: Publisher<sctn_msgs::PickPlace>,
    gate: ApprovalGate,
    stop_memory: StopMemory,
    driver: Arc<DriverClient>,
    work_cell: WorkCell,
    checker: Arc<CollisionChecker>,
    parameters: SuctionExecutorParameters,
}

impl Active for ExecutorNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let active = self.driver.activate(node).await?;
        let parameters = self.parameters.clone();
        let (phase_sender, phases) = mpsc::unbounded_channel();
        let executor = Executor {
            proposals: node.subscription("pick_place", Qos::Latched)?,
            confirmations: node.subscription("step_confirmation", Qos::Event)?,
            heightmaps: node.subscription("heightmap", Qos::Latched)?,
            presences: node.subscription("operator_presence", Qos::Event)?,
            presence: Presence::new(Duration::from_secs_f64(parameters.presence_timeout_s)),
            results: &self.results,
            planned: &self.planned,
            accepted: &self.accepted,
            rehearsals: Rehearsals::default(),
            home: node.service_server("~/propose_home")?,
            put_down: node.service_server("~/propose_put_down")?,
            goals: node.action_server("execute_pick_place")?,
            goal: None,
            phase_sender,
            phases,
            gate: &mut self.gate,
            stop_memory: &mut self.stop_memory,
            seen: None,
            has_publisher: false,
            without_arm: None,
            picked: None,
            #[cfg(feature = "planted_faults")]
            planted: self::planted::Memory::default(),
            motion: None,
            driver: Arc::clone(&self.driver),
            node: node.clone(),
            parameters,
            work_cell: self.work_cell.clone(),
            checker: Arc::clone(&self.checker),
            status: self.driver.status.clone(),
            origin: self.driver.origin,
        };
        executor.run(&active).await
    }
}

struct Executor<'a> {
    node: Node,
    parameters: SuctionExecutorParameters,
    work_cell: WorkCell,
    checker: Arc<CollisionChecker>,
    proposals: Subscription<sctn_msgs::PickPlace>,
    confirmations: Subscription<sctn_msgs::StepConfirmation>,
    heightmaps: Subscription<sctn_msgs::Heightmap>,
    presences: Subscription<sctn_msgs::OperatorPresence>,
    presence: Presence,
    results: &'a Publisher<sctn_msgs::StepResult>,
    planned: &'a Publisher<sctn_msgs::PlannedMotion>,
    /// Proposals that came as goals of the action.
    accepted: &'a Publisher<sctn_msgs::PickPlace>,
    rehearsals: Rehearsals,
    home: ServiceServer<sctn_msgs::ProposeHome>,
    put_down: ServiceServer<sctn_msgs::ProposeHome>,
    goals: ActionServer<sctn_msgs::ExecutePickPlace>,
    goal: Option<Goal>,
    phase_sender: mpsc::UnboundedSender<Phase>,
    /// Phases of the motion under way.
    phases: mpsc::UnboundedReceiver<Phase>,
    gate: &'a mut ApprovalGate,
    stop_memory: &'a mut StopMemory,
    /// The newest heightmap and its stamp.
    seen: Option<(Arc<Heightmap>, Duration)>,
    /// Whether anybody was known to publish heightmaps.
    has_publisher: bool,
    /// The newest heightmap that is sure not to show the arm.
    without_arm: Option<Arc<Heightmap>>,
    /// Where the last motion has picked.
    picked: Option<Picked>,
    motion: Option<Motion>,
    driver: Arc<DriverClient>,
    status: watch::Receiver<DriverStatus>,
    origin: Instant,
    #[cfg(feature = "planted_faults")]
    planted: self::planted::Memory,
}

impl Executor<'_> {
    async fn run(mut self, active: &ActiveExecutor) -> anyhow::Result<()> {
        let node = self.node.clone();
        let mut is_deposed = false;
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
                (call, _) = self.home.recv() => self.on_recovery_call(Recovery::Home, call),
                (call, _) = self.put_down.recv() => self.on_recovery_call(Recovery::PutDown, call),
                rehearsed = self.rehearsals.ended() => self.on_rehearsed(rehearsed),
                goal = self.goals.recv() => self.on_goal(goal),
                () = cancel_of(&self.goal) => self.on_goal_cancel(),
                Some(phase) = self.phases.recv() => self.say_phase(phase),
                (cause, stopped, ended) = end_of(&mut self.motion) => self.on_end(cause, stopped, ended),
                () = sleep_until(deadline) => self.ask_again(),
                _ = diagnostics.tick() => {
                    self.diagnose();
                    #[cfg(feature = "planted_faults")]
                    self.plant_now_and_then();
                    self.rehearse_next();
                }
                () = active.deposed() => {
                    is_deposed = true;
                    break;
                }
                () = node.deactivated() => break,
            }
        }
        self.gate.deactivate();
        let deadline = tokio::time::Instant::now() + STOP_GRACE;
        if let Some(motion) = &mut self.motion {
            let cause = match node.is_ending() {
                true => StopCause::Shutdown,
                false => StopCause::Deactivated,
            };
            warn!("{} while moving", cause.text());
            motion.stop(cause);
            let (cause, stopped, ended) = timeout_at(deadline, end_of(&mut self.motion))
                .await
                .with_context(|| format!("the arm has not stopped after {STOP_GRACE:?}"))?;
            self.on_end(cause, stopped, ended);
            // The process may end at once.
            tokio::time::sleep(LAST_WORD).await;
        }
        // A goal that is accepted late is cancelled; where this process ends before that, by the watchdog.
        let deadline = match node.is_ending() {
            true => deadline + (ANSWER_GRACE - STOP_GRACE),
            false => deadline,
        };
        let quiet = timeout_at(deadline, self.driver.heartbeat.quiet()).await;
        if quiet.is_err() {
            warn!("the driver has not answered a goal");
        }
        if is_deposed {
            return Err(ActivateError::AnotherIsActive.into());
        }
        Ok(())
    }

    fn on_presence(&mut self, message: &sctn_msgs::OperatorPresence) {
        self.presence
            .on_message(message.is_present, self.origin.elapsed());
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
        let watched = self.parameters.require_presence && !motion.is_stopped();
        let deadline = self.presence.deadline();
        watched.then(|| deadline.map_or_else(Instant::now, |deadline| self.origin + deadline))
    }

    fn on_absence(&mut self) {
        if let Some(motion) = &mut self.motion {
            warn!("no operator is present: stopping");
            motion.stop(StopCause::NobodyPresent);
        }
    }

    /// Why nothing may begin to move: nobody is present.
    fn unattended(&self) -> Option<String> {
        let absent =
            self.parameters.require_presence && !self.presence.is_present(self.origin.elapsed());
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
                self.has_publisher |= self.publishers() > 0;
                if !self.status.borrow().at_home.may_be_in_view(seen.stamp) {
                    self.without_arm = Some(Arc::clone(&seen.heightmap));
                }
                self.gate.on_heightmap(seen.stamp, seen.heightmap);
                self.rehearse_what_was_unseen();
                self.ask_again();
            }
            Err(error) => self.heightmaps.reject(error),
        }
    }

    /// How many publish heightmaps.
    fn publishers(&self) -> usize {
        self.node.graph().publishers(self.heightmaps.topic())
    }

    fn robot(&self) -> RobotNow {
        let status = self.status.borrow();
        let max_age = Duration::from_secs_f64(self.parameters.driver.status_max_age_s);
        let obstacle = self
            .unattended()
            .or_else(|| status.obstacle(self.origin.elapsed(), max_age))
            .or_else(|| self.driver.refusal());
        RobotNow {
            arm: self.work_cell.arm.clone(),
            checker: Arc::clone(&self.checker),
            obstacle,
            joints_rad: status.joints.map(|joints| joints.value.positions_rad),
            holds: status.pins.map(|pins| pins.value.vacuum),
            at_home: status.at_home,
            unseen: self.has_publisher && self.publishers() == 0,
            needs_home: self.parameters.observation_needs_home,
            time: self.node.clock().time(),
            seen: self.seen.clone(),
            observation_max_age: Duration::from_secs_f64(self.parameters.observation_max_age_s),
            contact: self.parameters.contact,
            sign: self.parameters.driver.contact,
            without_arm: self.without_arm.clone(),
            picked: self.picked.clone(),
            changes: changes(&self.parameters),
            rehearsed: self.rehearsals.proposal.clone(),
            rehearsed_recovery: self.rehearsals.recovery.clone(),
        }
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
