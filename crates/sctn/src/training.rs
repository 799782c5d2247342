//! The training loop.

use crate::data_set::{DataSet, DataSetError};
use crate::recipe::Recipe;
use gctn::{Losses, ModelCard, Storage, Trainer};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};

/// Stream of the seed's random numbers that samples are drawn from; step `n` draws from this one plus
/// `n`, so that a resumed training draws what an uninterrupted one would have.
const SAMPLING_STREAM: u64 = 1 << 40;

/// A training under way in its folder: `state.safetensors` to go on from, `snapshots/`, and in the end
/// `policy.safetensors`.
#[derive(Debug)]
pub struct Training {
    recipe: Recipe,
    data: DataSet,
    directory: PathBuf,
    trainer: Trainer,
}

/// Why a training cannot begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The folder holds another training.
    #[error("{}: already holds a training; resume it, or name another folder", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
    },
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The network, its optimiser or a checkpoint.
    #[error(transparent)]
    Network(#[from] gctn::Error),
    /// The demonstrations.
    #[error(transparent)]
    Data(#[from] DataSetError),
}

impl Training {
    /// Begins a training, or goes on with the one that the folder holds.
    pub fn open(
        recipe: Recipe,
        data: DataSet,
        directory: &Path,
        resume: bool,
    ) -> Result<Self, TrainingError> {
        let state = directory.join("state.safetensors");
        let trainer = if resume {
            Trainer::resume(&state, &recipe.network, &recipe.training)?
        } else if state.exists() {
            return Err(TrainingError::Occupied {
                path: directory.to_owned(),
            });
        } else {
            Trainer::new(&recipe.network, &recipe.training)?
        };
        let snapshots = directory.join("snapshots");
        std::fs::create_dir_all(&snapshots).map_err(|source| TrainingError::Io {
            path: snapshots,
            source,
        })?;
        Ok(Self {
            recipe,
            data,
            directory: directory.to_owned(),
            trainer,
        })
    }

    /// The recipe.
    pub fn recipe(&self) -> &Recipe {
        &self.recipe
    }

    /// Gradient steps done.
    pub fn step(&self) -> u64 {
        self.trainer.step()
    }

    /// Learning rate of the next step.
    pub fn learning_rate(&self) -> f64 {
        self.trainer.learning_rate()
    }

    /// Whether all gradient steps are done.
    pub fn is_done(&self) -> bool {
        self.step() >= self.recipe.training.steps
    }

    /// One gradient step.
    pub fn advance(&mut self) -> Result<Losses, TrainingError> {
        let Recipe {
            training,
            network,
            sampling,
            goal_jitter,
            ..
        } = &self.recipe;
        let mut rng = ChaCha8Rng::seed_from_u64(training.seed);
        rng.set_stream(SAMPLING_STREAM + self.trainer.step());
        let samples: Result<Vec<_>, _> = (0..training.batch)
            .map(|_| {
                let conditioning = network.conditioning;
                self.data
                    .draw(sampling, conditioning, *goal_jitter, &mut rng)
            })
            .collect();
        Ok(self.trainer.train_step(&samples?)?)
    }

    /// Whether the present step is one after which a snapshot is taken.
    pub fn is_snapshot_due(&self) -> bool {
        self.recipe.snapshot_steps().any(|step| step == self.step())
    }

    /// Writes a snapshot and the state to go on from; gives the snapshot's path.
    pub fn save_snapshot(&self, card: &ModelCard) -> Result<PathBuf, TrainingError> {
        let path = self
            .directory
            .join("snapshots")
            .join(format!("{:07}.safetensors", self.step()));
        self.trainer.save_checkpoint(&path, Storage::F16, card)?;
        self.trainer
            .save_state(&self.directory.join("state.safetensors"))?;
        Ok(path)
    }
}
