//! Training recipes: everything that makes a policy, in one YAML file.

use crate::data_set::Shown;
use crate::images::ImageMemory;
use crate::sampling::{Sampling, SamplingError};
use gctn::{GoalConditioning, Network, NetworkConfig, TrainingConfig};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What to train on what, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Recipe {
    /// Problems whose demonstrations are learned from.
    pub problems: Vec<String>,
    /// Demonstrations of each problem.
    pub demonstrations: Demonstrations,
    /// Problems drawn by `sctn problems` that are learned from too, one scene of each: those with the smallest seeds.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub generated: usize,
    /// The network.
    pub network: NetworkConfig,
    /// Checkpoint of the same network whose weights the training begins with, instead of random ones; from where the command runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start_from: Option<PathBuf>,
    /// How it is trained.
    pub training: TrainingConfig,
    /// Which step is drawn how often.
    #[serde(default)]
    pub sampling: Sampling,
    /// How often a demonstration is drawn, by the name of its problem, `generated` for those that `sctn problems` drew: so many times
    /// as often as one of a problem that is not named.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub draws: BTreeMap<String, f64>,
    /// Probability that a sample's next-step goal is the one after the next, against calling a step done too
    /// early.
    #[serde(default)]
    pub goal_jitter: f64,
    /// What is shown to a network of the conditioning `sequence`.
    #[serde(default, skip_serializing_if = "is_default")]
    pub shown: Shown,
    /// Most MB of images that are kept decoded. Changes no result.
    #[serde(default = "decoded_mb", skip_serializing_if = "is_decoded_mb")]
    pub decoded_mb: usize,
    /// Most MB of compressed images that are kept in memory; the others lie in a file in the training's folder that disappears
    /// with the process. Changes no result.
    #[serde(default = "compressed_mb", skip_serializing_if = "is_compressed_mb")]
    pub compressed_mb: usize,
    /// Number of snapshots, evenly spread over the training.
    pub snapshots: u64,
    /// The policy is the mean of the weights of the last so many snapshots; 1: a single one, the best in validation. For a training
    /// at a constant learning rate.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub average: u64,
    /// How snapshots are compared.
    pub validation: Validation,
}

/// How many demonstrations are learned from; with the conditioning `sequence` scenes, with all their starts.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, or one for each problem by its name")]
pub enum Demonstrations {
    /// So many of each problem.
    Each(usize),
    /// By name of the problem.
    Of(BTreeMap<String, usize>),
}

impl Demonstrations {
    /// How many of a problem; `None` of one that is not named.
    pub fn of(&self, problem: &str) -> Option<usize> {
        match self {
            Self::Each(count) => Some(*count),
            Self::Of(counts) => counts.get(problem).copied(),
        }
    }
}

fn is_zero(count: &usize) -> bool {
    *count == 0
}

fn one() -> u64 {
    1
}

fn is_one(count: &u64) -> bool {
    *count == 1
}

fn is_default(shown: &Shown) -> bool {
    *shown == Shown::default()
}

fn decoded_mb() -> usize {
    ImageMemory::default().decoded_mb
}

fn is_decoded_mb(mb: &usize) -> bool {
    *mb == decoded_mb()
}

fn compressed_mb() -> usize {
    ImageMemory::default().compressed_mb
}

fn is_compressed_mb(mb: &usize) -> bool {
    *mb == compressed_mb()
}

/// Validation episodes, on seeds that neither training nor test uses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Validation {
    /// Episodes of each problem, of every snapshot; 0 keeps the last snapshot.
    pub episodes: usize,
    /// Seed of the first episode; odd, and below 10,000.
    pub seed: u64,
}

/// A recipe that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RecipeError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// Not YAML, an unknown field, or a field of another type.
    #[error("{}: {source}", path.display())]
    Yaml {
        /// The file.
        path: PathBuf,
        /// What the parser said, with line and column.
        source: serde_yaml_ng::Error,
    },
    /// A network or training parameter out of range.
    #[error("{}: {source}", path.display())]
    Network {
        /// The file.
        path: PathBuf,
        /// Which, and what was expected.
        source: gctn::Error,
    },
    /// A weight out of range.
    #[error("{}: {source}", path.display())]
    Sampling {
        /// The file.
        path: PathBuf,
        /// Which, and what was expected.
        source: SamplingError,
    },
    /// A field out of range.
    #[error("{}: {field} is {value}, expected {expected}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The field.
        field: String,
        /// Its value.
        value: String,
        /// What was expected.
        expected: &'static str,
    },
}

