//! Next-step goal modules (paper, section IV-A): which image of the demonstration sequence comes next.
//!
//! The module *image distance* is [`Heightmap::nearest`] among the first observation and the sequence; *embedding*
//! is [`gctn::Embedding::nearest`] among the same.

use bags::Demonstration;
use gctn::{Goal, GoalConditioning};
use heightmap::Heightmap;
use step_protocol::ReachedGoals;

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

/// What is seen after each step of a rollout, and how many goals the oracle then counts as reached. `complete`: its last step
/// completed the problem.
pub fn reached(
    rollout: &Demonstration,
    goal_count: usize,
    complete: bool,
) -> impl Iterator<Item = (&Heightmap, usize)> {
    let mut oracle = ReachedGoals::new(goal_count);
    let count = rollout.steps.len();
    rollout.steps.iter().enumerate().map(move |(index, step)| {
        oracle.observe(step.delta_reward, complete && index + 1 == count);
        (rollout.observation(index + 1), oracle.reached())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_goal_counts_as_reached_after_a_gain_and_no_longer_after_a_loss() {
        let heightmap = Heightmap::new(heightmap::Workspace::RAVENS);
        let step = |delta_reward| bags::DemonstrationStep {
            observation: heightmap.clone(),
            action: pick_place::PickPlace {
                pick: nalgebra::Isometry2::identity(),
                place: nalgebra::Isometry2::identity(),
            },
            settings: pick_place::PrimitiveSettings::RIGID,
            module: "placing".into(),
            delta_reward,
            outcome: pick_place::Outcome::Placed,
        };
        let rollout = Demonstration {
            problem: "placing".into(),
            seed: 0,
            start_seed: 0,
            steps: [0.5, 0.0, -0.5, 0.5, 0.5].map(step).to_vec(),
            last: heightmap.clone(),
        };
        let counts = |complete| {
            let counts = reached(&rollout, 2, complete).map(|(_, reached)| reached);
            counts.collect::<Vec<_>>()
        };
        assert_eq!(counts(true), [1, 1, 0, 1, 2]);
        // The last image stays the goal until the problem is complete.
        assert_eq!(counts(false), [1, 1, 0, 1, 1]);
    }
}
