//! The paper's tables beside ours.

use crate::agent::Agent;
use crate::interval::wilson_95;
use crate::sweep::{RunResult, Score};
use std::collections::BTreeMap;
use std::fmt;

/// Completion in percent of the paper's tables "Single-task results" and "Multi-task results".
const PAPER: &str = include_str!("paper.csv");

/// A completion rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate {
    /// Share of completed episodes.
    pub completion: f64,
    /// Its 95 % interval (Wilson), over the episodes of all seeds.
    pub interval_95: [f64; 2],
}

impl Rate {
    fn of(score: (usize, usize)) -> Self {
        let (completed, episodes) = score;
        Self {
            completion: completed as f64 / episodes.max(1) as f64,
            interval_95: wilson_95(completed, episodes),
        }
    }
}

/// One problem, agent and number of demonstrations.
#[derive(Clone, Debug, PartialEq)]
pub struct Cell {
    /// Name of the problem.
    pub problem: String,
    /// The agent.
    pub agent: Agent,
    /// Number of demonstrations.
    pub demonstrations: usize,
    /// Training seeds.
    pub seeds: usize,
    /// Of the snapshot whose mean over seeds is best on test episodes: as the paper reports it.
    pub best: Rate,
    /// Of each seed's snapshot that is best on validation episodes: what one would get.
    pub chosen: Rate,
    /// The paper's rate.
    pub paper: Option<f64>,
    /// What agents of the same settings trained on the single tasks would reach together: the product of their
    /// best rates. Of multi-task problems, where all of them were run.
    pub expected: Option<f64>,
    /// Mean test completion after each snapshot's gradient steps.
    pub curve: Vec<(u64, f64)>,
}

impl Cell {
    /// More than 10 points above what is expected (the paper's dagger).
    pub fn beats_expectation(&self) -> bool {
        self.expected
            .is_some_and(|expected| self.best.completion > expected + 0.1)
    }
}

/// All cells that there are results for, in the order of the paper's tables.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// Its cells.
    pub cells: Vec<Cell>,
}

fn paper(problem: &str, agent: Agent, demonstrations: usize) -> Option<f64> {
    let start = format!("{problem},{},{demonstrations},", agent.slug());
    let rest = PAPER.lines().find_map(|line| line.strip_prefix(&start))?;
    let percent: f64 = rest.split(',').next()?.parse().ok()?;
    Some(percent / 100.0)
}

/// Rank of a problem in the paper; others come last, by name.
fn rank(problem: &str) -> usize {
    let start = format!("{problem},");
    PAPER
        .lines()
        .position(|line| line.starts_with(&start))
        .unwrap_or(usize::MAX)
}

fn add(sum: &mut (usize, usize), score: Score) {
    sum.0 += score.completed;
    sum.1 += score.episodes;
}

impl Table {
    /// Puts results together. `modules` names the task modules of a problem.
    pub fn new(results: &[RunResult], modules: impl Fn(&str) -> Vec<String>) -> Self {
        let mut groups: BTreeMap<(usize, String, usize, Agent), Vec<&RunResult>> = BTreeMap::new();
        for result in results {
            let problem = result.problem.clone();
            let key = (rank(&problem), problem, result.demonstrations, result.agent);
            groups.entry(key).or_default().push(result);
        }
        let mut cells: Vec<Cell> = Vec::new();
        for ((_, problem, demonstrations, agent), runs) in groups {
            let mut by_step: BTreeMap<u64, (usize, usize)> = BTreeMap::new();
            let mut chosen = (0, 0);
            for run in &runs {
                for snapshot in &run.snapshots {
                    add(by_step.entry(snapshot.step).or_default(), snapshot.test);
                }
                if let Some(snapshot) = run.chosen() {
                    add(&mut chosen, snapshot.test);
                }
            }
            let curve: Vec<_> = by_step
                .iter()
                .map(|(step, score)| (*step, Rate::of(*score).completion))
                .collect();
            let best = by_step
                .values()
                .copied()
                .map(Rate::of)
                .max_by(|a, b| a.completion.total_cmp(&b.completion));
            let Some(best) = best else { continue };
            cells.push(Cell {
                paper: paper(&problem, agent, demonstrations),
                problem,
                agent,
                demonstrations,
                seeds: runs.len(),
                best,
                chosen: Rate::of(chosen),
                expected: None,
                curve,
            });
        }
        let single: Vec<Cell> = cells.clone();
        for cell in &mut cells {
            let modules = modules(&cell.problem);
            if modules.len() < 2 {
                continue;
            }
            let alone = |module: &String| {
                let same = |other: &&Cell| {
                    other.problem == *module
                        && other.agent == cell.agent.single_task()
                        && other.demonstrations == cell.demonstrations
                };
                single.iter().find(same).map(|cell| cell.best.completion)
            };
            cell.expected = modules.iter().map(alone).product();
        }
        Self { cells }
    }
}

