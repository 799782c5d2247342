//! When the planner proposes.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{ChangeRules, Disk, Heightmap, Workspace};
use nalgebra::{Isometry2, Point2, Vector2};
use pick_place::PrimitiveSettings;

use crate::{
    Confirmation, Coverage, FAILED_PICK_RADIUS_M, Goal, Observation, OperatorDecision,
    PlannerRules, Prediction, Proposal, ProposalId, ProposalPlanner, ProposalStatus, StepOutcome,
    StepResult,
};

const REJECTED_RADIUS_M: f64 = 0.02;

fn planner() -> ProposalPlanner {
    ProposalPlanner::new(PlannerRules {
        changes: ChangeRules::default(),
        rejected_radius_m: REJECTED_RADIUS_M,
        checkpoint: "a checkpoint".into(),
        author: "a planner".into(),
    })
}

fn heightmap(stamp_s: u64, height_m: f32) -> Observation {
    let mut heightmap = Heightmap::new(Workspace {
        rows: 4,
        cols: 3,
        ..Workspace::RAVENS
    });
    heightmap.rgb.fill(100);
    heightmap.height_m.fill(height_m);
    Observation {
        stamp: Duration::from_secs(stamp_s),
        frame: "world".into(),
        heightmap: Arc::new(heightmap),
        coverage: Coverage::default(),
    }
}

fn goal(step: u32, attempt: u32, stamp_s: u64) -> Goal {
    Goal {
        stamp: Duration::from_secs(stamp_s),
        problem: "placing".into(),
        demonstration: "placing/10000".into(),
        step,
        step_count: 9,
        attempt,
        complete: false,
        module: "placing".into(),
        settings: PrimitiveSettings::RIGID,
        image: heightmap(0, 0.01 * step as f32).heightmap,
        coverage: Coverage::default(),
        previous: Some(heightmap(0, 0.01 * (step - 1) as f32).heightmap),
    }
}

fn prediction(x: f64) -> Prediction {
    Prediction {
        pick: Isometry2::new(Vector2::new(x, 0.1), 0.0),
        place: Isometry2::new(Vector2::new(0.5, -0.1), 1.0),
        pick_score: 0.9,
        place_score: 0.8,
        success_probability: None,
        done_probability: None,
    }
}

fn rejected(x: f64) -> Disk {
    Disk {
        center_m: Point2::new(x, 0.1),
        radius_m: REJECTED_RADIUS_M,
    }
}

fn failed(x: f64) -> Disk {
    Disk {
        radius_m: FAILED_PICK_RADIUS_M,
        ..rejected(x)
    }
}

fn says(decision: OperatorDecision, proposal_id: ProposalId) -> Confirmation {
    Confirmation {
        stamp: Duration::ZERO,
        proposal_id,
        decision,
        operator_name: "test".into(),
    }
}

fn result(proposal_id: ProposalId, outcome: StepOutcome) -> StepResult {
    StepResult {
        stamp: Duration::ZERO,
        proposal_id,
        outcome,
        reason: String::new(),
        duration: Duration::ZERO,
        status: None,
    }
}

fn refused(proposal_id: ProposalId, status: ProposalStatus) -> StepResult {
    StepResult {
        status: Some(status),
        ..result(proposal_id, StepOutcome::Refused)
    }
}

/// Somebody else's proposal.
fn another(proposal: &Proposal) -> ProposalId {
    ProposalId(proposal.id.0 ^ 1)
}

/// A planner that has proposed for step 1 from the observation of second 5.
fn proposed() -> (ProposalPlanner, Proposal) {
    let mut planner = planner();
    assert_eq!(planner.on_goal(goal(1, 0, 0)), None);
    assert!(planner.on_heightmap(heightmap(5, 0.0)).is_some());
    let (proposal, job) = planner.on_prediction(Ok(&prediction(0.4)));
    assert_eq!(job, None);
    (planner, proposal.unwrap().unwrap())
}

#[test]
fn a_proposal_carries_its_observation_and_goal() {
    let (_, proposal) = proposed();
    assert_eq!(proposal.stamp, Duration::from_secs(5));
    assert_eq!((proposal.step, proposal.attempt), (1, 0));
    assert_eq!(proposal.problem, "placing");
    assert_eq!(proposal.settings, goal(1, 0, 0).settings);
    assert_eq!(proposal.action.pick.translation.x, 0.4);
}

