//! Parameters of the node.

use std::path::{Path, PathBuf};

use gctn::Device;
use node_kit::{ChangeParameters, InvalidParameter, Parameters, Range, Ranges};
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
    #[serde(flatten)]
    pub changes: ChangeParameters,
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
            changes: ChangeParameters::default(),
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
    const RANGES: Ranges = &[
        ("threads", Range::Integer(1, 256)),
        ("exclusion_radius_m", Range::POSITIVE),
    ];
    const GROUPS: &'static [(&'static str, Ranges)] = &[("", ChangeParameters::RANGES)];
    const CHANGEABLE: &'static [&'static str] = &ChangeParameters::NAMES;
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
