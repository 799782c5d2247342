//! Topics in, motion and results out.

mod action;
mod motion;
#[cfg(feature = "planted_faults")]
mod planted;
mod proposals;
mod report;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use collision::{CollisionChecker, Margins};
use heightmap::{ChangeRules, Heightmap};
use msgs::{convert, sctn_msgs};
use nalgebra::Isometry2;
use node_kit::{ActionServer, Active, Node, Publisher, Qos, ServiceServer, Subscription};
use pick_place::Phase;
use step_protocol::{ApprovalGate, GateRules, Proposal};
use tokio::sync::{mpsc, watch};
use tokio::time::timeout_at;
use tracing::warn;
use ur_driver::DriverClient;
use ur_driver::status::DriverStatus;
use ur5::WorkCell;

use self::action::{Goal, cancel_of};
use self::motion::{Motion, StopCause, end_of};
use crate::dry_run::RobotNow;
use crate::parameters::SuctionExecutorParameters;
use crate::presence::Presence;
use crate::stop_memory::StopMemory;

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
    ur_driver::planted::check()?;
    let work_cell = match parameters.urdf.as_path() {
        path if path == Path::new("") => WorkCell::builtin(),
        path => WorkCell::load(path),
    }
    .context("parameter urdf")?;
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
        driver: Arc::new(driver),
        work_cell,
        checker: Arc::new(checker),
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
    driver: Arc<DriverClient>,
    work_cell: WorkCell,
    checker: Arc<CollisionChecker>,
}

impl Active for ExecutorNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let _active = self.driver.heartbeat.activate(node).await?;
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
            home: node.service_server("~/propose_home")?,
            goals: node.action_server("execute_pick_place")?,
            goal: None,
            phase_sender,
            phases,
            gate: &mut self.gate,
            stop_memory: self.stop_memory.clone(),
            seen: None,
            without_arm: None,
            picked: None,
            #[cfg(feature = "planted_faults")]
            planted: self::planted::Memory::default(),
            motion: None,
            driver: Arc::clone(&self.driver),
            node: node.clone(),
            parameters: parameters.borrow().clone(),
            work_cell: self.work_cell.clone(),
            checker: Arc::clone(&self.checker),
            status: self.driver.status.clone(),
            origin: self.driver.origin,
        };
        executor.run(parameters).await
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
    /// The pending proposal, while its motion could not be planned.
    unplanned: Option<Proposal>,
    home: ServiceServer<sctn_msgs::ProposeHome>,
    goals: ActionServer<sctn_msgs::ExecutePickPlace>,
    goal: Option<Goal>,
    phase_sender: mpsc::UnboundedSender<Phase>,
    /// Phases of the motion under way.
    phases: mpsc::UnboundedReceiver<Phase>,
    gate: &'a mut ApprovalGate,
    stop_memory: StopMemory,
    /// The newest heightmap and its stamp.
    seen: Option<(Arc<Heightmap>, Duration)>,
    /// The newest heightmap that is sure not to show the arm.
    without_arm: Option<Arc<Heightmap>>,
    /// Where the last motion has picked.
    picked: Option<Isometry2<f64>>,
    motion: Option<Motion>,
    driver: Arc<DriverClient>,
    status: watch::Receiver<DriverStatus>,
    origin: Instant,
    #[cfg(feature = "planted_faults")]
    planted: self::planted::Memory,
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
                (call, _) = self.home.recv() => self.on_propose_home(call),
                goal = self.goals.recv() => self.on_goal(goal),
                () = cancel_of(&self.goal) => self.on_goal_cancel(),
                Some(phase) = self.phases.recv() => self.say_phase(phase),
                (cause, stopped, ended) = end_of(&mut self.motion) => self.on_end(cause, stopped, ended),
                () = sleep_until(deadline) => self.ask_again(),
                _ = diagnostics.tick() => {
                    self.diagnose();
                    #[cfg(feature = "planted_faults")]
                    self.plant_now_and_then();
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
        let quiet = timeout_at(deadline, self.driver.heartbeat.quiet()).await;
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
        let watched = self.parameters.require_presence && !motion.is_stopped();
        watched.then(|| self.presence.deadline().unwrap_or_else(Instant::now))
    }

    fn on_absence(&mut self) {
        if let Some(motion) = &mut self.motion {
            warn!("no operator is present: stopping");
            motion.stop(StopCause::NobodyPresent);
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
                if !self.status.borrow().at_home.may_be_in_view(seen.stamp) {
                    self.without_arm = Some(Arc::clone(&seen.heightmap));
                }
                self.gate.on_heightmap(seen.stamp, seen.heightmap);
                self.plan_again();
                self.ask_again();
            }
            Err(error) => self.heightmaps.reject(error),
        }
    }

    fn robot(&self) -> RobotNow {
        RobotNow {
            arm: self.work_cell.arm.clone(),
            status: self.status.borrow().clone(),
            now: self.origin.elapsed(),
            max_age: Duration::from_secs_f64(self.parameters.driver.status_max_age_s),
            unattended: self.unattended(),
            refused: self.driver.refusal(),
            needs_home: self.parameters.observation_needs_home,
            time: Duration::from_nanos(self.node.clock().now_ns().max(0) as u64),
            seen: self.seen.clone(),
            observation_max_age: Duration::from_secs_f64(self.parameters.observation_max_age_s),
            contact: self.parameters.contact,
            sign: self.parameters.driver.contact,
            checker: Arc::clone(&self.checker),
            without_arm: self.without_arm.clone(),
            picked: self.picked,
        }
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
