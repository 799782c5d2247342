//! Evaluation as in the paper (section VI): completion rate over held-out episodes.

use crate::goal::{NextStepOracle, goal};
use crate::interval::wilson_95;
use crate::rollout::{Rollout, demonstrate, roll_out};
use bags::Demonstration;
use gctn::{GoalConditioning, Policy};
use multiravens::{Environment, EnvironmentError, Problem};
use pick_place::PickPlace;
use serde::Serialize;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;
use ur5::WorkCell;

/// One test episode.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EpisodeReport {
    /// Its seed.
    pub seed: u64,
    /// Whether every goal of every module was reached.
    pub completed: bool,
    /// Reward of the last state.
    pub reward: f64,
    /// Steps taken.
    pub steps: usize,
    /// Steps before which the goal module *image distance* would have named the same goal as the oracle.
    pub image_distance_right: usize,
}

/// An evaluation of one policy on one problem.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Name of the problem.
    pub problem: String,
    /// `sctn` with next-step goals, `gctn` with the final goal.
    pub agent: &'static str,
    /// Number of episodes.
    pub episodes: usize,
    /// Share of episodes in which every module was completed.
    pub completion: f64,
    /// Mean reward.
    pub reward: f64,
    /// Share of all steps before which the goal module *image distance* would have named the same goal as
    /// the oracle.
    pub image_distance: f64,
    /// 95 % interval of the completion rate (Wilson).
    pub interval_95: [f64; 2],
    /// Seeds passed over because the demonstrator failed on them: there was no demonstration sequence.
    pub skipped_seeds: Vec<u64>,
    /// Wall time.
    pub seconds: f64,
    /// The episodes, in order of their seeds.
    pub reports: Vec<EpisodeReport>,
}

/// Why an evaluation stopped.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// The demonstrator fails on nearly every seed, so that there is next to nothing to evaluate on.
    #[error("the demonstrator of {problem} failed on most of the first {seeds} seeds")]
    NoDemonstrations {
        /// Name of the problem.
        problem: String,
        /// Seeds tried.
        seeds: u64,
    },
    /// The simulation failed.
    #[error("seed {seed}: {source}")]
    Environment {
        /// Seed of the episode.
        seed: u64,
        /// Why.
        source: Box<EnvironmentError>,
    },
    /// The policy failed.
    #[error("seed {seed}: {source}")]
    Policy {
        /// Seed of the episode.
        seed: u64,
        /// Why.
        source: gctn::Error,
    },
}

/// A demonstrator that needs more seeds than this for each episode is broken.
const MAX_SEEDS_PER_EPISODE: u64 = 10;

enum StepError {
    Environment(EnvironmentError),
    Policy(gctn::Error),
}

impl From<EnvironmentError> for StepError {
    fn from(error: EnvironmentError) -> Self {
        Self::Environment(error)
    }
}

impl From<gctn::Error> for StepError {
    fn from(error: gctn::Error) -> Self {
        Self::Policy(error)
    }
}

/// What a policy did in one episode.
#[derive(Clone, Debug)]
pub struct Attempt {
    /// The demonstration of the same start, whose images were the goals.
    pub shown: Demonstration,
    /// What was seen and done.
    pub rollout: Rollout,
    /// Steps before which the goal module *image distance* would have named the same goal as the oracle.
    pub image_distance_right: usize,
}

/// Lets the policy act on one episode, with the demonstration sequence of the same start. `None`: the
/// demonstrator failed on this seed.
pub fn attempt(
    environment: &mut Environment,
    policy: &Policy,
    seed: u64,
) -> Result<Option<Attempt>, EvaluationError> {
    let failed = |error| EvaluationError::Environment {
        seed,
        source: Box::new(error),
    };
    let shown = demonstrate(environment, seed).map_err(failed)?;
    if !shown.complete {
        return Ok(None);
    }
    let goals = shown.demonstration.goals();
    let conditioning = policy.config().conditioning;
    let oracle = std::cell::Cell::new(NextStepOracle::new(goals.len()));
    let first = shown.demonstration.observation(0);
    let mut image_distance_right = 0;
    let rollout = roll_out(
        environment,
        seed,
        |_, observation| {
            let nearest = observation.nearest(std::iter::once(first).chain(goals.iter().copied()));
            image_distance_right += usize::from(nearest == Some(oracle.get().reached()));
            let Some(goal) = goal(&goals, oracle.get().index(), conditioning) else {
                return Ok(None);
            };
            let decision = policy.decide(observation, goal, &[])?;
            Ok(Some(PickPlace {
                pick: decision.pick,
                place: decision.place,
            }))
        },
        |delta_reward| {
            let mut told = oracle.get();
            told.observe(delta_reward);
            oracle.set(told);
        },
    );
    match rollout {
        Ok(rollout) => Ok(Some(Attempt {
            shown: shown.demonstration,
            rollout,
            image_distance_right,
        })),
        Err(StepError::Environment(source)) => Err(failed(source)),
        Err(StepError::Policy(source)) => Err(EvaluationError::Policy { seed, source }),
    }
}

