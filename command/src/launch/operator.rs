//! Operators: who approves proposals and confirms steps.

use clap::ValueEnum;
use msgs::sctn_msgs::{PickPlace, Reward, StepConfirmation, StepResult};
use node_kit::ns_from_stamp;

/// Who decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum OperatorKind {
    /// Approves every proposal, and confirms steps by the simulator's reward
    Auto,
    /// Asks the person at the terminal
    Terminal,
    /// Serves a page on which a person decides, and prints its address
    Web,
    /// A person who only watches: every proposal is carried out, and the goal module, or with the oracle the motion's
    /// outcome, says which goal is next. Ctrl-C ends the run
    Watch,
    /// Nobody here: another program on the topics decides
    None,
}

/// A question to the operator.
#[derive(Clone, Debug, PartialEq)]
pub enum Question {
    /// Carry this proposal out?
    Approve(PickPlace),
    /// Did this step succeed? With the reward that the simulator measured.
    Confirm(StepResult, Reward),
}

/// Pairs what arrives on different topics, in whatever order, into questions, each asked once.
#[derive(Debug, Default)]
pub struct Operator {
    proposal: Option<PickPlace>,
    result: Option<StepResult>,
    reward: Option<Reward>,
}

impl Operator {
    /// A new proposal supersedes the one before.
    pub fn proposal(&mut self, proposal: PickPlace) -> Option<Question> {
        if self
            .proposal
            .as_ref()
            .is_some_and(|known| known.id == proposal.id)
        {
            return None;
        }
        self.proposal = Some(proposal.clone());
        self.result = None;
        Some(Question::Approve(proposal))
    }

    /// The executor's word on the present proposal.
    pub fn result(&mut self, result: StepResult) -> Option<Question> {
        if self
            .proposal
            .as_ref()
            .is_some_and(|proposal| proposal.id == result.proposal_id)
            && moved(&result)
        {
            self.result = Some(result);
        }
        self.confirm()
    }

    /// The simulator's measurement at rest.
    pub fn reward(&mut self, reward: Reward) -> Option<Question> {
        self.reward = Some(reward);
        self.confirm()
    }

    /// A step is judged by a reward measured after it: younger than the observation it was proposed from.
    fn confirm(&mut self) -> Option<Question> {
        let seen = ns_from_stamp(&self.proposal.as_ref()?.header.stamp);
        let reward = self
            .reward
            .as_ref()
            .filter(|reward| ns_from_stamp(&reward.header.stamp) > seen)?;
        Some(Question::Confirm(self.result.take()?, reward.clone()))
    }
}

/// Whether the robot has moved and is back home.
pub fn moved(result: &StepResult) -> bool {
    matches!(
        result.outcome,
        StepResult::PLACED
            | StepResult::NO_CONTACT
            | StepResult::GRASP_FAILED
            | StepResult::DROPPED
            | StepResult::LAG_ABORTED
    )
}

/// What the automatic operator answers: approval, and the simulator's reward as the judge of a step.
pub fn automatic(question: &Question) -> u8 {
    match question {
        Question::Approve(_) => StepConfirmation::APPROVE,
        Question::Confirm(_, reward) if reward.delta > 0.0 => StepConfirmation::ADVANCE,
        Question::Confirm(..) => StepConfirmation::RETRY,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node_kit::stamp_from_ns;

    fn proposal(id: u64, stamp_ns: i64) -> PickPlace {
        let mut proposal = PickPlace {
            id,
            ..PickPlace::default()
        };
        proposal.header.stamp = stamp_from_ns(stamp_ns);
        proposal
    }

    fn reward(delta: f64, stamp_ns: i64) -> Reward {
        let mut reward = Reward {
            delta,
            ..Reward::default()
        };
        reward.header.stamp = stamp_from_ns(stamp_ns);
        reward
    }

    fn result(proposal_id: u64) -> StepResult {
        StepResult {
            proposal_id,
            outcome: StepResult::PLACED,
            ..StepResult::default()
        }
    }

    #[test]
    fn a_step_is_confirmed_whichever_of_result_and_reward_comes_first() {
        for reward_first in [false, true] {
            let mut operator = Operator::default();
            assert!(operator.proposal(proposal(7, 10)).is_some());
            // The reward of the start says nothing about the step.
            assert_eq!(operator.reward(reward(0.0, 10)), None);
            let question = if reward_first {
                assert_eq!(operator.reward(reward(0.1, 20)), None);
                operator.result(result(7))
            } else {
                assert_eq!(operator.result(result(7)), None);
                operator.reward(reward(0.1, 20))
            };
            let question = question.expect("a question");
            assert_eq!(automatic(&question), StepConfirmation::ADVANCE);
            assert_eq!(operator.reward(reward(0.1, 20)), None, "asked once");
        }
    }

    #[test]
    fn a_step_without_reward_is_tried_again() {
        let mut operator = Operator::default();
        operator.proposal(proposal(7, 10));
        operator.result(result(7));
        let question = operator.reward(reward(0.0, 20)).expect("a question");
        assert_eq!(automatic(&question), StepConfirmation::RETRY);
    }

    #[test]
    fn a_refusal_or_another_proposals_result_confirms_nothing() {
        let mut operator = Operator::default();
        operator.proposal(proposal(7, 10));
        operator.reward(reward(0.1, 20));
        assert_eq!(
            operator.result(StepResult {
                outcome: StepResult::REFUSED,
                ..result(7)
            }),
            None
        );
        assert_eq!(operator.result(result(6)), None);
    }
}
