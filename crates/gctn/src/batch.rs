//! The part of a gradient step that needs no weights.

use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

use crate::augment::Warp;
use crate::input::{Encoding, Label, encode};
use crate::{Error, NetworkConfig, Sample, TrainingConfig};

/// The samples of one gradient step, augmented and encoded as the network reads them.
#[derive(Debug)]
pub struct Batch {
    /// Gradient steps done before this one.
    pub(crate) step: u64,
    /// N x rows x cols x channels. No tensor yet: libtorch fills a new one on as many threads as it computes with, beside those of the trainer
    /// where the batch is made on another thread.
    pub(crate) encoded: Vec<f32>,
    pub(crate) labels: Vec<Label>,
    /// The step's random numbers after the augmentation.
    pub(crate) rng: ChaCha8Rng,
}

/// Makes the batches of a [`Trainer`](crate::Trainer), also on another thread while the trainer computes.
#[derive(Clone, Debug)]
pub struct BatchMaker {
    pub(crate) network: NetworkConfig,
    pub(crate) training: TrainingConfig,
    pub(crate) encoding: Encoding,
    pub(crate) says_done: bool,
}

impl BatchMaker {
    /// The batch of the gradient step after `step` others. It depends on the samples, the step's number and the seed alone.
    pub fn batch(&self, step: u64, samples: &[Sample<'_>]) -> Result<Batch, Error> {
        if samples.len() != self.training.batch {
            return Err(Error::Batch {
                actual: samples.len(),
                expected: self.training.batch,
            });
        }
        // A stream of its own for each step: the random state is the step's number.
        let mut rng = ChaCha8Rng::seed_from_u64(self.training.seed);
        rng.set_stream(step + 1);
        self.encode(step, samples, rng, true)
    }

    /// Samples as they are, any number but none.
    pub(crate) fn unaugmented(&self, samples: &[Sample<'_>]) -> Result<Batch, Error> {
        if samples.is_empty() {
            return Err(Error::Batch {
                actual: 0,
                expected: self.training.batch,
            });
        }
        let rng = ChaCha8Rng::seed_from_u64(self.training.seed);
        self.encode(0, samples, rng, false)
    }

    fn encode(
        &self,
        step: u64,
        samples: &[Sample<'_>],
        mut rng: ChaCha8Rng,
        augment: bool,
    ) -> Result<Batch, Error> {
        let (network, encoding) = (&self.network, self.encoding);
        let cells = network.rows * network.cols;
        let mut encoded = vec![0.0; samples.len() * encoding.channels() * cells];
        let mut labels = Vec::new();
        let images = encoded.chunks_exact_mut(encoding.channels() * cells);
        for ((index, sample), image) in samples.iter().enumerate().zip(images) {
            let label = Label::of(network, index, sample)?;
            if label.done && !self.says_done {
                return Err(Error::Done { index });
            }
            let warp = if augment {
                let labels_px = [label.pick_px, label.place_px];
                Warp::draw(
                    &self.training.augmentation,
                    network.rows,
                    network.cols,
                    1 + encoding.goals,
                    labels_px,
                    &mut rng,
                )
            } else {
                Warp::identity()
            };
            encode(encoding, sample.observation, sample.goal, &warp, image);
            labels.push(label.warped(&warp, network));
        }
        Ok(Batch {
            step,
            encoded,
            labels,
            rng,
        })
    }
}
