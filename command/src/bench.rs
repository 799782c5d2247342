//! `sctn bench`: the inner loops, timed by criterion, and what demonstrations cost.

use crate::demos::demonstration;
use crate::device_bench::DeviceArguments;
use crate::latency::Chain;
use crate::root::Root;
use anyhow::{Context, Result, bail};
use clap::Args;
use cpu_time::ThreadTime;
use criterion::Criterion;
use gctn::{Device, NetworkConfig, Policy, Precision, Trainer, TrainingConfig};
use heightmap::{Fusion, Heightmap, StillFusion, StillSettings, View, Workspace};
use learning::{DataSet, DrawRules, Sampling, Shown, demonstrate, goal};
use multiravens::{Environment, Problem};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeMap;
use std::hint::black_box;
use std::path::Path;
use std::time::Duration;

/// Arguments of `sctn bench`.
#[derive(Args)]
pub struct Bench {
    /// Only benchmarks whose name contains this; those of problems are called demonstration_PROBLEM. `idle`: what the graph
    /// costs while it waits for an operator. `camera_stream`: three cameras at 30 Hz into camera_fusion. `device_parity`: the
    /// same gradient steps on the processor and on a device. `device_speed`: gradient steps per second there
    name: Option<String>,
    /// Demonstrations of each problem
    #[arg(long, default_value_t = 10)]
    demonstrations: u64,
    /// Seconds of `camera_stream`, and about those of `device_speed`
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    /// Sets of images that each heightmap of `camera_stream` is the median of
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=31))]
    frames: u8,
    #[command(flatten)]
    on_device: DeviceArguments,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// A benchmark: what to run, and what to compare it with.
struct Workload {
    name: &'static str,
    /// Threads that it uses.
    threads: usize,
    /// The same work in the original (PyBullet, numpy, TensorFlow), where it was measured.
    original_s: Option<f64>,
    /// What the median may be.
    limit_s: Option<f64>,
    /// Iterations measured, at least.
    samples: usize,
    run: fn(&Root, &mut Criterion, &str) -> Result<()>,
}

const SEED: u64 = 10_000;

const WORKLOADS: &[Workload] = &[
    Workload {
        name: "fusion",
        threads: 1,
        original_s: Some(0.176),
        limit_s: None,
        samples: 50,
        run: fusion,
    },
    Workload {
        name: "still_fusion",
        threads: 1,
        original_s: None,
        limit_s: None,
        samples: 50,
        run: still_fusion,
    },
    Workload {
        name: "rendering",
        threads: 1,
        original_s: Some(0.766),
        limit_s: None,
        samples: 50,
        run: rendering,
    },
    Workload {
        name: "inverse_kinematics",
        threads: 1,
        original_s: None,
        limit_s: None,
        samples: 50,
        run: inverse_kinematics,
    },
    Workload {
        name: "physics_step",
        threads: 1,
        original_s: Some(1.0 / 6870.0),
        limit_s: None,
        samples: 20,
        run: physics_step,
    },
    Workload {
        name: "decision_compact",
        threads: 1,
        original_s: Some(5.26),
        limit_s: None,
        samples: 20,
        run: decision_compact,
    },
    Workload {
        name: "decision_matching",
        threads: 1,
        original_s: Some(5.26),
        limit_s: None,
        samples: 20,
        run: decision_matching,
    },
    Workload {
        name: "decision_resnet43",
        threads: 2,
        original_s: Some(5.26),
        limit_s: None,
        samples: 10,
        run: decision_resnet43,
    },
    Workload {
        name: "decision_resnet43_bf16",
        threads: 2,
        original_s: Some(5.26),
        limit_s: None,
        samples: 10,
        run: decision_resnet43_bf16,
    },
    Workload {
        name: "training_sample_compact",
        threads: 1,
        original_s: Some(27.4),
        limit_s: None,
        samples: 20,
        run: training_sample_compact,
    },
    Workload {
        name: "training_sample_matching",
        threads: 1,
        original_s: Some(27.4),
        limit_s: None,
        samples: 20,
        run: training_sample_matching,
    },
    Workload {
        name: "training_step_resnet43",
        threads: 2,
        original_s: Some(27.4),
        limit_s: None,
        samples: 10,
        run: training_step_resnet43,
    },
    Workload {
        name: "frame_to_proposal",
        threads: 1,
        original_s: None,
        limit_s: None,
        samples: 10,
        run: frame_to_proposal,
    },
    Workload {
        name: "still_frames_to_proposal",
        threads: 1,
        original_s: None,
        limit_s: Some(0.04),
        samples: 10,
        run: still_frames_to_proposal,
    },
];

