//! Which goal is next.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use heightmap::Heightmap;
use pick_place::PrimitiveSettings;
use strum::{FromRepr, VariantArray};

use crate::mutation::{Mutation, planted};
use crate::{
    Confirmation, Coverage, Goal, GoalSequence, Judgement, OperatorDecision, Proposal, ProposalId,
    ProposalStatus, StepOutcome, StepResult,
};

/// Proposal ids that are remembered as seen.
const MAX_SEEN: usize = 100_000;
/// Attempts that are taken from proposals: higher ones are not those of an earlier life.
const MAX_ATTEMPTS: u32 = 1000;
/// No sequence is taught longer than this: every goal holds a heightmap.
const MAX_GOALS: usize = 1000;

/// Why a confirmation changes nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ConfirmationRefusal {
    /// No such proposal for the present goal.
    #[error("proposal {id} is unknown for step {step}, attempt {attempt}")]
    Unknown {
        /// The proposal named.
        id: ProposalId,
        /// Of the present goal.
        step: u32,
        /// Of the present goal.
        attempt: u32,
    },
    /// It belongs to a goal that is past: stale or repeated.
    #[error(
        "proposal {id} is of an earlier goal; the present one is step {step}, attempt {attempt}"
    )]
    Stale {
        /// The proposal named.
        id: ProposalId,
        /// Of the present goal.
        step: u32,
        /// Of the present goal.
        attempt: u32,
    },
    /// Another decision on this proposal is waiting for the result of its motion.
    #[error("proposal {id}: a decision waits for its result already")]
    Twice {
        /// The proposal named.
        id: ProposalId,
    },
    /// The run was stopped.
    #[error("the run was stopped")]
    Stopped,
    /// All steps are done.
    #[error("all steps are done")]
    Complete,
    /// A number that stands for no decision.
    #[error(
        "decision is {0}, expected APPROVE=1, REJECT=2, ADVANCE=3, RETRY=4, STOP=5 or STEP_BACK=6"
    )]
    NoDecision(u8),
    /// The tracker does not wait for an operator.
    #[error(
        "this oracle decides by itself (require_confirmation is false, or goal_module is not oracle)"
    )]
    NotAsked,
}

impl ConfirmationRefusal {
    /// What kind it is.
    pub const fn kind(&self) -> RefusalKind {
        match self {
            Self::Unknown { .. } => RefusalKind::Unknown,
            Self::Stale { .. } => RefusalKind::Stale,
            Self::Twice { .. } => RefusalKind::Twice,
            Self::Stopped => RefusalKind::Stopped,
            Self::Complete => RefusalKind::Complete,
            Self::NoDecision(_) => RefusalKind::NoDecision,
            Self::NotAsked => RefusalKind::NotAsked,
        }
    }
}

/// Kinds of a [`ConfirmationRefusal`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, FromRepr, VariantArray)]
#[repr(u8)]
pub enum RefusalKind {
    /// No such proposal for the present goal.
    Unknown = 1,
    /// It belongs to a goal that is past.
    Stale = 2,
    /// Another decision on the proposal waits for its result.
    Twice = 3,
    /// The run was stopped.
    Stopped = 4,
    /// All steps are done.
    Complete = 5,
    /// A number that stands for no decision.
    NoDecision = 6,
    /// The tracker does not wait for an operator.
    NotAsked = 7,
}

impl RefusalKind {
    /// All of them, in the order of their codes.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// The constant of the message `ConfirmationRefused`.
    pub const fn code(self) -> u8 {
        self as u8
    }
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
    /// The sequence is full.
    #[error("the sequence has {MAX_GOALS} steps, which is the most")]
    TooMany,
}

/// A heightmap to become a goal.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// What was seen.
    pub image: Arc<Heightmap>,
    /// How much of it was seen.
    pub coverage: Coverage,
    /// At the end of the sequence; else before the present goal.
    pub append: bool,
    /// Task module; empty for that of the goal beside it.
    pub module: String,
    /// Heights and speeds; none for those of the goal beside it.
    pub settings: Option<PrimitiveSettings>,
}

/// What an input leads to.
#[derive(Clone, Debug, PartialEq)]
pub enum Change {
    /// Nothing to do.
    None,
    /// A new goal is to be published.
    Goal(Box<Goal>),
    /// The operator ended the run.
    Stopped,
}

/// Who says, after a motion, which goal is next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepJudge {
    /// The operator, by ADVANCE, RETRY and STEP_BACK.
    Operator,
    /// The motion's outcome: PLACED advances.
    Outcome,
    /// The first heightmap after the motion: see [`GoalTracker::on_image_match`].
    Image,
}

