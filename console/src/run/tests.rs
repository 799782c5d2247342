use super::*;
use crate::preview::tests::{planned, unplanned};
use crate::samples;
use heightmap::Workspace;
use nalgebra::Isometry2;
use pick_place::PickPlace;
use step_protocol::{Confirmation, ProposalStatus, RefusalKind, StepResult};

const NOW: Duration = Duration::from_secs(100);
const WORKSPACE: Workspace = samples::workspace(4, 3, 0.1);

fn id(proposal: u64) -> ProposalId {
    ProposalId(proposal)
}

fn image(height_m: f32) -> Heightmap {
    samples::image(WORKSPACE, height_m)
}

fn heightmap(stamp_s: u64, height_m: f32) -> Observation {
    samples::observation(image(height_m), stamp_s)
}

fn goal(step: u32, attempt: u32, stamp_s: u64) -> Goal {
    Goal {
        stamp: Duration::from_secs(stamp_s),
        problem: "stacking".into(),
        demonstration: "stacking/10000".into(),
        step,
        step_count: 2,
        attempt,
        module: "stacking".into(),
        ..samples::goal(image(0.01 * step as f32))
    }
}

fn proposal(number: u64, step: u32, attempt: u32, stamp_s: u64) -> Proposal {
    let pose = Isometry2::translation(0.15, 0.15);
    Proposal {
        stamp: Duration::from_secs(stamp_s),
        problem: "stacking".into(),
        step,
        attempt,
        module: "stacking".into(),
        action: PickPlace {
            pick: pose,
            place: pose,
        },
        ..samples::proposal(number)
    }
}

fn confirmation(proposal: u64, decision: Decision) -> Confirmation {
    Confirmation {
        stamp: Duration::ZERO,
        proposal_id: id(proposal),
        decision: decision.into(),
        operator_name: "Ada".into(),
    }
}

fn refused(proposal: u64, status: Option<ProposalStatus>) -> StepResult {
    StepResult {
        status,
        ..result(proposal, StepOutcome::Refused, 21)
    }
}

fn result(proposal: u64, outcome: StepOutcome, stamp_s: u64) -> StepResult {
    samples::result(id(proposal), outcome, stamp_s)
}

/// A node hears a camera, whose newest image is of this age, and says how a part of it is.
fn hears_camera(run: &mut Run, node: &str, age: &str) {
    let image = format!("in messages=9 rate_hz=1.0 age_s={age} dropped=0 errors=0");
    let own = "out messages=9 rate_hz=0.0 age_s=50.0 dropped=0 errors=0";
    let report = NodeReport {
        values: vec![
            ("/front/color/image_raw".into(), image),
            ("/heightmap".into(), own.into()),
        ],
        ..report(node, "topics", "all messages arrive whole")
    };
    run.on_report(report, NOW);
}

fn report(node: &str, state: &str, message: &str) -> NodeReport {
    NodeReport {
        node: node.into(),
        state: state.into(),
        message: message.into(),
        ..NodeReport::default()
    }
}

/// A run in which all streams are fresh.
fn fresh() -> Run {
    let mut run = Run::new(samples::watch(&["/camera_fusion", "/suction_executor"]));
    hears_camera(&mut run, "/camera_fusion", "0.5");
    run.on_report(report("/suction_executor", "topics", "all well"), NOW);
    run.on_report(report("/suction_executor", "driver", "ready"), NOW);
    run.on_joints(samples::joint("elbow", 0.0), NOW);
    run
}

/// A run with an open proposal 7 for step 1.
fn proposed() -> Run {
    let mut run = fresh();
    run.on_heightmap(heightmap(10, 0.0), NOW);
    run.on_goal(goal(1, 0, 0), NOW).unwrap();
    run.on_proposal(proposal(7, 1, 0, 10)).unwrap();
    run.on_planned_motion(planned(7));
    run
}

