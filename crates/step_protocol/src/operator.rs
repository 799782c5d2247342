//! The operator's side: which question is due, how far the run is, and what has to be decided again.

use std::collections::VecDeque;
use std::time::Duration;

use crate::gate::REHEARSAL_GRACE;
use crate::mutation::{Mutation, planted};
use crate::{
    Confirmation, Goal, Judgement, OperatorDecision, Proposal, ProposalId, ProposalStatus,
    RefusalKind, Reward, StepOutcome, StepResult,
};

/// Proposals that are remembered: their result may still come, or they are published again.
const PROPOSALS: usize = 256;
/// Decisions of this operator that have not come back on the topic yet.
const SENT: usize = 64;
/// An approval is answered in this time, by its refusal or by the motion; and a decision on a step, by the next goal. The
/// executor refuses an approval that waits for its rehearsal a second earlier.
const ANSWERED_WITHIN: Duration = REHEARSAL_GRACE.saturating_add(Duration::from_secs(1));
/// A goal, or another proposal, follows in this time where a proposal was closed or judged.
const FOLLOWED_WITHIN: Duration = Duration::from_secs(10);

/// A question to the operator.
#[derive(Clone, Debug, PartialEq)]
pub enum Question {
    /// Carry this proposal out?
    Approve(Proposal),
    /// Did this step succeed?
    Confirm {
        /// What the executor said of the motion.
        result: StepResult,
        /// The reward that the simulator measured after it; `None` where nothing measures one, or its message was lost.
        reward: Option<Reward>,
        /// Whether the proposal was for the last goal of the demonstration.
        is_last_goal: bool,
    },
}

impl Question {
    /// The proposal that it is about.
    pub fn proposal_id(&self) -> ProposalId {
        match self {
            Self::Approve(proposal) => proposal.id,
            Self::Confirm { result, .. } => result.proposal_id,
        }
    }

    /// What the automatic operator answers: approval, and the simulator's reward as the judge of a step. Without a reward
    /// the step is tried again.
    pub fn automatic_answer(&self) -> OperatorDecision {
        match self {
            Self::Approve(_) => OperatorDecision::Approve,
            Self::Confirm {
                reward: Some(reward),
                is_last_goal,
                ..
            } => Judgement::from_reward(reward.delta, reward.complete, *is_last_goal).decision(),
            Self::Confirm { reward: None, .. } => OperatorDecision::Retry,
        }
    }
}

/// A motion that has ended, until the operator has been asked about it.
#[derive(Clone, Debug)]
struct Motion {
    proposal: Proposal,
    result: StepResult,
}

/// How far a run is, as the operator sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunPhase {
    /// No goal has come.
    NoGoal,
    /// Nothing is proposed for the present goal, or what was decided last has not been answered yet.
    AwaitingProposal,
    /// A proposal waits for the operator.
    Proposed,
    /// The approved proposal is being carried out.
    Moving,
    /// The arm has moved: the operator says whether the step succeeded.
    AwaitingConfirmation,
    /// The motion broke off by itself.
    Fault,
    /// The run was stopped.
    Stopped,
    /// All steps are done.
    Complete,
}

impl RunPhase {
    /// In one word.
    pub const fn name(self) -> &'static str {
        match self {
            Self::NoGoal => "no_goal",
            Self::AwaitingProposal => "awaiting_proposal",
            Self::Proposed => "proposed",
            Self::Moving => "moving",
            Self::AwaitingConfirmation => "awaiting_confirmation",
            Self::Fault => "fault",
            Self::Stopped => "stopped",
            Self::Complete => "complete",
        }
    }
}

/// Where a proposal stands, as far as this operator has heard.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Standing {
    /// It waits for a decision.
    Open,
    /// It was approved; its result has not come.
    Approved,
    /// It was rejected, withdrawn or superseded: it can never be approved again.
    Closed,
    /// The arm has moved for it, to this end; `Refused` where only the refusal of a second approval says so.
    Moved(StepOutcome),
    /// The arm has moved for it, and an operator has said whether the step succeeded.
    Judged(StepOutcome),
}

#[derive(Clone, Debug)]
struct Known {
    proposal: Proposal,
    standing: Standing,
    /// The goal tracker does not know it: its decisions do not count, and it hides no other proposal.
    unknown_to_tracker: bool,
}

