//! The simulated work cell as a robot driver shows it: an episode of a problem, moved by trajectories and digital pins, with
//! servo lag, braking and a vacuum that takes time. It knows no ROS; the node `sim_workcell` gives it goals and publishes what it says.
//!
//! Simulated time passes only in [`SimulatedCell::step`] and [`SimulatedCell::pass_time`].
//!
//! ```
//! use driver_model::HardwareSettings;
//! use multiravens::Problem;
//! use simulated_cell::{Output, SimulatedCell, Wiring};
//! use ur5::WorkCell;
//!
//! let problem = Problem::parse("placing", include_str!("../../../config/problems/placing.yaml"))?;
//! let wiring = Wiring { suction_pin: 16, vacuum_pin: 17 };
//! let hardware = HardwareSettings::default();
//! let mut cell = SimulatedCell::new(&problem, &WorkCell::builtin()?, 10_000, wiring, None, hardware)?;
//! cell.set(Output::digital(16, 1.0)?);
//! assert!(cell.pins().outputs[&16] && cell.is_at_rest());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod images;
mod schedule;
mod shutter;

use std::collections::BTreeMap;
use std::time::Duration;

use camera_noise::Perturbation;
use driver_model::{HardwareSettings, PathDeviation, Servo, Vacuum, Valves};
use multiravens::{Assessment, CellError, Environment, EnvironmentError, MotionEnd, Problem, Tick};
use ur5::{JointTrajectory, Joints, PlanError, WorkCell};

pub use self::images::{NOISY_PERIOD, Shot, StillScene};
pub use self::schedule::{MotionTicks, Pace, PublishSchedule};
pub use self::shutter::Shutter;

/// Digital pins of a UR controller: 0 to 7 standard, 8 to 15 configurable, 16 and 17 at the tool.
const PINS: u8 = 18;
/// Flags of a UR controller.
const FLAGS: u8 = 128;
/// What a tool can be fed with (V).
const TOOL_VOLTAGES: [u8; 3] = [0, 12, 24];
/// From this pin on they have power only where the tool has.
const TOOL_PINS_FROM: u8 = 16;

/// Which pins suction is wired to.
#[derive(Clone, Copy, Debug)]
pub struct Wiring {
    /// Digital output of the valve.
    pub suction_pin: u8,
    /// Digital input of the vacuum sensor.
    pub vacuum_pin: u8,
}

/// What a program may set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// A digital output.
    Digital {
        /// 0 to 17.
        pin: u8,
        /// Its new level.
        level: bool,
    },
    /// A flag.
    Flag {
        /// 0 to 127.
        flag: u8,
        /// Its new level.
        level: bool,
    },
    /// What the tool is fed with: 0, 12 or 24 V.
    ToolVoltage(u8),
}

/// Something that cannot be set.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidOutput {
    /// A pin or flag that there is not.
    #[error("pin is {pin}, expected 0 to {last}")]
    Pin {
        /// The pin.
        pin: i8,
        /// The last one.
        last: u8,
    },
    /// The level of the pin is neither 0 nor 1.
    #[error("state is {0}, expected 0 or 1")]
    Level(f32),
    /// A voltage that the tool cannot be fed with.
    #[error("state is {0}, expected 0, 12 or 24 V")]
    Voltage(f32),
}

impl Output {
    /// A digital output; numbers as the driver's messages have them.
    ///
    /// # Errors
    /// Where there is no such pin or level.
    pub fn digital(pin: i8, level: f32) -> Result<Self, InvalidOutput> {
        Ok(Self::Digital {
            pin: pin_below(PINS, pin)?,
            level: level_of(level)?,
        })
    }

    /// A flag.
    ///
    /// # Errors
    /// Where there is no such flag or level.
    pub fn flag(flag: i8, level: f32) -> Result<Self, InvalidOutput> {
        Ok(Self::Flag {
            flag: pin_below(FLAGS, flag)?,
            level: level_of(level)?,
        })
    }

    /// The tool's voltage.
    ///
    /// # Errors
    /// Where the tool cannot be fed with it.
    pub fn tool_voltage(voltage: f32) -> Result<Self, InvalidOutput> {
        let found = TOOL_VOLTAGES
            .into_iter()
            .find(|known| f32::from(*known) == voltage);
        found
            .map(Self::ToolVoltage)
            .ok_or(InvalidOutput::Voltage(voltage))
    }
}

