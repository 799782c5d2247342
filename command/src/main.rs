//! The sctn command: launches the graph, makes demonstrations, trains, evaluates, draws.

mod bag;
mod bench;
mod calibrate;
mod camera_stream;
mod check;
mod cluster;
mod compare;
mod console;
mod curves;
mod decide;
mod demos;
mod device_bench;
mod embed;
mod evaluate;
mod gallery;
mod goals;
mod health;
mod idle;
mod interfaces;
mod latency;
mod launch;
mod operate;
mod picture;
mod policy;
mod problems;
mod progress;
mod publish;
mod reliability;
mod root;
mod search;
mod sweep;
mod table;
mod train;

use anyhow::Result;
use clap::{Parser, Subcommand};
use root::Root;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Parser)]
#[command(name = "sctn", version, about, max_term_width = 100)]
struct Arguments {
    /// Folder that holds config/ and urdf/ [default: the nearest one above the current folder or the program]
    #[arg(long, global = true)]
    root: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Bag(bag::Bag),
    /// Time the inner loops
    Bench(bench::Bench),
    /// Print, as JSON, what a policy decides before each step of a demonstration
    Decide(decide::Decide),
    /// Make demonstrations of a problem, and keep the successful ones as bags
    Demos(demos::Demos),
    /// Draw problems of the module arranging at random, and write their files
    Problems(problems::Problems),
    /// Check the physics of a problem, and that no policy solves it by accident
    Health(health::Health),
    /// Print every topic, service, action and parameter of the nodes: docs/interfaces.md
    Interfaces(interfaces::Interfaces),
    /// Train a policy on demonstrations, by a recipe
    Train(train::Train),
    /// Measure how far policies are from demonstrated steps that they were not trained on
    Compare(compare::Compare),
    /// Train and test many policies: problems, agents, demonstrations and seeds
    Sweep(sweep::SweepCommand),
    /// Find the step weights of a task module, and how complex it is, by black-box optimisation
    Search(search::SearchCommand),
    /// Print the paper's tables beside the results of sweeps
    Table(table::TableCommand),
    /// Train the embedding of the goal module of that name on demonstrations
    Embed(embed::Embed),
    /// Measure how often each goal module names the right goal
    Goals(goals::Goals),
    /// Evaluate a policy on held-out episodes
    Evaluate(evaluate::Evaluate),
    /// Say whether a policy's probabilities of success are to be trusted, and fit them
    Reliability(reliability::ReliabilityCommand),
    /// Launch the graph on a simulated cell, under an operator
    Launch(launch::Launch),
    /// Decide at the terminal for a graph that runs, simulated or real
    Operate(operate::Operate),
    /// Serve the operator's page for a graph that runs, simulated or real
    Console(console::ConsoleCommand),
    /// Write a checkpoint and its results as a folder in the layout of the Hugging Face hub; nothing is uploaded
    Publish(publish::Publish),
    /// Find where the cameras stand, from images of a board of AprilTags at the tool
    Calibrate(calibrate::Calibrate),
    /// Check a real or simulated cell: table, cameras, noise, clocks, reach; exit code 1 if something is red
    Check(check::Check),
    /// Draw what the cameras, the fusion, the demonstrator and the policy make of a problem
    Picture(picture::Picture),
}

fn main() -> Result<ExitCode> {
    node_kit::logging::init(&[])?;
    let arguments = Arguments::parse();
    let root = || Root::find(arguments.root);
    match arguments.command {
        // Bags can be looked at anywhere.
        Command::Bag(bag) => return bag.run(),
        Command::Reliability(reliability) => reliability.run(),
        Command::Bench(bench) => bench.run(&root()?),
        Command::Decide(decide) => decide.run(&root()?),
        Command::Demos(demos) => demos.run(&root()?),
        Command::Problems(problems) => problems.run(&root()?),
        Command::Health(health) => health.run(&root()?),
        Command::Interfaces(interfaces) => interfaces.run(&root()?),
        Command::Train(train) => train.run(&root()?),
        Command::Compare(compare) => compare.run(&root()?),
        Command::Sweep(sweep) => sweep.run(&root()?),
        Command::Search(search) => search.run(&root()?),
        Command::Embed(embed) => embed.run(&root()?),
        Command::Goals(goals) => goals.run(&root()?),
        Command::Table(table) => table.run(&root()?),
        Command::Evaluate(evaluate) => evaluate.run(&root()?),
        Command::Launch(launch) => launch.run(&root()?),
        Command::Operate(operate) => operate.run(),
        Command::Calibrate(calibrate) => calibrate.run(&root()?),
        Command::Check(check) => return check.run(&root()?),
        Command::Console(console) => console.run(&root()?),
        Command::Publish(publish) => publish.run(&root()?),
        Command::Picture(picture) => picture.run(&root()?),
    }?;
    Ok(ExitCode::SUCCESS)
}