/// Reads a file, without checking ranges.
pub(crate) fn read_yaml<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, RecipeError> {
    let text = std::fs::read_to_string(path).map_err(|source| RecipeError::Io {
        path: path.to_owned(),
        source,
    })?;
    serde_yaml_ng::from_str(&text).map_err(|source| RecipeError::Yaml {
        path: path.to_owned(),
        source,
    })
}

/// Refuses a field out of range.
pub(crate) fn check_field(
    path: &Path,
    field: &str,
    good: bool,
    value: String,
    expected: &'static str,
) -> Result<(), RecipeError> {
    match good {
        true => Ok(()),
        false => Err(RecipeError::Field {
            path: path.to_owned(),
            field: field.to_owned(),
            value,
            expected,
        }),
    }
}

impl Recipe {
    /// Reads and checks a recipe.
    pub fn load(path: &Path) -> Result<Self, RecipeError> {
        let recipe: Self = read_yaml(path)?;
        recipe.check(path)?;
        Ok(recipe)
    }

    /// Checks all ranges; `path` is what errors name.
    pub(crate) fn check(&self, path: &Path) -> Result<(), RecipeError> {
        let recipe = self;
        let owned = || path.to_owned();
        let network = |source| RecipeError::Network {
            path: owned(),
            source,
        };
        recipe.network.check().map_err(network)?;
        recipe.training.check().map_err(network)?;
        recipe
            .sampling
            .validate()
            .map_err(|source| RecipeError::Sampling {
                path: owned(),
                source,
            })?;
        let field = |field, good, value, expected| check_field(path, field, good, value, expected);
        let Self {
            problems,
            demonstrations,
            goal_jitter,
            shown,
            snapshots,
            average,
            validation,
            ..
        } = recipe;
        field(
            "problems",
            !problems.is_empty(),
            format!("{problems:?}"),
            "at least one",
        )?;
        for problem in problems {
            let count = demonstrations.of(problem);
            let value = count.map_or("missing".into(), |count| count.to_string());
            check_field(
                path,
                &format!("demonstrations of {problem}"),
                count.is_some_and(|count| count > 0),
                value,
                "at least 1",
            )?;
        }
        if let Demonstrations::Of(counts) = demonstrations {
            for problem in counts.keys() {
                check_field(
                    path,
                    &format!("demonstrations of {problem}"),
                    problems.contains(problem),
                    "given".into(),
                    "only problems of the field problems",
                )?;
            }
        }
        for (problem, times) in &self.draws {
            let known = problems.contains(problem) || problem == "generated";
            let good = known && times.is_finite() && *times > 0.0;
            let expected = "a number above 0, for one of the field problems or generated";
            check_field(
                path,
                &format!("draws of {problem}"),
                good,
                times.to_string(),
                expected,
            )?;
        }
        for (name, share) in [
            ("shown.same_start", shown.same_start),
            ("shown.done", shown.done),
        ] {
            let good = (0.0..=1.0).contains(&share);
            field(name, good, share.to_string(), "0 to 1")?;
        }
        let sequence = recipe.network.conditioning == GoalConditioning::Sequence;
        let says_done = matches!(recipe.network.network, Network::Matching(_));
        field(
            "shown.done",
            says_done || shown.done == 0.0,
            shown.done.to_string(),
            "0 but for the network matching",
        )?;
        field(
            "goal_jitter",
            !sequence || *goal_jitter == 0.0,
            goal_jitter.to_string(),
            "0 with the conditioning sequence",
        )?;
        let good = (0.0..=1.0).contains(goal_jitter);
        field("goal_jitter", good, goal_jitter.to_string(), "0 to 1")?;
        let good = (1..=recipe.training.steps).contains(snapshots);
        field(
            "snapshots",
            good,
            snapshots.to_string(),
            "1 to training.steps",
        )?;
        let good = (1..=*snapshots).contains(average);
        field("average", good, average.to_string(), "1 to snapshots")?;
        field(
            "average",
            *average == 1 || validation.episodes == 0,
            average.to_string(),
            "1 where validation chooses the snapshot",
        )?;
        let good = validation.seed % 2 == 1 && validation.seed < 10_000;
        field(
            "validation.seed",
            good,
            validation.seed.to_string(),
            "an odd number below 10,000",
        )
    }