/// A decision that nothing has come of yet.
#[derive(Clone, Copy, Debug)]
struct Unanswered {
    id: ProposalId,
    decision: OperatorDecision,
    /// Where the proposal stood before it; none of a way home.
    before: Option<Standing>,
    /// When it was made; of an approval, when the arm moved last. None until the next [`Operator::ask_again`], where only the
    /// executor has said that it moves.
    since: Option<Duration>,
}

/// Pairs what arrives on different topics, in whatever order, into questions, each asked once; and knows how far the run is.
///
/// A program and a person at a terminal answer the questions that the inputs return. A page shows [`Self::phase`] and
/// [`Self::current`], and calls [`Self::ask_again`] and [`Self::probe`] from time to time. Times are monotonic, from any origin.
#[derive(Debug)]
pub struct Operator {
    /// Whether something measures rewards: a question about a motion then waits for its reward.
    has_rewards: bool,
    /// The goal tracker knows of the motions that ended by its stamp.
    goal: Option<Goal>,
    /// The newest is the last.
    proposals: VecDeque<Known>,
    /// Of these, those whose last approval was refused; the one that was refused last is the last.
    refused: Vec<ProposalId>,
    /// Waits for its reward.
    motion: Option<Motion>,
    /// The last motion that a stop or a fault broke off: nothing measures it, and it is asked about on silence only.
    broken_off: Option<Motion>,
    /// The last question about a motion.
    confirm: Option<Question>,
    /// Whether the newest proposal was asked about.
    asked: bool,
    reward: Option<Reward>,
    /// Whether the run was stopped since the present goal came.
    stopped: bool,
    /// One for each proposal at most.
    unanswered: Vec<Unanswered>,
    /// Proposal and decision of this operator's own confirmations: they counted when they were made.
    sent: VecDeque<(ProposalId, OperatorDecision)>,
    /// When it was first seen that nothing follows the proposal that was closed or judged last.
    quiet_since: Option<Duration>,
}

impl Operator {
    /// An operator who has received nothing yet.
    pub fn new(has_rewards: bool) -> Self {
        Self {
            has_rewards,
            goal: None,
            proposals: VecDeque::new(),
            refused: Vec::new(),
            motion: None,
            broken_off: None,
            confirm: None,
            asked: false,
            reward: None,
            stopped: false,
            unanswered: Vec::new(),
            sent: VecDeque::new(),
            quiet_since: None,
        }
    }

    /// The present goal.
    pub fn goal(&self) -> Option<&Goal> {
        self.goal.as_ref()
    }

    /// What was measured last.
    pub fn reward(&self) -> Option<&Reward> {
        self.reward.as_ref()
    }

    /// A proposal that has come, by its id.
    pub fn proposal(&self, id: ProposalId) -> Option<&Proposal> {
        self.known(id).map(|known| &known.proposal)
    }

    /// Whether the run was stopped since the present goal came.
    pub fn is_stopped(&self) -> bool {
        self.stopped
    }

    fn known(&self, id: ProposalId) -> Option<&Known> {
        let mut known = self.proposals.iter().rev();
        known.find(|known| known.proposal.id == id)
    }

    fn known_mut(&mut self, id: ProposalId) -> Option<&mut Known> {
        let mut known = self.proposals.iter_mut().rev();
        known.find(|known| known.proposal.id == id)
    }

    /// How far the run is.
    pub fn phase(&self) -> RunPhase {
        match &self.goal {
            None => return RunPhase::NoGoal,
            Some(goal) if goal.complete => return RunPhase::Complete,
            Some(_) if self.stopped => return RunPhase::Stopped,
            Some(_) => {}
        }
        match self.current_known().map(|known| known.standing) {
            None | Some(Standing::Closed | Standing::Judged(_)) => RunPhase::AwaitingProposal,
            Some(Standing::Open) => RunPhase::Proposed,
            Some(Standing::Approved) => RunPhase::Moving,
            Some(Standing::Moved(StepOutcome::Fault)) => RunPhase::Fault,
            Some(Standing::Moved(_)) => RunPhase::AwaitingConfirmation,
        }
    }

    /// The proposal that a decision would be about: the one for the present goal that the arm moves or has moved for; else the
    /// one whose rejection is not answered; else the newest that can be decided on, and where there is none, the newest.
    pub fn current(&self) -> Option<&Proposal> {
        self.current_known().map(|known| &known.proposal)
    }