#[test]
fn a_run_goes_from_proposal_to_approval_motion_confirmation_and_its_end() {
    let mut run = fresh();
    assert_eq!(run.phase(), RunPhase::NoGoal);
    run.on_heightmap(heightmap(10, 0.0), NOW);
    run.on_goal(goal(1, 0, 0), NOW).unwrap();
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    run.on_proposal(proposal(7, 1, 0, 10)).unwrap();
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(id(7)))
    );
    run.check(Decision::Approve, NOW).unwrap_err();
    run.on_planned_motion(planned(7));
    run.check(Decision::Approve, NOW).unwrap();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    assert_eq!(run.phase(), RunPhase::Moving);
    run.check(Decision::Approve, NOW).unwrap_err();
    run.check(Decision::Stop, NOW).unwrap();
    run.on_result(&result(7, StepOutcome::Placed, 20), NOW);
    assert_eq!(run.phase(), RunPhase::AwaitingConfirmation);
    run.check(Decision::Advance, NOW).unwrap();
    run.on_heightmap(heightmap(21, 0.1), NOW);
    run.on_confirmation(&confirmation(7, Decision::Advance), NOW);
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    let (before, after) = run.past_step(1).unwrap();
    assert_eq!((before.unwrap().number, after.unwrap().number), (1, 2));
    let mut last = goal(2, 0, 20);
    last.complete = true;
    run.on_goal(last, NOW).unwrap();
    assert_eq!(run.phase(), RunPhase::Complete);
    run.check(Decision::Stop, NOW).unwrap_err();
}

#[test]
fn a_proposal_that_comes_before_its_goal_is_shown_with_it() {
    let mut run = proposed();
    run.on_proposal(proposal(8, 2, 0, 20)).unwrap();
    // The present one stands as long as its goal does.
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(id(7)))
    );
    run.on_goal(goal(2, 0, 20), NOW).unwrap();
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(id(8)))
    );
}

#[test]
fn a_refused_approval_opens_the_proposal_again_and_says_why_and_what_to_do() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    let mut refusal = result(7, StepOutcome::Refused, 11);
    refusal.reason = "proposal 7: the observation has changed since".into();
    run.on_result(&refusal, NOW);
    assert_eq!(run.phase(), RunPhase::Proposed);
    let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
    assert_eq!(json["notices"][0]["kind"], "refusal");
    let advice = json["notices"][0]["advice"].as_str().unwrap();
    assert!(advice.contains("new proposal"), "{advice}");
}

#[test]
fn a_refused_advance_asks_again_whether_the_step_succeeded() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    run.on_result(&result(7, StepOutcome::Dropped, 20), NOW);
    run.on_confirmation(&confirmation(7, Decision::Retry), NOW);
    let refuse = |run: &mut Run, kind| {
        let reason = "proposal 7: a decision waits for its result already";
        run.on_confirmation_refused(id(7), Some(kind), reason, NOW);
    };
    refuse(&mut run, RefusalKind::Twice);
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    refuse(&mut run, RefusalKind::Unknown);
    assert_eq!(run.phase(), RunPhase::AwaitingConfirmation);
    refuse(&mut run, RefusalKind::Stopped);
    assert_eq!(run.phase(), RunPhase::Stopped);
    let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
    let kinds: Vec<_> = json["notices"]
        .as_array()
        .unwrap()
        .iter()
        .map(|notice| &notice["kind"])
        .collect();
    assert_eq!(kinds, ["refusal"; 3]);
}

#[test]
fn where_the_executor_says_that_a_proposal_stands_is_where_it_is_shown() {
    for (status, phase) in [
        (Some(ProposalStatus::Pending), RunPhase::Proposed),
        (Some(ProposalStatus::Superseded), RunPhase::AwaitingProposal),
        (Some(ProposalStatus::Moving), RunPhase::Moving),
        (Some(ProposalStatus::Done), RunPhase::AwaitingConfirmation),
        (Some(ProposalStatus::Rejected), RunPhase::AwaitingProposal),
        (Some(ProposalStatus::Withdrawn), RunPhase::AwaitingProposal),
        (None, RunPhase::Proposed),
    ] {
        let mut run = proposed();
        run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
        run.on_result(&refused(7, status), NOW);
        assert_eq!(run.phase(), phase, "status {status:?}");
    }
}

