//! Stops and faults, and what the driver says of each.

use serde::{Deserialize, Serialize};

/// What is wrong with the robot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fault {
    /// Nothing.
    #[default]
    None,
    /// The robot has stopped itself because it met something.
    ProtectiveStop,
    /// Somebody has pressed the emergency stop.
    EmergencyStop,
    /// Somebody has stopped the robot's program at the teach pendant.
    ProgramStopped,
    /// The driver's process is gone: it publishes nothing and answers nothing.
    DriverDead,
}

/// What the driver publishes of the robot's state, in the numbers of `ur_dashboard_msgs`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Modes {
    /// `RobotMode`: 7 is RUNNING, 3 POWER_OFF.
    pub robot_mode: i8,
    /// `SafetyMode`: 1 is NORMAL, 3 PROTECTIVE_STOP, 7 ROBOT_EMERGENCY_STOP.
    pub safety_mode: u8,
    /// Whether the driver's program runs on the robot. Where it does not, trajectories are rejected.
    pub program_running: bool,
}

impl Fault {
    /// What the driver says; of a dead driver, what it said last.
    pub fn modes(self) -> Modes {
        let (robot_mode, safety_mode, program_running) = match self {
            Self::None | Self::DriverDead => (7, 1, true),
            Self::ProtectiveStop => (7, 3, false),
            // The arm is switched off, its brakes hold it.
            Self::EmergencyStop => (3, 7, false),
            Self::ProgramStopped => (7, 1, false),
        };
        Modes {
            robot_mode,
            safety_mode,
            program_running,
        }
    }

    /// Whether the arm may go on.
    pub fn lets_move(self) -> bool {
        self == Self::None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_robot_without_a_fault_moves() {
        for fault in [
            Fault::None,
            Fault::ProtectiveStop,
            Fault::EmergencyStop,
            Fault::ProgramStopped,
            Fault::DriverDead,
        ] {
            assert_eq!(fault.lets_move(), fault == Fault::None);
            let says = fault.modes();
            let ready = (says.robot_mode, says.safety_mode, says.program_running) == (7, 1, true);
            // A dead driver cannot say that it is dead.
            assert_eq!(
                ready,
                matches!(fault, Fault::None | Fault::DriverDead),
                "{fault:?}"
            );
        }
    }
}