    fn current_known(&self) -> Option<&Known> {
        let goal = self.goal.as_ref()?;
        let newest = self.proposals.back().map(|newest| newest.proposal.id);
        // A demonstration that is repeated has the same steps again: what was seen before its goal is of the time before.
        let of_goal = |known: &&Known| {
            let is_hidden = planted(Mutation::OtherGoalHidesProposal)
                && newest.is_some_and(|newest| newest != known.proposal.id);
            is_for(&known.proposal, goal) && known.proposal.stamp >= goal.stamp && !is_hidden
        };
        let of_goal = || self.proposals.iter().rev().filter(of_goal);
        let is_at_work = |known: &&Known| match known.standing {
            Standing::Approved | Standing::Judged(_) => true,
            Standing::Moved(_) => {
                !known.unknown_to_tracker || planted(Mutation::UnknownMotionHidesProposal)
            }
            Standing::Open | Standing::Closed => false,
        };
        let is_unanswered = |known: &&Known| {
            let mut unanswered = self.unanswered.iter();
            unanswered.any(|asked| asked.id == known.proposal.id)
        };
        of_goal()
            .find(is_at_work)
            .or_else(|| of_goal().find(is_unanswered))
            .or_else(|| of_goal().find(|known| known.standing == Standing::Open))
            .or_else(|| of_goal().next())
    }

    /// A goal was published: after a motion that has ended by its stamp nothing is to be confirmed any more.
    pub fn on_goal(&mut self, goal: &Goal) {
        // The same one, latched again, answers nothing.
        if self.goal.as_ref() != Some(goal) {
            self.stopped = false;
            self.quiet_since = None;
            self.end_decisions();
        }
        self.goal = Some(goal.clone());
        let is_confirmed = |motion: &mut Motion| motion.result.stamp <= goal.stamp;
        self.motion.take_if(is_confirmed);
        self.broken_off.take_if(is_confirmed);
    }

    /// The goal tracker goes on with the present goal, as it was asked to: where it had heard neither of a stop nor of a proposal, no other
    /// goal comes.
    pub fn on_continued(&mut self) {
        self.stopped = false;
    }

    /// A new proposal supersedes the one before. While a motion for the same goal waits for its confirmation nothing more is
    /// to move for it.
    pub fn on_proposal(&mut self, proposal: Proposal) -> Option<Question> {
        let id = proposal.id;
        let newest = self.proposals.back();
        if newest.is_some_and(|newest| newest.proposal.id == id) {
            return None;
        }
        self.quiet_since = None;
        let index = self
            .proposals
            .iter()
            .position(|known| known.proposal.id == id);
        let before = index.and_then(|index| self.proposals.remove(index));
        if self.proposals.len() == PROPOSALS {
            let oldest = self.proposals.pop_front();
            let is_other = |refused: &ProposalId| {
                let oldest = oldest.as_ref();
                oldest.is_none_or(|oldest| oldest.proposal.id != *refused)
            };
            self.refused.retain(is_other);
        }
        let of_same_goal = |motion: &Motion| {
            let goal = |proposal: &Proposal| (proposal.step, proposal.attempt);
            goal(&motion.proposal) == goal(&proposal) && motion.proposal.problem == proposal.problem
        };
        self.asked = !self.motion.as_ref().is_some_and(of_same_goal);
        let question = self.asked.then(|| Question::Approve(proposal.clone()));
        self.proposals.push_back(Known {
            proposal,
            standing: before
                .as_ref()
                .map_or(Standing::Open, |before| before.standing),
            unknown_to_tracker: before.is_some_and(|before| before.unknown_to_tracker),
        });
        question
    }

    /// This operator decides: the confirmation is being published.
    pub fn decide(&mut self, confirmation: &Confirmation, now: Duration) {
        self.count(confirmation, true, now);
        if self.sent.len() == SENT {
            self.sent.pop_front();
        }
        let Confirmation {
            proposal_id,
            decision,
            ..
        } = confirmation;
        self.sent.push_back((*proposal_id, *decision));
    }

