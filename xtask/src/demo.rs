//! The main job, from a fresh clone: one run of a problem through all nodes as processes.

use crate::command::{command, repository_root, run, target_directory};
use crate::{libtorch, python, stage};
use anyhow::{Context as _, Result};
use std::fs;

/// Sets up, builds, and runs `problem` with the scene of `seed`, recorded to `out/demo`.
pub fn run_problem(problem: &str, seed: u64) -> Result<()> {
    libtorch::set_up(&python::with_pip()?)?;
    println!("demo: building the nodes (a first build takes some minutes) ...");
    stage::build_programs()?;
    let record = repository_root().join("out/demo");
    // An earlier demo's own output; `sctn launch` does not write over a recording.
    if record.exists() {
        fs::remove_dir_all(&record)
            .with_context(|| format!("cannot remove the earlier {}", record.display()))?;
    }
    run(command(target_directory().join("release/sctn"))
        .args(["launch", "--problem", problem, "--seed", &seed.to_string()])
        .args(["--operator", "auto", "--processes", "--record", "out/demo"]))
}
