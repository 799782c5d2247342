//! Topics in, motion and results out.

mod inputs;
mod outputs;
#[cfg(feature = "planted_faults")]
mod planted;

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use collision::{CollisionChecker, Margins};
use msgs::sctn_msgs;
use node_kit::{
    ActionServer, Active, Node, Publisher, Qos, RequestId, RunningGoal, ServiceServer,
    Subscription, when,
};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use rehearsal::{RehearsalRules, Rehearsals, Rehearsed};
use step_protocol::{Executor, Recovery, StopCause};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until, timeout_at};
use tracing::warn;
use ur_driver::{ActivateError, ActiveExecutor, DriverClient, RunningMotion, StopFile};

use crate::cell;
use crate::parameters::SuctionExecutorParameters;

/// How long a motion may take to stop when the node is deactivated.
const STOP_GRACE: Duration = Duration::from_millis(1500);
/// Where the process ends while a goal is unanswered, so long it waits for the answer, to cancel the goal: UR's released drivers take 2 s.
const ANSWER_GRACE: Duration = Duration::from_secs(3);
/// How long the result of a motion that was stopped at the end takes to be sent.
const LAST_WORD: Duration = Duration::from_millis(100);
const DIAGNOSTICS_PERIOD: Duration = Duration::from_millis(500);

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("suction_executor", arguments, configure)
}

/// Loads the work cell and listens to the driver; returns the node that executes proposals.
pub async fn configure(
    node: Node,
    parameters: SuctionExecutorParameters,
) -> anyhow::Result<ExecutorNode> {
    ur_driver::planted::check()?;
    let work_cell = cell::load(&parameters)?;
    let margins = Margins {
        obstacle_m: parameters.collision_margin_m,
        ..Margins::default()
    };
    let checker =
        CollisionChecker::new(&work_cell, margins).context("parameter collision_margin_m")?;
    let driver = DriverClient::new(&node, &parameters.driver, &work_cell)?;
    let path = &parameters.stop_file;
    let stop_file =
        StopFile::open(path).with_context(|| format!("parameter stop_file: {}", path.display()))?;
    let stopped = stop_file.text().map(str::to_owned);
    if let Some(reason) = &stopped {
        warn!("stopped before this start: {reason}. Nothing moves by itself before an approval");
    }
    let presence_timeout = Duration::from_secs_f64(parameters.presence_timeout_s);
    let presence_timeout = parameters.require_presence.then_some(presence_timeout);
    Ok(ExecutorNode {
        results: node.publisher("step_result", Qos::Event)?,
        planned: node.publisher("planned_motion", Qos::Latched)?,
        accepted: node.publisher("pick_place_goal", Qos::Event)?,
        protocol: Executor::new(parameters.gate_rules(), presence_timeout, stopped),
        stop_file,
        driver: Arc::new(driver),
        joint_names: work_cell.joint_names,
        rules: parameters.rehearsal_rules(work_cell.arm, checker),
        parameters,
    })
}

/// The configured node. What was used or stopped stays so while it is inactive.
pub struct ExecutorNode {
    results: Publisher<sctn_msgs::StepResult>,
    planned: Publisher<sctn_msgs::PlannedMotion>,
    /// Proposals that came as goals of the action.
    accepted: Publisher<sctn_msgs::PickPlace>,
    protocol: Executor,
    stop_file: StopFile,
    driver: Arc<DriverClient>,
    joint_names: [String; 6],
    rules: RehearsalRules,
    parameters: SuctionExecutorParameters,
}

impl Active for ExecutorNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let active = self.driver.activate(node).await?;
        self.protocol.activate();
        let executor = ActiveNode {
            proposals: node.subscription("pick_place", Qos::Latched)?,
            confirmations: node.subscription("step_confirmation", Qos::Event)?,
            heightmaps: node.subscription("heightmap", Qos::Latched)?,
            presences: node.subscription("operator_presence", Qos::Event)?,
            home: node.service_server("~/propose_home")?,
            put_down: node.service_server("~/propose_put_down")?,
            goals: node.action_server("execute_pick_place")?,
            rehearsals: Rehearsals::new(self.rules.clone()),
            rehearsing: None,
            goal: None,
            motion: None,
            #[cfg(feature = "planted_faults")]
            planted: self::planted::Memory::default(),
            origin: self.driver.origin,
            node: node.clone(),
            configured: self,
        };
        executor.run(&active).await
    }
}

