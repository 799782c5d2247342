//! What the executor decides around its gate.

use std::time::Duration;

use pick_place::{Outcome, Phase};

use super::gate::{NOW, READY, Robot, empty, proposal, rules};
use crate::{
    CannotBegin, Executor, ExecutorAction, GateRules, MotionCause, MotionEnd, MotionOrder,
    MotionTimes, OperatorDecision, ProposalId, ProposalStatus, Proposed, Recovery, RequireApproval,
    Said, StepOutcome, StopCause,
};

const TIMEOUT: Duration = Duration::from_secs(1);
const ID: ProposalId = ProposalId(7);
const OTHER: ProposalId = ProposalId(8);

/// An executor that has received a heightmap.
fn executor(
    require_approval: RequireApproval,
    presence_timeout: Option<Duration>,
    stopped: Option<&str>,
) -> Executor {
    let rules = GateRules {
        require_approval,
        ..rules()
    };
    let mut executor = Executor::new(rules, presence_timeout, stopped.map(str::to_owned));
    executor.activate();
    executor.on_heightmap(Duration::from_secs(5), empty());
    executor
}

fn asking() -> Executor {
    executor(RequireApproval::Always, None, None)
}

fn propose(executor: &mut Executor, id: ProposalId) -> Vec<ExecutorAction> {
    let (proposed, actions) = executor.on_proposal(id, Ok(proposal(id.0)), &READY, NOW);
    assert_eq!(proposed, Proposed::Pending);
    actions
}

fn decide(
    executor: &mut Executor,
    id: ProposalId,
    decision: OperatorDecision,
) -> Vec<ExecutorAction> {
    executor.on_confirmation(id, decision, "anna", &READY, NOW)
}

fn approve(executor: &mut Executor, id: ProposalId) -> Vec<ExecutorAction> {
    decide(executor, id, OperatorDecision::Approve)
}

fn goal(executor: &mut Executor, id: ProposalId) -> Result<Vec<ExecutorAction>, String> {
    let goal = executor.on_goal(id, Ok(proposal(id.0)), &READY, NOW);
    goal.map_err(|said| {
        assert!(!said.ends_goal && said.report.outcome == StepOutcome::Refused);
        said.report.reason
    })
}

fn end(executor: &mut Executor, end: MotionEnd) -> Vec<ExecutorAction> {
    let times = MotionTimes::new(None, NOW);
    executor.on_motion_end(end, times, &READY, NOW)
}

fn begins(id: ProposalId) -> ExecutorAction {
    ExecutorAction::Begin(MotionOrder::Proposal(Box::new(proposal(id.0))))
}

#[track_caller]
fn said(actions: &[ExecutorAction]) -> &Said {
    let mut said = actions.iter().filter_map(|action| match action {
        ExecutorAction::Say(said) => Some(said),
        _ => None,
    });
    said.next()
        .unwrap_or_else(|| panic!("nothing was said: {actions:?}"))
}

#[track_caller]
fn assert_said(actions: &[ExecutorAction], outcome: StepOutcome, ends_goal: bool, part: &str) {
    let Said {
        report,
        ends_goal: ends,
        ..
    } = said(actions);
    assert_eq!((report.outcome, *ends), (outcome, ends_goal), "{report:?}");
    assert!(report.reason.contains(part), "{report:?}");
}

fn moves_anything(actions: &[ExecutorAction]) -> bool {
    let mut actions = actions.iter();
    actions.any(|action| matches!(action, ExecutorAction::Begin(_)))
}