    /// A decision has come on the topic. Returns whether it is news: this operator's own counted when it was made, and may come
    /// back after its answer.
    pub fn on_confirmation(&mut self, confirmation: &Confirmation, now: Duration) -> bool {
        let key = (confirmation.proposal_id, confirmation.decision);
        let own = self.sent.iter().position(|sent| *sent == key);
        if let Some(index) = own {
            self.sent.remove(index);
            return false;
        }
        self.count(confirmation, false, now);
        true
    }

    fn count(&mut self, confirmation: &Confirmation, is_own: bool, now: Duration) {
        use OperatorDecision::{Advance, Approve, Reject, Retry, StepBack, Stop};
        let (id, decision) = (confirmation.proposal_id, confirmation.decision);
        self.quiet_since = None;
        if decision == Stop {
            self.stopped = self.goal.as_ref().is_some_and(|goal| !goal.complete);
            // What waits for an answer comes to nothing, or the executor says what has become of it.
            for asked in std::mem::take(&mut self.unanswered) {
                self.reopen(asked);
            }
            return;
        }
        let before = match self.known_mut(id) {
            Some(known) => {
                let standing = match (decision, known.standing) {
                    (Approve, Standing::Open) => Standing::Approved,
                    (Reject, Standing::Open) => Standing::Closed,
                    (Advance | Retry | StepBack, Standing::Moved(outcome)) => {
                        Standing::Judged(outcome)
                    }
                    _ => return,
                };
                Some(std::mem::replace(&mut known.standing, standing))
            }
            // Of the way home.
            None if is_own && decision == Approve => None,
            None => return,
        };
        self.unanswered.retain(|asked| asked.id != id);
        self.unanswered.push(Unanswered {
            id,
            decision,
            before,
            since: Some(now),
        });
    }

    /// The arm moves: what was approved is not answered before its end.
    pub fn on_motion(&mut self, now: Duration) {
        let approved = |asked: &&mut Unanswered| asked.decision == OperatorDecision::Approve;
        let approved = self.unanswered.iter_mut().filter(approved);
        approved.for_each(|asked| asked.since = Some(now));
    }

    /// The goal tracker has refused a decision on a step; `kind` is none where this version does not know it.
    pub fn on_confirmation_refused(&mut self, id: ProposalId, kind: Option<RefusalKind>) {
        self.quiet_since = None;
        // An approval or a rejection is the executor's to answer.
        self.unanswered
            .retain(|asked| asked.id != id || Judgement::from_decision(asked.decision).is_none());
        match kind {
            // The question is still open.
            Some(RefusalKind::Unknown) => {
                if let Some(known) = self.known_mut(id)
                    && let Standing::Judged(outcome) = known.standing
                {
                    known.standing = Standing::Moved(outcome);
                    known.unknown_to_tracker = true;
                }
            }
            Some(RefusalKind::Stale) => self.on_stale(id),
            Some(RefusalKind::Stopped) => {
                self.stopped = self.goal.as_ref().is_some_and(|goal| !goal.complete);
            }
            _ => {}
        }
    }

    /// The goal tracker does not decide on this motion, and it hides neither a later one for the present goal nor what is proposed for
    /// that.
    fn on_stale(&mut self, id: ProposalId) {
        let goal = self.goal.as_ref();
        let has_other = self.proposals.iter().any(|known| {
            let is_due = match known.standing {
                Standing::Open => true,
                Standing::Moved(_) => !known.unknown_to_tracker,
                Standing::Approved | Standing::Closed | Standing::Judged(_) => false,
            };
            let is_of_goal = goal.is_some_and(|goal| is_for(&known.proposal, goal));
            known.proposal.id != id && is_due && is_of_goal
        });
        if let Some(known) = self.known_mut(id).filter(|_| has_other)
            && let Standing::Judged(_) = known.standing
            && !planted(Mutation::StaleMotionHidesOthers)
        {
            known.standing = Standing::Closed;
        }
    }

    /// Opens the question again whose decision nobody has answered in time: it may have been lost. Returns proposal and decision.
    pub fn ask_again(&mut self, now: Duration) -> Option<(ProposalId, OperatorDecision)> {
        if planted(Mutation::UnansweredIsForgotten) {
            return None;
        }
        let is_late = |asked: &mut Unanswered| {
            let since = *asked.since.get_or_insert(now);
            now.saturating_sub(since) > ANSWERED_WITHIN
        };
        loop {
            let index = self.unanswered.iter_mut().position(is_late)?;
            let asked = self.unanswered.remove(index);
            self.reopen(asked);
            // What stays closed is not to be decided again: see `probe`.
            if asked.before != Some(Standing::Closed) {
                return Some((asked.id, asked.decision));
            }
        }
    }

