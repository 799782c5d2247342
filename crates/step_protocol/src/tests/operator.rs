//! What the operator is asked.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{Heightmap, Workspace};
use nalgebra::Isometry2;
use pick_place::{PickPlace, PrimitiveSettings};

use crate::{
    Coverage, Goal, Operator, OperatorDecision, Proposal, ProposalId, ProposalStatus, Question,
    Reward, StepOutcome, StepResult,
};

fn proposal(id: u64, stamp_s: u64) -> Proposal {
    Proposal {
        id: ProposalId(id),
        frame: "world".into(),
        stamp: Duration::from_secs(stamp_s),
        problem: "placing".into(),
        step: 1,
        attempt: 0,
        module: "placing".into(),
        action: PickPlace {
            pick: Isometry2::identity(),
            place: Isometry2::identity(),
        },
        settings: PrimitiveSettings::RIGID,
        pick_score: 1.0,
        place_score: 1.0,
        success_probability: None,
        checkpoint: String::new(),
        author: "test".into(),
    }
}

fn goal(step_count: u32, stamp_s: u64) -> Goal {
    Goal {
        stamp: Duration::from_secs(stamp_s),
        problem: "placing".into(),
        demonstration: "placing/1".into(),
        step: 1,
        step_count,
        attempt: 0,
        complete: false,
        module: "placing".into(),
        settings: PrimitiveSettings::RIGID,
        image: Arc::new(Heightmap::new(Workspace::RAVENS)),
        coverage: Coverage::default(),
        previous: None,
    }
}

fn reward(delta: f64, stamp_s: u64) -> Reward {
    Reward {
        stamp: Duration::from_secs(stamp_s),
        delta,
        total: 0.5,
        complete: false,
    }
}

fn result(id: u64, outcome: StepOutcome) -> StepResult {
    StepResult {
        stamp: Duration::from_secs(20),
        proposal_id: ProposalId(id),
        outcome,
        reason: String::new(),
        duration: Duration::from_secs(1),
        status: None,
    }
}

fn placed(id: u64) -> StepResult {
    result(id, StepOutcome::Placed)
}

/// The proposal that a question is about, and what the automatic operator answers.
fn answer(question: Option<Question>) -> (u64, OperatorDecision) {
    let question = question.expect("a question");
    (question.proposal_id().0, question.automatic_answer())
}

#[test]
fn a_step_is_confirmed_whichever_of_result_and_reward_comes_first() {
    for reward_first in [false, true] {
        let mut operator = Operator::new(true);
        operator.on_goal(&goal(3, 0));
        let asked = operator.on_proposal(proposal(7, 10));
        assert_eq!(answer(asked), (7, OperatorDecision::Approve));
        // The reward of the start says nothing about the step.
        assert_eq!(operator.on_reward(reward(0.0, 10)), None);
        let question = if reward_first {
            assert_eq!(operator.on_reward(reward(0.1, 20)), None);
            operator.on_result(placed(7))
        } else {
            assert_eq!(operator.on_result(placed(7)), None);
            operator.on_reward(reward(0.1, 20))
        };
        assert_eq!(answer(question), (7, OperatorDecision::Advance));
        assert_eq!(operator.on_reward(reward(0.1, 20)), None, "asked once");
        assert_eq!(operator.on_result(placed(7)), None, "asked once");
    }
}

#[test]
fn without_a_reward_a_step_is_tried_again_after_a_loss_the_goal_before_comes() {
    for (delta, expected) in [
        (0.0, OperatorDecision::Retry),
        (-0.1, OperatorDecision::StepBack),
    ] {
        let mut operator = Operator::new(true);
        operator.on_proposal(proposal(7, 10));
        operator.on_result(placed(7));
        let question = operator.on_reward(reward(delta, 20));
        assert_eq!(answer(question), (7, expected));
    }
}

#[test]
fn the_last_goal_stays_until_everything_is_complete() {
    let mut operator = Operator::new(true);
    operator.on_goal(&goal(1, 0));
    operator.on_proposal(proposal(7, 10));
    operator.on_result(placed(7));
    let question = operator.on_reward(reward(0.1, 20));
    assert_eq!(answer(question), (7, OperatorDecision::Retry));
    operator.on_proposal(Proposal {
        attempt: 1,
        ..proposal(8, 20)
    });
    operator.on_result(placed(8));
    let complete = Reward {
        complete: true,
        ..reward(0.1, 30)
    };
    let question = operator.on_reward(complete);
    assert_eq!(answer(question), (8, OperatorDecision::Advance));
}

#[test]
fn where_nothing_measures_rewards_the_result_is_enough() {
    let mut operator = Operator::new(false);
    operator.on_proposal(proposal(7, 10));
    let question = operator.on_result(placed(7));
    assert!(matches!(
        question,
        Some(Question::Confirm { reward: None, .. })
    ));
}

#[test]
fn a_refusal_or_another_proposals_result_confirms_nothing() {
    let mut operator = Operator::new(true);
    operator.on_proposal(proposal(7, 10));
    operator.on_reward(reward(0.1, 20));
    assert_eq!(operator.on_result(result(7, StepOutcome::Refused)), None);
    assert_eq!(operator.on_result(placed(6)), None);
}

