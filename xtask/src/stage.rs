//! The checks of `cargo xtask test`, in the order in which they run.

use crate::command::{cargo, command, repository_root, run, target_directory};
use crate::{layers, libtorch, licences, python, unit_tests};
use anyhow::{Context as _, Result, ensure};
use clap::ValueEnum;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

/// One check.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Stage {
    /// The slim libtorch
    Setup,
    /// rustfmt would change nothing
    Fmt,
    /// Every dependency has a permissive licence, and dependencies between our crates are those of ARCHITECTURE.md
    Dependencies,
    /// clippy has no warning
    Clippy,
    /// The documentation builds without a warning
    Doc,
    /// ruff finds no fault in the Python files and would format none of them
    Python,
    /// Unit tests and documentation examples of every crate
    Unit,
    /// Real processes and rclpy of ROS 2 Jazzy: pytest in tests/
    EndToEnd,
    /// The table of docs/ros2.md against rclpy of ROS 2 Kilted too
    Kilted,
    /// The Python package multiravens: installed by pip into a fresh environment, then pytest in python/tests
    Multiravens,
}

impl Stage {
    /// Runs the check. Everything is built in release, so that dependencies are compiled once.
    fn run(self, pytest_arguments: &[String]) -> Result<()> {
        match self {
            Self::Setup => libtorch::set_up(&python::with_pip()?),
            Self::Fmt => {
                run(cargo().args(["fmt", "--check"]))?;
                // Declared by a macro, which cargo fmt does not look into.
                let modules = rust_files("crates/multiravens/src/tasks")?;
                run(command("rustfmt")
                    .args(["--check", "--edition", "2024"])
                    .args(modules))
            }
            Self::Python => python::lint(),
            Self::Dependencies => {
                layers::check()?;
                licences::check()
            }
            Self::Clippy => run(&mut clippy()),
            Self::Doc => run(cargo()
                .args(["doc", "--workspace", "--no-deps", "--release"])
                .env("RUSTDOCFLAGS", "-D warnings")),
            Self::Unit => {
                unit_tests::of_workspace()?;
                fuzz_for_a_minute()?;
                golden_episodes_without_optimisation()?;
                // The networks against numpy, which the environment has, and against PyTorch where there is one.
                // Of the whole workspace, as above: for one crate alone Cargo would choose other features and compile again.
                let cross_check = |judge: &str| {
                    let test = ["test", "--workspace", "--release", "--tests", "--quiet"];
                    run(cargo().args(test).args([judge, "--", "--ignored"]))
                };
                cross_check("what_numpy_says")?;
                if python::with_pytorch().is_some() {
                    return cross_check("what_pytorch_says");
                }
                let reason = "no Python here can import torch (CONTRIBUTING.md, \"Cross-checks\")";
                ensure!(
                    std::env::var_os("CI").is_none(),
                    "the networks have to be compared with PyTorch where CI is set, and {reason}"
                );
                println!("left out: the comparison of the networks with PyTorch; {reason}");
                Ok(())
            }
            Self::EndToEnd => {
                let environment = python::Environment::set_up()?;
                build_programs()?;
                run(environment
                    .python()?
                    // Two files at a time: most tests wait for discovery, or for time to pass.
                    .args(["-m", "pytest", "-n", "2", "--dist", "loadfile", "tests"])
                    .args(pytest_arguments))
            }
            Self::Kilted => {
                let environment = python::Environment::set_up_kilted()?;
                build_programs()?;
                run(environment
                    .python()?
                    .args(["-m", "pytest", "tests/test_ros2.py"])
                    .args(pytest_arguments))
            }
            Self::Multiravens => {
                build_programs()?;
                let python = python::install_package()?;
                run(command(python)
                    .args(["-m", "pytest", "-c", "python/pytest.ini", "python/tests"])
                    .args(pytest_arguments))
            }
        }
    }

    fn name(self) -> String {
        self.to_possible_value()
            .map(|value| value.get_name().to_owned())
            .unwrap_or_default()
    }
}

/// clippy on everything; a warning fails.
pub fn clippy() -> Command {
    let mut clippy = cargo();
    clippy
        .args(["clippy", "--workspace", "--all-targets", "--release"])
        .args(["--", "-D", "warnings"]);
    clippy
}

