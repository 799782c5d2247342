//! What the operator is asked.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{Heightmap, Workspace};
use nalgebra::Isometry2;
use pick_place::{PickPlace, PrimitiveSettings};

use crate::{
    Confirmation, Coverage, Goal, Operator, OperatorDecision, Proposal, ProposalId, ProposalStatus,
    Question, RefusalKind, Reward, RunPhase, StepOutcome, StepResult,
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
        done_probability: None,
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

const NOW: Duration = Duration::from_secs(100);
const LATE: Duration = Duration::from_secs(120);

fn says(decision: OperatorDecision, id: u64) -> Confirmation {
    Confirmation {
        stamp: NOW,
        proposal_id: ProposalId(id),
        decision,
        operator_name: "Ada".into(),
    }
}

/// An operator at a page that shows proposal 7 for the first goal.
fn at_page() -> Operator {
    let mut operator = Operator::new(false);
    operator.on_goal(&goal(3, 0));
    operator.on_proposal(proposal(7, 10));
    operator
}

fn current(operator: &Operator) -> Option<u64> {
    operator.current().map(|proposal| proposal.id.0)
}

#[test]
fn a_page_goes_from_proposal_to_motion_confirmation_and_the_next_goal() {
    let mut operator = Operator::new(false);
    assert_eq!(operator.phase(), RunPhase::NoGoal);
    operator.on_goal(&goal(3, 0));
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
    operator.on_proposal(proposal(7, 10));
    assert_eq!(operator.phase(), RunPhase::Proposed);
    operator.decide(&says(OperatorDecision::Approve, 7), NOW);
    assert_eq!(operator.phase(), RunPhase::Moving);
    operator.on_result(placed(7));
    assert_eq!(operator.phase(), RunPhase::AwaitingConfirmation);
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
    let complete = Goal {
        complete: true,
        ..goal(3, 20)
    };
    operator.on_goal(&complete);
    assert_eq!(operator.phase(), RunPhase::Complete);
}

#[test]
fn an_own_decision_that_comes_back_after_its_answer_counts_once() {
    let mut operator = at_page();
    let approval = says(OperatorDecision::Approve, 7);
    operator.decide(&approval, NOW);
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Pending),
        ..result(7, StepOutcome::Refused)
    });
    assert!(!operator.on_confirmation(&approval, NOW));
    assert_eq!(operator.phase(), RunPhase::Proposed);
    // Somebody else's.
    assert!(operator.on_confirmation(&approval, NOW));
    assert_eq!(operator.phase(), RunPhase::Moving);
}

#[test]
fn a_decision_that_nobody_answers_is_asked_for_again_and_an_approval_not_while_the_arm_moves() {
    let mut operator = at_page();
    operator.decide(&says(OperatorDecision::Approve, 7), NOW);
    operator.on_motion(LATE);
    assert_eq!(operator.ask_again(LATE), None);
    let approval = Some((ProposalId(7), OperatorDecision::Approve));
    assert_eq!(operator.ask_again(LATE + Duration::from_secs(7)), approval);
    assert_eq!(operator.phase(), RunPhase::Proposed);
    // Its result was late.
    operator.on_result(placed(7));
    operator.decide(&says(OperatorDecision::Retry, 7), NOW);
    // Another proposal takes no decision away.
    operator.on_proposal(proposal(8, 10));
    let retry = Some((ProposalId(7), OperatorDecision::Retry));
    assert_eq!(operator.ask_again(LATE), retry);
    assert_eq!(operator.phase(), RunPhase::AwaitingConfirmation);
    operator.decide(&says(OperatorDecision::Retry, 7), LATE);
    operator.on_goal(&goal(3, 20));
    assert_eq!(operator.ask_again(LATE * 2), None);
}

#[test]
fn a_way_home_that_was_approved_and_not_answered_is_asked_for_again() {
    let mut operator = at_page();
    let approval = says(OperatorDecision::Approve, 99);
    operator.decide(&approval, NOW);
    let asked = Some((ProposalId(99), OperatorDecision::Approve));
    assert_eq!(operator.ask_again(LATE), asked);
    operator.decide(&approval, NOW);
    operator.on_result(result(99, StepOutcome::AtHome));
    assert_eq!(operator.ask_again(LATE), None);
}

