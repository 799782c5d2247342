//! Weighted sampling of training steps: demonstration, then task module, then step (paper, section IV-B).

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;

/// How the steps of one task module within a demonstration are weighted (paper, appendix
/// "Determining Sampling Weights"). The smallest weight is 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "scheme", rename_all = "snake_case", deny_unknown_fields)]
pub enum StepWeights {
    /// Every step alike.
    Uniform,
    /// From 1 at the first step to `max_weight` at the last, linearly.
    Linear {
        /// Weight of the last step.
        max_weight: f64,
    },
    /// The last step `max_weight`, the others 1.
    Last {
        /// Weight of the last step.
        max_weight: f64,
    },
    /// First and last step `max_weight`, the others 1.
    FirstLast {
        /// Weight of the first and of the last step.
        max_weight: f64,
    },
}

impl StepWeights {
    /// The weight of step `index` of `len`.
    pub fn weight(&self, index: usize, len: usize) -> f64 {
        let last = index + 1 == len;
        match *self {
            Self::Uniform => 1.0,
            Self::Linear { max_weight } if len > 1 => {
                1.0 + (max_weight - 1.0) * index as f64 / (len - 1) as f64
            }
            Self::Linear { max_weight } => max_weight,
            Self::Last { max_weight } => {
                if last {
                    max_weight
                } else {
                    1.0
                }
            }
            Self::FirstLast { max_weight } => {
                if last || index == 0 {
                    max_weight
                } else {
                    1.0
                }
            }
        }
    }

    fn max_weight(&self) -> f64 {
        match *self {
            Self::Uniform => 1.0,
            Self::Linear { max_weight }
            | Self::Last { max_weight }
            | Self::FirstLast { max_weight } => max_weight,
        }
    }
}

/// Weights of one task module.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModuleWeights {
    /// Weight of the module against the others, for instance its inferred complexity.
    pub weight: f64,
    /// Weights of its steps.
    pub steps: StepWeights,
}

/// Which training step is drawn how often.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
#[serde(tag = "weighting", rename_all = "snake_case", deny_unknown_fields)]
pub enum Sampling {
    /// All steps of a demonstration alike, as in the plain agents.
    #[default]
    Plain,
    /// Steps by the paper's step weights, as in the agents -Step; modules only by how many steps they have.
    Step,
    /// First a module, all alike, then a step by the paper's step weights, as in the agents -Unif-Step.
    UnifStep,
    /// First a module by the paper's inferred complexity, then a step by the paper's step weights, as in the
    /// agents -Comp-Step.
    CompStep,
    /// First a module, then a step within it, by these weights.
    Modules {
        /// By name of the module.
        modules: BTreeMap<String, ModuleWeights>,
    },
}

/// A sampling that cannot be used.
#[derive(Debug, thiserror::Error, PartialEq)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum SamplingError {
    /// A weight is not a finite number of the allowed range.
    #[error(
        "sampling.modules.{module}.{field} is {value}, expected a finite number of at least {at_least}"
    )]
    Weight {
        module: String,
        field: &'static str,
        value: f64,
        at_least: f64,
    },
    /// A demonstration holds a module without weights.
    #[error("sampling has no weights for the module {module} of the demonstrations")]
    UnknownModule { module: String },
    /// There is nothing to draw from.
    #[error("a demonstration without steps cannot be sampled")]
    Empty,
}

impl Sampling {
    /// Checks the ranges of all weights.
    pub fn validate(&self) -> Result<(), SamplingError> {
        let Self::Modules { modules } = self else {
            return Ok(());
        };
        for (module, weights) in modules {
            let refuse = |field, value, at_least| SamplingError::Weight {
                module: module.clone(),
                field,
                value,
                at_least,
            };
            if !(weights.weight.is_finite() && weights.weight > 0.0) {
                return Err(refuse("weight", weights.weight, f64::MIN_POSITIVE));
            }
            let max = weights.steps.max_weight();
            if !(max.is_finite() && max >= 1.0) {
                return Err(refuse("steps.max_weight", max, 1.0));
            }
        }
        Ok(())
    }

    /// Draws a step of a demonstration whose steps belong to the modules named, in order.
    pub fn draw<R: Rng>(
        &self,
        modules_of_steps: &[String],
        rng: &mut R,
    ) -> Result<usize, SamplingError> {
        if modules_of_steps.is_empty() {
            return Err(SamplingError::Empty);
        }
        if *self == Self::Plain {
            return Ok(rng.random_range(0..modules_of_steps.len()));
        }
        let spans = spans(modules_of_steps);
        let mut weights = Vec::with_capacity(spans.len());
        for (module, _) in &spans {
            let weight = self.weights(module);
            weights.push(weight.ok_or_else(|| SamplingError::UnknownModule {
                module: (*module).into(),
            })?);
        }
        let step_weights = |chosen: usize| {
            let (len, steps) = (spans[chosen].1.len(), weights[chosen].steps);
            (0..len).map(move |index| steps.weight(index, len))
        };
        if *self == Self::Step {
            return Ok(draw_weighted((0..spans.len()).flat_map(step_weights), rng));
        }
        let chosen = draw_weighted(weights.iter().map(|module| module.weight), rng);
        Ok(spans[chosen].1.start + draw_weighted(step_weights(chosen), rng))
    }

    /// Weights of a module, where there are any for it.
    fn weights(&self, module: &str) -> Option<ModuleWeights> {
        match self {
            Self::Modules { modules } => modules.get(module).copied(),
            Self::CompStep => published(module),
            Self::Plain | Self::Step | Self::UnifStep => published(module).map(|weights| {
                let weight = 1.0;
                ModuleWeights { weight, ..weights }
            }),
        }
    }
}

