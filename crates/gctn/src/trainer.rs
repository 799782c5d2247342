//! Training.

use rand_chacha::ChaCha8Rng;
use std::path::Path;
use tch::{Kind, Tensor};

use crate::batch::{Batch, BatchMaker};
use crate::candidates::{candidate_loss, turn_shapes};
use crate::checkpoint::{self, File};
use crate::input::{self, Label};
use crate::losses::{done_loss, first_place_loss, pick_loss, place_loss};
use crate::network::{Builder, Features, Model, multiplications};
use crate::optimiser::{self, AdamW, Rate};
use crate::{Error, ModelCard, NetworkConfig, Policy, Sample, Storage, TrainingConfig};

/// A network in training, its optimiser (AdamW) and its random state.
#[derive(Debug)]
pub struct Trainer {
    config: TrainingConfig,
    device: tch::Device,
    model: Model,
    weights: Vec<Tensor>,
    optimiser: AdamW,
    step: u64,
}

/// Mean losses of a batch, in nats.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Losses {
    /// Pick loss. Its floor is the entropy of the demonstrator's own choice.
    pub pick: f64,
    /// Place loss; of a network that finds the place first, the loss of that included.
    pub place: f64,
    /// Loss of whether the step is done already; 0 of a network that does not say so.
    pub done: f64,
    /// Norm of the gradient before clipping; 0 where none was taken.
    pub gradient_norm: f64,
}

impl Losses {
    /// From where they were computed, at once: each reading waits for all that is being computed there.
    fn read([pick, place, done, gradient_norm]: [&Tensor; 4]) -> Result<Self, Error> {
        let all = [pick, place, done, gradient_norm];
        let all = all.map(|number| number.detach().flatten(0, -1));
        let all = Tensor::f_cat(&all, 0)?.to_kind(Kind::Double);
        let mut numbers = [0.0; 4];
        all.to_device(tch::Device::Cpu)
            .f_copy_data(&mut numbers, 4)?;
        let [pick, place, done, gradient_norm] = numbers;
        Ok(Self {
            pick,
            place,
            done,
            gradient_norm,
        })
    }
}

const FORMAT: &str = "gctn-training";
const VERSION: &str = "1";

impl Trainer {
    /// A network with random weights. Sets the threads of libtorch, in the whole process.
    pub fn new(network: &NetworkConfig, training: &TrainingConfig) -> Result<Self, Error> {
        network.check()?;
        training.check()?;
        crate::set_threads(training.threads);
        let device = training.device.open()?;
        let mut model = Model::new(
            network,
            Builder::random(training.seed, device),
            training.precision.on(training.device),
        );
        let weights = model.learn();
        let optimiser = AdamW::new(&model.parameters.flat);
        Ok(Self {
            config: training.clone(),
            device,
            model,
            weights,
            optimiser,
            step: 0,
        })
    }

    /// The same training, begun with the weights of a checkpoint of the same network instead of random ones.
    pub fn starting_from(self, checkpoint: &Path) -> Result<Self, Error> {
        let (file, saved, _) = checkpoint::open(checkpoint)?;
        if !saved.has_weights_of(&self.model.config) {
            let [saved, asked] = [&saved, &self.model.config].map(checkpoint::json);
            return Err(file.error(format!("it is of the network {saved}, expected {asked}")));
        }
        file.fill(&self.model.parameters.entries)?;
        Ok(self)
    }

    /// The network's configuration.
    pub fn network(&self) -> &NetworkConfig {
        &self.model.config
    }

    /// How it is trained.
    pub fn config(&self) -> &TrainingConfig {
        &self.config
    }

    /// Gradient steps done.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// How many weights the network has.
    pub fn parameters(&self) -> usize {
        self.model.parameters.len()
    }

    /// Learning rate of the next step.
    pub fn learning_rate(&self) -> f64 {
        let TrainingConfig {
            learning_rate,
            schedule,
            warm_up_steps,
            steps,
            ..
        } = self.config;
        optimiser::learning_rate(learning_rate, schedule, warm_up_steps, steps, self.step)
    }