#[test]
fn a_proposal_that_comes_before_the_reward_waits_until_the_motion_is_confirmed() {
    let mut operator = Operator::new(true);
    operator.on_proposal(proposal(7, 10));
    operator.on_result(placed(7));
    // For the same goal: it must not move before it is known what the first motion reached.
    assert_eq!(operator.on_proposal(proposal(8, 15)), None);
    let question = operator.on_reward(reward(0.1, 20));
    assert_eq!(answer(question), (7, OperatorDecision::Advance));
    // The confirmation was lost.
    let again = operator.on_silence();
    let about: Vec<_> = again
        .into_iter()
        .map(|question| answer(Some(question)))
        .collect();
    assert_eq!(
        about,
        [
            (7, OperatorDecision::Advance),
            (8, OperatorDecision::Approve)
        ]
    );
}

#[test]
fn a_result_that_comes_after_the_next_proposal_is_confirmed() {
    let mut operator = Operator::new(true);
    operator.on_proposal(proposal(7, 10));
    operator.on_proposal(proposal(8, 15));
    operator.on_result(placed(7));
    let question = operator.on_reward(reward(0.1, 20));
    assert_eq!(answer(question), (7, OperatorDecision::Advance));
}

#[test]
fn a_goal_from_after_the_motion_ends_the_wait_for_a_reward() {
    let mut operator = Operator::new(true);
    operator.on_goal(&goal(3, 10));
    operator.on_proposal(proposal(7, 10));
    operator.on_result(placed(7));
    // Another operator has confirmed.
    operator.on_goal(&goal(3, 20));
    assert_eq!(
        answer(operator.on_proposal(proposal(8, 20))),
        (8, OperatorDecision::Approve)
    );
    assert_eq!(operator.on_reward(reward(0.1, 20)), None);
    assert_eq!(operator.on_result(placed(7)), None);
}

#[test]
fn somebodys_proposal_for_another_goal_takes_no_confirmation_away() {
    let mut operator = Operator::new(true);
    operator.on_proposal(proposal(7, 10));
    let other = Proposal {
        step: 2,
        ..proposal(8, 10)
    };
    operator.on_proposal(other);
    operator.on_result(placed(7));
    let question = operator.on_reward(reward(0.1, 20));
    assert_eq!(answer(question), (7, OperatorDecision::Advance));
}

#[test]
fn the_refusal_of_what_was_carried_out_stands_for_a_result_that_was_lost() {
    let mut operator = Operator::new(true);
    operator.on_proposal(proposal(7, 10));
    operator.on_reward(reward(0.1, 20));
    let done = StepResult {
        status: Some(ProposalStatus::Done),
        ..result(7, StepOutcome::Refused)
    };
    assert_eq!(
        answer(operator.on_result(done)),
        (7, OperatorDecision::Advance)
    );
}

#[test]
fn in_silence_the_last_questions_are_asked_again_without_the_reward_if_need_be() {
    let mut operator = Operator::new(true);
    assert_eq!(operator.on_silence(), []);
    operator.on_proposal(proposal(7, 10));
    let again = operator.on_silence();
    assert_eq!(again, [Question::Approve(proposal(7, 10))]);
    operator.on_result(placed(7));
    let again = operator.on_silence();
    assert_eq!(again[0].automatic_answer(), OperatorDecision::Retry);
    assert_eq!(operator.on_silence(), again);
}

#[test]
fn a_motion_that_was_broken_off_is_asked_about_in_silence() {
    let mut operator = Operator::new(true);
    operator.on_goal(&goal(3, 0));
    operator.on_proposal(proposal(7, 10));
    let stopped = StepResult {
        status: Some(ProposalStatus::Done),
        ..result(7, StepOutcome::Stopped)
    };
    assert_eq!(operator.on_result(stopped), None);
    let again = operator.on_silence();
    assert_eq!(answer(again.first().cloned()), (7, OperatorDecision::Retry));
}

#[test]
fn in_silence_a_proposal_that_was_refused_or_is_for_another_goal_gives_way_to_one_for_the_goal() {
    let mut operator = Operator::new(true);
    operator.on_goal(&goal(3, 0));
    operator.on_proposal(proposal(7, 10));
    operator.on_proposal(proposal(8, 10));
    operator.on_proposal(Proposal {
        step: 2,
        ..proposal(9, 10)
    });
    let asked = operator.on_silence();
    assert_eq!(answer(asked.last().cloned()).0, 8);
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Pending),
        ..result(8, StepOutcome::Refused)
    });
    let asked = operator.on_silence();
    assert_eq!(answer(asked.last().cloned()).0, 7);
}

#[test]
fn in_silence_proposals_that_were_all_refused_are_asked_about_in_turn() {
    let mut operator = Operator::new(true);
    operator.on_goal(&goal(3, 0));
    let refused = |id| StepResult {
        status: Some(ProposalStatus::Superseded),
        ..result(id, StepOutcome::Refused)
    };
    for id in [7, 8] {
        operator.on_proposal(proposal(id, 10));
        operator.on_result(refused(id));
    }
    // Each may be of another author, who hears of it only in this way.
    for id in [7, 8, 7] {
        let asked = operator.on_silence();
        assert_eq!(answer(asked.last().cloned()).0, id);
        operator.on_result(refused(id));
    }
}
