//! Which goal the tracker publishes.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use heightmap::{Heightmap, Workspace};
use nalgebra::Isometry2;
use pick_place::{PickPlace, PrimitiveSettings};
use proptest::prelude::*;

use crate::{
    Capture, CaptureError, Change, Confirmation, ConfirmationRefusal, Coverage, Goal, GoalSequence,
    GoalTracker, OperatorDecision, Proposal, ProposalId, ProposalStatus, StepJudge, StepOutcome,
    StepResult,
};

pub(super) fn tracker(count: u32) -> GoalTracker {
    judged_by(count, StepJudge::Operator)
}

fn image(height_m: f32) -> Arc<Heightmap> {
    let mut heightmap = Heightmap::new(Workspace {
        rows: 1,
        cols: 1,
        ..Workspace::RAVENS
    });
    heightmap.height_m[0] = height_m;
    Arc::new(heightmap)
}

fn goal_of_step(problem: &str, step: u32, step_count: u32) -> Goal {
    Goal {
        stamp: Duration::ZERO,
        problem: problem.into(),
        demonstration: String::new(),
        step,
        step_count,
        attempt: 0,
        complete: false,
        module: "placing".into(),
        settings: PrimitiveSettings::RIGID,
        image: image(-1.0),
        coverage: Coverage::default(),
        previous: None,
    }
}

fn judged_by(count: u32, judge: StepJudge) -> GoalTracker {
    let goals = (1..=count).map(|step| goal_of_step("placing", step, count));
    let sequence = GoalSequence {
        start: None,
        goals: goals.collect(),
    };
    GoalTracker::new(sequence, judge)
}

pub(super) fn proposal(id: u64, step: u32, attempt: u32) -> Proposal {
    Proposal {
        id: ProposalId(id),
        frame: "world".into(),
        stamp: Duration::ZERO,
        problem: "placing".into(),
        step,
        attempt,
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

pub(super) fn result(id: u64, outcome: StepOutcome, sec: u64) -> StepResult {
    StepResult {
        stamp: Duration::from_secs(sec),
        proposal_id: ProposalId(id),
        outcome,
        reason: String::new(),
        duration: Duration::from_secs(1),
        status: None,
    }
}

fn refused(id: u64, status: ProposalStatus, sec: u64) -> StepResult {
    StepResult {
        status: Some(status),
        ..result(id, StepOutcome::Refused, sec)
    }
}

pub(super) fn says(decision: OperatorDecision, proposal_id: u64) -> Confirmation {
    Confirmation {
        stamp: Duration::ZERO,
        proposal_id: ProposalId(proposal_id),
        decision,
        operator_name: "test".into(),
    }
}

fn goal(change: Change) -> (u32, u32, u64, bool) {
    match change {
        Change::Goal(goal) => (goal.step, goal.attempt, goal.stamp.as_secs(), goal.complete),
        other => panic!("expected a goal, got {other:?}"),
    }
}

#[test]
fn an_advance_after_the_motion_latches_the_next_goal_with_the_results_stamp() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    assert_eq!(
        tracker.on_result(&result(7, StepOutcome::Placed, 5)),
        Change::None
    );
    let change = tracker
        .on_confirmation(&says(OperatorDecision::Advance, 7))
        .unwrap();
    assert_eq!(goal(change), (2, 0, 5, false));
    tracker.on_proposal(&proposal(8, 2, 0));
    tracker.on_result(&result(8, StepOutcome::Dropped, 9));
    let change = tracker
        .on_confirmation(&says(OperatorDecision::Advance, 8))
        .unwrap();
    assert_eq!(goal(change), (2, 0, 9, true));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 8)),
        Err(ConfirmationRefusal::Complete)
    );
}

#[test]
fn a_retry_keeps_the_step_and_counts_the_attempt() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_result(&result(7, StepOutcome::NoContact, 5));
    let change = tracker
        .on_confirmation(&says(OperatorDecision::Retry, 7))
        .unwrap();
    assert_eq!(goal(change), (1, 1, 5, false));
}

#[test]
fn a_rejection_asks_for_another_proposal_from_the_same_observation() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    let change = tracker.on_result(&result(7, StepOutcome::Rejected, 5));
    assert_eq!(goal(change), (1, 1, 0, false));
    assert_eq!(
        tracker.on_result(&result(7, StepOutcome::Rejected, 5)),
        Change::None
    );
}