#[test]
fn the_id_depends_on_contents_alone() {
    let ids = |step, attempt, stamp_s, x| {
        let mut planner = planner();
        planner.on_goal(goal(step, attempt, 0));
        planner.on_heightmap(heightmap(stamp_s, 0.0));
        planner
            .on_prediction(Ok(&prediction(x)))
            .0
            .unwrap()
            .unwrap()
            .id
    };
    let id = ids(1, 0, 5, 0.4);
    assert_eq!(id, ids(1, 0, 5, 0.4));
    for other in [
        ids(2, 0, 5, 0.4),
        ids(1, 1, 5, 0.4),
        ids(1, 0, 6, 0.4),
        ids(1, 0, 5, 0.41),
    ] {
        assert_ne!(id, other);
    }
}

#[test]
fn a_heightmap_older_than_the_goal_is_not_acted_on() {
    let mut planner = planner();
    assert_eq!(planner.on_heightmap(heightmap(5, 0.0)), None);
    assert_eq!(planner.on_goal(goal(1, 0, 6)), None);
    assert_eq!(planner.on_heightmap(heightmap(5, 0.0)), None);
    assert!(planner.on_heightmap(heightmap(6, 0.0)).is_some());
}

#[test]
fn one_proposal_is_made_while_nothing_changes() {
    let (mut planner, _) = proposed();
    assert_eq!(planner.on_heightmap(heightmap(6, 0.001)), None);
    assert_eq!(planner.on_goal(goal(1, 0, 0)), None);
}

#[test]
fn a_changed_observation_supersedes_a_proposal_that_nobody_has_approved() {
    let (mut planner, first) = proposed();
    assert!(planner.on_heightmap(heightmap(6, 0.1)).is_some());
    let second = planner
        .on_prediction(Ok(&prediction(0.4)))
        .0
        .unwrap()
        .unwrap();
    assert_ne!(first.id, second.id);
    assert_eq!(second.stamp, Duration::from_secs(6));
}

#[test]
fn what_the_cameras_see_during_and_after_the_motion_makes_no_proposal() {
    let (mut planner, proposal) = proposed();
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    assert_eq!(planner.on_heightmap(heightmap(6, 0.1)), None);
    assert_eq!(
        planner.on_result(&result(proposal.id, StepOutcome::Placed)),
        None
    );
    assert_eq!(planner.on_heightmap(heightmap(7, 0.2)), None);
    // A second approval is refused; that opens nothing.
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    assert_eq!(
        planner.on_result(&result(proposal.id, StepOutcome::Refused)),
        None
    );
    assert!(planner.on_goal(goal(2, 0, 7)).is_some());
}

/// Where proposals are carried out without an approval.
#[test]
fn the_heightmap_after_a_motion_that_comes_before_its_result_makes_no_proposal() {
    let (mut planner, proposal) = proposed();
    assert!(planner.on_heightmap(heightmap(6, 0.1)).is_some());
    let moved = result(proposal.id, StepOutcome::Placed);
    assert_eq!(planner.on_result(&moved), None);
    assert_eq!(planner.on_prediction(Ok(&prediction(0.6))), (None, None));
    assert!(planner.on_goal(goal(2, 0, 6)).is_some());
}

#[test]
fn after_the_motion_of_another_proposal_ours_is_made_anew() {
    let (mut planner, proposal) = proposed();
    let mut moved = result(another(&proposal), StepOutcome::GraspFailed);
    moved.stamp = Duration::from_secs(7);
    assert_eq!(planner.on_result(&moved), None);
    assert_eq!(planner.on_heightmap(heightmap(6, 0.0)), None);
    assert!(planner.on_heightmap(heightmap(7, 0.0)).is_some());
    planner.on_prediction(Ok(&prediction(0.4)));
    assert_eq!(planner.on_heightmap(heightmap(8, 0.0)), None);
}

#[test]
fn a_refused_approval_opens_the_proposal_again() {
    let (mut planner, proposal) = proposed();
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    assert_eq!(planner.on_heightmap(heightmap(6, 0.1)), None);
    let job = planner.on_result(&result(proposal.id, StepOutcome::Refused));
    assert!(job.is_some());
}

#[test]
fn after_a_rejection_the_pick_is_left_out_and_after_the_step_no_more() {
    let (mut planner, _) = proposed();
    let job = planner.on_goal(goal(1, 1, 0)).unwrap();
    assert_eq!(job.exclude, [rejected(0.4)]);
    planner.on_prediction(Ok(&prediction(0.6)));
    let job = planner.on_goal(goal(1, 2, 0)).unwrap();
    assert_eq!(job.exclude, [rejected(0.4), rejected(0.6)]);
    planner.on_prediction(Ok(&prediction(0.7)));
    let job = planner.on_goal(goal(2, 0, 5)).unwrap();
    assert!(job.exclude.is_empty());
}