/// Evaluates on `episodes` episodes, of the seeds `first_seed`, `first_seed + 2`, ...: a stride of two
/// keeps training seeds even and validation seeds odd. One thread for each policy given; the result
/// does not depend on how many. `progress` is told of each episode as it comes.
pub fn evaluate(
    problem: &Problem,
    work_cell: &WorkCell,
    policies: &mut [Policy],
    first_seed: u64,
    episodes: usize,
    progress: impl Fn(&EpisodeReport, &Attempt) + Sync,
) -> Result<Evaluation, EvaluationError> {
    let started = Instant::now();
    let next = AtomicU64::new(0);
    let outcomes = Mutex::new(Vec::new());
    // Seeds are handed out in order, and more of them while some are passed over; what comes after the
    // last needed episode is cut off below, so that the number of threads does not matter.
    let work = |policy: &mut Policy| -> Result<(), EvaluationError> {
        let mut environment = Environment::new(problem, work_cell);
        loop {
            let done = outcomes
                .lock()
                .expect("no thread panics with the lock")
                .iter()
                .filter(|(_, report)| Option::is_some(report))
                .count();
            if done >= episodes {
                return Ok(());
            }
            let index = next.fetch_add(1, Ordering::Relaxed);
            if index > MAX_SEEDS_PER_EPISODE * (episodes as u64 + 1) {
                let problem = problem.name().to_owned();
                return Err(EvaluationError::NoDemonstrations {
                    problem,
                    seeds: index,
                });
            }
            let seed = first_seed + 2 * index;
            let report = attempt(&mut environment, policy, seed)?.map(|attempt| {
                let report = EpisodeReport {
                    seed,
                    completed: attempt.rollout.complete,
                    reward: attempt.rollout.total_reward,
                    steps: attempt.rollout.demonstration.steps.len(),
                    image_distance_right: attempt.image_distance_right,
                };
                progress(&report, &attempt);
                report
            });
            outcomes
                .lock()
                .expect("no thread panics with the lock")
                .push((seed, report));
        }
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = policies
            .iter_mut()
            .map(|policy| scope.spawn(|| work(policy)))
            .collect();
        threads
            .into_iter()
            .try_for_each(|thread| match thread.join() {
                Ok(result) => result,
                Err(panic) => std::panic::resume_unwind(panic),
            })
    })?;
    let mut outcomes = outcomes
        .into_inner()
        .expect("no thread panics with the lock");
    outcomes.sort_by_key(|(seed, _)| *seed);
    let mut reports = Vec::new();
    let mut skipped_seeds = Vec::new();
    for (seed, report) in outcomes {
        match report {
            _ if reports.len() == episodes => break,
            Some(report) => reports.push(report),
            None => skipped_seeds.push(seed),
        }
    }
    let completed = reports.iter().filter(|report| report.completed).count();
    let count = reports.len().max(1) as f64;
    let steps: usize = reports.iter().map(|report| report.steps).sum();
    let named: usize = reports
        .iter()
        .map(|report| report.image_distance_right)
        .sum();
    let conditioning = policies.first().map(|policy| policy.config().conditioning);
    Ok(Evaluation {
        problem: problem.name().to_owned(),
        agent: if conditioning == Some(GoalConditioning::Final) {
            "gctn"
        } else {
            "sctn"
        },
        episodes: reports.len(),
        completion: completed as f64 / count,
        reward: reports.iter().map(|report| report.reward).sum::<f64>() / count,
        image_distance: named as f64 / steps.max(1) as f64,
        interval_95: wilson_95(completed, reports.len()),
        skipped_seeds,
        seconds: started.elapsed().as_secs_f64(),
        reports,
    })
}
