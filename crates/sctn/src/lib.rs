//! Sequence-conditioned learning: data set, weighted sampling, training, evaluation.

mod agent;
mod data_set;
mod evaluation;
mod goal;
mod interval;
mod recipe;
mod rollout;
mod sampling;
mod training;

pub use agent::Agent;
pub use data_set::{DataSet, DataSetError, demonstration_path};
pub use evaluation::{EpisodeReport, Evaluation, EvaluationError, attempt, evaluate};
pub use goal::{NextStepOracle, goal};
pub use interval::wilson_95;
pub use recipe::{Recipe, RecipeError, Validation};
pub use rollout::{Rollout, demonstrate, roll_out};
pub use sampling::{ModuleWeights, Sampling, SamplingError, StepWeights};
pub use training::{Training, TrainingError};
