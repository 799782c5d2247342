//! The fault campaign: `tests/campaign.py`.

use crate::command::run;
use crate::{python, stage};
use anyhow::Result;

/// Sets up, builds, and injects faults at random moments of motions.
pub fn run_faults(faults: u32, seed: u64, json: bool) -> Result<()> {
    let environment = python::Environment::set_up()?;
    stage::build_programs()?;
    let mut python = environment.python()?;
    python.arg("tests/campaign.py");
    python.args(["--faults", &faults.to_string(), "--seed", &seed.to_string()]);
    if json {
        python.arg("--json");
    }
    run(&mut python)
}
