//! Parameters that several nodes have, each with the same meaning.

use std::path::Path;

use heightmap::ChangeRules;
use serde::{Deserialize, Serialize};
use tracing::warn;
use ur5::WorkCell;

use crate::{
    invalid_parameter::InvalidParameter,
    parameters::{Range, Ranges},
};

/// When the table counts as changed. A node takes them among its own parameters with `#[serde(flatten)]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ChangeParameters {
    /// A cell of the heightmap has changed when its height differs by more.
    pub observation_tolerance_m: f64,
    /// The observation has changed where so many mm^2 of connected cells have.
    pub observation_changed_area_mm2: f64,
}

impl Default for ChangeParameters {
    /// Those of [`ChangeRules`].
    fn default() -> Self {
        Self {
            observation_tolerance_m: 0.005,
            observation_changed_area_mm2: 75.0,
        }
    }
}

impl ChangeParameters {
    /// Their names.
    pub const NAMES: [&'static str; 2] =
        ["observation_tolerance_m", "observation_changed_area_mm2"];
    /// Their bounds.
    pub const RANGES: Ranges = &[
        (Self::NAMES[0], Range::POSITIVE),
        (Self::NAMES[1], Range::POSITIVE),
    ];

    /// The rules that they stand for.
    pub fn rules(&self) -> ChangeRules {
        ChangeRules::new(
            self.observation_tolerance_m,
            1e-6 * self.observation_changed_area_mm2,
        )
    }
}

/// The work cell of the parameter `urdf`, the compiled-in one where it is empty. Logs which shapes are left out.
///
/// # Errors
/// When the file cannot be read, or is not the URDF of a work cell.
pub fn load_work_cell(urdf: &Path) -> Result<WorkCell, InvalidParameter> {
    let cell = WorkCell::load_or_builtin(urdf)
        .map_err(|error| InvalidParameter::new("urdf", error.to_string()))?;
    if let Some(warning) = cell.warning() {
        warn!("parameter urdf: {warning}");
    }
    Ok(cell)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::{Parameters, load_text};

    #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Example {
        name: String,
        #[serde(flatten)]
        changes: ChangeParameters,
    }

    impl Parameters for Example {
        const GROUPS: &'static [(&'static str, Ranges)] = &[("", ChangeParameters::RANGES)];
    }

    fn read(line: &str) -> Result<Example, String> {
        let text = format!("/**:\n  ros__parameters:\n    {line}\n");
        load_text("f.yaml", &text, "/node").map_err(|error| error.to_string())
    }

    #[test]
    fn the_defaults_are_the_rules_of_the_library() {
        assert_eq!(ChangeParameters::default().rules(), ChangeRules::default());
    }

    #[test]
    fn shared_parameters_stand_among_the_nodes_own_and_are_refused_by_name() {
        let found = read("observation_tolerance_m: 1").unwrap();
        assert_eq!(found.changes.observation_tolerance_m, 1.0);
        for (line, expected) in [
            (
                "observation_changed_area_mm2: -1.0",
                "parameter observation_changed_area_mm2 (from f.yaml): must be above 0, is -1",
            ),
            (
                "{name: a, observation_tolerance_m: wide}",
                "parameter observation_tolerance_m (from f.yaml): invalid type: string \"wide\", expected f64",
            ),
            (
                "{name: a, observation_tolerance: 1.0}",
                "unknown field `observation_tolerance`",
            ),
        ] {
            let error = read(line).unwrap_err();
            assert!(
                error.contains(expected) && error.contains("f.yaml"),
                "{error}"
            );
        }
    }

    #[test]
    fn a_work_cell_that_cannot_be_read_is_refused_by_its_parameter() {
        assert!(load_work_cell(Path::new("")).is_ok());
        let error = load_work_cell(Path::new("/no/such.urdf"))
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("parameter urdf: "), "{error}");
        assert!(error.contains("/no/such.urdf"), "{error}");
    }
}
