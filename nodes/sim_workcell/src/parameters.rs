//! Parameters; `config/sim_workcell.yaml` explains each.

use std::path::PathBuf;

use cell_emulation::EmulatorSettings;
use node_kit::{Parameters, Range};
use serde::{Deserialize, Serialize};

/// Parameters of the node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimWorkcellParameters {
    /// What the emulated cell does, and how it is paced.
    #[serde(flatten)]
    pub emulator: EmulatorSettings,
    /// URDF of the work cell; empty for the one that was compiled in.
    pub urdf: PathBuf,
    /// Digital output that switches suction.
    pub suction_pin: u8,
    /// Digital input of the vacuum sensor.
    pub vacuum_pin: u8,
    /// What the cameras do: a file as those of config/perturbations; empty for perfect ones.
    pub perturbation: PathBuf,
}

impl Default for SimWorkcellParameters {
    fn default() -> Self {
        Self {
            emulator: EmulatorSettings::default(),
            urdf: PathBuf::new(),
            suction_pin: 16,
            vacuum_pin: 16,
            perturbation: PathBuf::new(),
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
