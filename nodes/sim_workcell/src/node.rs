//! Topics, services and actions, and the thread that owns the simulated hardware.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError, mpsc};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context as _;
use camera_noise::{Perturbation, Rig};
use driver_model::{AcceptanceQueue, Answer, Controllers, EncoderNoise, Fault, HardwareSettings};
use heightmap::Camera;
use msgs::control_msgs::{
    FollowJointTrajectory, FollowJointTrajectoryFeedback, FollowJointTrajectoryResult,
};
use msgs::controller_manager_msgs::{
    ControllerState, ListControllers, ListControllersResponse, SwitchController,
    SwitchControllerResponse,
};
use msgs::convert::{self, ConvertError};
use msgs::rosgraph_msgs::Clock;
use msgs::sctn_msgs::{ResetCell, ResetCellRequest, ResetCellResponse, Reward};
use msgs::sensor_msgs::JointState;
use msgs::std_msgs::{self, Bool, Header};
use msgs::tf2_msgs::TFMessage;
use msgs::trajectory_msgs::JointTrajectoryPoint;
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::{
    FollowJointTrajectoryUntil, FollowJointTrajectoryUntilFeedback,
    FollowJointTrajectoryUntilResult, GetRobotSoftwareVersion, GetRobotSoftwareVersionResponse,
    IOStates, SetIO, SetIORequest, SetIOResponse, ToolDataMsg,
};
use multiravens::render::RgbdImage;
use multiravens::{MotionEnd, Problem};
use node_kit::{Active, Level, NewGoal, Node, Publisher, Qos, ReplyCache, RunningGoal};
use tokio::sync::oneshot;
use tracing::{error, info, warn};
use ur5::{JointTrajectory, Joints, WorkCell};

use crate::driver::{Failure, follow_trajectory, path_tolerances, until_trajectory};
use crate::frames::{CameraTopics, Frame, camera_transforms, link_transforms};
use crate::parameters::SimWorkcellParameters;
use crate::workcell::{Step, Wiring, Workcell};