fn pin_below(end: u8, pin: i8) -> Result<u8, InvalidOutput> {
    let known = u8::try_from(pin).ok().filter(|pin| *pin < end);
    known.ok_or(InvalidOutput::Pin { pin, last: end - 1 })
}

fn level_of(level: f32) -> Result<bool, InvalidOutput> {
    match level {
        0.0 => Ok(false),
        1.0 => Ok(true),
        other => Err(InvalidOutput::Level(other)),
    }
}

/// Levels of digital inputs, digital outputs and flags, by their numbers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pins {
    /// Digital inputs.
    pub inputs: BTreeMap<u8, bool>,
    /// Digital outputs.
    pub outputs: BTreeMap<u8, bool>,
    /// Flags that were set.
    pub flags: BTreeMap<u8, bool>,
}

/// Why a motion cannot begin.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BeginError {
    /// The servo loop makes no trajectory of it.
    #[error(transparent)]
    Servo(#[from] PlanError),
    /// The arm is busy or elsewhere.
    #[error(transparent)]
    Cell(#[from] CellError),
}

/// Session of perturbed cameras: light, colours and noise are those of another day than a demonstration's of the same seed.
const SESSION: u64 = 1;
/// The most that simulated time catches up at once.
const MOST_CATCH_UP: Duration = Duration::from_millis(200);
/// Time between the end of an episode and the beginning of the next.
const PAUSE: Duration = Duration::from_secs(1);

/// An episode of a problem, driven by trajectories and pins.
pub struct SimulatedCell {
    environment: Environment,
    /// Simulated time of the episodes before: time never runs back.
    past: Duration,
    wiring: Wiring,
    /// What the cameras do; perfect ones without.
    perturbation: Option<Perturbation>,
    /// Digital outputs that are not suction.
    outputs: BTreeMap<u8, bool>,
    flags: BTreeMap<u8, bool>,
    velocities_rad_s: Joints,
    /// How the driver behaves.
    hardware: HardwareSettings,
    vacuum: Vacuum,
    /// What the valve was told.
    valve: bool,
    /// What was held has been lost to a leak; nothing is gripped until the valve was closed.
    leaked: bool,
    /// What the arm follows, where it does not follow exactly.
    followed: Option<Followed>,
    /// The last goal has ended with the arm at home, nothing held, and the bodies settled.
    rests: bool,
    /// The rewards of this rest have been told.
    assessed: bool,
    /// Sets of images that noisy cameras have taken so far, over all episodes.
    sets_taken: u64,
}

/// A trajectory that a servo loop follows.
struct Followed {
    servo: Servo,
    desired: JointTrajectory,
    actual: JointTrajectory,
    tolerances_rad: Joints,
    until_contact: bool,
    begin: Duration,
}

/// What a step of the physics has done.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// The arm is on its way.
    Moving,
    /// The motion has ended.
    Ended(MotionEnd),
    /// A joint was too far from its trajectory.
    Deviated(PathDeviation),
    /// Why there was no step.
    Failed(String),
}

impl SimulatedCell {
    /// An episode with everything at rest.
    ///
    /// # Errors
    /// When the scene of the seed cannot be made.
    pub fn new(
        problem: &Problem,
        work_cell: &WorkCell,
        seed: u64,
        wiring: Wiring,
        perturbation: Option<Perturbation>,
        hardware: HardwareSettings,
    ) -> Result<Self, EnvironmentError> {
        let mut environment = Environment::new(problem, work_cell);
        environment.set_perturbation(perturbation.as_ref());
        environment.set_session(SESSION);
        environment.reset(seed)?;
        Ok(Self {
            environment,
            past: Duration::ZERO,
            wiring,
            perturbation,
            outputs: (0..PINS).map(|pin| (pin, false)).collect(),
            flags: BTreeMap::new(),
            velocities_rad_s: Joints::zeros(),
            hardware,
            vacuum: Vacuum::default(),
            valve: false,
            leaked: false,
            followed: None,
            rests: true,
            assessed: true,
            sets_taken: 0,
        })
    }