#[test]
fn a_stop_that_only_withdrew_the_proposal_is_no_step() {
    let mut run = proposed();
    let mut stopped = result(7, StepOutcome::Stopped, 11);
    stopped.status = Some(ProposalStatus::Withdrawn);
    run.on_result(&stopped, NOW);
    assert_eq!(run.phase(), RunPhase::Stopped);
    assert!(run.past_step(1).is_none());
}

#[test]
fn a_proposal_made_before_the_table_changed_is_stale_until_the_table_is_as_it_was() {
    let mut run = proposed();
    run.on_heightmap(heightmap(11, 0.004), NOW);
    run.check(Decision::Approve, NOW).unwrap();
    run.on_heightmap(heightmap(12, 0.02), NOW);
    let refusal = run.check(Decision::Approve, NOW).unwrap_err();
    assert!(refusal.reason.contains("stale"), "{refusal:?}");
    run.check(Decision::Reject, NOW).unwrap();
    run.on_heightmap(heightmap(13, 0.0), NOW);
    run.check(Decision::Approve, NOW).unwrap();
    // A proposal that comes after the change that it has not seen.
    run.on_heightmap(heightmap(14, 0.02), NOW);
    run.on_proposal(proposal(8, 1, 0, 13)).unwrap();
    run.check(Decision::Approve, NOW).unwrap_err();
    run.on_proposal(proposal(9, 1, 0, 14)).unwrap();
    run.on_planned_motion(planned(9));
    run.check(Decision::Approve, NOW).unwrap();
}

#[test]
fn who_made_a_proposal_and_how_likely_it_succeeds_is_shown() {
    let mut run = proposed();
    let shown = |run: &Run| serde_json::to_value(run.snapshot(NOW)).unwrap()["proposal"].clone();
    assert!(shown(&run)["success_probability"].is_null());
    let made = Proposal {
        success_probability: Some(0.75),
        checkpoint: "stacking".into(),
        author: "gctn_policy".into(),
        ..proposal(8, 1, 0, 10)
    };
    run.on_proposal(made).unwrap();
    let shown = shown(&run);
    assert_eq!(shown["success_probability"], 0.75);
    assert_eq!(shown["verdict"], "");
    assert_eq!(
        (&shown["checkpoint"], &shown["author"]),
        (&"stacking".into(), &"gctn_policy".into())
    );
    let pose = Pose {
        x_m: 0.1,
        y_m: 0.2,
        yaw_rad: 0.0,
    };
    let corrected = run.correction(pose, pose, "Ada").unwrap();
    assert_eq!(
        (corrected.author.as_str(), corrected.success_probability),
        ("Ada", None)
    );
    assert_eq!(corrected.checkpoint, "");
}

#[test]
fn a_goal_that_looks_reached_and_a_policy_that_does_not_know_are_shown() {
    let mut run = proposed();
    let mut number = 7;
    let mut verdict = |success: Option<f32>, done: Option<f32>| {
        number += 1;
        let made = Proposal {
            success_probability: success,
            done_probability: done,
            ..proposal(number, 1, 0, 10)
        };
        run.on_proposal(made).unwrap();
        let shown = serde_json::to_value(run.snapshot(NOW)).unwrap();
        shown["proposal"]["verdict"].as_str().unwrap().to_owned()
    };
    assert_eq!(
        verdict(Some(0.9), Some(0.8)),
        "the goal of this step looks reached already"
    );
    assert_eq!(
        verdict(Some(0.1), Some(0.2)),
        "the policy does not know how to reach the goal"
    );
    assert_eq!(verdict(Some(0.9), Some(0.2)), "");
    assert_eq!(verdict(None, None), "");
}

