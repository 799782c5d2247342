//! `sctn demos`.

use crate::gallery;
use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result, bail};
use bags::Demonstration;
use clap::Args;
use cpu_time::ProcessTime;
use learning::{demonstrate, demonstration_path, wilson_95};
use multiravens::{Environment, Problem};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use ur5::WorkCell;

/// Arguments of `sctn demos`.
#[derive(Args)]
pub struct Demos {
    /// Problem to demonstrate
    #[arg(long, required_unless_present = "gallery")]
    problem: Option<String>,
    /// Episodes to try; the successful ones are kept
    #[arg(long, required_unless_present = "gallery")]
    episodes: Option<u64>,
    /// Seed of the first episode; the next ones are seed + 2, seed + 4, ... (training even, validation odd)
    #[arg(long, required_unless_present = "gallery")]
    seed: Option<u64>,
    /// Draw instead, into this folder: the problem [default: all], its demonstration of the seed
    /// [default: 0] as pictures and an animation
    #[arg(long, conflicts_with_all = ["episodes", "out", "threads", "json"])]
    gallery: Option<PathBuf>,
    /// Folder for the bags, DIR/PROBLEM/SEED each; those already there are kept [default: none are written]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Threads [default: one per core]
    #[arg(long)]
    threads: Option<usize>,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// What was made.
#[derive(Serialize)]
struct Report {
    problem: String,
    /// Episodes tried.
    episodes: u64,
    /// Share of episodes in which the demonstrator completed every module.
    success: f64,
    interval_95: [f64; 2],
    /// Steps of the successful episodes.
    steps: u64,
    /// Bytes of their bags.
    bytes: u64,
    /// Processor time of what was made in this run.
    cpu_seconds: f64,
}

struct Episode {
    complete: bool,
    steps: u64,
    bytes: u64,
}

impl Demos {
    pub fn run(self, root: &Root) -> Result<()> {
        if let Some(folder) = &self.gallery {
            let seed = self.seed.unwrap_or(0);
            return gallery::draw(root, self.problem.as_deref(), seed, folder);
        }
        let name = self.problem.as_deref().context("--problem is missing")?;
        let count = self.episodes.context("--episodes is missing")?;
        let first_seed = self.seed.context("--seed is missing")?;
        let problem = root.problem(name)?;
        let work_cell = root.work_cell()?;
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        let threads = self.threads.unwrap_or(cores).max(1);
        let bar = progress::bar(count, "demonstrations");
        let started = ProcessTime::now();
        let next = AtomicU64::new(0);
        let stop = AtomicBool::new(false);
        let episodes = Mutex::new(Vec::new());
        let work = || -> Result<()> {
            let mut environment = Environment::new(&problem, &work_cell);
            while !stop.load(Ordering::Relaxed) {
                let index = next.fetch_add(1, Ordering::Relaxed);
                if index >= count {
                    break;
                }
                let seed = first_seed + 2 * index;
                let episode = self
                    .episode(&mut environment, seed)
                    .inspect_err(|_| stop.store(true, Ordering::Relaxed))?;
                episodes
                    .lock()
                    .expect("no thread panics with the lock")
                    .push(episode);
                bar.inc(1);
            }
            Ok(())
        };
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
            threads
                .into_iter()
                .try_for_each(|thread| match thread.join() {
                    Ok(result) => result,
                    Err(panic) => std::panic::resume_unwind(panic),
                })
        })?;
        bar.finish_and_clear();
        let episodes = episodes
            .into_inner()
            .expect("no thread panics with the lock");
        let kept = episodes.iter().filter(|episode| episode.complete);
        let successes = kept.clone().count();
        let report = Report {
            problem: problem.name().to_owned(),
            episodes: count,
            success: successes as f64 / count.max(1) as f64,
            interval_95: wilson_95(successes, episodes.len()),
            steps: kept.clone().map(|episode| episode.steps).sum(),
            bytes: kept.map(|episode| episode.bytes).sum(),
            cpu_seconds: started.elapsed().as_secs_f64(),
        };
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        } else {
            println!(
                "{}: {successes} of {} demonstrations succeeded, {} steps, {:.1} MB, {:.1} s of processor time",
                report.problem,
                report.episodes,
                report.steps,
                report.bytes as f64 / 1e6,
                report.cpu_seconds
            );
        }
        if successes == 0 && count > 0 {
            bail!("no demonstration of {} succeeded", report.problem);
        }
        Ok(())
    }

    /// Makes the demonstration of a seed, or takes the one that an earlier run has finished.
    fn episode(&self, environment: &mut Environment, seed: u64) -> Result<Episode> {
        let problem = environment.problem().name().to_owned();
        let path = self
            .out
            .as_ref()
            .map(|out| demonstration_path(out, &problem, seed));
        if let Some(path) = &path
            && path.exists()
        {
            let found = Demonstration::read(path)
                .with_context(|| format!("{}: remove it to make it anew", path.display()))?;
            return Ok(Episode {
                complete: true,
                steps: found.steps.len() as u64,
                bytes: size(path)?,
            });
        }
        let rollout =
            demonstrate(environment, seed).with_context(|| format!("{problem}, seed {seed}"))?;
        let mut bytes = 0;
        if rollout.complete
            && let Some(path) = &path
        {
            let folder = path.parent().context("the bag's folder")?;
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            rollout.demonstration.write(path)?;
            bytes = size(path)?;
        }
        Ok(Episode {
            complete: rollout.complete,
            steps: rollout.demonstration.steps.len() as u64,
            bytes,
        })
    }
}

/// Bytes of the files of a bag.
fn size(bag: &Path) -> Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(bag).with_context(|| bag.display().to_string())? {
        bytes += entry?.metadata()?.len();
    }
    Ok(bytes)
}

/// The demonstration of a problem's seed; an error where the demonstrator fails on it.
pub fn demonstration(problem: &Problem, work_cell: &WorkCell, seed: u64) -> Result<Demonstration> {
    let mut environment = Environment::new(problem, work_cell);
    let rollout = demonstrate(&mut environment, seed)?;
    if !rollout.complete {
        bail!(
            "the demonstrator does not complete {} with seed {seed}: choose another seed",
            problem.name()
        );
    }
    Ok(rollout.demonstration)
}
