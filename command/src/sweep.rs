//! `sctn sweep`.

use crate::progress;
use crate::root::Root;
use crate::train::{Data, Snapshot, train};
use anyhow::{Context, Result};
use clap::Args;
use cpu_time::ProcessTime;
use gctn::{Device, Policy, TrainingConfig};
use learning::{
    Actor, Episodes, Recipe, Run, RunResult, Score, SnapshotResult, Start, Sweep, evaluate,
    wilson_95,
};
use std::path::{Path, PathBuf};

/// Arguments of `sctn sweep`.
#[derive(Args)]
pub struct SweepCommand {
    /// What to train: problems, agents, demonstrations, seeds
    #[arg(long)]
    sweep: PathBuf,
    /// Folder that `sctn demos` wrote
    #[arg(long)]
    demos: PathBuf,
    /// Folder for one JSON file a run, and below runs/ the trainings. Runs whose file is there are not run
    /// again, those that were stopped go on
    #[arg(long)]
    out: PathBuf,
    /// Do only the part of the runs that says `INDEX/COUNT`, from 0/COUNT on: for several processes
    #[arg(long, value_name = "INDEX/COUNT", value_parser = part, default_value = "0/1")]
    part: (usize, usize),
    /// List the runs, and do nothing
    #[arg(long)]
    list: bool,
}

/// `1/3` is the second of three parts.
fn part(text: &str) -> Result<(usize, usize), String> {
    let expected = "expected INDEX/COUNT with INDEX below COUNT, such as 0/2";
    let (index, count) = text.split_once('/').ok_or(expected)?;
    match (index.parse(), count.parse()) {
        (Ok(index), Ok(count)) if index < count => Ok((index, count)),
        _ => Err(expected.into()),
    }
}

impl SweepCommand {
    pub fn run(self, root: &Root) -> Result<()> {
        let sweep = Sweep::load(&self.sweep)?;
        // Problems are read before anything is trained.
        let mut modules = std::collections::BTreeMap::new();
        for name in &sweep.problems {
            modules.insert(name.clone(), root.problem(name)?.modules().len());
        }
        let (index, count) = self.part;
        let runs = sweep.runs(|problem| modules[problem]);
        let runs: Vec<_> = runs.into_iter().skip(index).step_by(count).collect();
        for (number, run) in runs.iter().enumerate() {
            let slug = run.slug();
            let file = self.out.join(format!("{slug}.json"));
            let done = file.exists();
            let state = if done { "done" } else { "to do" };
            tracing::info!("run {} of {}: {slug}, {state}", number + 1, runs.len());
            if self.list {
                continue;
            }
            if done {
                let name = || file.display().to_string();
                let text = std::fs::read_to_string(&file).with_context(name)?;
                println!(
                    "{slug}: {}",
                    line(&serde_json::from_str(&text).with_context(name)?)
                );
                continue;
            }
            let recipe = sweep.recipe(run, modules[&run.problem]);
            let result = self
                .one(root, &sweep, run, recipe)
                .with_context(|| format!("run {slug}"))?;
            write_whole(&file, &serde_json::to_string_pretty(&result)?)?;
            println!("{slug}: {}", line(&result));
        }
        Ok(())
    }

    /// Folder of the demonstrations that evaluations show: the same for all runs.
    fn shown(&self) -> PathBuf {
        self.out.join("shown")
    }