    /// Begins another episode. The state stays as it is where that cannot begin.
    ///
    /// # Errors
    /// When the scene of the seed cannot be made.
    pub fn reset(
        &mut self,
        problem: &Problem,
        work_cell: &WorkCell,
        seed: u64,
    ) -> Result<(), EnvironmentError> {
        let next = Self::new(
            problem,
            work_cell,
            seed,
            self.wiring,
            self.perturbation.clone(),
            self.hardware.clone(),
        )?;
        let past = self.time() + PAUSE;
        *self = Self {
            past,
            sets_taken: self.sets_taken,
            ..next
        };
        Ok(())
    }

    /// Lets the time begin at `time`, for an episode that has just begun.
    pub fn begin_at(&mut self, time: Duration) {
        self.past = time.saturating_sub(self.environment.cell().time());
    }

    /// Takes over what may change while the node is active.
    pub fn set_hardware(&mut self, hardware: &HardwareSettings) {
        let tool_voltage = self.hardware.tool_voltage;
        if hardware.speed_scaling != self.hardware.speed_scaling {
            self.slide(hardware.speed_scaling / self.hardware.speed_scaling);
        }
        self.hardware = HardwareSettings {
            // Set by the robot's program, too.
            tool_voltage,
            ..hardware.clone()
        };
    }

    /// The simulation.
    pub fn environment(&self) -> &Environment {
        &self.environment
    }

    /// Simulated time, over all episodes.
    pub fn time(&self) -> Duration {
        self.past + self.environment.cell().time()
    }

    /// Positions of the joints.
    pub fn joints_rad(&self) -> Joints {
        self.environment.cell().joint_positions()
    }

    /// Velocities of the joints.
    pub fn velocities_rad_s(&self) -> Joints {
        self.velocities_rad_s
    }

    /// Begins a motion. `tolerances_rad`: how far each joint may be from its trajectory; a negative one allows everything.
    ///
    /// # Errors
    /// When the arm is busy, is not where the trajectory starts, or cannot follow it.
    pub fn begin(
        &mut self,
        trajectory: JointTrajectory,
        until_contact: bool,
        tolerances_rad: &Joints,
    ) -> Result<(), BeginError> {
        let desired = Servo::new(0.0, self.hardware.speed_scaling).actual(&trajectory)?;
        // At the speed that the slider allows it lags as at any other.
        let servo = Servo::new(self.hardware.servo_delay_s, 1.0);
        let actual = servo.actual(&desired)?;
        let braking = self.hardware.braking_time_s > 0.0;
        let is_ideal = servo.is_ideal() && self.hardware.speed_scaling == 1.0;
        let followed = (braking || !is_ideal).then(|| Followed {
            servo,
            desired,
            actual: actual.clone(),
            tolerances_rad: *tolerances_rad,
            until_contact,
            begin: self.time(),
        });
        self.environment.cell_mut().begin(actual, until_contact)?;
        self.followed = followed;
        self.rests = false;
        self.assessed = false;
        Ok(())
    }

    /// One physics step. `now`: time of the wall clock, from any origin.
    pub fn step(&mut self, now: Duration) -> Step {
        let (before_rad, before) = (self.joints_rad(), self.time());
        let ticked = self.environment.cell_mut().tick();
        self.update_vacuum(now, true);
        let elapsed_s = (self.time() - before).as_secs_f64();
        self.velocities_rad_s = match ticked {
            Ok(Tick::Moving) if elapsed_s > 0.0 => (self.joints_rad() - before_rad) / elapsed_s,
            _ => Joints::zeros(),
        };
        match ticked {
            Ok(Tick::Moving) => match self.deviation() {
                Some(deviation) => Step::Deviated(deviation),
                None => Step::Moving,
            },
            Ok(Tick::Ended(end)) => {
                let cell = self.environment.cell();
                self.rests = cell.is_home() && !cell.is_holding();
                Step::Ended(end)
            }
            Ok(Tick::Idle) => Step::Failed("there is no motion under way".into()),
            Err(error) => Step::Failed(error.to_string()),
        }
    }

