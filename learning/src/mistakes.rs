//! Demonstrations that go on from a policy's mistakes (DAgger: Ross, Gordon and Bagnell, AISTATS 2011).

use bags::Demonstration;
use multiravens::{Environment, EpisodeSeed};
use nalgebra::{Isometry2, Point2};

use crate::evaluation::{EvaluationError, StepError};
use crate::rollout::roll;
use crate::{Actor, Rollout, goal};

/// A demonstration, and how many mistakes it goes on from.
#[derive(Clone, Debug)]
pub struct Corrected {
    /// What the demonstrator did.
    pub rollout: Rollout,
    /// Mistakes of the policy.
    pub mistakes: usize,
}

/// Begins the episode of a seed. Before each step the policy acts, shown a demonstration of the scene that reaches the goals in `order`: where that
/// reaches no goal the demonstrator goes on from its result; where it does, the demonstrator acts in its place. The policy's actions are no steps.
///
/// # Errors
/// The simulation or the policy fails.
pub fn demonstrate_corrections(
    environment: &mut Environment,
    actor: &Actor,
    seed: EpisodeSeed,
    (shown, order): (&Demonstration, &[usize]),
) -> Result<Corrected, EvaluationError> {
    let (first, goals) = (shown.observation(0), shown.goals());
    let mut mistakes = 0;
    let rollout = roll(
        environment,
        seed,
        |environment| {
            environment.follow(order)?;
            let reached = environment.goals_reached().len();
            let Some(wanted) = goal(first, &goals, reached, actor.conditioning()) else {
                return Ok(false);
            };
            let act = actor.act(environment.observe()?, wanted, &[])?;
            let is_mistake = environment.mistake(&act.action)?;
            mistakes += usize::from(is_mistake);
            Ok(is_mistake)
        },
        |environment, observation| {
            // What the policy has pushed over the edge cannot be picked.
            let is_inside = |pose: &Isometry2<f64>| {
                let point = Point2::from(pose.translation.vector);
                observation.workspace.pixel(&point).is_some()
            };
            let action = environment.demonstrate();
            let action =
                action.filter(|action| is_inside(&action.pick) && is_inside(&action.place));
            Ok::<_, StepError>(action)
        },
        |_, _| (),
    );
    match rollout {
        Ok(rollout) => Ok(Corrected { rollout, mistakes }),
        Err(error) => Err(error.of(seed.start)),
    }
}
