//! `sctn evaluate`.

use crate::picture::scores;
use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result};
use clap::Args;
use gctn::Policy;
use heightmap::picture::{self, RgbImage};
use learning::{Attempt, Evaluation, NextStepOracle, evaluate, goal};
use std::path::PathBuf;
use std::sync::Mutex;

/// Arguments of `sctn evaluate`.
#[derive(Args)]
pub struct Evaluate {
    /// Checkpoint of the policy [default: the shipped one]
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// Problem to solve
    #[arg(long)]
    problem: String,
    /// Number of episodes
    #[arg(long)]
    episodes: usize,
    /// Seed of the first episode; the next ones are seed + 2, seed + 4, ... (test: from 10,000 up)
    #[arg(long)]
    seed: u64,
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
    /// Print the report as a JSON object last
    #[arg(long)]
    json: bool,
}

impl Evaluate {
    pub fn run(self, root: &Root) -> Result<()> {
        let problem = root.problem(&self.problem)?;
        let work_cell = root.work_cell()?;
        let checkpoint = self.checkpoint.unwrap_or_else(|| root.shipped_checkpoint());
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        // One decision on one thread, several episodes at a time: the same bits whatever the machine.
        gctn::set_threads(1);
        let mut policies: Vec<_> = (0..self.threads.unwrap_or(cores).max(1))
            .map(|_| Ok(Policy::load(&checkpoint)?))
            .collect::<Result<_>>()?;
        let bar = progress::bar(self.episodes as u64, "episodes");
        let failed = Mutex::new(Vec::new());
        let report = evaluate(
            &problem,
            &work_cell,
            &mut policies,
            self.seed,
            self.episodes,
            |report, attempt| {
                bar.inc(1);
                if self.failures.is_some() && !report.completed {
                    let mut failed = failed.lock().expect("no thread panics with the lock");
                    failed.push(attempt.clone());
                }
            },
        )?;
        bar.finish_and_clear();
        if let Some(folder) = &self.failures {
            std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            let failed = failed.into_inner().expect("no thread panics with the lock");
            for attempt in failed {
                let seed = attempt.shown.seed;
                let path = folder.join(format!("{}_{seed}.png", self.problem));
                let policy = policies.first().context("no policy")?;
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

/// Each step of an attempt a row: observation, goal, pick scores, place scores.
fn drawn(policy: &Policy, attempt: &Attempt) -> Result<RgbImage> {
    let goals = attempt.shown.goals();
    let done = &attempt.rollout.demonstration;
    let mut oracle = NextStepOracle::new(goals.len());
    let mut rows = Vec::new();
    for (index, step) in done.steps.iter().enumerate() {
        let observation = done.observation(index);
        let goal = goal(&goals, oracle.index(), policy.config().conditioning);
        let goal = goal.context("a demonstration without a goal")?;
        let row = picture::side_by_side(&[
            picture::colors(observation),
            picture::colors(goal.image),
            scores(policy, observation, goal)?,
        ]);
        rows.push(picture::halved(&row));
        oracle.observe(step.delta_reward);
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
