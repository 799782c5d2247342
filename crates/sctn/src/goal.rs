//! Next-step goal modules (paper, section IV-A): which image of the demonstration sequence comes next.

use gctn::GoalConditioning;

/// The oracle: counts delta rewards, as the paper's operator does who checks each step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NextStepOracle {
    next: usize,
    len: usize,
}

impl NextStepOracle {
    /// At the start of a demonstration sequence of `len` images.
    pub fn new(len: usize) -> Self {
        Self { next: 0, len }
    }

    /// Index of the goal image: the next one of the sequence, or always the last. After the last step
    /// it stays at the last image.
    pub fn index(&self, conditioning: GoalConditioning) -> usize {
        let last = self.len.saturating_sub(1);
        match conditioning {
            GoalConditioning::NextStep => self.next.min(last),
            GoalConditioning::Final => last,
        }
    }

    /// Tells of a step's delta reward: a gain advances by one image, a loss steps back by one.
    pub fn observe(&mut self, delta_reward: f64) {
        if delta_reward > 0.0 {
            self.next = (self.next + 1).min(self.len);
        } else if delta_reward < 0.0 {
            self.next = self.next.saturating_sub(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_delta_reward_advances_the_goal() {
        let mut oracle = NextStepOracle::new(3);
        oracle.observe(0.0);
        assert_eq!(oracle.index(GoalConditioning::NextStep), 0);
        oracle.observe(0.5);
        assert_eq!(oracle.index(GoalConditioning::NextStep), 1);
        assert_eq!(oracle.index(GoalConditioning::Final), 2);
    }

    #[test]
    fn after_the_last_step_the_goal_stays() {
        let mut oracle = NextStepOracle::new(2);
        for _ in 0..5 {
            oracle.observe(0.5);
        }
        assert_eq!(oracle.index(GoalConditioning::NextStep), 1);
    }
}
