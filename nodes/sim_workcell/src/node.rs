//! Services and actions of the simulated driver. What they ask is passed on to the thread of `hardware`.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::SystemTime;

use anyhow::Context as _;
use camera_noise::Perturbation;
use driver_model::{Controllers, HardwareSettings};
use msgs::control_msgs::FollowJointTrajectory;
use msgs::controller_manager_msgs::{
    ControllerState, ListControllers, ListControllersResponse, SwitchController,
    SwitchControllerResponse,
};
use msgs::sctn_msgs::{ResetCell, ResetCellRequest, ResetCellResponse};
use msgs::ur_msgs::{
    FollowJointTrajectoryUntil, GetRobotSoftwareVersion, GetRobotSoftwareVersionResponse, SetIO,
    SetIORequest, SetIOResponse,
};
use multiravens::Problem;
use node_kit::{Active, NewGoal, Node};
use simulated_cell::{SimulatedCell, Wiring};
use tokio::sync::oneshot;
use tracing::{error, warn};
use ur5::WorkCell;

use crate::hardware::Hardware;
use crate::parameters::SimWorkcellParameters;

/// Commands that wait for the hardware's thread; more are refused.
const WAITING_COMMANDS: usize = 64;

/// Begins the episode and returns the node that emulates the UR driver and the cameras.
pub async fn configure(
    node: Node,
    parameters: SimWorkcellParameters,
) -> anyhow::Result<HardwareNode> {
    let problem = Problem::load(&parameters.problems_dir, &parameters.problem)?;
    let work_cell = match parameters.urdf.as_path() {
        path if path == Path::new("") => WorkCell::builtin(),
        path => WorkCell::load(path),
    }
    .context("parameter urdf")?;
    if let Some(warning) = work_cell.warning() {
        warn!("parameter urdf: {warning}");
    }
    let wiring = Wiring {
        suction_pin: parameters.suction_pin,
        vacuum_pin: parameters.vacuum_pin,
    };
    let perturbation = match parameters.perturbation.as_path() {
        path if path == Path::new("") => None,
        path => Some(Perturbation::load(path).context("parameter perturbation")?),
    };
    let seed = parameters.seed;
    let behaviour = parameters.hardware.clone();
    let mut cell = tokio::task::spawn_blocking({
        let (work_cell, behaviour) = (work_cell.clone(), behaviour.clone());
        move || SimulatedCell::new(&problem, &work_cell, seed, wiring, perturbation, behaviour)
    })
    .await
    .context("setting up the episode")??;
    if behaviour.free_running {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        cell.begin_at(now.context("the clock is before 1970")?);
    }
    let controller = controller_of(&parameters.follow_action);
    let shared = Arc::new(Shared {
        stop: AtomicBool::new(false),
        dead: AtomicBool::new(false),
        controllers: Mutex::new(Controllers::new(
            controller,
            &behaviour.inactive_controllers,
            behaviour.software_major,
        )),
    });

    let (follow_action, until_action) = (
        parameters.follow_action.clone(),
        parameters.until_action.clone(),
    );
    let (sender, commands) = mpsc::sync_channel(WAITING_COMMANDS);
    let hardware = Hardware::new(
        &node,
        parameters,
        cell,
        work_cell,
        commands,
        Arc::clone(&shared),
    )?;
    Ok(HardwareNode {
        hardware: Some(hardware),
        sender,
        shared,
        behaviour,
        follow_action,
        until_action,
    })
}

/// The controller behind an action: the first part of its name.
pub(crate) fn controller_of(action: &str) -> &str {
    action
        .trim_start_matches('/')
        .split('/')
        .next()
        .unwrap_or("")
}

/// What the services and the hardware's thread share.
pub(crate) struct Shared {
    /// The node is no longer active.
    pub(crate) stop: AtomicBool,
    /// The driver's process is gone.
    pub(crate) dead: AtomicBool,
    controllers: Mutex<Controllers>,
}

impl Shared {
    pub(crate) fn controllers(&self) -> MutexGuard<'_, Controllers> {
        self.controllers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

/// The configured node. While it is inactive the cell stays as it is, and nothing is said.
pub struct HardwareNode {
    /// Its thread has it while the node is active.
    hardware: Option<Hardware>,
    sender: mpsc::SyncSender<Command>,
    shared: Arc<Shared>,
    behaviour: HardwareSettings,
    follow_action: String,
    until_action: String,
}

impl Drop for HardwareNode {
    /// Where the runtime ends without deactivation, the hardware's thread ends too.
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
    }
}

