//! How likely a decision is to earn its step: a logistic model of what the network says of it, fitted on steps that were
//! carried out and stored with the checkpoint.

use serde::{Deserialize, Serialize};

use crate::{Error, ScoreMap};

/// Scores within this distance of a decision's poses count for it. A little more than 4 cells, so that no last bit says whether the
/// cells at that distance count.
const NEAR_PX: f64 = 4.001;
/// Scores within this distance are of the same object: a decision between them is one between its parts.
const ABOUT_PX: f64 = 12.001;
/// The least score that has a logarithm here.
const LEAST: f64 = 1e-6;

/// What a network says of its own decision, as numbers that a [`Calibration`] weighs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// Logarithm of the probability of picking within 4 cells of the heightmap of the pick.
    pub pick: f64,
    /// Logarithm of the probability of placing, turned as decided, within 4 cells of the place.
    pub place: f64,
    /// Logarithm of the odds that the step is done already, from -12 to 12; 0 of a network that does not say so.
    pub done: f64,
    /// Logarithm of the share of the probability of picking within 12 cells of the pick that lies within 4: near 0 where there is one
    /// point to pick an object by, lower where one bead is as good as the next. 0 where a report does not say it.
    #[serde(default)]
    pub pick_focus: f64,
    /// The same of placing, turned as decided.
    #[serde(default)]
    pub place_focus: f64,
}

impl Evidence {
    /// Of a decision. Poses in continuous image coordinates, as (x, y).
    pub(crate) fn new(
        pick: (&ScoreMap, [f64; 2]),
        place: (&ScoreMap, [f64; 2]),
        stride: usize,
        done: Option<f64>,
    ) -> Self {
        let within = |(map, at): (&ScoreMap, [f64; 2]), radius_px: f64| {
            let center = |index: usize| (index as f64 + 0.5) * stride as f64;
            // Rows and columns that may hold such a cell.
            let around = |at: f64, len: usize| {
                let [first, end] = [at - radius_px, at + radius_px].map(|px| px / stride as f64);
                first.max(0.0) as usize..((end + 1.0).max(0.0) as usize).min(len)
            };
            let cells = around(at[1], map.rows)
                .flat_map(|row| around(at[0], map.cols).map(move |col| (row, col)));
            let near = cells.filter(|(row, col)| {
                (center(*col) - at[0]).hypot(center(*row) - at[1]) <= radius_px
            });
            let sum: f64 = near
                .map(|(row, col)| f64::from(map.scores[row * map.cols + col]))
                .sum();
            sum.clamp(LEAST, 1.0).ln()
        };
        let near = [pick, place].map(|scores| within(scores, NEAR_PX));
        let about = [pick, place].map(|scores| within(scores, ABOUT_PX));
        const MOST_ODDS: f64 = 12.0;
        let odds = |share: f64| (share / (1.0 - share)).ln().clamp(-MOST_ODDS, MOST_ODDS);
        Self {
            pick: near[0],
            place: near[1],
            done: done.map_or(0.0, odds),
            pick_focus: near[0] - about[0],
            place_focus: near[1] - about[1],
        }
    }

    fn features(&self) -> [f64; FEATURES] {
        let Self {
            pick,
            place,
            done,
            pick_focus,
            place_focus,
        } = *self;
        [1.0, pick, place, done, pick_focus, place_focus]
    }
}

const FEATURES: usize = 6;

/// Logistic regression from [`Evidence`] to the probability that a step earns its reward (Platt, 1999).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// Constant, then weights of pick, place, done, pick focus and place focus. Those that an older file leaves out are 0.
    #[serde(deserialize_with = "weights")]
    pub weights: [f64; FEATURES],
    /// Steps that it was fitted on.
    pub steps: usize,
}

/// The constant and the weights of pick, place and done: what every file has.
const OLDEST_FEATURES: usize = 4;

fn weights<'de, D: serde::Deserializer<'de>>(source: D) -> Result<[f64; FEATURES], D::Error> {
    let given = Vec::<f64>::deserialize(source)?;
    if !(OLDEST_FEATURES..=FEATURES).contains(&given.len()) {
        let expected = "4 to 6 weights of a calibration";
        return Err(serde::de::Error::invalid_length(given.len(), &expected));
    }
    let mut weights = [0.0; FEATURES];
    weights[..given.len()].copy_from_slice(&given);
    Ok(weights)
}

/// Fewest steps, and fewest of either outcome, that a calibration is fitted on.
const LEAST_STEPS: usize = 50;
const LEAST_OF_EACH: usize = 5;

