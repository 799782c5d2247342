//! `sctn sweep`.

use crate::cluster::{Engine, Jobs};
use crate::progress;
use crate::root::Root;
use crate::train::{Data, Snapshot, decider, train};
use anyhow::{Context, Result, ensure};
use clap::Args;
use cpu_time::ProcessTime;
use gctn::{Device, TrainingConfig};
use learning::{
    Actor, Episodes, Recipe, Run, RunResult, Score, SnapshotResult, Start, Sweep, evaluate,
    wilson_95,
};
use std::fs::{File, TryLockError};
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
    /// Where trainings, validation and tests compute, in place of the sweep's: cpu, cuda or cuda:N
    #[arg(long)]
    device: Option<Device>,
    /// Where to run: here, one run after the other, or each as a job of its own on a cluster whose hosts share all files
    #[arg(long, value_enum, default_value_t)]
    engine: Engine,
    /// GPUs of each run on a cluster, with Ray also fractions [default: 1 where the training's device is cuda, else 0]
    #[arg(long, value_name = "NUMBER")]
    gpus: Option<f64>,
    /// The Python that has the package ray, for --engine ray
    #[arg(long, value_name = "PROGRAM", default_value = "python3")]
    python: PathBuf,
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
        let mut sweep = Sweep::load(&self.sweep)?;
        if let Some(device) = self.device {
            sweep.training.device = device;
        }
        if self.engine == Engine::Local && !self.list {
            sweep.training.device.check()?;
        }
        // Problems are read before anything is trained.
        let mut modules = std::collections::BTreeMap::new();
        for name in &sweep.problems {
            modules.insert(name.clone(), root.problem(name)?.modules().len());
        }
        let (index, count) = self.part;
        let all = sweep.runs(|problem| modules[problem]);
        let total = all.len();
        let runs: Vec<_> = all
            .into_iter()
            .enumerate()
            .skip(index)
            .step_by(count)
            .collect();
        if self.engine != Engine::Local && !self.list {
            let to_do = runs.iter().filter(|(_, run)| !self.file(run).exists());
            let parts = to_do.map(|(index, run)| (run.slug(), format!("{index}/{total}")));
            self.jobs(root, &sweep, parts.collect())?
                .carry_out(self.engine, &self.python)?;
        }
        let mut missing = Vec::new();
        for (number, (_, run)) in runs.iter().enumerate() {
            let slug = run.slug();
            let file = self.file(run);
            let state = if file.exists() { "done" } else { "to do" };
            tracing::info!("run {} of {}: {slug}, {state}", number + 1, runs.len());
            if self.list {
                continue;
            }
            if self.engine == Engine::Local && !file.exists() {
                let recipe = sweep.recipe(run, modules[&run.problem]);
                self.one(root, &sweep, run, recipe)
                    .with_context(|| format!("run {slug}"))?;
            }
            if !file.exists() {
                missing.push(slug);
                continue;
            }
            let name = || file.display().to_string();
            let text = std::fs::read_to_string(&file).with_context(name)?;
            let result = serde_json::from_str(&text).with_context(name)?;
            println!("{slug}: {}", line(&result));
        }
        ensure!(
            missing.is_empty(),
            "{} of {} runs are not done: {}",
            missing.len(),
            runs.len(),
            missing.join(", ")
        );
        Ok(())
    }

    /// A job of `sctn sweep` for each run (its name and its part).
    fn jobs(&self, root: &Root, sweep: &Sweep, parts: Vec<(String, String)>) -> Result<Jobs> {
        let absolute = |path: &Path| -> Result<String> {
            let path = std::path::absolute(path).with_context(|| path.display().to_string())?;
            let text = path.to_str().with_context(|| {
                format!("{}: expected a path in UTF-8 for a cluster", path.display())
            })?;
            Ok(text.to_owned())
        };
        let program = std::env::current_exe().context("path of the program")?;
        let mut command = vec![
            absolute(&program)?,
            "--root".into(),
            absolute(&root.join(""))?,
            "sweep".into(),
            "--sweep".into(),
            absolute(&self.sweep)?,
            "--demos".into(),
            absolute(&self.demos)?,
            "--out".into(),
            absolute(&self.out)?,
        ];
        if let Some(device) = self.device {
            command.extend(["--device".into(), device.to_string()]);
        }
        command.push("--part".into());
        Ok(Jobs {
            command,
            parts,
            cores: sweep.training.threads,
            gpus: self.gpus.unwrap_or(match sweep.training.device {
                Device::Cpu => 0.0,
                Device::Cuda(_) => 1.0,
            }),
            logs: self.out.join("slurm"),
        })
    }

    /// Where the result of a run is written.
    fn file(&self, run: &Run) -> PathBuf {
        self.out.join(format!("{}.json", run.slug()))
    }

    /// Folder of the demonstrations that evaluations show: the same for all runs.
    fn shown(&self) -> PathBuf {
        self.out.join("shown")
    }

    /// Carries out a run that is not done, or goes on with it. Of several processes one does, and the others wait for it.
    fn one(&self, root: &Root, sweep: &Sweep, run: &Run, recipe: Recipe) -> Result<()> {
        let folder = self.out.join("runs").join(run.slug());
        let path = folder.with_extension("lock");
        let name = || path.display().to_string();
        std::fs::create_dir_all(self.out.join("runs")).with_context(name)?;
        let lock = File::create(&path).with_context(name)?;
        match lock.try_lock() {
            Err(TryLockError::WouldBlock) => {
                tracing::info!("another process is at it: waiting for its end");
                lock.lock().with_context(name)?;
            }
            locked => locked.with_context(name)?,
        }
        let file = self.file(run);
        if file.exists() {
            return Ok(());
        }
        let result = self.train_and_test(root, sweep, run, recipe, &folder)?;
        write_whole(&file, &serde_json::to_string_pretty(&result)?)
    }

    fn train_and_test(
        &self,
        root: &Root,
        sweep: &Sweep,
        run: &Run,
        recipe: Recipe,
        folder: &Path,
    ) -> Result<RunResult> {
        let started = ProcessTime::now();
        let resume = folder.join("state.safetensors").exists();
        let snapshots = train(
            root,
            recipe.clone(),
            Data {
                demos: std::slice::from_ref(&self.demos),
                held_out: &[],
            },
            folder,
            &self.shown(),
            resume,
            None,
        )?;
        let problem = root.problem(&run.problem)?;
        let work_cell = root.work_cell()?;
        let score = |snapshot: &Snapshot, seed: u64, episodes: usize| -> Result<Score> {
            gctn::set_threads(1);
            let mut actors = (0..recipe.training.threads)
                .map(|_| Ok(Actor::from(decider(&snapshot.checkpoint, &recipe)?)))
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
        Device::Cuda(_) => format!("a CUDA card beside {}, {precision}", processor()),
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