/// The paper's weights of its four modules: inferred complexity in thousands of gradient steps, and what the
/// search of its appendix found for the steps (paper, table "Hyperparameters for weighted sampling"). *arranging* is none of
/// them: as complex as *placing*, its steps alike.
fn published(module: &str) -> Option<ModuleWeights> {
    let (weight, steps) = match module {
        "placing" => (4.0, StepWeights::Linear { max_weight: 2.76 }),
        "chaining" => (20.0, StepWeights::Last { max_weight: 1.92 }),
        "routing" => (20.0, StepWeights::Linear { max_weight: 1.76 }),
        "stacking" => (12.0, StepWeights::Linear { max_weight: 1.50 }),
        "arranging" => (4.0, StepWeights::Uniform),
        _ => return None,
    };
    Some(ModuleWeights { weight, steps })
}

/// Runs of steps of the same module: demonstrations solve one module after another.
fn spans(modules_of_steps: &[String]) -> Vec<(&str, Range<usize>)> {
    let mut spans: Vec<(&str, Range<usize>)> = Vec::new();
    for (step, module) in modules_of_steps.iter().enumerate() {
        match spans.last_mut() {
            Some((name, span)) if *name == module => span.end = step + 1,
            _ => spans.push((module, step..step + 1)),
        }
    }
    spans
}

/// An index with probability proportional to its weight.
fn draw_weighted<R: Rng>(weights: impl Iterator<Item = f64> + Clone, rng: &mut R) -> usize {
    let mut left = rng.random::<f64>() * weights.clone().sum::<f64>();
    let mut chosen = 0;
    for (index, weight) in weights.enumerate() {
        chosen = index;
        left -= weight;
        if left < 0.0 {
            break;
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn names(counts: &[(&str, usize)]) -> Vec<String> {
        counts
            .iter()
            .flat_map(|(name, count)| vec![name.to_string(); *count])
            .collect()
    }

    #[test]
    fn linear_weights_run_from_one_to_the_maximum() {
        let linear = StepWeights::Linear { max_weight: 3.0 };
        let weights: Vec<_> = (0..5).map(|index| linear.weight(index, 5)).collect();
        assert_eq!(weights, [1.0, 1.5, 2.0, 2.5, 3.0]);
        let ends = StepWeights::FirstLast { max_weight: 2.0 };
        let weights: Vec<_> = (0..4).map(|index| ends.weight(index, 4)).collect();
        assert_eq!(weights, [2.0, 1.0, 1.0, 2.0]);
    }

    #[test]
    fn modules_are_drawn_by_their_weight_whatever_their_length() {
        let modules = BTreeMap::from([
            (
                "placing".to_string(),
                ModuleWeights {
                    weight: 1.0,
                    steps: StepWeights::Uniform,
                },
            ),
            (
                "routing".to_string(),
                ModuleWeights {
                    weight: 3.0,
                    steps: StepWeights::Last { max_weight: 2.0 },
                },
            ),
        ]);
        let sampling = Sampling::Modules { modules };
        let steps = names(&[("placing", 9), ("routing", 3)]);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut counts = [0usize; 12];
        for _ in 0..40_000 {
            counts[sampling.draw(&steps, &mut rng).unwrap()] += 1;
        }
        let placing: usize = counts[..9].iter().sum();
        assert!((9_600..10_400).contains(&placing), "{placing}");
        // Routing's last step weighs as much as its two others together.
        assert!((14_500..15_500).contains(&counts[11]), "{}", counts[11]);
    }

    #[test]
    fn the_agents_of_the_paper_share_modules_and_steps_as_they_say() {
        let steps = names(&[("placing", 9), ("routing", 3)]);
        let shares = |sampling: Sampling| {
            let mut rng = ChaCha8Rng::seed_from_u64(2);
            let mut counts = [0.0; 12];
            for _ in 0..40_000 {
                counts[sampling.draw(&steps, &mut rng).unwrap()] += 1.0 / 40_000.0;
            }
            let routing: f64 = counts[9..].iter().sum();
            (routing, counts[11] / counts[9])
        };
        // Routing's last step weighs 1.76 times its first; placing's nine weigh 9 (1 + 2.76) / 2 together.
        let step = 3.0 * 1.38 / (3.0 * 1.38 + 9.0 * 1.88);
        for (sampling, routing, ratio) in [
            (Sampling::Plain, 0.25, 1.0),
            (Sampling::Step, step, 1.76),
            (Sampling::UnifStep, 0.5, 1.76),
            (Sampling::CompStep, 20.0 / 24.0, 1.76),
        ] {
            let found = shares(sampling.clone());
            assert!((found.0 - routing).abs() < 0.01, "{sampling:?}: {found:?}");
            assert!((found.1 - ratio).abs() < 0.1, "{sampling:?}: {found:?}");
        }
    }

    #[test]
    fn a_module_without_weights_is_named() {
        let sampling = Sampling::Modules {
            modules: BTreeMap::new(),
        };
        let error = sampling
            .draw(
                &names(&[("chaining", 2)]),
                &mut ChaCha8Rng::seed_from_u64(0),
            )
            .unwrap_err();
        assert!(error.to_string().contains("chaining"), "{error}");
    }

    #[test]
    fn a_weight_below_one_is_refused_by_name() {
        let weights = ModuleWeights {
            weight: 1.0,
            steps: StepWeights::Linear {
                max_weight: f64::NAN,
            },
        };
        let sampling = Sampling::Modules {
            modules: BTreeMap::from([("stacking".into(), weights)]),
        };
        let error = sampling.validate().unwrap_err().to_string();
        assert!(
            error.contains("stacking") && error.contains("max_weight"),
            "{error}"
        );
    }
}
