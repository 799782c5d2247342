//! Rollouts: an actor acts in an environment until the episode is over.

use bags::{Demonstration, DemonstrationStep};
use heightmap::Heightmap;
use multiravens::{Environment, EnvironmentError};
use pick_place::PickPlace;

/// A rollout and how it ended.
#[derive(Clone, Debug)]
pub struct Rollout {
    /// What was seen and done.
    pub demonstration: Demonstration,
    /// Whether every goal was reached.
    pub complete: bool,
    /// Reward of the last state, 0..1.
    pub total_reward: f64,
}

/// Begins the episode of a seed and lets the demonstrator act until it is over or it knows no action.
pub fn demonstrate(environment: &mut Environment, seed: u64) -> Result<Rollout, EnvironmentError> {
    roll_out(
        environment,
        seed,
        |environment, _| Ok(environment.demonstrate()),
        |_| (),
    )
}

/// Begins the episode of a seed and takes the actions of `act`, which is shown the observation, until
/// the episode is over or it gives none. `after` is told each delta reward.
pub fn roll_out<E: From<EnvironmentError>>(
    environment: &mut Environment,
    seed: u64,
    mut act: impl FnMut(&mut Environment, &Heightmap) -> Result<Option<PickPlace>, E>,
    mut after: impl FnMut(f64),
) -> Result<Rollout, E> {
    environment.reset(seed)?;
    let mut steps = Vec::new();
    let mut observation = environment.observe()?.clone();
    while let (false, Some(settings)) = (environment.is_done(), environment.settings()) {
        let Some(action) = act(environment, &observation)? else {
            break;
        };
        let report = environment.step(&action)?;
        let next = environment.observe()?.clone();
        steps.push(DemonstrationStep {
            observation: std::mem::replace(&mut observation, next),
            action,
            settings,
            module: report.module.to_owned(),
            delta_reward: report.delta_reward,
            outcome: report.outcome,
        });
        after(report.delta_reward);
    }
    Ok(Rollout {
        demonstration: Demonstration {
            problem: environment.problem().name().to_owned(),
            seed,
            steps,
            last: observation,
        },
        complete: environment.is_complete(),
        total_reward: environment.total_reward(),
    })
}
