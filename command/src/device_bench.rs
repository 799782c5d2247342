//! `sctn bench device_parity` and `sctn bench device_speed`: training on a device, beside the processor and beside the arithmetic limit.

use crate::demos::demonstration;
use crate::root::Root;
use anyhow::{Context, Result, ensure};
use clap::{Args, ValueEnum};
use gctn::{
    Batch, Device, GrConvnet, Network, NetworkConfig, Precision, Sample, Trainer, TrainingConfig,
};
use learning::{DataSet, DrawRules, DrawnSample, Sampling, Shown};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

const SEED: u64 = 10_000;

/// What is measured on which device.
#[derive(Args)]
pub struct DeviceArguments {
    /// Of device_parity and device_speed: cpu, cuda or cuda:N
    #[arg(long, default_value_t)]
    device: Device,
    /// Of the same: networks
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Net::Compact, Net::GrConvnet, Net::Matching, Net::Resnet43])]
    networks: Vec<Net>,
    /// Of device_speed: samples a gradient step, ascending
    #[arg(long, value_delimiter = ',', default_values_t = [1, 2, 4, 8, 16, 32])]
    batches: Vec<usize>,
    /// Of device_parity: gradient steps
    #[arg(long, default_value_t = 20)]
    steps: u64,
}

/// A network as configured by default.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "snake_case")]
enum Net {
    Compact,
    #[value(name = "gr_convnet")]
    GrConvnet,
    Matching,
    Resnet43,
}

impl Net {
    fn config(self) -> NetworkConfig {
        match self {
            Self::Compact => NetworkConfig::compact(),
            Self::GrConvnet => NetworkConfig::new(Network::GrConvnet(GrConvnet::default())),
            Self::Matching => NetworkConfig::matching(),
            Self::Resnet43 => NetworkConfig::resnet43(),
        }
    }

    /// As it is trained, the published network as published.
    fn training(self, precision: Precision, batch: usize, device: Device) -> TrainingConfig {
        let training = match self {
            Self::Resnet43 => TrainingConfig::published(),
            _ => TrainingConfig::compact(),
        };
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        TrainingConfig {
            precision,
            batch,
            device,
            threads: cores,
            ..training
        }
    }
}

/// Steps of a demonstration of *placing*, as a network is shown them.
struct Samples {
    drawn: Vec<DrawnSample>,
}

impl Samples {
    fn new(root: &Root, network: &NetworkConfig, count: usize) -> Result<Self> {
        let mut data = DataSet::default();
        let placing = root.problem("placing")?;
        data.push(demonstration(&placing, &root.work_cell()?, SEED)?)?;
        let mut rng = ChaCha8Rng::seed_from_u64(SEED);
        let rules = DrawRules {
            sampling: &Sampling::Plain,
            conditioning: network.conditioning,
            goal_jitter: 0.0,
            shown: Shown::default(),
        };
        let drawn = (0..count).map(|_| data.draw(&rules, &mut rng));
        let drawn = drawn.collect::<Result<_, _>>()?;
        Ok(Self { drawn })
    }

    /// As many as a batch has, from this step's on.
    fn of(&self, step: u64, batch: usize) -> Vec<Sample<'_>> {
        let all = self
            .drawn
            .iter()
            .cycle()
            .skip(step as usize % self.drawn.len());
        all.take(batch).map(DrawnSample::sample).collect()
    }
}

/// The same gradient steps on the processor and on the device, both in 32-bit floats.
#[derive(Serialize)]
pub struct Parity {
    network: Net,
    steps: u64,
    /// Pick and place loss of the last step, on the processor and on the device.
    last_losses: [f64; 2],
    /// Largest difference of the sum of both, relative to the processor's: of the first step, and of all.
    first_difference: f64,
    largest_difference: f64,
    /// Seconds of all steps on the processor and on the device.
    seconds: [f64; 2],
}

