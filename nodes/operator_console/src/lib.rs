//! Node that serves the operator's page: see, approve and stop a run in a browser. What the page shows and decides is the
//! library `console`; here messages are converted and commands carried out.

mod cameras;
mod commands;
mod convert;
mod parameters;

use std::fs::OpenOptions;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use console::{
    Access, Cameras, Checkpoints, Console, Libraries, Listener, Page, Phase, Run, Sessions,
    TlsAcceptor, Trainings, Watch,
};
use msgs::convert::{
    confirmation_from_msg, confirmation_refused_from_msg, goal_from_msg, observation_from_msg,
    proposal_from_msg, result_from_msg, reward_from_msg,
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
use node_kit::{Active, Level, Node, Qos};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::commands::{Commands, show_demonstration};
use crate::convert::{joints_from_msg, level, motion_from_msg, report_from_msg, scores_from_msg};

pub use parameters::{OperatorConsoleParameters, Tls};

/// Time between messages that say whether the operator is present.
const PRESENCE_PERIOD: Duration = Duration::from_millis(200);
/// Joint states are taken over at most this often: a UR5 sends 500 a second.
const JOINTS_PERIOD: Duration = Duration::from_millis(100);

/// Reads certificate and key; what it returns serves the page while it is active.
pub async fn configure(
    node: Node,
    parameters: OperatorConsoleParameters,
) -> anyhow::Result<ConsoleNode> {
    let tls = match parameters.has_tls() {
        true => {
            let Tls { certificate, key } = &parameters.tls;
            Some(
                console::tls_acceptor(certificate, key)
                    .context("parameters tls.certificate and tls.key")?,
            )
        }
        false => None,
    };
    let watch = Watch {
        nodes: parameters
            .nodes
            .iter()
            .filter(|name| !name.is_empty())
            .map(|name| node.resolve(name))
            .collect(),
        executor: node.resolve(&parameters.executor),
        stale_after: Duration::from_secs_f64(parameters.stale_after_s),
        changes: heightmap::ChangeRules::new(
            parameters.observation_tolerance_m,
            1e-6 * parameters.observation_changed_area_mm2,
        ),
    };
    let session_timeout = Duration::from_secs_f64(parameters.session_timeout_s);
    let sessions = Sessions::new(parameters.max_viewers, session_timeout);
    let checkpoints = [parameters.checkpoints.clone(), parameters.training.clone()];
    let trainings = Trainings::new(
        parameters.sctn.clone(),
        parameters.recipe.clone(),
        parameters.training.clone(),
        parameters.checkpoint.clone(),
    );
    let cameras = Cameras::new(&parameters.cameras, &parameters.world_frame);
    let page = Page {
        console: Arc::new(Console::new(Run::new(watch), sessions)),
        libraries: Arc::new(Libraries::new(&parameters.library)),
        checkpoints: Arc::new(Checkpoints::new(checkpoints)),
        trainings: Arc::new(trainings),
        cameras: Arc::new(cameras),
    };
    Ok(ConsoleNode {
        commands: Commands::new(&node, &parameters, page.clone())?,
        token: match parameters.token.as_str() {
            "" => console::secret(),
            token => token.to_owned(),
        },
        page,
        tls,
        parameters,
    })
}

/// The configured node.
pub struct ConsoleNode {
    parameters: OperatorConsoleParameters,
    token: String,
    tls: Option<TlsAcceptor>,
    page: Page,
    commands: Commands,
}

impl Active for ConsoleNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let console = Arc::clone(&self.page.console);
        let mut commands = console.connect();
        let end = CancellationToken::new();
        let _ended = end.clone().drop_guard();
        if self.parameters.demonstration != Path::new("") {
            let path = self.parameters.demonstration.clone();
            show_demonstration(node, &console, path).await;
        }
        let libraries = Arc::clone(&self.page.libraries);
        let open_run = node.spawn_blocking(move || libraries.history.open_run());
        if let Some(run) = open_run.await.context("reading the history panicked")? {
            console.change(|state, _| state.resume_run(run));
        }
        self.serve(node, &end).await?;
        self.follow_cameras(node, &end);
        let io_and_status = |name| format!("{}/{name}", self.parameters.io_and_status);
        let mut heightmaps = node.subscription::<Heightmap>("heightmap", Qos::Latched)?;
        let mut goals = node.subscription::<Goal>("goal", Qos::Latched)?;
        let mut proposals = node.subscription::<PickPlace>("pick_place", Qos::Latched)?;
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
        let mut joints_taken: Option<Instant> = None;
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
                message = proposals.recv() => {
                    let proposal = proposal_from_msg(&message).map_err(anyhow::Error::from);
                    let shown = proposal
                        .and_then(|proposal| Ok(console.change(|state, now| state.on_proposal(proposal, now))?));
                    if let Err(error) = shown {
                        proposals.reject(error);
                    }
                }
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
                message = joints.recv() => {
                    if joints_taken.is_none_or(|taken| taken.elapsed() >= JOINTS_PERIOD) {
                        joints_taken = Some(Instant::now());
                        match joints_from_msg(message) {
                            Ok((names, positions_rad)) => show_joints(&console, names, positions_rad),
                            Err(error) => joints.reject(error),
                        }
                    }
                }
                message = pins.recv() => {
                    let suction = level(&message.digital_out_states, self.parameters.suction_pin);
                    let vacuum = level(&message.digital_in_states, self.parameters.vacuum_pin);
                    console.change_quietly(|state, _| state.run.on_robot(|robot| {
                        robot.suction = suction;
                        robot.vacuum = vacuum;
                    }));
                }
                message = robot_modes.recv() => {
                    console.change(|state, _| state.run.on_robot(|robot| robot.robot_mode = Some(message.mode)));
                }
                message = safety_modes.recv() => {
                    console.change(|state, _| state.run.on_robot(|robot| robot.safety_mode = Some(message.mode)));
                }
                message = speeds.recv() => {
                    // The driver tells percents.
                    let share = (message.data.is_finite()).then_some(message.data / 100.0);
                    console.change_quietly(|state, _| state.run.on_robot(|robot| robot.speed_scaling = share));
                }
                message = running.recv() => {
                    console.change(|state, _| state.run.on_robot(|robot| robot.program_running = Some(message.data)));
                }
            }
        }
    }
}