#[test]
fn a_rejected_proposal_is_not_open_when_it_is_published_again() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Reject), NOW);
    run.on_result(&result(7, StepOutcome::Rejected, 10), NOW);
    run.on_proposal(proposal(7, 1, 0, 10)).unwrap();
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    run.on_goal(goal(1, 1, 0), NOW).unwrap();
    run.on_proposal(proposal(8, 1, 1, 10)).unwrap();
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(id(8)))
    );
}

#[test]
fn a_stop_holds_until_a_goal_is_latched_again() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    run.on_confirmation(&confirmation(7, Decision::Stop), NOW);
    assert_eq!(run.phase(), RunPhase::Stopped);
    run.on_result(&result(7, StepOutcome::Stopped, 15), NOW);
    assert_eq!(run.phase(), RunPhase::Stopped);
    run.check(Decision::Approve, NOW).unwrap_err();
    // The same goal latched once more is no new one.
    run.on_goal(goal(1, 0, 0), NOW).unwrap();
    assert_eq!(run.phase(), RunPhase::Stopped);
    run.on_goal(goal(1, 1, 15), NOW).unwrap();
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
}

#[test]
fn after_a_fault_the_step_can_be_tried_again() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    run.on_result(&result(7, StepOutcome::Fault, 15), NOW);
    assert_eq!(run.phase(), RunPhase::Fault);
    run.check(Decision::Retry, NOW).unwrap();
    let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
    assert!(
        json["notices"][0]["reason"]
            .as_str()
            .unwrap()
            .contains("For a reason.")
    );
}

#[test]
fn images_of_a_driver_with_other_names_are_watched_too() {
    let mut run = proposed();
    let image = "in messages=9 rate_hz=1.0 age_s=3.5 dropped=0 errors=0";
    let late = NodeReport {
        values: vec![("/front/depth/depth_registered".into(), image.into())],
        ..report("/camera_fusion", "topics", "all messages arrive whole")
    };
    run.on_report(late, NOW);
    let refusal = run.check(Decision::Approve, NOW).unwrap_err();
    assert!(
        refusal.reason.contains("front/depth/depth_registered"),
        "{refusal:?}"
    );
}

#[test]
fn what_is_stale_cannot_be_approved_but_can_be_stopped() {
    let late = NOW + Duration::from_secs(4);
    let run = proposed();
    let refusal = run.check(Decision::Approve, late).unwrap_err();
    assert!(
        refusal.reason.contains("camera_fusion is stale"),
        "{refusal:?}"
    );
    run.check(Decision::Reject, late).unwrap();
    run.check(Decision::Stop, late).unwrap();

    // The node lives, and its camera has fallen silent.
    let mut run = proposed();
    hears_camera(&mut run, "/camera_fusion", "3.5");
    let refusal = run.check(Decision::Approve, NOW).unwrap_err();
    assert!(
        refusal.reason.contains("front/color/image_raw"),
        "{refusal:?}"
    );
    hears_camera(&mut run, "/camera_fusion", "never");
    let refusal = run.check(Decision::Approve, NOW).unwrap_err();
    assert!(refusal.reason.contains("Nothing has come"), "{refusal:?}");
    hears_camera(&mut run, "/camera_fusion", "0.1");
    run.check(Decision::Approve, NOW).unwrap();
}

#[test]
fn nothing_is_approved_while_the_robot_is_not_ready() {
    let mut run = proposed();
    let stopped = "safety mode is PROTECTIVE_STOP, expected NORMAL or REDUCED";
    run.on_report(report("/suction_executor", "driver", stopped), NOW);
    let refusal = run.check(Decision::Approve, NOW).unwrap_err();
    assert!(refusal.reason.contains("PROTECTIVE_STOP"), "{refusal:?}");
    assert!(refusal.advice.contains("teach pendant"), "{refusal:?}");
}

