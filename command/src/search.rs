//! `sctn search`.

use crate::root::Root;
use crate::sweep::write_whole;
use crate::train::{Data, train};
use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use cpu_time::ProcessTime;
use learning::{ModuleWeights, Recipe, Sampling, Score, Search, StepWeights, Trial, TrialSnapshot};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Arguments of `sctn search`.
#[derive(Args)]
pub struct SearchCommand {
    /// Recipe of one problem with one task module, with validation episodes; every trial sets its sampling
    #[arg(long)]
    recipe: PathBuf,
    /// Folder that `sctn demos` wrote
    #[arg(long)]
    demos: PathBuf,
    /// Folder for one JSON file a trial, and below trials/ the trainings. A search that was stopped goes on
    #[arg(long)]
    out: PathBuf,
    /// Trials in all, those already there among them
    #[arg(long)]
    trials: usize,
    /// Seed of the search; that of the trainings is in the recipe
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

impl SearchCommand {
    pub fn run(self, root: &Root) -> Result<()> {
        let recipe = Recipe::load(&self.recipe)?;
        let shown = self.recipe.display();
        let [name] = recipe.problems.as_slice() else {
            bail!("{shown}: problems are {:?}, expected one", recipe.problems);
        };
        let problem = root.problem(name)?;
        let [module] = problem.modules() else {
            let count = problem.modules().len();
            bail!("{shown}: {name} has {count} task modules, expected one");
        };
        let module = module.name.to_owned();
        ensure!(
            recipe.validation.episodes > 0,
            "{shown}: validation.episodes is 0, expected at least 1: trials are compared by them"
        );
        std::fs::create_dir_all(&self.out).with_context(|| self.out.display().to_string())?;
        let mut search = Search::new(self.seed)?;
        let mut trials = Vec::new();
        for number in 0..self.trials {
            let file = self.out.join(format!("{number:03}.json"));
            let steps = search.ask()?;
            let recipe = with_weights(&recipe, &module, steps);
            let trial = if file.exists() {
                read(&file, self.seed, steps, &recipe)?
            } else {
                let trial = self.one(root, number, steps, recipe);
                let trial = trial.with_context(|| format!("trial {number}"))?;
                write_whole(&file, &serde_json::to_string_pretty(&trial)?)?;
                trial
            };
            tracing::info!("{}", line(&trial));
            search.tell(steps, trial.objective())?;
            trials.push(trial);
        }
        // The first of equals.
        let best = trials
            .iter()
            .rev()
            .max_by(|a, b| a.objective().total_cmp(&b.objective()))
            .context("--trials is 0, expected at least 1")?;
        if self.json {
            println!(
                "{}",
                serde_json::json!({ "best": best, "trials": trials.len() })
            );
            return Ok(());
        }
        for trial in &trials {
            println!("{}", line(trial));
        }
        println!("best: {}", line(best));
        let modules =
            serde_json::json!({ module: { "weight": best.complexity, "steps": best.steps } });
        println!("sampling: {{weighting: modules, modules: {modules}}}");
        Ok(())
    }

    fn one(&self, root: &Root, number: usize, steps: StepWeights, recipe: Recipe) -> Result<Trial> {
        let started = ProcessTime::now();
        let folder = self.out.join("trials").join(format!("{number:03}"));
        let resume = folder.join("state.safetensors").exists();
        let shown = self.out.join("shown");
        let data = Data {
            demos: std::slice::from_ref(&self.demos),
            held_out: &[],
        };
        let snapshots = train(root, recipe.clone(), data, &folder, &shown, resume, None)?;
        let episodes = recipe.validation.episodes;
        let first = |rates: &BTreeMap<String, f64>| rates.values().next().copied().unwrap_or(0.0);
        let snapshots = snapshots.iter().map(|snapshot| TrialSnapshot {
            step: snapshot.step,
            validation: Score {
                episodes,
                completed: (first(&snapshot.completion) * episodes as f64).round() as usize,
                reward: first(&snapshot.reward),
            },
        });
        let cpu_seconds = started.elapsed().as_secs_f64();
        let snapshots = snapshots.collect();
        Trial::new(number, self.seed, steps, recipe, cpu_seconds, snapshots)
            .context("no snapshot was taken")
    }
}

/// The recipe with the step weights of a trial.
fn with_weights(recipe: &Recipe, module: &str, steps: StepWeights) -> Recipe {
    let weights = ModuleWeights { weight: 1.0, steps };
    Recipe {
        sampling: Sampling::Modules {
            modules: BTreeMap::from([(module.to_owned(), weights)]),
        },
        ..recipe.clone()
    }
}

/// A trial that is done. Refuses one of another search.
fn read(file: &Path, seed: u64, steps: StepWeights, recipe: &Recipe) -> Result<Trial> {
    let name = || file.display().to_string();
    let text = std::fs::read_to_string(file).with_context(name)?;
    let trial: Trial = serde_json::from_str(&text).with_context(name)?;
    ensure!(
        (trial.search_seed, trial.steps) == (seed, steps) && trial.recipe == *recipe,
        "{}: a trial of another recipe or seed; name another folder",
        file.display()
    );
    Ok(trial)
}

/// One line for a person.
fn line(trial: &Trial) -> String {
    let (scheme, max_weight) = match trial.steps {
        StepWeights::Uniform => ("uniform", 1.0),
        StepWeights::Linear { max_weight } => ("linear", max_weight),
        StepWeights::Last { max_weight } => ("last", max_weight),
        StepWeights::FirstLast { max_weight } => ("first_last", max_weight),
    };
    format!(
        "trial {:3}: {scheme:10} {max_weight:.2}: completion {:5.1} %, reward {:.3}, complexity {} steps",
        trial.number,
        100.0 * trial.best.completion(),
        trial.best.reward,
        trial.complexity
    )
}
