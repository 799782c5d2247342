//! The node: what its services and actions ask is passed on to the thread of `hardware`.

use std::convert::Infallible;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::SystemTime;

use anyhow::Context as _;
use camera_noise::Perturbation;
use cell_emulation::{ActionNames, DriverServer, DriverState, Request};
use driver_model::HardwareSettings;
use msgs::sctn_msgs::{ResetCell, ResetCellRequest, ResetCellResponse};
use multiravens::Problem;
use node_kit::{Active, Node, ServiceServer};
use simulated_cell::{SimulatedCell, Wiring};
use tokio::sync::oneshot;
use tracing::warn;
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
    let work_cell = WorkCell::load_or_builtin(&parameters.urdf).context("parameter urdf")?;
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
    let actions = parameters.actions();
    let shared = Arc::new(Shared {
        stop: AtomicBool::new(false),
        driver: Arc::new(DriverState::new(&actions, &behaviour)),
    });
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
        actions,
    })
}

/// What the services and the hardware's thread share.
pub(crate) struct Shared {
    /// The node is no longer active.
    pub(crate) stop: AtomicBool,
    pub(crate) driver: Arc<DriverState>,
}

/// The configured node. While it is inactive the cell stays as it is, and nothing is said.
pub struct HardwareNode {
    /// Its thread has it while the node is active.
    hardware: Option<Hardware>,
    sender: mpsc::SyncSender<Command>,
    shared: Arc<Shared>,
    behaviour: HardwareSettings,
    actions: ActionNames,
}

impl Drop for HardwareNode {
    /// Where the runtime ends without deactivation, the hardware's thread ends too.
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
    }
}

impl Active for HardwareNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let state = Arc::clone(&self.shared.driver);
        let mut driver = DriverServer::new(node, &self.actions, &self.behaviour, state)?;
        let resets = node.service_server::<ResetCell>("~/reset")?;
        let hardware = self.hardware.take();
        let mut hardware = hardware.context("the hardware's thread has not ended")?;
        self.shared.stop.store(false, Ordering::Release);
        let mut thread = node.spawn_blocking(move || {
            let ended = hardware.run();
            (hardware, ended)
        });
        let sender = &self.sender;
        tokio::select! {
            never = driver.serve(|request| pass_on(sender, Command::Driver(request))) => match never {},
            never = serve_resets(resets, sender) => match never {},
            ended = &mut thread => ended.context("the hardware's thread panicked")?.1,
            () = node.deactivated() => {
                self.shared.stop.store(true, Ordering::Release);
                let (hardware, ended) = thread.await.context("the hardware's thread panicked")?;
                self.hardware = Some(hardware);
                ended
            }
        }
    }
}

/// Passes resets on, one after the other.
async fn serve_resets(
    mut resets: ServiceServer<ResetCell>,
    sender: &mpsc::SyncSender<Command>,
) -> Infallible {
    loop {
        let (id, request) = resets.recv().await;
        let (reply, replied) = oneshot::channel();
        pass_on(sender, Command::Reset(request, reply));
        let refused = |_| ResetCellResponse {
            message: "too many other commands wait".into(),
            ..Default::default()
        };
        resets.respond(id, replied.await.unwrap_or_else(refused));
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
    Driver(Request),
    Reset(ResetCellRequest, oneshot::Sender<ResetCellResponse>),
}
