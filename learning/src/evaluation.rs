//! Evaluation as in the paper (section VI): completion rate over held-out episodes.

use crate::actor::{Act, Actor, Said};
use crate::goal::goal;
use crate::interval::bootstrap_95;
use crate::rollout::{Rollout, roll_out};
use crate::shown::{ShownError, ShownFolder, shown};
use bags::Demonstration;
use camera_noise::Perturbation;
use multiravens::{Environment, EnvironmentError, EpisodeSeed, Problem};
use serde::{Deserialize, Serialize};
use std::cell::RefCell;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;
use step_protocol::{FailedPicks, ReachedGoals};
use ur5::WorkCell;

/// Where the demonstration begins whose images are the goals of an episode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Start {
    /// At the very start of the episode: what is seen is what was shown, until the policy errs.
    #[default]
    Same,
    /// At another start of the same scene: the same fixtures, objects and goal, the loose objects elsewhere.
    Other,
}

impl Start {
    /// What the demonstration for the episode of a scene's own start is made from.
    pub fn shown(self, scene: u64) -> EpisodeSeed {
        let start = match self {
            Self::Same => scene,
            Self::Other => scene + 1,
        };
        EpisodeSeed { scene, start }
    }
}

/// Which episodes to evaluate on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Episodes {
    /// Seed of the first; the next ones are seed + 2, seed + 4, ...: a stride of two keeps training seeds even and
    /// validation seeds odd.
    pub first_seed: u64,
    /// How many.
    pub count: usize,
    /// Where the shown demonstrations begin.
    pub start: Start,
}

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
    /// The network's judgements of each step, and the step's result; empty for the baseline.
    pub said: Vec<SaidStep>,
}

/// A network's judgements of one step, and the step's result.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SaidStep {
    /// The estimates before the step.
    pub said: Said,
    /// Whether the step earned a reward.
    pub earned: bool,
    /// What it said afterwards, shown the same step once more, of an earned step that another one followed: the probability
    /// that this step is done.
    pub done_after: Option<f64>,
}

/// An evaluation of one policy on one problem.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// Name of the problem.
    pub problem: String,
    /// `sctn` with next-step goals or a sequence, `gctn` with the final goal, `difference` for the baseline.
    pub agent: &'static str,
    /// Where the shown demonstrations begin.
    pub start: Start,
    /// Name of the perturbation of what the cameras see; null without one.
    pub perturb: Option<String>,
    /// Number of episodes.
    pub episodes: usize,
    /// Share of episodes in which every module was completed.
    pub completion: f64,
    /// Mean reward.
    pub reward: f64,
    /// Share of all steps before which the goal module *image distance* would have named the same goal as
    /// the oracle.
    pub image_distance: f64,
    /// 95 % interval of the completion rate, by bootstrap over episodes.
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
        /// The reason.
        source: Box<EnvironmentError>,
    },
    /// The folder of shown demonstrations.
    #[error(transparent)]
    Shown(#[from] ShownError),
    /// The policy failed.
    #[error("seed {seed}: {source}")]
    Policy {
        /// Seed of the episode.
        seed: u64,
        /// The reason.
        source: gctn::Error,
    },
}

/// A demonstrator that needs more seeds than this for each episode is broken.
const MAX_SEEDS_PER_EPISODE: u64 = 10;

/// Sessions of perturbed cameras: light and colours were others when the demonstration was made.
const SESSION_OF_DEMONSTRATION: u64 = 0;
const SESSION_OF_ROLLOUT: u64 = 1;

/// What went wrong in a step.
pub(crate) enum StepError {
    Environment(EnvironmentError),
    Policy(gctn::Error),
}

impl StepError {
    /// In the episode of this seed.
    pub(crate) fn of(self, seed: u64) -> EvaluationError {
        match self {
            Self::Environment(source) => EvaluationError::Environment {
                seed,
                source: Box::new(source),
            },
            Self::Policy(source) => EvaluationError::Policy { seed, source },
        }
    }
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
    /// The demonstration whose images were the goals.
    pub shown: Demonstration,
    /// What was seen and done.
    pub rollout: Rollout,
    /// Steps before which the goal module *image distance* would have named the same goal as the oracle.
    pub image_distance_right: usize,
    /// The network's judgements of each step, and the step's result; empty for the baseline.
    pub said: Vec<SaidStep>,
}

