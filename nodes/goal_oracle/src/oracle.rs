//! Which goal is next: proposals, results and confirmations in, goals out, no ROS around it.

use std::collections::{BTreeMap, BTreeSet};

use bags::Demonstration;
use msgs::{
    builtin_interfaces::Time,
    convert::{self, ConvertError},
    sctn_msgs::{Goal, Heightmap, PickPlace, PrimitiveSettings, StepConfirmation, StepResult},
    std_msgs::Header,
};

/// Proposal ids that are remembered as seen.
const MAX_SEEN: usize = 100_000;
/// No sequence is taught longer than this: every goal holds a heightmap.
const MAX_GOALS: usize = 1000;

/// A demonstration without a goal.
#[derive(Debug, thiserror::Error)]
pub enum SequenceError {
    /// Nothing in it earned a reward.
    #[error("the demonstration of {problem} has no step with a reward, expected at least one")]
    NoGoals {
        /// The problem.
        problem: String,
    },
    /// A goal cannot be written as a message.
    #[error("goal of step {step}: {source}")]
    Convert {
        /// From 1.
        step: usize,
        /// Why.
        source: ConvertError,
    },
}

/// Why a confirmation changes nothing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// No such proposal for the present goal.
    #[error("proposal {id} is unknown for step {step}, attempt {attempt}")]
    Unknown {
        /// The proposal named.
        id: u64,
        /// Of the present goal.
        step: u32,
        /// Of the present goal.
        attempt: u32,
    },
    /// It belongs to a goal that is past: stale or twice.
    #[error(
        "proposal {id} is of an earlier goal; the present one is step {step}, attempt {attempt}"
    )]
    Stale {
        /// The proposal named.
        id: u64,
        /// Of the present goal.
        step: u32,
        /// Of the present goal.
        attempt: u32,
    },
    /// Another decision on this proposal waits for the motion's end.
    #[error("proposal {id}: a decision waits for its result already")]
    Twice {
        /// The proposal named.
        id: u64,
    },
    /// The run is over.
    #[error("the run was stopped")]
    Stopped,
    /// The run is over.
    #[error("all steps are done")]
    Complete,
    /// A number that is no decision.
    #[error("decision is {0}, expected APPROVE=1, REJECT=2, ADVANCE=3, RETRY=4 or STOP=5")]
    NoDecision(u8),
    /// The parameter `require_confirmation` is false.
    #[error(
        "this oracle decides by itself (require_confirmation is false, or goal_module is not oracle)"
    )]
    NotAsked,
}

/// A step that the sequence does not have.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("step is {step}, expected 1 to {count}, the number of steps")]
pub struct NoSuchStep {
    step: u32,
    count: u32,
}

/// Why a heightmap cannot become a goal.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CaptureError {
    /// There is no goal to take the settings from.
    #[error("settings are all zero, and there is no goal beside it to take them from")]
    NoSettings,
    /// A setting is not positive.
    #[error("settings.{0}")]
    Settings(#[from] ConvertError),
    /// The sequence is full.
    #[error("the sequence has {MAX_GOALS} steps, which is the most")]
    TooMany,
}

/// A heightmap to become a goal.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// What was seen.
    pub heightmap: Heightmap,
    /// At the end of the sequence; else before the present goal.
    pub append: bool,
    /// Task module; empty for that of the goal beside it.
    pub module: String,
    /// Heights and speeds; all zero for those of the goal beside it.
    pub settings: PrimitiveSettings,
}

/// What an input leads to.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// Nothing to do.
    None,
    /// A new goal is to be latched.
    Goal(Box<Goal>),
    /// The operator ended the run.
    Stopped,
}

/// The proposal that was made for the present goal.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Current {
    id: u64,
    /// Stamp of its result, once the arm has moved for it.
    moved: Option<Time>,
    /// What the operator said before the result arrived here: the two come by different topics.
    waiting: Option<Verdict>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Advance,
    Retry,
}

