//! The node: what its services and actions ask is passed on to the emulator's thread.

use std::convert::Infallible;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::SystemTime;

use anyhow::Context as _;
use camera_noise::Perturbation;
use cell_emulation::{
    Command, DriverServer, DriverState, Emulator, EmulatorSettings, Shared, refused_reset,
};
use msgs::sctn_msgs::{ResetCell, ResetCellResponse};
use multiravens::Problem;
use node_kit::{Active, IdempotentServer, Node, ReplyCache};
#[cfg(not(test))]
use node_kit::{Context, NodeLife, RosArguments};
use simulated_cell::{SimulatedCell, Wiring};
use tokio::sync::oneshot;
use tracing::warn;

use crate::parameters::SimWorkcellParameters;

/// Commands that wait for the emulator's thread; more are refused.
const WAITING_COMMANDS: usize = 64;

/// Starts the node in a context. It is compiled here, once, and not anew in every program that has it; tests of this library have no use for it.
#[cfg(not(test))]
pub fn start(context: &Context, arguments: &RosArguments) -> anyhow::Result<NodeLife> {
    context.start("sim_workcell", arguments, configure)
}

/// Begins the episode and returns the node that emulates the UR driver and the cameras.
pub async fn configure(
    node: Node,
    parameters: SimWorkcellParameters,
) -> anyhow::Result<HardwareNode> {
    let settings = parameters.emulator;
    let problem = Problem::load(&settings.problems_dir, &settings.problem)?;
    let work_cell = node_kit::load_work_cell(&parameters.urdf)?;
    let wiring = Wiring {
        suction_pin: parameters.suction_pin,
        vacuum_pin: parameters.vacuum_pin,
    };
    let perturbation = match parameters.perturbation.as_path() {
        path if path == Path::new("") => None,
        path => Some(Perturbation::load(path).context("parameter perturbation")?),
    };
    let mut cell = tokio::task::spawn_blocking({
        let (work_cell, hardware) = (work_cell.clone(), settings.hardware.clone());
        let seed = settings.seed;
        move || SimulatedCell::new(&problem, &work_cell, seed, wiring, perturbation, hardware)
    })
    .await
    .context("setting up the episode")??;
    if settings.hardware.free_running {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        cell.begin_at(now.context("the clock is before 1970")?);
    }
    let shared = Arc::new(Shared {
        stop: AtomicBool::new(false),
        driver: Arc::new(DriverState::new(&settings.actions(), &settings.hardware)),
    });
    let (sender, commands) = mpsc::sync_channel(WAITING_COMMANDS);
    let reading = node.clone();
    let newer_settings = move |known: &EmulatorSettings| {
        let parameters = reading.parameters::<SimWorkcellParameters>();
        let now = &parameters.borrow().emulator;
        (now != known).then(|| now.clone())
    };
    let emulator = Emulator::new(
        &node,
        settings.clone(),
        newer_settings,
        cell,
        work_cell,
        commands,
        Arc::clone(&shared),
    )?;
    Ok(HardwareNode {
        emulator: Some(emulator),
        sender,
        shared,
        settings,
        resets: ReplyCache::default(),
    })
}

/// The configured node. While it is inactive the cell stays as it is, and nothing is said.
pub struct HardwareNode {
    /// Its thread has it while the node is active.
    emulator: Option<Emulator>,
    sender: mpsc::SyncSender<Command>,
    shared: Arc<Shared>,
    settings: EmulatorSettings,
    resets: ReplyCache<ResetCellResponse>,
}

impl Drop for HardwareNode {
    /// Where the runtime ends without deactivation, the emulator's thread ends too.
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
    }
}

impl Active for HardwareNode {
    async fn run(&mut self, node: &Node) -> anyhow::Result<()> {
        let state = Arc::clone(&self.shared.driver);
        let EmulatorSettings { hardware, .. } = &self.settings;
        let mut driver = DriverServer::new(node, &self.settings.actions(), hardware, state)?;
        let resets = node.idempotent_server::<ResetCell>("~/reset", &self.resets)?;
        let emulator = self.emulator.take();
        let mut emulator = emulator.context("the emulator's thread has not ended")?;
        self.shared.stop.store(false, Ordering::Release);
        let mut thread = node.spawn_blocking(move || {
            let ended = emulator.run();
            (emulator, ended)
        });
        let sender = &self.sender;
        let ended = tokio::select! {
            never = driver.serve(|request| pass_on(sender, Command::Driver(request))) => match never {},
            never = serve_resets(resets, sender) => match never {},
            ended = &mut thread => ended.context("the emulator's thread panicked")?.1,
            () = node.deactivated() => {
                self.shared.stop.store(true, Ordering::Release);
                let (emulator, ended) = thread.await.context("the emulator's thread panicked")?;
                self.emulator = Some(emulator);
                ended
            }
        };
        Ok(ended?)
    }
}

/// Passes resets on, one after the other.
async fn serve_resets(
    mut resets: IdempotentServer<ResetCell>,
    sender: &mpsc::SyncSender<Command>,
) -> Infallible {
    loop {
        let (call, request) = resets.recv(refused_reset).await;
        let (reply, replied) = oneshot::channel();
        pass_on(sender, Command::Reset(request, reply));
        let dropped = |_| Err("too many other commands wait".to_owned());
        match replied.await.unwrap_or_else(dropped) {
            Ok(answer) => resets.respond(call, answer),
            Err(reason) => resets.respond_for_now(call, refused_reset(reason)),
        }
    }
}

fn pass_on(sender: &mpsc::SyncSender<Command>, command: Command) {
    // A goal that is dropped is rejected, a request fails.
    if sender.try_send(command).is_err() {
        warn!("command refused: {WAITING_COMMANDS} others wait");
    }
}