/// The proposal that was made for the present goal.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Current {
    id: ProposalId,
    /// Stamp of its result, once the arm has moved for it.
    moved: Option<Duration>,
    /// The operator's decision that arrived before the result: the two come by different topics.
    queued: Option<Judgement>,
}

/// Walks through the goals of a demonstration.
///
/// ADVANCE, RETRY and STEP_BACK count for the newest proposal of the present goal once the arm has moved for it, whatever
/// the motion's outcome: the operator has the last word. A STOP always counts.
#[derive(Debug)]
pub struct GoalTracker {
    sequence: GoalSequence,
    /// Index of the present goal, which is the number of images reached.
    reached: usize,
    attempt: u32,
    /// Heightmaps must not be older.
    stamp: Duration,
    stopped: bool,
    current: Option<Current>,
    /// Earlier proposals for the present goal, with a decision that waits for a result. The executor may have refused those
    /// that came after them.
    superseded: BTreeMap<ProposalId, Option<Judgement>>,
    /// Proposals of earlier goals and for other ones.
    seen: BTreeSet<ProposalId>,
    judge: StepJudge,
    /// The highest attempt of each step that was published, or that somebody has proposed for, with the present stamp: a step
    /// that comes again before anything has moved needs another one, or its proposals would be taken for the old ones.
    attempts: BTreeMap<usize, u32>,
    /// The end of the last motion, completed or stopped.
    moved_until: Duration,
    /// Goals that were captured.
    captured: u32,
    /// Decisions that waited for a result in vain, and have not been reported yet.
    refused: Vec<(ProposalId, ConfirmationRefusal)>,
}

impl GoalTracker {
    /// Starts at the first goal; without any it waits for [`Self::load`] or [`Self::capture`].
    pub fn new(sequence: GoalSequence, judge: StepJudge) -> Self {
        Self {
            sequence,
            reached: 0,
            attempt: 0,
            stamp: Duration::ZERO,
            stopped: false,
            current: None,
            superseded: BTreeMap::new(),
            seen: BTreeSet::new(),
            judge,
            attempts: BTreeMap::from([(0, 0)]),
            moved_until: Duration::ZERO,
            captured: 0,
            refused: Vec::new(),
        }
    }

    /// The present goal; after the last step the last one, marked as complete.
    pub fn goal(&self) -> Option<Goal> {
        let goals = &self.sequence.goals;
        let index = self.reached.min(goals.len().checked_sub(1)?);
        let previous = match index.checked_sub(1) {
            Some(before) => Some(&goals[before].image),
            None => self.sequence.start.as_ref(),
        };
        Some(Goal {
            stamp: self.stamp,
            attempt: self.attempt,
            complete: self.is_complete(),
            previous: previous.map(Arc::clone),
            ..goals[index].clone()
        })
    }

    /// What was seen before the first step, then the images to be reached. Where the one of index `i` looks most like what
    /// is seen, `i` goals are reached. None if nobody saw the start.
    pub fn known_images(&self) -> Option<impl Iterator<Item = &Heightmap>> {
        let start = self.sequence.start.as_deref()?;
        let goals = self.sequence.goals.iter().map(|goal| &*goal.image);
        Some(std::iter::once(start).chain(goals))
    }

    /// What was seen before the first step of the demonstration.
    pub fn start(&self) -> Option<&Heightmap> {
        self.sequence.start.as_deref()
    }

    /// The end of the last motion: older heightmaps show what has changed since.
    pub fn moved_until(&self) -> Duration {
        self.moved_until
    }

    /// Publishes the goal of a step. The present one is published again, with a further attempt, where the run has ended or
    /// something was proposed for it: what the arm did since may be known to nobody, as after a start in mid-motion.
    ///
    /// # Errors
    /// There is no such step.
    pub fn set_step(&mut self, step: u32) -> Result<Change, NoSuchStep> {
        let count = self.sequence.goals.len() as u32;
        if !(1..=count).contains(&step) {
            return Err(NoSuchStep { step, count });
        }
        let index = step as usize - 1;
        if index == self.reached && !self.stopped && self.current.is_none() {
            return Ok(Change::None);
        }
        Ok(self.restart_at(index))
    }

    /// Starts at the first goal of another sequence, of which there is at least one.
    pub fn load(&mut self, sequence: GoalSequence) -> Change {
        self.sequence = sequence;
        self.captured = 0;
        self.restart_at(0)
    }

