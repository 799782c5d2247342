//! An embedding of heightmaps that tells how far a task is, learned by time contrast (Sermanet et al., "Time-Contrastive
//! Networks", ICRA 2018; paper, section IV-A).
//!
//! Two views of the same image of a demonstration are to be near each other, and far from the images of other times of the same
//! demonstration. There is one camera, so the other view is the image itself, a little displaced here and there and with noisy
//! colours and heights: what an image may differ in without anything having been done.

use heightmap::Heightmap;
use nalgebra::Point2;
use rand::{Rng, RngExt};
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use rand_distr::StandardNormal;
use std::path::Path;
use tch::{Device, Kind, Tensor};

use crate::augment::Warp;
use crate::checkpoint::{self, File};
use crate::input::{Encoding, Reading, check_cells, encode_alone, tensor};
use crate::network::{Builder, Conv, Encoder, Init, Parameters};
use crate::optimiser::{self, AdamW, Rate};
use crate::{EmbeddingConfig, EmbeddingTraining, Error, ModelCard, Schedule, Storage};

const FORMAT: &str = "gctn-embedding";
const VERSION: &str = "1";
const ENCODING: Encoding = Encoding {
    reading: Reading::Difference,
    goals: 0,
};

/// Where a heightmap lies among others, as a network sees it.
pub type Embedded = Vec<f32>;

/// A trained network that embeds heightmaps.
#[derive(Debug)]
pub struct Embedding {
    net: Net,
    card: ModelCard,
}

impl Embedding {
    /// Loads a checkpoint. Refuses another version, missing, further or misshapen tensors, numbers that are not
    /// finite and truncated files.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let file = File::read(path, FORMAT, VERSION)?;
        let config: EmbeddingConfig = file.json("network")?;
        config
            .check()
            .map_err(|error| file.error(format!("\"network\" in its head: {error}")))?;
        let net = Net::new(&config, Builder::empty(Device::Cpu));
        file.fill(&net.parameters.entries)?;
        let card = file.json("card")?;
        Ok(Self { net, card })
    }

    /// The network's configuration.
    pub fn config(&self) -> &EmbeddingConfig {
        &self.net.config
    }

    /// What its maker wrote about it.
    pub fn card(&self) -> &ModelCard {
        &self.card
    }

    /// Embeds a heightmap. The same heightmap and number of threads give the same bits.
    pub fn embed(&self, heightmap: &Heightmap) -> Result<Embedded, Error> {
        crate::apply_threads();
        let config = &self.net.config;
        config.check_workspace(&heightmap.workspace)?;
        check_cells("heightmap", heightmap)?;
        let mut encoded = vec![0.0; ENCODING.channels() * heightmap.workspace.len()];
        encode_alone(ENCODING, heightmap, &Warp::identity(), &mut encoded);
        let input = tensor(ENCODING, [config.rows, config.cols], &encoded);
        let output = tch::no_grad(|| self.net.forward(&input));
        let embedded = Embedded::try_from(output.squeeze_dim(0).contiguous())?;
        match embedded.iter().all(|value| value.is_finite()) {
            true => Ok(embedded),
            false => Err(Error::NotFinite {
                what: "the embedding",
                step: None,
            }),
        }
    }

    /// Index of the image that lies nearest, the first of equals; none of no images.
    pub fn nearest(seen: &Embedded, images: &[Embedded]) -> Option<usize> {
        let distance = |image: &Embedded| -> f32 {
            seen.iter().zip(image).map(|(a, b)| (a - b).powi(2)).sum()
        };
        images
            .iter()
            .map(distance)
            .enumerate()
            .min_by(|(_, a), (_, b)| a.total_cmp(b))
            .map(|(index, _)| index)
    }
}

#[derive(Debug)]
struct Net {
    config: EmbeddingConfig,
    parameters: Parameters,
    encoder: Encoder,
    head: Conv,
    /// Logarithm of the factor from squared distance to logit.
    scale: Tensor,
}

impl Net {
    fn new(config: &EmbeddingConfig, mut builder: Builder) -> Self {
        let channels = &config.channels;
        let encoder = Encoder::new(ENCODING.channels(), channels, &[1; 4], &mut builder);
        let shape = [channels[3], config.features];
        let head = builder.conv("head", shape, 1, 1, Init::FanIn);
        let scale = builder.scalar("scale", 0.0);
        Self {
            config: config.clone(),
            parameters: builder.finish(),
            encoder,
            head,
            scale,
        }
    }

