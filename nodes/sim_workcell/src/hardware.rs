//! The thread that owns the simulated hardware: what it is asked, one thing after the other, and what is wrong with it.

mod images;
mod motion;
mod reports;
mod shutter;

use std::sync::atomic::Ordering;
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::{Duration, Instant};

use cell_emulation::cameras::{CameraTopics, Frame};
use cell_emulation::{Acceptance, Goal, Request, StatusPublishers, output_from_msg};
use driver_model::{EncoderNoise, Fault};
use msgs::rosgraph_msgs::Clock;
use msgs::sctn_msgs::{ResetCellRequest, ResetCellResponse, Reward};
use msgs::std_msgs;
use msgs::tf2_msgs::TFMessage;
use msgs::ur_msgs::SetIORequest;
use multiravens::Problem;
use node_kit::{Node, Publisher, Qos, ReplyCache};
use simulated_cell::{Output, Pins, SimulatedCell};
use tokio::sync::oneshot;
use tracing::{info, warn};
use ur5::WorkCell;

use self::reports::fixed_transforms;
use self::shutter::Shutter;
use crate::node::{Command, Shared};
use crate::parameters::SimWorkcellParameters;

/// How often a dead driver looks whether it was started again.
const DEAD_PERIOD: Duration = Duration::from_millis(20);

/// The simulated hardware and where it speaks.
pub(crate) struct Hardware {
    node: Node,
    parameters: SimWorkcellParameters,
    /// Of the present episode; a reset may have begun another one than the parameter's.
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
    /// What is wrong now.
    fault: Fault,
    /// The driver's process has ended by itself.
    died: bool,
    /// Origin of the times of the wall clock, and the simulated time then.
    origin: (Instant, Duration),
    clock: Publisher<Clock>,
    status: StatusPublishers,
    /// Of the arm's links.
    tf: Option<Publisher<TFMessage>>,
    reward: Publisher<Reward>,
    cameras: Arc<Vec<CameraTopics>>,
    /// Of noisy cameras where time goes on by itself.
    shutter: Option<Shutter>,
    /// Latched.
    tf_static: Publisher<TFMessage>,
    /// Latched, said once; kept so that late joiners hear them.
    _robot_description: Option<Publisher<std_msgs::String>>,
    /// What the cameras saw at this rest: one set of frames of perfect cameras, several of noisy ones.
    frames: Vec<Vec<(usize, Frame)>>,
    /// Which set is said next.
    next_set: usize,
    resets: ReplyCache<ResetCellResponse>,
    published_pins: Pins,
    /// When the last command ended.
    last_command: Instant,
    next_status: Instant,
    next_pins: Instant,
    next_frames: Instant,
}