#[test]
fn a_decision_that_overtakes_its_result_waits_for_it() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    let early = tracker.on_confirmation(&says(OperatorDecision::Advance, 7));
    assert_eq!(early, Ok(Change::None));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Retry, 7)),
        Err(ConfirmationRefusal::Twice { id: ProposalId(7) })
    );
    let change = tracker.on_result(&result(7, StepOutcome::Placed, 5));
    assert_eq!(goal(change), (2, 0, 5, false));
}

#[test]
fn a_motion_for_a_proposal_that_was_not_heard_counts() {
    let mut tracker = tracker(2);
    assert_eq!(
        tracker.on_result(&result(7, StepOutcome::Placed, 5)),
        Change::None
    );
    let change = tracker
        .on_confirmation(&says(OperatorDecision::Advance, 7))
        .unwrap();
    assert_eq!(goal(change), (2, 0, 5, false));
}

#[test]
fn stale_unknown_and_repeated_confirmations_change_nothing() {
    let mut tracker = tracker(3);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    tracker
        .on_confirmation(&says(OperatorDecision::Advance, 7))
        .unwrap();
    let before = tracker.goal();
    let (step, attempt) = (2, 0);
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 7)),
        Err(ConfirmationRefusal::Stale {
            id: ProposalId(7),
            step,
            attempt
        })
    );
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Retry, 99)),
        Err(ConfirmationRefusal::Unknown {
            id: ProposalId(99),
            step,
            attempt
        })
    );
    // The old result once more, and an old proposal once more.
    assert_eq!(
        tracker.on_result(&result(7, StepOutcome::Placed, 5)),
        Change::None
    );
    tracker.on_proposal(&proposal(7, 1, 0));
    assert!(
        tracker
            .on_confirmation(&says(OperatorDecision::Advance, 7))
            .is_err()
    );
    assert_eq!(tracker.goal(), before);
}

#[test]
fn a_superseded_proposal_cannot_advance() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_proposal(&proposal(8, 1, 0));
    assert!(matches!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 7)),
        Err(ConfirmationRefusal::Stale {
            id: ProposalId(7),
            ..
        })
    ));
    tracker.on_result(&result(8, StepOutcome::Placed, 6));
    let change = tracker
        .on_confirmation(&says(OperatorDecision::Advance, 8))
        .unwrap();
    assert_eq!(goal(change), (2, 0, 6, false));
}

#[test]
fn what_the_executor_carried_out_counts_whatever_was_proposed_since() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    // Readable, of this step, and nothing that the executor would do.
    tracker.on_proposal(&proposal(8, 1, 0));
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    assert!(
        tracker
            .on_confirmation(&says(OperatorDecision::Advance, 8))
            .is_err()
    );
    let change = tracker
        .on_confirmation(&says(OperatorDecision::Advance, 7))
        .unwrap();
    assert_eq!(goal(change), (2, 0, 5, false));
    // Said again, it is a proposal of an earlier goal.
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    assert_eq!(tracker.progress(), (2, 2, 0));
}

#[test]
fn a_proposal_said_again_may_be_decided_on_before_its_result_comes() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_proposal(&proposal(8, 1, 0));
    // What the policy does when the executor has refused 8.
    tracker.on_proposal(&proposal(7, 1, 0));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 7)),
        Ok(Change::None)
    );
    let change = tracker.on_result(&result(7, StepOutcome::Placed, 5));
    assert_eq!(goal(change), (2, 0, 5, false));
}

#[test]
fn proposals_for_another_problem_step_or_attempt_are_not_current() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 2, 0));
    tracker.on_proposal(&proposal(8, 1, 1));
    tracker.on_proposal(&Proposal {
        problem: "chaining".into(),
        ..proposal(9, 1, 0)
    });
    for id in [7, 8, 9] {
        tracker.on_result(&result(id, StepOutcome::Placed, 5));
        assert!(
            tracker
                .on_confirmation(&says(OperatorDecision::Advance, id))
                .is_err()
        );
    }
    assert_eq!(tracker.progress(), (1, 2, 0));
}

#[test]
fn a_refused_approval_changes_nothing() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    assert_eq!(
        tracker.on_result(&result(7, StepOutcome::Refused, 5)),
        Change::None
    );
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Approve, 7)),
        Ok(Change::None)
    );
    assert_eq!(tracker.progress(), (1, 2, 0));
}