    /// Takes what is seen into the sequence: the step that it ends, and the change.
    ///
    /// # Errors
    /// The sequence is full, or there are no settings.
    pub fn capture(&mut self, capture: Capture) -> Result<(u32, Change), CaptureError> {
        let goals = &mut self.sequence.goals;
        if goals.len() >= MAX_GOALS {
            return Err(CaptureError::TooMany);
        }
        let beside = goals.get(self.reached).or(goals.last());
        let (problem, demonstration) = match beside {
            Some(goal) => {
                let name = goal.demonstration.as_str();
                let name = name.rsplit_once('+').map_or(name, |(name, _)| name);
                (goal.problem.clone(), name.to_owned())
            }
            None => ("captured".to_owned(), "captured".to_owned()),
        };
        let settings = capture.settings.or(beside.map(|goal| goal.settings));
        let goal = Goal {
            stamp: Duration::ZERO,
            problem,
            demonstration: String::new(),
            step: 0,
            step_count: 0,
            attempt: 0,
            complete: false,
            module: match beside {
                Some(goal) if capture.module.is_empty() => goal.module.clone(),
                _ => capture.module,
            },
            settings: settings.ok_or(CaptureError::NoSettings)?,
            image: capture.image,
            coverage: capture.coverage,
            previous: None,
        };
        let index = if capture.append {
            goals.len()
        } else {
            self.reached
        };
        goals.insert(index, goal);
        self.captured += 1;
        // Another name: goals of the same step number are not the same any more.
        let demonstration = format!("{demonstration}+{}", self.captured);
        let step_count = goals.len() as u32;
        for (index, goal) in goals.iter_mut().enumerate() {
            goal.step = index as u32 + 1;
            goal.step_count = step_count;
            goal.demonstration.clone_from(&demonstration);
        }
        // A goal that is appended does not disturb the work on the present one.
        let change = if index == self.reached {
            self.restart_at(index)
        } else {
            Change::None
        };
        Ok((index as u32 + 1, change))
    }

    /// Publishes a goal at a call, not because of a motion.
    fn restart_at(&mut self, index: usize) -> Change {
        let was_stopped = std::mem::take(&mut self.stopped);
        let stamp = self.stamp.max(self.moved_until);
        // Somebody may have proposed for the present step from what was seen after the motion, while the run was stopped too: that must
        // not be taken for new.
        let is_used = was_stopped || (index == self.reached && self.current.is_some());
        let attempt = match stamp == self.stamp || is_used {
            true => self.next_attempt(index),
            false => 0,
        };
        self.next_goal(index, attempt, stamp)
    }

    /// An attempt of a step that has no proposals yet, as long as nothing moves.
    fn next_attempt(&self, index: usize) -> u32 {
        let attempt = self.attempts.get(&index);
        attempt.map_or(0, |attempt| attempt.saturating_add(1))
    }

    /// A proposal for another goal: this tracker may have published that goal before it was started again.
    fn remember_attempt(&mut self, proposal: &Proposal) {
        let index = (proposal.step as usize).wrapping_sub(1);
        let goal = self.sequence.goals.get(index);
        if goal.is_some_and(|goal| goal.problem == proposal.problem)
            && proposal.attempt < MAX_ATTEMPTS
        {
            let attempt = self.attempts.entry(index).or_insert(proposal.attempt);
            *attempt = proposal.attempt.max(*attempt);
        }
    }

    /// Whether all steps are done.
    pub fn is_complete(&self) -> bool {
        self.reached == self.sequence.goals.len()
    }

    /// Whether the operator ended the run.
    pub fn is_stopped(&self) -> bool {
        self.stopped
    }

    /// Step (from 1), number of steps, attempt.
    pub fn progress(&self) -> (u32, u32, u32) {
        let count = self.sequence.goals.len() as u32;
        ((self.reached as u32 + 1).min(count), count, self.attempt)
    }

    /// A proposal was published. The newest for the present goal is current, until the arm moves; one that is repeated is
    /// the newest again.
    pub fn on_proposal(&mut self, proposal: &Proposal) {
        let of_this_goal = !self.stopped
            && self.sequence.goals.get(self.reached).is_some_and(|goal| {
                (proposal.step, proposal.attempt) == (goal.step, self.attempt)
                    && proposal.problem == goal.problem
            });
        if !of_this_goal {
            self.remember(proposal.id);
            self.remember_attempt(proposal);
            return;
        }
        if self.seen.contains(&proposal.id) || self.is_current(proposal.id) {
            return;
        }
        if self.has_moved() {
            // It is of this goal, and counts only if the arm moves for it too.
            if self.superseded.len() < MAX_SEEN {
                self.superseded.entry(proposal.id).or_default();
            }
            return;
        }
        let queued = self.superseded.remove(&proposal.id).flatten();
        self.make_current(proposal.id, queued);
    }

