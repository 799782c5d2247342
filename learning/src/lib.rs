//! Sequence-conditioned learning: data set, weighted sampling, training, evaluation.

mod actor;
mod agent;
mod data_set;
mod embedding;
mod evaluation;
mod goal;
mod images;
mod interval;
mod mistakes;
mod recipe;
mod reliability;
mod rollout;
mod sampling;
mod search;
mod shown;
mod sweep;
mod table;
mod tensorboard;
mod training;

pub use actor::{Act, Actor, Said, difference};
pub use agent::Agent;
pub use data_set::{
    DataSet, DataSetError, DrawRules, DrawnSample, GENERATED, Shown, demonstration_path,
    recorded_run,
};
pub use embedding::EmbeddingRecipe;
pub use evaluation::{
    Attempt, EpisodeReport, Episodes, Evaluation, EvaluationError, SaidStep, Start, attempt,
    evaluate,
};
pub use goal::{goal, known_images, reached};
pub use images::ImageMemory;
pub use interval::{bootstrap_95, wilson_95};
pub use mistakes::{Corrected, demonstrate_corrections};
pub use recipe::{Demonstrations, Recipe, RecipeError, Validation};
pub use reliability::{Reliability, ReliabilityBin, Unasked, reliability};
pub use rollout::{
    Rollout, demonstrate, demonstrate_disturbed, demonstrate_in_order, replay, roll_out,
};
pub use sampling::{ModuleWeights, Sampling, SamplingError, StepWeights};
pub use search::{Search, SearchError, Trial, TrialSnapshot};
pub use shown::{ShownError, ShownFolder};
pub use sweep::{Run, RunResult, Score, SnapshotResult, Sweep, Test};
pub use table::{Cell, Rate, Table};
pub use tensorboard::EventFile;
pub use training::{Training, TrainingError};
