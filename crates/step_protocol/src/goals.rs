//! The goals of a demonstration, and the rule that says which one is next.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{Disk, Heightmap};
use nalgebra::Isometry2;
use pick_place::{Outcome, PrimitiveSettings};

use crate::{Coverage, Goal, OperatorDecision, StepOutcome};

/// A step of a demonstration, as far as its goals depend on it.
#[derive(Clone, Debug, PartialEq)]
pub struct ShownStep {
    /// Change of the reward by the step.
    pub delta_reward: f64,
    /// Task module.
    pub module: String,
    /// Heights and speeds.
    pub settings: PrimitiveSettings,
    /// The workspace after the step.
    pub after: Arc<Heightmap>,
}

/// The goals of a demonstration, or of a sequence that somebody taught.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GoalSequence {
    /// The workspace before the first step, v_0; `None` where nobody saw it.
    pub start: Option<Arc<Heightmap>>,
    /// v_1 to v_D, in order.
    pub goals: Vec<Goal>,
}

/// A demonstration without a goal.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the demonstration of {problem} has no step with a reward, expected at least one")]
pub struct NoGoals {
    /// The problem.
    pub problem: String,
}

/// Indices, from 0, of the steps after which an image of the demonstration is a goal: those with a positive delta reward
/// (paper, section IV-A).
pub fn goal_steps(delta_rewards: impl IntoIterator<Item = f64>) -> Vec<usize> {
    let rewards = delta_rewards.into_iter().enumerate();
    let rewarded = rewards.filter(|(_, delta_reward)| *delta_reward > 0.0);
    rewarded.map(|(index, _)| index).collect()
}

/// The goals of a demonstration from `start`: what was seen after each step with a positive delta reward. `demonstration` is its
/// name for people.
///
/// # Errors
/// No step earned a reward.
pub fn goals_of(
    problem: &str,
    demonstration: &str,
    start: Arc<Heightmap>,
    steps: &[ShownStep],
) -> Result<GoalSequence, NoGoals> {
    let indices = goal_steps(steps.iter().map(|step| step.delta_reward));
    if indices.is_empty() {
        return Err(NoGoals {
            problem: problem.to_owned(),
        });
    }
    let step_count = indices.len() as u32;
    let mut previous = Arc::clone(&start);
    let goal = |(number, index): (usize, usize)| {
        let step = &steps[index];
        Goal {
            stamp: Duration::ZERO,
            problem: problem.to_owned(),
            demonstration: demonstration.to_owned(),
            step: number as u32 + 1,
            step_count,
            attempt: 0,
            complete: false,
            module: step.module.clone(),
            settings: step.settings,
            previous: Some(std::mem::replace(&mut previous, Arc::clone(&step.after))),
            image: Arc::clone(&step.after),
            coverage: Coverage::default(),
        }
    };
    Ok(GoalSequence {
        goals: indices.into_iter().enumerate().map(goal).collect(),
        start: Some(start),
    })
}

/// What a motion did to the number of images of the demonstration that are reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// One image more is reached.
    Advance,
    /// As many as before: the same goal once more.
    Retry,
    /// One image fewer: an earlier step was undone.
    StepBack,
}

impl Judgement {
    /// What an operator's decision says of a motion; none of the decisions that speak of a proposal or of the run.
    pub const fn from_decision(decision: OperatorDecision) -> Option<Self> {
        match decision {
            OperatorDecision::Advance => Some(Self::Advance),
            OperatorDecision::Retry => Some(Self::Retry),
            OperatorDecision::StepBack => Some(Self::StepBack),
            OperatorDecision::Approve | OperatorDecision::Reject | OperatorDecision::Stop => None,
        }
    }

    /// The operator's decision that says it.
    pub const fn decision(self) -> OperatorDecision {
        match self {
            Self::Advance => OperatorDecision::Advance,
            Self::Retry => OperatorDecision::Retry,
            Self::StepBack => OperatorDecision::StepBack,
        }
    }

    /// What a measured reward says of a motion: a gain advances, a loss steps back. `is_last_goal`: the goal was the last
    /// image, which stays the goal until the problem is `complete`.
    pub fn from_reward(delta_reward: f64, complete: bool, is_last_goal: bool) -> Self {
        if delta_reward > 0.0 && (complete || !is_last_goal) {
            Self::Advance
        } else if delta_reward < 0.0 {
            Self::StepBack
        } else {
            Self::Retry
        }
    }

    /// **The** rule for the next goal. `reached` of `goal_count` images were reached before the motion; returns how many
    /// are after it. The goal is always the image after those reached; with all of them reached the run is complete.
    ///
    /// The paper's oracle "knows which delta reward time step the agent is in": a motion that undoes a step takes the
    /// agent back by one, so the next goal is an earlier image. An oracle that stayed where it was would ask for an image that
    /// differs in two places, which no policy is trained on.
    pub fn apply(self, reached: usize, goal_count: usize) -> usize {
        match self {
            Self::Advance => (reached + 1).min(goal_count),
            Self::Retry => reached,
            Self::StepBack => reached.saturating_sub(1),
        }
    }
}

/// Counts the images of a demonstration that are reached, from measured rewards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ReachedGoals {
    reached: usize,
    goal_count: usize,
}

impl ReachedGoals {
    /// At the start of a demonstration with so many goals.
    pub fn new(goal_count: usize) -> Self {
        Self {
            reached: 0,
            goal_count,
        }
    }

