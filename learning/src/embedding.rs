//! What an embedding is trained on, and how: one YAML file.

use crate::recipe::{RecipeError, check_field, read_yaml};
use gctn::{EmbeddingConfig, EmbeddingTraining};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The recipe of an embedding for the goal module of that name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EmbeddingRecipe {
    /// Problems whose demonstrations are learned from.
    pub problems: Vec<String>,
    /// Demonstrations of each problem.
    pub demonstrations: usize,
    /// The network.
    #[serde(default)]
    pub network: EmbeddingConfig,
    /// How it is trained.
    #[serde(default)]
    pub training: EmbeddingTraining,
}

impl EmbeddingRecipe {
    /// Reads and checks a recipe.
    pub fn load(path: &Path) -> Result<Self, RecipeError> {
        let recipe: Self = read_yaml(path)?;
        let network = |source| RecipeError::Network {
            path: path.to_owned(),
            source,
        };
        recipe.network.check().map_err(network)?;
        recipe.training.check().map_err(network)?;
        let some = !recipe.problems.is_empty();
        check_field(path, "problems", some, "empty".into(), "at least one")?;
        let count = recipe.demonstrations;
        let expected = "at least 1";
        check_field(
            path,
            "demonstrations",
            count > 0,
            count.to_string(),
            expected,
        )?;
        Ok(recipe)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shipped() -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/recipes/embedding/all.yaml")
    }

    #[test]
    fn the_shipped_recipe_says_what_is_meant_where_nothing_is_said() {
        let recipe = EmbeddingRecipe::load(&shipped()).unwrap();
        assert_eq!(recipe.network, EmbeddingConfig::default());
        let training = EmbeddingTraining {
            steps: recipe.training.steps,
            ..EmbeddingTraining::default()
        };
        assert_eq!(recipe.training, training);
    }

    #[test]
    fn a_field_that_is_unknown_or_out_of_range_is_refused_by_name() {
        let text = std::fs::read_to_string(shipped()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("recipe.yaml");
        for (from, to, expected) in [
            ("batch: 2", "batch: 0", "batch is 0"),
            ("features: 8", "feature: 8", "feature"),
            (
                "demonstrations: ",
                "demonstrations: 0 #",
                "demonstrations is 0",
            ),
        ] {
            assert!(text.contains(from), "{from}");
            std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
            let error = EmbeddingRecipe::load(&path).unwrap_err().to_string();
            assert!(
                error.contains(expected) && error.contains("recipe.yaml"),
                "{error}"
            );
        }
    }
}