    /// Another goal has come: it answers what was decided on a step. What was approved for the goal before may come to nothing; the
    /// executor says what has become of it.
    fn end_decisions(&mut self) {
        for asked in std::mem::take(&mut self.unanswered) {
            if asked.decision == OperatorDecision::Approve {
                self.reopen(asked);
            }
        }
        for known in &mut self.proposals {
            if let Standing::Judged(_) = known.standing {
                known.standing = Standing::Closed;
            }
        }
    }

    /// The proposal stands where it stood before the decision.
    fn reopen(&mut self, asked: Unanswered) {
        if let (Some(before), Some(known)) = (asked.before, self.known_mut(asked.id)) {
            known.standing = before;
        }
    }

    /// The proposal to be rejected once more, where neither a goal nor another proposal has followed one that was closed or judged:
    /// what lets things go on was lost. A rejection moves nothing, and the executor's answer says where the proposal stands, for
    /// everybody.
    pub fn probe(&mut self, now: Duration) -> Option<ProposalId> {
        let waits = self.phase() == RunPhase::AwaitingProposal && self.unanswered.is_empty();
        let Some(id) = self.to_be_probed().filter(|_| waits) else {
            self.quiet_since = None;
            return None;
        };
        let since = *self.quiet_since.get_or_insert(now);
        if now.saturating_sub(since) <= FOLLOWED_WITHIN {
            return None;
        }
        self.quiet_since = Some(now);
        Some(id)
    }

    /// The one that was judged; else each proposal for the present goal in turn, as each may be of another author.
    fn to_be_probed(&self) -> Option<ProposalId> {
        let (current, goal) = (self.current_known()?, self.goal.as_ref()?);
        if let Standing::Judged(_) = current.standing {
            return Some(current.proposal.id);
        }
        let proposals = self.proposals.iter().map(|known| &known.proposal);
        let of_goal = proposals.filter(|proposal| is_for(proposal, goal));
        let refusal = |proposal: &&Proposal| self.refused.iter().position(|id| *id == proposal.id);
        of_goal.min_by_key(refusal).map(|proposal| proposal.id)
    }

    /// The executor's word on a proposal. The refusal of one that was carried out before says that its result was lost.
    pub fn on_result(&mut self, result: StepResult) -> Option<Question> {
        self.stand(&result);
        let id = result.proposal_id;
        let refused = result.outcome == StepOutcome::Refused;
        let is_at_home = refused || result.outcome.motion().is_some();
        let is_known = |question: &Question| question.proposal_id() == id;
        let proposal = self.known(id)?.proposal.clone();
        if refused {
            self.refused.retain(|known| *known != id);
            self.refused.push(id);
        }
        if result.was_carried_out()
            && self
                .goal
                .as_ref()
                .is_none_or(|goal| goal.stamp < result.stamp)
            && !self.confirm.as_ref().is_some_and(is_known)
        {
            let ended = Motion { proposal, result };
            if is_at_home {
                self.motion = Some(ended);
            } else {
                self.broken_off = Some(ended);
            }
        }
        self.confirm()
    }

