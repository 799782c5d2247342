//! The fault campaign: `tests/campaign.py`.

use crate::command::{cargo, run};
use crate::{python, stage};
use anyhow::Result;
use std::path::PathBuf;

/// What the campaign is asked for.
#[derive(clap::Args)]
pub struct Options {
    /// How many faults; each takes some 11 s
    #[arg(long, default_value_t = 20)]
    faults: u32,
    /// The same seed draws the same faults at the same moments
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Append a line of JSON for each fault; faults that are in the file are not injected again
    #[arg(long)]
    log: Option<PathBuf>,
    /// End after so long; with --log the next call goes on
    #[arg(long)]
    minutes: Option<f64>,
    /// How many cells run side by side; each takes a fifth of a core
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=16))]
    cells: u32,
    /// Run executors with a planted fault each instead: the monitor has to catch all of them
    #[arg(long)]
    planted: bool,
    /// Print the result as one line of JSON
    #[arg(long)]
    json: bool,
}

/// Sets up, builds, and injects faults at random moments of motions; or runs executors with planted faults.
pub fn run_faults(options: &Options) -> Result<()> {
    let Options {
        faults,
        seed,
        cells,
        planted,
        json,
        ..
    } = *options;
    let environment = python::Environment::set_up()?;
    stage::build_programs()?;
    let mut python = environment.python()?;
    python.arg("tests/campaign.py");
    python.args(["--faults", &faults.to_string(), "--seed", &seed.to_string()]);
    python.args(["--cells", &cells.to_string()]);
    if let Some(log) = &options.log {
        python.arg("--log").arg(log);
    }
    if let Some(minutes) = options.minutes {
        python.args(["--minutes", &minutes.to_string()]);
    }
    if planted {
        build_planted()?;
        python.arg("--planted");
    }
    if json {
        python.arg("--json");
    }
    run(&mut python)
}

/// Builds the executor in which faults are planted: an executable of its own.
fn build_planted() -> Result<()> {
    run(cargo().args([
        "build",
        "--workspace",
        "--exclude",
        "xtask",
        "--release",
        "--features",
        "suction_executor/planted_faults",
        "--bin",
        "suction_executor_planted",
    ]))
}
