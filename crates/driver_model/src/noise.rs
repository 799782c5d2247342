//! Noise of joint readings.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use ur5::Joints;

/// Noise of the encoders, drawn from a seed.
#[derive(Clone, Debug)]
pub struct EncoderNoise {
    rng: ChaCha8Rng,
}

impl EncoderNoise {
    /// Starts the sequence of a seed.
    pub fn new(seed: u64) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// A reading (rad) with noise of a standard deviation (rad). Without noise it is the position itself, bit for bit.
    pub fn read(&mut self, positions_rad: &Joints, deviation_rad: f64) -> Joints {
        if deviation_rad <= 0.0 {
            return *positions_rad;
        }
        positions_rad.map(|position_rad| {
            let unit: f64 = self.rng.sample(StandardNormal);
            position_rad + deviation_rad * unit
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readings_scatter_by_the_deviation_and_not_at_all_without() {
        let mut noise = EncoderNoise::new(1);
        let position = Joints::repeat(0.5);
        assert_eq!(noise.read(&position, 0.0), position);
        let readings: Vec<f64> = (0..1000)
            .flat_map(|_| (noise.read(&position, 1e-4) - position).as_slice().to_vec())
            .collect();
        let variance = readings.iter().map(|error| error * error).sum::<f64>() / 6000.0;
        assert!((0.9e-4..1.1e-4).contains(&variance.sqrt()), "{variance}");
    }
}