    /// N x numbers: what is seen stays where it is, so that a cell in which nothing has changed counts nothing.
    fn forward(&self, input: &Tensor) -> Tensor {
        let (x, _) = self.encoder.forward(input);
        self.head.forward(&x).flatten(1, -1)
    }
}

/// What a gradient step found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EmbeddingLoss {
    /// Cross entropy, in nats, over which image of its demonstration another view belongs to.
    pub loss: f64,
    /// Share of the views whose own image was the nearest.
    pub right: f64,
}

/// An embedding in training.
#[derive(Debug)]
pub struct EmbeddingTrainer {
    training: EmbeddingTraining,
    net: Net,
    weights: Vec<Tensor>,
    optimiser: AdamW,
    step: u64,
}

impl EmbeddingTrainer {
    /// A network with random weights. Sets the threads of libtorch, in the whole process.
    pub fn new(config: &EmbeddingConfig, training: &EmbeddingTraining) -> Result<Self, Error> {
        config.check()?;
        training.check()?;
        crate::set_threads(training.threads);
        let net = Net::new(config, Builder::random(training.seed, Device::Cpu));
        Ok(Self {
            training: training.clone(),
            weights: net.parameters.require_gradients(),
            optimiser: AdamW::new(&net.parameters.flat),
            net,
            step: 0,
        })
    }

    /// Gradient steps done.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// One gradient step on as many demonstrations as configured, each given as its images in order: at least two. Fails,
    /// leaving the weights as they were, when loss or gradient is not finite.
    pub fn train_step(&mut self, sequences: &[Vec<&Heightmap>]) -> Result<EmbeddingLoss, Error> {
        let training = &self.training;
        if sequences.len() != training.batch {
            return Err(Error::Batch {
                actual: sequences.len(),
                expected: training.batch,
            });
        }
        crate::apply_threads();
        // A stream of its own for each step: the random state is the step's number.
        let mut rng = ChaCha8Rng::seed_from_u64(training.seed);
        rng.set_stream(self.step + 1);
        let (mut losses, mut right, mut views) = (Vec::new(), 0.0, 0);
        for (index, images) in sequences.iter().enumerate() {
            let (cross_entropy, nearest) = self.contrast(index, images, &mut rng)?;
            losses.push(cross_entropy);
            right += nearest;
            views += images.len();
        }
        let loss = Tensor::stack(&losses, 0).mean(Kind::Float);
        let gradients = Tensor::f_run_backward(&[&loss], &self.weights, false, false)?;
        let flat: Vec<Tensor> = gradients
            .iter()
            .map(|gradient| gradient.reshape([-1]))
            .collect();
        let gradient = Tensor::cat(&flat, 0);
        let norm = gradient.norm().double_value(&[]);
        let value = loss.double_value(&[]);
        for (what, value) in [("the loss", value), ("the gradient", norm)] {
            if !value.is_finite() {
                let step = Some(self.step);
                return Err(Error::NotFinite { what, step });
            }
        }
        let EmbeddingTraining {
            learning_rate,
            warm_up_steps,
            steps,
            ..
        } = *training;
        let schedule = Schedule::Cosine;
        let rate = Rate {
            learning_rate: optimiser::learning_rate(
                learning_rate,
                schedule,
                warm_up_steps,
                steps,
                self.step,
            ),
            clip: Some(5.0),
            weight_decay: 0.01,
        };
        let count = self.step as i32 + 1;
        let flat = &self.net.parameters.flat;
        self.optimiser.update(flat, gradient, norm, count, rate);
        self.step += 1;
        Ok(EmbeddingLoss {
            loss: value,
            right: right / views.max(1) as f64,
        })
    }

