//! Parameters of the node.

use std::path::{Path, PathBuf};

use gctn::Device;
use node_kit::{InvalidParameter, Parameters, Range};
use serde::{Deserialize, Serialize};

/// Explained in config/gctn_policy.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct GctnPolicyParameters {
    pub checkpoint: PathBuf,
    pub threads: usize,
    pub device: Device,
    pub exclusion_radius_m: f64,
    pub observation_tolerance_m: f64,
    pub observation_changed_area_mm2: f64,
    pub observation_needs_home: bool,
    pub urdf: PathBuf,
}

impl Default for GctnPolicyParameters {
    fn default() -> Self {
        Self {
            checkpoint: PathBuf::new(),
            threads: 1,
            device: Device::Cpu,
            exclusion_radius_m: 0.02,
            observation_tolerance_m: 0.005,
            observation_changed_area_mm2: 75.0,
            observation_needs_home: false,
            urdf: PathBuf::new(),
        }
    }
}

impl GctnPolicyParameters {
    /// The checkpoint's path; there is no default one.
    pub(crate) fn checkpoint(&self) -> Result<&Path, InvalidParameter> {
        if self.checkpoint == Path::new("") {
            return Err(InvalidParameter::new(
                "checkpoint",
                "expected the path of a checkpoint, found nothing",
            ));
        }
        Ok(&self.checkpoint)
    }
}

impl Parameters for GctnPolicyParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/gctn_policy.yaml");
    const RANGES: &'static [(&'static str, Range)] = &[
        ("threads", Range::Integer(1, 256)),
        ("exclusion_radius_m", Range::POSITIVE),
        ("observation_tolerance_m", Range::POSITIVE),
        ("observation_changed_area_mm2", Range::POSITIVE),
    ];
    const CHANGEABLE: &'static [&'static str] =
        &["observation_tolerance_m", "observation_changed_area_mm2"];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes = node_kit::mistakes_in_documentation::<GctnPolicyParameters>("gctn_policy");
        assert_eq!(mistakes, [""; 0]);
    }
}