#[test]
fn a_stop_ends_the_run_whatever_it_names() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Stop, 1234)),
        Ok(Change::Stopped)
    );
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 7)),
        Err(ConfirmationRefusal::Stopped)
    );
    assert!(tracker.is_stopped() && !tracker.is_complete());
}

#[test]
fn without_required_confirmation_the_outcome_decides() {
    let mut tracker = judged_by(2, StepJudge::Outcome);
    tracker.on_proposal(&proposal(7, 1, 0));
    let change = tracker.on_result(&result(7, StepOutcome::GraspFailed, 3));
    assert_eq!(goal(change), (1, 1, 3, false));
    tracker.on_proposal(&proposal(8, 1, 1));
    let change = tracker.on_result(&result(8, StepOutcome::Placed, 5));
    assert_eq!(goal(change), (2, 0, 5, false));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 8)),
        Err(ConfirmationRefusal::NotAsked)
    );
}

#[test]
fn another_step_is_latched_at_a_call_and_no_attempt_is_used_twice_before_something_moves() {
    let mut tracker = tracker(3);
    assert_eq!(tracker.set_step(1), Ok(Change::None));
    assert_eq!(goal(tracker.set_step(3).unwrap()), (3, 0, 0, false));
    assert_eq!(tracker.set_step(3), Ok(Change::None));
    // Its proposals of before would have the same ids.
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 1, 0, false));
    for step in [0, 4] {
        let refusal = tracker.set_step(step).unwrap_err().to_string();
        assert!(refusal.contains("expected 1 to 3"), "{refusal}");
    }
    tracker.on_proposal(&proposal(7, 1, 1));
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    // Before the operator has confirmed: what was seen before the motion is no ground to go on.
    assert_eq!(goal(tracker.set_step(3).unwrap()), (3, 0, 5, false));
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 7)),
        Err(ConfirmationRefusal::Stale {
            id: ProposalId(7),
            step: 3,
            attempt: 0
        })
    );
}

#[test]
fn a_tracker_that_is_started_again_takes_no_attempt_that_somebody_has_proposed_for() {
    let mut tracker = tracker(3);
    // Made before it was started again; the planner would propose the same once more.
    tracker.on_proposal(&proposal(7, 3, 0));
    tracker.on_proposal(&proposal(8, 1, 1));
    assert_eq!(goal(tracker.set_step(3).unwrap()), (3, 1, 0, false));
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 2, 0, false));
    // Nobody's number ends the attempts.
    tracker.on_proposal(&proposal(9, 2, u32::MAX));
    assert_eq!(goal(tracker.set_step(2).unwrap()), (2, 0, 0, false));
    tracker.on_proposal(&proposal(10, 2, 0));
    let rejected = result(10, StepOutcome::Rejected, 0);
    assert_eq!(goal(tracker.on_result(&rejected)), (2, 1, 0, false));
}

#[test]
fn the_present_step_is_published_again_where_something_was_proposed_for_it() {
    let mut tracker = tracker(3);
    assert_eq!(tracker.set_step(1), Ok(Change::None));
    // Made, and carried out, before this tracker was started again: nobody says so any more.
    tracker.on_proposal(&proposal(7, 1, 0));
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 1, 0, false));
    assert_eq!(tracker.set_step(1), Ok(Change::None));
    tracker.on_proposal(&proposal(8, 1, 1));
    tracker.on_result(&result(8, StepOutcome::GraspFailed, 5));
    // A proposal from what is seen since may be on its way.
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 2, 5, false));
}

#[test]
fn a_step_that_is_set_ends_a_stop_and_a_completed_run() {
    let mut tracker = tracker(1);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker
        .on_confirmation(&says(OperatorDecision::Stop, 7))
        .unwrap();
    // The motion's end is heard after the stop.
    tracker.on_result(&result(7, StepOutcome::Stopped, 4));
    // Somebody may have proposed for the stopped attempt from what was seen since.
    tracker.on_proposal(&proposal(9, 1, 0));
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 1, 4, false));
    tracker.on_proposal(&proposal(8, 1, 1));
    tracker.on_result(&result(8, StepOutcome::Placed, 6));
    let end = tracker.on_confirmation(&says(OperatorDecision::Advance, 8));
    assert_eq!(goal(end.unwrap()), (1, 0, 6, true));
    // Nothing was proposed since that motion: attempts begin anew.
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 0, 6, false));
}

