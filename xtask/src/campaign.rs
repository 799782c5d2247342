//! The fault campaign: `tests/campaign.py`.

use crate::command::{cargo, run};
use crate::{python, stage};
use anyhow::Result;

/// Sets up, builds, and injects faults at random moments of motions; or runs executors with planted faults.
pub fn run_faults(faults: u32, seed: u64, planted: bool, json: bool) -> Result<()> {
    let environment = python::Environment::set_up()?;
    stage::build_programs()?;
    let mut python = environment.python()?;
    python.arg("tests/campaign.py");
    python.args(["--faults", &faults.to_string(), "--seed", &seed.to_string()]);
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