    /// Where the arm has left its trajectory.
    fn deviation(&self) -> Option<PathDeviation> {
        let followed = self.followed.as_ref()?;
        let elapsed = self.time() - followed.begin;
        // Later than that the arm only waits.
        let moves = elapsed <= followed.actual.duration();
        let (joints, tolerances) = (self.joints_rad(), &followed.tolerances_rad);
        let check = || {
            followed
                .servo
                .check(&followed.desired, elapsed, &joints, tolerances)
        };
        moves.then(check)?.err()
    }

    /// One physics step while no goal is active.
    ///
    /// # Errors
    /// When the physics has failed.
    pub fn pass_time(&mut self, now: Duration) -> Result<(), CellError> {
        let passed = self.environment.cell_mut().pass_time();
        self.update_vacuum(now, false);
        passed
    }

    /// Lets time go on to `until` while no goal is active. A host that is behind catches up little by little: each call brings 0.2 s at most.
    ///
    /// # Errors
    /// When the physics has failed.
    pub fn catch_up(&mut self, until: Duration, now: Duration) -> Result<(), CellError> {
        let until = until.min(self.time() + MOST_CATCH_UP);
        while self.time() < until {
            self.pass_time(now)?;
        }
        Ok(())
    }

    /// The speed slider was moved: what is left of the motion under way goes on at so much of its present speed. The arm lags by as much of its
    /// way as before.
    fn slide(&mut self, factor: f64) {
        let Some(followed) = &self.followed else {
            return;
        };
        let elapsed = self.time() - followed.begin;
        // Later the arm only waits.
        if !self.is_moving() || elapsed >= followed.actual.duration() {
            return;
        }
        let slid = |of: &JointTrajectory| Servo::slide(of, elapsed, factor);
        // One that would take too long keeps its speed.
        let (Ok(desired), Ok(actual)) = (slid(&followed.desired), slid(&followed.actual)) else {
            return;
        };
        let (tolerances_rad, servo) = (followed.tolerances_rad, followed.servo);
        let until_contact = followed.until_contact;
        let cell = self.environment.cell_mut();
        cell.cancel();
        // It begins where the arm is.
        let begun = cell.begin(actual.clone(), until_contact);
        self.followed = begun.is_ok().then(|| Followed {
            servo,
            desired,
            actual,
            tolerances_rad,
            until_contact,
            begin: self.time(),
        });
    }

    /// Stops the motion under way. An arm without inertia stands still at once; another one brakes: `step` goes on until it ends.
    pub fn cancel(&mut self) {
        let was_moving = self.environment.cell_mut().cancel();
        self.velocities_rad_s = Joints::zeros();
        let Some(followed) = self.followed.take().filter(|_| was_moving) else {
            return;
        };
        let braking = Duration::from_secs_f64(self.hardware.braking_time_s);
        if braking.is_zero() {
            return;
        }
        let elapsed = self.time() - followed.begin;
        let brake = Servo::brake(&followed.actual, elapsed, braking);
        let cell = self.environment.cell_mut();
        // Where there is no way to brake, the arm stands still at once.
        if let Ok(brake) = brake {
            let _ = cell.begin(brake, false);
        }
    }

    /// Stops the motion under way at once.
    pub fn halt(&mut self) {
        self.environment.cell_mut().cancel();
        self.followed = None;
        self.velocities_rad_s = Joints::zeros();
    }

    /// Whether something moves the arm.
    pub fn is_moving(&self) -> bool {
        self.environment.cell().is_moving()
    }

    fn vacuum_is_ideal(&self) -> bool {
        let HardwareSettings {
            vacuum_build_s,
            vacuum_release_s,
            vacuum_leak_s,
            ..
        } = self.hardware;
        vacuum_build_s == 0.0 && vacuum_release_s == 0.0 && vacuum_leak_s == 0.0
    }

    /// Whether a pin has power.
    fn has_power(&self, pin: u8) -> bool {
        pin < TOOL_PINS_FROM || self.hardware.tool_voltage > 0
    }