    /// Cross entropy of the images of one demonstration, and how many of their other views are nearest to their own.
    fn contrast(
        &self,
        index: usize,
        images: &[&Heightmap],
        rng: &mut ChaCha8Rng,
    ) -> Result<(Tensor, f64), Error> {
        if images.len() < 2 {
            let actual = images.len();
            return Err(Error::Sequence { index, actual });
        }
        let config = &self.net.config;
        let (rows, cols) = (config.rows, config.cols);
        let middle = [Point2::new(cols as f64 / 2.0, rows as f64 / 2.0); 2];
        let warp = Warp::draw(&self.training.augmentation, rows, cols, 1, middle, rng);
        let cells = ENCODING.channels() * rows * cols;
        let mut encoded = vec![0.0; images.len() * cells];
        for (image, out) in images.iter().zip(encoded.chunks_exact_mut(cells)) {
            config.check_workspace(&image.workspace)?;
            check_cells("image", image)?;
            encode_alone(ENCODING, image, &warp, out);
        }
        let input = tensor(ENCODING, [rows, cols], &encoded);
        let other = self.other_view(&input, rng);
        let output = self.net.forward(&Tensor::cat(&[&other, &input], 0));
        let count = images.len() as i64;
        let (seen, known) = (output.narrow(0, 0, count), output.narrow(0, count, count));
        let distance = (seen.unsqueeze(1) - known.unsqueeze(0))
            .square()
            .sum_dim_intlist([2i64].as_slice(), false, Kind::Float);
        let logits = distance * -self.net.scale.exp();
        let own = Tensor::arange(count, (Kind::Int64, Device::Cpu));
        let loss = logits.cross_entropy_loss::<Tensor>(&own, None, tch::Reduction::Mean, -100, 0.0);
        let nearest = logits.argmax(1, false).eq_tensor(&own);
        let right = nearest.sum(Kind::Float).double_value(&[]);
        Ok((loss, right))
    }

    /// The same images, each a little displaced here and there, with noise.
    fn other_view(&self, input: &Tensor, rng: &mut impl Rng) -> Tensor {
        let EmbeddingTraining {
            displacement_sigma_px: sigma_px,
            displacement_spacing_px: spacing_px,
            color_noise,
            height_noise_m,
            ..
        } = self.training;
        let [count, channels, rows, cols] = [0, 1, 2, 3].map(|i| input.size()[i]);
        let float = (Kind::Float, Device::Cpu);
        // Coordinates of libtorch: -1 and 1 at the edges of the image.
        let nodes = [rows, cols].map(|size| size / spacing_px as i64 + 2);
        let shifts: Vec<f32> = [cols, rows]
            .iter()
            .flat_map(|&size| std::iter::repeat_n(size, (nodes[0] * nodes[1]) as usize))
            .cycle()
            .take((count * 2 * nodes[0] * nodes[1]) as usize)
            .map(|size| {
                let shift_px = sigma_px * rng.sample::<f64, _>(StandardNormal);
                (2.0 * shift_px / size as f64) as f32
            })
            .collect();
        let shifts = Tensor::from_slice(&shifts)
            .view([count, 2, nodes[0], nodes[1]])
            .upsample_bilinear2d([rows, cols], true, None, None)
            .permute([0, 2, 3, 1]);
        let middles = |size: i64| (Tensor::arange(size, float) * 2.0 + 1.0) / size as f64 - 1.0;
        let x = middles(cols).view([1, cols]).expand([rows, cols], false);
        let y = middles(rows).view([rows, 1]).expand([rows, cols], false);
        let grid = Tensor::stack(&[x, y], 2).unsqueeze(0) + shifts;
        // Bilinear; beyond the edge what is at the edge.
        let displaced = input.grid_sampler_2d(&grid, 0, 1, false);
        let noise: Vec<f32> = (0..count * channels * rows * cols)
            .map(|_| rng.random_range(-1.0..1.0))
            .collect();
        // Largest errors in the scale of the encoding.
        let height = height_noise_m / 0.04;
        let color = color_noise / 128.0;
        let largest = Tensor::from_slice(&[color, color, color, height].map(|value| value as f32));
        let noise = Tensor::from_slice(&noise).view([count, channels, rows, cols]);
        displaced + noise * largest.view([1, channels, 1, 1])
    }

    /// Writes the network for [`Embedding::load`], in 16-bit floats. The file appears whole or not at all.
    pub fn save_checkpoint(&self, path: &Path, card: &ModelCard) -> Result<(), Error> {
        let texts = [
            ("network", checkpoint::json(&self.net.config)),
            ("card", checkpoint::json(card)),
        ];
        let head = checkpoint::head(FORMAT, VERSION, texts);
        checkpoint::write(path, Storage::F16, &self.net.parameters.entries, &head)
    }
}