/// Detects contact; only robots with software 5 or later have it.
const TOOL_CONTACT: &str = "tool_contact_controller";
/// How often a dead driver looks whether it was started again.
const DEAD_PERIOD: Duration = Duration::from_millis(20);
/// The most that simulated time catches up at once.
const MOST_CATCH_UP: Duration = Duration::from_millis(200);
/// Commands that wait for the hardware's thread; more are refused.
const WAITING_COMMANDS: usize = 64;
/// Simulated time between feedback messages, as the driver's controllers have it.
const FEEDBACK_PERIOD: Duration = Duration::from_millis(50);
/// Who commands reads the status; once nobody has for so long, it is repeated less often.
const ATTENTIVE: Duration = Duration::from_secs(1);
/// By so much less often.
const INATTENTIVE_FACTOR: f64 = 5.0;

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
    let mut workcell = tokio::task::spawn_blocking({
        let (work_cell, behaviour) = (work_cell.clone(), behaviour.clone());
        move || Workcell::new(&problem, &work_cell, seed, wiring, perturbation, behaviour)
    })
    .await
    .context("setting up the episode")??;
    if behaviour.free_running {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
        workcell.begin_at(now.context("the clock is before 1970")?);
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
        workcell,
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
fn controller_of(action: &str) -> &str {
    action
        .trim_start_matches('/')
        .split('/')
        .next()
        .unwrap_or("")
}

/// What the services and the hardware's thread share.
struct Shared {
    stop: AtomicBool,
    /// The driver's process is gone.
    dead: AtomicBool,
    controllers: Mutex<Controllers>,
}

impl Shared {
    fn controllers(&self) -> MutexGuard<'_, Controllers> {
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

enum Command {
    Follow(NewGoal<FollowJointTrajectory>),
    Until(NewGoal<FollowJointTrajectoryUntil>),
    SetIo(SetIORequest, oneshot::Sender<bool>),
    Reset(ResetCellRequest, oneshot::Sender<ResetCellResponse>),
    /// The driver's process ends.
    Die,
}

/// A goal that is being carried out.
enum Activity {
    Follow(RunningGoal<FollowJointTrajectory>),
    Until(RunningGoal<FollowJointTrajectoryUntil>),
}

/// How a goal ends.
enum End {
    Motion(MotionEnd),
    Failed(Failure),
    Cancelled,
    /// The driver has ended it, as its controllers do.
    Withdrawn(Failure),
}

impl Activity {
    fn is_cancel_requested(&self) -> bool {
        match self {
            Self::Follow(goal) => goal.is_cancel_requested(),
            Self::Until(goal) => goal.is_cancel_requested(),
        }
    }

    fn feedback(&self, header: Header, joint_names: Vec<String>, point: JointTrajectoryPoint) {
        // The arm is where it should be.
        let error = JointTrajectoryPoint {
            positions: vec![0.0; point.positions.len()],
            velocities: vec![0.0; point.velocities.len()],
            time_from_start: point.time_from_start,
            ..Default::default()
        };
        match self {
            Self::Follow(goal) => goal.feedback(FollowJointTrajectoryFeedback {
                header,
                joint_names,
                desired: point.clone(),
                actual: point,
                error,
                ..Default::default()
            }),
            Self::Until(goal) => goal.feedback(FollowJointTrajectoryUntilFeedback {
                header,
                joint_names,
                desired: point.clone(),
                actual: point,
                error,
            }),
        }
    }

    fn end(self, end: End) {
        let lag = || {
            Failure::new(
                FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED,
                format!(
                    "the suction tip was more than {} m behind the arm",
                    multiravens::MAX_LAG_M
                ),
            )
        };
        let withdrawn = matches!(end, End::Withdrawn(_));
        let (cancelled, failure, triggered) = match end {
            End::Motion(MotionEnd::Reached) => (false, None, false),
            End::Motion(MotionEnd::Contact) => (false, None, true),
            End::Motion(MotionEnd::Lag) => (false, Some(lag()), false),
            End::Failed(failure) | End::Withdrawn(failure) => (false, Some(failure), false),
            End::Cancelled => (true, None, false),
        };
        let failed = failure.is_some() && !withdrawn;
        let cancelled = cancelled || withdrawn;
        let (error_code, error_string) = match failure {
            Some(Failure { code, reason }) => (code, reason),
            None if cancelled => (0, "cancelled".to_owned()),
            None => (0, String::new()),
        };
        match self {
            Self::Follow(goal) => {
                let result = FollowJointTrajectoryResult {
                    error_code,
                    error_string,
                };
                match (cancelled, failed) {
                    (true, _) => goal.cancelled(result),
                    (_, true) => goal.abort(result),
                    _ => goal.succeed(result),
                }
            }
            Self::Until(goal) => {
                let result = FollowJointTrajectoryUntilResult {
                    error_code,
                    until_condition_result: if triggered {
                        FollowJointTrajectoryUntilResult::TRIGGERED
                    } else {
                        FollowJointTrajectoryUntilResult::NOT_TRIGGERED
                    },
                    error_string,
                };
                match (cancelled, failed) {
                    (true, _) => goal.cancelled(result),
                    (_, true) => goal.abort(result),
                    _ => goal.succeed(result),
                }
            }
        }
    }
}

/// The simulated hardware and where it speaks.
struct Hardware {
    node: Node,
    parameters: SimWorkcellParameters,
    /// Of the present episode; a reset may have begun another one than the parameter's.
    problem: String,
    workcell: Workcell,
    work_cell: WorkCell,
    commands: mpsc::Receiver<Command>,
    shared: Arc<Shared>,
    /// Goals of `trajectory_until_node` that wait for their answer.
    unanswered: AcceptanceQueue<NewGoal<FollowJointTrajectoryUntil>>,
    /// Replaces the trajectory that was under way.
    next: Option<Command>,
    /// Goals of a dead driver: nobody hears of their end.
    orphans: Vec<Activity>,
    noise: EncoderNoise,
    /// What is wrong now.
    fault: Fault,
    /// The driver's process has ended by itself.
    died: bool,
    /// Origin of the times of the wall clock, and the simulated time then.
    origin: (Instant, Duration),
    clock: Publisher<Clock>,
    joint_states: Publisher<JointState>,
    /// Of the arm's links.
    tf: Option<Publisher<TFMessage>>,
    io_states: Publisher<IOStates>,
    reward: Publisher<Reward>,
    cameras: Vec<CameraTopics>,
    /// Latched.
    tf_static: Publisher<TFMessage>,
    /// Latched, said once; kept so that late joiners hear them.
    _robot_description: Option<Publisher<std_msgs::String>>,
    robot_mode: Publisher<RobotMode>,
    safety_mode: Publisher<SafetyMode>,
    program_running: Publisher<Bool>,
    tool_data: Publisher<ToolDataMsg>,
    /// What the cameras saw at this rest: one set of frames of perfect cameras, several of noisy ones.
    frames: Vec<Vec<(usize, Frame)>>,
    /// Which set is said next.
    next_set: usize,
    /// Sets taken of noisy cameras so far.
    sets_taken: u64,
    resets: ReplyCache<ResetCellResponse>,
    said_pins: IOStates,
    /// When the last command ended.
    last_command: Instant,
    next_status: Instant,
    next_pins: Instant,
    next_frames: Instant,
}

/// Where the cameras are, as their calibration has it, and the links that stand still.
fn fixed_transforms(
    workcell: &Workcell,
    work_cell: &WorkCell,
    parameters: &SimWorkcellParameters,
) -> Result<TFMessage, ConvertError> {
    let environment = workcell.environment();
    let cameras = environment.cell().cameras().iter().enumerate();
    let believed: Vec<Camera> = cameras
        .map(|(index, camera)| match environment.rig() {
            Some(rig) => rig.believed(index, camera),
            None => camera.clone(),
        })
        .collect();
    let (world, time) = (&parameters.world_frame, workcell.time());
    let mut fixed = camera_transforms(&believed, world, time)?;
    if parameters.publish_robot {
        let links = link_transforms(work_cell, &work_cell.arm.home, false, world, time)?;
        fixed.transforms.extend(links.transforms);
    }
    Ok(fixed)
}

/// Period of noisy cameras: 30 Hz.
const NOISY_PERIOD: Duration = Duration::from_nanos(33_333_333);
/// They run free: each takes its images this much after the one before it, so that the first and the last of three are 14 ms apart.
const NOISY_OFFSET: Duration = Duration::from_millis(7);

/// What noisy cameras take of a still scene: as many sets as their model says, one after the other, each image with noise of its own.
fn noisy_sets(
    rig: &Rig,
    cameras: &[Camera],
    images: &[RgbdImage],
    time: Duration,
    taken: u64,
) -> Result<Vec<Vec<(usize, Frame)>>, ConvertError> {
    let mut sets = Vec::new();
    for set in 0..rig.model().frames as u32 {
        let mut frames = Vec::new();
        for (index, (camera, image)) in cameras.iter().zip(images).enumerate() {
            if rig.is_missing(index) {
                continue;
            }
            let mut image = image.clone();
            let frame = taken + u64::from(set);
            rig.apply(
                index,
                &camera.intrinsics,
                frame,
                &mut image.rgb,
                &mut image.depth_m,
            );
            let stamp = time + set * NOISY_PERIOD + index as u32 * NOISY_OFFSET;
            frames.push((index, Frame::new(camera, &image, stamp)?));
        }
        sets.push(frames);
    }
    Ok(sets)
}

fn withdrawn(reason: &str) -> End {
    let code = FollowJointTrajectoryResult::INVALID_GOAL;
    End::Withdrawn(Failure::new(code, reason))
}

/// Shortest and longest time until `trajectory_until_node` answers.
fn answer_range(hardware: &HardwareSettings) -> (Duration, Duration) {
    (
        Duration::from_secs_f64(hardware.until_answer_min_s),
        Duration::from_secs_f64(hardware.until_answer_max_s),
    )
}

impl Hardware {
    fn new(
        node: &Node,
        parameters: SimWorkcellParameters,
        workcell: Workcell,
        work_cell: WorkCell,
        commands: mpsc::Receiver<Command>,
        shared: Arc<Shared>,
    ) -> anyhow::Result<Self> {
        let cameras = workcell.environment().cell().cameras();
        let topics = cameras
            .iter()
            .map(|camera| CameraTopics::new(node, &camera.name));
        let topics = topics.collect::<Result<_, _>>()?;
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
        tf_static.publish(fixed_transforms(&workcell, &work_cell, &parameters)?);
        let status = |name| format!("io_and_status_controller/{name}");
        let range = answer_range(&parameters.hardware);
        let seed = parameters.seed;
        let origin = (Instant::now(), workcell.time());
        let hardware = Self {
            // Best effort: the readers of /clock that ros2-client makes acknowledge nothing.
            clock: node.publisher("/clock", Qos::Image)?,
            joint_states: node.publisher("joint_states", Qos::Event)?,
            tf: match &robot_description {
                Some(_) => Some(node.publisher("/tf", Qos::Event)?),
                None => None,
            },
            _robot_description: robot_description,
            io_states: node.publisher(&status("io_states"), Qos::Event)?,
            reward: node.publisher("reward", Qos::Event)?,
            node: node.clone(),
            said_pins: workcell.io_states(),
            problem: parameters.problem.clone(),
            parameters,
            workcell,
            work_cell,
            commands,
            shared,
            cameras: topics,
            tf_static,
            robot_mode: node.publisher(&status("robot_mode"), Qos::Latched)?,
            safety_mode: node.publisher(&status("safety_mode"), Qos::Latched)?,
            program_running: node.publisher(&status("robot_program_running"), Qos::Latched)?,
            tool_data: node.publisher(&status("tool_data"), Qos::Event)?,
            unanswered: AcceptanceQueue::new(range.0, range.1, seed),
            next: None,
            orphans: Vec::new(),
            noise: EncoderNoise::new(seed),
            fault: Fault::None,
            died: false,
            origin,
            frames: Vec::new(),
            next_set: 0,
            sets_taken: 0,
            resets: ReplyCache::default(),
            last_command: Instant::now(),
            next_status: Instant::now(),
            next_pins: Instant::now(),
            next_frames: Instant::now(),
        };
        hardware.say_modes();
        Ok(hardware)
    }

    fn run(&mut self) -> anyhow::Result<()> {
        // What waited while nothing was active is refused.
        while self.commands.try_recv().is_ok() {}
        info!(
            "problem {}: ready at {:?}",
            self.problem,
            self.workcell.time()
        );
        self.origin = (Instant::now(), self.workcell.time());
        self.look()?;
        while !self.is_stopped() {
            self.take_over();
            if self.is_dead() {
                // What comes now waits, and is forgotten when the driver is started again.
                thread::sleep(DEAD_PERIOD);
                continue;
            }
            self.run_on()?;
            self.answer_goals()?;
            let next = self.next_status.min(self.next_pins).min(self.next_frames);
            let due = self.unanswered.due().map(|due| self.origin.0 + due);
            let next = due.map_or(next, |due| next.min(due));
            let command = match self.next.take() {
                Some(command) => Ok(command),
                None => self
                    .commands
                    .recv_timeout(next.saturating_duration_since(Instant::now())),
            };
            match command {
                Ok(command) => {
                    self.obey(command)?;
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
                self.say_status()?;
            }
            if now >= self.next_pins {
                self.say_pins();
            }
            if now >= self.next_frames {
                if self.parameters.hardware.free_running
                    && self.next_set == 0
                    && self.workcell.is_at_rest()
                {
                    // A camera does not repeat images.
                    self.render()?;
                }
                self.say_frames();
            }
        }
        Ok(())
    }

    fn obey(&mut self, command: Command) -> anyhow::Result<()> {
        let (arm, names) = (&self.work_cell.arm, &self.work_cell.joint_names);
        let default_rad = self.parameters.hardware.path_tolerance_rad;
        match command {
            Command::Follow(goal) => {
                if let Some(reason) = self.inactive(controller_of(&self.parameters.follow_action)) {
                    goal.reject(reason);
                    return Ok(());
                }
                let (goal, running) = goal.accept();
                let tolerances = path_tolerances(&goal.path_tolerance, names, default_rad);
                let trajectory = follow_trajectory(&goal, arm, names);
                self.carry_out(Activity::Follow(running), trajectory, false, &tolerances)
            }
            Command::Until(goal) => {
                self.unanswered.push(goal, self.now());
                self.answer_goals()
            }
            Command::Die => {
                self.die();
                Ok(())
            }
            Command::SetIo(request, reply) => {
                self.set_io(&request, reply);
                Ok(())
            }
            Command::Reset(request, reply) => {
                let answer = self.reset(&request)?;
                // The caller may have gone.
                let _ = reply.send(answer);
                Ok(())
            }
        }
    }

    /// Answers the goals of `trajectory_until_node` whose time has come.
    fn answer_goals(&mut self) -> anyhow::Result<()> {
        while let Some(answer) = self.unanswered.pop(self.now(), false) {
            // A goal is carried out before the next one has its turn.
            let (Answer::Accept(goal) | Answer::Busy(goal)) = answer;
            let follow = controller_of(&self.parameters.follow_action);
            let inactive = self
                .inactive(follow)
                .or_else(|| self.inactive(TOOL_CONTACT));
            if let Some(reason) = inactive {
                goal.reject(reason);
                continue;
            }
            let (goal, running) = goal.accept();
            let (arm, names) = (&self.work_cell.arm, &self.work_cell.joint_names);
            let default_rad = self.parameters.hardware.path_tolerance_rad;
            let tolerances = path_tolerances(&goal.path_tolerance, names, default_rad);
            let trajectory = until_trajectory(&goal, arm, names);
            self.carry_out(Activity::Until(running), trajectory, true, &tolerances)?;
        }
        Ok(())
    }

    /// Why a controller takes no goals.
    fn inactive(&self, controller: &str) -> Option<String> {
        if !self.fault.modes().program_running {
            return Some(format!("{controller} does not run: {:?}", self.fault));
        }
        let active = self.shared.controllers().is_active(controller);
        (!active).then(|| format!("{controller} is not active"))
    }

    /// What can be obeyed while a goal is active. Returns what ends that goal.
    fn obey_meanwhile(&mut self, command: Command) -> Option<Command> {
        let reason = "another goal is active";
        match command {
            // A trajectory controller takes the newest.
            Command::Follow(_) if self.parameters.hardware.strict_actions => return Some(command),
            Command::Follow(goal) => goal.reject(reason),
            Command::Until(goal) => self.unanswered.push(goal, self.now()),
            Command::Die => return Some(command),
            Command::SetIo(request, reply) => self.set_io(&request, reply),
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

    /// Rejects the goals of `trajectory_until_node` whose time has come while another goal is active.
    fn reject_goals(&mut self) {
        while let Some(answer) = self.unanswered.pop(self.now(), true) {
            let (Answer::Accept(goal) | Answer::Busy(goal)) = answer;
            goal.reject("another goal is active");
        }
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
                let begun = self.workcell.reset(&problem, &self.work_cell, seed);
                begun.map_err(|error| error.to_string())
            });
        let answer = match begun {
            Ok(()) => {
                info!("reset: problem {name}, seed {seed}");
                self.problem = name;
                if self.workcell.environment().rig().is_some() {
                    // The errors of the calibration are those of the seed.
                    self.tf_static.publish(fixed_transforms(
                        &self.workcell,
                        &self.work_cell,
                        &self.parameters,
                    )?);
                }
                self.say_pins();
                self.say_status()?;
                self.look()?;
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
        let done = self.workcell.set_io(request);
        if let Err(reason) = &done {
            warn!("set_io: {reason}");
        }
        // The new state is out before the reply is.
        self.say_pins_if_changed();
        // The caller may have gone.
        let _ = reply.send(done.is_ok());
    }

    /// Carries a goal out to its end.
    fn carry_out(
        &mut self,
        goal: Activity,
        trajectory: Result<JointTrajectory, Failure>,
        until_contact: bool,
        tolerances: &Joints,
    ) -> anyhow::Result<()> {
        // Where the arm still brakes, it brakes no longer.
        self.workcell.halt();
        let begun = trajectory
            .and_then(|trajectory| self.workcell.begin(trajectory, until_contact, tolerances));
        if let Err(failure) = begun {
            warn!("goal aborted: {failure}");
            goal.end(End::Failed(failure));
            return Ok(());
        }
        self.frames.clear();
        let end = self.drive(&goal)?;
        match &end {
            End::Failed(failure) => error!("goal aborted: {failure}"),
            End::Motion(MotionEnd::Lag) => warn!("goal aborted: the suction tip lags behind"),
            End::Motion(_) => {}
            End::Cancelled => info!("goal cancelled, the arm stops"),
            End::Withdrawn(failure) => warn!("goal withdrawn: {failure}"),
        }
        if self.is_dead() {
            // Nobody hears how it ends.
            self.orphans.push(goal);
            return Ok(());
        }
        // Whoever hears of the end can know where it led to.
        self.say_pins_if_changed();
        self.say_status()?;
        if let Some(assessment) = self.workcell.assess() {
            self.reward.publish(Reward {
                header: self.header()?,
                delta: assessment.delta_reward,
                total: assessment.total_reward,
                complete: assessment.complete,
            });
        }
        goal.end(end);
        self.coast()?;
        if self.workcell.is_at_rest() {
            self.look()?;
        }
        Ok(())
    }

    /// Lets an arm that brakes come to rest.
    fn coast(&mut self) -> anyhow::Result<()> {
        if !self.workcell.is_moving() {
            return Ok(());
        }
        let begin = (Instant::now(), self.workcell.time());
        while self.workcell.is_moving() {
            match self.workcell.step(self.now()) {
                Step::Moving | Step::Deviated(_) => {}
                Step::Ended(_) => break,
                Step::Failed(reason) => {
                    error!("braking: {reason}");
                    break;
                }
            }
            if Instant::now() >= self.next_status {
                self.say_status()?;
            }
            self.pace(begin);
        }
        self.say_status()
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
    fn die(&mut self) {
        self.died = true;
        self.shared.dead.store(true, Ordering::Release);
    }

    /// Lets time go on with the wall clock where nothing moves.
    fn run_on(&mut self) -> anyhow::Result<()> {
        let now = self.now();
        if !self.parameters.hardware.free_running {
            // The vacuum takes its time all the same.
            self.workcell.update_vacuum(now, false);
            return Ok(());
        }
        // A host that is behind catches up little by little.
        let due = (self.origin.1 + now).min(self.workcell.time() + MOST_CATCH_UP);
        while self.workcell.time() < due {
            self.workcell.pass_time(now).map_err(anyhow::Error::msg)?;
        }
        Ok(())
    }

    /// Steps the physics to the goal's end.
    fn drive(&mut self, goal: &Activity) -> anyhow::Result<End> {
        let begin = (Instant::now(), self.workcell.time());
        let rate_hz = self.parameters.joint_states_rate_hz;
        let tick_of = |time: Duration, rate_hz: f64| (time.as_secs_f64() * rate_hz) as u64;
        let mut said = tick_of(begin.1, rate_hz);
        let mut next_feedback = begin.1 + FEEDBACK_PERIOD;
        loop {
            while let Ok(command) = self.commands.try_recv() {
                match self.obey_meanwhile(command) {
                    None => {}
                    Some(Command::Die) => self.die(),
                    Some(command) => {
                        self.workcell.halt();
                        self.next = Some(command);
                        return Ok(withdrawn("a newer trajectory has come"));
                    }
                }
            }
            self.reject_goals();
            if goal.is_cancel_requested() || self.is_stopped() {
                self.workcell.cancel();
                return Ok(End::Cancelled);
            }
            if self.is_dead() {
                self.workcell.cancel();
                self.coast_unheard();
                return Ok(withdrawn("the driver is gone"));
            }
            if !self.fault.lets_move() {
                self.workcell.cancel();
                return Ok(withdrawn(&format!(
                    "the robot has stopped: {:?}",
                    self.fault
                )));
            }
            match self.workcell.step(self.now()) {
                Step::Moving => {}
                Step::Ended(end) => return Ok(End::Motion(end)),
                Step::Deviated(deviation) => {
                    self.workcell.cancel();
                    let code = FollowJointTrajectoryResult::PATH_TOLERANCE_VIOLATED;
                    return Ok(End::Failed(Failure::new(code, deviation.to_string())));
                }
                Step::Failed(reason) => {
                    self.workcell.cancel();
                    let code = FollowJointTrajectoryResult::INVALID_GOAL;
                    return Ok(End::Failed(Failure::new(code, reason)));
                }
            }
            let time = self.workcell.time();
            let tick = tick_of(time, rate_hz);
            if tick != said {
                said = tick;
                self.take_over();
                self.say_status()?;
            }
            if time >= next_feedback {
                next_feedback += FEEDBACK_PERIOD;
                self.say_feedback(goal, time - begin.1)?;
            }
            if Instant::now() >= self.next_pins {
                self.say_pins();
            }
            self.pace(begin);
        }
    }

    /// The parameters that may be set at run time.
    fn take_over(&mut self) {
        let parameters = self.node.parameters::<SimWorkcellParameters>();
        let unchanged = *parameters.borrow() == self.parameters;
        if unchanged && self.parameters.hardware.fault == self.fault {
            return;
        }
        self.parameters = parameters.borrow().clone();
        let hardware = &self.parameters.hardware;
        self.workcell.set_hardware(hardware);
        let range = answer_range(hardware);
        self.unanswered.set_range(range.0, range.1);
        let (before, fault) = (self.fault, hardware.fault);
        if before == fault {
            return;
        }
        warn!("hardware.fault is {fault:?}, was {before:?}");
        self.fault = fault;
        self.shared.dead.store(self.is_dead(), Ordering::Release);
        if before == Fault::DriverDead && !self.died {
            // Started again, it knows nothing of what was.
            for goal in self.unanswered.clear() {
                goal.reject("the driver was started again");
            }
            while self.commands.try_recv().is_ok() {}
            self.orphans.clear();
            self.next_status = Instant::now();
        }
        self.say_modes();
    }

    fn say_modes(&self) {
        if self.is_dead() {
            return;
        }
        let modes = self.fault.modes();
        self.robot_mode.publish(RobotMode {
            mode: modes.robot_mode,
        });
        self.safety_mode.publish(SafetyMode {
            mode: modes.safety_mode,
        });
        self.program_running.publish(Bool {
            data: modes.program_running,
        });
    }

    /// An arm whose driver is gone brakes by itself.
    fn coast_unheard(&mut self) {
        let begin = (Instant::now(), self.workcell.time());
        while self.workcell.is_moving() {
            if !matches!(
                self.workcell.step(self.now()),
                Step::Moving | Step::Deviated(_)
            ) {
                break;
            }
            self.pace(begin);
        }
        self.workcell.halt();
    }

    /// Waits where simulated time is to run no faster than a multiple of the wall clock's.
    fn pace(&self, begin: (Instant, Duration)) {
        let factor = match self.parameters.real_time_factor {
            0.0 if self.parameters.hardware.free_running => 1.0,
            factor => factor,
        };
        if factor > 0.0 {
            let due = (self.workcell.time() - begin.1).div_f64(factor);
            thread::sleep(due.saturating_sub(begin.0.elapsed()));
        }
    }

    /// Renders the cameras' frames and publishes them.
    fn look(&mut self) -> anyhow::Result<()> {
        let time = self.workcell.time();
        let settled = self.workcell.environment().cell().is_settled();
        if !settled {
            warn!("the bodies have not come to rest; the frames show them in motion");
        }
        self.render()?;
        self.say_frames();
        let environment = self.workcell.environment();
        let level = if settled { Level::Ok } else { Level::Warn };
        let values = [
            ("simulated_time_s", format!("{:.9}", time.as_secs_f64())),
            ("state_hash", format!("{:016x}", environment.state_hash())),
            ("steps", environment.steps().to_string()),
            ("total_reward", environment.total_reward().to_string()),
        ];
        let said = if settled { "at rest" } else { "not at rest" };
        self.node
            .diagnostics()
            .set("simulation", level, said, values);
        info!(
            "{said} at {time:?}: state {:016x}",
            environment.state_hash()
        );
        Ok(())
    }

    /// Renders what the cameras see now.
    fn render(&mut self) -> anyhow::Result<()> {
        let time = self.workcell.time();
        let rig = self.workcell.environment().rig().cloned();
        let cell = self.workcell.environment_mut().cell_mut();
        let cameras = cell.cameras().to_vec();
        let images = cell.render()?;
        self.frames = match &rig {
            None => {
                let frames = cameras.iter().zip(images).enumerate();
                let frames = frames
                    .map(|(index, (camera, image))| Ok((index, Frame::new(camera, image, time)?)));
                vec![frames.collect::<Result<_, ConvertError>>()?]
            }
            Some(rig) => noisy_sets(rig, &cameras, images, time, self.sets_taken)?,
        };
        self.sets_taken += self.frames.len() as u64;
        self.next_set = 0;
        Ok(())
    }

    fn header(&self) -> anyhow::Result<Header> {
        let time = self.workcell.time();
        Ok(convert::header(time, &self.parameters.world_frame)?)
    }

    fn say_status(&mut self) -> anyhow::Result<()> {
        self.next_status = self.after(self.status_period_s());
        if self.is_dead() {
            return Ok(());
        }
        let header = self.header()?;
        if !self.parameters.hardware.free_running {
            self.clock.publish(Clock {
                clock: header.stamp,
            });
        }
        let deviation_rad = self.parameters.hardware.encoder_noise_rad;
        let joints_rad = self.noise.read(&self.workcell.joints_rad(), deviation_rad);
        self.joint_states.publish(convert::joint_state_to_msg(
            header,
            &self.work_cell.joint_names,
            &joints_rad,
            &self.workcell.velocities_rad_s(),
        ));
        if let Some(tf) = &self.tf {
            tf.publish(link_transforms(
                &self.work_cell,
                &self.workcell.joints_rad(),
                true,
                &self.parameters.world_frame,
                self.workcell.time(),
            )?);
        }
        Ok(())
    }

    fn say_pins(&mut self) {
        if self.is_dead() {
            return;
        }
        self.tool_data.publish(self.workcell.tool_data());
        self.said_pins = self.workcell.io_states();
        self.io_states.publish(self.said_pins.clone());
        self.next_pins = self.after(self.status_period_s());
    }

    fn say_pins_if_changed(&mut self) {
        if self.workcell.io_states() != self.said_pins {
            self.say_pins();
        }
    }

    fn say_feedback(&self, goal: &Activity, elapsed: Duration) -> anyhow::Result<()> {
        let point = JointTrajectoryPoint {
            positions: self.workcell.joints_rad().iter().copied().collect(),
            velocities: self.workcell.velocities_rad_s().iter().copied().collect(),
            time_from_start: convert::duration_to_msg(elapsed)?,
            ..Default::default()
        };
        goal.feedback(self.header()?, self.work_cell.joint_names.to_vec(), point);
        Ok(())
    }

    fn say_frames(&mut self) {
        for (camera, frame) in self.frames.get(self.next_set).into_iter().flatten() {
            self.cameras[*camera].publish(frame.clone());
        }
        self.next_set += 1;
        if self.next_set < self.frames.len() {
            self.next_frames = self.after(NOISY_PERIOD.as_secs_f64());
        } else {
            self.next_set = 0;
            self.next_frames = self.after(self.parameters.frames_period_s);
        }
    }

    fn status_period_s(&self) -> f64 {
        match self.last_command.elapsed() > ATTENTIVE {
            true => INATTENTIVE_FACTOR * self.parameters.status_period_s,
            false => self.parameters.status_period_s,
        }
    }

    fn after(&self, period_s: f64) -> Instant {
        Instant::now() + Duration::from_secs_f64(period_s)
    }
}