    /// The proposal becomes the one that decisions speak of; the one before is kept with its decision.
    fn make_current(&mut self, id: ProposalId, queued: Option<Judgement>) {
        let new = Current {
            id,
            moved: None,
            queued,
        };
        if let Some(before) = self.current.replace(new) {
            let queued = before
                .queued
                .filter(|_| !planted(Mutation::SupersessionDropsDecision));
            if self.superseded.len() < MAX_SEEN {
                self.superseded.insert(before.id, queued);
            } else if queued.is_some() {
                self.refuse_stale(before.id);
            }
        }
    }

    /// The executor has reported.
    pub fn on_result(&mut self, result: &StepResult) -> Change {
        let id = result.proposal_id;
        if result.outcome.is_of_home() {
            return Change::None;
        }
        // The stop itself may have arrived before.
        if result.outcome == StepOutcome::Stopped && result.arm_moved() && self.is_current(id) {
            self.moved_until = result.stamp;
        }
        if self.stopped || self.is_complete() {
            return Change::None;
        }
        let is_of_this_goal = self.is_current(id) || self.superseded.contains_key(&id);
        match (result.outcome, result.status) {
            // Its result was lost: only the refusal of a second approval says that the arm has moved.
            (StepOutcome::Refused, Some(ProposalStatus::Done))
                if is_of_this_goal && !self.has_moved() =>
            {
                self.on_motion(result)
            }
            // Nothing has moved, so what was seen before still holds: the stamp stays.
            (StepOutcome::Rejected, _)
            | (StepOutcome::Refused, Some(ProposalStatus::Rejected | ProposalStatus::Withdrawn))
                if is_of_this_goal && !self.has_moved() =>
            {
                self.next_goal(self.reached, self.next_attempt(self.reached), self.stamp)
            }
            (StepOutcome::Stopped, _) if self.judge != StepJudge::Operator => Change::None,
            _ if result.arm_moved() => self.on_motion(result),
            _ => Change::None,
        }
    }

    fn has_moved(&self) -> bool {
        self.current.is_some_and(|current| current.moved.is_some())
    }

    fn on_motion(&mut self, result: &StepResult) -> Change {
        let id = result.proposal_id;
        // The proposal itself may have been published before this node was discovered: the executor knows it, and it is not
        // one of an earlier goal.
        let is_new = !self.seen.contains(&id) || planted(Mutation::ResultCountsTwice);
        if self.current.is_none() && is_new {
            self.make_current(id, None);
        }
        // The executor has not accepted what came after it; or the arm has moved again before anybody decided on the motion
        // before: then the last motion is the one to decide on, unless a decision on the first one waits for its result.
        let mut stamp = result.stamp;
        if let Some(current) = self.current.filter(|current| current.id != id)
            && is_new
        {
            let queued = self.superseded.get(&id).copied();
            let is_newer = current.moved < Some(stamp) && (queued.is_some() || self.has_moved());
            if is_newer || queued.flatten().is_some() {
                stamp = current.moved.map_or(stamp, |moved| moved.max(stamp));
                self.superseded.remove(&id);
                self.make_current(id, queued.flatten());
            }
        }
        let Some(current) = &mut self.current else {
            return Change::None;
        };
        if current.id != id || current.moved.is_some() {
            return Change::None;
        }
        current.moved = Some(stamp);
        self.moved_until = stamp;
        let judgement = match (self.judge, result.outcome) {
            (StepJudge::Operator, _) => current.queued.take(),
            (StepJudge::Outcome, StepOutcome::Placed) => Some(Judgement::Advance),
            (StepJudge::Outcome, _) => Some(Judgement::Retry),
            (StepJudge::Image, _) => None,
        };
        match judgement {
            Some(judgement) => self.after_motion(judgement, stamp),
            None => Change::None,
        }
    }

    /// Stamp of a motion whose result waits for a heightmap to decide by.
    pub fn waits_for_image(&self) -> Option<Duration> {
        let waits = self.judge == StepJudge::Image && !self.stopped;
        self.current.filter(|_| waits)?.moved
    }

    /// A heightmap seen after the motion looks most like the state in which so many goals are reached: the goal after them
    /// is next, be that further on, the same once more, or an earlier one.
    pub fn on_image_match(&mut self, reached: usize) -> Change {
        let Some(stamp) = self.waits_for_image() else {
            return Change::None;
        };
        self.reached_after_motion(reached.min(self.sequence.goals.len()), stamp)
    }

