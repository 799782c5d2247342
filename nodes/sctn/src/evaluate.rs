//! `sctn evaluate`.

use crate::progress;
use crate::root::Root;
use anyhow::{Context, Result};
use clap::Args;
use gctn::Policy;
use sctn::{Evaluation, evaluate};
use std::path::PathBuf;

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
        let report = evaluate(
            &problem,
            &work_cell,
            &mut policies,
            self.seed,
            self.episodes,
            |_| bar.inc(1),
        )?;
        bar.finish_and_clear();
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
