//! Sweeps: the same training for many problems, agents, numbers of demonstrations and seeds (paper, section VI).

use crate::agent::Agent;
use crate::data_set::Shown;
use crate::images::ImageMemory;
use crate::recipe::{Demonstrations, Recipe, RecipeError, Validation, check_field, read_yaml};
use gctn::{NetworkConfig, TrainingConfig};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// What to train and to test: every problem with every agent, number of demonstrations and seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sweep {
    /// Names of problems.
    pub problems: Vec<String>,
    /// Agents of the paper. On single-task problems, where modules cannot be weighed against each other,
    /// -Unif-Step and -Comp-Step are -Step.
    pub agents: Vec<Agent>,
    /// Numbers of demonstrations.
    pub demonstrations: Vec<usize>,
    /// Training seeds.
    pub seeds: Vec<u64>,
    /// The network; each agent sets its conditioning.
    pub network: NetworkConfig,
    /// The training. `steps` are those of each task module, as in the paper; each run sets its seed.
    pub training: TrainingConfig,
    /// As in a recipe.
    #[serde(default)]
    pub goal_jitter: f64,
    /// Number of snapshots of a run, evenly spread.
    pub snapshots: u64,
    /// Episodes that choose a snapshot.
    pub validation: Validation,
    /// Episodes that every snapshot is tested on.
    pub test: Test,
}

/// Test episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Test {
    /// Episodes for every snapshot.
    pub episodes: usize,
    /// Seed of the first episode; 10,000 or more.
    pub seed: u64,
}

/// One training of a sweep.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// Name of the problem.
    pub problem: String,
    /// The agent.
    pub agent: Agent,
    /// Number of demonstrations.
    pub demonstrations: usize,
    /// Training seed.
    pub seed: u64,
}

impl Run {
    /// Its name, as that of its file and folder.
    pub fn slug(&self) -> String {
        let Self {
            problem,
            agent,
            demonstrations,
            seed,
        } = self;
        format!("{problem}-{}-{demonstrations}-{seed}", agent.slug())
    }
}

/// How a snapshot did on the episodes of a problem.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// Episodes.
    pub episodes: usize,
    /// Episodes in which every module was completed.
    pub completed: usize,
    /// Mean reward.
    pub reward: f64,
}

impl Score {
    /// Share of completed episodes; 0 of none.
    pub fn completion(&self) -> f64 {
        self.completed as f64 / self.episodes.max(1) as f64
    }
}

/// A snapshot of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SnapshotResult {
    /// Gradient steps.
    pub step: u64,
    /// Mean pick loss since the snapshot before.
    pub pick_loss: f64,
    /// Mean place loss since the snapshot before.
    pub place_loss: f64,
    /// On validation episodes.
    pub validation: Score,
    /// On test episodes.
    pub test: Score,
}

/// What came of a run: one JSON file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunResult {
    /// Name of the problem.
    pub problem: String,
    /// The agent.
    pub agent: Agent,
    /// Number of demonstrations.
    pub demonstrations: usize,
    /// Training seed.
    pub seed: u64,
    /// All that made it.
    pub recipe: Recipe,
    /// The test episodes.
    pub test: Test,
    /// Processor time of training and evaluation; of a resumed run, since it was resumed.
    pub cpu_seconds: f64,
    /// What it ran on.
    pub device: String,
    /// In order of their steps.
    pub snapshots: Vec<SnapshotResult>,
}

impl RunResult {
    /// The snapshot that is best on validation episodes: by completion, reward, then step.
    pub fn chosen(&self) -> Option<&SnapshotResult> {
        let rank = |snapshot: &SnapshotResult| {
            let score = snapshot.validation;
            (score.completion(), score.reward, snapshot.step)
        };
        self.snapshots.iter().max_by(|a, b| {
            rank(a)
                .partial_cmp(&rank(b))
                .unwrap_or(std::cmp::Ordering::Equal)
        })
    }
}