#[test]
fn a_message_that_cannot_be_shown_is_named_by_its_field_and_changes_nothing() {
    let mut run = proposed();
    let error = run.on_goal(goal(3, 0, 11), NOW).unwrap_err().to_string();
    assert!(error.contains("step is 3"), "{error}");
    let mut outside = proposal(8, 1, 0, 10);
    outside.action.place.translation.x = 9.0;
    let error = run.on_proposal(outside).unwrap_err().to_string();
    assert!(error.contains("place is (9.000"), "{error}");
    let mut nowhere = proposal(8, 1, 0, 10);
    nowhere.action.pick.translation.y = f64::NAN;
    let error = run.on_proposal(nowhere).unwrap_err().to_string();
    assert!(error.starts_with("pick"), "{error}");
    let long = " ".repeat(LONGEST_DESCRIPTION + 1);
    let error = run.on_robot_description(long).unwrap_err().to_string();
    assert!(error.contains("1048577 bytes"), "{error}");
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(id(7)))
    );
}

#[test]
fn the_demonstration_strip_holds_what_was_latched_and_begins_anew_with_another() {
    let mut run = proposed();
    run.on_goal(goal(2, 0, 20), NOW).unwrap();
    assert!(run.strip(1).is_some() && run.strip(2).is_some());
    let mut other = goal(1, 0, 30);
    other.demonstration = "stacking/10002".into();
    run.on_goal(other, NOW).unwrap();
    assert!(run.strip(1).is_some() && run.strip(2).is_none());
    // One that was read fills the gaps, where it is the present one.
    let read = || vec![image(0.1), image(0.2)];
    run.on_demonstration("stacking/10000".into(), read(), NOW);
    assert!(run.strip(2).is_none());
    run.on_demonstration("stacking/10002".into(), read(), NOW);
    assert_eq!(run.strip(1).unwrap().number, 3);
    assert_eq!(run.strip(2).unwrap().heightmap.height_m[0], 0.2);
    assert!(run.strip(0).is_none() && run.strip(3).is_none());
}

#[test]
fn a_correction_is_a_proposal_for_the_present_goal_from_the_newest_view() {
    let mut run = proposed();
    let pose = |x_m, yaw_rad| Pose {
        x_m,
        y_m: 0.2,
        yaw_rad,
    };
    let corrected = run
        .correction(pose(0.1, 0.0), pose(0.2, 0.5), "Ada")
        .unwrap();
    assert_eq!((corrected.step, corrected.attempt), (1, 0));
    assert_eq!(corrected.stamp, Duration::from_secs(10));
    let place = Pose::from(&corrected.action.place);
    assert_eq!((place.x_m, place.yaw_rad), (0.2, 0.5));
    let corrected_id = corrected.id;
    run.on_proposal(corrected).unwrap();
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(corrected_id))
    );
    // The same one again would be taken for a repetition.
    run.correction(pose(0.1, 0.0), pose(0.2, 0.5), "Ada")
        .unwrap_err();
    assert_ne!(
        run.correction(pose(0.1, 0.0), pose(0.2, 0.6), "Ada")
            .unwrap()
            .id,
        corrected_id
    );
    let refusal = run
        .correction(pose(9.0, 0.0), pose(0.2, 0.5), "Ada")
        .unwrap_err();
    assert!(refusal.reason.contains("pick lies outside"), "{refusal:?}");
    run.correction(pose(0.1, 0.0), pose(f64::NAN, 0.5), "Ada")
        .unwrap_err();

    // The policy proposes again once the arm has moved; the operator still judges the corrected step.
    run.on_confirmation(&confirmation(corrected_id.0, Decision::Approve), NOW);
    run.correction(pose(0.1, 0.0), pose(0.2, 0.7), "Ada")
        .unwrap_err();
    run.on_result(&result(corrected_id.0, StepOutcome::Placed, 20), NOW);
    run.on_proposal(proposal(9, 1, 0, 21)).unwrap();
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::AwaitingConfirmation, Some(corrected_id))
    );
}