#[derive(Serialize)]
struct Figure {
    median_s: f64,
    threads: usize,
    original_s: Option<f64>,
    limit_s: Option<f64>,
}

/// Processor time that the fusion of three cameras at 30 Hz may take, in cores.
const FUSION_CORES: f64 = 0.5;
/// Sets of images that the fusion of real cameras takes the median of, as real_cell.launch.py sets it.
const STILL_FRAMES: u32 = 5;

/// Reset and one demonstration in the original (PyBullet), where it was measured.
const ORIGINAL_DEMONSTRATIONS_S: [(&str, f64); 3] =
    [("stacking", 16.0), ("routing", 13.9), ("chaining", 41.0)];

/// What demonstrations of a problem cost with reset, rendering and fusion, on one thread.
#[derive(Serialize)]
struct Cost {
    episodes: u64,
    successes: u64,
    /// Processor time of all episodes, by successful ones.
    cpu_s: f64,
    /// Wall time of 1,000 successful ones on two cores, at that.
    thousand_on_two_cores_s: f64,
    original_s: Option<f64>,
}

#[derive(Serialize)]
struct Report {
    inner_loops: BTreeMap<&'static str, Figure>,
    demonstrations: BTreeMap<String, Cost>,
}

impl Bench {
    pub fn run(self, root: &Root) -> Result<()> {
        if self.name.as_deref() == Some("idle") {
            return crate::idle::run(self.json);
        }
        if self.name.as_deref() == Some("camera_stream") {
            return self.camera_stream(root);
        }
        match self.name.as_deref() {
            Some("device_parity") => return self.printed(&self.on_device.parity(root)?),
            Some("device_speed") => {
                return self.printed(&self.on_device.speed(root, self.seconds)?);
            }
            _ => {}
        }
        let wanted = |name: &str| self.name.as_ref().is_none_or(|part| name.contains(part));
        let chosen: Vec<_> = WORKLOADS.iter().filter(|w| wanted(w.name)).collect();
        let problems = root.join("config/problems");
        let problems = Problem::names(&problems).with_context(|| problems.display().to_string())?;
        let benchmark = |problem: &String| format!("demonstration_{problem}");
        let shown = problems
            .iter()
            .filter(|problem| wanted(&benchmark(problem)));
        let shown: Vec<_> = shown.collect();
        if chosen.is_empty() && shown.is_empty() {
            let names = WORKLOADS.iter().map(|workload| workload.name.to_owned());
            let names: Vec<_> = names.chain(problems.iter().map(benchmark)).collect();
            bail!("no benchmark of that name; there are: {}", names.join(", "));
        }
        if self.demonstrations == 0 {
            bail!("--demonstrations: expected at least one");
        }
        let computed = Precision::Bf16.on(Device::Cpu);
        if computed != Precision::Bf16 {
            tracing::warn!(
                "this processor has no instructions for bf16: it is measured in {computed}"
            );
        }
        let output = tempfile::tempdir().context("folder for criterion's files")?;
        let mut figures = BTreeMap::new();
        for workload in chosen {
            gctn::set_threads(workload.threads);
            let mut criterion = Criterion::default()
                .output_directory(output.path())
                .without_plots()
                .sample_size(workload.samples)
                .warm_up_time(Duration::from_secs(1))
                .measurement_time(Duration::from_secs(3));
            (workload.run)(root, &mut criterion, workload.name)?;
            let median_s = median_s(output.path(), workload.name)?;
            let Workload {
                threads,
                original_s,
                limit_s,
                ..
            } = *workload;
            figures.insert(
                workload.name,
                Figure {
                    median_s,
                    threads,
                    original_s,
                    limit_s,
                },
            );
        }
        let costs = shown.into_iter().map(|problem| {
            let cost = Cost::measure(root, problem, self.demonstrations);
            cost.map(|cost| (problem.clone(), cost))
        });
        let report = Report {
            inner_loops: figures,
            demonstrations: costs.collect::<Result<_>>()?,
        };
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        } else {
            report.print();
        }
        for (name, figure) in &report.inner_loops {
            if let Some(limit_s) = figure.limit_s.filter(|limit_s| figure.median_s > *limit_s) {
                bail!(
                    "{name}: {}, expected at most {}",
                    time(figure.median_s),
                    time(limit_s)
                );
            }
        }
        Ok(())
    }
}

