//! `sctn demos`.

use crate::gallery;
use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result, bail};
use bags::Demonstration;
use camera_noise::Perturbation;
use clap::Args;
use cpu_time::ProcessTime;
use gctn::Policy;
use learning::{
    Actor, Rollout, demonstrate, demonstrate_corrections, demonstrate_disturbed,
    demonstration_path, replay, wilson_95,
};
use multiravens::{Care, Environment, EpisodeSeed, Problem};
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
    /// Demonstrations of each scene, with the same fixtures and goal: the first from its own start, the others from the
    /// starts SEED + 2, SEED + 4, ..., with the goals reached in the same order
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    starts: u64,
    /// Probability, before each step, that it is first carried out badly: gripped or set down beside. That is no step of the
    /// demonstration, which goes on from the result. With --starts the demonstration that sets the order stays clean
    #[arg(long, default_value_t = 0.0, value_parser = probability)]
    disturb: f64,
    /// The policy of this checkpoint, shown the first demonstration of the scene, acts before each step. Where it makes a mistake the demonstration
    /// goes on from the result; of the other starts only demonstrations in which it made one are kept
    #[arg(long, value_name = "CHECKPOINT", conflicts_with = "disturb")]
    mistakes_of: Option<PathBuf>,
    /// Make more sure of moves of chains and cables: each succeeds in five rehearsals too, gripped and set down within 6 mm of
    /// what is meant, as a policy may miss [default: two rehearsals within 1 mm]
    #[arg(long)]
    careful: bool,
    /// What the cameras do to the images, a file as those of config/perturbations; each start is a session of the cameras of its own
    /// [default: perfect cameras]
    #[arg(long)]
    perturb: Option<PathBuf>,
    /// Draw instead, into this folder: the problem [default: all], its demonstration of the seed
    /// [default: 0] as pictures and an animation
    #[arg(long, conflicts_with_all = ["episodes", "perturb", "out", "threads", "json"])]
    gallery: Option<PathBuf>,
    /// Folder for the bags, DIR/PROBLEM/SEED each, or DIR/PROBLEM/SEED_START from another start; those already there are kept [default: none are written]
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
    /// Episodes tried: scenes times starts.
    episodes: u64,
    /// Share of episodes in which the demonstrator completed every module, in the same order as from the first
    /// start of the scene that it completed.
    success: f64,
    interval_95: [f64; 2],
    /// The same for each start: the scene's own, then the others.
    success_by_start: Vec<f64>,
    /// Steps of the successful episodes.
    steps: u64,
    /// Bytes of their bags.
    bytes: u64,
    /// Processor time of what was made in this run.
    cpu_seconds: f64,
}

/// What the other starts of a scene go by.
struct Lead {
    demonstration: Demonstration,
    /// The order in which it reaches the goals; `None` where no other start can follow it.
    order: Option<Vec<usize>>,
}

impl Lead {
    fn new(rollout: Rollout) -> Self {
        Self {
            order: rollout.goal_order(),
            demonstration: rollout.demonstration,
        }
    }
}

