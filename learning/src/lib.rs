//! Sequence-conditioned learning: data set, weighted sampling, training, evaluation.

mod agent;
mod data_set;
mod embedding;
mod evaluation;
mod goal;
mod interval;
mod recipe;
mod rollout;
mod sampling;
mod search;
mod sweep;
mod table;
mod tensorboard;
mod training;

pub use agent::Agent;
pub use data_set::{DataSet, DataSetError, demonstration_path, recorded_run};
pub use embedding::EmbeddingRecipe;
pub use evaluation::{Attempt, EpisodeReport, Evaluation, EvaluationError, attempt, evaluate};
pub use goal::{NextStepOracle, goal, known_images, reached};
pub use interval::wilson_95;
pub use recipe::{Recipe, RecipeError, Validation};
pub use rollout::{Rollout, demonstrate, demonstrate_in_order, replay, roll_out};
pub use sampling::{ModuleWeights, Sampling, SamplingError, StepWeights};
pub use search::{Search, SearchError, Trial, TrialSnapshot};
pub use sweep::{Run, RunResult, Score, SnapshotResult, Sweep, Test};
pub use table::{Cell, Rate, Table};
pub use tensorboard::EventFile;
pub use training::{Training, TrainingError};