impl Cost {
    fn measure(root: &Root, problem: &str, episodes: u64) -> Result<Self> {
        let mut environment = Environment::new(&root.problem(problem)?, &root.work_cell()?);
        let mut successes = 0;
        let started = ThreadTime::now();
        for index in 0..episodes {
            let rollout = demonstrate(&mut environment, SEED + 2 * index)?;
            successes += u64::from(rollout.complete);
        }
        if successes == 0 {
            bail!("no demonstration of {problem} succeeded");
        }
        let cpu_s = started.elapsed().as_secs_f64() / successes as f64;
        let original = ORIGINAL_DEMONSTRATIONS_S
            .iter()
            .find(|(name, _)| *name == problem);
        Ok(Self {
            episodes,
            successes,
            cpu_s,
            thousand_on_two_cores_s: 1000.0 * cpu_s / 2.0,
            original_s: original.map(|(_, seconds)| *seconds),
        })
    }
}

impl Report {
    /// The originals ran on another machine: no ratio is claimed.
    fn print(&self) {
        let original = |seconds: Option<f64>| seconds.map_or_else(|| "-".to_owned(), time);
        if !self.inner_loops.is_empty() {
            println!(
                "{:26} {:>10} {:>8} {:>10}",
                "inner loop", "median", "threads", "original"
            );
        }
        for (name, figure) in &self.inner_loops {
            let (median, original) = (time(figure.median_s), original(figure.original_s));
            println!(
                "{name:26} {median:>10} {:>8} {original:>10}",
                figure.threads
            );
        }
        if !self.demonstrations.is_empty() {
            println!(
                "{:26} {:>10} {:>8} {:>10} {:>17}",
                "demonstration", "CPU time", "success", "original", "1,000 on 2 cores"
            );
        }
        for (name, cost) in &self.demonstrations {
            println!(
                "{name:26} {:>10} {:>8} {:>10} {:>13.1} min",
                time(cost.cpu_s),
                format!("{}/{}", cost.successes, cost.episodes),
                original(cost.original_s),
                cost.thousand_on_two_cores_s / 60.0
            );
        }
    }
}

impl Bench {
    /// On one line as JSON, or on many for a person.
    fn printed(&self, report: &impl Serialize) -> Result<()> {
        let text = match self.json {
            true => serde_json::to_string(report)?,
            false => serde_json::to_string_pretty(report)?,
        };
        println!("{text}");
        Ok(())
    }