struct Episode {
    /// Number of the start, from 0: the scene's own.
    start: u64,
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
        let perturbation = self.perturb.as_deref().map(Perturbation::load);
        let perturbation = perturbation.transpose()?;
        if self.mistakes_of.is_some() && self.starts == 1 {
            bail!(
                "--mistakes-of needs --starts of 2 or more: the policy is shown the demonstration of another start"
            );
        }
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        let threads = self.threads.unwrap_or(cores).max(1);
        let bar = progress::bar(count * self.starts, "demonstrations");
        let started = ProcessTime::now();
        let next = AtomicU64::new(0);
        let stop = AtomicBool::new(false);
        let episodes = Mutex::new(Vec::new());
        let work = || -> Result<()> {
            let mut environment = Environment::new(&problem, &work_cell);
            environment.set_perturbation(perturbation.as_ref());
            environment.set_care(if self.careful {
                Care::Careful
            } else {
                Care::Usual
            });
            let policy = self.mistakes_of.as_deref().map(Policy::load).transpose()?;
            let actor = policy.map(Actor::from);
            while !stop.load(Ordering::Relaxed) {
                let index = next.fetch_add(1, Ordering::Relaxed);
                if index >= count {
                    break;
                }
                let scene = first_seed + 2 * index;
                let mut lead = None;
                for start in 0..self.starts {
                    let episode = self
                        .episode(&mut environment, actor.as_ref(), scene, start, &mut lead)
                        .inspect_err(|_| stop.store(true, Ordering::Relaxed))?;
                    episodes
                        .lock()
                        .expect("no thread panics with the lock")
                        .push(episode);
                    bar.inc(1);
                }
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
        let complete = |start| {
            kept.clone()
                .filter(|episode| episode.start == start)
                .count()
        };
        let report = Report {
            problem: problem.name().to_owned(),
            episodes: count * self.starts,
            success: successes as f64 / episodes.len().max(1) as f64,
            interval_95: wilson_95(successes, episodes.len()),
            success_by_start: (0..self.starts)
                .map(|start| complete(start) as f64 / count.max(1) as f64)
                .collect(),
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

    /// Makes the demonstration of a scene from one of its starts, or takes the one that an earlier run has
    /// finished. The first complete one of a scene sets the order of the goals; one that reaches them in
    /// another order, or loses one on the way, does not count.
    fn episode(
        &self,
        environment: &mut Environment,
        actor: Option<&Actor>,
        scene: u64,
        start: u64,
        lead: &mut Option<Lead>,
    ) -> Result<Episode> {
        let seed = EpisodeSeed {
            scene,
            start: scene + 2 * start,
        };
        let problem = environment.problem().name().to_owned();
        let context = || format!("{problem}, seed {seed}");
        let path = self.out.as_ref();
        let path = path.map(|out| demonstration_path(out, &problem, seed));
        let mut episode = Episode {
            start,
            complete: true,
            steps: 0,
            bytes: 0,
        };
        if let Some(path) = &path
            && path.exists()
        {
            let found = Demonstration::read(path)
                .with_context(|| format!("{}: remove it to make it anew", path.display()))?;
            if self.starts > 1 && lead.is_none() {
                *lead = Some(Lead::new(
                    replay(environment, &found).with_context(context)?,
                ));
            }
            episode.steps = found.steps.len() as u64;
            episode.bytes = size(path)?;
            return Ok(episode);
        }
        environment.set_session(start);
        let order = lead.as_ref().and_then(|lead| lead.order.as_deref());
        let known = order.unwrap_or_default();
        let leads = self.starts > 1 && order.is_none();
        let (rollout, is_wanted) = match (actor, lead.as_ref()) {
            (Some(actor), Some(lead)) if !leads => {
                let shown = (&lead.demonstration, known);
                let corrected = demonstrate_corrections(environment, actor, seed, shown);
                let corrected = corrected.with_context(context)?;
                (corrected.rollout, corrected.mistakes > 0)
            }
            _ => {
                let disturb = if leads { 0.0 } else { self.disturb };
                let rollout = demonstrate_disturbed(environment, seed, known, disturb);
                (rollout.with_context(context)?, true)
            }
        };
        episode.complete = rollout.complete && is_wanted;
        if self.starts > 1 && rollout.complete {
            let reached = rollout.goal_order();
            let follows = order.is_none_or(|order| reached.as_deref() == Some(order));
            episode.complete &= reached.is_some() && follows;
            if leads && episode.complete {
                *lead = Some(Lead::new(rollout.clone()));
            }
        }
        if !episode.complete {
            return Ok(episode);
        }
        episode.steps = rollout.demonstration.steps.len() as u64;
        if let Some(path) = &path {
            let folder = path.parent().context("the bag's folder")?;
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            rollout.demonstration.write(path)?;
            episode.bytes = size(path)?;
        }
        Ok(episode)
    }
}

fn probability(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().ok();
    let value = value.filter(|value| (0.0..=1.0).contains(value));
    value.ok_or_else(|| format!("`{text}` is no probability, expected 0 to 1"))
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
pub fn demonstration(
    problem: &Problem,
    work_cell: &WorkCell,
    seed: impl Into<EpisodeSeed>,
) -> Result<Demonstration> {
    let seed = seed.into();
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