    /// Brings the vacuum to a time. `moving`: whether the cup may have met something.
    pub fn update_vacuum(&mut self, now: Duration, moving: bool) {
        if self.vacuum_is_ideal() {
            return;
        }
        let suction = self.valve && self.has_power(self.wiring.suction_pin);
        let blow_off = u8::try_from(self.hardware.blow_off_pin).is_ok_and(|pin| {
            self.has_power(pin) && self.outputs.get(&pin).is_some_and(|level| *level)
        });
        self.leaked &= suction;
        let cell = self.environment.cell_mut();
        if suction && !self.leaked && !cell.is_holding() && (moving || !cell.suction()) {
            // The cup grips what it touches at the moment when suction goes on.
            cell.set_suction(false);
            cell.set_suction(true);
        }
        let closed = cell.is_holding();
        let valves = Valves { suction, blow_off };
        let stays = self.vacuum.update(&self.hardware, now, valves, closed);
        if closed && !stays {
            cell.set_suction(false);
            self.leaked = suction;
        } else if !suction && !closed && cell.suction() {
            cell.set_suction(false);
        }
    }

    /// Whether the cameras may look: a goal (or the reset) has brought the arm home with nothing
    /// held, and the cell has waited for the bodies to settle.
    pub fn is_at_rest(&self) -> bool {
        self.rests
    }

    /// The rewards of the motion that has led to this rest; once after each.
    pub fn assess(&mut self) -> Option<Assessment> {
        if self.assessed || !self.is_at_rest() {
            return None;
        }
        self.assessed = true;
        Some(self.environment.assess())
    }

    /// Sets an output.
    pub fn set(&mut self, output: Output) {
        match output {
            Output::Digital { pin, level } if pin == self.wiring.suction_pin => {
                self.valve = level;
                if self.vacuum_is_ideal() {
                    let level = level && self.has_power(pin);
                    self.environment.cell_mut().set_suction(level);
                }
            }
            Output::Digital { pin, level } => {
                self.outputs.insert(pin, level);
            }
            Output::Flag { flag, level } => {
                self.flags.insert(flag, level);
            }
            Output::ToolVoltage(voltage) => self.hardware.tool_voltage = voltage,
        }
    }

    /// What the tool is fed with (V).
    pub fn tool_voltage(&self) -> u8 {
        self.hardware.tool_voltage
    }

