//! The operator's side: which question is due.

use std::collections::VecDeque;

use crate::mutation::{Mutation, planted};
use crate::{
    Goal, Judgement, OperatorDecision, Proposal, ProposalId, Reward, StepOutcome, StepResult,
};

/// Proposals whose result may still come.
const PROPOSALS: usize = 64;

/// A question to the operator.
#[derive(Clone, Debug, PartialEq)]
pub enum Question {
    /// Carry this proposal out?
    Approve(Proposal),
    /// Did this step succeed?
    Confirm {
        /// What the executor said of the motion.
        result: StepResult,
        /// The reward that the simulator measured after it; none where nothing measures one, or its message was lost.
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

/// Pairs what arrives on different topics, in whatever order, into questions, each asked once.
#[derive(Debug)]
pub struct Operator {
    /// Whether something measures rewards: a question about a motion then waits for its reward.
    has_rewards: bool,
    /// The goal tracker knows of the motions that ended by its stamp.
    goal: Option<Goal>,
    /// The newest is the last.
    proposals: VecDeque<Proposal>,
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
        }
    }

    /// A goal was published: after a motion that has ended by its stamp nothing is to be confirmed any more.
    pub fn on_goal(&mut self, goal: &Goal) {
        self.goal = Some(goal.clone());
        let is_confirmed = |motion: &mut Motion| motion.result.stamp <= goal.stamp;
        self.motion.take_if(is_confirmed);
        self.broken_off.take_if(is_confirmed);
    }

    /// A new proposal supersedes the one before. While a motion for the same goal waits for its confirmation nothing more is
    /// to move for it.
    pub fn on_proposal(&mut self, proposal: Proposal) -> Option<Question> {
        let id = proposal.id;
        if self.proposals.back().is_some_and(|newest| newest.id == id) {
            return None;
        }
        self.proposals.retain(|known| known.id != id);
        if self.proposals.len() == PROPOSALS {
            let oldest = self.proposals.pop_front();
            self.refused
                .retain(|refused| oldest.as_ref().is_none_or(|oldest| oldest.id != *refused));
        }
        let of_same_goal = |motion: &Motion| {
            let goal = |proposal: &Proposal| (proposal.step, proposal.attempt);
            goal(&motion.proposal) == goal(&proposal) && motion.proposal.problem == proposal.problem
        };
        self.asked = !self.motion.as_ref().is_some_and(of_same_goal);
        let question = self.asked.then(|| Question::Approve(proposal.clone()));
        self.proposals.push_back(proposal);
        question
    }

    /// The executor's word on a proposal. The refusal of one that was carried out before says that its result was lost.
    pub fn on_result(&mut self, result: StepResult) -> Option<Question> {
        let id = result.proposal_id;
        let refused = result.outcome == StepOutcome::Refused;
        let is_at_home = refused || result.outcome.motion().is_some();
        let is_known = |question: &Question| question.proposal_id() == id;
        let mut proposals = self.proposals.iter().rev();
        let proposal = proposals.find(|proposal| proposal.id == id)?;
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
            let ended = Motion {
                proposal: proposal.clone(),
                result,
            };
            if is_at_home {
                self.motion = Some(ended);
            } else {
                self.broken_off = Some(ended);
            }
        }
        self.confirm()
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
            self.goal.as_ref().is_some_and(|goal| {
                (proposal.step, proposal.attempt) == (goal.step, goal.attempt)
                    && proposal.problem == goal.problem
            })
        };
        let refusal = |proposal: &&Proposal| self.refused.iter().position(|id| *id == proposal.id);
        // Not one that cannot be approved or is for another goal: whoever proposes for this goal has to hear whether the approval
        // was lost. Where all were refused, each is asked about in turn, as each may be of another author.
        let of_goal = || self.proposals.iter().rev().filter(of_goal);
        let newest = of_goal().find(|proposal| refusal(proposal).is_none());
        let newest = newest.or_else(|| of_goal().min_by_key(refusal));
        let newest = newest.or(self.proposals.back()).cloned();
        about_motion
            .into_iter()
            .chain(newest.map(Question::Approve))
            .collect()
    }
}
