//! A goal of the executor's action: a proposal whose way its client follows.

use crate::{ProposalId, StepOutcome};

/// A goal from its acceptance to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionGoal {
    /// Its proposal.
    pub id: ProposalId,
    /// Whether the motion of its proposal is under way.
    pub is_moving: bool,
    /// Whether its client wants it cancelled.
    pub is_cancelled: bool,
}

impl ActionGoal {
    /// It waits for an approval, or for its turn.
    pub(crate) fn new(id: ProposalId) -> Self {
        Self {
            id,
            is_moving: false,
            is_cancelled: false,
        }
    }

    /// Whether it ends with a word on a proposal: on its own one, and where that moves, no other word than that on the motion.
    pub(crate) fn ends_with(&self, id: ProposalId, is_of_motion: bool) -> bool {
        self.id == id && (is_of_motion || !self.is_moving)
    }
}

/// How a goal of the action ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GoalEnd {
    /// As the client wanted it.
    Succeeded,
    /// Stopped after the client wanted it cancelled.
    Cancelled,
    /// Anything else; the result says why.
    Aborted,
}

impl GoalEnd {
    /// The end of a goal whose proposal ended so.
    pub fn of(outcome: StepOutcome, is_cancel_requested: bool) -> Self {
        match outcome {
            StepOutcome::Placed => Self::Succeeded,
            StepOutcome::Stopped if is_cancel_requested => Self::Cancelled,
            _ => Self::Aborted,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn while_its_motion_is_under_way_only_the_end_of_that_ends_a_goal() {
        let mut goal = ActionGoal::new(ProposalId(7));
        assert!(goal.ends_with(ProposalId(7), false));
        assert!(!goal.ends_with(ProposalId(8), true));
        goal.is_moving = true;
        assert!(!goal.ends_with(ProposalId(7), false));
        assert!(goal.ends_with(ProposalId(7), true));
    }

    #[test]
    fn a_goal_succeeds_only_where_the_object_was_placed() {
        for &outcome in StepOutcome::ALL {
            for is_cancel_requested in [false, true] {
                let expected = match (outcome, is_cancel_requested) {
                    (StepOutcome::Placed, _) => GoalEnd::Succeeded,
                    (StepOutcome::Stopped, true) => GoalEnd::Cancelled,
                    _ => GoalEnd::Aborted,
                };
                assert_eq!(GoalEnd::of(outcome, is_cancel_requested), expected);
            }
        }
    }
}