#[test]
fn another_sequence_starts_at_its_first_goal() {
    let mut tracker = tracker(3);
    tracker.set_step(2).unwrap();
    let loaded = tracker.load(GoalSequence {
        start: Some(image(0.0)),
        goals: vec![goal_of_step("chaining", 1, 1)],
    });
    assert_eq!(goal(loaded), (1, 1, 0, false));
    assert_eq!(tracker.goal().unwrap().problem, "chaining");
    assert_eq!(tracker.progress(), (1, 1, 1));
}

fn capture(height_m: f32, append: bool) -> Capture {
    Capture {
        image: image(height_m),
        coverage: Coverage::default(),
        append,
        module: String::new(),
        settings: None,
    }
}

/// Heights of the images, each step by step as a goal.
fn heights(tracker: &mut GoalTracker) -> Vec<f32> {
    let (step, count, _) = tracker.progress();
    let height_of = |step| {
        tracker.set_step(step).unwrap();
        tracker.goal().unwrap().image.height_m[0]
    };
    let heights = (1..=count).map(height_of).collect();
    tracker.set_step(step).unwrap();
    heights
}

#[test]
fn what_is_captured_is_the_present_goal_or_the_last() {
    let mut tracker = tracker(2);
    tracker.set_step(2).unwrap();
    let (step, change) = tracker.capture(capture(0.1, false)).unwrap();
    assert_eq!((step, goal(change)), (2, (2, 1, 0, false)));
    assert_eq!(heights(&mut tracker), [-1.0, 0.1, -1.0]);
    // A goal that is appended does not disturb the work on the present one.
    let appended = tracker.capture(capture(0.2, true)).unwrap();
    assert_eq!(appended, (4, Change::None));
    assert_eq!(heights(&mut tracker), [-1.0, 0.1, -1.0, 0.2]);
    tracker.set_step(4).unwrap();
    let last = tracker.goal().unwrap();
    assert_eq!((last.step_count, last.demonstration.as_str()), (4, "+2"));
    assert_eq!(last.previous.unwrap().height_m[0], -1.0);
}

#[test]
fn a_sequence_can_be_taught_from_nothing() {
    let mut tracker = tracker(0);
    assert_eq!(tracker.goal(), None);
    tracker.on_proposal(&proposal(7, 1, 0));
    assert_eq!(
        tracker.capture(capture(0.1, true)),
        Err(CaptureError::NoSettings)
    );
    let first = Capture {
        settings: Some(PrimitiveSettings::RIGID),
        ..capture(0.1, true)
    };
    let (step, change) = tracker.capture(first).unwrap();
    assert_eq!((step, goal(change)), (1, (1, 1, 0, false)));
    let (step, change) = tracker.capture(capture(0.2, true)).unwrap();
    assert_eq!((step, change), (2, Change::None));
    let goal = tracker.goal().unwrap();
    assert_eq!((goal.problem.as_str(), goal.step_count), ("captured", 2));
    for _ in 2..1000 {
        tracker.capture(capture(0.3, true)).unwrap();
    }
    assert_eq!(
        tracker.capture(capture(0.3, true)),
        Err(CaptureError::TooMany)
    );
}

#[test]
fn an_image_after_the_motion_says_which_goal_is_next() {
    let mut tracker = judged_by(3, StepJudge::Image);
    tracker.on_proposal(&proposal(7, 1, 0));
    // Nothing has moved yet: what is seen decides nothing.
    assert_eq!(tracker.on_image_match(2), Change::None);
    let result_of = |id, sec| result(id, StepOutcome::Placed, sec);
    assert_eq!(tracker.on_result(&result_of(7, 5)), Change::None);
    assert_eq!(tracker.waits_for_image(), Some(Duration::from_secs(5)));
    // The operator is not asked.
    assert_eq!(
        tracker.on_confirmation(&says(OperatorDecision::Advance, 7)),
        Err(ConfirmationRefusal::NotAsked)
    );
    assert_eq!(goal(tracker.on_image_match(1)), (2, 0, 5, false));
    // Not reached: once more. The same image counts once.
    tracker.on_proposal(&proposal(8, 2, 0));
    tracker.on_result(&result_of(8, 6));
    assert_eq!(goal(tracker.on_image_match(1)), (2, 1, 6, false));
    assert_eq!(tracker.on_image_match(1), Change::None);
    // Something was undone: back.
    tracker.on_proposal(&proposal(9, 2, 1));
    tracker.on_result(&result_of(9, 7));
    assert_eq!(goal(tracker.on_image_match(0)), (1, 0, 7, false));
    tracker.on_proposal(&proposal(10, 1, 0));
    tracker.on_result(&result_of(10, 8));
    assert_eq!(goal(tracker.on_image_match(9)), (3, 0, 8, true));
    assert!(tracker.is_complete());
}