/// Lets an actor act on the episode of a scene's own start, shown a demonstration. A pick that has just failed is left
/// out, see [`FailedPicks`]. The demonstration is kept in the folder where there is one. `None`: the demonstrator failed on this seed.
pub fn attempt(
    environment: &mut Environment,
    actor: &Actor,
    seed: u64,
    start: Start,
    folder: Option<&ShownFolder>,
) -> Result<Option<Attempt>, EvaluationError> {
    environment.set_session(SESSION_OF_DEMONSTRATION);
    let seeds = start.shown(seed);
    let demonstration = match folder {
        Some(folder) => folder.demonstrate(environment, seeds)?,
        None => shown(environment, seeds)?,
    };
    let Some(demonstration) = demonstration else {
        return Ok(None);
    };
    environment.set_session(SESSION_OF_ROLLOUT);
    let goals = demonstration.goals();
    let conditioning = actor.conditioning();
    let oracle = RefCell::new(ReachedGoals::new(goals.len()));
    let failed_picks: RefCell<FailedPicks> = RefCell::default();
    let said: RefCell<Option<Act>> = RefCell::default();
    let first = demonstration.observation(0);
    let mut image_distance_right = 0;
    let said_steps: RefCell<Vec<SaidStep>> = RefCell::default();
    let rollout: Result<_, StepError> = roll_out(
        environment,
        seed,
        |_, observation| {
            let nearest = observation.nearest(std::iter::once(first).chain(goals.iter().copied()));
            let (reached, next) = (oracle.borrow().reached(), oracle.borrow().next_index());
            image_distance_right += usize::from(nearest == Some(reached));
            let Some(wanted) = goal(first, &goals, next, conditioning) else {
                return Ok(None);
            };
            let mut said_steps = said_steps.borrow_mut();
            if let Some(last) = said_steps.last_mut()
                && last.earned
                && last.said.done.is_some()
                && let Some(index) = next.checked_sub(1)
                && let Some(earned) = goal(first, &goals, index, conditioning)
            {
                last.done_after = actor.done(observation, earned)?;
            }
            let exclude: Vec<_> = failed_picks.borrow().exclusions().collect();
            let act = actor.act(observation, wanted, &exclude)?;
            *said.borrow_mut() = Some(act);
            Ok(Some(act.action))
        },
        |action, report| {
            let mut oracle = oracle.borrow_mut();
            let before = oracle.next_index();
            oracle.observe(report.delta_reward, report.complete);
            let mut failed_picks = failed_picks.borrow_mut();
            failed_picks.record(&action.pick, report.outcome.into());
            if oracle.next_index() != before {
                failed_picks.forget();
            }
            let said = said.borrow_mut().take().and_then(|act| act.said);
            said_steps.borrow_mut().extend(said.map(|said| SaidStep {
                said,
                earned: report.delta_reward > 0.0,
                done_after: None,
            }));
        },
    );
    match rollout {
        Ok(rollout) => Ok(Some(Attempt {
            shown: demonstration,
            rollout,
            image_distance_right,
            said: said_steps.into_inner(),
        })),
        Err(error) => Err(error.of(seed)),
    }
}

/// Evaluates on episodes. One thread for each actor given, which must all be alike; the result does not depend on how
/// many. With a perturbation, observations and goals are what such cameras see. Where `shown` names a folder, the shown
/// demonstrations are kept in it, see [`ShownFolder`]; it changes no result. `progress` is called after each episode.
pub fn evaluate(
    problem: &Problem,
    work_cell: &WorkCell,
    actors: &mut [Actor],
    plan: &Episodes,
    perturbation: Option<&Perturbation>,
    shown: Option<&Path>,
    progress: impl Fn(&EpisodeReport, &Attempt) + Sync,
) -> Result<Evaluation, EvaluationError> {
    let Episodes {
        first_seed,
        count: episodes,
        start,
    } = *plan;
    let started = Instant::now();
    let folder = shown.map(|folder| ShownFolder::new(folder, problem, work_cell, perturbation));
    let folder = folder.transpose()?;
    let next = AtomicU64::new(0);
    let outcomes = Mutex::new(Vec::new());
    // Seeds are handed out in order, and more of them while some are passed over; what comes after the
    // last needed episode is cut off below, so that the number of threads does not matter.
    let work = |actor: &mut Actor| -> Result<(), EvaluationError> {
        let mut environment = Environment::new(problem, work_cell);
        environment.set_perturbation(perturbation);
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
            let report =
                attempt(&mut environment, actor, seed, start, folder.as_ref())?.map(|attempt| {
                    let report = EpisodeReport {
                        seed,
                        completed: attempt.rollout.complete,
                        reward: attempt.rollout.total_reward,
                        steps: attempt.rollout.demonstration.steps.len(),
                        image_distance_right: attempt.image_distance_right,
                        said: attempt.said.clone(),
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
        let threads: Vec<_> = actors
            .iter_mut()
            .map(|actor| scope.spawn(|| work(actor)))
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
    let outcomes = reports.iter().map(|report| report.completed).collect();
    Ok(Evaluation {
        problem: problem.name().to_owned(),
        agent: actors.first().map_or("sctn", Actor::name),
        start,
        perturb: None,
        episodes: reports.len(),
        completion: completed as f64 / count,
        reward: reports.iter().map(|report| report.reward).sum::<f64>() / count,
        image_distance: named as f64 / steps.max(1) as f64,
        interval_95: bootstrap_95(&[outcomes]),
        skipped_seeds,
        seconds: started.elapsed().as_secs_f64(),
        reports,
    })
}
