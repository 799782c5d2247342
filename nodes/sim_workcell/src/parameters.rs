//! Parameters; `config/sim_workcell.yaml` explains each.

use std::path::PathBuf;

use node_kit::{InvalidParameter, Parameters};
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
    /// Wall seconds between repeats of joint and pin states and clock while nothing moves.
    pub status_period_s: f64,
    /// Wall seconds between repeats of the camera frames while nothing moves.
    pub frames_period_s: f64,
}

impl Default for SimWorkcellParameters {
    fn default() -> Self {
        Self {
            problem: "placing".into(),
            seed: 10_000,
            problems_dir: "config/problems".into(),
            urdf: PathBuf::new(),
            world_frame: "world".into(),
            follow_action: "scaled_joint_trajectory_controller/follow_joint_trajectory".into(),
            until_action: "trajectory_until_node/execute".into(),
            suction_pin: 16,
            vacuum_pin: 16,
            real_time_factor: 0.0,
            joint_states_rate_hz: 50.0,
            status_period_s: 0.02,
            frames_period_s: 0.5,
        }
    }
}

impl Parameters for SimWorkcellParameters {
    fn validate(&self) -> Result<(), InvalidParameter> {
        for (name, pin) in [
            ("suction_pin", self.suction_pin),
            ("vacuum_pin", self.vacuum_pin),
        ] {
            if pin > 17 {
                let reason = format!("must be 0 to 17, is {pin}");
                return Err(InvalidParameter::new(name, reason));
            }
        }
        if !(self.real_time_factor.is_finite() && self.real_time_factor >= 0.0) {
            let reason = format!("must be 0 or more, is {}", self.real_time_factor);
            return Err(InvalidParameter::new("real_time_factor", reason));
        }
        let rate = self.joint_states_rate_hz;
        // Not a number is in no range.
        if !(1.0..=480.0).contains(&rate) {
            let reason = format!("must be 1 to 480, the rate of the physics, is {rate}");
            return Err(InvalidParameter::new("joint_states_rate_hz", reason));
        }
        for (name, period) in [
            ("status_period_s", self.status_period_s),
            ("frames_period_s", self.frames_period_s),
        ] {
            if !(0.001..=3600.0).contains(&period) {
                let reason = format!("must be 0.001 to 3600, is {period}");
                return Err(InvalidParameter::new(name, reason));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_shows_the_defaults() {
        let file = include_str!("../../../config/sim_workcell.yaml");
        let read: SimWorkcellParameters =
            node_kit::load_text("config/sim_workcell.yaml", file, "/sim_workcell").unwrap();
        assert_eq!(read, SimWorkcellParameters::default());
        // And all of them.
        let shown = serde_yaml_ng::to_value(&read).unwrap();
        for name in shown.as_mapping().unwrap().keys() {
            let name = format!("    {}:", name.as_str().unwrap());
            assert!(file.contains(&name), "{name} is missing");
        }
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (line, name) in [
            ("suction_pin: 18", "suction_pin"),
            ("real_time_factor: -1.0", "real_time_factor"),
            ("joint_states_rate_hz: .nan", "joint_states_rate_hz"),
            ("frames_period_s: 0.0", "frames_period_s"),
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