/// Gradient steps of a network.
#[derive(Serialize)]
pub struct Speed {
    network: Net,
    precision: String,
    batch: usize,
    /// `None`: the steps would have taken too long, or failed.
    steps_per_s: Option<f64>,
    samples_per_s: Option<f64>,
    /// Of the samples, one thread of the processor draws, augments and encodes so many a second.
    samples_made_per_s: Option<f64>,
    /// Where the convolutions run as fast as a large one does, and nothing else takes time.
    limit_samples_per_s: f64,
    /// Why there is no figure.
    left_out: Option<String>,
}

/// What a device reaches in a large convolution.
#[derive(Serialize)]
pub struct Peak {
    precision: String,
    tflops: f64,
}

/// All of `device_speed`.
#[derive(Serialize)]
pub struct Speeds {
    device: String,
    peak: Vec<Peak>,
    speed: Vec<Speed>,
}

/// All of `device_parity`.
#[derive(Serialize)]
pub struct Parities {
    device: String,
    parity: Vec<Parity>,
}

impl DeviceArguments {
    /// 20 steps, or as many as asked for, of every network on the processor and on the device.
    pub fn parity(&self, root: &Root) -> Result<Parities> {
        self.device.check()?;
        let parity = self.networks.iter().map(|net| self.parity_of(root, *net));
        Ok(Parities {
            device: self.device.to_string(),
            parity: parity.collect::<Result<_>>()?,
        })
    }

    fn parity_of(&self, root: &Root, network: Net) -> Result<Parity> {
        let config = network.config();
        let samples = Samples::new(root, &config, 8)?;
        let run = |device: Device| -> Result<(Vec<f64>, f64)> {
            let training = network.training(Precision::F32, 1, device);
            let mut trainer = Trainer::new(&config, &training)?;
            let begun = Instant::now();
            let losses = (0..self.steps).map(|step| -> Result<f64> {
                let losses = trainer.train_step(&samples.of(step, training.batch))?;
                Ok(losses.pick + losses.place)
            });
            let losses = losses.collect::<Result<Vec<f64>>>()?;
            Ok((losses, begun.elapsed().as_secs_f64()))
        };
        let (here, here_s) = run(Device::Cpu)?;
        let (there, there_s) = run(self.device)?;
        let differences = here.iter().zip(&there);
        let differences: Vec<f64> = differences
            .map(|(here, there)| (here - there).abs() / here.abs())
            .collect();
        let last = |losses: &[f64]| {
            losses
                .last()
                .copied()
                .context("--steps: expected at least 1")
        };
        let largest_difference = differences.iter().copied().fold(0.0, f64::max);
        tracing::info!("{network:?}: losses differ by {largest_difference:.1e} at most");
        Ok(Parity {
            network,
            steps: self.steps,
            last_losses: [last(&here)?, last(&there)?],
            first_difference: differences[0],
            largest_difference,
            seconds: [here_s, there_s],
        })
    }

    /// Steps per second of every network at every batch, about `seconds` in all.
    pub fn speed(&self, root: &Root, seconds: f64) -> Result<Speeds> {
        self.device.check()?;
        ensure!(
            !self.batches.is_empty() && !self.batches.contains(&0),
            "--batches: expected at least 1 each"
        );
        let precisions = [Precision::F32, Precision::Bf16];
        let mut peak = Vec::new();
        let mut speed = Vec::new();
        let count = precisions.len() * self.networks.len() * self.batches.len();
        let each = Duration::try_from_secs_f64(seconds / count as f64)
            .context("--seconds: expected a positive number")?;
        for precision in precisions {
            if precision.on(self.device) != precision {
                tracing::warn!(
                    "{} has no instructions for {precision}: left out",
                    self.device
                );
                continue;
            }
            let tflops = gctn::convolution_tflops(self.device, precision)?;
            tracing::info!("a large convolution in {precision}: {tflops:.1} TFLOP/s");
            peak.push(Peak {
                precision: precision.to_string(),
                tflops,
            });
            for network in &self.networks {
                let measured = self.speeds_of(root, *network, precision, tflops, each);
                speed.extend(measured.with_context(|| format!("{network:?}"))?);
            }
        }
        Ok(Speeds {
            device: self.device.to_string(),
            peak,
            speed,
        })
    }