#[test]
fn a_page_shows_the_proposal_of_the_goal_whatever_else_is_proposed() {
    let mut operator = at_page();
    operator.on_proposal(Proposal {
        step: 2,
        ..proposal(8, 10)
    });
    assert_eq!(
        (operator.phase(), current(&operator)),
        (RunPhase::Proposed, Some(7))
    );
    operator.on_proposal(proposal(9, 11));
    assert_eq!(current(&operator), Some(9));
    // The next goal answers a rejection, not the proposal before.
    operator.decide(&says(OperatorDecision::Reject, 9), NOW);
    operator.on_result(result(9, StepOutcome::Rejected));
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
    // The executor takes the one before: the policy has published it again.
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Superseded),
        ..result(9, StepOutcome::Refused)
    });
    assert_eq!(
        (operator.phase(), current(&operator)),
        (RunPhase::Proposed, Some(7))
    );
}

#[test]
fn a_rejection_that_was_taken_and_brings_no_goal_is_not_asked_for_again_and_what_else_was_proposed_is_probed()
 {
    let mut operator = at_page();
    // The goal tracker has gone on to the other one, whose end this page has heard.
    operator.on_proposal(proposal(8, 10));
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Withdrawn),
        ..result(8, StepOutcome::Stopped)
    });
    operator.on_continued();
    operator.decide(&says(OperatorDecision::Reject, 7), NOW);
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Rejected),
        ..result(7, StepOutcome::Refused)
    });
    assert_eq!(operator.ask_again(LATE), None);
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
    let probed = |now| {
        assert_eq!(operator.probe(now), None);
        let id = operator.probe(now + LATE)?;
        operator.on_result(StepResult {
            status: Some(ProposalStatus::Withdrawn),
            ..result(id.0, StepOutcome::Refused)
        });
        Some(id.0)
    };
    let probed: Vec<_> = [LATE, LATE * 3].into_iter().map(probed).collect();
    assert_eq!(probed, [Some(8), Some(7)]);
}

#[test]
fn the_executors_word_on_a_proposal_is_where_it_stands() {
    for (status, phase) in [
        (Some(ProposalStatus::Pending), RunPhase::Proposed),
        (Some(ProposalStatus::Superseded), RunPhase::AwaitingProposal),
        (Some(ProposalStatus::Moving), RunPhase::Moving),
        (Some(ProposalStatus::Done), RunPhase::AwaitingConfirmation),
        (Some(ProposalStatus::Rejected), RunPhase::AwaitingProposal),
        (Some(ProposalStatus::Withdrawn), RunPhase::AwaitingProposal),
        (None, RunPhase::Proposed),
    ] {
        for decision in [None, Some(OperatorDecision::Approve)] {
            let mut operator = at_page();
            if let Some(decision) = decision {
                operator.decide(&says(decision, 7), NOW);
            }
            operator.on_result(StepResult {
                status,
                ..result(7, StepOutcome::Refused)
            });
            assert_eq!(operator.phase(), phase, "{status:?} after {decision:?}");
        }
    }
}

#[test]
fn a_run_that_was_stopped_goes_on_with_another_goal_or_when_it_is_continued() {
    let mut operator = at_page();
    operator.on_confirmation(&says(OperatorDecision::Stop, 0), NOW);
    operator.on_goal(&goal(3, 0));
    assert_eq!(operator.phase(), RunPhase::Stopped, "the same goal");
    // The goal tracker had not heard of the stop: no other goal comes.
    operator.on_continued();
    assert_eq!(operator.phase(), RunPhase::Proposed);
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Stopped));
    assert_eq!(operator.phase(), RunPhase::Stopped);
    operator.on_goal(&goal(3, 5));
    assert_eq!(operator.phase(), RunPhase::Proposed);
    // The executor stops by itself; the same word once more stops nothing.
    let stopped = StepResult {
        status: Some(ProposalStatus::Withdrawn),
        ..result(7, StepOutcome::Stopped)
    };
    operator.on_result(stopped.clone());
    assert_eq!(operator.phase(), RunPhase::Stopped);
    operator.on_continued();
    operator.on_result(stopped);
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
}

#[test]
fn where_nothing_follows_a_judgement_the_proposal_is_to_be_rejected_once_more() {
    let mut operator = at_page();
    operator.on_result(placed(7));
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    // The tracker has not heard of the motion: it waits for its result.
    assert_eq!(operator.probe(NOW), None, "it may be answered still");
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Twice));
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
    assert_eq!(operator.probe(NOW), None);
    assert_eq!(operator.probe(LATE), Some(ProposalId(7)));
    assert_eq!(operator.probe(LATE), None, "once in a while");
    operator.on_goal(&Goal {
        step: 2,
        ..goal(3, 20)
    });
    assert_eq!(operator.probe(LATE * 2), None);
    assert_eq!(operator.probe(LATE * 3), None, "nothing was proposed yet");
}