    /// Where the proposal stands after the executor's word.
    fn stand(&mut self, result: &StepResult) {
        let (id, outcome) = (result.proposal_id, result.outcome);
        self.quiet_since = None;
        // The next goal answers a rejection that the executor has taken, and a decision on a step.
        let goal_follows = outcome == StepOutcome::Rejected
            || matches!(
                result.status,
                Some(ProposalStatus::Rejected | ProposalStatus::Withdrawn)
            );
        let still_moves =
            outcome == StepOutcome::Refused && result.status == Some(ProposalStatus::Moving);
        self.unanswered.retain_mut(|asked| {
            let is_answered = match asked.decision {
                OperatorDecision::Approve => !still_moves,
                OperatorDecision::Reject => !goal_follows,
                _ => false,
            };
            if asked.id == id && asked.decision == OperatorDecision::Reject {
                // It can never be approved again, whether a goal follows or the goal tracker has gone on to another proposal.
                asked.before = Some(Standing::Closed);
            }
            asked.id != id || !is_answered
        });
        let before = self.known(id).map(|known| known.standing);
        let is_over = matches!(
            before,
            Some(Standing::Closed | Standing::Moved(_) | Standing::Judged(_))
        );
        // The same word once more stops nothing.
        self.stopped |= outcome == StepOutcome::Stopped && !is_over;
        let is_asked = self.unanswered.iter().any(|asked| asked.id == id);
        let Some(known) = self.known_mut(id) else {
            return;
        };
        known.standing = match (outcome, result.status, known.standing) {
            // The decision on it was refused, maybe because the goal tracker had not heard of the motion.
            (StepOutcome::Refused, Some(ProposalStatus::Done), Standing::Judged(end))
                if !is_asked =>
            {
                Standing::Moved(end)
            }
            (_, _, Standing::Moved(_) | Standing::Judged(_)) => known.standing,
            (StepOutcome::Refused, Some(status), _) => match status {
                ProposalStatus::Pending => Standing::Open,
                ProposalStatus::Moving => Standing::Approved,
                ProposalStatus::Done => Standing::Moved(outcome),
                ProposalStatus::Superseded
                | ProposalStatus::Rejected
                | ProposalStatus::Withdrawn => Standing::Closed,
            },
            (StepOutcome::Refused, None, Standing::Approved) => Standing::Open,
            (StepOutcome::Refused, None, standing) => standing,
            _ if result.arm_moved() => Standing::Moved(outcome),
            _ => Standing::Closed,
        };
        if known.standing == Standing::Approved && !is_asked {
            self.unanswered.push(Unanswered {
                id,
                decision: OperatorDecision::Approve,
                before: Some(Standing::Open),
                since: None,
            });
        }
    }

    /// The simulator's measurement at rest.
    pub fn on_reward(&mut self, reward: Reward) -> Option<Question> {
        self.reward = Some(reward);
        self.confirm()
    }

    /// A step is judged by a reward measured after it: younger than the observation it was proposed from.
    fn confirm(&mut self) -> Option<Question> {
        let seen = self.motion.as_ref()?.proposal.stamp;
        let reward = self.reward.filter(|reward| reward.stamp > seen);
        if self.has_rewards && reward.is_none() {
            return None;
        }
        let motion = self.motion.take()?;
        Some(self.question(motion, reward))
    }

    fn question(&mut self, motion: Motion, reward: Option<Reward>) -> Question {
        let Motion { proposal, result } = motion;
        let question = Question::Confirm {
            result,
            reward,
            is_last_goal: self.goal.as_ref().map_or(0, |goal| goal.step_count) == proposal.step,
        };
        self.confirm = Some(question.clone());
        question
    }

    /// Nothing has happened for a long time: a message may have been lost, or a node was started again. Repeats what the
    /// operator was asked last. All decisions are safe to repeat: the executor and the goal tracker count each once.
    pub fn on_silence(&mut self) -> Vec<Question> {
        let motion = self.motion.take().or_else(|| self.broken_off.take());
        let about_motion = match motion {
            _ if planted(Mutation::SilenceForgetsMotion) => None,
            Some(motion) => Some(self.question(motion, None)),
            None => self.confirm.clone(),
        };
        self.asked = true;
        let of_goal = |proposal: &&Proposal| {
            let goal = self.goal.as_ref();
            goal.is_some_and(|goal| is_for(proposal, goal))
        };
        let refusal = |proposal: &&Proposal| self.refused.iter().position(|id| *id == proposal.id);
        // Not one that cannot be approved or is for another goal: whoever proposes for this goal has to hear whether the approval
        // was lost. Where all were refused, each is asked about in turn, as each may be of another author.
        let proposals = || self.proposals.iter().rev().map(|known| &known.proposal);
        let newest = proposals()
            .filter(of_goal)
            .find(|proposal| refusal(proposal).is_none());
        let newest = newest.or_else(|| proposals().filter(of_goal).min_by_key(refusal));
        let newest = newest.or_else(|| proposals().next()).cloned();
        about_motion
            .into_iter()
            .chain(newest.map(Question::Approve))
            .collect()
    }
}

/// Whether the proposal was made for this step and attempt.
fn is_for(proposal: &Proposal, goal: &Goal) -> bool {
    (proposal.step, proposal.attempt) == (goal.step, goal.attempt)
        && proposal.problem == goal.problem
}
