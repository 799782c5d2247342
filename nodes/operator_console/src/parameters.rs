//! Parameters of the node.

use std::path::PathBuf;

use console::{PageSettings, ServerSettings};
use msgs::CameraPreset;
use node_kit::{ChangeParameters, InvalidParameter, Parameters, Range, Ranges};
use serde::{Deserialize, Serialize};

/// Explained in config/operator_console.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct OperatorConsoleParameters {
    #[serde(flatten)]
    pub server: ServerSettings,
    #[serde(flatten)]
    pub page: PageSettings,
    #[serde(flatten)]
    pub changes: ChangeParameters,
    pub stale_after_s: f64,
    pub demonstration: PathBuf,
    pub nodes: Vec<String>,
    pub camera_preset: CameraPreset,
    pub executor: String,
    pub goal_oracle: String,
    pub policy: String,
    pub io_and_status: String,
    pub speed_scaling: String,
    pub suction_pin: u8,
    pub vacuum_pin: u8,
}

impl Default for OperatorConsoleParameters {
    fn default() -> Self {
        let nodes = [
            "camera_fusion",
            "gctn_policy",
            "goal_oracle",
            "suction_executor",
        ];
        Self {
            server: ServerSettings::default(),
            page: PageSettings::default(),
            changes: ChangeParameters::default(),
            stale_after_s: 3.0,
            demonstration: PathBuf::new(),
            nodes: nodes.map(str::to_owned).into(),
            camera_preset: CameraPreset::Simulated,
            executor: "suction_executor".into(),
            goal_oracle: "goal_oracle".into(),
            policy: "gctn_policy".into(),
            io_and_status: "io_and_status_controller".into(),
            speed_scaling: "speed_scaling_state_broadcaster/speed_scaling".into(),
            suction_pin: 16,
            vacuum_pin: 16,
        }
    }
}

impl Parameters for OperatorConsoleParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/operator_console.yaml");
    const RANGES: Ranges = &[
        ("port", Range::Integer(0, 65535)),
        ("max_viewers", Range::Integer(1, 256)),
        ("stale_after_s", Range::POSITIVE),
        ("session_timeout_s", Range::POSITIVE),
        ("suction_pin", Range::PIN),
        ("vacuum_pin", Range::PIN),
    ];
    const GROUPS: &'static [(&'static str, Ranges)] = &[("", ChangeParameters::RANGES)];

    fn validate(&self) -> Result<(), InvalidParameter> {
        let refused = self.server.check();
        refused.map_err(|error| InvalidParameter::new(error.setting(), error.to_string()))?;
        for (name, value) in [
            ("executor", &self.executor),
            ("goal_oracle", &self.goal_oracle),
            ("policy", &self.policy),
            ("io_and_status", &self.io_and_status),
            ("speed_scaling", &self.speed_scaling),
        ] {
            InvalidParameter::unless_given(name, value)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes =
            node_kit::mistakes_in_documentation::<OperatorConsoleParameters>("operator_console");
        assert_eq!(mistakes, [""; 0]);
    }

    #[test]
    fn what_the_library_refuses_is_refused_by_the_parameters_name() {
        for (line, expected) in [
            (
                "token: secret",
                "parameter token (from f.yaml): expected at least",
            ),
            ("address: 0.0.0.0", "tls.certificate"),
            ("tls: {key: key.pem}", "parameter tls (from f.yaml)"),
            ("tls: {keys: key.pem}", "unknown field `keys`"),
            (
                "max_viewers: many",
                "parameter max_viewers (from f.yaml): invalid type",
            ),
            ("port: 65536", "parameter port (from f.yaml): "),
            ("prot: 8750", "unknown field `prot`"),
        ] {
            let text = format!("/**:\n  ros__parameters:\n    {line}\n");
            let read =
                node_kit::load_text::<OperatorConsoleParameters>("f.yaml", &text, "/console");
            let error = read.unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
