//! Search of a task module's step weights by black-box optimisation (paper, appendix "Determining Sampling Weights").
//!
//! The optimiser is a tree-structured Parzen estimator (Bergstra et al., NIPS 2011): the scheme first, then the largest
//! weight of that scheme.

use crate::recipe::Recipe;
use crate::sampling::StepWeights;
use crate::sweep::Score;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use tpe::density_estimation::DefaultEstimatorBuilder;
use tpe::{TpeOptimizer, TpeOptimizerBuilder};

/// Largest weights that are tried (paper).
const MAX_WEIGHTS: [f64; 2] = [1.5, 5.0];
/// Trials that are drawn uniformly, before there is anything to learn from.
const FIRST_TRIALS: usize = 6;
/// Share of trials that count as good.
const GOOD: f64 = 0.25;
/// Worth of a reward beside a completion rate: it decides between equal rates.
const REWARD: f64 = 0.01;

/// A snapshot of a trial's training, on the validation episodes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrialSnapshot {
    /// Gradient steps.
    pub step: u64,
    /// How it did.
    pub validation: Score,
}

/// A training with weights that were tried: one JSON file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// From 0.
    pub number: usize,
    /// Seed of the search.
    pub search_seed: u64,
    /// The weights.
    pub steps: StepWeights,
    /// Completion rate and reward of the best snapshot: the paper's objective is the rate.
    pub best: Score,
    /// Gradient steps of the first snapshot with that rate: the inferred complexity.
    pub complexity: u64,
    /// All that made it.
    pub recipe: Recipe,
    /// Processor time; of a resumed training, since it was resumed.
    pub cpu_seconds: f64,
    /// In order of their steps.
    pub snapshots: Vec<TrialSnapshot>,
}

impl Trial {
    /// What came of a training. None without snapshots.
    pub fn new(
        number: usize,
        search_seed: u64,
        steps: StepWeights,
        recipe: Recipe,
        cpu_seconds: f64,
        snapshots: Vec<TrialSnapshot>,
    ) -> Option<Self> {
        let completion = |snapshot: &&TrialSnapshot| snapshot.validation.completed;
        // The first of the best: `max_by_key` gives the last.
        let best = snapshots.iter().rev().max_by_key(completion)?;
        let (best, complexity) = (best.validation, best.step);
        Some(Self {
            number,
            search_seed,
            steps,
            best,
            complexity,
            recipe,
            cpu_seconds,
            snapshots,
        })
    }

    /// The larger, the better.
    pub fn objective(&self) -> f64 {
        // Rounded: the last bits do not survive every JSON parser.
        let value = self.best.completion() + REWARD * self.best.reward;
        (value * 1e6).round() / 1e6
    }
}

/// Why a search cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SearchError {
    /// The optimiser refused.
    #[error("the optimiser: {0}")]
    Optimiser(String),
    /// Weights of no scheme that is searched.
    #[error("{0:?}: expected linear, last or first_last with a max_weight from 1.5 to 5")]
    Weights(StepWeights),
}

/// A search under way. Trial `n` is drawn from stream `n` of the seed's random numbers and the trials before, so that a resumed
/// search asks what an uninterrupted one would have.
#[derive(Debug)]
pub struct Search {
    seed: u64,
    told: usize,
    scheme: TpeOptimizer<DefaultEstimatorBuilder>,
    /// Of each scheme.
    max_weights: Vec<TpeOptimizer<DefaultEstimatorBuilder>>,
}

type Scheme = fn(f64) -> StepWeights;

/// The schemes of the paper.
const SCHEMES: [Scheme; 3] = [
    |max_weight| StepWeights::Linear { max_weight },
    |max_weight| StepWeights::Last { max_weight },
    |max_weight| StepWeights::FirstLast { max_weight },
];

/// Index of the scheme, and largest weight.
fn scheme(weights: StepWeights) -> Option<(usize, f64)> {
    match weights {
        StepWeights::Uniform => None,
        StepWeights::Linear { max_weight } => Some((0, max_weight)),
        StepWeights::Last { max_weight } => Some((1, max_weight)),
        StepWeights::FirstLast { max_weight } => Some((2, max_weight)),
    }
}

fn refused(error: impl std::fmt::Display) -> SearchError {
    SearchError::Optimiser(error.to_string())
}

impl Search {
    /// Before the first trial.
    pub fn new(seed: u64) -> Result<Self, SearchError> {
        let mut builder = TpeOptimizerBuilder::new();
        builder.gamma(GOOD);
        let range = tpe::categorical_range(SCHEMES.len()).map_err(refused)?;
        // The most promising of many candidates would be the same scheme for ever; one is a draw by how good they were.
        let mut draw = TpeOptimizerBuilder::new();
        let scheme = draw
            .gamma(GOOD)
            .candidates(1)
            .build(tpe::histogram_estimator(), range)
            .map_err(refused)?;
        let max_weight = |_| {
            let range = tpe::range(MAX_WEIGHTS[0], MAX_WEIGHTS[1]).map_err(refused)?;
            builder
                .build(tpe::parzen_estimator(), range)
                .map_err(refused)
        };
        Ok(Self {
            seed,
            told: 0,
            scheme,
            max_weights: (0..SCHEMES.len())
                .map(max_weight)
                .collect::<Result<_, _>>()?,
        })
    }

