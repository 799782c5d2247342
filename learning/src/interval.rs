//! Confidence intervals of a rate.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Wilson's 95 % score interval of `successes` out of `trials`, as fractions of 1
/// (Wilson, JASA 22, 1927). It stays inside 0..1 and is honest for rates near the ends.
pub fn wilson_95(successes: usize, trials: usize) -> [f64; 2] {
    if trials == 0 {
        return [0.0, 1.0];
    }
    const Z: f64 = 1.959_963_984_540_054;
    let n = trials as f64;
    let rate = successes as f64 / n;
    let denominator = 1.0 + Z * Z / n;
    let center = (rate + Z * Z / (2.0 * n)) / denominator;
    let half = Z / denominator * (rate * (1.0 - rate) / n + Z * Z / (4.0 * n * n)).sqrt();
    [(center - half).max(0.0), (center + half).min(1.0)]
}

/// Resamplings of a bootstrap.
const RESAMPLINGS: usize = 4000;
/// Its seed: the same episodes give the same interval.
const BOOTSTRAP_SEED: u64 = 0;

/// 95 % interval of the mean of `runs`, each the outcomes of one training seed, by a bootstrap that draws training
/// seeds and then episodes of each (percentiles; Efron, 1979). Where all outcomes are alike the bootstrap knows no spread:
/// then it is [`wilson_95`].
pub fn bootstrap_95(runs: &[Vec<bool>]) -> [f64; 2] {
    let runs: Vec<&Vec<bool>> = runs.iter().filter(|run| !run.is_empty()).collect();
    let all = || runs.iter().flat_map(|run| run.iter());
    let (trials, successes) = (all().count(), all().filter(|outcome| **outcome).count());
    if successes == 0 || successes == trials {
        return wilson_95(successes, trials);
    }
    let mut rng = ChaCha8Rng::seed_from_u64(BOOTSTRAP_SEED);
    let mut means: Vec<f64> = (0..RESAMPLINGS)
        .map(|_| {
            let (mut successes, mut trials) = (0, 0);
            for _ in 0..runs.len() {
                let run = runs[rng.random_range(0..runs.len())];
                let drawn = (0..run.len()).filter(|_| run[rng.random_range(0..run.len())]);
                successes += drawn.count();
                trials += run.len();
            }
            successes as f64 / trials as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    let at = |share: f64| means[(share * (RESAMPLINGS - 1) as f64).round() as usize];
    [at(0.025), at(0.975)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seventy_of_a_hundred_leave_nine_points_either_way() {
        let [low, high] = wilson_95(70, 100);
        assert!(
            (low - 0.604).abs() < 0.001 && (high - 0.781).abs() < 0.001,
            "{low} {high}"
        );
    }

    fn outcomes(successes: usize, trials: usize) -> Vec<bool> {
        (0..trials).map(|index| index < successes).collect()
    }

    #[test]
    fn a_bootstrap_of_one_run_agrees_with_the_normal_approximation() {
        let [low, high] = bootstrap_95(&[outcomes(70, 100)]);
        assert!(
            (low - 0.61).abs() < 0.015 && (high - 0.79).abs() < 0.015,
            "{low} {high}"
        );
        assert_eq!([low, high], bootstrap_95(&[outcomes(70, 100)]));
    }

    #[test]
    fn training_seeds_that_differ_widen_a_bootstrap() {
        let alike = bootstrap_95(&[outcomes(35, 50), outcomes(35, 50)]);
        let apart = bootstrap_95(&[outcomes(50, 50), outcomes(20, 50)]);
        assert!(
            apart[1] - apart[0] > 2.0 * (alike[1] - alike[0]),
            "{alike:?} {apart:?}"
        );
    }

    #[test]
    fn a_bootstrap_without_spread_is_not_certain() {
        assert_eq!(bootstrap_95(&[outcomes(50, 50)]), wilson_95(50, 50));
        assert_eq!(bootstrap_95(&[]), [0.0, 1.0]);
    }

    #[test]
    fn all_successes_do_not_prove_certainty() {
        let [low, high] = wilson_95(50, 50);
        assert!((0.9..0.95).contains(&low) && high == 1.0, "{low} {high}");
    }
}
