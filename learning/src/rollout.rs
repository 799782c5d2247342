//! Rollouts: an actor acts in an environment until the episode is over.

use bags::{Demonstration, DemonstrationStep};
use heightmap::Heightmap;
use multiravens::{Environment, EnvironmentError, EpisodeSeed, StepReport};
use pick_place::PickPlace;

/// A rollout and how it ended.
#[derive(Clone, Debug)]
pub struct Rollout {
    /// What was seen and done.
    pub demonstration: Demonstration,
    /// Goals reached after each step, numbered as in [`Environment::goals_reached`].
    pub goals_reached: Vec<Vec<usize>>,
    /// Whether every goal was reached.
    pub complete: bool,
    /// Reward of the last state, 0..1.
    pub total_reward: f64,
}

impl Rollout {
    /// The order in which the goals were reached, to be followed from another start. `None` where a
    /// goal was lost again, or two were reached in one step: no other start can follow that.
    pub fn goal_order(&self) -> Option<Vec<usize>> {
        let mut order: Vec<usize> = Vec::new();
        for reached in &self.goals_reached {
            let lost = order.iter().any(|goal| !reached.contains(goal));
            if lost || reached.len() > order.len() + 1 {
                return None;
            }
            order.extend(reached.iter().find(|goal| !order.contains(goal)));
        }
        Some(order)
    }
}

/// Begins the episode of a seed and lets the demonstrator act until it is over or it knows no action.
pub fn demonstrate(
    environment: &mut Environment,
    seed: impl Into<EpisodeSeed>,
) -> Result<Rollout, EnvironmentError> {
    demonstrate_in_order(environment, seed, &[])
}

/// [`demonstrate`], the goals reached in an order: that of another start, see [`Rollout::goal_order`].
/// Goals that are not named come last.
pub fn demonstrate_in_order(
    environment: &mut Environment,
    seed: impl Into<EpisodeSeed>,
    order: &[usize],
) -> Result<Rollout, EnvironmentError> {
    demonstrate_disturbed(environment, seed, order, 0.0)
}

/// [`demonstrate_in_order`], disturbed before each step with a probability, see [`Environment::disturb`].
/// A disturbance is not a step: the next step begins from its result. A demonstration in which
/// a disturbance reaches a goal is not complete, since no step shows how.
pub fn demonstrate_disturbed(
    environment: &mut Environment,
    seed: impl Into<EpisodeSeed>,
    order: &[usize],
    probability: f64,
) -> Result<Rollout, EnvironmentError> {
    let mut spoiled = false;
    let mut rollout = roll(
        environment,
        seed.into(),
        |environment| {
            environment.follow(order)?;
            let before = environment.goals_reached();
            let disturbed = environment.disturb(probability)?;
            let after = environment.goals_reached();
            spoiled |= after.iter().any(|goal| !before.contains(goal));
            Ok(disturbed)
        },
        |environment, _| Ok::<_, EnvironmentError>(environment.demonstrate()),
        |_, _| (),
    )?;
    rollout.complete &= !spoiled;
    Ok(rollout)
}

/// Repeats the actions of a demonstration of this problem from the same start: the same states come of
/// it, and with them which goals each step reached, which a bag does not say.
pub fn replay(
    environment: &mut Environment,
    demonstration: &Demonstration,
) -> Result<Rollout, EnvironmentError> {
    let seed = EpisodeSeed {
        scene: demonstration.seed,
        start: demonstration.start_seed,
    };
    let mut actions = demonstration.steps.iter().map(|step| step.action);
    roll_out(environment, seed, |_, _| Ok(actions.next()), |_, _| ())
}

/// Begins the episode of a seed and takes the actions of `act`, which is shown the observation, until
/// the episode is over or it gives none. `after` is called with each action and its result.
pub fn roll_out<E: From<EnvironmentError>>(
    environment: &mut Environment,
    seed: impl Into<EpisodeSeed>,
    act: impl FnMut(&mut Environment, &Heightmap) -> Result<Option<PickPlace>, E>,
    after: impl FnMut(&PickPlace, &StepReport),
) -> Result<Rollout, E> {
    roll(environment, seed.into(), |_| Ok(false), act, after)
}

/// [`roll_out`]; `before` is called before each step, and says whether it has moved anything.
pub(crate) fn roll<E: From<EnvironmentError>>(
    environment: &mut Environment,
    seed: EpisodeSeed,
    mut before: impl FnMut(&mut Environment) -> Result<bool, E>,
    mut act: impl FnMut(&mut Environment, &Heightmap) -> Result<Option<PickPlace>, E>,
    mut after: impl FnMut(&PickPlace, &StepReport),
) -> Result<Rollout, E> {
    environment.reset(seed)?;
    let mut steps = Vec::new();
    let mut goals_reached = Vec::new();
    let mut observation = environment.observe()?.clone();
    while !environment.is_done() {
        if before(environment)? {
            observation = environment.observe()?.clone();
        }
        let Some(settings) = environment.settings() else {
            break;
        };
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
        goals_reached.push(environment.goals_reached());
        after(&action, &report);
    }
    Ok(Rollout {
        demonstration: Demonstration {
            problem: environment.problem().name().to_owned(),
            seed: seed.scene,
            start_seed: seed.start,
            steps,
            last: observation,
        },
        goals_reached,
        complete: environment.is_complete(),
        total_reward: environment.total_reward(),
    })
}