    fn one(&self, root: &Root, sweep: &Sweep, run: &Run, recipe: Recipe) -> Result<RunResult> {
        let started = ProcessTime::now();
        let folder = self.out.join("runs").join(run.slug());
        let resume = folder.join("state.safetensors").exists();
        let snapshots = train(
            root,
            recipe.clone(),
            Data {
                demos: std::slice::from_ref(&self.demos),
                held_out: &[],
            },
            &folder,
            &self.shown(),
            resume,
        )?;
        let problem = root.problem(&run.problem)?;
        let work_cell = root.work_cell()?;
        let score = |snapshot: &Snapshot, seed: u64, episodes: usize| -> Result<Score> {
            gctn::set_threads(1);
            let mut actors = (0..recipe.training.threads)
                .map(|_| Ok(Actor::from(Policy::load(&snapshot.checkpoint)?)))
                .collect::<Result<Vec<_>>>()?;
            let plan = Episodes {
                first_seed: seed,
                count: episodes,
                start: Start::Same,
            };
            let bar = progress::bar(episodes as u64, "episodes");
            let shown = Some(self.shown());
            let report = evaluate(
                &problem,
                &work_cell,
                &mut actors,
                &plan,
                None,
                shown.as_deref(),
                |_, _| bar.inc(1),
            )?;
            bar.finish_and_clear();
            Ok(Score {
                episodes: report.episodes,
                completed: report
                    .reports
                    .iter()
                    .filter(|report| report.completed)
                    .count(),
                reward: report.reward,
            })
        };
        let mut results = Vec::new();
        for snapshot in &snapshots {
            // The training has evaluated on the validation episodes already.
            let count = recipe.validation.episodes;
            let rate = snapshot.completion.get(&run.problem).copied();
            results.push(SnapshotResult {
                step: snapshot.step,
                pick_loss: snapshot.pick_loss,
                place_loss: snapshot.place_loss,
                validation: Score {
                    episodes: count,
                    completed: (rate.unwrap_or(0.0) * count as f64).round() as usize,
                    reward: snapshot.reward.get(&run.problem).copied().unwrap_or(0.0),
                },
                test: score(snapshot, sweep.test.seed, sweep.test.episodes)?,
            });
        }
        Ok(RunResult {
            problem: run.problem.clone(),
            agent: run.agent,
            demonstrations: run.demonstrations,
            seed: run.seed,
            test: sweep.test.clone(),
            cpu_seconds: started.elapsed().as_secs_f64(),
            device: device(&recipe.training),
            recipe,
            snapshots: results,
        })
    }
}

/// One line for a person: the snapshot chosen on validation episodes, and what all of the run cost.
fn line(result: &RunResult) -> String {
    let minutes = result.cpu_seconds / 60.0;
    let Some(chosen) = result.chosen() else {
        return format!("no snapshot, {minutes:.1} minutes of processor time");
    };
    let Score {
        episodes,
        completed,
        reward,
    } = chosen.test;
    let [low, high] = wilson_95(completed, episodes).map(|share| 100.0 * share);
    format!(
        "{completed} of {episodes} completed (95 % interval {low:.0} to {high:.0}), reward {reward:.3}, step {}, \
         {minutes:.1} minutes of processor time for training and evaluations",
        chosen.step
    )
}

/// What a training computed on and in, for people.
fn device(training: &TrainingConfig) -> String {
    let precision = training.precision.on(training.device);
    match training.device {
        Device::Cpu => format!("{}, {precision}", processor()),
        Device::Cuda => format!("a CUDA card beside {}, {precision}", processor()),
    }
}

/// The processor's name.
fn processor() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info
        .lines()
        .find_map(|line| line.strip_prefix("model name")?.split_once(':'))
        .map(|(_, name)| name.trim().to_owned());
    name.unwrap_or_else(|| std::env::consts::ARCH.into())
}

/// Appears whole or not at all: a file there is a run that is done.
pub fn write_whole(path: &Path, text: &str) -> Result<()> {
    let part = path.with_extension("json.part");
    std::fs::write(&part, format!("{text}\n"))
        .and_then(|()| std::fs::rename(&part, path))
        .with_context(|| path.display().to_string())
}

#[cfg(test)]
mod tests {
    use super::part;

    #[test]
    fn a_part_is_below_its_count() {
        assert_eq!(part("1/3"), Ok((1, 3)));
        for wrong in ["3/3", "1", "a/2", "0/0", "-1/2"] {
            assert!(part(wrong).is_err(), "{wrong}");
        }
    }
}