/// Walks through the goals of a demonstration.
///
/// ADVANCE and RETRY count for the newest proposal of the present goal once the arm has moved for it,
/// whatever the motion's outcome: the operator has the last word. A STOP always counts.
#[derive(Debug)]
pub struct Oracle {
    goals: Vec<Goal>,
    /// Index of the present goal; the number of goals when complete.
    index: usize,
    attempt: u32,
    /// Heightmaps must not be older.
    stamp: Time,
    stopped: bool,
    current: Option<Current>,
    /// Earlier proposals for the present goal. The executor may have found that what came after them is no proposal.
    superseded: BTreeSet<u64>,
    /// Proposals of earlier goals and for other ones.
    seen: BTreeSet<u64>,
    decider: Decider,
    /// The highest attempt of each step that was latched with the present stamp: a step that comes again
    /// before anything has moved needs another one, or its proposals would be taken for the old ones.
    latched: BTreeMap<u32, u32>,
    /// The end of the last motion, completed or stopped.
    moved_until: Time,
    /// Goals that were captured.
    captured: u32,
}

/// Who says, after a motion, which goal is next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Decider {
    /// The operator, by ADVANCE and RETRY.
    Operator,
    /// The motion's outcome: PLACED advances.
    Outcome,
    /// The first heightmap after the motion: see [`Oracle::matched`].
    Image,
}

/// The goals of a demonstration: what was seen after each step with a reward.
pub fn sequence(
    demonstration: &Demonstration,
    world_frame: &str,
) -> Result<Vec<Goal>, SequenceError> {
    let rewarded: Vec<_> = demonstration
        .steps
        .iter()
        .filter(|step| step.delta_reward > 0.0)
        .zip(demonstration.goals())
        .collect();
    if rewarded.is_empty() {
        return Err(SequenceError::NoGoals {
            problem: demonstration.problem.clone(),
        });
    }
    let step_count = rewarded.len() as u32;
    let goal = |(index, (step, heightmap)): (usize, (&bags::DemonstrationStep, _))| {
        let header = Header {
            frame_id: world_frame.to_owned(),
            ..Header::default()
        };
        // How many views a demonstration was fused from is not known.
        let heightmap =
            convert::heightmap_to_msg(heightmap, header.clone(), 0, 0.0).map_err(|source| {
                SequenceError::Convert {
                    step: index + 1,
                    source,
                }
            })?;
        Ok(Goal {
            header,
            problem: demonstration.problem.clone(),
            demonstration: format!("{}/{}", demonstration.problem, demonstration.seed),
            step: index as u32 + 1,
            step_count,
            attempt: 0,
            complete: false,
            module: step.module.clone(),
            settings: convert::settings_to_msg(&step.settings),
            heightmap,
        })
    };
    let owned = rewarded
        .into_iter()
        .map(|(step, heightmap): (_, &heightmap::Heightmap)| (step, heightmap.clone()));
    owned.enumerate().map(goal).collect()
}

impl Oracle {
    /// Starts at the first of `goals`; without any it waits for [`Self::load`] or [`Self::capture`].
    pub fn new(goals: Vec<Goal>, decider: Decider) -> Self {
        Self {
            goals,
            index: 0,
            attempt: 0,
            stamp: Time::default(),
            stopped: false,
            current: None,
            superseded: BTreeSet::new(),
            seen: BTreeSet::new(),
            decider,
            latched: BTreeMap::from([(1, 0)]),
            moved_until: Time::default(),
            captured: 0,
        }
    }

    /// The present goal; after the last step the last one, marked as complete.
    pub fn goal(&self) -> Option<Goal> {
        let mut goal = self.goals.get(self.index).or(self.goals.last())?.clone();
        goal.header.stamp = self.stamp;
        goal.attempt = self.attempt;
        goal.complete = self.is_complete();
        Some(goal)
    }

    /// The images to be reached, one after the other.
    pub fn images(&self) -> impl Iterator<Item = &Heightmap> {
        self.goals.iter().map(|goal| &goal.heightmap)
    }

    /// The end of the last motion: older heightmaps show what is no more.
    pub fn moved_until(&self) -> Time {
        self.moved_until
    }

    /// Latches the goal of another step; the present one changes nothing unless the run has ended.
    pub fn set_step(&mut self, step: u32) -> Result<Change, NoSuchStep> {
        let count = self.goals.len() as u32;
        if !(1..=count).contains(&step) {
            return Err(NoSuchStep { step, count });
        }
        let index = step as usize - 1;
        if index == self.index && !self.stopped {
            return Ok(Change::None);
        }
        Ok(self.relatch(index))
    }

    /// Starts at the first goal of another sequence, of which there is at least one.
    pub fn load(&mut self, goals: Vec<Goal>) -> Change {
        self.goals = goals;
        self.captured = 0;
        self.relatch(0)
    }

