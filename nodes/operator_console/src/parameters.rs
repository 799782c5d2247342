//! Parameters of the node.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use console::Access;
use msgs::CameraPreset;
use node_kit::{InvalidParameter, Parameters, Range};
use serde::{Deserialize, Serialize};

/// Explained in config/operator_console.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct OperatorConsoleParameters {
    pub address: String,
    pub port: u16,
    pub host_names: Vec<String>,
    pub token: String,
    pub address_file: PathBuf,
    pub tls: Tls,
    pub max_viewers: usize,
    pub stale_after_s: f64,
    pub observation_tolerance_m: f64,
    pub observation_changed_area_mm2: f64,
    pub session_timeout_s: f64,
    pub demonstration: PathBuf,
    pub library: PathBuf,
    pub checkpoints: PathBuf,
    pub checkpoint: PathBuf,
    pub sctn: PathBuf,
    pub recipe: PathBuf,
    pub training: PathBuf,
    pub nodes: Vec<String>,
    pub cameras: Vec<String>,
    pub camera_preset: CameraPreset,
    pub world_frame: String,
    pub executor: String,
    pub goal_oracle: String,
    pub policy: String,
    pub io_and_status: String,
    pub speed_scaling: String,
    pub suction_pin: u8,
    pub vacuum_pin: u8,
}

/// Explained in config/operator_console.yaml.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct Tls {
    pub certificate: PathBuf,
    pub key: PathBuf,
}

impl Default for OperatorConsoleParameters {
    fn default() -> Self {
        let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        Self {
            address: "127.0.0.1".into(),
            port: 8750,
            // A list of ROS parameters must not be empty: its type would be unknown.
            host_names: names(&[""]),
            token: String::new(),
            address_file: PathBuf::new(),
            tls: Tls::default(),
            max_viewers: 16,
            stale_after_s: 3.0,
            observation_tolerance_m: 0.005,
            observation_changed_area_mm2: 75.0,
            session_timeout_s: 60.0,
            demonstration: PathBuf::new(),
            library: "out/library".into(),
            checkpoints: "config/checkpoints".into(),
            checkpoint: "config/checkpoints/ten_problems.safetensors".into(),
            sctn: "sctn".into(),
            recipe: "config/recipes/taught.yaml".into(),
            training: "out/training".into(),
            nodes: names(&[
                "camera_fusion",
                "gctn_policy",
                "goal_oracle",
                "suction_executor",
            ]),
            cameras: names(&["front", "left", "right"]),
            camera_preset: CameraPreset::Simulated,
            world_frame: "world".into(),
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

impl OperatorConsoleParameters {
    /// Where to listen.
    pub(crate) fn socket(&self) -> Result<SocketAddr, InvalidParameter> {
        let address: IpAddr = self.address.parse().map_err(|_| {
            let found = &self.address;
            InvalidParameter::new(
                "address",
                format!("expected an IP address, found {found:?}"),
            )
        })?;
        Ok(SocketAddr::new(address, self.port))
    }

    /// Whether the page is served with TLS.
    pub(crate) fn has_tls(&self) -> bool {
        self.tls.certificate != Path::new("")
    }
}

impl Parameters for OperatorConsoleParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/operator_console.yaml");
    const RANGES: &'static [(&'static str, Range)] = &[
        ("port", Range::Integer(0, 65535)),
        ("max_viewers", Range::Integer(1, 256)),
        ("stale_after_s", Range::POSITIVE),
        ("observation_tolerance_m", Range::POSITIVE),
        ("observation_changed_area_mm2", Range::POSITIVE),
        ("session_timeout_s", Range::POSITIVE),
        ("suction_pin", Range::Integer(0, 17)),
        ("vacuum_pin", Range::Integer(0, 17)),
    ];

    fn validate(&self) -> Result<(), InvalidParameter> {
        let socket = self.socket()?;
        if self.has_tls() != (self.tls.key != Path::new("")) {
            return Err(InvalidParameter::new(
                "tls",
                "expected both certificate and key, or neither",
            ));
        }
        if !socket.ip().is_loopback() && !self.has_tls() {
            return Err(InvalidParameter::new(
                "address",
                format!(
                    "{} is not a loopback address: it needs tls.certificate and tls.key",
                    socket.ip()
                ),
            ));
        }
        Access::check(&self.token)
            .map_err(|error| InvalidParameter::new("token", error.to_string()))?;
        for (name, value) in [
            ("executor", &self.executor),
            ("goal_oracle", &self.goal_oracle),
            ("policy", &self.policy),
            ("io_and_status", &self.io_and_status),
            ("speed_scaling", &self.speed_scaling),
        ] {
            if value.is_empty() {
                return Err(InvalidParameter::new(name, "must not be empty"));
            }
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
    fn another_address_than_loopback_needs_tls() {
        let mut parameters = OperatorConsoleParameters {
            address: "0.0.0.0".into(),
            ..Default::default()
        };
        let error = parameters.check().unwrap_err().to_string();
        assert!(error.contains("tls.certificate"), "{error}");
        parameters.tls = Tls {
            certificate: "certificate.pem".into(),
            key: "key.pem".into(),
        };
        assert_eq!(parameters.check(), Ok(()));
        parameters.tls.key = PathBuf::new();
        assert!(parameters.check().is_err());
    }

    #[test]
    fn a_token_that_can_be_guessed_is_refused_by_the_parameters_name() {
        let parameters = OperatorConsoleParameters {
            token: "secret".into(),
            ..Default::default()
        };
        let error = parameters.check().unwrap_err().to_string();
        assert!(error.contains("token"), "{error}");
    }
}