type Goal = RunningGoal<sctn_msgs::ExecutePickPlace>;

struct ActiveNode<'a> {
    configured: &'a mut ExecutorNode,
    node: Node,
    proposals: Subscription<sctn_msgs::PickPlace>,
    confirmations: Subscription<sctn_msgs::StepConfirmation>,
    heightmaps: Subscription<sctn_msgs::Heightmap>,
    presences: Subscription<sctn_msgs::OperatorPresence>,
    home: ServiceServer<sctn_msgs::ProposeHome>,
    put_down: ServiceServer<sctn_msgs::ProposeHome>,
    goals: ActionServer<sctn_msgs::ExecutePickPlace>,
    rehearsals: Rehearsals<RequestId>,
    /// The rehearsal under way: on a thread of its own, because a stop must not wait for it.
    rehearsing: Option<JoinHandle<Rehearsed>>,
    goal: Option<Goal>,
    motion: Option<RunningMotion>,
    /// Of monotonic times.
    origin: std::time::Instant,
    #[cfg(feature = "planted_faults")]
    planted: self::planted::Memory,
}

impl ActiveNode<'_> {
    async fn run(mut self, active: &ActiveExecutor) -> anyhow::Result<()> {
        let node = self.node.clone();
        let mut is_deposed = false;
        let mut diagnostics = tokio::time::interval(DIAGNOSTICS_PERIOD);
        loop {
            let protocol = &self.configured.protocol;
            let deadline = protocol.deadline();
            let deadline = deadline.map(|deadline| Instant::from_std(self.origin + deadline));
            let is_cancelled = protocol.goal().is_some_and(|goal| goal.is_cancelled);
            let goal = self.goal.as_ref().filter(|_| !is_cancelled);
            tokio::select! {
                message = self.heightmaps.recv() => self.on_heightmap(message),
                message = self.proposals.recv() => self.on_proposal(message),
                message = self.confirmations.recv() => self.on_confirmation(message),
                message = self.presences.recv() => self.on_presence(&message),
                (call, _) = self.home.recv() => self.on_recovery_call(Recovery::Home, call),
                (call, _) = self.put_down.recv() => self.on_recovery_call(Recovery::PutDown, call),
                goal = self.goals.recv() => self.on_goal(goal),
                () = when(goal.map(Goal::cancel_requested)) => self.on_goal_cancel(),
                rehearsed = when(self.rehearsing.as_mut()) => self.on_rehearsed(rehearsed),
                event = when(self.motion.as_mut().map(RunningMotion::next)) => self.on_motion(event),
                () = when(deadline.map(sleep_until)) => self.on_time(),
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
        self.stop().await?;
        if is_deposed {
            return Err(ActivateError::AnotherIsActive.into());
        }
        Ok(())
    }

    /// Stops what moves, and waits until it has stopped.
    async fn stop(&mut self) -> anyhow::Result<()> {
        let cause = match self.node.is_ending() {
            true => StopCause::Shutdown,
            false => StopCause::Deactivated,
        };
        let deadline = Instant::now() + STOP_GRACE;
        let actions = self.configured.protocol.deactivate(cause);
        self.act(actions);
        let mut was_moving = false;
        while let Some(motion) = &mut self.motion {
            let event = timeout_at(deadline, motion.next())
                .await
                .with_context(|| format!("the arm has not stopped after {STOP_GRACE:?}"))?;
            self.on_motion(event);
            was_moving = true;
        }
        if was_moving {
            // The process may end at once.
            tokio::time::sleep(LAST_WORD).await;
        }
        // A goal that is accepted late is cancelled; where this process ends before that, by the watchdog.
        let deadline = match self.node.is_ending() {
            true => deadline + (ANSWER_GRACE - STOP_GRACE),
            false => deadline,
        };
        let heartbeat = &self.configured.driver.heartbeat;
        if timeout_at(deadline, heartbeat.quiet()).await.is_err() {
            warn!("the driver has not answered a goal");
        }
        Ok(())
    }
}