#[test]
fn a_goal_waits_for_an_approval_and_ends_with_its_motion() {
    let mut executor = asking();
    let waits = goal(&mut executor, ID).unwrap();
    assert_eq!(waits, [ExecutorAction::AwaitApproval(ID)]);
    assert!(!executor.goal().unwrap().is_moving);
    assert_eq!(approve(&mut executor, ID), [begins(ID)]);
    assert!(executor.goal().unwrap().is_moving);
    // A word on an approval that comes again ends nothing.
    let again = approve(&mut executor, ID);
    assert_said(&again, StepOutcome::Refused, false, "already being");
    let ended = end(&mut executor, MotionEnd::Done(Some(Outcome::Placed)));
    assert_said(&ended, StepOutcome::Placed, true, "");
    assert_eq!((executor.moving(), executor.goal()), (None, None));
    assert_eq!(executor.status(ID), Some(ProposalStatus::Done));
}

#[test]
fn a_goal_moves_unasked_only_where_no_approval_is_asked_for() {
    let mut executor = executor(RequireApproval::Never, None, None);
    assert_eq!(goal(&mut executor, ID).unwrap(), [begins(ID)]);
    assert!(executor.goal().unwrap().is_moving);
}

#[test]
fn a_second_goal_and_one_while_the_arm_moves_are_rejected_with_the_reason() {
    let mut executor = asking();
    goal(&mut executor, ID).unwrap();
    let reason = goal(&mut executor, OTHER).unwrap_err();
    assert_eq!(
        reason,
        "goal for proposal 8 rejected: a goal for proposal 7 is active"
    );
    let mut executor = asking();
    propose(&mut executor, ID);
    approve(&mut executor, ID);
    let reason = goal(&mut executor, OTHER).unwrap_err();
    assert!(
        reason.contains("proposal 7 is being carried out"),
        "{reason}"
    );
    assert_eq!(executor.status(OTHER), None);
    let mut executor = asking();
    let unreadable = executor.on_goal(ID, Err("no pose".to_owned()), &READY, NOW);
    assert!(unreadable.unwrap_err().report.reason.contains("no pose"));
}

#[test]
fn a_goal_that_is_cancelled_before_it_moves_can_no_longer_be_approved() {
    let mut executor = asking();
    goal(&mut executor, ID).unwrap();
    assert!(!executor.goal().unwrap().is_cancelled);
    let cancelled = executor.on_goal_cancel();
    assert_said(&cancelled, StepOutcome::Stopped, true, "nothing was moving");
    assert_eq!(executor.status(ID), Some(ProposalStatus::Withdrawn));
    assert!(!moves_anything(&approve(&mut executor, ID)));
    assert_eq!(executor.on_goal_cancel(), []);
}

#[test]
fn a_goal_that_is_cancelled_in_its_motion_stops_that_and_ends_with_it() {
    let mut executor = asking();
    goal(&mut executor, ID).unwrap();
    approve(&mut executor, ID);
    let cancelled = executor.on_goal_cancel();
    assert_eq!(cancelled, [ExecutorAction::Stop(StopCause::GoalCancelled)]);
    assert!(executor.goal().unwrap().is_cancelled);
    // What has stopped it first counts.
    let stopped = decide(&mut executor, ID, OperatorDecision::Stop);
    assert_eq!(stopped, [ExecutorAction::Stop(StopCause::GoalCancelled)]);
    let ended = end(&mut executor, MotionEnd::Stopped(Phase::Lift));
    assert_said(&ended, StepOutcome::Stopped, true, "goal was cancelled");
}

#[test]
fn a_goal_ends_when_its_proposal_can_no_longer_be_approved() {
    let mut executor = asking();
    goal(&mut executor, ID).unwrap();
    let superseded = propose(&mut executor, OTHER);
    assert_said(&superseded, StepOutcome::Refused, true, "superseded");
    goal(&mut executor, ProposalId(9)).unwrap();
    let stopped = decide(&mut executor, OTHER, OperatorDecision::Stop);
    let of_goal = stopped.iter().any(|action| match action {
        ExecutorAction::Say(said) => said.ends_goal && said.report.id == ProposalId(9),
        _ => false,
    });
    assert!(of_goal, "{stopped:?}");
    assert!(!moves_anything(&approve(&mut executor, ProposalId(9))));
}

