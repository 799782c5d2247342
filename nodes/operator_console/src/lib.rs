//! Node that serves the operator's page: see, approve and stop a run in a browser. What the page shows and decides is the
//! library `console`; here messages are converted and commands carried out.

mod cameras;
mod commands;
mod convert;
mod parameters;

use std::sync::Arc;
use std::time::Duration;

use anyhow::Context as _;
use console::{Console, Joints, Page, Server, Watch};
use msgs::convert::{
    confirmation_from_msg, confirmation_refused_from_msg, goal_from_msg, observation_from_msg,
    pin_level, proposal_from_msg, result_from_msg, reward_from_msg,
};
use msgs::diagnostic_msgs::DiagnosticArray;
use msgs::sctn_msgs::{
    ConfirmationRefused, Goal, Heightmap, PickPlace, PlannedMotion, Reward, StepConfirmation,
    StepResult,
};
use msgs::sensor_msgs::{Image, JointState};
use msgs::std_msgs::{self, Bool, Float64};
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::IOStates;
use node_kit::{Active, Level, Node, Qos, Subscription};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use step_protocol::PRESENCE_PERIOD;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::commands::Commands;
use crate::convert::{motion_from_msg, report_from_msg, scores_from_msg};

pub use parameters::OperatorConsoleParameters;

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("operator_console", arguments, configure)
}

/// Reads certificate and key; what it returns serves the page while it is active.
pub async fn configure(
    node: Node,
    parameters: OperatorConsoleParameters,
) -> anyhow::Result<ConsoleNode> {
    let server =
        Server::new(parameters.server.clone()).context("parameters tls.certificate and tls.key")?;
    let watched = parameters.nodes.iter().filter(|name| !name.is_empty());
    let watch = Watch {
        nodes: watched.map(|name| node.resolve(name)).collect(),
        executor: node.resolve(&parameters.executor),
        image_topics: parameters
            .camera_preset
            .image_endings()
            .map(str::to_owned)
            .into(),
        stale_after: Duration::from_secs_f64(parameters.stale_after_s),
        changes: parameters.changes.rules(),
    };
    let page = Page::new(&parameters.page, watch);
    Ok(ConsoleNode {
        commands: Commands::new(&node, &parameters, page.clone())?,
        page,
        server,
        parameters,
    })
}

/// The configured node.
pub struct ConsoleNode {
    parameters: OperatorConsoleParameters,
    server: Server,
    page: Page,
    commands: Commands,
}