    fn speeds_of(
        &self,
        root: &Root,
        network: Net,
        precision: Precision,
        tflops: f64,
        each: Duration,
    ) -> Result<Vec<Speed>> {
        let config = network.config();
        let samples = Samples::new(root, &config, 8)?;
        let mut sample_s = 0.0;
        let mut speeds = Vec::new();
        let mut multiplications = None;
        for &batch in &self.batches {
            let training = network.training(precision, batch, self.device);
            let mut trainer = Trainer::new(&config, &training)?;
            let counted = match multiplications {
                Some(counted) => counted,
                None => trainer.multiplications(&samples.of(0, 1))?,
            };
            multiplications = Some(counted);
            // Forward and, twice as many, backward; a multiplication and an addition each.
            let limit_samples_per_s = tflops * 1e12 / (6.0 * counted as f64);
            // Two steps have to be done: one to warm up.
            let expected = Duration::try_from_secs_f64(2.0 * sample_s * batch as f64);
            let measured = match expected {
                Ok(expected) if speeds.is_empty() || expected <= 3 * each => {
                    // libtorch panics where memory does not suffice.
                    catch_unwind(AssertUnwindSafe(|| timed(&mut trainer, &samples, each)))
                        .unwrap_or_else(|_| Err(anyhow::anyhow!("libtorch gave up: see above")))
                }
                _ => Err(anyhow::anyhow!("a step would take too long")),
            };
            let speed = |figures: Option<Timed>, left_out: Option<String>| Speed {
                network,
                precision: precision.to_string(),
                batch,
                steps_per_s: figures.map(|figures| figures.step_s.recip()),
                samples_per_s: figures.map(|figures| batch as f64 / figures.step_s),
                samples_made_per_s: figures.map(|figures| batch as f64 / figures.made_s),
                limit_samples_per_s,
                left_out,
            };
            let speed = match measured {
                Ok(figures) => {
                    sample_s = figures.step_s / batch as f64;
                    speed(Some(figures), None)
                }
                Err(error) => speed(None, Some(format!("{error:#}"))),
            };
            tracing::info!(
                "{network:?} in {precision}, {batch} samples a step: {}",
                match (&speed.left_out, speed.steps_per_s) {
                    (None, Some(steps)) => format!("{steps:.2} steps per second"),
                    (reason, _) => reason.clone().unwrap_or_default(),
                }
            );
            speeds.push(speed);
        }
        Ok(speeds)
    }
}

/// Medians of a gradient step and of making its batch.
#[derive(Clone, Copy)]
struct Timed {
    step_s: f64,
    made_s: f64,
}

/// Steps for about so long, at least two, the first of which is not counted.
fn timed(trainer: &mut Trainer, samples: &Samples, about: Duration) -> Result<Timed> {
    const MOST: usize = 200;
    let (maker, batch) = (trainer.batch_maker(), trainer.config().batch);
    let begun = Instant::now();
    let (mut steps, mut made) = (Vec::new(), Vec::new());
    while steps.len() < 2 || (begun.elapsed() < about && steps.len() < MOST) {
        let start = Instant::now();
        let next: Batch = maker.batch(trainer.step(), &samples.of(trainer.step(), batch))?;
        made.push(start.elapsed().as_secs_f64());
        let start = Instant::now();
        // It gives the losses: the device has done all but the last of its work.
        trainer.train_batch(next)?;
        steps.push(start.elapsed().as_secs_f64());
    }
    let median = |times: &mut Vec<f64>| {
        times.remove(0);
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    Ok(Timed {
        step_s: median(&mut steps),
        made_s: median(&mut made),
    })
}