#[test]
fn somebody_elses_proposal_hides_ours_only_until_the_operators_word_on_it_is_refused() {
    let (mut planner, proposal) = proposed();
    let theirs = another(&proposal);
    planner.on_confirmation(&says(OperatorDecision::Approve, theirs));
    assert!(planner.needs_republish(&result(theirs, StepOutcome::Refused)));
    assert_eq!(
        planner.on_result(&result(theirs, StepOutcome::Refused)),
        None
    );
    let pending = refused(proposal.id, ProposalStatus::Pending);
    assert!(!planner.needs_republish(&pending));
    // An executor that does not know ours has to be told.
    assert!(planner.needs_republish(&result(proposal.id, StepOutcome::Refused)));
    assert!(!planner.needs_republish(&result(theirs, StepOutcome::Placed)));
    // Its rejection says nothing about our pick.
    planner.on_confirmation(&says(OperatorDecision::Reject, theirs));
    let job = planner.on_goal(goal(1, 1, 0)).unwrap();
    assert!(job.exclude.is_empty());
    planner.on_prediction(Ok(&prediction(0.6)));
    planner.on_confirmation(&says(OperatorDecision::Reject, ProposalId(1)));
    planner.on_goal(goal(2, 0, 7));
    assert!(!planner.needs_republish(&result(theirs, StepOutcome::Refused)));
}

#[test]
fn a_pick_that_has_just_failed_is_left_out_until_something_was_held() {
    let (mut planner, proposal) = proposed();
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    planner.on_result(&result(proposal.id, StepOutcome::NoContact));
    assert_eq!(planner.on_goal(goal(1, 1, 8)), None);
    let job = planner.on_heightmap(heightmap(8, 0.0)).unwrap();
    assert_eq!(job.exclude, [failed(0.4)]);
    let (second, _) = planner.on_prediction(Ok(&prediction(0.6)));
    let second = second.unwrap().unwrap();
    planner.on_result(&result(second.id, StepOutcome::GraspFailed));
    // The same result once more changes nothing.
    planner.on_result(&result(second.id, StepOutcome::GraspFailed));
    planner.on_goal(goal(1, 2, 9));
    let job = planner.on_heightmap(heightmap(9, 0.0)).unwrap();
    assert_eq!(job.exclude, [failed(0.4), failed(0.6)]);
    let (third, _) = planner.on_prediction(Ok(&prediction(0.7)));
    planner.on_result(&result(third.unwrap().unwrap().id, StepOutcome::Dropped));
    planner.on_goal(goal(1, 3, 10));
    let job = planner.on_heightmap(heightmap(10, 0.0)).unwrap();
    assert_eq!(job.exclude, []);
}

#[test]
fn what_failed_at_one_goal_is_not_left_out_at_another() {
    let (mut planner, proposal) = proposed();
    planner.on_result(&result(proposal.id, StepOutcome::GraspFailed));
    planner.on_goal(goal(2, 0, 8));
    let job = planner.on_heightmap(heightmap(8, 0.0)).unwrap();
    assert_eq!(job.exclude, []);
}

#[test]
fn a_failure_that_comes_after_the_goal_of_the_next_attempt_counts_all_the_same() {
    let (mut planner, proposal) = proposed();
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    planner.on_goal(goal(1, 1, 8));
    planner.on_heightmap(heightmap(8, 0.0)).unwrap();
    let late = result(proposal.id, StepOutcome::GraspFailed);
    assert_eq!(planner.on_result(&late), None);
    let (answer, job) = planner.on_prediction(Ok(&prediction(0.4)));
    assert_eq!(answer, None);
    assert_eq!(job.unwrap().exclude, [failed(0.4)]);
}

#[test]
fn an_answer_for_a_goal_that_has_gone_is_dropped() {
    let mut planner = planner();
    planner.on_goal(goal(1, 0, 0));
    assert!(planner.on_heightmap(heightmap(5, 0.0)).is_some());
    assert_eq!(planner.on_goal(goal(2, 0, 0)), None);
    let (proposal, job) = planner.on_prediction(Ok(&prediction(0.4)));
    assert_eq!(proposal, None);
    assert_eq!(*job.unwrap().goal, *goal(2, 0, 0).image);
    let (proposal, _) = planner.on_prediction(Ok(&prediction(0.4)));
    assert_eq!(proposal.unwrap().unwrap().step, 2);
}

