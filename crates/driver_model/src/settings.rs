//! All parameters in one place.

use crate::Fault;
use serde::{Deserialize, Serialize};

/// How the driver behaves. The default is an ideal driver: nothing takes time, nothing fails.
///
/// Times are in seconds of the wall clock unless the field says otherwise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HardwareSettings {
    /// Whether simulated time goes on with the wall clock while nothing moves.
    pub free_running: bool,
    /// `trajectory_until_node` answers a goal after this long at least (s), ...
    pub until_answer_min_s: f64,
    /// ... and after this long at most (s). UR's released drivers take 1 to 2 s.
    pub until_answer_max_s: f64,
    /// Whether actions behave as rclcpp's: a goal id that comes again kills the trajectory controller's process and is rejected as busy
    /// by `trajectory_until_node`; a new trajectory replaces the one under way. Otherwise a repeated goal gets the first answer
    /// again, and a goal that comes while another is active is rejected.
    pub strict_actions: bool,
    /// The joints follow a trajectory this much later (s of simulated time); UR's servoj looks 0.03 s ahead.
    pub servo_delay_s: f64,
    /// Path tolerance of a goal that asks for none (rad); UR's own is 0.2.
    pub path_tolerance_rad: f64,
    /// Standard deviation of the positions in `joint_states` (rad).
    pub encoder_noise_rad: f64,
    /// Share of the planned speed, as the slider on the teach pendant sets it (0.01 to 1), also in the middle of a motion of an arm that lags
    /// or brakes.
    pub speed_scaling: f64,
    /// How long the arm takes to stop when a goal is cancelled or the driver stops it (s of simulated time).
    pub braking_time_s: f64,
    /// Controllers that are loaded but not active.
    pub inactive_controllers: Vec<String>,
    /// Major version of the robot's software: 3 for a CB3, 5 or more for an e-Series. A CB3 has neither tool contact nor `trajectory_until_node`.
    pub software_major: u32,
    /// Voltage at the tool connector (V): 0, 12 or 24. At 0 pins 16 and 17 switch nothing.
    pub tool_voltage: u8,
    /// How long it takes from contact with suction on until the sensor says that something is held (s).
    pub vacuum_build_s: f64,
    /// How long the vacuum holds after suction was switched off (s).
    pub vacuum_release_s: f64,
    /// After how long what is held is lost (s); 0 for never.
    pub vacuum_leak_s: f64,
    /// Digital output that blows off what hangs at the cup once suction is off; -1 for none.
    pub blow_off_pin: i8,
    /// Digital input of an enabling switch; -1 for none.
    pub enable_pin: i8,
    /// Whether the enabling switch is held.
    pub enabled: bool,
    /// What is wrong with the robot now.
    pub fault: Fault,
}

impl Default for HardwareSettings {
    fn default() -> Self {
        Self {
            free_running: false,
            until_answer_min_s: 0.0,
            until_answer_max_s: 0.0,
            strict_actions: false,
            servo_delay_s: 0.0,
            path_tolerance_rad: 0.2,
            encoder_noise_rad: 0.0,
            speed_scaling: 1.0,
            braking_time_s: 0.0,
            inactive_controllers: Vec::new(),
            software_major: 5,
            tool_voltage: 24,
            vacuum_build_s: 0.0,
            vacuum_release_s: 0.0,
            vacuum_leak_s: 0.0,
            blow_off_pin: -1,
            enable_pin: -1,
            enabled: true,
            fault: Fault::None,
        }
    }
}