impl Active for ConsoleNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let console = Arc::clone(&self.page.console);
        let mut commands = console.connect();
        let end = CancellationToken::new();
        let _ended = end.clone().drop_guard();
        let (page, demonstration) = (self.page.clone(), self.parameters.demonstration.clone());
        let read = node.spawn_blocking(move || page.begin(&demonstration));
        read.await.context("reading the library panicked")?;
        self.serve(node, &end).await?;
        self.follow_cameras(node);
        let io_and_status = |name| format!("{}/{name}", self.parameters.io_and_status);
        let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
        let mut goals = node.subscription::<Goal>("goal", Qos::Latched)?;
        let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
        let mut accepted = node.subscription::<PickPlace>("pick_place_goal", Qos::Event)?;
        let mut confirmations =
            node.subscription::<StepConfirmation>("step_confirmation", Qos::Event)?;
        let mut results = node.subscription::<StepResult>("step_result", Qos::Event)?;
        let mut refused =
            node.subscription::<ConfirmationRefused>("confirmation_refused", Qos::Event)?;
        let mut rewards = node.subscription::<Reward>("reward", Qos::Event)?;
        let mut diagnostics = node.subscription::<DiagnosticArray>("/diagnostics", Qos::Event)?;
        let mut joints = node.subscription::<JointState>("joint_states", Qos::Event)?;
        let mut pins = node.subscription::<IOStates>(&io_and_status("io_states"), Qos::Event)?;
        let mut robot_modes =
            node.subscription::<RobotMode>(&io_and_status("robot_mode"), Qos::Latched)?;
        let mut safety_modes =
            node.subscription::<SafetyMode>(&io_and_status("safety_mode"), Qos::Latched)?;
        let mut running =
            node.subscription::<Bool>(&io_and_status("robot_program_running"), Qos::Latched)?;
        let mut speeds =
            node.subscription::<Float64>(&self.parameters.speed_scaling, Qos::Event)?;
        let mut motions = node.subscription::<PlannedMotion>("planned_motion", Qos::Latched)?;
        let mut scores = node.subscription::<Image>("pick_place/scores", Qos::Latched)?;
        let mut descriptions =
            node.subscription::<std_msgs::String>("robot_description", Qos::Latched)?;
        let mut heartbeats = node.subscription::<Bool>("motion_heartbeat", Qos::Event)?;
        let mut presence = tokio::time::interval(PRESENCE_PERIOD);
        presence.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // What an operator has decided goes before what is shown.
                biased;
                _ = presence.tick() => self.commands.publish_presence(node),
                Some(command) = commands.recv() => self.commands.carry_out(node, command),
                message = heightmaps.recv() => match observation_from_msg(message) {
                    Ok(seen) => console.change(|state, now| state.on_heightmap(seen, now)),
                    Err(error) => heightmaps.reject(error),
                },
                message = goals.recv() => {
                    let goal = goal_from_msg(message).map_err(anyhow::Error::from);
                    let shown = goal.and_then(|goal| Ok(console.change(|state, now| state.on_goal(goal, now))?));
                    if let Err(error) = shown {
                        goals.reject(error);
                    }
                }
                message = proposals.recv() => show_proposal(&console, &proposals, &message),
                message = accepted.recv() => show_proposal(&console, &accepted, &message),
                message = confirmations.recv() => match confirmation_from_msg(&message) {
                    Ok(confirmation) => console.change(|state, now| state.on_confirmation(&confirmation, now)),
                    Err(refusal) => confirmations.reject(refusal),
                },
                message = results.recv() => match result_from_msg(&message) {
                    Ok(result) => console.change(|state, now| state.on_result(&result, now)),
                    Err(error) => results.reject(error),
                },
                message = motions.recv() => match motion_from_msg(message) {
                    Ok(motion) => console.change(|state, now| state.on_planned_motion(motion, now)),
                    Err(error) => motions.reject(error),
                },
                message = scores.recv() => match scores_from_msg(message) {
                    Ok(scores) => console.change(|state, _| state.run.on_scores(scores)),
                    Err(error) => scores.reject(error),
                },
                message = descriptions.recv() => {
                    if let Err(error) = console.change(|state, _| state.run.on_robot_description(message.data)) {
                        descriptions.reject(error);
                    }
                }
                message = refused.recv() => {
                    let (id, kind) = confirmation_refused_from_msg(&message);
                    console.change(|state, now| state.run.on_confirmation_refused(id, kind, &message.message, now));
                }
                message = rewards.recv() => match reward_from_msg(&message) {
                    Ok(reward) => console.change(|state, _| state.run.on_reward(reward)),
                    Err(error) => rewards.reject(error),
                },
                message = diagnostics.recv() => {
                    let reports = message.status.into_iter().filter_map(report_from_msg);
                    console.change_quietly(|state, now| {
                        reports.for_each(|report| state.run.on_report(report, now));
                    });
                }
                message = joints.recv() => match Joints::new(message.name, message.position) {
                    Ok(read) => console.hear(|state, now| state.run.on_joints(read, now)),
                    Err(error) => joints.reject(error),
                },
                message = heartbeats.recv() => console.change_quietly(|state, now| state.run.on_motion(message.data, now)),
                message = pins.recv() => {
                    let suction = pin_level(&message.digital_out_states, self.parameters.suction_pin);
                    let vacuum = pin_level(&message.digital_in_states, self.parameters.vacuum_pin);
                    console.hear(|state, _| state.run.on_pins(suction, vacuum));
                }
                message = robot_modes.recv() => console.change(|state, _| state.run.on_robot_mode(message.mode)),
                message = safety_modes.recv() => console.change(|state, _| state.run.on_safety_mode(message.mode)),
                message = speeds.recv() => console.change_quietly(|state, _| state.run.on_speed_scaling(message.data)),
                message = running.recv() => console.change(|state, _| state.run.on_program(message.data)),
            }
        }
    }
}

/// Viewers see a proposal, of a topic or of the executor's action.
fn show_proposal(console: &Console, topic: &Subscription<PickPlace>, message: &PickPlace) {
    let proposal = proposal_from_msg(message).map_err(anyhow::Error::from);
    let shown = proposal
        .and_then(|proposal| Ok(console.change(|state, now| state.on_proposal(proposal, now))?));
    if let Err(error) = shown {
        topic.reject(error);
    }
}

impl ConsoleNode {
    /// Serves the page until `end`.
    async fn serve(&self, node: &Node, end: &CancellationToken) -> anyhow::Result<()> {
        let listening = self.server.listen().await;
        let listening = listening.context("parameters address and port")?;
        let printed = listening.announce().context("parameter address_file")?;
        if let Some(address) = printed {
            // Standard output may be a program's result.
            eprintln!("operator console: {address}");
        }
        // Logs go to every node: never the token.
        let served = format!("served on {}", listening.address());
        info!("the operator's page is {served}");
        node.diagnostics().set("page", Level::Ok, served, []);
        listening.serve(self.page.clone(), end);
        Ok(())
    }

    /// Keeps images and transforms while the node is active.
    fn follow_cameras(&self, node: &Node) {
        let cameras = || Arc::clone(&self.page.cameras);
        let transforms = cameras::follow_transforms(node.clone(), cameras());
        show(node, "a proposal on the cameras' images".into(), transforms);
        let names = self.parameters.page.cameras.iter();
        for name in names.filter(|name| !name.is_empty()) {
            let topics = self.parameters.camera_preset.topics(name);
            let images = cameras::follow(node.clone(), cameras(), name.clone(), topics);
            show(node, format!("camera {name}"), images);
        }
    }
}

/// Does `work`, on a task of its own; `what` is not shown without it.
fn show(
    node: &Node,
    what: String,
    work: impl Future<Output = anyhow::Result<()>> + Send + 'static,
) {
    node.spawn(async move {
        if let Err(error) = work.await {
            warn!("{what} is not shown: {error:#}");
        }
    });
}