#[test]
fn a_network_that_cannot_decide_is_asked_again_when_something_changes() {
    let mut planner = planner();
    planner.on_goal(goal(1, 0, 0));
    planner.on_heightmap(heightmap(5, 0.0)).unwrap();
    let (proposal, job) = planner.on_prediction(Err("other size".into()));
    assert_eq!((proposal, job), (Some(Err("other size".into())), None));
    assert_eq!(planner.on_heightmap(heightmap(6, 0.0)), None);
    assert!(planner.on_heightmap(heightmap(7, 0.1)).is_some());
}

#[test]
fn when_all_steps_are_done_nothing_is_proposed() {
    let (mut planner, _) = proposed();
    let complete = Goal {
        complete: true,
        ..goal(9, 0, 5)
    };
    assert_eq!(planner.on_goal(complete), None);
    assert_eq!(planner.on_heightmap(heightmap(9, 0.3)), None);
}

#[test]
fn a_second_approval_that_is_refused_does_not_reopen_a_proposal_that_moves() {
    let (mut planner, proposal) = proposed();
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    let moving = refused(proposal.id, ProposalStatus::Moving);
    assert_eq!(planner.on_result(&moving), None);
    // The arm before the cameras.
    assert_eq!(planner.on_heightmap(heightmap(6, 0.1)), None);
}

#[test]
fn a_refusal_says_that_the_arm_has_moved_where_the_result_was_lost() {
    let (mut planner, proposal) = proposed();
    let done = refused(proposal.id, ProposalStatus::Done);
    assert_eq!(planner.on_result(&done), None);
    assert_eq!(planner.on_heightmap(heightmap(6, 0.1)), None);
}

#[test]
fn a_proposal_that_somebody_elses_has_superseded_is_made_anew_with_another_id() {
    let (mut planner, proposal) = proposed();
    let job = planner.on_result(&refused(proposal.id, ProposalStatus::Superseded));
    assert!(job.is_some());
    let (second, _) = planner.on_prediction(Ok(&prediction(0.4)));
    let second = second.unwrap().unwrap();
    assert_ne!(second.id, proposal.id);
    assert_eq!(second.action, proposal.action);
}

#[test]
fn a_motion_or_stop_that_the_executor_has_forgotten_leaves_room_for_another_proposal() {
    for status in [ProposalStatus::Pending, ProposalStatus::Superseded] {
        let (mut planner, proposal) = proposed();
        let withdrawn = StepResult {
            status: Some(ProposalStatus::Withdrawn),
            ..result(proposal.id, StepOutcome::Stopped)
        };
        assert_eq!(planner.on_result(&withdrawn), None);
        // The executor was started again: all that it knows of the proposal is that it was published.
        let job = planner.on_result(&refused(proposal.id, status));
        assert!(job.is_some(), "{status:?}");
        let (second, _) = planner.on_prediction(Ok(&prediction(0.4)));
        assert_ne!(second.unwrap().unwrap().id, proposal.id);
    }
}

#[test]
fn a_refused_proposal_is_made_anew_from_the_next_observation_though_nothing_has_changed() {
    let (mut planner, proposal) = proposed();
    planner.on_confirmation(&says(OperatorDecision::Approve, proposal.id));
    // The executor was started again, and never sees the heightmap of second 5.
    assert_eq!(
        planner.on_result(&refused(proposal.id, ProposalStatus::Pending)),
        None
    );
    assert!(planner.on_heightmap(heightmap(6, 0.0)).is_some());
}

#[test]
fn what_was_withdrawn_was_not_a_bad_pick() {
    let (mut planner, proposal) = proposed();
    planner.on_result(&refused(proposal.id, ProposalStatus::Withdrawn));
    let job = planner.on_goal(goal(1, 1, 0)).unwrap();
    assert_eq!(job.exclude, []);
}

#[test]
fn a_job_holds_the_image_to_be_reached_and_the_one_before_it() {
    let mut planner = planner();
    planner.on_goal(goal(3, 0, 0));
    let job = planner.on_heightmap(heightmap(5, 0.0)).unwrap();
    assert_eq!(job.goal, goal(3, 0, 0).image);
    assert_eq!(job.previous, goal(3, 0, 0).previous);
}

#[test]
fn a_motion_that_the_executor_has_forgotten_is_proposed_anew() {
    let (mut planner, proposal) = proposed();
    planner.on_result(&result(proposal.id, StepOutcome::LagAborted));
    assert_eq!(planner.on_heightmap(heightmap(20, 0.0)), None);
    // The executor was started again: to it the proposal is one that nobody has approved.
    let job = planner.on_result(&refused(proposal.id, ProposalStatus::Pending));
    assert!(job.is_some());
}
