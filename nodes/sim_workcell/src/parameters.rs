//! Parameters; `config/sim_workcell.yaml` explains each.

use std::path::PathBuf;

use cell_emulation::EmulatorSettings;
use node_kit::{Parameters, Range, Ranges};
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

impl Parameters for SimWorkcellParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/sim_workcell.yaml");
    const RANGES: Ranges = &[("suction_pin", Range::PIN), ("vacuum_pin", Range::PIN)];
    const GROUPS: &'static [(&'static str, Ranges)] = &[("", EmulatorSettings::RANGES)];
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