    /// Fails where an image was lost, or the fusion takes too much.
    fn camera_stream(&self, root: &Root) -> Result<()> {
        if !(self.seconds.is_finite() && self.seconds > 0.0) {
            bail!("--seconds {}: expected a positive number", self.seconds);
        }
        let figures = crate::camera_stream::measure(root, self.seconds, usize::from(self.frames))?;
        if self.json {
            println!("{}", serde_json::json!({"camera_stream": figures}));
        } else {
            println!(
                "three cameras, colour of 1.04 MB and depth of 0.69 MB at 30 Hz, {} s, {:.0} MB/s, median of {}: {} sets, {} heightmaps, \
                 {} images lost",
                figures.seconds,
                figures.mb_s,
                figures.frames,
                figures.sets,
                figures.heightmaps,
                figures.images_lost
            );
            println!(
                "camera_fusion: {:.2} cores; last image sent to heightmap received: median {}, 99 % {}, at most {}",
                figures.fusion_cores,
                time(figures.latency_median_s),
                time(figures.latency_p99_s),
                time(figures.latency_max_s)
            );
        }
        if figures.fusion_cores > FUSION_CORES {
            bail!(
                "camera_fusion takes {:.2} cores, expected at most {FUSION_CORES}",
                figures.fusion_cores
            );
        }
        if figures.images_lost > 0 || figures.heightmaps < figures.sets {
            bail!(
                "{} images lost, {} of {} heightmaps",
                figures.images_lost,
                figures.heightmaps,
                figures.sets
            );
        }
        Ok(())
    }
}

/// A time for people.
fn time(seconds: f64) -> String {
    match seconds {
        s if s < 1e-3 => format!("{:.2} us", 1e6 * s),
        s if s < 1.0 => format!("{:.2} ms", 1e3 * s),
        s => format!("{s:.2} s"),
    }
}

/// The median that criterion has written.
fn median_s(directory: &Path, name: &str) -> Result<f64> {
    let path = directory.join(name).join("new/estimates.json");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let estimates: serde_json::Value = serde_json::from_str(&text)?;
    let nanoseconds = estimates["median"]["point_estimate"].as_f64();
    Ok(nanoseconds.context("criterion's estimates have no median")? * 1e-9)
}

fn environment(root: &Root) -> Result<Environment> {
    let mut environment = Environment::new(&root.problem("placing")?, &root.work_cell()?);
    environment.reset(SEED)?;
    Ok(environment)
}

fn fusion(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let mut environment = environment(root)?;
    environment.observe()?;
    let views: Vec<View<'_>> = environment.cell().views().collect();
    let (mut fusion, mut out) = (Fusion::default(), Heightmap::new(Workspace::RAVENS));
    criterion.bench_function(name, |b| {
        b.iter(|| fusion.fuse(black_box(&views), &mut out))
    });
    Ok(())
}

/// What a set of images costs where a heightmap is the median of several.
fn still_fusion(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let mut environment = environment(root)?;
    environment.observe()?;
    let views: Vec<View<'_>> = environment.cell().views().collect();
    let mut fusion = StillFusion::new(StillSettings {
        frames: STILL_FRAMES as usize,
        ..StillSettings::default()
    });
    let mut out = Heightmap::new(Workspace::RAVENS);
    criterion.bench_function(name, |b| {
        b.iter(|| {
            fusion.push(black_box(&views), &Workspace::RAVENS)?;
            Ok::<_, heightmap::FusionError>(fusion.median(&mut out))
        })
    });
    Ok(())
}

fn rendering(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let mut environment = environment(root)?;
    criterion.bench_function(name, |b| b.iter(|| environment.cell_mut().render().is_ok()));
    Ok(())
}

fn inverse_kinematics(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let arm = root.work_cell()?.arm;
    let near = arm.home + ur5::Joints::repeat(0.1);
    let tip = arm.tip(&near);
    arm.solve(&tip, &arm.home)?;
    criterion.bench_function(name, |b| b.iter(|| arm.solve(black_box(&tip), &arm.home)));
    Ok(())
}

fn physics_step(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let mut environment = environment(root)?;
    let arm = root.work_cell()?.arm;
    let tip = arm.tip(&arm.home);
    let world = environment.cell_mut().world_mut();
    criterion.bench_function(name, |b| b.iter(|| world.step(&tip)));
    Ok(())
}

fn decision_compact(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    decision(
        root,
        criterion,
        name,
        &Policy::load(&root.shipped_checkpoint())?,
    )
}

/// Random weights cost as much as trained ones.
fn decision_matching(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let trainer = Trainer::new(&NetworkConfig::matching(), &TrainingConfig::compact())?;
    decision(root, criterion, name, &trainer.policy()?)
}

