//! Node that serves the operator's page: see, approve and stop a run in a browser.
//!
//! `run::Run` is what the operator sees, `session::Sessions` who watches and who decides; neither knows ROS
//! node, clock or network.

mod cameras;
mod checkpoints;
mod console;
mod history;
mod lesson;
mod library;
mod parameters;
mod preview;
mod refusal;
mod run;
mod server;
mod session;
mod tls;
mod training;

use std::fs::OpenOptions;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use bags::Demonstration;
use msgs::convert;
use msgs::diagnostic_msgs::DiagnosticArray;
use msgs::sctn_msgs::{
    ConfirmationRefused, Goal, Heightmap, LoadCheckpoint, LoadCheckpointRequest, LoadDemonstration,
    LoadDemonstrationRequest, OperatorPresence, PickPlace, PlannedMotion, ProposeHome,
    ProposeHomeRequest, Reward, SetStep, SetStepRequest, StepConfirmation, StepResult,
};
use msgs::sensor_msgs::{Image, JointState};
use msgs::std_msgs::{self, Bool, Float64, Header};
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::{Digital, IOStates};
use node_kit::{Active, CallOptions, Level, Node, Publisher, Qos, ServiceClient};
use tokio::time::MissedTickBehavior;
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;
use tracing::{info, warn};

use crate::cameras::Cameras;
use crate::checkpoints::Checkpoints;
use crate::console::{Command, Console, PolicyState};
use crate::library::Libraries;
use crate::run::{Phase, Run, Watch};
use crate::server::Access;
use crate::session::Sessions;
use crate::tls::Listener;
use crate::training::Trainings;

pub use parameters::{OperatorConsoleParameters, Tls};

/// Time between messages that say whether the operator is present.
const PRESENCE_PERIOD: Duration = Duration::from_millis(200);
/// Joint states are taken over at most this often: a UR5 sends 500 a second.
const JOINTS_PERIOD: Duration = Duration::from_millis(100);
const CHOOSE_ANOTHER: &str =
    "Choose another demonstration, or look whether the goal oracle is at work.";
/// How long the plan of the way home may take.
const HOME_TIMEOUT: CallOptions = CallOptions {
    attempts: 1,
    timeout: Duration::from_secs(60),
};

