//! The simulated hardware as the driver shows it, without middleware.

use std::collections::BTreeMap;
use std::time::Duration;

use camera_noise::Perturbation;
use msgs::control_msgs::FollowJointTrajectoryResult;
use msgs::ur_msgs::{Digital, IOStates, SetIORequest};
use multiravens::{Assessment, Environment, EnvironmentError, MotionEnd, Problem, Tick};
use ur5::{JointTrajectory, Joints, WorkCell};

use crate::driver::Failure;

/// Pins of a UR controller: 0 to 7 standard, 8 to 15 configurable, 16 and 17 at the tool.
const PINS: u8 = 18;

/// Which pins suction is wired to.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Wiring {
    pub suction_pin: u8,
    pub vacuum_pin: u8,
}

/// Time between the end of an episode and the beginning of the next.
const PAUSE: Duration = Duration::from_secs(1);

/// An episode of a problem, driven by goals and pins.
pub(crate) struct Workcell {
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
    /// The last goal has ended with the arm at home, nothing held, and the bodies settled.
    rests: bool,
    /// The rewards of this rest have been told.
    assessed: bool,
}

/// What a step of the physics has done.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Step {
    Moving,
    Ended(MotionEnd),
    Failed(String),
}

impl Workcell {
    /// An episode with everything at rest.
    pub(crate) fn new(
        problem: &Problem,
        work_cell: &WorkCell,
        seed: u64,
        wiring: Wiring,
        perturbation: Option<Perturbation>,
    ) -> Result<Self, EnvironmentError> {
        let mut environment = Environment::new(problem, work_cell);
        environment.set_perturbation(perturbation.as_ref());
        environment.reset(seed)?;
        Ok(Self {
            environment,
            past: Duration::ZERO,
            wiring,
            perturbation,
            outputs: (0..PINS).map(|pin| (pin, false)).collect(),
            flags: BTreeMap::new(),
            velocities_rad_s: Joints::zeros(),
            rests: true,
            assessed: true,
        })
    }