    /// The operator has decided. Approvals and rejections are the executor's business.
    ///
    /// # Errors
    /// Says why the decision changes nothing.
    pub fn on_confirmation(
        &mut self,
        confirmation: &Confirmation,
    ) -> Result<Change, ConfirmationRefusal> {
        let Some(judgement) = Judgement::from_decision(confirmation.decision) else {
            return Ok(match confirmation.decision {
                OperatorDecision::Stop => self.stop(),
                _ => Change::None,
            });
        };
        if self.stopped {
            return Err(ConfirmationRefusal::Stopped);
        }
        if self.is_complete() {
            return Err(ConfirmationRefusal::Complete);
        }
        if self.judge != StepJudge::Operator {
            return Err(ConfirmationRefusal::NotAsked);
        }
        let id = confirmation.proposal_id;
        match &mut self.current {
            Some(current) if current.id == id => match (current.moved, current.queued) {
                (Some(stamp), _) => Ok(self.after_motion(judgement, stamp)),
                (None, _) if planted(Mutation::AdvanceWithoutMotion) => {
                    Ok(self.after_motion(judgement, self.stamp))
                }
                (None, None) => {
                    current.queued = Some(judgement);
                    Ok(Change::None)
                }
                (None, Some(_)) => Err(ConfirmationRefusal::Twice { id }),
            },
            _ => Err(self.refusal(id)),
        }
    }

    /// Decisions that waited for a result and cannot count any more, since the last call: each is to be reported.
    pub fn take_refused(&mut self) -> Vec<(ProposalId, ConfirmationRefusal)> {
        std::mem::take(&mut self.refused)
    }

    fn stop(&mut self) -> Change {
        let queued = self.take_queued();
        let stopped = queued
            .into_iter()
            .map(|id| (id, ConfirmationRefusal::Stopped));
        self.refused.extend(stopped);
        if std::mem::replace(&mut self.stopped, true) {
            Change::None
        } else {
            Change::Stopped
        }
    }

    /// Why a decision on a proposal that is not current changes nothing.
    fn refusal(&self, id: ProposalId) -> ConfirmationRefusal {
        let (step, _, attempt) = self.progress();
        if self.seen.contains(&id) || self.superseded.contains_key(&id) {
            ConfirmationRefusal::Stale { id, step, attempt }
        } else {
            ConfirmationRefusal::Unknown { id, step, attempt }
        }
    }

    fn refuse_stale(&mut self, id: ProposalId) {
        let (step, _, attempt) = self.progress();
        let refusal = ConfirmationRefusal::Stale { id, step, attempt };
        self.refused.push((id, refusal));
    }

    /// Proposals with a decision that waits for their result; it will wait no more.
    fn take_queued(&mut self) -> Vec<ProposalId> {
        let current = self.current.as_mut();
        let current = current.and_then(|current| current.queued.take().map(|_| current.id));
        let superseded = self.superseded.iter_mut();
        let superseded = superseded.filter_map(|(id, queued)| queued.take().map(|_| *id));
        superseded.chain(current).collect()
    }

    fn is_current(&self, id: ProposalId) -> bool {
        self.current.is_some_and(|current| current.id == id)
    }

    fn after_motion(&mut self, judgement: Judgement, stamp: Duration) -> Change {
        let reached = judgement.apply(self.reached, self.sequence.goals.len());
        if let Some(current) = &mut self.current {
            // It counts now; whatever else waits does not.
            current.queued = None;
        }
        self.reached_after_motion(reached, stamp)
    }

    fn reached_after_motion(&mut self, reached: usize, stamp: Duration) -> Change {
        let attempt = if reached == self.reached {
            self.attempt + 1
        } else {
            0
        };
        self.next_goal(reached, attempt, stamp)
    }

    fn next_goal(&mut self, reached: usize, attempt: u32, stamp: Duration) -> Change {
        let queued = self.take_queued();
        let past = self.current.take().map(|current| current.id);
        let superseded = std::mem::take(&mut self.superseded).into_keys();
        for id in superseded.chain(past) {
            self.remember(id);
        }
        if stamp != self.stamp {
            self.attempts.clear();
        }
        self.attempts.insert(reached, attempt);
        self.reached = reached;
        self.attempt = attempt;
        self.stamp = stamp;
        for id in queued {
            self.refuse_stale(id);
        }
        match self.goal() {
            Some(goal) => Change::Goal(Box::new(goal)),
            None => Change::None,
        }
    }

    fn remember(&mut self, id: ProposalId) {
        if self.seen.len() < MAX_SEEN {
            self.seen.insert(id);
        }
    }
}