impl Hardware {
    pub(crate) fn new(
        node: &Node,
        parameters: SimWorkcellParameters,
        cell: SimulatedCell,
        work_cell: WorkCell,
        commands: mpsc::Receiver<Command>,
        shared: Arc<Shared>,
    ) -> anyhow::Result<Self> {
        let cameras = cell.environment().cell().cameras();
        let topics = cameras
            .iter()
            .map(|camera| CameraTopics::new(node, &camera.name));
        let topics: Arc<Vec<CameraTopics>> = Arc::new(topics.collect::<Result<_, _>>()?);
        let free_running = parameters.hardware.free_running && cell.environment().rig().is_some();
        let shutter = free_running.then(|| Shutter::new(Arc::clone(&topics)));
        let tf_static = node.publisher("/tf_static", Qos::Latched)?;
        let robot_description = match parameters.publish_robot {
            false => None,
            true => {
                let description = node.publisher("robot_description", Qos::Latched)?;
                description.publish(std_msgs::String {
                    data: work_cell.urdf.clone(),
                });
                Some(description)
            }
        };
        tf_static.publish(fixed_transforms(&cell, &work_cell, &parameters)?);
        let seed = parameters.seed;
        let acceptance = Acceptance::new(
            Arc::clone(&shared.driver),
            &parameters.actions(),
            &work_cell,
            &parameters.hardware,
            seed,
        );
        let origin = (Instant::now(), cell.time());
        let hardware = Self {
            // Best effort: the readers of /clock that ros2-client makes acknowledge nothing.
            clock: node.publisher("/clock", Qos::Image)?,
            status: StatusPublishers::new(node, &work_cell.joint_names)?,
            tf: match &robot_description {
                Some(_) => Some(node.publisher("/tf", Qos::Event)?),
                None => None,
            },
            _robot_description: robot_description,
            reward: node.publisher("reward", Qos::Event)?,
            node: node.clone(),
            published_pins: cell.pins(),
            problem: parameters.problem.clone(),
            parameters,
            cell,
            work_cell,
            commands,
            shared,
            cameras: topics,
            shutter,
            tf_static,
            acceptance,
            next: None,
            orphans: Vec::new(),
            noise: EncoderNoise::new(seed),
            fault: Fault::None,
            died: false,
            origin,
            frames: Vec::new(),
            next_set: 0,
            resets: ReplyCache::default(),
            last_command: Instant::now(),
            next_status: Instant::now(),
            next_pins: Instant::now(),
            next_frames: Instant::now(),
        };
        hardware.publish_modes();
        Ok(hardware)
    }

    pub(crate) fn run(&mut self) -> anyhow::Result<()> {
        // What waited while nothing was active is refused.
        while self.commands.try_recv().is_ok() {}
        info!("problem {}: ready at {:?}", self.problem, self.cell.time());
        self.origin = (Instant::now(), self.cell.time());
        self.publish_scene()?;
        while !self.is_stopped() {
            self.take_parameters();
            if self.is_dead() {
                // What comes now waits, and is forgotten when the driver is started again.
                thread::sleep(DEAD_PERIOD);
                continue;
            }
            self.run_on()?;
            self.answer_goals()?;
            let next = self.next_status.min(self.next_pins).min(self.next_frames);
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
                    self.last_command = Instant::now();
                    let soon = self.after(self.status_period_s());
                    self.next_status = self.next_status.min(soon);
                    self.next_pins = self.next_pins.min(soon);
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
            let now = Instant::now();
            if now >= self.next_status {
                self.publish_state()?;
            }
            if now >= self.next_pins {
                self.publish_pins();
            }
            if now >= self.next_frames {
                if self.parameters.hardware.free_running
                    && self.shutter.is_none()
                    && self.cell.is_at_rest()
                {
                    // A camera does not repeat images.
                    self.render()?;
                }
                self.publish_frames();
            }
        }
        Ok(())
    }

    fn handle(&mut self, command: Command) -> anyhow::Result<()> {
        match command {
            Command::Driver(Request::Follow(goal)) => {
                if let Some((goal, motion)) = self.acceptance.follow(*goal, self.fault) {
                    self.carry_out(goal, motion)?;
                }
            }
            Command::Driver(Request::Until(goal)) => {
                self.acceptance.wait(*goal, self.now());
                self.answer_goals()?;
            }
            Command::Driver(Request::Die) => self.end_driver(),
            Command::Driver(Request::SetIo(request, reply)) => self.set_io(&request, reply),
            Command::Reset(request, reply) => {
                let answer = self.reset(&request)?;
                // The caller may have gone.
                let _ = reply.send(answer);
            }
        }
        Ok(())
    }

    /// Carries out the goals of `trajectory_until_node` whose time has come, each to its end before the next one has its turn.
    fn answer_goals(&mut self) -> anyhow::Result<()> {
        while let Some((goal, motion)) = self.acceptance.next(self.now(), self.fault) {
            self.carry_out(goal, motion)?;
        }
        Ok(())
    }

