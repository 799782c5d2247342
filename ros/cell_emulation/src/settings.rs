//! Settings of the emulator.

use std::path::PathBuf;

use driver_model::HardwareSettings;
use node_kit::{Range, Ranges};
use serde::{Deserialize, Serialize};

use crate::server::ActionNames;

/// What the emulated cell does, and how it is paced.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EmulatorSettings {
    /// Name of the problem: a file in `problems_dir`, without `.yaml`.
    pub problem: String,
    /// Seed of the episode.
    pub seed: u64,
    /// Directory of the problem files.
    pub problems_dir: PathBuf,
    /// Frame of the work cell.
    pub world_frame: String,
    /// Whether to say where the links are and what they look like.
    pub publish_robot: bool,
    /// Action that follows a trajectory.
    pub follow_action: String,
    /// Action that follows a trajectory until the tool touches something.
    pub until_action: String,
    /// Simulated seconds per wall second; 0 for as fast as the host can.
    pub real_time_factor: f64,
    /// Joint states and clock messages per simulated second.
    pub joint_states_rate_hz: f64,
    /// Wall seconds between repeats of joint and pin states and clock while nothing moves; five times as many
    /// when no command has come for a second.
    pub status_period_s: f64,
    /// Wall seconds between repeats of the camera frames while nothing moves.
    pub frames_period_s: f64,
    /// How the driver behaves; an ideal one by default.
    pub hardware: HardwareSettings,
}

impl Default for EmulatorSettings {
    fn default() -> Self {
        Self {
            problem: "placing".into(),
            seed: 10_000,
            problems_dir: "config/problems".into(),
            world_frame: "world".into(),
            publish_robot: true,
            follow_action: "scaled_joint_trajectory_controller/follow_joint_trajectory".into(),
            until_action: "trajectory_until_node/execute".into(),
            real_time_factor: 0.0,
            joint_states_rate_hz: 50.0,
            status_period_s: 0.02,
            frames_period_s: 1.0,
            hardware: HardwareSettings::default(),
        }
    }
}

/// Times that hardware takes (s).
const DELAY: Range = Range::Float(0.0, 60.0);

impl EmulatorSettings {
    /// Bounds, by dotted name.
    pub const RANGES: Ranges = &[
        ("seed", Range::Integer(0, i64::MAX)),
        ("real_time_factor", Range::NOT_NEGATIVE),
        // At most the rate of the physics.
        ("joint_states_rate_hz", Range::Float(1.0, 480.0)),
        ("status_period_s", Range::DURATION_S),
        ("frames_period_s", Range::DURATION_S),
        ("hardware.until_answer_min_s", DELAY),
        ("hardware.until_answer_max_s", DELAY),
        ("hardware.servo_delay_s", Range::Float(0.0, 1.0)),
        ("hardware.path_tolerance_rad", Range::POSITIVE),
        ("hardware.encoder_noise_rad", Range::Float(0.0, 0.1)),
        ("hardware.speed_scaling", Range::Float(0.01, 1.0)),
        ("hardware.braking_time_s", Range::Float(0.0, 1.0)),
        ("hardware.software_major", Range::Integer(3, 10)),
        ("hardware.tool_voltage", Range::Integer(0, 24)),
        ("hardware.vacuum_build_s", DELAY),
        ("hardware.vacuum_release_s", DELAY),
        ("hardware.vacuum_leak_s", Range::NOT_NEGATIVE),
        ("hardware.blow_off_pin", Range::PIN_OR_NONE),
        ("hardware.enable_pin", Range::PIN_OR_NONE),
    ];

    /// Names of the motion actions.
    pub fn actions(&self) -> ActionNames {
        ActionNames {
            follow: self.follow_action.clone(),
            until: self.until_action.clone(),
        }
    }
}