/// In Markdown, percent.
impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "| problem | demonstrations | agent | paper | ours, best snapshot (95 %) | ours, chosen on validation (95 %) | expected of single-task agents | seeds |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|")?;
        let percent = |rate: Option<f64>| {
            rate.map_or_else(String::new, |rate| format!("{:.1}", 100.0 * rate))
        };
        for cell in &self.cells {
            let rate = |rate: Rate| {
                let [low, high] = rate.interval_95.map(|bound| 100.0 * bound);
                format!("{:.1} ({low:.0} to {high:.0})", 100.0 * rate.completion)
            };
            writeln!(
                f,
                "| {} | {} | {} | {} | {}{} | {} | {} | {} |",
                cell.problem,
                cell.demonstrations,
                cell.agent,
                percent(cell.paper),
                rate(cell.best),
                if cell.beats_expectation() { "†" } else { "" },
                rate(cell.chosen),
                percent(cell.expected),
                cell.seeds,
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::Recipe;
    use crate::sweep::{SnapshotResult, Test};
    use std::path::Path;

    fn result(problem: &str, agent: Agent, seed: u64, tests: [usize; 2]) -> RunResult {
        let recipe = "../config/recipes/placing.yaml";
        let recipe = Recipe::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join(recipe)).unwrap();
        let score = |completed| Score {
            episodes: 20,
            completed,
            reward: 0.5,
        };
        // Validation always prefers the first snapshot.
        let snapshot = |(index, completed): (usize, usize)| SnapshotResult {
            step: 100 * (index as u64 + 1),
            pick_loss: 1.0,
            place_loss: 1.0,
            validation: score(10 - index),
            test: score(completed),
        };
        RunResult {
            problem: problem.into(),
            agent,
            demonstrations: 10,
            seed,
            recipe,
            test: Test {
                episodes: 20,
                seed: 10_000,
            },
            cpu_seconds: 1.0,
            device: "a processor".into(),
            snapshots: tests.into_iter().enumerate().map(snapshot).collect(),
        }
    }

    #[test]
    fn the_papers_numbers_are_found() {
        assert_eq!(paper("placing", Agent::Sctn, 1), Some(0.94));
        assert_eq!(paper("routing", Agent::GctnStep, 100), Some(0.78));
        assert_eq!(
            paper("placing_stacking_routing", Agent::SctnUnifStep, 10),
            Some(0.425)
        );
        assert_eq!(paper("placing", Agent::SctnUnifStep, 10), None);
        // 4 problems with 4 agents and 6 with 6, at 4 numbers of demonstrations.
        assert_eq!(PAPER.lines().count(), 1 + (4 * 4 + 6 * 6) * 4);
    }

    #[test]
    fn the_best_snapshot_is_best_on_the_mean_over_seeds_and_the_chosen_one_is_each_seeds_own() {
        let runs = [
            result("placing", Agent::Sctn, 0, [20, 10]),
            result("placing", Agent::Sctn, 1, [2, 16]),
        ];
        let table = Table::new(&runs, |problem| vec![problem.into()]);
        let [cell] = &table.cells[..] else {
            panic!("{table:?}");
        };
        assert_eq!((cell.seeds, cell.paper), (2, Some(1.0)));
        assert_eq!(cell.best.completion, 26.0 / 40.0);
        assert_eq!(cell.chosen.completion, 22.0 / 40.0);
        assert_eq!(cell.curve, [(100, 0.55), (200, 0.65)]);
        assert_eq!(cell.expected, None);
    }

    #[test]
    fn what_is_expected_is_the_product_of_the_single_tasks_and_beating_it_is_marked() {
        let runs = [
            result("placing", Agent::SctnStep, 0, [20, 18]),
            result("routing", Agent::SctnStep, 0, [5, 10]),
            result("placing_routing", Agent::SctnUnifStep, 0, [13, 4]),
            result("placing_chaining", Agent::SctnUnifStep, 0, [13, 4]),
        ];
        let modules = |problem: &str| problem.split('_').map(str::to_owned).collect();
        let table = Table::new(&runs, modules);
        let of = |problem: &str| table.cells.iter().find(|cell| cell.problem == problem);
        let joint = of("placing_routing").unwrap();
        assert_eq!(joint.expected, Some(0.5));
        assert!(joint.beats_expectation());
        // Nobody ran chaining alone.
        assert_eq!(of("placing_chaining").unwrap().expected, None);
        let text = table.to_string();
        assert!(
            text.contains("| placing_routing | 10 | SCTN-Unif-Step | 50.0 | 65.0 (43 to 82)† |"),
            "{text}"
        );
        // As in the paper: single tasks first.
        assert!(text.find("| routing").unwrap() < text.find("| placing_routing").unwrap());
    }
}