#[test]
fn a_stop_without_a_proposal_ends_the_run_without_a_refusal() {
    let mut run = fresh();
    run.on_heightmap(heightmap(10, 0.0), NOW);
    run.on_goal(goal(1, 0, 0), NOW).unwrap();
    run.on_confirmation(&confirmation(0, Decision::Stop), NOW);
    run.on_result(&result(0, StepOutcome::Refused, 10), NOW);
    assert_eq!(run.phase(), RunPhase::Stopped);
    let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
    assert_eq!(json["notices"].as_array().unwrap().len(), 0);
}

#[test]
fn the_planned_motion_and_the_scores_of_another_proposal_are_not_shown() {
    let mut run = proposed();
    assert_eq!(run.motion().unwrap().proposal_id, id(7));
    let scores = |stamp_s| ScoreMaps {
        stamp: Duration::from_secs(stamp_s),
        rows: 4,
        cols: 6,
        rgb: vec![0; 72],
    };
    run.on_scores(scores(9));
    assert!(run.scores().is_none());
    run.on_scores(scores(10));
    assert_eq!(run.scores().unwrap().0, 2);
    run.on_proposal(proposal(8, 1, 0, 11)).unwrap();
    assert!(run.motion().is_none() && run.scores().is_none());
}

#[test]
fn a_proposal_can_only_be_approved_when_the_executor_has_planned_it() {
    let mut run = proposed();
    run.on_proposal(proposal(8, 1, 0, 10)).unwrap();
    let why = |run: &Run| run.check(Decision::Approve, NOW).unwrap_err().reason;
    assert!(why(&run).contains("not planned"), "{}", why(&run));
    run.check(Decision::Reject, NOW).unwrap();
    run.on_planned_motion(unplanned(8, "place is out of reach"));
    assert!(
        why(&run).contains("Place is out of reach."),
        "{}",
        why(&run)
    );
    // The table is shown as it is: nothing is greyed.
    assert!(!run.snapshot(NOW).stale);
    // The executor has planned it after all.
    run.on_planned_motion(planned(8));
    run.check(Decision::Approve, NOW).unwrap();
    // The proposal before it stands again.
    run.on_proposal(proposal(7, 1, 0, 10)).unwrap();
    run.check(Decision::Approve, NOW).unwrap();
}

#[test]
fn a_demonstration_that_is_repeated_before_a_motion_was_confirmed_begins_anew() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    run.on_result(&result(7, StepOutcome::Placed, 20), NOW);
    assert_eq!(run.phase(), RunPhase::AwaitingConfirmation);
    run.on_goal(goal(1, 0, 20), NOW).unwrap();
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    run.on_proposal(proposal(8, 1, 0, 21)).unwrap();
    assert_eq!(
        (run.phase(), run.current_id()),
        (RunPhase::Proposed, Some(id(8)))
    );
}

#[test]
fn without_an_executor_the_words_say_so() {
    let mut run = Run::new(samples::watch(&["/suction_executor"]));
    run.on_heightmap(heightmap(10, 0.0), NOW);
    run.on_goal(goal(1, 0, 0), NOW).unwrap();
    run.on_proposal(proposal(7, 1, 0, 10)).unwrap();
    let refusal = run.check(Decision::Approve, NOW).unwrap_err();
    assert!(
        refusal.reason.contains("No executor is there"),
        "{refusal:?}"
    );
}

#[test]
fn an_approval_that_the_executor_does_not_carry_out_is_asked_for_again() {
    let mut run = proposed();
    let later = |run: &mut Run, seconds, moves| {
        let now = NOW + Duration::from_secs(seconds);
        run.on_motion(moves, now);
        run.ask_again(now)
    };
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    assert_eq!(later(&mut run, 1, false), None);
    // The arm moves for 20 s; its result comes a little after its end.
    for seconds in 2..20 {
        assert_eq!(later(&mut run, seconds, true), None);
    }
    assert_eq!(later(&mut run, 22, false), None);
    assert_eq!(run.phase(), RunPhase::Moving);
    assert_eq!(later(&mut run, 30, false), Some(id(7)));
    assert_eq!(run.phase(), RunPhase::Proposed);
    let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
    let reason = json["notices"][0]["reason"].as_str().unwrap();
    assert!(reason.contains("not answered the approval"), "{reason}");
    assert_eq!(later(&mut run, 40, false), None);
}