    /// What can be obeyed while a goal is active. Returns what ends that goal.
    fn handle_while_moving(&mut self, command: Command) -> Option<Command> {
        let reason = "another goal is active";
        match command {
            // A trajectory controller takes the newest.
            Command::Driver(Request::Follow(_)) if self.parameters.hardware.strict_actions => {
                return Some(command);
            }
            Command::Driver(Request::Follow(goal)) => goal.reject(reason),
            Command::Driver(Request::Until(goal)) => self.acceptance.wait(*goal, self.now()),
            Command::Driver(Request::Die) => return Some(command),
            Command::Driver(Request::SetIo(request, reply)) => self.set_io(&request, reply),
            Command::Reset(request, reply) => {
                let refusal = |message| ResetCellResponse {
                    message,
                    ..Default::default()
                };
                let known = self.resets.known(&request.request_id, refusal);
                let answer = known.unwrap_or_else(|| refusal(format!("{reason}: cancel it first")));
                let _ = reply.send(answer);
            }
        }
        None
    }

    /// Begins an episode; only failures to speak of it are errors.
    fn reset(&mut self, request: &ResetCellRequest) -> anyhow::Result<ResetCellResponse> {
        let refusal = |message: String| {
            warn!("reset: {message}");
            ResetCellResponse {
                message,
                ..Default::default()
            }
        };
        if let Some(answer) = self.resets.known(&request.request_id, refusal) {
            return Ok(answer);
        }
        let name = match request.problem.as_str() {
            "" => self.problem.clone(),
            name => name.to_owned(),
        };
        let seed = request.seed;
        let begun = Problem::load(&self.parameters.problems_dir, &name)
            .map_err(|error| error.to_string())
            .and_then(|problem| {
                let begun = self.cell.reset(&problem, &self.work_cell, seed);
                begun.map_err(|error| error.to_string())
            });
        let answer = match begun {
            Ok(()) => {
                info!("reset: problem {name}, seed {seed}");
                self.problem = name;
                if self.cell.environment().rig().is_some() {
                    // The errors of the calibration are those of the seed.
                    self.tf_static.publish(fixed_transforms(
                        &self.cell,
                        &self.work_cell,
                        &self.parameters,
                    )?);
                }
                self.publish_pins();
                self.publish_state()?;
                self.publish_scene()?;
                ResetCellResponse {
                    success: true,
                    stamp: self.header()?.stamp,
                    ..Default::default()
                }
            }
            Err(reason) => refusal(reason),
        };
        self.resets.remember(&request.request_id, answer.clone());
        Ok(answer)
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

    fn is_dead(&self) -> bool {
        self.died || self.fault == Fault::DriverDead
    }

    /// The driver's process is gone: the robot stops by itself, and nobody hears of it.
    fn end_driver(&mut self) {
        self.died = true;
        self.shared.driver.set_dead(true);
    }

    /// The parameters that may be set at run time.
    fn take_parameters(&mut self) {
        let parameters = self.node.parameters::<SimWorkcellParameters>();
        let unchanged = *parameters.borrow() == self.parameters;
        if unchanged && self.parameters.hardware.fault == self.fault {
            return;
        }
        let parameters = parameters.borrow().clone();
        let before = std::mem::replace(&mut self.parameters, parameters);
        let hardware = &self.parameters.hardware;
        if before.hardware.inactive_controllers != hardware.inactive_controllers {
            let actions = self.parameters.actions();
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
        let (before, fault) = (self.fault, hardware.fault);
        if before == fault {
            return;
        }
        warn!("hardware.fault is {fault:?}, was {before:?}");
        self.fault = fault;
        self.shared.driver.set_dead(self.is_dead());
        if before == Fault::DriverDead && !self.died {
            // Started again, it knows nothing of what was.
            self.acceptance.restart();
            while self.commands.try_recv().is_ok() {}
            self.orphans.clear();
            self.next_status = Instant::now();
        }
        self.publish_modes();
    }

    fn after(&self, period_s: f64) -> Instant {
        Instant::now() + Duration::from_secs_f64(period_s)
    }
}
