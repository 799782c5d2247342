//! Set-up, demonstration run and tests of the whole repository: `cargo xtask --help`.

mod command;
mod libtorch;
mod python;

use clap::{Parser, Subcommand};

/// Set-up, demonstration run and tests of the whole repository.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask")]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Make what a plain `cargo build` needs: the slim libtorch in .libtorch
    Setup,
}

fn main() -> anyhow::Result<()> {
    match Arguments::parse().task {
        Task::Setup => libtorch::set_up(&python::with_pip()?),
    }
}