    /// Takes what is seen into the sequence: the step that it ends, and the change.
    pub fn capture(&mut self, capture: Capture) -> Result<(u32, Change), CaptureError> {
        if self.goals.len() >= MAX_GOALS {
            return Err(CaptureError::TooMany);
        }
        let Capture {
            heightmap,
            append,
            module,
            settings,
        } = capture;
        let beside = self.goals.get(self.index).or(self.goals.last());
        let given = settings != PrimitiveSettings::default();
        if given {
            convert::settings_from_msg(&settings)?;
        }
        let (problem, demonstration) = match beside {
            Some(goal) => {
                let name = goal.demonstration.as_str();
                let name = name.rsplit_once('+').map_or(name, |(name, _)| name);
                (goal.problem.clone(), name.to_owned())
            }
            None => ("captured".to_owned(), "captured".to_owned()),
        };
        let goal = Goal {
            header: Header {
                frame_id: heightmap.header.frame_id.clone(),
                ..Header::default()
            },
            problem,
            settings: match (given, beside) {
                (true, _) => settings,
                (false, Some(goal)) => goal.settings,
                (false, None) => return Err(CaptureError::NoSettings),
            },
            module: match beside {
                Some(goal) if module.is_empty() => goal.module.clone(),
                _ => module,
            },
            heightmap,
            ..Goal::default()
        };
        let end = self.goals.len();
        let index = if append { end } else { self.index };
        self.goals.insert(index, goal);
        self.captured += 1;
        // Another name: goals of the same step number are not the same any more.
        let demonstration = format!("{demonstration}+{}", self.captured);
        let step_count = self.goals.len() as u32;
        for (index, goal) in self.goals.iter_mut().enumerate() {
            goal.step = index as u32 + 1;
            goal.step_count = step_count;
            goal.demonstration.clone_from(&demonstration);
        }
        // Whoever works on the present goal is not disturbed by what comes after it.
        let change = if index == self.index {
            self.relatch(index)
        } else {
            Change::None
        };
        Ok((index as u32 + 1, change))
    }

    /// Latches a goal because somebody said so, not because of a motion.
    fn relatch(&mut self, index: usize) -> Change {
        self.stopped = false;
        let order = |time: Time| (time.sec, time.nanosec);
        let stamp = std::cmp::max_by_key(self.stamp, self.moved_until, |time| order(*time));
        let step = index as u32 + 1;
        let before = self.latched.get(&step).filter(|_| stamp == self.stamp);
        let attempt = before.map_or(0, |attempt| attempt + 1);
        self.latch(index, attempt, stamp)
    }

    /// Whether all steps are done.
    pub fn is_complete(&self) -> bool {
        self.index == self.goals.len()
    }

    /// Whether the operator ended the run.
    pub fn is_stopped(&self) -> bool {
        self.stopped
    }

    /// Step (from 1), number of steps, attempt.
    pub fn progress(&self) -> (u32, u32, u32) {
        let count = self.goals.len() as u32;
        ((self.index as u32 + 1).min(count), count, self.attempt)
    }

    /// A proposal was published. The newest for the present goal is current, until the arm moves; one
    /// that is said again is the newest again.
    pub fn proposed(&mut self, proposal: &PickPlace) {
        let of_this_goal = !self.stopped
            && self.goals.get(self.index).is_some_and(|goal| {
                (proposal.step, proposal.attempt) == (goal.step, self.attempt)
                    && proposal.problem == goal.problem
            });
        if !of_this_goal {
            self.remember(proposal.id);
            return;
        }
        let moved = self.current.is_some_and(|current| current.moved.is_some());
        if moved || self.seen.contains(&proposal.id) {
            return;
        }
        self.superseded.remove(&proposal.id);
        match &self.current {
            Some(current) if current.id == proposal.id => {}
            other => {
                if let Some(superseded) = *other
                    && self.superseded.len() < MAX_SEEN
                {
                    self.superseded.insert(superseded.id);
                }
                self.current = Some(Current {
                    id: proposal.id,
                    moved: None,
                    waiting: None,
                });
            }
        }
    }

    /// The executor has reported.
    pub fn result(&mut self, result: &StepResult) -> Change {
        // Its stop may have been heard before.
        if result.outcome == StepResult::STOPPED && self.is_current(result.proposal_id) {
            self.moved_until = result.header.stamp;
        }
        if self.stopped || self.is_complete() {
            return Change::None;
        }
        match result.outcome {
            StepResult::PLACED
            | StepResult::NO_CONTACT
            | StepResult::GRASP_FAILED
            | StepResult::DROPPED
            | StepResult::LAG_ABORTED
            | StepResult::FAULT => self.moved(result),
            // Nothing has moved, so what was seen before still holds: the stamp stays.
            StepResult::REJECTED if self.is_current(result.proposal_id) => {
                self.latch(self.index, self.attempt + 1, self.stamp)
            }
            _ => Change::None,
        }
    }