impl Calibration {
    /// Fits to steps that were carried out and whether each earned a reward: the largest likelihood, with a weak pull of the
    /// weights towards 0, by Newton's method.
    pub fn fit(steps: &[(Evidence, bool)]) -> Result<Self, Error> {
        let earned = steps.iter().filter(|(_, earned)| *earned).count();
        if steps.len() < LEAST_STEPS || earned.min(steps.len() - earned) < LEAST_OF_EACH {
            return Err(Error::Config {
                what: "steps of a calibration",
                actual: format!("{} of which {earned} earned a reward", steps.len()),
                expected: "at least 50, at least 5 with a reward and 5 without",
            });
        }
        const PULL: f64 = 1e-2;
        const ROUNDS: usize = 100;
        let mut weights = nalgebra::SVector::<f64, FEATURES>::zeros();
        for _ in 0..ROUNDS {
            let mut slope = -PULL * weights;
            let mut curvature = nalgebra::SMatrix::<f64, FEATURES, FEATURES>::identity() * PULL;
            for (evidence, earned) in steps {
                let features = nalgebra::SVector::from(evidence.features());
                let probability = logistic(weights.dot(&features));
                slope += features * (f64::from(u8::from(*earned)) - probability);
                curvature += features * features.transpose() * probability * (1.0 - probability);
            }
            // The pull keeps the curvature positive.
            let Some(inverse) = curvature.try_inverse() else {
                break;
            };
            // A whole step may go too far where all is nearly certain.
            const FARTHEST: f64 = 2.0;
            let step = (inverse * slope).cap_magnitude(FARTHEST);
            weights += step;
            if step.norm() < 1e-9 {
                break;
            }
        }
        Ok(Self {
            weights: weights.into(),
            steps: steps.len(),
        })
    }

    /// Probability that the step earns its reward.
    pub fn probability(&self, evidence: &Evidence) -> f64 {
        let terms = self.weights.iter().zip(evidence.features());
        logistic(terms.map(|(weight, feature)| weight * feature).sum())
    }
}

fn logistic(odds: f64) -> f64 {
    (1.0 + (-odds).exp()).recip()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

    #[test]
    fn a_fit_finds_the_probabilities_that_made_the_outcomes() {
        let made = Calibration {
            weights: [1.5, 2.0, 0.7, -0.4, 1.0, -0.6],
            steps: 0,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let steps: Vec<(Evidence, bool)> = (0..20_000)
            .map(|_| {
                let evidence = Evidence {
                    pick: rng.random_range(-3.0..0.0),
                    place: rng.random_range(-3.0..0.0),
                    done: rng.random_range(-5.0..5.0),
                    pick_focus: rng.random_range(-2.0..0.0),
                    place_focus: rng.random_range(-2.0..0.0),
                };
                (evidence, rng.random::<f64>() < made.probability(&evidence))
            })
            .collect();
        let found = Calibration::fit(&steps).unwrap();
        for (found, made) in found.weights.iter().zip(made.weights) {
            assert!((found - made).abs() < 0.15, "{found} for {made}");
        }
        assert_eq!(found.steps, 20_000);
    }

    #[test]
    fn a_calibration_of_fewer_features_says_what_it_said() {
        let older = r#"{"weights": [1.0, 2.0, 3.0, 4.0], "steps": 60}"#;
        let older: Calibration = serde_json::from_str(older).unwrap();
        assert_eq!(older.weights, [1.0, 2.0, 3.0, 4.0, 0.0, 0.0]);
        for weights in ["[1.0, 2.0, 3.0]", "[1, 2, 3, 4, 5, 6, 7]"] {
            let text = format!(r#"{{"weights": {weights}, "steps": 60}}"#);
            let error = serde_json::from_str::<Calibration>(&text).unwrap_err();
            assert!(error.to_string().contains("4 to 6 weights"), "{error}");
        }
    }

    #[test]
    fn a_decision_between_parts_of_an_object_is_less_focused_than_one_between_objects() {
        let map = |cells: &[(usize, f32)]| {
            let mut scores = vec![0.0; 400];
            cells
                .iter()
                .for_each(|(cell, score)| scores[*cell] = *score);
            ScoreMap {
                rows: 20,
                cols: 20,
                scores,
            }
        };
        // The picked cell lies at (10.5, 10.5) of the grid, at stride 2.
        let at = [21.0, 21.0];
        let sure = map(&[(210, 1.0)]);
        let objects = map(&[(210, 0.5), (0, 0.5)]);
        let parts = map(&[(210, 0.5), (214, 0.5)]);
        let evidence = |pick: &ScoreMap| Evidence::new((pick, at), (&sure, at), 2, None);
        let [objects, parts] = [objects, parts].map(|pick| evidence(&pick));
        assert!((objects.pick - parts.pick).abs() < 1e-6 && (parts.pick + 0.693).abs() < 1e-3);
        assert!(objects.pick_focus.abs() < 1e-6 && (parts.pick_focus + 0.693).abs() < 1e-3);
        assert_eq!((parts.place, parts.place_focus), (0.0, 0.0));
    }

    #[test]
    fn outcomes_that_are_all_alike_are_no_calibration() {
        let evidence = Evidence {
            pick: -1.0,
            place: -1.0,
            done: 0.0,
            pick_focus: 0.0,
            place_focus: 0.0,
        };
        let error = Calibration::fit(&vec![(evidence, true); 100]).unwrap_err();
        assert!(error.to_string().contains("100 of which 100"), "{error}");
    }

    #[test]
    fn what_separates_perfectly_stays_finite() {
        let steps: Vec<_> = (0..100)
            .map(|index| {
                let good = index % 2 == 0;
                let pick = if good { -0.01 } else { -5.0 };
                let evidence = Evidence {
                    pick,
                    place: -0.1,
                    done: 0.0,
                    pick_focus: 0.0,
                    place_focus: 0.0,
                };
                (evidence, good)
            })
            .collect();
        let found = Calibration::fit(&steps).unwrap();
        assert!(found.weights.iter().all(|weight| weight.is_finite()));
        let [good, bad] = [0, 1].map(|index: usize| found.probability(&steps[index].0));
        assert!(good > 0.95 && bad < 0.05, "{good} {bad}");
    }
}