    /// Begins another episode. The state stays as it is where that cannot begin.
    pub(crate) fn reset(
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
        )?;
        let past = self.time() + PAUSE;
        *self = Self { past, ..next };
        Ok(())
    }

    pub(crate) fn environment(&self) -> &Environment {
        &self.environment
    }

    pub(crate) fn environment_mut(&mut self) -> &mut Environment {
        &mut self.environment
    }

    /// Simulated time since the node's start.
    pub(crate) fn time(&self) -> Duration {
        self.past + self.environment.cell().time()
    }

    pub(crate) fn joints_rad(&self) -> Joints {
        self.environment.cell().joint_positions()
    }

    pub(crate) fn velocities_rad_s(&self) -> Joints {
        self.velocities_rad_s
    }

    /// Begins a goal.
    pub(crate) fn begin(
        &mut self,
        trajectory: JointTrajectory,
        until_contact: bool,
    ) -> Result<(), Failure> {
        let cell = self.environment.cell_mut();
        cell.begin(trajectory, until_contact).map_err(|error| {
            let code = FollowJointTrajectoryResult::INVALID_GOAL;
            Failure::new(code, one_line(&error.to_string()))
        })?;
        self.rests = false;
        self.assessed = false;
        Ok(())
    }

    /// One physics step.
    pub(crate) fn step(&mut self) -> Step {
        let (before_rad, before) = (self.joints_rad(), self.time());
        let ticked = self.environment.cell_mut().tick();
        let elapsed_s = (self.time() - before).as_secs_f64();
        self.velocities_rad_s = match ticked {
            Ok(Tick::Moving) if elapsed_s > 0.0 => (self.joints_rad() - before_rad) / elapsed_s,
            _ => Joints::zeros(),
        };
        match ticked {
            Ok(Tick::Moving) => Step::Moving,
            Ok(Tick::Ended(end)) => {
                let cell = self.environment.cell();
                self.rests = cell.is_home() && !cell.is_holding();
                Step::Ended(end)
            }
            Ok(Tick::Idle) => Step::Failed("there is no motion under way".into()),
            Err(error) => Step::Failed(one_line(&error.to_string())),
        }
    }

    /// Stops at once: the simulated arm has no momentum.
    pub(crate) fn cancel(&mut self) {
        self.environment.cell_mut().cancel();
        self.velocities_rad_s = Joints::zeros();
    }

    /// Whether the cameras may look: a goal (or the reset) has brought the arm home with nothing
    /// held, and the cell has waited for the bodies to settle.
    pub(crate) fn is_at_rest(&self) -> bool {
        self.rests
    }

    /// The rewards of the motion that has led to this rest; once after each.
    pub(crate) fn assess(&mut self) -> Option<Assessment> {
        if self.assessed || !self.is_at_rest() {
            return None;
        }
        self.assessed = true;
        Some(self.environment.assess())
    }

    /// Carries out a request of `set_io`. Says why it cannot.
    pub(crate) fn set_io(&mut self, request: &SetIORequest) -> Result<(), String> {
        let pin = |most: u8| {
            u8::try_from(request.pin)
                .ok()
                .filter(|pin| *pin < most)
                .ok_or_else(|| format!("pin is {}, expected 0 to {}", request.pin, most - 1))
        };
        let level = || match request.state {
            0.0 => Ok(false),
            1.0 => Ok(true),
            other => Err(format!("state is {other}, expected 0 or 1")),
        };
        match request.fun {
            SetIORequest::FUN_SET_DIGITAL_OUT => {
                let (pin, level) = (pin(PINS)?, level()?);
                if pin == self.wiring.suction_pin {
                    self.environment.cell_mut().set_suction(level);
                } else {
                    self.outputs.insert(pin, level);
                }
            }
            SetIORequest::FUN_SET_FLAG => {
                self.flags.insert(pin(128)?, level()?);
            }
            other => {
                return Err(format!(
                    "fun is {other}, expected FUN_SET_DIGITAL_OUT ({}) or FUN_SET_FLAG ({})",
                    SetIORequest::FUN_SET_DIGITAL_OUT,
                    SetIORequest::FUN_SET_FLAG
                ));
            }
        }
        Ok(())
    }

    pub(crate) fn io_states(&self) -> IOStates {
        let cell = self.environment.cell();
        let Wiring {
            suction_pin,
            vacuum_pin,
        } = self.wiring;
        let digital = |(pin, state)| Digital { pin, state };
        IOStates {
            digital_in_states: (0..PINS)
                .map(|pin| (pin, pin == vacuum_pin && cell.is_holding()))
                .map(digital)
                .collect(),
            digital_out_states: self
                .outputs
                .iter()
                .map(|(pin, state)| {
                    (
                        *pin,
                        if *pin == suction_pin {
                            cell.suction()
                        } else {
                            *state
                        },
                    )
                })
                .map(digital)
                .collect(),
            flag_states: self
                .flags
                .iter()
                .map(|(pin, state)| digital((*pin, *state)))
                .collect(),
            ..Default::default()
        }
    }
}

