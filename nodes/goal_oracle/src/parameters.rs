//! Parameters of the node.

use std::path::{Path, PathBuf};

use node_kit::{InvalidParameter, Parameters};
use serde::{Deserialize, Serialize};

/// What says which goal is next.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GoalModule {
    /// The operator, or the outcome of the motion.
    #[default]
    Oracle,
    /// The image of the sequence that looks most like what is seen after the motion.
    ImageDistance,
    /// The same, where the images lie as a trained network embeds them.
    Embedding,
    /// A policy conditioned on the sequence says whether the step is done, also from another start.
    Sequence,
}

/// Explained in config/goal_oracle.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct GoalOracleParameters {
    pub demonstration: PathBuf,
    pub start_empty: bool,
    pub goal_module: GoalModule,
    pub embedding: PathBuf,
    pub checkpoint: PathBuf,
    pub require_confirmation: bool,
    pub world_frame: String,
}

impl Default for GoalOracleParameters {
    fn default() -> Self {
        Self {
            demonstration: PathBuf::new(),
            start_empty: false,
            goal_module: GoalModule::Oracle,
            embedding: PathBuf::new(),
            checkpoint: PathBuf::new(),
            require_confirmation: true,
            world_frame: "world".into(),
        }
    }
}

impl GoalOracleParameters {
    /// The demonstration's path; there is no default one, and none only where that was asked for.
    pub(crate) fn demonstration(&self) -> Result<Option<&Path>, InvalidParameter> {
        match (self.demonstration == Path::new(""), self.start_empty) {
            (true, true) => Ok(None),
            (true, false) => Err(InvalidParameter::new(
                "demonstration",
                "expected the path of a demonstration bag, found nothing (or set start_empty)",
            )),
            (false, _) => Ok(Some(&self.demonstration)),
        }
    }
}

impl Parameters for GoalOracleParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/goal_oracle.yaml");

    fn validate(&self) -> Result<(), InvalidParameter> {
        InvalidParameter::unless_given("world_frame", &self.world_frame)?;
        if self.goal_module == GoalModule::Embedding && self.embedding == Path::new("") {
            return Err(InvalidParameter::new(
                "embedding",
                "expected the path of a checkpoint with goal_module embedding, found nothing",
            ));
        }
        if self.goal_module == GoalModule::Sequence && self.checkpoint == Path::new("") {
            return Err(InvalidParameter::new(
                "checkpoint",
                "expected the path of a policy's checkpoint with goal_module sequence, found nothing",
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_module_that_needs_a_checkpoint_is_refused_without_one() {
        let needs = [
            (GoalModule::Embedding, "embedding"),
            (GoalModule::Sequence, "checkpoint"),
        ];
        for (goal_module, parameter) in needs {
            let parameters = GoalOracleParameters {
                goal_module,
                ..GoalOracleParameters::default()
            };
            let error = parameters.validate().unwrap_err().to_string();
            assert!(error.contains(parameter), "{error}");
        }
    }

    #[test]
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes = node_kit::mistakes_in_documentation::<GoalOracleParameters>("goal_oracle");
        assert_eq!(mistakes, [""; 0]);
    }
}
