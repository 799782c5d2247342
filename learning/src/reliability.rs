//! Whether a policy's probabilities of success are to be trusted: of the steps that it calls 80 % likely, four in five should earn
//! their reward.

use crate::evaluation::SaidStep;
use serde::Serialize;

/// Bins of a reliability curve, of equal width.
const BINS: usize = 10;
/// Most of the steps that nobody was asked about may fail.
const TOLERATED: f64 = 0.01;

/// Steps whose probability of success lies in a bin.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ReliabilityBin {
    /// Its lower bound; the bin is a tenth wide.
    pub from: f64,
    /// Steps in it.
    pub steps: usize,
    /// Mean probability that the policy gave them.
    pub said: f64,
    /// Share of them that earned a reward.
    pub earned: f64,
}

/// Which steps need nobody, when a person is asked below a threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Unasked {
    /// Probability of success below which a person is asked.
    pub threshold: f64,
    /// Share of all steps at or above it.
    pub share: f64,
    /// Share of those that earned nothing.
    pub failed: f64,
}

/// How well a policy knows what its steps will earn, and which steps are done.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reliability {
    /// Steps with a probability of success.
    pub steps: usize,
    /// Share of them that earned a reward.
    pub earned: f64,
    /// Mean squared error of the probabilities (Brier, 1950).
    pub brier: f64,
    /// Mean over steps of how far their bin's mean probability is from its share of success.
    pub calibration_error: f64,
    /// The curve; bins without steps are left out.
    pub curve: Vec<ReliabilityBin>,
    /// The lowest threshold above which at most 1 % of the steps earn nothing, if there is one.
    pub unasked: Option<Unasked>,
    /// Judgements of whether a step is done: before each step, and after an earned one.
    pub done_judged: usize,
    /// Share of them that were right.
    pub done_right: f64,
}

/// Sums up steps. Those without a probability of success count only for what is done.
pub fn reliability(steps: &[SaidStep]) -> Reliability {
    let outcomes = steps
        .iter()
        .filter_map(|step| Some((step.said.success?, step.earned)));
    let mut outcomes: Vec<(f64, bool)> = outcomes.collect();
    let share = |part: usize, whole: usize| part as f64 / whole.max(1) as f64;
    let earned = |steps: &[(f64, bool)]| steps.iter().filter(|(_, earned)| *earned).count();
    let count = outcomes.len();
    let errors = outcomes
        .iter()
        .map(|(said, earned)| (said - f64::from(u8::from(*earned))).powi(2));
    let brier = errors.sum::<f64>() / count.max(1) as f64;
    let mut curve = Vec::new();
    let mut calibration_error = 0.0;
    for bin in 0..BINS {
        let of = |said: f64| ((said * BINS as f64) as usize).min(BINS - 1);
        let inside: Vec<(f64, bool)> = outcomes
            .iter()
            .copied()
            .filter(|(said, _)| of(*said) == bin)
            .collect();
        if inside.is_empty() {
            continue;
        }
        let entry = ReliabilityBin {
            from: bin as f64 / BINS as f64,
            steps: inside.len(),
            said: inside.iter().map(|(said, _)| said).sum::<f64>() / inside.len() as f64,
            earned: share(earned(&inside), inside.len()),
        };
        calibration_error += share(inside.len(), count) * (entry.said - entry.earned).abs();
        curve.push(entry);
    }
    // From the likeliest step down: the longest run in which few fail. Equal probabilities stay together.
    outcomes.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut unasked = None;
    let mut failed = 0;
    for (index, (threshold, earned)) in outcomes.iter().enumerate() {
        failed += usize::from(!earned);
        let is_last_alike = outcomes
            .get(index + 1)
            .is_none_or(|next| next.0 < *threshold);
        if is_last_alike && share(failed, index + 1) <= TOLERATED {
            unasked = Some(Unasked {
                threshold: *threshold,
                share: share(index + 1, count),
                failed: share(failed, index + 1),
            });
        }
    }
    // Before a step that is tried it is not done; after one that was earned it is.
    let before = steps.iter().filter_map(|step| Some(step.said.done? < 0.5));
    let after = steps
        .iter()
        .filter_map(|step| Some(step.done_after? >= 0.5));
    let done: Vec<bool> = before.chain(after).collect();
    Reliability {
        steps: count,
        earned: share(earned(&outcomes), count),
        brier,
        calibration_error,
        curve,
        unasked,
        done_judged: done.len(),
        done_right: share(done.iter().filter(|right| **right).count(), done.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::actor::Said;
    use gctn::Evidence;

    fn step(success: f64, earned: bool) -> SaidStep {
        SaidStep {
            said: Said {
                evidence: Evidence {
                    pick: 0.0,
                    place: 0.0,
                    done: 0.0,
                    pick_focus: 0.0,
                    place_focus: 0.0,
                },
                done: Some(0.2),
                success: Some(success),
            },
            earned,
            done_after: earned.then_some(0.4),
        }
    }

    #[test]
    fn a_curve_counts_what_was_said_and_what_came_of_it() {
        let steps = [
            step(0.95, true),
            step(0.95, true),
            step(0.55, true),
            step(0.55, false),
        ];
        let found = reliability(&steps);
        assert_eq!((found.steps, found.earned), (4, 0.75));
        let bins: Vec<_> = found
            .curve
            .iter()
            .map(|bin| (bin.steps, bin.earned))
            .collect();
        assert_eq!(bins, [(2, 0.5), (2, 1.0)]);
        assert!((found.calibration_error - 0.05).abs() < 1e-9);
        assert!((found.brier - (2.0 * 0.0025 + 0.2025 + 0.3025) / 4.0).abs() < 1e-9);
        let unasked = found.unasked.unwrap();
        assert_eq!(
            (unasked.threshold, unasked.share, unasked.failed),
            (0.95, 0.5, 0.0)
        );
        // Four times right that the step was not done, three times wrong that it still was not.
        assert_eq!(found.done_judged, 7);
        assert!((found.done_right - 4.0 / 7.0).abs() < 1e-9);
    }

    #[test]
    fn equal_probabilities_are_asked_about_together() {
        let found = reliability(&[step(0.9, true), step(0.9, false), step(0.8, true)]);
        assert_eq!(found.unasked, None);
        assert_eq!(reliability(&[]).unasked, None);
    }
}