/// Vectors print themselves over several lines.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driver::follow_trajectory;
    use crate::driver::tests::turn;

    const WIRING: Wiring = Wiring {
        suction_pin: 16,
        vacuum_pin: 17,
    };

    fn problem() -> Problem {
        let text = include_str!("../../../config/problems/placing.yaml");
        Problem::parse("placing", text).unwrap()
    }

    fn workcell() -> (Workcell, WorkCell) {
        let work_cell = WorkCell::builtin().unwrap();
        (
            Workcell::new(&problem(), &work_cell, 10_000, WIRING, None).unwrap(),
            work_cell,
        )
    }

    fn set(pin: i8, state: f32) -> SetIORequest {
        SetIORequest {
            fun: SetIORequest::FUN_SET_DIGITAL_OUT,
            pin,
            state,
        }
    }

    fn output(workcell: &Workcell, pin: u8) -> bool {
        let states = workcell.io_states().digital_out_states;
        states
            .iter()
            .find(|digital| digital.pin == pin)
            .unwrap()
            .state
    }

    #[test]
    fn pins_are_set_and_shown_and_suction_is_one_of_them() {
        let (mut workcell, _) = workcell();
        assert!(!output(&workcell, 16) && !output(&workcell, 3));
        workcell.set_io(&set(16, 1.0)).unwrap();
        workcell.set_io(&set(3, 1.0)).unwrap();
        assert!(output(&workcell, 16) && output(&workcell, 3));
        assert!(workcell.environment().cell().suction());
        // Again, because the reply was lost.
        workcell.set_io(&set(16, 1.0)).unwrap();
        workcell.set_io(&set(16, 0.0)).unwrap();
        assert!(!output(&workcell, 16) && output(&workcell, 3));
        // In the air nothing is held.
        assert!(
            workcell
                .io_states()
                .digital_in_states
                .iter()
                .all(|digital| !digital.state)
        );
    }

    #[test]
    fn requests_without_sense_change_nothing() {
        let (mut workcell, _) = workcell();
        let before = workcell.io_states();
        for (request, expected) in [
            (set(-1, 1.0), "pin is -1"),
            (set(18, 1.0), "pin is 18"),
            (set(16, 0.5), "state is 0.5"),
            (set(16, f32::NAN), "state is NaN"),
            (
                SetIORequest {
                    fun: 3,
                    ..set(0, 1.0)
                },
                "fun is 3",
            ),
        ] {
            let reason = workcell.set_io(&request).unwrap_err();
            assert!(reason.contains(expected), "{reason}");
        }
        assert_eq!(workcell.io_states(), before);
    }

    #[test]
    fn a_goal_moves_the_arm_in_simulated_time_only() {
        let (mut workcell, work_cell) = workcell();
        assert!(workcell.is_at_rest());
        assert_eq!(workcell.assess(), None);
        let start = workcell.time();
        let trajectory =
            follow_trajectory(&turn(&work_cell), &work_cell.arm, &work_cell.joint_names).unwrap();
        workcell.begin(trajectory.clone(), false).unwrap();
        assert_eq!(workcell.step(), Step::Moving);
        assert!(workcell.begin(trajectory.clone(), false).is_err());
        while workcell.step() == Step::Moving {}
        assert!(workcell.time() - start >= Duration::from_secs(1));
        assert!((workcell.joints_rad() - trajectory.last().positions_rad).amax() < 1e-12);
        assert_eq!(workcell.velocities_rad_s(), Joints::zeros());
        assert!(!workcell.is_at_rest());
        assert_eq!(workcell.assess(), None);
        // From here the same trajectory would jump.
        let failure = workcell.begin(trajectory, false).unwrap_err();
        assert!(failure.reason.contains("starts at"), "{failure}");
    }

    #[test]
    fn a_reset_begins_the_episode_of_a_seed_as_a_start_does_and_time_goes_on() {
        let (mut workcell, work_cell) = workcell();
        let start = (workcell.time(), workcell.environment().state_hash());
        let trajectory =
            follow_trajectory(&turn(&work_cell), &work_cell.arm, &work_cell.joint_names).unwrap();
        workcell.begin(trajectory, false).unwrap();
        while workcell.step() == Step::Moving {}
        workcell.set_io(&set(16, 1.0)).unwrap();
        let before = workcell.time();
        workcell.reset(&problem(), &work_cell, 10_002).unwrap();
        assert_ne!(workcell.environment().state_hash(), start.1);
        workcell.reset(&problem(), &work_cell, 10_000).unwrap();
        assert_eq!(workcell.environment().state_hash(), start.1);
        assert!(workcell.time() > before + PAUSE && workcell.is_at_rest());
        assert_eq!(workcell.joints_rad(), work_cell.arm.home);
        assert!(!output(&workcell, 16) && workcell.assess().is_none());
    }

    #[test]
    fn a_cancelled_arm_stands_still() {
        let (mut workcell, work_cell) = workcell();
        let trajectory =
            follow_trajectory(&turn(&work_cell), &work_cell.arm, &work_cell.joint_names).unwrap();
        workcell.begin(trajectory, false).unwrap();
        for _ in 0..200 {
            assert_eq!(workcell.step(), Step::Moving);
        }
        assert!(workcell.velocities_rad_s().amax() > 0.0);
        workcell.cancel();
        let (time, joints) = (workcell.time(), workcell.joints_rad());
        assert!(matches!(workcell.step(), Step::Failed(_)));
        assert_eq!((workcell.time(), workcell.joints_rad()), (time, joints));
        assert_eq!(workcell.velocities_rad_s(), Joints::zeros());
    }
}