    /// The weights to try next.
    pub fn ask(&mut self) -> Result<StepWeights, SearchError> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(self.told as u64);
        let index = if self.told < FIRST_TRIALS {
            self.told % SCHEMES.len()
        } else {
            self.scheme.ask(&mut rng).map_err(refused)? as usize
        };
        let index = index.min(SCHEMES.len() - 1);
        let max_weight = self.max_weights[index].ask(&mut rng).map_err(refused)?;
        // Two decimals, as in the paper; they survive every JSON parser.
        let max_weight = (max_weight * 100.0).round() / 100.0;
        // The range excludes its end.
        Ok(SCHEMES[index](max_weight.min(MAX_WEIGHTS[1] - 0.01)))
    }

    /// What came of the weights asked for last: the larger, the better.
    pub fn tell(&mut self, weights: StepWeights, objective: f64) -> Result<(), SearchError> {
        let known = scheme(weights)
            .filter(|(_, max_weight)| (MAX_WEIGHTS[0]..MAX_WEIGHTS[1]).contains(max_weight));
        let (index, max_weight) = known.ok_or(SearchError::Weights(weights))?;
        // The optimiser looks for the least.
        let scheme = self.scheme.tell(index as f64, -objective);
        scheme.map_err(refused)?;
        let max_weights = self.max_weights[index].tell(max_weight, -objective);
        max_weights.map_err(refused)?;
        self.told += 1;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Best by far at linear weights up to 2.76, as the paper found for placing.
    fn objective(weights: StepWeights) -> f64 {
        match weights {
            StepWeights::Linear { max_weight } => 1.0 - 0.1 * (max_weight - 2.76).powi(2),
            StepWeights::Last { max_weight } => 0.8 - 0.1 * (max_weight - 2.0).powi(2),
            _ => 0.7,
        }
    }

    fn searched(seed: u64, trials: usize) -> Vec<StepWeights> {
        let mut search = Search::new(seed).unwrap();
        (0..trials)
            .map(|_| {
                let weights = search.ask().unwrap();
                search.tell(weights, objective(weights)).unwrap();
                weights
            })
            .collect()
    }

    #[test]
    fn the_optimum_is_found_and_looked_at_most() {
        for seed in 0..5 {
            let trials = searched(seed, 60);
            let best = trials
                .iter()
                .copied()
                .max_by(|a, b| objective(*a).total_cmp(&objective(*b)));
            let Some(StepWeights::Linear { max_weight }) = best else {
                panic!("{best:?}");
            };
            assert!((max_weight - 2.76).abs() < 0.1, "seed {seed}: {max_weight}");
            // Half of what came after the first trials; a third would be chance.
            let linear = |weights: &&StepWeights| matches!(weights, StepWeights::Linear { .. });
            let count = trials[FIRST_TRIALS..].iter().filter(linear).count();
            assert!(count >= 27, "seed {seed}: {count} of 54");
        }
    }

    #[test]
    fn a_resumed_search_asks_what_an_uninterrupted_one_would_have() {
        let whole = searched(3, 20);
        let mut resumed = Search::new(3).unwrap();
        for weights in &whole[..12] {
            resumed.tell(*weights, objective(*weights)).unwrap();
        }
        for weights in &whole[12..] {
            assert_eq!(resumed.ask().unwrap(), *weights);
            resumed.tell(*weights, objective(*weights)).unwrap();
        }
        assert_ne!(whole, searched(4, 20));
    }

    #[test]
    fn the_complexity_is_the_first_snapshot_that_reaches_the_best_rate() {
        let snapshot = |step, completed| TrialSnapshot {
            step,
            validation: Score {
                episodes: 20,
                completed,
                reward: 0.9,
            },
        };
        let recipe = || {
            let path = "../config/recipes/placing.yaml";
            let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
            Recipe::load(&path).unwrap()
        };
        let trial = |snapshots| Trial::new(0, 0, StepWeights::Uniform, recipe(), 0.0, snapshots);
        let snapshots = vec![snapshot(100, 7), snapshot(200, 18), snapshot(300, 18)];
        let trial_of_three = trial(snapshots).unwrap();
        assert_eq!(trial_of_three.complexity, 200);
        assert_eq!(trial_of_three.best.completion(), 0.9);
        assert_eq!(trial_of_three.objective(), 0.909);
        assert!(trial(Vec::new()).is_none());
    }

    #[test]
    fn weights_that_are_not_searched_are_refused() {
        let mut search = Search::new(0).unwrap();
        for weights in [
            StepWeights::Uniform,
            StepWeights::Last { max_weight: 7.0 },
            StepWeights::Last {
                max_weight: f64::NAN,
            },
        ] {
            assert!(matches!(
                search.tell(weights, 0.5),
                Err(SearchError::Weights(_))
            ));
        }
    }
}