#[test]
fn the_goals_of_an_active_state_end_with_it() {
    let mut executor = asking();
    goal(&mut executor, ID).unwrap();
    assert_eq!(executor.deactivate(StopCause::Deactivated), []);
    executor.activate();
    assert_eq!(executor.on_goal_cancel(), []);
    // Its client has heard that it has ended.
    assert_eq!(executor.status(ID), Some(ProposalStatus::Withdrawn));
    assert!(!moves_anything(&approve(&mut executor, ID)));
    goal(&mut executor, OTHER).unwrap();
    approve(&mut executor, OTHER);
    let stopped = executor.deactivate(StopCause::Shutdown);
    assert_eq!(stopped, [ExecutorAction::Stop(StopCause::Shutdown)]);
}

#[test]
fn nothing_begins_to_move_before_an_operator_is_present() {
    let mut executor = executor(RequireApproval::Never, Some(TIMEOUT), None);
    let unasked = propose(&mut executor, ID);
    assert_said(&unasked, StepOutcome::Refused, false, "require_presence");
    assert!(!moves_anything(&unasked));
    let home = executor.propose_recovery(OTHER, Recovery::Home, &READY, NOW);
    let Err(CannotBegin::Refused(reason)) = home else {
        panic!("expected a refusal, found {home:?}");
    };
    assert_eq!(
        reason.text(),
        "no operator is present (require_presence)",
        "{reason:?}"
    );
    assert_eq!(executor.on_presence(true, NOW), []);
    assert_eq!(approve(&mut executor, ID), [begins(ID)]);
}

#[test]
fn a_motion_stops_when_the_operator_goes_away_or_falls_silent() {
    for leaves in [false, true] {
        let mut executor = executor(RequireApproval::Always, Some(TIMEOUT), None);
        executor.on_presence(true, NOW);
        propose(&mut executor, ID);
        assert_eq!(executor.deadline(), None);
        approve(&mut executor, ID);
        assert_eq!(executor.deadline(), Some(NOW + TIMEOUT));
        assert_eq!(executor.on_time(&READY, NOW + TIMEOUT / 2), []);
        let stopped = match leaves {
            true => executor.on_presence(false, NOW + TIMEOUT / 2),
            false => executor.on_time(&READY, NOW + TIMEOUT),
        };
        assert_eq!(stopped, [ExecutorAction::Stop(StopCause::NobodyPresent)]);
        // Once is enough.
        assert_eq!(executor.deadline(), None);
        let ended = end(&mut executor, MotionEnd::Stopped(Phase::Transfer));
        assert_said(&ended, StepOutcome::Stopped, false, "no operator");
    }
    let mut executor = asking();
    propose(&mut executor, ID);
    approve(&mut executor, ID);
    assert_eq!(executor.on_presence(false, NOW), []);
    assert_eq!(executor.deadline(), None);
}

#[test]
fn the_robots_own_obstacle_stands_behind_the_missing_operator() {
    let stopped = Robot {
        obstacle: Some("safety mode is PROTECTIVE_STOP"),
        ..READY
    };
    for (is_present, part) in [(false, "no operator"), (true, "PROTECTIVE_STOP")] {
        let mut executor = executor(RequireApproval::Always, Some(TIMEOUT), None);
        executor.on_presence(is_present, NOW);
        propose(&mut executor, ID);
        let decision = OperatorDecision::Approve;
        let refused = executor.on_confirmation(ID, decision, "anna", &stopped, NOW);
        assert_said(&refused, StepOutcome::Refused, false, part);
    }
}