    fn moved(&mut self, result: &StepResult) -> Change {
        let id = result.proposal_id;
        // The proposal itself may have been published before this node was discovered: the executor
        // has seen it, and it is not one of an earlier goal.
        if self.current.is_none() && !self.seen.contains(&id) {
            self.current = Some(Current {
                id,
                moved: None,
                waiting: None,
            });
        }
        // What came after it was no proposal to the executor, which knows more of them.
        if self.superseded.contains(&id)
            && self
                .current
                .is_some_and(|current| current.id != id && current.moved.is_none())
        {
            self.current = Some(Current {
                id,
                moved: None,
                waiting: None,
            });
        }
        let Some(current) = &mut self.current else {
            return Change::None;
        };
        if current.id != id || current.moved.is_some() {
            return Change::None;
        }
        current.moved = Some(result.header.stamp);
        self.moved_until = result.header.stamp;
        let verdict = match (self.decider, result.outcome) {
            (Decider::Operator, _) => current.waiting,
            (Decider::Outcome, StepResult::PLACED) => Some(Verdict::Advance),
            (Decider::Outcome, _) => Some(Verdict::Retry),
            (Decider::Image, _) => None,
        };
        match verdict {
            Some(verdict) => self.decide(verdict, result.header.stamp),
            None => Change::None,
        }
    }

    /// Stamp of a motion whose result waits for a heightmap to decide by.
    pub fn waits_for_image(&self) -> Option<Time> {
        let waits = self.decider == Decider::Image && !self.stopped;
        self.current.filter(|_| waits)?.moved
    }

    /// A heightmap seen after the motion looks most like the state in which so many goals are reached: the
    /// goal after them is next, be that further on, the same once more, or an earlier one.
    pub fn matched(&mut self, reached: usize) -> Change {
        let Some(stamp) = self.waits_for_image() else {
            return Change::None;
        };
        let reached = reached.min(self.goals.len());
        let attempt = if reached == self.index {
            self.attempt + 1
        } else {
            0
        };
        self.latch(reached, attempt, stamp)
    }

    /// The operator has spoken. Approvals and rejections are the executor's business.
    pub fn confirmed(&mut self, confirmation: &StepConfirmation) -> Result<Change, Refusal> {
        let verdict = match confirmation.decision {
            StepConfirmation::APPROVE | StepConfirmation::REJECT => return Ok(Change::None),
            StepConfirmation::STOP => {
                let first = !self.stopped;
                self.stopped = true;
                return Ok(if first { Change::Stopped } else { Change::None });
            }
            StepConfirmation::ADVANCE => Verdict::Advance,
            StepConfirmation::RETRY => Verdict::Retry,
            other => return Err(Refusal::NoDecision(other)),
        };
        if self.stopped {
            return Err(Refusal::Stopped);
        }
        if self.is_complete() {
            return Err(Refusal::Complete);
        }
        if self.decider != Decider::Operator {
            return Err(Refusal::NotAsked);
        }
        let id = confirmation.proposal_id;
        let (step, attempt) = (self.goals[self.index].step, self.attempt);
        match &mut self.current {
            Some(current) if current.id == id => match (current.moved, current.waiting) {
                (Some(stamp), _) => Ok(self.decide(verdict, stamp)),
                (None, None) => {
                    current.waiting = Some(verdict);
                    Ok(Change::None)
                }
                (None, Some(_)) => Err(Refusal::Twice { id }),
            },
            _ if self.seen.contains(&id) || self.superseded.contains(&id) => {
                Err(Refusal::Stale { id, step, attempt })
            }
            _ => Err(Refusal::Unknown { id, step, attempt }),
        }
    }

    fn is_current(&self, id: u64) -> bool {
        self.current.is_some_and(|current| current.id == id)
    }

    fn decide(&mut self, verdict: Verdict, stamp: Time) -> Change {
        match verdict {
            Verdict::Advance => self.latch(self.index + 1, 0, stamp),
            Verdict::Retry => self.latch(self.index, self.attempt + 1, stamp),
        }
    }

