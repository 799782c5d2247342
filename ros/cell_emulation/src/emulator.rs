//! A simulated cell behind the driver's interface: it carries out what is asked of it, one thing after the other, on the thread that calls
//! [`Emulator::run`].

mod motion;
mod reports;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use driver_model::EncoderNoise;
use msgs::convert::ConvertError;
use msgs::rosgraph_msgs::Clock;
use msgs::sctn_msgs::{ResetCellRequest, ResetCellResponse, Reward};
use msgs::ur_msgs::SetIORequest;
use multiravens::{CellError, Problem};
use node_kit::{Node, NodeError, Publisher, Qos};
use simulated_cell::{Output, Pins, PublishSchedule, SimulatedCell};
use tokio::sync::oneshot;
use tracing::{info, warn};
use ur5::WorkCell;

use crate::acceptance::Acceptance;
use crate::goal::Goal;
use crate::health::FaultChange;
use crate::pins::output_from_msg;
use crate::robot::RobotPublishers;
use crate::scene::{SceneCameras, SceneError};
use crate::server::{DriverState, Request};
use crate::settings::EmulatorSettings;
use crate::status::StatusPublishers;

/// How often a dead driver looks whether it was started again.
const DEAD_PERIOD: Duration = Duration::from_millis(20);

/// What the services and action servers ask of the emulator.
pub enum Command {
    /// Of the driver.
    Driver(Request),
    /// Another episode. With where the answer goes, or why there is none now.
    Reset(
        ResetCellRequest,
        oneshot::Sender<Result<ResetCellResponse, String>>,
    ),
}

/// What the emulator and those who talk to it share.
pub struct Shared {
    /// The emulator is to return.
    pub stop: AtomicBool,
    /// The driver's state.
    pub driver: Arc<DriverState>,
}