    /// How many images are reached.
    pub fn reached(&self) -> usize {
        self.reached
    }

    /// Index, from 0, of the goal: the image after those reached, in the end the last one.
    pub fn next_index(&self) -> usize {
        self.reached.min(self.goal_count.saturating_sub(1))
    }

    /// Takes the reward measured after a motion.
    pub fn observe(&mut self, delta_reward: f64, complete: bool) -> Judgement {
        let is_last_goal = self.reached + 1 >= self.goal_count;
        let judgement = Judgement::from_reward(delta_reward, complete, is_last_goal);
        self.reached = judgement.apply(self.reached, self.goal_count);
        judgement
    }
}

/// A failed pick is left out within this distance: after a grasp that failed nothing has changed, and a policy would propose
/// the same pick for ever.
pub const FAILED_PICK_RADIUS_M: f64 = 0.005;

/// Picks that have just failed at the present goal.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FailedPicks {
    picks: Vec<Isometry2<f64>>,
}

impl FailedPicks {
    /// A motion has ended. A pick that met or held nothing is remembered; any other end may have changed the scene, so that
    /// the picks before it may work.
    pub fn record(&mut self, pick: &Isometry2<f64>, outcome: StepOutcome) {
        match outcome.motion() {
            Some(Outcome::NoContact | Outcome::GraspFailed) => self.picks.push(*pick),
            Some(Outcome::Placed | Outcome::Dropped | Outcome::LagAborted) => self.picks.clear(),
            // An arm that was stopped in a motion may have held something.
            None if outcome.arm_moved() => self.picks.clear(),
            None => {}
        }
    }

    /// Another goal: what failed there says nothing here.
    pub fn forget(&mut self) {
        self.picks.clear();
    }

    /// What the next attempt leaves out.
    pub fn exclusions(&self) -> impl Iterator<Item = Disk> {
        self.picks.iter().map(|pick| Disk {
            center_m: pick.translation.vector.into(),
            radius_m: FAILED_PICK_RADIUS_M,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::Workspace;

    fn image(mark: u8) -> Arc<Heightmap> {
        let mut heightmap = Heightmap::new(Workspace {
            rows: 1,
            cols: 1,
            ..Workspace::RAVENS
        });
        heightmap.rgb[0] = mark;
        Arc::new(heightmap)
    }

    fn step(delta_reward: f64, mark: u8) -> ShownStep {
        ShownStep {
            delta_reward,
            module: format!("module {mark}"),
            settings: PrimitiveSettings::RIGID,
            after: image(mark),
        }
    }

    #[test]
    fn goals_are_the_images_after_a_reward_each_with_the_one_before() {
        let steps = [step(0.5, 1), step(0.0, 2), step(-0.5, 3), step(0.5, 4)];
        let sequence = goals_of("placing", "placing/7", image(0), &steps).unwrap();
        let marks = |goal: &Goal| (goal.previous.as_ref().unwrap().rgb[0], goal.image.rgb[0]);
        let found: Vec<_> = sequence.goals.iter().map(marks).collect();
        assert_eq!(found, [(0, 1), (1, 4)]);
        let last = &sequence.goals[1];
        assert_eq!((last.step, last.step_count), (2, 2));
        assert_eq!(
            (last.demonstration.as_str(), last.module.as_str()),
            ("placing/7", "module 4")
        );
        assert_eq!(sequence.start.unwrap().rgb[0], 0);
        let error = goals_of("placing", "placing/7", image(0), &steps[1..3]).unwrap_err();
        assert!(
            error.to_string().contains("no step with a reward"),
            "{error}"
        );
    }

    #[test]
    fn a_gain_advances_a_loss_steps_back_and_the_last_goal_stays_until_all_is_complete() {
        let mut goals = ReachedGoals::new(3);
        let mut after = |delta, complete| {
            goals.observe(delta, complete);
            (goals.reached(), goals.next_index())
        };
        assert_eq!(after(0.0, false), (0, 0));
        assert_eq!(after(-0.5, false), (0, 0));
        assert_eq!(after(0.5, false), (1, 1));
        assert_eq!(after(0.5, false), (2, 2));
        assert_eq!(after(0.1, false), (2, 2));
        assert_eq!(after(-0.5, false), (1, 1));
        assert_eq!(after(0.5, false), (2, 2));
        assert_eq!(after(0.5, true), (3, 2));
    }

    #[test]
    fn a_failed_pick_is_left_out_until_something_was_held_or_the_goal_changes() {
        let pick = |x| Isometry2::new(nalgebra::Vector2::new(x, 0.1), 0.3);
        let mut failed = FailedPicks::default();
        failed.record(&pick(0.4), StepOutcome::GraspFailed);
        failed.record(&pick(0.5), StepOutcome::Refused);
        failed.record(&pick(0.6), StepOutcome::NoContact);
        let excluded: Vec<_> = failed.exclusions().map(|disk| disk.center_m.x).collect();
        assert_eq!(excluded, [0.4, 0.6]);
        for outcome in [
            StepOutcome::Placed,
            StepOutcome::Dropped,
            StepOutcome::Stopped,
        ] {
            let mut failed = failed.clone();
            failed.record(&pick(0.7), outcome);
            assert_eq!(failed.exclusions().count(), 0, "{outcome:?}");
        }
        failed.forget();
        assert_eq!(failed.exclusions().count(), 0);
    }
}
