//! `sctn evaluate`.

use crate::picture::scores;
use crate::policy::PolicyArguments;
use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result, bail};
use camera_noise::Perturbation;
use clap::{Args, ValueEnum};
use gctn::Policy;
use heightmap::picture::{self, RgbImage};
use learning::{Actor, Attempt, Episodes, Evaluation, Start, evaluate, goal};
use std::path::PathBuf;
use std::sync::Mutex;
use step_protocol::ReachedGoals;

/// Arguments of `sctn evaluate`.
#[derive(Args)]
pub struct Evaluate {
    #[command(flatten)]
    policy: PolicyArguments,
    /// Problem to solve
    #[arg(long)]
    problem: String,
    /// Act by a rule that has learned nothing instead of a policy: what a score is worth that does not beat it
    #[arg(long, value_enum, conflicts_with_all = ["checkpoint", "failures"])]
    baseline: Option<Baseline>,
    /// Start of the demonstration that is shown: the very start of the episode, or another one of its scene
    #[arg(long, value_enum, default_value = "same")]
    start: StartArgument,
    /// Number of episodes
    #[arg(long)]
    episodes: usize,
    /// Seed of the first episode; the next ones are seed + 2, seed + 4, ... (test: from 10,000 up)
    #[arg(long)]
    seed: u64,
    /// What the cameras do to observations and goals, a file as those of config/perturbations [default: perfect cameras]
    #[arg(long)]
    perturb: Option<PathBuf>,
    /// Episodes at a time [default: one per core]
    #[arg(long)]
    threads: Option<usize>,
    /// File for the report with every episode
    #[arg(long)]
    out: Option<PathBuf>,
    /// Folder for a picture of every episode that is not completed, PROBLEM_SEED.png: each step a row of observation, goal, pick
    /// scores and place scores, with the poses decided on
    #[arg(long)]
    failures: Option<PathBuf>,
    /// Folder for the shown demonstrations: each is simulated once and read by later evaluations of the same program, problem and
    /// perturbation [default: none are kept]
    #[arg(long)]
    shown: Option<PathBuf>,
    /// Print the report as a JSON object last
    #[arg(long)]
    json: bool,
}

/// Rules without anything learned.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Baseline {
    /// Pick the middle of the cells that are lower in the goal by more than 6 mm, place at the middle of those that are higher
    Difference,
}

/// Where the shown demonstration begins.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum StartArgument {
    /// At the very start of the episode
    Same,
    /// At another start of the same scene: start seed SEED + 1
    Other,
}

impl From<StartArgument> for Start {
    fn from(start: StartArgument) -> Self {
        match start {
            StartArgument::Same => Self::Same,
            StartArgument::Other => Self::Other,
        }
    }
}

impl Evaluate {
    pub fn run(self, root: &Root) -> Result<()> {
        let problem = root.problem(&self.problem)?;
        let work_cell = root.work_cell()?;
        let perturbation = self.perturb.as_deref().map(Perturbation::load);
        let perturbation = perturbation.transpose()?;
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        // One decision on one thread, several episodes at a time: the same bits whatever the machine.
        gctn::set_threads(1);
        let mut actors: Vec<_> = (0..self.threads.unwrap_or(cores).max(1))
            .map(|_| match self.baseline {
                Some(Baseline::Difference) => Ok(Actor::Difference),
                None => Ok(Actor::from(self.policy.load(root)?)),
            })
            .collect::<Result<_>>()?;
        let plan = Episodes {
            first_seed: self.seed,
            count: self.episodes,
            start: self.start.into(),
        };
        let bar = progress::bar(self.episodes as u64, "episodes");
        let failed = Mutex::new(Vec::new());
        let mut report = evaluate(
            &problem,
            &work_cell,
            &mut actors,
            &plan,
            perturbation.as_ref(),
            self.shown.as_deref(),
            |report, attempt| {
                bar.inc(1);
                if self.failures.is_some() && !report.completed {
                    let mut failed = failed.lock().expect("no thread panics with the lock");
                    failed.push(attempt.clone());
                }
            },
        )?;
        bar.finish_and_clear();
        report.perturb = self.perturb.map(|path| path.display().to_string());
        if let Some(folder) = &self.failures {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            let failed = failed.into_inner().expect("no thread panics with the lock");
            for attempt in failed {
                let seed = attempt.shown.seed;
                let path = folder.join(format!("{}_{seed}.png", self.problem));
                let Some(Actor::Policy(policy)) = actors.first() else {
                    bail!("--failures: only of a policy");
                };
                picture::write(&path, &drawn(policy, &attempt)?)?;
            }
        }
        if let Some(out) = &self.out {
            let text = serde_json::to_string_pretty(&report)?;
            std::fs::write(out, text + "\n").with_context(|| out.display().to_string())?;
        }
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        } else {
            println!("{}", summary(&report));
        }
        Ok(())
    }
}

/// Each step of an attempt a row: observation, of a sequence the image before the goal, goal, pick scores, place scores.
fn drawn(policy: &Policy, attempt: &Attempt) -> Result<RgbImage> {
    let goals = attempt.shown.goals();
    let done = &attempt.rollout.demonstration;
    let mut oracle = ReachedGoals::new(goals.len());
    let mut rows = Vec::new();
    for (index, step) in done.steps.iter().enumerate() {
        let observation = done.observation(index);
        let first = attempt.shown.observation(0);
        let goal = goal(
            first,
            &goals,
            oracle.next_index(),
            policy.config().conditioning,
        );
        let goal = goal.context("a demonstration without a goal")?;
        let mut images = vec![picture::colors(observation)];
        images.extend(goal.previous.map(picture::colors));
        images.extend([
            picture::colors(goal.image),
            scores(policy, observation, goal)?,
        ]);
        let row = picture::side_by_side(&images);
        rows.push(picture::halved(&row));
        let is_last = index + 1 == done.steps.len();
        oracle.observe(step.delta_reward, is_last && attempt.rollout.complete);
    }
    // What came of the last step.
    rows.push(picture::halved(&picture::colors(&done.last)));
    Ok(picture::stacked(&rows))
}

/// One line for a person.
pub fn summary(report: &Evaluation) -> String {
    let [low, high] = report.interval_95;
    format!(
        "{}: completion {:.1} % (95 % interval {:.1} to {:.1}), reward {:.3}, {} episodes",
        report.problem,
        100.0 * report.completion,
        100.0 * low,
        100.0 * high,
        report.reward,
        report.episodes
    )
}
