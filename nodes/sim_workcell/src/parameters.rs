//! Parameters; `config/sim_workcell.yaml` explains each.

use std::path::PathBuf;

use cell_emulation::ActionNames;
use driver_model::HardwareSettings;
use node_kit::{Parameters, Range};
use serde::{Deserialize, Serialize};

/// Parameters of the node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimWorkcellParameters {
    /// Name of the problem: a file in `problems_dir`, without `.yaml`.
    pub problem: String,
    /// Seed of the episode.
    pub seed: u64,
    /// Directory of the problem files.
    pub problems_dir: PathBuf,
    /// URDF of the work cell; empty for the one that was compiled in.
    pub urdf: PathBuf,
    /// Frame of the work cell.
    pub world_frame: String,
    /// Whether to say where the links are and what they look like.
    pub publish_robot: bool,
    /// Action that follows a trajectory.
    pub follow_action: String,
    /// Action that follows a trajectory until the tool touches something.
    pub until_action: String,
    /// Digital output that switches suction.
    pub suction_pin: u8,
    /// Digital input of the vacuum sensor.
    pub vacuum_pin: u8,
    /// Simulated seconds per wall second; 0 for as fast as the host can.
    pub real_time_factor: f64,
    /// Joint states and clock messages per simulated second.
    pub joint_states_rate_hz: f64,
    /// Wall seconds between repeats of joint and pin states and clock while nothing moves; five times as many
    /// when no command has come for a second.
    pub status_period_s: f64,
    /// Wall seconds between repeats of the camera frames while nothing moves.
    pub frames_period_s: f64,
    /// What the cameras do: a file as those of config/perturbations; empty for perfect ones.
    pub perturbation: PathBuf,
    /// How the driver behaves; an ideal one by default.
    pub hardware: HardwareSettings,
}

impl SimWorkcellParameters {
    /// Names of the motion actions.
    pub(crate) fn actions(&self) -> ActionNames {
        ActionNames {
            follow: self.follow_action.clone(),
            until: self.until_action.clone(),
        }
    }
}

impl Default for SimWorkcellParameters {
    fn default() -> Self {
        Self {
            problem: "placing".into(),
            seed: 10_000,
            problems_dir: "config/problems".into(),
            urdf: PathBuf::new(),
            world_frame: "world".into(),
            publish_robot: true,
            follow_action: "scaled_joint_trajectory_controller/follow_joint_trajectory".into(),
            until_action: "trajectory_until_node/execute".into(),
            suction_pin: 16,
            vacuum_pin: 16,
            real_time_factor: 0.0,
            joint_states_rate_hz: 50.0,
            status_period_s: 0.02,
            frames_period_s: 1.0,
            perturbation: PathBuf::new(),
            hardware: HardwareSettings::default(),
        }
    }
}

/// Times of the wall clock, in s.
const PERIOD: Range = Range::Float(0.001, 3600.0);
/// Times that hardware takes, in s.
const DELAY: Range = Range::Float(0.0, 60.0);
/// Pins of the control box and the tool.
const PIN: Range = Range::Integer(0, 17);

impl Parameters for SimWorkcellParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/sim_workcell.yaml");
    const RANGES: &'static [(&'static str, Range)] = &[
        ("seed", Range::Integer(0, i64::MAX)),
        ("suction_pin", PIN),
        ("vacuum_pin", PIN),
        ("real_time_factor", Range::NOT_NEGATIVE),
        // At most the rate of the physics.
        ("joint_states_rate_hz", Range::Float(1.0, 480.0)),
        ("status_period_s", PERIOD),
        ("frames_period_s", PERIOD),
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
        ("hardware.blow_off_pin", Range::Integer(-1, 17)),
        ("hardware.enable_pin", Range::Integer(-1, 17)),
    ];
    const CHANGEABLE: &'static [&'static str] = &[
        "real_time_factor",
        "status_period_s",
        "frames_period_s",
        "hardware.until_answer_min_s",
        "hardware.until_answer_max_s",
        "hardware.servo_delay_s",
        "hardware.encoder_noise_rad",
        "hardware.speed_scaling",
        "hardware.inactive_controllers",
        "hardware.tool_voltage",
        "hardware.vacuum_leak_s",
        "hardware.enabled",
        "hardware.fault",
    ];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes = node_kit::mistakes_in_documentation::<SimWorkcellParameters>("sim_workcell");
        assert_eq!(mistakes, [""; 0]);
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (line, name) in [
            ("suction_pin: 18", "suction_pin"),
            ("real_time_factor: -1.0", "real_time_factor"),
            ("joint_states_rate_hz: .nan", "joint_states_rate_hz"),
            ("frames_period_s: 0.0", "frames_period_s"),
            ("hardware: {speed_scaling: 0.0}", "hardware.speed_scaling"),
            ("hardware: {fault: bad}", "hardware.fault"),
            ("sead: 3", "sead"),
        ] {
            let text = format!("/**:\n  ros__parameters:\n    {line}\n");
            let error =
                node_kit::load_text::<SimWorkcellParameters>("f.yaml", &text, "/sim_workcell")
                    .unwrap_err()
                    .to_string();
            assert!(error.contains(name) && error.contains("f.yaml"), "{error}");
        }
    }
}