/// Viewers see the arm move.
fn show_joints(console: &Console, names: Vec<String>, positions_rad: Vec<f64>) {
    let change = |state: &mut console::State, now| state.run.on_joints(names, positions_rad, now);
    match console.read(|state, _| state.run.phase()) {
        Phase::Moving => console.change(change),
        _ => console.change_quietly(change),
    }
}

impl ConsoleNode {
    /// Serves the page until `end`.
    async fn serve(&self, node: &Node, end: &CancellationToken) -> anyhow::Result<()> {
        let socket = self.parameters.socket()?;
        let listener = Listener::bind(socket, self.tls.clone())
            .await
            .with_context(|| format!("parameters address and port: cannot listen on {socket}"))?;
        let address = listener.address();
        let tls = self.tls.is_some();
        let scheme = if tls { "https" } else { "http" };
        let page = format!("{scheme}://{address}/#token={}", self.token);
        if self.parameters.address_file == Path::new("") {
            // Standard output may be a program's result.
            eprintln!("operator console: {page}");
        } else {
            write_address(&self.parameters.address_file, &page)?;
        }
        // Logs go to every node: never the token.
        info!("the operator's page is served on {scheme}://{address}/");
        node.diagnostics().set(
            "page",
            Level::Ok,
            format!("served on {scheme}://{address}/"),
            [],
        );
        let access = Access::new(
            self.token.clone(),
            address,
            &self.parameters.host_names,
            tls,
        );
        let router = console::router(self.page.clone(), access, end.clone());
        let ended = end.clone().cancelled_owned();
        tokio::spawn(async move {
            let served = axum::serve(listener, router).with_graceful_shutdown(ended);
            if let Err(error) = served.await {
                warn!("the page is no longer served: {error}");
            }
        });
        Ok(())
    }

    /// Keeps images and transforms until `end`.
    fn follow_cameras(&self, node: &Node, end: &CancellationToken) {
        let watch =
            |what: String, work: Pin<Box<dyn Future<Output = anyhow::Result<()>> + Send>>| {
                let work = end.clone().run_until_cancelled_owned(work);
                node.spawn(async move {
                    if let Some(Err(error)) = work.await {
                        warn!("{what} is not shown: {error:#}");
                    }
                });
            };
        let cameras = || Arc::clone(&self.page.cameras);
        let transforms = cameras::follow_transforms(node.clone(), cameras());
        watch(
            "a proposal on the cameras' images".to_owned(),
            Box::pin(transforms),
        );
        for name in self
            .parameters
            .cameras
            .iter()
            .filter(|name| !name.is_empty())
        {
            let images = cameras::follow(node.clone(), cameras(), name.clone());
            watch(format!("camera {name}"), Box::pin(images));
        }
    }
}

/// Whole or not at all, for the owner alone: it holds the token.
fn write_address(path: &Path, page: &str) -> anyhow::Result<()> {
    let shown = || format!("parameter address_file: {}", path.display());
    let mut partial = path.as_os_str().to_owned();
    partial.push(".partial");
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(true).mode(0o600);
    let mut file = options.open(&partial).with_context(shown)?;
    writeln!(file, "{page}").with_context(shown)?;
    std::fs::rename(&partial, path).with_context(shown)
}
