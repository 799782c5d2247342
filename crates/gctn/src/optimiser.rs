//! AdamW (Loshchilov and Hutter, 2019) on flat weights, and its learning rate.

use tch::Tensor;

use crate::Schedule;

const BETAS: [f64; 2] = [0.9, 0.999];
const EPSILON: f64 = 1e-8;

/// Running means of the gradient and of its square.
#[derive(Debug)]
pub(crate) struct AdamW {
    moments: [Tensor; 2],
    /// Room for the divisor of a step.
    divisor: Tensor,
}

/// How large a step is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rate {
    pub learning_rate: f64,
    /// Largest norm of the gradient, where there is one.
    pub clip: Option<f64>,
    pub weight_decay: f64,
}

impl AdamW {
    pub fn new(weights: &Tensor) -> Self {
        Self {
            moments: [(); 2].map(|()| weights.zeros_like()),
            divisor: weights.zeros_like(),
        }
    }

    /// One step, the `count`th, along a gradient of the given norm.
    pub fn update(
        &mut self,
        weights: &Tensor,
        mut gradient: Tensor,
        norm: f64,
        count: i32,
        rate: Rate,
    ) {
        let mut weights = weights.shallow_clone();
        tch::no_grad(|| {
            if let Some(clip) = rate.clip.filter(|clip| norm > *clip) {
                gradient *= clip / norm;
            }
            let [mean, square] = &mut self.moments;
            // Each line is one pass over the weights, none makes a new tensor.
            let _ = mean.lerp_(&gradient, 1.0 - BETAS[0]);
            let _ = square.lerp_(&gradient.square_(), 1.0 - BETAS[1]);
            // w -= r (m / a) / (sqrt(s / b) + e) is w += m / (f (sqrt(s) + e sqrt(b))) with f = -a / (r sqrt(b)).
            let [mean_bias, square_bias] = BETAS.map(|beta| 1.0 - beta.powi(count));
            let root = square_bias.sqrt();
            let factor = -mean_bias / (rate.learning_rate * root);
            let divisor = &mut self.divisor;
            let _ = square.sqrt_out(divisor);
            *divisor += EPSILON * root;
            *divisor *= factor;
            if rate.weight_decay > 0.0 {
                weights *= 1.0 - rate.learning_rate * rate.weight_decay;
            }
            let _ = weights.addcdiv_(mean, divisor);
        });
    }

    /// Its state, by name.
    pub fn entries(&self) -> [(&'static str, &Tensor); 2] {
        let [mean, square] = &self.moments;
        [("mean", mean), ("square", square)]
    }
}

/// Learning rate of a step, counted from 0, of `steps`: up from 0, then by the schedule.
pub(crate) fn learning_rate(
    largest: f64,
    schedule: Schedule,
    warm_up_steps: u64,
    steps: u64,
    step: u64,
) -> f64 {
    let warm_up = ((step + 1) as f64 / (warm_up_steps + 1) as f64).min(1.0);
    let factor = match schedule {
        Schedule::Constant => 1.0,
        Schedule::Cosine => {
            let after = step.saturating_sub(warm_up_steps) as f64;
            let span = steps.saturating_sub(warm_up_steps).max(1) as f64;
            0.5 + 0.5 * (std::f64::consts::PI * (after / span).min(1.0)).cos()
        }
    };
    largest * warm_up * factor
}