/// Why the emulator cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum EmulatorError {
    /// Time or state is none of ROS.
    #[error(transparent)]
    Convert(#[from] ConvertError),
    /// What the cameras see cannot be published.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The physics has failed.
    #[error(transparent)]
    Cell(#[from] CellError),
    /// The middleware refuses.
    #[error(transparent)]
    Node(#[from] NodeError),
}

/// The settings as they are now, where they are others than these.
type NewerSettings = dyn Fn(&EmulatorSettings) -> Option<EmulatorSettings> + Send;

/// The simulated cell and where it speaks.
pub struct Emulator {
    node: Node,
    settings: EmulatorSettings,
    newer_settings: Box<NewerSettings>,
    /// Of the present episode; a reset may have begun another one than the settings'.
    problem: String,
    cell: SimulatedCell,
    work_cell: WorkCell,
    commands: mpsc::Receiver<Command>,
    shared: Arc<Shared>,
    acceptance: Acceptance,
    /// Replaces the trajectory that was under way.
    next: Option<Command>,
    /// Goals of a dead driver: nobody hears of their end.
    orphans: Vec<Goal>,
    noise: EncoderNoise,
    /// Origin of the times of the wall clock, and the simulated time then.
    origin: (Instant, Duration),
    clock: Publisher<Clock>,
    status: StatusPublishers,
    robot: RobotPublishers,
    reward: Publisher<Reward>,
    cameras: SceneCameras,
    published_pins: Pins,
    schedule: PublishSchedule,
}

impl Emulator {
    /// Offers the topics of a cell whose episode has begun. `newer_settings`: the settings as they are now, where they are others than those
    /// that it is given.
    ///
    /// # Errors
    /// The middleware refuses, or the cell's time is none of ROS.
    pub fn new(
        node: &Node,
        settings: EmulatorSettings,
        newer_settings: impl Fn(&EmulatorSettings) -> Option<EmulatorSettings> + Send + 'static,
        cell: SimulatedCell,
        work_cell: WorkCell,
        commands: mpsc::Receiver<Command>,
        shared: Arc<Shared>,
    ) -> Result<Self, EmulatorError> {
        let (world_frame, with_robot) = (&settings.world_frame, settings.publish_robot);
        let robot = RobotPublishers::new(node, &work_cell, world_frame, with_robot)?;
        robot.publish_fixed(&cell.calibrated_cameras(), cell.time())?;
        let acceptance = Acceptance::new(
            Arc::clone(&shared.driver),
            &settings.actions(),
            &work_cell,
            &settings.hardware,
            settings.seed,
        );
        let emulator = Self {
            // Best effort: the readers of /clock that ros2-client makes acknowledge nothing.
            clock: node.publisher("/clock", Qos::Image)?,
            status: StatusPublishers::new(node, &work_cell.joint_names)?,
            robot,
            reward: node.publisher("reward", Qos::Event)?,
            cameras: SceneCameras::new(node, &cell, settings.hardware.free_running)?,
            node: node.clone(),
            published_pins: cell.pins(),
            problem: settings.problem.clone(),
            noise: EncoderNoise::new(settings.seed),
            settings,
            newer_settings: Box::new(newer_settings),
            origin: (Instant::now(), cell.time()),
            cell,
            work_cell,
            commands,
            shared,
            acceptance,
            next: None,
            orphans: Vec::new(),
            schedule: PublishSchedule::new(Instant::now()),
        };
        emulator.publish_modes();
        Ok(emulator)
    }

    /// Carries out what is asked until it is stopped.
    ///
    /// # Errors
    /// When it cannot go on.
    pub fn run(&mut self) -> Result<(), EmulatorError> {
        // What waited while nothing was active is refused.
        while self.commands.try_recv().is_ok() {}
        info!("problem {}: ready at {:?}", self.problem, self.cell.time());
        self.origin = (Instant::now(), self.cell.time());
        self.publish_scene()?;
        while !self.is_stopped() {
            self.take_settings();
            if self.is_dead() {
                // What comes now waits, and is forgotten when the driver is started again.
                thread::sleep(DEAD_PERIOD);
                continue;
            }
            self.run_on()?;
            self.answer_goals()?;
            let next = self.schedule.next();
            let due = self.acceptance.due().map(|due| self.origin.0 + due);
            let next = due.map_or(next, |due| next.min(due));
            let command = match self.next.take() {
                Some(command) => Ok(command),
                None => self
                    .commands
                    .recv_timeout(next.saturating_duration_since(Instant::now())),
            };
            match command {
                Ok(command) => {
                    self.handle(command)?;
                    let period = self.status_period();
                    self.schedule.on_command(Instant::now(), period);
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
            let now = Instant::now();
            if self.schedule.is_status_due(now) {
                self.publish_state()?;
            }
            if self.schedule.are_pins_due(now) {
                self.publish_pins();
            }
            if self.schedule.are_frames_due(now) {
                let is_free = self.settings.hardware.free_running;
                if is_free && !self.cameras.take_anew() && self.cell.is_at_rest() {
                    // A camera does not repeat images.
                    self.cameras.show(&mut self.cell)?;
                }
                self.publish_frames();
            }
        }
        Ok(())
    }

    fn handle(&mut self, command: Command) -> Result<(), EmulatorError> {
        match command {
            Command::Driver(Request::Follow(goal)) => {
                if let Some((goal, motion)) = self.acceptance.follow(*goal) {
                    self.carry_out(goal, motion)?;
                }
            }
            Command::Driver(Request::Until(goal)) => {
                self.acceptance.wait(*goal, self.now());
                self.answer_goals()?;
            }
            Command::Driver(Request::Die) => self.driver().end(),
            Command::Driver(Request::SetIo(request, reply)) => self.set_io(&request, reply),
            Command::Reset(request, reply) => {
                let answer = self.reset(&request)?;
                // The caller may have gone.
                let _ = reply.send(Ok(answer));
            }
        }
        Ok(())
    }

    /// Lets time go on with the wall clock where nothing moves.
    fn run_on(&mut self) -> Result<(), EmulatorError> {
        let now = self.now();
        if self.settings.hardware.free_running {
            self.cell.catch_up(self.origin.1 + now, now)?;
        } else {
            // The vacuum takes its time all the same.
            self.cell.update_vacuum(now, false);
        }
        Ok(())
    }

    /// Carries out the goals of `trajectory_until_node` whose time has come, each to its end before the next one has its turn.
    fn answer_goals(&mut self) -> Result<(), EmulatorError> {
        while let Some((goal, motion)) = self.acceptance.next(self.now()) {
            self.carry_out(goal, motion)?;
        }
        Ok(())
    }

    /// What can be obeyed while a goal is active. Returns what ends that goal.
    fn handle_while_moving(&mut self, command: Command) -> Option<Command> {
        let reason = "another goal is active";
        match command {
            // A trajectory controller takes the newest.
            Command::Driver(Request::Follow(_)) if self.settings.hardware.strict_actions => {
                return Some(command);
            }
            Command::Driver(Request::Follow(goal)) => goal.reject(reason),
            Command::Driver(Request::Until(goal)) => self.acceptance.wait(*goal, self.now()),
            Command::Driver(Request::Die) => return Some(command),
            Command::Driver(Request::SetIo(request, reply)) => self.set_io(&request, reply),
            Command::Reset(_, reply) => {
                let _ = reply.send(Err(format!("{reason}: cancel it first")));
            }
        }
        None
    }

    /// Begins an episode; only failures to speak of it are errors.
    fn reset(&mut self, request: &ResetCellRequest) -> Result<ResetCellResponse, EmulatorError> {
        let name = match request.problem.as_str() {
            "" => self.problem.clone(),
            name => name.to_owned(),
        };
        let seed = request.seed;
        let begun = Problem::load(&self.settings.problems_dir, &name)
            .map_err(|error| error.to_string())
            .and_then(|problem| {
                let begun = self.cell.reset(&problem, &self.work_cell, seed);
                begun.map_err(|error| error.to_string())
            });
        if let Err(reason) = begun {
            return Ok(refused_reset(reason));
        }
        info!("reset: problem {name}, seed {seed}");
        self.problem = name;
        if self.cell.environment().rig().is_some() {
            // The errors of the calibration are those of the seed.
            let cameras = self.cell.calibrated_cameras();
            self.robot.publish_fixed(&cameras, self.cell.time())?;
        }
        self.publish_pins();
        self.publish_state()?;
        self.publish_scene()?;
        Ok(ResetCellResponse {
            success: true,
            stamp: self.header()?.stamp,
            ..Default::default()
        })
    }

    fn set_io(&mut self, request: &SetIORequest, reply: oneshot::Sender<bool>) {
        let output = output_from_msg(request);
        match &output {
            Ok(output) => self.cell.set(*output),
            Err(reason) => warn!("set_io: {reason}"),
        }
        // The new state is out before the reply is.
        self.publish_changed_pins();
        // The caller may have gone.
        let _ = reply.send(output.is_ok());
    }

    /// Time of the wall clock, from an origin of its own.
    fn now(&self) -> Duration {
        self.origin.0.elapsed()
    }

    fn is_stopped(&self) -> bool {
        self.shared.stop.load(Ordering::Acquire)
    }

    fn driver(&self) -> &DriverState {
        &self.shared.driver
    }

    fn is_dead(&self) -> bool {
        self.driver().is_dead()
    }

    /// Takes over what may change while it runs.
    fn take_settings(&mut self) {
        let newer = (self.newer_settings)(&self.settings);
        if newer.is_none() && self.settings.hardware.fault == self.driver().fault() {
            return;
        }
        let settings = newer.unwrap_or_else(|| self.settings.clone());
        let before = std::mem::replace(&mut self.settings, settings);
        let hardware = &self.settings.hardware;
        if before.hardware.inactive_controllers != hardware.inactive_controllers {
            let actions = self.settings.actions();
            self.shared.driver.set_controllers(&actions, hardware);
        }
        if before.hardware.tool_voltage != hardware.tool_voltage {
            match Output::tool_voltage(f32::from(hardware.tool_voltage)) {
                Ok(output) => self.cell.set(output),
                Err(reason) => warn!("hardware.tool_voltage: {reason}"),
            }
        }
        self.cell.set_hardware(hardware);
        self.acceptance.set_hardware(hardware);
        let (before, fault) = (self.driver().fault(), hardware.fault);
        let change = self.driver().set_fault(fault);
        if change == FaultChange::Same {
            return;
        }
        warn!("hardware.fault is {fault:?}, was {before:?}");
        if change == FaultChange::Restarted {
            // Started again, it knows nothing of what was.
            self.acceptance.restart();
            while self.commands.try_recv().is_ok() {}
            self.orphans.clear();
            self.schedule.on_restart(Instant::now());
        }
        self.publish_modes();
    }
}

/// There is no reset, for this reason. Logs it.
pub fn refused_reset(message: String) -> ResetCellResponse {
    warn!("reset: {message}");
    ResetCellResponse {
        message,
        ..Default::default()
    }
}