#[test]
fn where_the_executor_says_that_a_proposal_moves_and_nothing_more_it_is_asked_for_again() {
    let mut operator = at_page();
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Moving),
        ..result(7, StepOutcome::Refused)
    });
    assert_eq!(operator.phase(), RunPhase::Moving);
    assert_eq!(operator.ask_again(NOW), None);
    let approval = Some((ProposalId(7), OperatorDecision::Approve));
    assert_eq!(operator.ask_again(LATE), approval);
    assert_eq!(operator.phase(), RunPhase::Proposed);
}

#[test]
fn a_stop_opens_what_was_not_answered_and_a_refused_judgement_is_asked_for_once_it_is_done() {
    let mut operator = at_page();
    operator.decide(&says(OperatorDecision::Approve, 7), NOW);
    operator.decide(&says(OperatorDecision::Stop, 7), NOW);
    operator.on_continued();
    assert_eq!(operator.phase(), RunPhase::Proposed);
    operator.on_result(placed(7));
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Stale));
    assert_eq!(operator.phase(), RunPhase::AwaitingProposal);
    // The answer to the rejection that the page repeats by itself.
    operator.on_result(StepResult {
        status: Some(ProposalStatus::Done),
        ..result(7, StepOutcome::Refused)
    });
    assert_eq!(operator.phase(), RunPhase::AwaitingConfirmation);
}

#[test]
fn the_refusal_of_a_judgement_answers_no_approval() {
    let mut operator = at_page();
    operator.decide(&says(OperatorDecision::Approve, 7), NOW);
    // Somebody has judged what has not moved yet.
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Twice));
    let approval = Some((ProposalId(7), OperatorDecision::Approve));
    assert_eq!(operator.ask_again(LATE), approval);
    assert_eq!(operator.phase(), RunPhase::Proposed);
}

#[test]
fn a_motion_that_the_tracker_does_not_know_hides_no_other_proposal() {
    let mut operator = at_page();
    operator.on_result(placed(7));
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Unknown));
    assert_eq!(operator.phase(), RunPhase::AwaitingConfirmation);
    operator.on_proposal(proposal(8, 30));
    assert_eq!(
        (operator.phase(), current(&operator)),
        (RunPhase::Proposed, Some(8))
    );
}

#[test]
fn where_the_arm_has_moved_once_more_the_page_asks_about_that_motion() {
    let mut operator = at_page();
    operator.on_result(placed(7));
    // Nobody was asked before it moved.
    operator.on_proposal(proposal(8, 10));
    operator.on_result(placed(8));
    // The first one is published again.
    operator.on_proposal(proposal(7, 10));
    assert_eq!(current(&operator), Some(7));
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Stale));
    assert_eq!(
        (operator.phase(), current(&operator)),
        (RunPhase::AwaitingConfirmation, Some(8))
    );
}

#[test]
fn a_motion_that_the_tracker_does_not_decide_on_hides_no_proposal() {
    let mut operator = at_page();
    operator.on_result(placed(7));
    operator.on_proposal(proposal(8, 30));
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    operator.on_confirmation_refused(ProposalId(7), Some(RefusalKind::Stale));
    assert_eq!(
        (operator.phase(), current(&operator)),
        (RunPhase::Proposed, Some(8))
    );
}

#[test]
fn where_the_same_goal_comes_again_nothing_decided_before_holds_the_run_up() {
    let mut operator = at_page();
    let second = Goal {
        step: 2,
        ..goal(3, 0)
    };
    operator.decide(&says(OperatorDecision::Approve, 7), NOW);
    operator.on_goal(&second);
    assert_eq!(operator.ask_again(LATE), None);
    // The goal tracker was started again.
    operator.on_goal(&goal(3, 0));
    assert_eq!(operator.phase(), RunPhase::Proposed);
    operator.on_result(placed(7));
    operator.decide(&says(OperatorDecision::Advance, 7), NOW);
    operator.on_goal(&second);
    operator.on_goal(&goal(3, 0));
    operator.on_proposal(proposal(8, 30));
    assert_eq!(current(&operator), Some(8));
}

#[test]
fn in_silence_each_proposal_for_the_goal_is_rejected_once_more_in_turn() {
    let mut operator = at_page();
    operator.on_proposal(proposal(8, 10));
    let refused = |id| StepResult {
        status: Some(ProposalStatus::Superseded),
        ..result(id, StepOutcome::Refused)
    };
    operator.on_result(refused(7));
    operator.on_result(refused(8));
    let mut now = NOW;
    for id in [7, 8, 7] {
        assert_eq!(operator.probe(now), None);
        now += LATE;
        assert_eq!(operator.probe(now), Some(ProposalId(id)));
        operator.on_result(refused(id));
    }
}