impl Sweep {
    /// Reads and checks a sweep.
    pub fn load(path: &Path) -> Result<Self, RecipeError> {
        let sweep: Self = read_yaml(path)?;
        let field = |field, good, value, expected| check_field(path, field, good, value, expected);
        let some = "at least one";
        let Self {
            problems,
            agents,
            demonstrations,
            seeds,
            test,
            ..
        } = &sweep;
        field("problems", !problems.is_empty(), "empty".into(), some)?;
        field("agents", !agents.is_empty(), "empty".into(), some)?;
        field(
            "demonstrations",
            !demonstrations.is_empty(),
            "empty".into(),
            some,
        )?;
        field("seeds", !seeds.is_empty(), "empty".into(), some)?;
        let good = test.seed >= 10_000;
        field("test.seed", good, test.seed.to_string(), "10,000 or more")?;
        let good = test.episodes > 0;
        field(
            "test.episodes",
            good,
            test.episodes.to_string(),
            "at least 1",
        )?;
        for run in sweep.runs(|_| 1) {
            sweep.recipe(&run, 1).check(path)?;
        }
        Ok(sweep)
    }

    /// Every run once, in a fixed order. `modules` tells how many task modules a problem has.
    pub fn runs(&self, modules: impl Fn(&str) -> usize) -> Vec<Run> {
        let mut runs: Vec<Run> = Vec::new();
        for problem in &self.problems {
            let single = modules(problem) == 1;
            for &demonstrations in &self.demonstrations {
                for &agent in &self.agents {
                    let agent = if single { agent.single_task() } else { agent };
                    for &seed in &self.seeds {
                        let problem = problem.clone();
                        let run = Run {
                            problem,
                            agent,
                            demonstrations,
                            seed,
                        };
                        if !runs.contains(&run) {
                            runs.push(run);
                        }
                    }
                }
            }
        }
        runs
    }

    /// The recipe of a run on a problem of so many modules.
    pub fn recipe(&self, run: &Run, modules: usize) -> Recipe {
        Recipe {
            problems: vec![run.problem.clone()],
            demonstrations: Demonstrations::Each(run.demonstrations),
            generated: 0,
            network: NetworkConfig {
                conditioning: run.agent.conditioning(),
                ..self.network.clone()
            },
            start_from: None,
            training: TrainingConfig {
                seed: run.seed,
                steps: self.training.steps * modules as u64,
                ..self.training.clone()
            },
            sampling: run.agent.sampling(),
            draws: BTreeMap::new(),
            goal_jitter: self.goal_jitter,
            shown: Shown::default(),
            decoded_mb: ImageMemory::default().decoded_mb,
            compressed_mb: ImageMemory::default().compressed_mb,
            snapshots: self.snapshots,
            average: 1,
            validation: self.validation.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(name: &str) -> Sweep {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sweeps");
        Sweep::load(&folder.join(name)).unwrap()
    }

    fn shipped() -> Sweep {
        load("paper.yaml")
    }

    #[test]
    fn gctn_and_sctn_have_68_cells_of_the_papers_tables() {
        let runs = ["tables.yaml", "tables_1000.yaml"].map(|name| {
            let runs = load(name).runs(|problem| problem.split('_').count());
            runs.iter().map(Run::slug).collect::<Vec<_>>()
        });
        assert_eq!(runs.each_ref().map(Vec::len), [60, 8]);
        assert!(runs[0].contains(&"stacking_routing-sctn_unif_step-1-0".to_owned()));
        assert!(runs[1].contains(&"routing-sctn_step-1000-0".to_owned()));
    }

    #[test]
    fn the_papers_sweep_has_the_papers_runs() {
        let sweep = shipped();
        let runs = sweep.runs(|problem| problem.split('_').count());
        // 4 single-task problems with 4 agents and 6 multi-task ones with 6, each with 4 numbers of
        // demonstrations and 5 seeds.
        assert_eq!(runs.len(), (4 * 4 + 6 * 6) * 4 * 5);
        let recipe = sweep.recipe(&runs[0], 2);
        assert_eq!(recipe.training.steps, 2 * sweep.training.steps);
        let slugs: std::collections::BTreeSet<_> = runs.iter().map(Run::slug).collect();
        assert_eq!(slugs.len(), runs.len());
    }

    #[test]
    fn single_task_problems_have_no_task_weights() {
        let mut sweep = shipped();
        sweep.problems = vec!["placing".into()];
        sweep.agents = vec![Agent::SctnUnifStep, Agent::SctnCompStep, Agent::SctnStep];
        sweep.demonstrations = vec![10];
        sweep.seeds = vec![0];
        let runs = sweep.runs(|_| 1);
        assert_eq!(runs.len(), 1);
        assert_eq!(runs[0].slug(), "placing-sctn_step-10-0");
    }
}