    /// Makes the batches that [`Trainer::train_batch`] takes.
    pub fn batch_maker(&self) -> BatchMaker {
        BatchMaker {
            network: self.model.config.clone(),
            training: self.config.clone(),
            encoding: self.model.encoding(),
            says_done: self.model.says_done(),
        }
    }

    /// One gradient step on a batch of the configured size. Fails, leaving the weights as they were, when
    /// loss or gradient is not finite.
    pub fn train_step(&mut self, samples: &[Sample<'_>]) -> Result<Losses, Error> {
        let batch = self.batch_maker().batch(self.step, samples)?;
        self.train_batch(batch)
    }

    /// One gradient step on the batch of the present step: as [`Trainer::train_step`] with its samples, bit for bit.
    pub fn train_batch(&mut self, batch: Batch) -> Result<Losses, Error> {
        if batch.step != self.step {
            return Err(Error::BatchStep {
                actual: batch.step,
                expected: self.step,
            });
        }
        let [pick, place, done] = self.forward(batch)?;
        let sum = &pick + &place + &done;
        let gradients = Tensor::f_run_backward(&[sum], &self.weights, false, false)?;
        let gradient = self.model.parameters.flat_gradient(&gradients);
        let losses = Losses::read([&pick, &place, &done, &gradient.norm()])?;
        for (what, value) in [
            ("the pick loss", losses.pick),
            ("the place loss", losses.place),
            ("the loss of what is done", losses.done),
            ("the gradient", losses.gradient_norm),
        ] {
            if !value.is_finite() {
                let step = Some(self.step);
                return Err(Error::NotFinite { what, step });
            }
        }
        let rate = Rate {
            learning_rate: self.learning_rate(),
            clip: self.config.gradient_clip,
            weight_decay: self.config.weight_decay,
        };
        let (flat, norm) = (&self.model.parameters.flat, losses.gradient_norm);
        let count = self.step as i32 + 1;
        self.optimiser.update(flat, gradient, norm, count, rate);
        self.step += 1;
        Ok(losses)
    }

    /// Losses without augmentation and without learning: for validation. Any number of samples but none.
    pub fn losses(&self, samples: &[Sample<'_>]) -> Result<Losses, Error> {
        let batch = self.batch_maker().unaugmented(samples)?;
        let [pick, place, done] = tch::no_grad(|| self.forward(batch))?;
        Losses::read([&pick, &place, &done, &done.zeros_like()])
    }

    /// Multiplications of the convolutions of one forward pass of these samples: what an arithmetic limit is counted from.
    pub fn multiplications(&self, samples: &[Sample<'_>]) -> Result<u64, Error> {
        let before = multiplications();
        self.losses(samples)?;
        Ok(multiplications() - before)
    }

    fn forward(&self, batch: Batch) -> Result<[Tensor; 3], Error> {
        crate::apply_threads();
        let network = &self.model.config;
        let Batch {
            encoded,
            labels,
            mut rng,
            ..
        } = batch;
        let size = [network.rows, network.cols];
        let input = input::tensor(self.model.encoding(), size, &encoded);
        drop(encoded);
        self.model.parameters.cast();
        let features = self.model.forward(&input.to_device(self.device));
        let (grid, sigma) = (&self.model.grid, self.config.label_sigma_cells);
        let to_do = |index: &usize| !labels[*index].done;
        let to_do: Vec<usize> = (0..labels.len()).filter(to_do).collect();
        let of = |features: &Features, labels: &[Label], rng: &mut ChaCha8Rng| {
            let (training, rotations) = (&self.config, network.rotations);
            let pick = pick_loss(grid, sigma, features, labels);
            let pick = match network.candidates() {
                0 => pick,
                _ => pick + candidate_loss(grid, features, network, labels),
            };
            let shapes = turn_shapes(grid, features, network, labels);
            let shapes = shapes.as_ref();
            [
                pick,
                place_loss(grid, training, rotations, features, shapes, labels, rng),
            ]
        };
        let [pick, place] = if to_do.len() == labels.len() {
            of(&features, &labels, &mut rng)
        } else if to_do.is_empty() {
            [features.nothing(), features.nothing()]
        } else {
            // A step that is done has no pick: its share of the batch's mean is 0.
            let indices: Vec<i64> = to_do.iter().map(|index| *index as i64).collect();
            let chosen: Vec<Label> = to_do.iter().map(|index| labels[*index]).collect();
            let share = to_do.len() as f64 / labels.len() as f64;
            of(&features.of(&indices), &chosen, &mut rng).map(|loss| loss * share)
        };
        Ok(match &features.first {
            None => [
                pick,
                place,
                Tensor::zeros([], (features.scale.kind(), self.device)),
            ],
            Some(first) => {
                let place = place + first_place_loss(grid, sigma, first, &labels);
                [pick, place, done_loss(first, &labels)]
            }
        })
    }

    /// A policy with a copy of the present weights.
    pub fn policy(&self) -> Result<Policy, Error> {
        let builder = Builder::empty(self.device);
        let model = Model::new(&self.model.config, builder, self.model.precision);
        tch::no_grad(|| {
            let mut flat = model.parameters.flat.shallow_clone();
            flat.f_copy_(&self.model.parameters.flat)
        })?;
        Ok(Policy::new(model, ModelCard::new(), self.device))
    }

    /// Writes the network for [`Policy::load`]. The file appears whole or not at all.
    pub fn save_checkpoint(
        &self,
        path: &Path,
        storage: Storage,
        card: &ModelCard,
    ) -> Result<(), Error> {
        let Model {
            config, parameters, ..
        } = &self.model;
        checkpoint::save(path, storage, config, parameters, card)
    }

    /// The flat tensors of a saved state, by name.
    fn state(&self) -> Vec<(String, Tensor)> {
        let weights = ("weights", &self.model.parameters.flat);
        std::iter::once(weights)
            .chain(self.optimiser.entries())
            .map(|(name, tensor)| (name.to_owned(), tensor.shallow_clone()))
            .collect()
    }

    /// Writes all that is needed to go on: weights, optimiser, random state. The file appears whole or
    /// not at all.
    pub fn save_state(&self, path: &Path) -> Result<(), Error> {
        let texts = [
            ("network", checkpoint::json(&self.model.config)),
            ("training", checkpoint::json(&self.config)),
            ("step", self.step.to_string()),
        ];
        let head = checkpoint::head(FORMAT, VERSION, texts);
        checkpoint::write(path, Storage::F32, &self.state(), &head)
    }

    /// Goes on where [`Trainer::save_state`] stopped, bit for bit on the processor with the same number of
    /// threads. Refuses a state of another configuration; threads and device may differ.
    pub fn resume(
        path: &Path,
        network: &NetworkConfig,
        training: &TrainingConfig,
    ) -> Result<Self, Error> {
        let file = File::read(path, FORMAT, VERSION)?;
        let saved: NetworkConfig = file.json("network")?;
        if saved != *network {
            let (saved, asked) = (checkpoint::json(&saved), checkpoint::json(network));
            return Err(file.error(format!("it is of the network {saved}, expected {asked}")));
        }
        let saved = TrainingConfig {
            threads: training.threads,
            device: training.device,
            ..file.json("training")?
        };
        if saved != *training {
            let (saved, asked) = (checkpoint::json(&saved), checkpoint::json(training));
            return Err(file.error(format!("it is of the training {saved}, expected {asked}")));
        }
        let mut trainer = Self::new(network, training)?;
        trainer.step = file.json("step")?;
        file.fill(&trainer.state())?;
        Ok(trainer)
    }
}