impl Active for HardwareNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let mut follow = node.action_server::<FollowJointTrajectory>(&self.follow_action)?;
        let mut until = node.action_server::<FollowJointTrajectoryUntil>(&self.until_action)?;
        let mut set_io = node.service_server::<SetIO>("io_and_status_controller/set_io")?;
        let mut reset = node.service_server::<ResetCell>("~/reset")?;
        let mut list =
            node.service_server::<ListControllers>("controller_manager/list_controllers")?;
        let mut switch =
            node.service_server::<SwitchController>("controller_manager/switch_controller")?;
        let mut version = node.service_server::<GetRobotSoftwareVersion>(
            "ur_configuration_controller/get_robot_software_version",
        )?;
        let repeats = self.behaviour.strict_actions.then(|| {
            // rclcpp answers, and throws where it adds the goal to those that it has.
            (follow.count_repeats(true), until.count_repeats(false))
        });
        let mut repeats = repeats.map(|(follow, _)| follow);
        let hardware = self.hardware.take();
        let mut hardware = hardware.context("the hardware's thread has not ended")?;
        self.shared.stop.store(false, Ordering::Release);
        let mut thread = node.spawn_blocking(move || {
            let ended = hardware.run();
            (hardware, ended)
        });
        let (sender, shared) = (&self.sender, &self.shared);
        let alive = || !shared.dead.load(Ordering::Acquire);
        loop {
            tokio::select! {
                goal = follow.recv() => pass_on(sender, Command::Follow(goal)),
                goal = until.recv() => pass_on(sender, Command::Until(goal)),
                () = repeated(&mut repeats) => {
                    error!("a goal id has come twice: the trajectory controller's process is gone");
                    pass_on(sender, Command::Die);
                }
                (id, request) = set_io.recv() => {
                    let (reply, replied) = oneshot::channel();
                    pass_on(sender, Command::SetIo(request, reply));
                    tokio::select! {
                        // Dropped where the command was not taken.
                        success = replied => {
                            let success = success.unwrap_or(false);
                            set_io.respond(id, SetIOResponse { success });
                        }
                        // A dead driver does not answer.
                        () = node.deactivated() => {}
                    }
                }
                (id, request) = reset.recv() => {
                    let (reply, replied) = oneshot::channel();
                    pass_on(sender, Command::Reset(request, reply));
                    let refused = || ResetCellResponse {
                        message: "too many other commands wait".into(),
                        ..Default::default()
                    };
                    tokio::select! {
                        answer = replied => {
                            reset.respond(id, answer.unwrap_or_else(|_| refused()));
                        }
                        () = node.deactivated() => {}
                    }
                }
                (id, _) = list.recv() => if alive() {
                    list.respond(id, controllers_of(&shared.controllers()));
                },
                (id, request) = switch.recv() => if alive() {
                    let (activate, deactivate) =
                        (&request.activate_controllers, &request.deactivate_controllers);
                    let switched = shared.controllers().switch(activate, deactivate);
                    switch.respond(id, SwitchControllerResponse {
                        ok: switched.is_ok(),
                        message: switched.err().map_or_else(String::new, |error| error.to_string()),
                    });
                },
                (id, _) = version.recv() => if alive() {
                    version.respond(id, GetRobotSoftwareVersionResponse {
                        major: self.behaviour.software_major,
                        ..Default::default()
                    });
                },
                ended = &mut thread => {
                    return ended.context("the hardware's thread panicked")?.1;
                }
                () = node.deactivated() => {
                    self.shared.stop.store(true, Ordering::Release);
                    let (hardware, ended) = thread.await.context("the hardware's thread panicked")?;
                    self.hardware = Some(hardware);
                    return ended;
                }
            }
        }
    }
}

/// Waits for a goal id that has come before; for ever where they are not counted.
async fn repeated(repeats: &mut Option<tokio::sync::watch::Receiver<u64>>) {
    if let Some(repeats) = repeats
        && repeats.changed().await.is_ok()
    {
        return;
    }
    std::future::pending().await
}

fn controllers_of(controllers: &Controllers) -> ListControllersResponse {
    let state = |controller: &driver_model::Controller| ControllerState {
        name: controller.name.clone(),
        state: if controller.is_active {
            "active"
        } else {
            "inactive"
        }
        .to_owned(),
        r#type: controller.class.to_owned(),
        ..Default::default()
    };
    ListControllersResponse {
        controller: controllers.list().iter().map(state).collect(),
    }
}

fn pass_on(sender: &mpsc::SyncSender<Command>, command: Command) {
    // A goal that is dropped is rejected, a request fails.
    if sender.try_send(command).is_err() {
        warn!("command refused: {WAITING_COMMANDS} others wait");
    }
}

/// What the services and action servers ask of the hardware's thread.
pub(crate) enum Command {
    Follow(NewGoal<FollowJointTrajectory>),
    Until(NewGoal<FollowJointTrajectoryUntil>),
    SetIo(SetIORequest, oneshot::Sender<bool>),
    Reset(ResetCellRequest, oneshot::Sender<ResetCellResponse>),
    /// The driver's process ends.
    Die,
}
