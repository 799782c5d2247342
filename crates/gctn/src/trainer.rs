//! Training.

use std::path::Path;

use crate::{Error, ModelCard, NetworkConfig, Policy, Sample, Storage, TrainingConfig};

/// A network in training, its optimiser and its random state.
#[derive(Debug)]
pub struct Trainer {}

/// Mean losses of a batch, in nats.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Losses {
    /// Pick loss. Its floor is the entropy of the demonstrator's own choice.
    pub pick: f64,
    /// Place loss.
    pub place: f64,
    /// Norm of the gradient before clipping; 0 where none was taken.
    pub gradient_norm: f64,
}

impl Trainer {
    /// A network with random weights.
    pub fn new(_network: &NetworkConfig, _training: &TrainingConfig) -> Result<Self, Error> {
        todo!()
    }

    /// One gradient step on a batch of the configured size. Fails, leaving the weights as they were, when
    /// loss or gradient is not finite.
    pub fn train_step(&mut self, _samples: &[Sample<'_>]) -> Result<Losses, Error> {
        todo!()
    }

    /// Losses without augmentation and without learning: for validation. Any number of samples.
    pub fn losses(&self, _samples: &[Sample<'_>]) -> Result<Losses, Error> {
        todo!()
    }

    /// Gradient steps done.
    pub fn step(&self) -> u64 {
        todo!()
    }

    /// A policy with a copy of the present weights.
    pub fn policy(&self) -> Result<Policy, Error> {
        todo!()
    }

    /// Writes the network for [`Policy::load`]. The file appears whole or not at all.
    pub fn save_checkpoint(
        &self,
        _path: &Path,
        _storage: Storage,
        _card: &ModelCard,
    ) -> Result<(), Error> {
        todo!()
    }

    /// Writes all that is needed to go on: weights, optimiser, random state. The file appears whole or
    /// not at all.
    pub fn save_state(&self, _path: &Path) -> Result<(), Error> {
        todo!()
    }

    /// Goes on where [`Trainer::save_state`] stopped, bit for bit on the processor with the same number of
    /// threads. Refuses a state of another configuration.
    pub fn resume(
        _path: &Path,
        _network: &NetworkConfig,
        _training: &TrainingConfig,
    ) -> Result<Self, Error> {
        todo!()
    }
}