#[test]
fn after_a_stop_or_a_fault_nothing_goes_on_unasked_and_the_next_process_knows() {
    let mut unasked = executor(RequireApproval::Never, None, None);
    assert_eq!(propose(&mut unasked, ID), [begins(ID)]);
    let middle = "the process ended in the middle of the motion of proposal 7";
    assert_eq!(unasked.stop_record().as_deref(), Some(middle));
    let ended = end(&mut unasked, MotionEnd::Failed("lost".into()));
    assert_said(&ended, StepOutcome::Fault, false, "lost");
    assert_eq!(unasked.stop_record().as_deref(), Some("lost"));
    assert_eq!(propose(&mut unasked, OTHER), []);
    // Another process; a stop of what it does not know is a stop, too.
    let before = unasked.stop_record();
    let mut unasked = executor(RequireApproval::Never, None, before.as_deref());
    assert_eq!(propose(&mut unasked, OTHER), []);
    decide(&mut unasked, ID, OperatorDecision::Stop);
    let stop = "stop of proposal 7";
    assert_eq!(unasked.stop_record().as_deref(), Some(stop));
    // Only an approved proposal lets things go on.
    let third = ProposalId(9);
    assert_eq!(propose(&mut unasked, third), []);
    assert_eq!(approve(&mut unasked, third), [begins(third)]);
    end(&mut unasked, MotionEnd::Done(Some(Outcome::Placed)));
    assert_eq!(unasked.stop_record(), None);
}

#[test]
fn what_waits_when_a_stop_comes_is_said_to_be_withdrawn() {
    let mut executor = asking();
    propose(&mut executor, ID);
    let unrehearsed = Robot {
        unrehearsed: true,
        ..READY
    };
    let decision = OperatorDecision::Approve;
    assert_eq!(
        executor.on_confirmation(ID, decision, "anna", &unrehearsed, NOW),
        []
    );
    let stopped = decide(&mut executor, OTHER, OperatorDecision::Stop);
    assert_said(&stopped, StepOutcome::Refused, false, "a stop came");
    let status = said(&stopped).report.status;
    assert_eq!(status, Some(ProposalStatus::Withdrawn));
}

#[test]
fn a_way_home_waits_for_its_approval_and_lets_nothing_go_on() {
    let mut executor = executor(RequireApproval::Always, None, Some("stop"));
    let home = executor.propose_recovery(ID, Recovery::Home, &READY, NOW);
    let home = home.unwrap();
    assert!(home.needs_approval && home.actions.is_empty());
    let begun = approve(&mut executor, home.id);
    assert_eq!(
        begun,
        [ExecutorAction::Begin(MotionOrder::Home(ProposalId(7)))]
    );
    assert_eq!(executor.moving(), Some(MotionCause::Home(ID)));
    let busy = executor.propose_recovery(OTHER, Recovery::PutDown, &READY, NOW);
    assert!(matches!(busy, Err(CannotBegin::Refused(_))), "{busy:?}");
    let ended = end(&mut executor, MotionEnd::Done(None));
    assert_said(&ended, StepOutcome::AtHome, false, "");
    assert_eq!(executor.stop_record().as_deref(), Some("stop"));
}

#[test]
fn a_way_home_moves_unasked_only_where_no_approval_is_ever_asked_for() {
    for (stopped, unasked) in [(None, true), (Some("stop"), false)] {
        let mut executor = executor(RequireApproval::Never, None, stopped);
        let home = executor.propose_recovery(ID, Recovery::PutDown, &READY, NOW);
        let home = home.unwrap();
        assert_eq!(home.needs_approval, !unasked);
        assert_eq!(moves_anything(&home.actions), unasked);
    }
}

#[test]
fn an_invalid_proposal_is_refused_where_nobody_is_asked() {
    for (rule, is_said) in [
        (RequireApproval::Always, false),
        (RequireApproval::Never, true),
    ] {
        let mut executor = executor(rule, None, None);
        let unreadable = Err("no pose".to_owned());
        let (proposed, actions) = executor.on_proposal(ID, unreadable, &READY, NOW);
        assert!(matches!(proposed, Proposed::Invalid(_)));
        assert_eq!(!actions.is_empty(), is_said, "{actions:?}");
    }
}