fn decision_resnet43(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    decision(root, criterion, name, &resnet43(Precision::F32)?.policy()?)
}

fn decision_resnet43_bf16(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    decision(root, criterion, name, &resnet43(Precision::Bf16)?.policy()?)
}

/// Random weights cost as much as trained ones.
fn resnet43(precision: Precision) -> Result<Trainer> {
    let training = TrainingConfig {
        threads: 2,
        precision,
        ..TrainingConfig::published()
    };
    Ok(Trainer::new(&NetworkConfig::resnet43(), &training)?)
}

/// Forward, backward and optimiser for one sample, augmented, in bf16 as in `config/recipes/ten_problems.yaml`.
fn training_sample_compact(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let training = TrainingConfig {
        batch: 1,
        precision: Precision::Bf16,
        ..TrainingConfig::compact()
    };
    let trainer = Trainer::new(&NetworkConfig::compact(), &training)?;
    training_step(root, criterion, name, trainer)
}

/// The same of the network that follows a demonstration from another start.
fn training_sample_matching(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let training = TrainingConfig {
        batch: 1,
        precision: Precision::Bf16,
        ..TrainingConfig::compact()
    };
    let trainer = Trainer::new(&NetworkConfig::matching(), &training)?;
    training_step(root, criterion, name, trainer)
}

/// As published: one sample a step, over all rotations.
fn training_step_resnet43(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    training_step(root, criterion, name, resnet43(Precision::F32)?)
}

fn training_step(
    root: &Root,
    criterion: &mut Criterion,
    name: &str,
    mut trainer: Trainer,
) -> Result<()> {
    let mut data = DataSet::default();
    data.push(demonstration(
        &root.problem("placing")?,
        &root.work_cell()?,
        SEED,
    )?)?;
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let conditioning = trainer.network().conditioning;
    let rules = DrawRules {
        sampling: &Sampling::Plain,
        conditioning,
        goal_jitter: 0.0,
        shown: Shown::default(),
    };
    let drawn = data.draw(&rules, &mut rng)?;
    let sample = drawn.sample();
    trainer.train_step(&[sample])?;
    let mut failure = None;
    criterion.bench_function(name, |b| {
        b.iter(|| {
            if let Err(error) = trainer.train_step(black_box(&[sample])) {
                failure = Some(error);
            }
        })
    });
    failure.map_or(Ok(()), |error| Err(error.into()))
}

fn decision(root: &Root, criterion: &mut Criterion, name: &str, policy: &Policy) -> Result<()> {
    let shown = demonstration(&root.problem("placing")?, &root.work_cell()?, SEED)?;
    let conditioning = policy.config().conditioning;
    let goal = goal(shown.observation(0), &shown.goals(), 0, conditioning)
        .context("a demonstration without goals")?;
    let observation = &shown
        .steps
        .first()
        .context("a demonstration without steps")?
        .observation;
    policy.decide(observation, goal, &[])?;
    criterion.bench_function(name, |b| {
        b.iter(|| policy.decide(black_box(observation), goal, &[]))
    });
    Ok(())
}

/// Over DDS, from the last camera frame to the proposal, without what the network takes.
fn frame_to_proposal(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    frames_to_proposal(root, criterion, name, 1)
}

/// The same from the last of the frames of a still scene that the median takes.
fn still_frames_to_proposal(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    frames_to_proposal(root, criterion, name, STILL_FRAMES)
}

fn frames_to_proposal(
    root: &Root,
    criterion: &mut Criterion,
    name: &str,
    frames: u32,
) -> Result<()> {
    let mut chain = Chain::start(root, SEED, frames)?;
    chain.warm_up()?;
    let mut failure = None;
    criterion.bench_function(name, |b| {
        b.iter_custom(|captures| {
            let times = (0..captures).map(|_| chain.measure());
            let total: Result<Duration> = times.sum();
            total.unwrap_or_else(|error| {
                failure = Some(error);
                Duration::from_secs(1)
            })
        })
    });
    failure.map_or(Ok(()), Err)
}
