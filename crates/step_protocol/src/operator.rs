//! The operator's side: which question is due.

use std::collections::VecDeque;
use std::time::Duration;

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
    step_count: u32,
    /// Stamp of the present goal: the goal tracker knows of the motions that ended by then.
    goal_stamp: Option<Duration>,
    /// The newest is the last.
    proposals: VecDeque<Proposal>,
    /// Waits for its reward.
    motion: Option<Motion>,
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
            step_count: 0,
            goal_stamp: None,
            proposals: VecDeque::new(),
            motion: None,
            confirm: None,
            asked: false,
            reward: None,
        }
    }

    /// A goal was published: after a motion that has ended by its stamp nothing is to be confirmed any more.
    pub fn on_goal(&mut self, goal: &Goal) {
        self.step_count = goal.step_count;
        self.goal_stamp = Some(goal.stamp);
        let is_confirmed = |motion: &mut Motion| motion.result.stamp <= goal.stamp;
        self.motion.take_if(is_confirmed);
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
            self.proposals.pop_front();
        }
        let of_same_goal = |motion: &Motion| {
            let goal = |proposal: &Proposal| (proposal.step, proposal.attempt);
            goal(&motion.proposal) == goal(&proposal) && motion.proposal.problem == proposal.problem
        };
        if planted(Mutation::OperatorForgetsMotion) {
            self.motion = None;
        }
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
        if is_at_home
            && result.was_carried_out()
            && self.goal_stamp.is_none_or(|stamp| stamp < result.stamp)
            && !self.confirm.as_ref().is_some_and(is_known)
        {
            self.motion = Some(Motion {
                proposal: proposal.clone(),
                result,
            });
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
        self.ask_about_motion(reward)
    }

    fn ask_about_motion(&mut self, reward: Option<Reward>) -> Option<Question> {
        let Motion { proposal, result } = self.motion.take()?;
        let question = Question::Confirm {
            result,
            reward,
            is_last_goal: proposal.step == self.step_count,
        };
        self.confirm = Some(question.clone());
        Some(question)
    }

    /// Nothing has happened for a long time: a message may have been lost, or a node was started again. Repeats what the
    /// operator was asked last. All decisions are safe to repeat: the executor and the goal tracker count each once.
    pub fn on_silence(&mut self) -> Vec<Question> {
        let about_motion = self.ask_about_motion(None).or_else(|| self.confirm.clone());
        self.asked = true;
        let newest = self.proposals.back().cloned().map(Question::Approve);
        about_motion.into_iter().chain(newest).collect()
    }
}
