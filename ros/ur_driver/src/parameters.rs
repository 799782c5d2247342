//! Parameters of the driver's edge; the node that uses it documents each in its configuration file.

use node_kit::{Range, Ranges};
use pick_place::ContactSign;
use serde::{Deserialize, Serialize};

/// The driver and its wiring.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DriverParameters {
    /// Action that follows a trajectory.
    pub follow_action: String,
    /// Action that follows a trajectory until the tool touches something.
    pub until_action: String,
    /// Namespace of `set_io`, `io_states`, `robot_mode`, `safety_mode`, `robot_program_running`.
    pub io_and_status: String,
    /// Digital output that switches suction.
    pub suction_pin: u8,
    /// Digital input of the vacuum sensor.
    pub vacuum_pin: u8,
    /// Digital input without which nothing moves: low in a motion is a stop; -1 for none.
    pub enable_pin: i8,
    /// Wall seconds; nothing moves when joint or pin states are older.
    pub status_max_age_s: f64,
    /// Wall seconds to wait for a fresh state of the joints or pins.
    pub reading_timeout_s: f64,
    /// Joints slower than this stand still.
    pub rest_speed_rad_s: f64,
    /// Wall seconds that joints have to stand still to count as at rest; ten times that in simulated
    /// time that does not stand still with them.
    pub rest_time_s: f64,
    /// Largest deviation on the way that is asked of the controller.
    pub path_tolerance_rad: f64,
    /// Largest deviation at the end that is asked of the controller.
    pub goal_tolerance_rad: f64,
    /// A motion may take this many times its planned duration, ...
    pub motion_time_factor: f64,
    /// ... and this much more, in seconds of ROS time.
    pub motion_time_margin_s: f64,
    /// Whether an arm that leaves its path lets go and goes home, as in the simulated cell, where a cable that is pulled too hard does that.
    /// On a real arm it may have met something: a fault.
    pub lag_rule: bool,
    /// What tells that the tool touches something.
    pub contact: ContactSign,
    /// Wall seconds that vacuum may take after suction was switched on.
    pub grasp_wait_s: f64,
    /// Wall seconds that vacuum may stay after suction was switched off.
    pub release_wait_s: f64,
    /// Digital output that blows the object off, on while it is released; -1 for none.
    pub blow_off_pin: i8,
    /// Namespace of `list_controllers`.
    pub controller_manager: String,
    /// Whether controllers, actions, the robot's software and the tool's voltage are checked before anything moves.
    pub check_controllers: bool,
    /// Wall seconds that an action may take to answer a goal.
    pub answer_timeout_s: f64,
    /// Wall seconds within which a motion that was broken off has to come to rest.
    pub stop_timeout_s: f64,
    /// Wall seconds for each attempt of a call.
    pub call_timeout_s: f64,
    /// Attempts of each call.
    pub call_attempts: u32,
}

impl Default for DriverParameters {
    fn default() -> Self {
        Self {
            follow_action: "scaled_joint_trajectory_controller/follow_joint_trajectory".into(),
            until_action: "trajectory_until_node/execute".into(),
            io_and_status: "io_and_status_controller".into(),
            suction_pin: 16,
            vacuum_pin: 16,
            enable_pin: -1,
            status_max_age_s: 2.0,
            reading_timeout_s: 5.0,
            rest_speed_rad_s: 1e-3,
            rest_time_s: 0.1,
            path_tolerance_rad: 0.2,
            goal_tolerance_rad: 0.01,
            motion_time_factor: 3.0,
            motion_time_margin_s: 15.0,
            lag_rule: false,
            contact: ContactSign::UntilAction,
            grasp_wait_s: 0.3,
            release_wait_s: 1.0,
            blow_off_pin: -1,
            controller_manager: "controller_manager".into(),
            check_controllers: true,
            answer_timeout_s: 5.0,
            stop_timeout_s: 1.0,
            call_timeout_s: 1.0,
            call_attempts: 5,
        }
    }
}

impl DriverParameters {
    /// Bounds, by name.
    pub const RANGES: Ranges = &[
        ("suction_pin", Range::PIN),
        ("vacuum_pin", Range::PIN),
        ("enable_pin", Range::PIN_OR_NONE),
        ("status_max_age_s", Range::DURATION_S),
        ("reading_timeout_s", Range::DURATION_S),
        ("rest_speed_rad_s", Range::POSITIVE),
        ("rest_time_s", Range::DURATION_S),
        ("path_tolerance_rad", Range::POSITIVE),
        ("goal_tolerance_rad", Range::POSITIVE),
        ("motion_time_factor", Range::POSITIVE),
        ("motion_time_margin_s", Range::DURATION_S),
        ("grasp_wait_s", Range::Float(0.0, 60.0)),
        ("release_wait_s", Range::Float(0.0, 60.0)),
        ("blow_off_pin", Range::PIN_OR_NONE),
        ("answer_timeout_s", Range::DURATION_S),
        ("stop_timeout_s", Range::DURATION_S),
        ("call_timeout_s", Range::DURATION_S),
        ("call_attempts", Range::Integer(1, 100)),
    ];
}