/// A secret of 256 random bits, for tokens and sessions.
pub(crate) fn secret() -> String {
    let bytes: [u8; 32] = rand::random();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Reads certificate and key; what it returns serves the page while it is active.
pub async fn configure(
    node: Node,
    parameters: OperatorConsoleParameters,
) -> anyhow::Result<ConsoleNode> {
    let tls = match parameters.has_tls() {
        true => Some(tls::acceptor(
            &parameters.tls.certificate,
            &parameters.tls.key,
        )?),
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
    Ok(ConsoleNode {
        confirmations: node.publisher("step_confirmation", Qos::Event)?,
        proposals: node.publisher("pick_place", Qos::Latched)?,
        presence: node.publisher("operator_presence", Qos::Event)?,
        home: Arc::new(node.service_client(&format!("{}/propose_home", parameters.executor))?),
        set_step: Arc::new(node.service_client(&format!("{}/set_step", parameters.goal_oracle))?),
        load: Arc::new(
            node.service_client(&format!("{}/load_demonstration", parameters.goal_oracle))?,
        ),
        libraries: Arc::new(Libraries::new(&parameters.library)),
        checkpoints: Arc::new(Checkpoints::new([
            parameters.checkpoints.clone(),
            parameters.training.clone(),
        ])),
        trainings: Arc::new(Trainings::new(
            parameters.sctn.clone(),
            parameters.recipe.clone(),
            parameters.training.clone(),
            parameters.checkpoint.clone(),
        )),
        load_checkpoint: Arc::new(
            node.service_client(&format!("{}/load_checkpoint", parameters.policy))?,
        ),
        cameras: Arc::new(Cameras::new(&parameters.cameras, &parameters.world_frame)),
        token: match parameters.token.as_str() {
            "" => secret(),
            token => token.to_owned(),
        },
        console: Arc::new(Console::new(Run::new(watch), sessions)),
        tls,
        parameters,
    })
}

/// The configured node.
pub struct ConsoleNode {
    parameters: OperatorConsoleParameters,
    token: String,
    tls: Option<TlsAcceptor>,
    console: Arc<Console>,
    confirmations: Publisher<StepConfirmation>,
    proposals: Publisher<PickPlace>,
    presence: Publisher<OperatorPresence>,
    home: Arc<ServiceClient<ProposeHome>>,
    set_step: Arc<ServiceClient<SetStep>>,
    load: Arc<ServiceClient<LoadDemonstration>>,
    libraries: Arc<Libraries>,
    checkpoints: Arc<Checkpoints>,
    trainings: Arc<Trainings>,
    load_checkpoint: Arc<ServiceClient<LoadCheckpoint>>,
    cameras: Arc<Cameras>,
}

impl Active for ConsoleNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut commands = self.console.connect();
        let end = CancellationToken::new();
        let _ended = end.clone().drop_guard();
        if self.parameters.demonstration != Path::new("") {
            let path = self.parameters.demonstration.clone();
            show_demonstration(node, &self.console, path).await;
        }
        let libraries = Arc::clone(&self.libraries);
        let open_run = node.spawn_blocking(move || libraries.history.open_run());
        if let Some(run) = open_run.await.context("reading the history panicked")? {
            self.console.change(|state, _| state.resume_run(run));
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
        let console = Arc::clone(&self.console);
        let mut joints_taken: Option<Instant> = None;
        let mut presence = tokio::time::interval(PRESENCE_PERIOD);
        presence.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // What an operator has decided goes before what is shown.
                biased;
                _ = presence.tick() => self.publish_presence(node),
                Some(command) = commands.recv() => self.carry_out(node, command),
                message = heightmaps.recv() => {
                    if let Err(reason) = console.change(|state, now| state.on_heightmap(message, now)) {
                        heightmaps.reject(reason);
                    }
                }
                message = goals.recv() => {
                    if let Err(reason) = console.change(|state, now| state.on_goal(message, now)) {
                        goals.reject(reason);
                    }
                }
                message = proposals.recv() => {
                    if let Err(reason) = console.change(|state, now| state.on_proposal(message, now)) {
                        proposals.reject(reason);
                    }
                }
                message = confirmations.recv() => console.change(|state, now| state.on_confirmation(&message, now)),
                message = results.recv() => {
                    if let Err(reason) = console.change(|state, now| state.on_result(&message, now)) {
                        results.reject(reason);
                    }
                }
                message = motions.recv() => {
                    if let Err(reason) = console.change(|state, now| state.on_planned_motion(message, now)) {
                        motions.reject(reason);
                    }
                }
                message = scores.recv() => {
                    if let Err(reason) = console.change(|state, _| state.run.on_scores(message)) {
                        scores.reject(reason);
                    }
                }
                message = descriptions.recv() => {
                    if let Err(reason) = console.change(|state, _| state.run.on_robot_description(message.data)) {
                        descriptions.reject(reason);
                    }
                }
                message = refused.recv() => {
                    console.change(|state, now| state.run.on_confirmation_refused(&message, now));
                }
                message = rewards.recv() => console.change(|state, _| state.run.on_reward(message)),
                message = diagnostics.recv() => {
                    console.change_quietly(|state, now| state.run.on_diagnostics(message, now));
                }
                message = joints.recv() => {
                    if joints_taken.is_none_or(|taken| taken.elapsed() >= JOINTS_PERIOD) {
                        joints_taken = Some(Instant::now());
                        let JointState { name, position, .. } = message;
                        if name.len() != position.len() || name.len() > 64 {
                            joints.reject(format_args!(
                                "{} names and {} positions, expected as many of each, at most 64", name.len(), position.len()
                            ));
                            continue;
                        }
                        let change = |state: &mut console::State, now| state.run.on_joints(name, position, now);
                        // Viewers see the arm move.
                        match console.read(|state, _| state.run.phase()) {
                            Phase::Moving => console.change(change),
                            _ => console.change_quietly(change),
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
        let router = server::router(
            Arc::clone(&self.console),
            Arc::clone(&self.libraries),
            Arc::clone(&self.checkpoints),
            Arc::clone(&self.trainings),
            Arc::clone(&self.cameras),
            access,
            end.clone(),
        );
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
        let cameras = || Arc::clone(&self.cameras);
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

    fn publish_presence(&self, node: &Node) {
        let mut message = self.console.read(|state, now| {
            let (name, is_present) = state.sessions.presence(now).unwrap_or(("", false));
            OperatorPresence {
                operator_name: name.to_owned(),
                is_present,
                ..OperatorPresence::default()
            }
        });
        message.header.stamp = node.now();
        self.presence.publish(message);
    }

    fn carry_out(&self, node: &Node, command: Command) {
        match command {
            Command::Confirm(mut confirmation) => {
                confirmation.header.stamp = node.now();
                let StepConfirmation {
                    proposal_id,
                    decision,
                    operator_name,
                    ..
                } = &confirmation;
                info!("`{operator_name}`: decision {decision} on proposal {proposal_id}");
                self.publish_presence(node);
                self.confirmations.publish(confirmation);
            }
            Command::Propose(proposal) => {
                info!("an operator's proposal {}", proposal.id);
                self.proposals.publish(*proposal);
            }
            Command::Home(name) => {
                info!("`{name}` asks for the way home");
                self.publish_presence(node);
                let (client, console) = (Arc::clone(&self.home), Arc::clone(&self.console));
                node.spawn(async move {
                    // The executor has to hear that the operator is present before the call, also where they have just taken control.
                    tokio::time::sleep(PRESENCE_PERIOD).await;
                    let answer = client
                        .call(&ProposeHomeRequest::default(), &HOME_TIMEOUT)
                        .await;
                    let reason = match answer {
                        Ok(answer) if answer.success => {
                            let (id, asks) = (answer.proposal_id, answer.needs_approval);
                            return console.change(|state, _| state.on_home(id, asks));
                        }
                        Ok(answer) => answer.message,
                        Err(error) => error.to_string(),
                    };
                    let advice = refusal::advice(&reason);
                    let text = format!("There is no way home: {reason}");
                    console.change(|state, now| state.run.note("refusal", text, advice, now));
                });
            }
            Command::Load(demonstration, path, name) => {
                info!("`{name}`: repeat {}", path.display());
                let (client, console) = (Arc::clone(&self.load), Arc::clone(&self.console));
                let request = LoadDemonstrationRequest {
                    request_id: secret(),
                    path: path.display().to_string(),
                };
                let shown = node.clone();
                node.spawn(async move {
                    let goals = show_demonstration(&shown, &console, path).await;
                    let answer = client.call(&request, &CallOptions::default()).await;
                    let (kind, reason, advice) = match answer {
                        Ok(answer) if answer.success => {
                            if let Some(goals) = goals {
                                console.change(|state, _| state.on_loaded(demonstration, goals));
                            }
                            ("note", format!("The run repeats {}.", answer.message), "")
                        }
                        Ok(answer) => (
                            "refusal",
                            format!("The demonstration was not loaded: {}", answer.message),
                            CHOOSE_ANOTHER,
                        ),
                        Err(error) => (
                            "refusal",
                            format!("The demonstration was not loaded: {error}"),
                            CHOOSE_ANOTHER,
                        ),
                    };
                    console.change(|state, now| state.run.note(kind, reason, advice, now));
                });
            }
            Command::LoadCheckpoint(path, name) => {
                info!("`{name}`: checkpoint {}", path.display());
                let client = Arc::clone(&self.load_checkpoint);
                let trainings = Arc::clone(&self.trainings);
                let console = Arc::clone(&self.console);
                let request = LoadCheckpointRequest {
                    request_id: secret(),
                    path: path.display().to_string(),
                };
                node.spawn(async move {
                    let answer = client.call(&request, &CallOptions::default()).await;
                    console.change(|state, now| {
                        let refused = match answer {
                            Ok(answer) if answer.success => {
                                let shown = path.file_stem().unwrap_or_default().to_string_lossy();
                                let reason =
                                    format!("The policy uses {shown} from its next proposal on.");
                                state.run.note("note", reason, "", now);
                                trainings.begin_with(&answer.path);
                                state.policy = Some(PolicyState {
                                    checkpoint: answer.path,
                                    previous: answer.previous,
                                });
                                return;
                            }
                            Ok(answer) => answer.message,
                            Err(error) => error.to_string(),
                        };
                        let reason = format!("The policy has kept its checkpoint: {refused}.");
                        let advice =
                            "Choose another checkpoint, or look whether the policy is at work.";
                        state.run.note("refusal", reason, advice, now);
                    });
                });
            }
            Command::Record(event) => {
                let libraries = Arc::clone(&self.libraries);
                self.write(node, "how a run went", move || {
                    libraries
                        .history
                        .add(event)
                        .map_err(|error| error.to_string())
                });
            }
            Command::Keep(correction) => {
                let libraries = Arc::clone(&self.libraries);
                let (name, demonstration) = *correction;
                info!("correction {name}");
                self.write(node, "a correction", move || {
                    let saved = libraries.corrections.save(&name, &demonstration);
                    saved.map_err(|refusal| refusal.reason)
                });
            }
            Command::SetStep(step, name) => {
                info!("`{name}`: continue with step {step}");
                let (client, console) = (Arc::clone(&self.set_step), Arc::clone(&self.console));
                let request = SetStepRequest {
                    request_id: secret(),
                    step,
                };
                node.spawn(async move {
                    let reason = match client.call(&request, &CallOptions::default()).await {
                        Ok(answer) if answer.success => return,
                        Ok(answer) => answer.message,
                        Err(error) => error.to_string(),
                    };
                    console.change(|state, now| {
                        let advice = "Look whether the goal oracle is at work.";
                        let reason = format!("The run did not continue: {reason}");
                        state.run.note("refusal", reason, advice, now);
                    });
                });
            }
        }
    }
}

impl ConsoleNode {
    /// Writes something of the library on a thread of its own; viewers are told.
    fn write(
        &self,
        node: &Node,
        what: &'static str,
        write: impl FnOnce() -> Result<(), String> + Send + 'static,
    ) {
        let console = Arc::clone(&self.console);
        node.spawn_blocking(move || match write() {
            Ok(()) => console.change(|state, _| state.library_changed()),
            Err(error) => {
                warn!("{what} was not kept: {error}");
                let reason =
                    format!("What was learned from the run was not kept ({what}): {error}");
                let advice = "Look at the parameter library and at the disk.";
                console.change(|state, now| state.run.note("fault", reason, advice, now));
            }
        });
    }
}

/// Name and goal images of a demonstration.
fn read_demonstration(path: &Path) -> anyhow::Result<(String, Vec<Heightmap>)> {
    let demonstration = Demonstration::read(path)?;
    let image = |heightmap: &heightmap::Heightmap| {
        convert::heightmap_to_msg(heightmap.clone(), Header::default(), 0, 0.0)
    };
    let images = demonstration.goals().into_iter().map(image);
    Ok((demonstration.name(), images.collect::<Result<_, _>>()?))
}

/// Shows the images of a demonstration before they are latched. Returns its name in the goals; nothing where it cannot be read.
async fn show_demonstration(node: &Node, console: &Console, path: PathBuf) -> Option<String> {
    let reading = path.clone();
    let read = node.spawn_blocking(move || read_demonstration(&reading));
    match read.await.context("reading panicked").flatten() {
        Ok((name, images)) => {
            let shown = name.clone();
            console.change(|state, now| state.run.on_demonstration(shown, images, now));
            Some(name)
        }
        Err(error) => {
            warn!("demonstration {}: {error:#}", path.display());
            None
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

fn level(states: &[Digital], pin: u8) -> Option<bool> {
    let mut states = states.iter();
    states
        .find(|state| state.pin == pin)
        .map(|state| state.state)
}