    fn latch(&mut self, index: usize, attempt: u32, stamp: Time) -> Change {
        if let Some(current) = self.current.take() {
            self.remember(current.id);
        }
        for id in std::mem::take(&mut self.superseded) {
            self.remember(id);
        }
        if stamp != self.stamp {
            self.latched.clear();
        }
        self.latched.insert(index as u32 + 1, attempt);
        self.index = index;
        self.attempt = attempt;
        self.stamp = stamp;
        match self.goal() {
            Some(goal) => Change::Goal(Box::new(goal)),
            None => Change::None,
        }
    }

    fn remember(&mut self, id: u64) {
        if self.seen.len() < MAX_SEEN {
            self.seen.insert(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn oracle(count: u32) -> Oracle {
        with_confirmation(count, true)
    }

    fn with_confirmation(count: u32, require_confirmation: bool) -> Oracle {
        let decider = match require_confirmation {
            true => Decider::Operator,
            false => Decider::Outcome,
        };
        decided_by(count, decider)
    }

    fn decided_by(count: u32, decider: Decider) -> Oracle {
        let goal = |step| Goal {
            problem: "placing".into(),
            step,
            step_count: count,
            ..Goal::default()
        };
        Oracle::new((1..=count).map(goal).collect(), decider)
    }

    fn proposal(id: u64, step: u32, attempt: u32) -> PickPlace {
        PickPlace {
            id,
            problem: "placing".into(),
            step,
            attempt,
            ..PickPlace::default()
        }
    }

    fn result(id: u64, outcome: u8, sec: i32) -> StepResult {
        let mut result = StepResult {
            proposal_id: id,
            outcome,
            ..StepResult::default()
        };
        result.header.stamp.sec = sec;
        result
    }

    fn says(decision: u8, proposal_id: u64) -> StepConfirmation {
        StepConfirmation {
            proposal_id,
            decision,
            ..StepConfirmation::default()
        }
    }

    fn goal(change: Change) -> (u32, u32, i32, bool) {
        match change {
            Change::Goal(goal) => (
                goal.step,
                goal.attempt,
                goal.header.stamp.sec,
                goal.complete,
            ),
            other => panic!("expected a goal, got {other:?}"),
        }
    }

    #[test]
    fn an_advance_after_the_motion_latches_the_next_goal_with_the_results_stamp() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        assert_eq!(
            oracle.result(&result(7, StepResult::PLACED, 5)),
            Change::None
        );
        let change = oracle
            .confirmed(&says(StepConfirmation::ADVANCE, 7))
            .unwrap();
        assert_eq!(goal(change), (2, 0, 5, false));
        oracle.proposed(&proposal(8, 2, 0));
        oracle.result(&result(8, StepResult::DROPPED, 9));
        let change = oracle
            .confirmed(&says(StepConfirmation::ADVANCE, 8))
            .unwrap();
        assert_eq!(goal(change), (2, 0, 9, true));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 8)),
            Err(Refusal::Complete)
        );
    }

    #[test]
    fn a_retry_keeps_the_step_and_counts_the_attempt() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        oracle.result(&result(7, StepResult::NO_CONTACT, 5));
        let change = oracle.confirmed(&says(StepConfirmation::RETRY, 7)).unwrap();
        assert_eq!(goal(change), (1, 1, 5, false));
    }

    #[test]
    fn a_rejection_asks_for_another_proposal_from_the_same_observation() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        let change = oracle.result(&result(7, StepResult::REJECTED, 5));
        assert_eq!(goal(change), (1, 1, 0, false));
        assert_eq!(
            oracle.result(&result(7, StepResult::REJECTED, 5)),
            Change::None
        );
    }

    #[test]
    fn a_decision_that_overtakes_its_result_waits_for_it() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        let early = oracle.confirmed(&says(StepConfirmation::ADVANCE, 7));
        assert_eq!(early, Ok(Change::None));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::RETRY, 7)),
            Err(Refusal::Twice { id: 7 })
        );
        let change = oracle.result(&result(7, StepResult::PLACED, 5));
        assert_eq!(goal(change), (2, 0, 5, false));
    }

    #[test]
    fn a_motion_for_a_proposal_that_was_not_heard_counts() {
        let mut oracle = oracle(2);
        assert_eq!(
            oracle.result(&result(7, StepResult::PLACED, 5)),
            Change::None
        );
        let change = oracle
            .confirmed(&says(StepConfirmation::ADVANCE, 7))
            .unwrap();
        assert_eq!(goal(change), (2, 0, 5, false));
    }

    #[test]
    fn stale_unknown_and_repeated_confirmations_change_nothing() {
        let mut oracle = oracle(3);
        oracle.proposed(&proposal(7, 1, 0));
        oracle.result(&result(7, StepResult::PLACED, 5));
        oracle
            .confirmed(&says(StepConfirmation::ADVANCE, 7))
            .unwrap();
        let before = oracle.goal();
        let (step, attempt) = (2, 0);
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 7)),
            Err(Refusal::Stale {
                id: 7,
                step,
                attempt
            })
        );
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::RETRY, 99)),
            Err(Refusal::Unknown {
                id: 99,
                step,
                attempt
            })
        );
        assert_eq!(oracle.confirmed(&says(77, 7)), Err(Refusal::NoDecision(77)));
        // The old result once more, and an old proposal once more.
        assert_eq!(
            oracle.result(&result(7, StepResult::PLACED, 5)),
            Change::None
        );
        oracle.proposed(&proposal(7, 1, 0));
        assert!(
            oracle
                .confirmed(&says(StepConfirmation::ADVANCE, 7))
                .is_err()
        );
        assert_eq!(oracle.goal(), before);
    }

    #[test]
    fn a_superseded_proposal_cannot_advance() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        oracle.proposed(&proposal(8, 1, 0));
        assert!(matches!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 7)),
            Err(Refusal::Stale { id: 7, .. })
        ));
        oracle.result(&result(8, StepResult::PLACED, 6));
        let change = oracle
            .confirmed(&says(StepConfirmation::ADVANCE, 8))
            .unwrap();
        assert_eq!(goal(change), (2, 0, 6, false));
    }

    #[test]
    fn what_the_executor_carried_out_counts_whatever_was_proposed_since() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        // Readable, of this step, and nothing that the executor would do.
        oracle.proposed(&proposal(8, 1, 0));
        oracle.result(&result(7, StepResult::PLACED, 5));
        assert!(
            oracle
                .confirmed(&says(StepConfirmation::ADVANCE, 8))
                .is_err()
        );
        let change = oracle
            .confirmed(&says(StepConfirmation::ADVANCE, 7))
            .unwrap();
        assert_eq!(goal(change), (2, 0, 5, false));
        // Said again, it is a proposal of an earlier goal.
        oracle.result(&result(7, StepResult::PLACED, 5));
        assert_eq!(oracle.progress(), (2, 2, 0));
    }

    #[test]
    fn a_proposal_said_again_may_be_decided_on_before_its_result_comes() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        oracle.proposed(&proposal(8, 1, 0));
        // What the policy does when the executor has refused 8.
        oracle.proposed(&proposal(7, 1, 0));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 7)),
            Ok(Change::None)
        );
        let change = oracle.result(&result(7, StepResult::PLACED, 5));
        assert_eq!(goal(change), (2, 0, 5, false));
    }

    #[test]
    fn proposals_for_another_problem_step_or_attempt_are_not_current() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 2, 0));
        oracle.proposed(&proposal(8, 1, 1));
        oracle.proposed(&PickPlace {
            problem: "chaining".into(),
            ..proposal(9, 1, 0)
        });
        for id in [7, 8, 9] {
            oracle.result(&result(id, StepResult::PLACED, 5));
            assert!(
                oracle
                    .confirmed(&says(StepConfirmation::ADVANCE, id))
                    .is_err()
            );
        }
        assert_eq!(oracle.progress(), (1, 2, 0));
    }

    #[test]
    fn a_refused_approval_changes_nothing() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        assert_eq!(
            oracle.result(&result(7, StepResult::REFUSED, 5)),
            Change::None
        );
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::APPROVE, 7)),
            Ok(Change::None)
        );
        assert_eq!(oracle.progress(), (1, 2, 0));
    }

    #[test]
    fn a_stop_ends_the_run_whatever_it_names() {
        let mut oracle = oracle(2);
        oracle.proposed(&proposal(7, 1, 0));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::STOP, 1234)),
            Ok(Change::Stopped)
        );
        oracle.result(&result(7, StepResult::PLACED, 5));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 7)),
            Err(Refusal::Stopped)
        );
        assert!(oracle.is_stopped() && !oracle.is_complete());
    }

    #[test]
    fn without_required_confirmation_the_outcome_decides() {
        let mut oracle = with_confirmation(2, false);
        oracle.proposed(&proposal(7, 1, 0));
        let change = oracle.result(&result(7, StepResult::GRASP_FAILED, 3));
        assert_eq!(goal(change), (1, 1, 3, false));
        oracle.proposed(&proposal(8, 1, 1));
        let change = oracle.result(&result(8, StepResult::PLACED, 5));
        assert_eq!(goal(change), (2, 0, 5, false));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 8)),
            Err(Refusal::NotAsked)
        );
    }

    #[test]
    fn another_step_is_latched_at_a_call_and_no_attempt_is_used_twice_before_something_moves() {
        let mut oracle = oracle(3);
        assert_eq!(oracle.set_step(1), Ok(Change::None));
        assert_eq!(goal(oracle.set_step(3).unwrap()), (3, 0, 0, false));
        assert_eq!(oracle.set_step(3), Ok(Change::None));
        // Its proposals of before would have the same ids.
        assert_eq!(goal(oracle.set_step(1).unwrap()), (1, 1, 0, false));
        for step in [0, 4] {
            let refusal = oracle.set_step(step).unwrap_err().to_string();
            assert!(refusal.contains("expected 1 to 3"), "{refusal}");
        }
        oracle.proposed(&proposal(7, 1, 1));
        oracle.result(&result(7, StepResult::PLACED, 5));
        // Before the operator has confirmed: what was seen before the motion is no ground to go on.
        assert_eq!(goal(oracle.set_step(3).unwrap()), (3, 0, 5, false));
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 7)),
            Err(Refusal::Stale {
                id: 7,
                step: 3,
                attempt: 0
            })
        );
    }

    #[test]
    fn a_step_that_is_set_ends_a_stop_and_a_completed_run() {
        let mut oracle = oracle(1);
        oracle.proposed(&proposal(7, 1, 0));
        oracle.confirmed(&says(StepConfirmation::STOP, 7)).unwrap();
        // The motion's end is heard after the stop.
        oracle.result(&result(7, StepResult::STOPPED, 4));
        assert_eq!(goal(oracle.set_step(1).unwrap()), (1, 0, 4, false));
        oracle.proposed(&proposal(8, 1, 0));
        oracle.result(&result(8, StepResult::PLACED, 6));
        let end = oracle.confirmed(&says(StepConfirmation::ADVANCE, 8));
        assert_eq!(goal(end.unwrap()), (1, 0, 6, true));
        // Nothing was proposed since that motion: attempts begin anew.
        assert_eq!(goal(oracle.set_step(1).unwrap()), (1, 0, 6, false));
    }

    #[test]
    fn another_sequence_starts_at_its_first_goal() {
        let mut oracle = oracle(3);
        oracle.set_step(2).unwrap();
        let other = Goal {
            problem: "chaining".into(),
            step: 1,
            step_count: 1,
            ..Goal::default()
        };
        let loaded = oracle.load(vec![other]);
        assert_eq!(goal(loaded), (1, 1, 0, false));
        assert_eq!(oracle.goal().unwrap().problem, "chaining");
        assert_eq!(oracle.progress(), (1, 1, 1));
    }

    fn seen(height_m: f32) -> Heightmap {
        Heightmap {
            height_m: vec![height_m],
            ..Heightmap::default()
        }
    }

    fn capture(height_m: f32, append: bool) -> Capture {
        Capture {
            heightmap: seen(height_m),
            append,
            module: String::new(),
            settings: PrimitiveSettings::default(),
        }
    }

    fn heights(oracle: &Oracle) -> Vec<f32> {
        oracle
            .images()
            .map(|image| image.height_m.first().copied().unwrap_or(-1.0))
            .collect()
    }

    #[test]
    fn what_is_captured_is_the_present_goal_or_the_last() {
        let mut oracle = oracle(2);
        oracle.set_step(2).unwrap();
        let (step, change) = oracle.capture(capture(0.1, false)).unwrap();
        assert_eq!((step, goal(change)), (2, (2, 1, 0, false)));
        assert_eq!(heights(&oracle), [-1.0, 0.1, -1.0]);
        // Whoever works on the present goal is not disturbed.
        assert_eq!(
            oracle.capture(capture(0.2, true)).unwrap(),
            (4, Change::None)
        );
        assert_eq!(heights(&oracle), [-1.0, 0.1, -1.0, 0.2]);
        let last = goal(oracle.set_step(4).unwrap());
        assert_eq!(last, (4, 0, 0, false));
        let last = oracle.goal().unwrap();
        assert_eq!((last.step_count, last.demonstration.as_str()), (4, "+2"));
    }

    #[test]
    fn a_sequence_can_be_taught_from_nothing() {
        let mut oracle = oracle(0);
        assert_eq!(oracle.goal(), None);
        oracle.proposed(&proposal(7, 1, 0));
        assert_eq!(
            oracle.capture(capture(0.1, true)),
            Err(CaptureError::NoSettings)
        );
        let mut first = capture(0.1, true);
        first.settings = convert::settings_to_msg(&pick_place::PrimitiveSettings::RIGID);
        let mut wrong = first.clone();
        wrong.settings.lift_m = f64::NAN;
        let refusal = oracle.capture(wrong).unwrap_err().to_string();
        assert!(refusal.contains("settings.lift_m"), "{refusal}");
        let (step, change) = oracle.capture(first).unwrap();
        assert_eq!((step, goal(change)), (1, (1, 1, 0, false)));
        let (step, change) = oracle.capture(capture(0.2, true)).unwrap();
        assert_eq!((step, change), (2, Change::None));
        let goal = oracle.goal().unwrap();
        assert_eq!((goal.problem.as_str(), goal.step_count), ("captured", 2));
        while oracle.goals.len() < MAX_GOALS {
            oracle.capture(capture(0.3, true)).unwrap();
        }
        assert_eq!(
            oracle.capture(capture(0.3, true)),
            Err(CaptureError::TooMany)
        );
    }

    #[test]
    fn an_image_after_the_motion_says_which_goal_is_next() {
        let mut oracle = decided_by(3, Decider::Image);
        oracle.proposed(&proposal(7, 1, 0));
        // Nothing has moved yet: what is seen decides nothing.
        assert_eq!(oracle.matched(2), Change::None);
        let result_of = |id, sec| result(id, StepResult::PLACED, sec);
        assert_eq!(oracle.result(&result_of(7, 5)), Change::None);
        assert_eq!(oracle.waits_for_image().unwrap().sec, 5);
        // The operator is not asked.
        assert_eq!(
            oracle.confirmed(&says(StepConfirmation::ADVANCE, 7)),
            Err(Refusal::NotAsked)
        );
        assert_eq!(goal(oracle.matched(1)), (2, 0, 5, false));
        // Not reached: once more. The same image counts once.
        oracle.proposed(&proposal(8, 2, 0));
        oracle.result(&result_of(8, 6));
        assert_eq!(goal(oracle.matched(1)), (2, 1, 6, false));
        assert_eq!(oracle.matched(1), Change::None);
        // Something was undone: back.
        oracle.proposed(&proposal(9, 2, 1));
        oracle.result(&result_of(9, 7));
        assert_eq!(goal(oracle.matched(0)), (1, 0, 7, false));
        oracle.proposed(&proposal(10, 1, 0));
        oracle.result(&result_of(10, 8));
        assert_eq!(goal(oracle.matched(9)), (3, 0, 8, true));
        assert!(oracle.is_complete());
    }

    #[test]
    fn after_a_stop_no_image_moves_the_goal() {
        let mut oracle = decided_by(2, Decider::Image);
        oracle.proposed(&proposal(7, 1, 0));
        oracle.result(&result(7, StepResult::PLACED, 5));
        oracle.confirmed(&says(StepConfirmation::STOP, 0)).unwrap();
        assert_eq!(oracle.matched(1), Change::None);
    }

    proptest! {
        /// However confused the messages, a step is passed only by a motion and an ADVANCE for it.
        #[test]
        fn steps_never_outnumber_motions(
            inputs in prop::collection::vec((0u8..3, 0u64..6, 0u8..12, 1u32..4, 0u32..3), 0..200)
        ) {
            let mut oracle = oracle(3);
            let mut moved = BTreeSet::new();
            for (kind, id, code, step, attempt) in inputs {
                match kind {
                    0 => oracle.proposed(&proposal(id, step, attempt)),
                    1 => {
                        if (1..=5).contains(&code) || code == StepResult::FAULT {
                            moved.insert(id);
                        }
                        oracle.result(&result(id, code, 1));
                    }
                    _ => drop(oracle.confirmed(&says(code, id))),
                }
                let (step, _, _) = oracle.progress();
                prop_assert!(step as usize <= moved.len() + 1);
            }
        }
    }
}