#[test]
fn after_a_stop_no_image_moves_the_goal() {
    let mut tracker = judged_by(2, StepJudge::Image);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    tracker
        .on_confirmation(&says(OperatorDecision::Stop, 0))
        .unwrap();
    assert_eq!(tracker.on_image_match(1), Change::None);
}

proptest! {
    /// However confused the messages, a step is passed only by a motion and an ADVANCE for it.
    #[test]
    fn steps_never_outnumber_motions(
        inputs in prop::collection::vec((0u8..3, 0u64..6, 0usize..9, 1u32..4, 0u32..3), 0..200)
    ) {
        let mut tracker = tracker(3);
        let mut moved = BTreeSet::new();
        for (kind, id, code, step, attempt) in inputs {
            match kind {
                0 => tracker.on_proposal(&proposal(id, step, attempt)),
                1 => {
                    let outcome = StepOutcome::ALL[code];
                    if outcome.arm_moved() {
                        moved.insert(id);
                    }
                    tracker.on_result(&result(id, outcome, 1));
                }
                _ => {
                    let decision = OperatorDecision::ALL[code % 6];
                    drop(tracker.on_confirmation(&says(decision, id)));
                }
            }
            let (step, _, _) = tracker.progress();
            prop_assert!(step as usize <= moved.len() + 1);
        }
    }
}

#[test]
fn a_decision_that_waits_for_its_result_outlives_a_newer_proposal() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    let early = tracker.on_confirmation(&says(OperatorDecision::Advance, 7));
    assert_eq!(early, Ok(Change::None));
    // The view changed while the arm moved.
    tracker.on_proposal(&proposal(8, 1, 0));
    let change = tracker.on_result(&result(7, StepOutcome::Placed, 5));
    assert_eq!(goal(change), (2, 0, 5, false));
    assert_eq!(tracker.take_refused(), []);
}

#[test]
fn a_decision_that_waited_in_vain_is_refused_when_the_goal_changes_or_the_run_stops() {
    let waiting = || {
        let mut tracker = tracker(2);
        tracker.on_proposal(&proposal(7, 1, 0));
        let early = tracker.on_confirmation(&says(OperatorDecision::Advance, 7));
        assert_eq!(early, Ok(Change::None));
        tracker
    };
    let id = ProposalId(7);
    let mut rejected = waiting();
    rejected.on_result(&result(7, StepOutcome::Rejected, 5));
    let (step, attempt) = (1, 1);
    let stale = ConfirmationRefusal::Stale { id, step, attempt };
    assert_eq!(rejected.take_refused(), [(id, stale)]);
    assert_eq!(rejected.take_refused(), []);
    let mut stopped = waiting();
    stopped
        .on_confirmation(&says(OperatorDecision::Stop, 7))
        .unwrap();
    let refused = ConfirmationRefusal::Stopped;
    assert_eq!(stopped.take_refused(), [(id, refused)]);
    stopped.on_result(&result(7, StepOutcome::Stopped, 5));
    stopped.set_step(1).unwrap();
    assert_eq!(stopped.progress(), (1, 2, 1));
}

#[test]
fn a_step_back_goes_to_the_goal_before_and_not_beyond_the_first() {
    let mut tracker = tracker(3);
    tracker.set_step(3).unwrap();
    for (id, step, expected) in [(7, 3, (2, 0)), (8, 2, (1, 0)), (9, 1, (1, 1))] {
        tracker.on_proposal(&proposal(id, step, 0));
        tracker.on_result(&result(id, StepOutcome::Placed, id));
        let change = tracker.on_confirmation(&says(OperatorDecision::StepBack, id));
        let (step, attempt) = expected;
        assert_eq!(goal(change.unwrap()), (step, attempt, id, false));
    }
}

