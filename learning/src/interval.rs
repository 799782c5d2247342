//! Confidence interval of a rate.

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

    #[test]
    fn all_successes_do_not_prove_certainty() {
        let [low, high] = wilson_95(50, 50);
        assert!((0.9..0.95).contains(&low) && high == 1.0, "{low} {high}");
    }
}
