//! Parameters of the node.

use std::path::{Path, PathBuf};

use node_kit::{InvalidParameter, Parameters};
use serde::{Deserialize, Serialize};

/// Explained in config/gctn_policy.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct GctnPolicyParameters {
    pub checkpoint: PathBuf,
    pub threads: usize,
    pub exclusion_radius_m: f64,
    pub observation_tolerance_m: f64,
    pub observation_changed_fraction: f64,
}

impl Default for GctnPolicyParameters {
    fn default() -> Self {
        Self {
            checkpoint: PathBuf::new(),
            threads: 1,
            exclusion_radius_m: 0.02,
            observation_tolerance_m: 0.005,
            observation_changed_fraction: 0.001,
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
    fn validate(&self) -> Result<(), InvalidParameter> {
        if !(1..=256).contains(&self.threads) {
            return Err(InvalidParameter::new(
                "threads",
                format!("must be 1 to 256, is {}", self.threads),
            ));
        }
        for (name, value) in [
            ("exclusion_radius_m", self.exclusion_radius_m),
            ("observation_tolerance_m", self.observation_tolerance_m),
        ] {
            InvalidParameter::unless_positive(name, value)?;
        }
        if !(0.0..=1.0).contains(&self.observation_changed_fraction) {
            return Err(InvalidParameter::new(
                "observation_changed_fraction",
                format!("must be 0 to 1, is {}", self.observation_changed_fraction),
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_holds_the_defaults() {
        let text = include_str!("../../../config/gctn_policy.yaml");
        let read: GctnPolicyParameters =
            node_kit::load_text("gctn_policy.yaml", text, "/cell/gctn_policy").unwrap();
        assert_eq!(read, GctnPolicyParameters::default());
    }
}