#[test]
fn the_refusal_of_what_was_carried_out_stands_for_a_result_that_was_lost() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    let early = tracker.on_confirmation(&says(OperatorDecision::Advance, 7));
    assert_eq!(early, Ok(Change::None));
    let moving = refused(7, ProposalStatus::Moving, 4);
    assert_eq!(tracker.on_result(&moving), Change::None);
    let change = tracker.on_result(&refused(7, ProposalStatus::Done, 5));
    assert_eq!(goal(change), (2, 0, 5, false));
    // A proposal of another goal says nothing here.
    assert_eq!(
        tracker.on_result(&refused(9, ProposalStatus::Done, 6)),
        Change::None
    );
    assert!(
        tracker
            .on_confirmation(&says(OperatorDecision::Advance, 9))
            .is_err()
    );
}

#[test]
fn the_refusal_of_what_was_rejected_or_withdrawn_asks_for_another_proposal() {
    for status in [ProposalStatus::Rejected, ProposalStatus::Withdrawn] {
        let mut tracker = tracker(2);
        tracker.on_proposal(&proposal(7, 1, 0));
        let change = tracker.on_result(&refused(7, status, 5));
        assert_eq!(goal(change), (1, 1, 0, false));
    }
    // The executor has not accepted the newer one.
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_proposal(&proposal(8, 1, 0));
    let change = tracker.on_result(&result(7, StepOutcome::Rejected, 5));
    assert_eq!(goal(change), (1, 1, 0, false));
}

#[test]
fn after_a_motion_that_was_stopped_the_operator_may_try_again() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    // The client of the action has cancelled its goal: no STOP was said.
    assert_eq!(
        tracker.on_result(&result(7, StepOutcome::Stopped, 5)),
        Change::None
    );
    let change = tracker.on_confirmation(&says(OperatorDecision::Retry, 7));
    assert_eq!(goal(change.unwrap()), (1, 1, 5, false));
    let mut alone = judged_by(2, StepJudge::Outcome);
    alone.on_proposal(&proposal(7, 1, 0));
    assert_eq!(
        alone.on_result(&result(7, StepOutcome::Stopped, 5)),
        Change::None
    );
}

#[test]
fn every_goal_comes_with_the_image_before_it() {
    let goals = [0.1, 0.2].map(|height_m| Goal {
        image: image(height_m),
        ..goal_of_step("placing", (10.0 * height_m) as u32, 2)
    });
    let sequence = GoalSequence {
        start: Some(image(0.0)),
        goals: goals.to_vec(),
    };
    let mut tracker = GoalTracker::new(sequence, StepJudge::Operator);
    let heights = |goal: Goal| (goal.previous.unwrap().height_m[0], goal.image.height_m[0]);
    assert_eq!(heights(tracker.goal().unwrap()), (0.0, 0.1));
    tracker.set_step(2).unwrap();
    assert_eq!(heights(tracker.goal().unwrap()), (0.1, 0.2));
    assert_eq!(tracker.known_images().unwrap().count(), 3);
}

#[test]
fn a_stop_that_moved_nothing_asks_for_no_newer_heightmap_and_no_attempt_comes_again() {
    let mut tracker = tracker(1);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker
        .on_confirmation(&says(OperatorDecision::Stop, 7))
        .unwrap();
    tracker.on_result(&StepResult {
        status: Some(ProposalStatus::Withdrawn),
        ..result(7, StepOutcome::Stopped, 5)
    });
    // From the same heightmap attempt 0 would give the proposal that was withdrawn.
    assert_eq!(goal(tracker.set_step(1).unwrap()), (1, 1, 0, false));
}

#[test]
fn a_second_motion_for_the_same_goal_is_the_one_to_decide_on() {
    let mut tracker = tracker(2);
    tracker.on_proposal(&proposal(7, 1, 0));
    tracker.on_result(&result(7, StepOutcome::Placed, 5));
    // Nobody knows of the first one any more: the operators were started again.
    tracker.on_proposal(&proposal(8, 1, 0));
    tracker.on_result(&result(8, StepOutcome::Placed, 9));
    assert!(
        tracker
            .on_confirmation(&says(OperatorDecision::Advance, 7))
            .is_err()
    );
    let change = tracker.on_confirmation(&says(OperatorDecision::Advance, 8));
    assert_eq!(goal(change.unwrap()), (2, 0, 9, false));
}
