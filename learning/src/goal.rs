//! Next-step goal modules (paper, section IV-A): which image of the demonstration sequence comes next.
//!
//! The module *image distance* is [`Heightmap::nearest`] among the first observation and the sequence; *embedding*
//! is [`gctn::Embedding::nearest`] among the same.

use bags::Demonstration;
use gctn::{Goal, GoalConditioning};
use heightmap::Heightmap;

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

    /// Index of the next-step goal in the sequence. After the last step it stays at the last image.
    pub fn index(&self) -> usize {
        self.next.min(self.len.saturating_sub(1))
    }

    /// Number of images of the sequence that have been reached.
    pub fn reached(&self) -> usize {
        self.next
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

/// What a policy is shown of a demonstration that begins with the image `first` and has the sequence `images`, when `next` is
/// the index of its next-step goal. None of an empty sequence.
pub fn goal<'a>(
    first: &'a Heightmap,
    images: &[&'a Heightmap],
    next: usize,
    conditioning: GoalConditioning,
) -> Option<Goal<'a>> {
    let last = *images.last()?;
    let index = next.min(images.len() - 1);
    let next = images[index];
    Some(match conditioning {
        GoalConditioning::Sequence => {
            let before = index.checked_sub(1).map_or(first, |before| images[before]);
            Goal::step(before, next)
        }
        GoalConditioning::NextStep => next.into(),
        GoalConditioning::Final => last.into(),
        GoalConditioning::Both => Goal {
            image: next,
            last: Some(last),
            previous: None,
        },
    })
}

/// The images that a goal module compares with: what was seen at the start of a demonstration, and its sequence. Where the one
/// of index `i` is nearest, `i` goals are reached.
pub fn known_images(shown: &Demonstration) -> Vec<&Heightmap> {
    let first = shown.observation(0);
    std::iter::once(first).chain(shown.goals()).collect()
}

/// What is seen after each step of a rollout, and how many goals the oracle then counts as reached.
pub fn reached(
    rollout: &Demonstration,
    goal_count: usize,
) -> impl Iterator<Item = (&Heightmap, usize)> {
    let mut oracle = NextStepOracle::new(goal_count);
    rollout.steps.iter().enumerate().map(move |(index, step)| {
        oracle.observe(step.delta_reward);
        (rollout.observation(index + 1), oracle.reached())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_delta_reward_advances_the_goal() {
        let mut oracle = NextStepOracle::new(3);
        oracle.observe(0.0);
        assert_eq!(oracle.index(), 0);
        oracle.observe(0.5);
        assert_eq!(oracle.index(), 1);
    }

    #[test]
    fn each_conditioning_is_shown_its_images() {
        let images = [0, 1, 2, 3].map(|mark| {
            let mut heightmap = Heightmap::new(heightmap::Workspace::RAVENS);
            heightmap.rgb[0] = mark;
            heightmap
        });
        let images: Vec<_> = images.iter().collect();
        let shown = |next, conditioning| {
            let goal = goal(images[0], &images[1..], next, conditioning).unwrap();
            let beside = goal.last.or(goal.previous);
            (goal.image.rgb[0], beside.map(|beside| beside.rgb[0]))
        };
        assert_eq!(shown(1, GoalConditioning::NextStep), (2, None));
        assert_eq!(shown(1, GoalConditioning::Final), (3, None));
        assert_eq!(shown(1, GoalConditioning::Both), (2, Some(3)));
        assert_eq!(shown(7, GoalConditioning::Both), (3, Some(3)));
        assert_eq!(shown(0, GoalConditioning::Sequence), (1, Some(0)));
        assert_eq!(shown(2, GoalConditioning::Sequence), (3, Some(2)));
        assert_eq!(shown(7, GoalConditioning::Sequence), (3, Some(2)));
        assert!(goal(images[0], &[], 0, GoalConditioning::Both).is_none());
    }

    #[test]
    fn after_the_last_step_the_goal_stays() {
        let mut oracle = NextStepOracle::new(2);
        for _ in 0..5 {
            oracle.observe(0.5);
        }
        assert_eq!(oracle.index(), 1);
    }
}