/// Our packages that decide what happens in an episode.
const SIMULATION: [&str; 6] = [
    "camera_noise",
    "collision",
    "heightmap",
    "multiravens",
    "pick_place",
    "ur5",
];

/// The golden episodes have the same bits without optimisation. Only our crates are built without it, and with what is checked in
/// development: what is not ours is compiled once.
fn golden_episodes_without_optimisation() -> Result<()> {
    let mut test = cargo();
    test.args(["test", "--workspace", "--release", "--test", "golden"]);
    for package in SIMULATION {
        for setting in [
            "opt-level=0",
            "debug-assertions=true",
            "overflow-checks=true",
        ] {
            test.args([
                "--config",
                &format!("profile.release.package.{package}.{setting}"),
            ]);
        }
    }
    run(&mut test)
}

/// Mangled bags, guided by what they reach in the reader: see bags/README.md. What ends it stays in the target directory.
fn fuzz_for_a_minute() -> Result<()> {
    let wrapper = repository_root().join("bags/fuzz/instrumented_rustc");
    // With the features that the programs are built with: what is not ours is compiled once.
    run(cargo()
        .args(["build", "--workspace", "--exclude", "xtask"])
        .args(["--bin", "reader", "--release"])
        .env("RUSTC_WORKSPACE_WRAPPER", wrapper))?;
    let target = target_directory();
    let inputs = target.join("fuzz");
    std::fs::create_dir_all(&inputs).with_context(|| inputs.display().to_string())?;
    let artifacts = format!("-artifact_prefix={}/", target.display());
    run(command(target.join("release/reader"))
        .args(["-max_total_time=60", "-timeout=20", "-rss_limit_mb=1024"])
        .args(["-max_len=65536", "-print_final_stats=1", &artifacts])
        .env("BAGS_FUZZ_SEEDS", &inputs)
        .arg(&inputs))
}

/// The Rust files of a folder of the repository.
fn rust_files(folder: &str) -> Result<Vec<PathBuf>> {
    let folder = repository_root().join(folder);
    let entries = std::fs::read_dir(&folder).with_context(|| folder.display().to_string())?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Builds the nodes and the `sctn` command.
pub fn build_programs() -> Result<()> {
    run(cargo().args([
        "build",
        "--workspace",
        "--exclude",
        "xtask",
        "--bins",
        "--release",
    ]))
}

/// Runs the given checks, or all of them when none is given, and prints how long each took.
pub fn run_all(only: &[Stage], pytest_arguments: &[String]) -> Result<()> {
    let is_chosen = |stage: &&Stage| only.is_empty() || only.contains(stage);
    let chosen: Vec<Stage> = Stage::value_variants()
        .iter()
        .filter(is_chosen)
        .copied()
        .collect();
    std::thread::scope(|scope| {
        // Made meanwhile: much of it waits for downloads. The stage that needs one waits for it, and reports what fails.
        scope.spawn(|| {
            let makes = [
                (
                    Stage::EndToEnd,
                    python::Environment::set_up as fn() -> Result<_>,
                ),
                (Stage::Kilted, python::Environment::set_up_kilted),
            ];
            for (stage, make) in makes {
                if chosen.contains(&stage)
                    && let Err(error) = make()
                {
                    println!(
                        "python: {error:#}; tried again by the stage {}",
                        stage.name()
                    );
                }
            }
        });
        run_one_after_the_other(&chosen, pytest_arguments)
    })
}

fn run_one_after_the_other(stages: &[Stage], pytest_arguments: &[String]) -> Result<()> {
    let mut times: Vec<(Stage, Duration)> = Vec::new();
    for &stage in stages {
        println!("=== {} ===", stage.name());
        let start = Instant::now();
        stage
            .run(pytest_arguments)
            .with_context(|| format!("stage {} failed", stage.name()))?;
        times.push((stage, start.elapsed()));
    }
    println!("=== time of each stage ===");
    for (stage, time) in &times {
        println!("{:>12} {:7.1} s", stage.name(), time.as_secs_f64());
    }
    println!(
        "{:>12} {:7.1} s",
        "total",
        times
            .iter()
            .map(|(_, time)| time.as_secs_f64())
            .sum::<f64>()
    );
    Ok(())
}