    /// All pins and flags.
    pub fn pins(&self) -> Pins {
        let cell = self.environment.cell();
        let Wiring {
            suction_pin,
            vacuum_pin,
        } = self.wiring;
        let senses = match self.vacuum_is_ideal() {
            true => cell.is_holding(),
            false => self.vacuum.senses() && self.has_power(vacuum_pin),
        };
        let enable_pin = u8::try_from(self.hardware.enable_pin).ok();
        let inputs = (0..PINS).map(|pin| {
            let enabled = Some(pin) == enable_pin && self.hardware.enabled;
            (pin, enabled || pin == vacuum_pin && senses)
        });
        let mut outputs = self.outputs.clone();
        outputs.insert(suction_pin, self.valve);
        Pins {
            inputs: inputs.collect(),
            outputs,
            flags: self.flags.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ur5::TrajectoryPoint;

    const WIRING: Wiring = Wiring {
        suction_pin: 16,
        vacuum_pin: 17,
    };

    fn problem() -> Problem {
        let text = include_str!("../../../config/problems/placing.yaml");
        Problem::parse("placing", text).unwrap()
    }

    fn cell() -> (SimulatedCell, WorkCell) {
        let work_cell = WorkCell::builtin().unwrap();
        (
            SimulatedCell::new(
                &problem(),
                &work_cell,
                10_000,
                WIRING,
                None,
                HardwareSettings::default(),
            )
            .unwrap(),
            work_cell,
        )
    }

    const NOW: Duration = Duration::ZERO;

    fn any() -> Joints {
        Joints::repeat(-1.0)
    }

    fn set(cell: &mut SimulatedCell, pin: i8, level: f32) {
        cell.set(Output::digital(pin, level).unwrap());
    }

    fn output(cell: &SimulatedCell, pin: u8) -> bool {
        cell.pins().outputs[&pin]
    }

    /// The shoulder turns by 0.1 rad in 1 s.
    fn turn(work_cell: &WorkCell) -> JointTrajectory {
        let mut end = work_cell.arm.home;
        end[0] += 0.1;
        let point = |time, positions_rad| TrajectoryPoint {
            time,
            positions_rad,
            velocities_rad_s: Joints::zeros(),
        };
        let begin = point(Duration::ZERO, work_cell.arm.home);
        JointTrajectory::new(vec![begin, point(Duration::from_secs(1), end)]).unwrap()
    }

    #[test]
    fn pins_are_set_and_shown_and_suction_is_one_of_them() {
        let (mut cell, _) = cell();
        assert!(!output(&cell, 16) && !output(&cell, 3));
        set(&mut cell, 16, 1.0);
        set(&mut cell, 3, 1.0);
        assert!(output(&cell, 16) && output(&cell, 3));
        assert!(cell.environment().cell().suction());
        // Again, because the reply was lost.
        set(&mut cell, 16, 1.0);
        set(&mut cell, 16, 0.0);
        assert!(!output(&cell, 16) && output(&cell, 3));
        // In the air nothing is held.
        assert!(cell.pins().inputs.values().all(|level| !level));
    }

    #[test]
    fn outputs_that_there_are_not_are_refused() {
        for (output, expected) in [
            (Output::digital(-1, 1.0), "pin is -1, expected 0 to 17"),
            (Output::digital(18, 1.0), "pin is 18, expected 0 to 17"),
            (Output::digital(16, 0.5), "state is 0.5, expected 0 or 1"),
            (Output::digital(16, f32::NAN), "state is NaN"),
            (Output::flag(-128, 1.0), "expected 0 to 127"),
            (Output::tool_voltage(13.0), "expected 0, 12 or 24 V"),
        ] {
            let reason = output.unwrap_err().to_string();
            assert!(reason.contains(expected), "{reason}");
        }
    }

    #[test]
    fn a_goal_moves_the_arm_in_simulated_time_only() {
        let (mut cell, work_cell) = cell();
        assert!(cell.is_at_rest());
        assert_eq!(cell.assess(), None);
        let start = cell.time();
        let trajectory = turn(&work_cell);
        cell.begin(trajectory.clone(), false, &any()).unwrap();
        assert_eq!(cell.step(NOW), Step::Moving);
        assert!(cell.begin(trajectory.clone(), false, &any()).is_err());
        while cell.step(NOW) == Step::Moving {}
        assert!(cell.time() - start >= Duration::from_secs(1));
        assert!((cell.joints_rad() - trajectory.last().positions_rad).amax() < 1e-12);
        assert_eq!(cell.velocities_rad_s(), Joints::zeros());
        assert!(!cell.is_at_rest());
        assert_eq!(cell.assess(), None);
        // From here the same trajectory would jump.
        let failure = cell.begin(trajectory, false, &any()).unwrap_err();
        assert!(failure.to_string().contains("starts at"), "{failure}");
    }

    #[test]
    fn the_speed_slider_counts_in_the_middle_of_a_motion() {
        let (mut cell, work_cell) = cell();
        let mut hardware = HardwareSettings {
            servo_delay_s: 0.03,
            braking_time_s: 0.1,
            ..HardwareSettings::default()
        };
        cell.set_hardware(&hardware);
        let trajectory = turn(&work_cell);
        let start = cell.time();
        cell.begin(trajectory.clone(), false, &Joints::repeat(0.05))
            .unwrap();
        while cell.time() - start < Duration::from_millis(500) {
            assert_eq!(cell.step(NOW), Step::Moving);
        }
        let before_rad = cell.joints_rad()[0];
        hardware.speed_scaling = 0.25;
        cell.set_hardware(&hardware);
        // It goes on from where it is.
        assert_eq!(cell.step(NOW), Step::Moving);
        assert!((cell.joints_rad()[0] - before_rad).abs() < 1e-3);
        let ended = loop {
            match cell.step(NOW) {
                Step::Moving => {}
                ended => break ended,
            }
        };
        assert_eq!(ended, Step::Ended(MotionEnd::Reached));
        assert!((cell.joints_rad() - trajectory.last().positions_rad).amax() < 1e-6);
        // Half a second of way was left, at a quarter of the speed.
        assert!(cell.time() - start > Duration::from_millis(2200));
    }

    #[test]
    fn a_reset_begins_the_episode_of_a_seed_as_a_start_does_and_time_goes_on() {
        let (mut cell, work_cell) = cell();
        let start = (cell.time(), cell.environment().state_hash());
        let trajectory = turn(&work_cell);
        cell.begin(trajectory, false, &any()).unwrap();
        while cell.step(NOW) == Step::Moving {}
        set(&mut cell, 16, 1.0);
        let before = cell.time();
        cell.reset(&problem(), &work_cell, 10_002).unwrap();
        assert_ne!(cell.environment().state_hash(), start.1);
        cell.reset(&problem(), &work_cell, 10_000).unwrap();
        assert_eq!(cell.environment().state_hash(), start.1);
        assert!(cell.time() > before + PAUSE && cell.is_at_rest());
        assert_eq!(cell.joints_rad(), work_cell.arm.home);
        assert!(!output(&cell, 16) && cell.assess().is_none());
    }

    #[test]
    fn a_cancelled_arm_stands_still() {
        let (mut cell, work_cell) = cell();
        let trajectory = turn(&work_cell);
        cell.begin(trajectory, false, &any()).unwrap();
        for _ in 0..200 {
            assert_eq!(cell.step(NOW), Step::Moving);
        }
        assert!(cell.velocities_rad_s().amax() > 0.0);
        cell.cancel();
        let (time, joints) = (cell.time(), cell.joints_rad());
        assert!(matches!(cell.step(NOW), Step::Failed(_)));
        assert_eq!((cell.time(), cell.joints_rad()), (time, joints));
        assert_eq!(cell.velocities_rad_s(), Joints::zeros());
    }

    #[test]
    fn time_catches_up_little_by_little() {
        let (mut cell, _) = cell();
        let start = cell.time();
        let until = start + Duration::from_millis(300);
        cell.catch_up(until, NOW).unwrap();
        let first = cell.time() - start;
        assert!(first >= MOST_CATCH_UP && first < until - start, "{first:?}");
        cell.catch_up(until, NOW).unwrap();
        let reached = cell.time();
        assert!(reached >= until);
        cell.catch_up(until, NOW).unwrap();
        assert_eq!(cell.time(), reached);
    }

    fn behaving(hardware: HardwareSettings) -> (SimulatedCell, WorkCell) {
        let (_, work_cell) = cell();
        let problem = problem();
        let cell = SimulatedCell::new(&problem, &work_cell, 10_000, WIRING, None, hardware);
        (cell.unwrap(), work_cell)
    }

    #[test]
    fn an_arm_that_lags_behind_leaves_a_tight_tolerance_and_keeps_a_loose_one() {
        let (mut cell, work_cell) = behaving(HardwareSettings {
            servo_delay_s: 0.05,
            braking_time_s: 0.1,
            ..HardwareSettings::default()
        });
        let trajectory = turn(&work_cell);
        let end = trajectory.last().positions_rad;
        let begin = cell.begin(trajectory.clone(), false, &Joints::repeat(0.002));
        begin.unwrap();
        let deviation = loop {
            match cell.step(NOW) {
                Step::Moving => {}
                Step::Deviated(deviation) => break deviation,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(deviation.joint, 0);
        // The arm brakes on its way, and stands.
        let at_deviation = cell.joints_rad()[0];
        cell.cancel();
        assert!(cell.is_moving());
        while cell.is_moving() {
            cell.step(NOW);
        }
        let braked = cell.joints_rad()[0] - at_deviation;
        assert!(0.0 < braked && braked < 0.01, "{braked}");

        let (mut cell, _) = behaving(HardwareSettings {
            servo_delay_s: 0.05,
            ..HardwareSettings::default()
        });
        cell.begin(trajectory, false, &Joints::repeat(0.2)).unwrap();
        while cell.step(NOW) == Step::Moving {}
        assert!((cell.joints_rad() - end).amax() < 1e-12);
    }

    #[test]
    fn without_tool_voltage_the_valve_has_no_power() {
        let (mut cell, _) = behaving(HardwareSettings {
            tool_voltage: 0,
            ..HardwareSettings::default()
        });
        set(&mut cell, 16, 1.0);
        assert!(output(&cell, 16) && !cell.environment().cell().suction());
        assert_eq!(cell.tool_voltage(), 0);
        cell.set(Output::tool_voltage(24.0).unwrap());
        set(&mut cell, 16, 1.0);
        assert!(cell.environment().cell().suction());
        assert_eq!(cell.tool_voltage(), 24);
    }
}