#[test]
fn a_decision_of_somebody_who_does_not_decide_moves_nothing() {
    let rules = GateRules {
        operators: vec!["berta".to_owned()],
        ..rules()
    };
    let mut executor = Executor::new(rules, None, None);
    executor.on_heightmap(Duration::from_secs(5), empty());
    propose(&mut executor, ID);
    let refused = approve(&mut executor, ID);
    assert_said(&refused, StepOutcome::Refused, false, "does not decide");
    let decision = OperatorDecision::Approve;
    let begun = executor.on_confirmation(ID, decision, "berta", &READY, NOW);
    assert_eq!(begun, [begins(ID)]);
}

#[test]
fn a_decision_that_does_not_count_ends_no_goal() {
    let rules = GateRules {
        operators: vec!["berta".to_owned()],
        ..rules()
    };
    let mut executor = Executor::new(rules, None, None);
    executor.on_heightmap(Duration::from_secs(5), empty());
    goal(&mut executor, ID).unwrap();
    let stranger = decide(&mut executor, ID, OperatorDecision::Reject);
    assert_said(&stranger, StepOutcome::Refused, false, "does not decide");
    let unreadable = executor.refuse(ID, "decision is 77".to_owned());
    assert_said(&unreadable, StepOutcome::Refused, false, "77");
    let decision = OperatorDecision::Approve;
    let begun = executor.on_confirmation(ID, decision, "berta", &READY, NOW);
    assert_eq!(begun, [begins(ID)]);
}

#[test]
fn the_word_that_ends_a_goal_says_that_nothing_moves_for_it_any_more() {
    let mut executor = asking();
    goal(&mut executor, ID).unwrap();
    let stopped = Robot {
        obstacle: Some("safety mode is PROTECTIVE_STOP"),
        ..READY
    };
    let decision = OperatorDecision::Approve;
    let refused = executor.on_confirmation(ID, decision, "anna", &stopped, NOW);
    assert_said(&refused, StepOutcome::Refused, true, "PROTECTIVE_STOP");
    let status = said(&refused).report.status;
    assert_eq!(status, Some(ProposalStatus::Withdrawn));
    assert_eq!(status, executor.status(ID));
}

#[test]
fn the_result_of_a_motion_has_its_times_and_any_other_has_the_present() {
    let mut executor = asking();
    propose(&mut executor, ID);
    approve(&mut executor, ID);
    let second = Duration::from_secs;
    let times = MotionTimes::new(Some((second(2), second(5))), second(4));
    let done = MotionEnd::Done(Some(Outcome::Placed));
    let ended = executor.on_motion_end(done, times, &READY, NOW);
    let result = said(&ended).clone().result(second(6));
    assert_eq!((result.stamp, result.duration), (second(5), second(3)));
    assert_eq!(result.status, Some(ProposalStatus::Done));
    let refused = executor.refuse(ID, "no".to_owned());
    let result = said(&refused).clone().result(second(6));
    assert_eq!((result.stamp, result.duration), (second(6), second(0)));
    // Nothing moves: nothing has ended.
    assert_eq!(end(&mut executor, MotionEnd::Done(None)), []);
}

#[test]
fn ways_home_of_another_time_or_place_have_another_id() {
    let second = Duration::from_secs;
    let joints = crate::JointPositions::repeat(0.5);
    let elsewhere = 2.0 * joints;
    let id = |time, now, joints| ProposalId::of_recovery(second(time), second(now), joints);
    let ids = [
        id(1, 2, Some(&joints)),
        id(2, 2, Some(&joints)),
        id(1, 3, Some(&joints)),
        id(1, 2, Some(&elsewhere)),
        id(1, 2, None),
    ];
    for (index, one) in ids.iter().enumerate() {
        assert!(!ids[index + 1..].contains(one));
    }
    assert_eq!(ids[0], id(1, 2, Some(&joints)));
}
