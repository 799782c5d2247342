//! `sctn bench`: the inner loops, timed by criterion.

use crate::demos::demonstration;
use crate::latency::Chain;
use crate::root::Root;
use anyhow::{Context, Result, bail};
use clap::Args;
use criterion::Criterion;
use gctn::{NetworkConfig, Policy, Trainer, TrainingConfig};
use heightmap::{Fusion, Heightmap, View, Workspace};
use multiravens::Environment;
use serde::Serialize;
use std::collections::BTreeMap;
use std::hint::black_box;
use std::path::Path;
use std::time::Duration;

/// Arguments of `sctn bench`.
#[derive(Args)]
pub struct Bench {
    /// Only benchmarks whose name contains this
    name: Option<String>,
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
        samples: 50,
        run: fusion,
    },
    Workload {
        name: "rendering",
        threads: 1,
        original_s: Some(0.766),
        samples: 50,
        run: rendering,
    },
    Workload {
        name: "inverse_kinematics",
        threads: 1,
        original_s: None,
        samples: 50,
        run: inverse_kinematics,
    },
    Workload {
        name: "physics_step",
        threads: 1,
        original_s: Some(1.0 / 6870.0),
        samples: 20,
        run: physics_step,
    },
    Workload {
        name: "demonstration_placing",
        threads: 1,
        original_s: None,
        samples: 10,
        run: demonstration_placing,
    },
    Workload {
        name: "decision_compact",
        threads: 1,
        original_s: Some(5.26),
        samples: 20,
        run: decision_compact,
    },
    Workload {
        name: "decision_resnet43",
        threads: 2,
        original_s: Some(5.26),
        samples: 10,
        run: decision_resnet43,
    },
    Workload {
        name: "frame_to_proposal",
        threads: 1,
        original_s: None,
        samples: 10,
        run: frame_to_proposal,
    },
];

#[derive(Serialize)]
struct Figure {
    median_s: f64,
    threads: usize,
    original_s: Option<f64>,
}

impl Bench {
    pub fn run(self, root: &Root) -> Result<()> {
        let chosen: Vec<_> = WORKLOADS
            .iter()
            .filter(|w| self.name.as_ref().is_none_or(|name| w.name.contains(name)))
            .collect();
        if chosen.is_empty() {
            let names: Vec<_> = WORKLOADS.iter().map(|workload| workload.name).collect();
            bail!("no benchmark of that name; there are: {}", names.join(", "));
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
                ..
            } = *workload;
            figures.insert(
                workload.name,
                Figure {
                    median_s,
                    threads,
                    original_s,
                },
            );
        }
        if self.json {
            println!("{}", serde_json::to_string(&figures)?);
            return Ok(());
        }
        // The originals ran on another machine: no ratio is claimed.
        println!(
            "{:24} {:>12} {:>8} {:>12}",
            "benchmark", "median", "threads", "original"
        );
        for (name, figure) in &figures {
            let original = figure.original_s.map_or_else(|| "-".to_owned(), time);
            let median = time(figure.median_s);
            println!(
                "{name:24} {median:>12} {:>8} {original:>12}",
                figure.threads
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

fn demonstration_placing(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let (problem, work_cell) = (root.problem("placing")?, root.work_cell()?);
    demonstration(&problem, &work_cell, SEED)?;
    criterion.bench_function(name, |b| {
        b.iter(|| demonstration(&problem, &work_cell, SEED))
    });
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
fn decision_resnet43(root: &Root, criterion: &mut Criterion, name: &str) -> Result<()> {
    let training = TrainingConfig {
        threads: 2,
        ..TrainingConfig::published()
    };
    decision(
        root,
        criterion,
        name,
        &Trainer::new(&NetworkConfig::resnet43(), &training)?.policy()?,
    )
}

fn decision(root: &Root, criterion: &mut Criterion, name: &str, policy: &Policy) -> Result<()> {
    let shown = demonstration(&root.problem("placing")?, &root.work_cell()?, SEED)?;
    let goal = shown
        .goals()
        .into_iter()
        .next()
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
    let mut chain = Chain::start(root, SEED)?;
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