    /// Steps after which a snapshot is taken, the last step among them.
    pub fn snapshot_steps(&self) -> impl Iterator<Item = u64> {
        let (steps, snapshots) = (self.training.steps, self.snapshots);
        (1..=snapshots).map(move |index| index * steps / snapshots)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shipped() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/recipes/placing.yaml")
    }

    fn changed(from: &str, to: &str) -> String {
        let text = std::fs::read_to_string(shipped()).unwrap();
        assert!(text.contains(from), "{from}");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("recipe.yaml");
        std::fs::write(&path, text.replacen(from, to, 1)).unwrap();
        let error = Recipe::load(&path).unwrap_err().to_string();
        assert!(error.contains("recipe.yaml"), "{error}");
        error
    }

    #[test]
    fn the_shipped_recipe_loads_and_snapshots_end_with_the_last_step() {
        let recipe = Recipe::load(&shipped()).unwrap();
        let steps: Vec<_> = recipe.snapshot_steps().collect();
        assert_eq!(steps.len() as u64, recipe.snapshots);
        assert_eq!(steps.last(), Some(&recipe.training.steps));
    }

    #[test]
    fn the_recipe_of_all_options_says_what_is_meant_where_nothing_is_said() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/recipes");
        let all = Recipe::load(&folder.join("all_options.yaml")).unwrap();
        let network = NetworkConfig::compact();
        assert_eq!(all.network, network);
        assert_eq!(all.training, TrainingConfig::compact());
        assert_eq!(all.sampling, Sampling::default());
        assert_eq!(all.goal_jitter, 0.0);
    }

    #[test]
    fn every_shipped_recipe_loads() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/recipes");
        let mut count = 0;
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_file() {
                Recipe::load(&path).unwrap();
                count += 1;
            }
        }
        assert!(count >= 2);
    }

    #[test]
    fn each_problem_may_have_a_number_of_its_own() {
        let of = |text: &str| serde_yaml_ng::from_str::<Demonstrations>(text);
        assert_eq!(of("7").unwrap().of("placing"), Some(7));
        let some = of("{placing: 3, stacking: 9}").unwrap();
        let counts = ["placing", "stacking", "routing"].map(|problem| some.of(problem));
        assert_eq!(counts, [Some(3), Some(9), None]);
        let error = of("many").unwrap_err().to_string();
        assert!(error.contains("one for each problem"), "{error}");
    }

    #[test]
    fn a_field_that_is_unknown_or_out_of_range_is_refused_by_name() {
        assert!(changed("snapshots:", "snapshot:").contains("snapshot"));
        assert!(changed("seed: 1}", "seed: 2}").contains("validation.seed is 2"));
        assert!(changed("snapshots: 4", "snapshots: 0").contains("snapshots is 0"));
        assert!(changed("snapshots: 4", "snapshots: 4\naverage: 5").contains("average is 5"));
        assert!(changed("batch: 4", "batch: 0").contains("batch is 0"));
        assert!(
            changed("snapshots: 4", "snapshots: 4\ngoal_jitter: 1.5")
                .contains("goal_jitter is 1.5")
        );
        assert!(
            changed("weighting: plain", "weighting: unif").contains("unif_step"),
            "the known ones are named"
        );
        assert!(
            changed("demonstrations: 100", "demonstrations: 0")
                .contains("demonstrations of placing is 0")
        );
        for (draws, value) in [("{placing: 0}", "0"), ("{stacking: 2}", "2")] {
            let error = changed("snapshots: 4", &format!("snapshots: 4\ndraws: {draws}"));
            assert!(
                error.contains(&format!("is {value}, expected a number above 0")),
                "{error}"
            );
        }
        let error = changed("demonstrations: 100", "demonstrations: {stacking: 3}");
        assert!(error.contains("demonstrations of placing is missing"));
        let both = "demonstrations: {placing: 3, stacking: 3}";
        let error = changed("demonstrations: 100", both);
        assert!(error.contains("demonstrations of stacking is given"));
    }
}
