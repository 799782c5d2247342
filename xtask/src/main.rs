//! Set-up, demonstration run and tests of the whole repository: `cargo xtask --help`.

mod campaign;
mod check;
mod command;
mod demo;
#[cfg(test)]
mod documents;
mod gpu;
mod layers;
mod libtorch;
mod licences;
mod packages;
mod python;
mod stage;
mod unit_tests;

use anyhow::Result;
use clap::{Parser, Subcommand};

/// Set-up, demonstration run and tests of the whole repository
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask")]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Make what a plain `cargo build` needs: the slim libtorch in .libtorch
    Setup {
        /// Also make what the end-to-end tests need: .venv with rclpy and our messages
        #[arg(long)]
        python: bool,
        /// Also make what computes on an NVIDIA card: .libtorch-cuda, which programs find at run time
        #[arg(long)]
        cuda: bool,
    },
    /// After an edit: formatting, clippy and unit tests of the packages that have changed
    Check {
        /// Check these packages instead of those with a change since origin/main
        #[arg(short = 'p', long = "package", value_name = "CRATE")]
        packages: Vec<String>,
    },
    /// Run every check of the repository
    Test {
        /// Run only these stages
        #[arg(long, value_enum, value_delimiter = ',')]
        only: Vec<stage::Stage>,
        /// Arguments for pytest, after --
        #[arg(last = true)]
        pytest: Vec<String>,
    },
    /// Run one problem through all nodes as processes, headless; the recording goes to out/demo
    Demo {
        /// Problem in config/problems
        #[arg(long, default_value = "placing")]
        problem: String,
        /// Seed of the scene; test seeds start at 10000
        #[arg(long, default_value_t = 10_000)]
        seed: u64,
    },
    /// Inject faults at random moments of motions, while an independent monitor reads the joints and the approvals
    Campaign(campaign::Options),
    /// On a host with a GPU: parity with the processor, steps per second, trainings with a deadline; one JSON file comes back
    Gpu(gpu::Options),
    /// Check that every dependency has a permissive licence
    Licences,
}

fn main() -> Result<()> {
    match Arguments::parse().task {
        Task::Setup { python, cuda } => {
            let pip = python::with_pip()?;
            libtorch::set_up(&pip)?;
            if cuda {
                libtorch::set_up_cuda(&pip)?;
            }
            if python {
                python::Environment::set_up()?;
            }
            Ok(())
        }
        Task::Check { packages } => check::run_checks(&packages),
        Task::Test { only, pytest } => stage::run_all(&only, &pytest),
        Task::Demo { problem, seed } => demo::run_problem(&problem, seed),
        Task::Campaign(options) => campaign::run_faults(&options),
        Task::Gpu(options) => gpu::measure(options),
        Task::Licences => licences::check(),
    }
}