#[test]
fn a_decision_that_the_oracle_does_not_answer_is_asked_for_again() {
    let late = NOW + Duration::from_secs(7);
    // A rejection that the executor has taken is the page's to repeat, not the person's.
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Reject), NOW);
    run.on_result(&result(7, StepOutcome::Rejected, 11), NOW);
    assert_eq!(run.ask_again(late), None);
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    assert_eq!(run.probe(late), None);
    assert_eq!(run.probe(late + Duration::from_secs(11)), Some(id(7)));

    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    run.on_result(&result(7, StepOutcome::Placed, 20), NOW);
    assert_eq!(run.ask_again(late), None);
    run.on_confirmation(&confirmation(7, Decision::Advance), NOW);
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
    assert_eq!(run.ask_again(late), Some(id(7)));
    assert_eq!(run.phase(), RunPhase::AwaitingConfirmation);
    // An answer is a goal.
    run.on_confirmation(&confirmation(7, Decision::Advance), NOW);
    run.on_goal(goal(2, 0, 20), NOW).unwrap();
    assert_eq!(run.ask_again(late), None);
}

#[test]
fn a_result_that_comes_twice_is_one_step() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    for _ in 0..2 {
        run.on_result(&result(7, StepOutcome::Placed, 20), NOW);
    }
    assert!(run.past_step(1).is_some() && run.past_step(2).is_none());
    // Nor does it open a question that was answered.
    run.on_confirmation(&confirmation(7, Decision::Advance), NOW);
    run.on_result(&result(7, StepOutcome::Placed, 20), NOW);
    assert_eq!(run.phase(), RunPhase::AwaitingProposal);
}

#[test]
fn the_answer_to_a_rejection_that_the_console_has_repeated_by_itself_is_not_shown() {
    let mut run = proposed();
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    run.on_result(&refused(7, Some(ProposalStatus::Superseded)), NOW);
    let later = |seconds| NOW + Duration::from_secs(seconds);
    assert_eq!(run.probe(later(0)), None);
    assert_eq!(run.probe(later(11)), Some(id(7)));
    run.on_result(&refused(7, Some(ProposalStatus::Superseded)), later(12));
    let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
    assert_eq!(json["notices"].as_array().unwrap().len(), 1);
}

#[test]
fn joints_are_taken_ten_times_a_second_and_shown_while_the_arm_moves() {
    let mut run = proposed();
    let joints = |run: &mut Run, milliseconds, position_rad| {
        let now = NOW + Duration::from_millis(milliseconds);
        run.on_joints(samples::joint("elbow", position_rad), now)
    };
    assert!(!joints(&mut run, 200, 1.0), "nothing moves");
    run.on_confirmation(&confirmation(7, Decision::Approve), NOW);
    assert!(!joints(&mut run, 250, 2.0), "too soon");
    let shown = |run: &Run| {
        let json = serde_json::to_value(run.snapshot(NOW)).unwrap();
        json["joints"]["elbow"].as_f64().unwrap()
    };
    assert_eq!(shown(&run), 1.0);
    assert!(joints(&mut run, 300, 3.0));
    assert_eq!(shown(&run), 3.0);
}

#[test]
fn viewers_are_told_at_once_when_something_is_held_or_lost() {
    let mut run = fresh();
    assert!(!run.on_pins(Some(true), None));
    assert!(run.on_pins(Some(true), Some(true)));
    assert!(!run.on_pins(Some(false), Some(true)));
    assert!(run.on_pins(Some(false), Some(false)));
}
