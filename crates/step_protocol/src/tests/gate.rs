//! What the gate lets move.

use std::sync::Arc;
use std::time::Duration;

use heightmap::{Change, ChangeRules, Heightmap, Workspace};
use nalgebra::{Isometry2, Point2, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};

use crate::{
    ApprovalGate, CannotBegin, GateAction, GateRules, InvalidProposal, JointPositions, MotionCause,
    Obstacle, OperatorDecision, Proposal, ProposalId, ProposalStatus, Proposed, Recovery, Refusal,
    RefusalReason, RequireApproval, RobotState, StepOutcome, Unasked,
};

pub(super) const NOW: Duration = Duration::from_secs(100);
const GRACE: Duration = Duration::from_secs(1);

pub(super) fn rules() -> GateRules {
    GateRules {
        frame: "world".into(),
        limits: PrimitiveSettings {
            clearance_m: 0.5,
            lift_m: 0.5,
            travel_m_s: 1.0,
            carry_m_s: 1.0,
            descend_m_s: 0.2,
            acceleration_m_s2: 5.0,
        },
        changes: ChangeRules::default(),
        confirmation_grace: GRACE,
        require_approval: RequireApproval::Always,
        operators: Vec::new(),
    }
}

pub(super) fn proposal(id: u64) -> Proposal {
    Proposal {
        id: ProposalId(id),
        frame: "world".into(),
        stamp: Duration::from_secs(5),
        problem: "placing".into(),
        step: 1,
        attempt: 0,
        module: "placing".into(),
        action: PickPlace {
            pick: Isometry2::new(Vector2::new(0.4, 0.2), 0.0),
            place: Isometry2::new(Vector2::new(0.5, -0.2), 1.0),
        },
        settings: PrimitiveSettings {
            clearance_m: 0.1,
            lift_m: 0.05,
            travel_m_s: 0.8,
            carry_m_s: 0.5,
            descend_m_s: 0.1,
            acceleration_m_s2: 2.5,
        },
        pick_score: 1.0,
        place_score: 1.0,
        success_probability: None,
        done_probability: None,
        checkpoint: String::new(),
        author: "test".into(),
    }
}

/// A robot that can do everything, or says why not.
#[derive(Default)]
pub(super) struct Robot {
    pub(super) obstacle: Option<&'static str>,
    pub(super) no_plan: Option<&'static str>,
    /// Whether motions are still to be rehearsed.
    pub(super) unrehearsed: bool,
    /// Where every joint is (rad).
    pub(super) joints_rad: f64,
}

impl RobotState for Robot {
    fn obstacle(&self) -> Option<Obstacle> {
        self.obstacle.map(str::to_owned).map(Obstacle::from)
    }

    fn check_motion(&self, _: &Proposal) -> Result<(), CannotBegin> {
        match self.no_plan {
            _ if self.unrehearsed => Err(CannotBegin::NotRehearsed),
            Some(reason) => Err(CannotBegin::Refused(reason.to_owned().into())),
            None => Ok(()),
        }
    }

    fn check_recovery(&self, _: Recovery) -> Result<JointPositions, CannotBegin> {
        match self.no_plan {
            _ if self.unrehearsed => Err(CannotBegin::NotRehearsed),
            Some(reason) => Err(CannotBegin::Refused(reason.to_owned().into())),
            None => Ok(JointPositions::repeat(self.joints_rad)),
        }
    }
}

pub(super) const READY: Robot = Robot {
    obstacle: None,
    no_plan: None,
    unrehearsed: false,
    joints_rad: 0.0,
};

const UNREHEARSED: Robot = Robot {
    unrehearsed: true,
    ..READY
};

pub(super) fn empty() -> Arc<Heightmap> {
    raised(0)
}

/// The empty table with the first cells raised.
fn raised(cells: usize) -> Arc<Heightmap> {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    heightmap.rgb.fill(100);
    heightmap.height_m[..cells].fill(0.02);
    Arc::new(heightmap)
}

/// A gate that has received a heightmap and proposal 7, made from it.
pub(super) fn gate() -> ApprovalGate {
    let mut gate = ApprovalGate::new(rules());
    gate.on_heightmap(Duration::from_secs(5), empty());
    assert_eq!(propose(&mut gate, proposal(7)), Proposed::Pending);
    gate
}

pub(super) fn propose(gate: &mut ApprovalGate, proposal: Proposal) -> Proposed {
    gate.on_proposal(proposal.id, Ok(proposal))
}

fn decide(gate: &mut ApprovalGate, id: u64, decision: OperatorDecision) -> Vec<GateAction> {
    gate.on_confirmation(ProposalId(id), decision, &READY, NOW)
}

fn approve(gate: &mut ApprovalGate, id: u64) -> Vec<GateAction> {
    decide(gate, id, OperatorDecision::Approve)
}

/// What the gate says of a proposal that is approved after its patience is over.
fn refused_at_last(gate: &mut ApprovalGate, id: u64) -> Vec<GateAction> {
    assert_eq!(approve(gate, id), []);
    gate.on_news(&READY, NOW + GRACE)
}

fn why_not(gate: &ApprovalGate, id: u64) -> String {
    gate.check_pending(ProposalId(id)).unwrap_err().to_string()
}

fn moves(proposal: Proposal) -> Vec<GateAction> {
    vec![GateAction::Move(Box::new(proposal))]
}

#[track_caller]
fn invalid(gate: &mut ApprovalGate, proposal: Proposal) -> String {
    match propose(gate, proposal) {
        Proposed::Invalid(reason) => reason.to_string(),
        other => panic!("expected an invalid proposal, found {other:?}"),
    }
}

#[track_caller]
fn assert_reported(actions: &[GateAction], outcome: StepOutcome, expected: &[&str]) {
    let [GateAction::Report(report)] = actions else {
        panic!("expected a report, found {actions:?}");
    };
    assert_eq!(report.outcome, outcome, "{report:?}");
    for part in expected {
        assert!(report.reason.contains(part), "{report:?} lacks {part:?}");
    }
}

#[track_caller]
fn assert_refused(gate: &ApprovalGate, actions: Vec<GateAction>, expected: &[&str]) {
    assert_reported(&actions, StepOutcome::Refused, expected);
    assert_eq!(gate.moving(), None);
}

#[test]
fn an_approved_proposal_moves_once() {
    let mut gate = gate();
    assert_eq!(approve(&mut gate, 7), moves(proposal(7)));
    assert_eq!(gate.moving(), Some(ProposalId(7)));
    gate.finish(Duration::from_secs(9), false);
    assert_eq!(gate.moving(), None);
}

#[test]
fn nothing_moves_without_a_confirmation() {
    let mut gate = gate();
    gate.on_heightmap(Duration::from_secs(6), empty());
    assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
    assert_eq!(gate.moving(), None);
}

#[test]
fn a_rejected_proposal_does_not_move_and_cannot_be_approved_any_more() {
    let mut gate = gate();
    let actions = decide(&mut gate, 7, OperatorDecision::Reject);
    assert_reported(
        &actions,
        StepOutcome::Rejected,
        &["rejected by the operator"],
    );
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "already rejected"]);
    let actions = decide(&mut gate, 7, OperatorDecision::Reject);
    assert_refused(&gate, actions, &["7", "already rejected"]);
}

#[test]
fn a_stale_approval_moves_nothing() {
    let mut gate = gate();
    assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "superseded"]);
    // The newer one is not touched by that.
    assert!(matches!(approve(&mut gate, 8)[..], [GateAction::Move(_)]));
}

#[test]
fn a_duplicate_approval_moves_nothing() {
    let mut gate = gate();
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
    let actions = approve(&mut gate, 7);
    assert_reported(
        &actions,
        StepOutcome::Refused,
        &["already being carried out"],
    );
    gate.finish(Duration::from_secs(9), false);
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "already carried out"]);
}

#[test]
fn a_proposal_that_is_sent_again_cannot_be_approved_again() {
    let mut gate = gate();
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
    gate.finish(Duration::from_secs(4), false);
    assert_eq!(propose(&mut gate, proposal(7)), Proposed::Repeated);
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["already carried out"]);
    // Nor one from further back.
    assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
    assert_eq!(propose(&mut gate, proposal(7)), Proposed::Repeated);
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["already carried out"]);
}

#[test]
fn an_unknown_approval_waits_for_its_proposal_and_moves_nothing() {
    let mut gate = gate();
    assert_eq!(approve(&mut gate, 99), []);
    assert_eq!(gate.deadline(), Some(NOW + GRACE));
    assert_eq!(gate.on_news(&READY, NOW), []);
    let actions = gate.on_news(&READY, NOW + GRACE);
    assert_refused(&gate, actions, &["99", "unknown"]);
    assert_eq!(gate.deadline(), None);
    assert_eq!(decide(&mut gate, 8, OperatorDecision::Approve), []);
    assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
    assert_eq!(gate.on_news(&READY, NOW), moves(proposal(8)));
}

#[test]
fn what_waits_for_its_proposal_does_not_survive_a_stop_a_fault_or_a_deactivation() {
    for end in ["stop", "fault", "deactivation"] {
        let mut gate = gate();
        assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
        assert_eq!(approve(&mut gate, 8), []);
        let refused = match end {
            "stop" => {
                let mut actions = decide(&mut gate, 7, OperatorDecision::Stop);
                assert_eq!(actions.pop(), Some(GateAction::Cancel));
                gate.finish(Duration::from_secs(5), true);
                actions
            }
            "fault" => gate.finish(Duration::from_secs(5), true),
            _ => {
                gate.deactivate();
                gate.finish(Duration::from_secs(5), false)
            }
        };
        if end != "deactivation" {
            assert_reported(&refused, StepOutcome::Refused, &["8", "before it"]);
        }
        assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
        assert_eq!(gate.on_news(&READY, NOW), [], "{end}");
        assert!(matches!(approve(&mut gate, 8)[..], [GateAction::Move(_)]));
    }
}

#[test]
fn where_operators_are_named_nobody_else_approves_or_rejects_and_everybody_may_stop() {
    let id = ProposalId(7);
    let anybody = ApprovalGate::new(rules());
    assert_eq!(
        anybody.check_operator(id, OperatorDecision::Approve, "eve"),
        Ok(())
    );
    let gate = ApprovalGate::new(GateRules {
        operators: vec!["anna".into(), "bob".into()],
        ..rules()
    });
    for decision in [OperatorDecision::Approve, OperatorDecision::Reject] {
        for name in ["anna", "bob"] {
            assert_eq!(gate.check_operator(id, decision, name), Ok(()));
        }
        for name in ["eve", "", "Anna", "anna "] {
            let refusal = gate.check_operator(id, decision, name).unwrap_err();
            assert!(matches!(refusal, Refusal::NotAnOperator { .. }));
            let text = refusal.to_string();
            assert!(
                text.contains(&format!("`{name}`")) && text.contains("anna"),
                "{text}"
            );
        }
    }
    assert_eq!(
        gate.check_operator(id, OperatorDecision::Stop, "eve"),
        Ok(())
    );
}

#[test]
fn nothing_goes_on_by_itself_after_a_stop_or_a_fault_until_something_is_approved() {
    let automatic = GateRules {
        require_approval: RequireApproval::Never,
        ..rules()
    };
    let mut gate = ApprovalGate::new(automatic);
    assert!(gate.is_automatic());
    gate.on_heightmap(Duration::from_secs(5), empty());
    propose(&mut gate, proposal(7));
    approve(&mut gate, 7);
    gate.finish(Duration::from_secs(5), true);
    assert!(!gate.is_automatic());
    propose(&mut gate, proposal(8));
    assert!(matches!(approve(&mut gate, 8)[..], [GateAction::Move(_)]));
    assert!(gate.is_automatic());
    decide(&mut gate, 8, OperatorDecision::Stop);
    assert!(!gate.is_automatic());
}

#[test]
fn only_a_proposal_that_is_sure_enough_moves_unasked_and_none_after_a_stop() {
    let unsure = GateRules {
        require_approval: RequireApproval::Unsure { threshold: 0.9 },
        ..rules()
    };
    let mut gate = ApprovalGate::new(unsure);
    gate.on_heightmap(Duration::from_secs(5), empty());
    let probabilities = [
        (7, None, false),
        (8, Some(0.89), false),
        (9, Some(f32::NAN), false),
        (10, Some(0.9), true),
    ];
    for (id, success_probability, moves) in probabilities {
        propose(
            &mut gate,
            Proposal {
                success_probability,
                ..proposal(id)
            },
        );
        assert_eq!(gate.moves_unasked(ProposalId(id)), moves, "{id}");
        assert!(!gate.moves_unasked(ProposalId(id - 1)), "{id}");
    }
    // However sure the policy is of it: there may be nothing to do.
    let done = Proposal {
        success_probability: Some(1.0),
        done_probability: Some(0.6),
        ..proposal(12)
    };
    propose(&mut gate, done);
    assert!(!gate.moves_unasked(ProposalId(12)));
    propose(
        &mut gate,
        Proposal {
            success_probability: Some(0.9),
            ..proposal(10)
        },
    );
    decide(&mut gate, 10, OperatorDecision::Stop);
    let sure = Proposal {
        success_probability: Some(1.0),
        ..proposal(11)
    };
    propose(&mut gate, sure);
    assert!(!gate.moves_unasked(ProposalId(11)));
    approve(&mut gate, 11);
    assert!(gate.is_automatic());
}

#[test]
fn an_approval_while_moving_is_refused() {
    let mut gate = gate();
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
    assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
    let actions = approve(&mut gate, 8);
    assert_reported(&actions, StepOutcome::Refused, &["8", "proposal 7"]);
    assert_eq!(gate.moving(), Some(ProposalId(7)));
}

#[test]
fn a_pose_with_nan_or_outside_the_workspace_moves_nothing() {
    for (bad, expected) in [
        (f64::NAN, "not finite"),
        (f64::INFINITY, "not finite"),
        (0.9, "outside the workspace"),
    ] {
        for which in ["pick", "place"] {
            let mut gate = gate();
            let mut bad_one = proposal(8);
            let pose = match which {
                "pick" => &mut bad_one.action.pick,
                _ => &mut bad_one.action.place,
            };
            pose.translation.x = bad;
            let error = invalid(&mut gate, bad_one);
            assert!(error.contains(which) && error.contains(expected), "{error}");
            let actions = approve(&mut gate, 8);
            assert_refused(&gate, actions, &["8", which, expected]);
            // It has taken nothing from the one before.
            let actions = approve(&mut gate, 7);
            assert_eq!(actions, moves(proposal(7)));
        }
    }
    let mut gate = gate();
    let mut turned = proposal(8);
    turned.action.place = Isometry2::new(nalgebra::Vector2::new(0.5, 0.0), f64::NAN);
    assert!(invalid(&mut gate, turned).contains("not finite"));
}

#[test]
fn a_message_that_is_no_proposal_moves_nothing() {
    let mut gate = gate();
    let broken = || Err("proposal 8: x is not finite".to_owned());
    assert!(matches!(
        gate.on_proposal(ProposalId(8), broken()),
        Proposed::Invalid(_)
    ));
    assert_eq!(
        gate.on_proposal(ProposalId(8), broken()),
        Proposed::Repeated
    );
    let actions = approve(&mut gate, 8);
    assert_refused(&gate, actions, &["x is not finite"]);
}

#[test]
fn no_number_of_messages_that_are_no_proposals_takes_away_the_one_that_is() {
    let mut gate = gate();
    for id in 100..5000 {
        let mut garbage = proposal(id);
        garbage.action.pick.translation.x = 7.0;
        invalid(&mut gate, garbage);
    }
    let actions = decide(&mut gate, 4999, OperatorDecision::Reject);
    assert_refused(&gate, actions, &["4999", "outside the workspace"]);
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
}

#[test]
fn settings_out_of_range_move_nothing() {
    for bad in [f64::NAN, 0.0, -1.0, 100.0] {
        let mut gate = gate();
        let mut fast = proposal(8);
        fast.settings.carry_m_s = bad;
        invalid(&mut gate, fast);
        let actions = approve(&mut gate, 8);
        assert_refused(&gate, actions, &["8", "carry_m_s"]);
    }
}

#[test]
fn a_proposal_in_another_frame_moves_nothing() {
    let mut gate = gate();
    let mut elsewhere = proposal(8);
    elsewhere.frame = "front_camera".into();
    invalid(&mut gate, elsewhere);
    let actions = approve(&mut gate, 8);
    assert_refused(&gate, actions, &["front_camera", "world"]);
}

#[test]
fn an_id_that_stands_for_two_contents_moves_nothing() {
    let mut gate = gate();
    let mut other = proposal(7);
    other.action.place.translation.y = 0.1;
    assert!(invalid(&mut gate, other).contains("different contents"));
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "different contents"]);
    // Its author has to make another one.
    assert_eq!(
        gate.final_status(ProposalId(7)),
        Some(ProposalStatus::Superseded)
    );
}

#[test]
fn an_approval_after_the_observation_changed_moves_nothing() {
    let mut gate = gate();
    gate.on_heightmap(Duration::from_secs(6), raised(100));
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "observation has changed", "6.000 s"]);
    // A small change is noise.
    gate.on_heightmap(Duration::from_secs(7), raised(8));
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
}

#[test]
fn another_heightmap_of_the_same_stamp_is_a_change() {
    let mut gate = gate();
    gate.on_heightmap(Duration::from_secs(5), empty());
    gate.on_heightmap(Duration::from_secs(5), raised(100));
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "observation has changed"]);
    gate.on_heightmap(Duration::from_secs(5), empty());
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
}

#[test]
fn a_slow_operator_may_approve_after_many_observations() {
    let mut gate = gate();
    for second in 6..200 {
        let stamp = Duration::from_secs(second);
        gate.on_heightmap(stamp, empty());
    }
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
}

#[test]
fn an_approval_waits_for_the_heightmap_that_the_proposal_was_made_from() {
    let mut gate = gate();
    let mut early = proposal(8);
    early.stamp = Duration::from_secs(6);
    assert_eq!(propose(&mut gate, early), Proposed::Pending);
    let actions = refused_at_last(&mut gate, 8);
    assert_refused(&gate, actions, &["8", "6.000 s", "has not arrived"]);
    assert_eq!(approve(&mut gate, 8), []);
    gate.on_heightmap(Duration::from_secs(6), empty());
    assert!(matches!(
        gate.on_news(&READY, NOW)[..],
        [GateAction::Move(_)]
    ));
}

#[test]
fn an_observation_from_before_the_last_motion_is_no_ground_to_move() {
    let mut gate = gate();
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
    gate.finish(Duration::from_secs(9), false);
    assert_eq!(propose(&mut gate, proposal(8)), Proposed::Pending);
    let actions = approve(&mut gate, 8);
    assert_refused(&gate, actions, &["8", "5.000 s", "9.000 s"]);
}

#[test]
fn an_obstacle_moves_nothing_and_the_proposal_stays_pending() {
    let mut gate = gate();
    let stopped = Robot {
        obstacle: Some("safety mode is PROTECTIVE_STOP"),
        ..Robot::default()
    };
    let approve_it = OperatorDecision::Approve;
    let actions = gate.on_confirmation(ProposalId(7), approve_it, &stopped, NOW);
    let [GateAction::Report(report)] = &actions[..] else {
        panic!("expected a report, found {actions:?}");
    };
    assert_eq!(report.status, Some(ProposalStatus::Pending));
    assert_refused(&gate, actions, &["7", "PROTECTIVE_STOP"]);
    assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
}

#[test]
fn a_motion_that_cannot_be_planned_is_refused() {
    let mut gate = gate();
    let far = Robot {
        no_plan: Some("0.4 is out of reach"),
        ..Robot::default()
    };
    let actions = gate.on_confirmation(ProposalId(7), OperatorDecision::Approve, &far, NOW);
    assert_refused(&gate, actions, &["7", "0.4 is out of reach"]);
}

#[test]
fn poses_are_judged_by_the_workspace_of_the_heightmap() {
    let small = Workspace {
        rows: 64,
        cols: 32,
        ..Workspace::RAVENS
    };
    let mut gate = ApprovalGate::new(rules());
    gate.on_heightmap(Duration::from_secs(5), Arc::new(Heightmap::new(small)));
    let reason = invalid(&mut gate, proposal(7));
    assert!(
        reason.contains("outside the workspace") && reason.contains("0.25..0.35"),
        "{reason}"
    );
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["outside the workspace"]);
    // The first heightmap may come after the proposal.
    let mut gate = ApprovalGate::new(rules());
    assert_eq!(propose(&mut gate, proposal(7)), Proposed::Pending);
    gate.on_heightmap(Duration::from_secs(5), Arc::new(Heightmap::new(small)));
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["outside the workspace"]);
}

#[test]
fn a_stop_cancels_the_motion_whatever_proposal_it_names() {
    for id in [7, 99] {
        let mut gate = gate();
        assert!(matches!(approve(&mut gate, 7)[..], [GateAction::Move(_)]));
        let actions = decide(&mut gate, id, OperatorDecision::Stop);
        assert_eq!(actions, [GateAction::Cancel]);
        assert_eq!(gate.moving(), Some(ProposalId(7)));
    }
}

#[test]
fn a_stop_while_nothing_moves_withdraws_the_proposal() {
    let mut gate = gate();
    let actions = decide(&mut gate, 7, OperatorDecision::Stop);
    assert_reported(&actions, StepOutcome::Stopped, &["nothing was moving"]);
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "withdrawn"]);
    // Said again, or after a result, it is not news.
    assert_eq!(decide(&mut gate, 7, OperatorDecision::Stop), []);
    let actions = decide(&mut gate, 99, OperatorDecision::Stop);
    assert_refused(&gate, actions, &["99", "unknown"]);
}

#[test]
fn a_withdrawn_proposal_cannot_be_approved_and_says_so() {
    let mut gate = gate();
    assert_eq!(gate.check_pending(ProposalId(7)), Ok(()));
    assert!(why_not(&gate, 99).contains("unknown"));
    gate.withdraw(ProposalId(7));
    assert!(why_not(&gate, 7).contains("withdrawn"));
    let actions = approve(&mut gate, 7);
    assert_refused(&gate, actions, &["7", "withdrawn"]);
    let mut bad = proposal(8);
    bad.frame = "camera".into();
    propose(&mut gate, bad);
    assert!(why_not(&gate, 8).contains("camera"));
    // One that moves is not taken back.
    propose(&mut gate, proposal(9));
    assert!(matches!(approve(&mut gate, 9)[..], [GateAction::Move(_)]));
    gate.withdraw(ProposalId(9));
    assert!(why_not(&gate, 9).contains("being carried out"));
}

#[test]
fn the_arm_goes_home_only_by_an_approval_of_that_very_proposal() {
    let mut gate = gate();
    let stopped = Robot {
        obstacle: Some("PROTECTIVE_STOP"),
        ..Robot::default()
    };
    let propose_home = |gate: &mut ApprovalGate, id, robot: &Robot| {
        let proposed = gate.propose_home(ProposalId(id), Recovery::Home, robot);
        proposed
            .map(|ProposalId(id)| id)
            .map_err(|cannot| match cannot {
                CannotBegin::Refused(obstacle) => obstacle.into(),
                CannotBegin::NotRehearsed => "not rehearsed".to_owned(),
            })
    };
    let reason = propose_home(&mut gate, 50, &stopped).unwrap_err();
    assert!(reason.contains("PROTECTIVE_STOP"), "{reason}");
    assert_eq!(propose_home(&mut gate, 50, &READY), Ok(50));
    // The call may come again because its answer was lost.
    assert_eq!(propose_home(&mut gate, 51, &READY), Ok(50));
    assert!(!gate.moves_unasked(ProposalId(50)));
    let elsewhere = Robot {
        joints_rad: 0.1,
        ..Robot::default()
    };
    let actions = gate.on_confirmation(ProposalId(50), OperatorDecision::Approve, &elsewhere, NOW);
    assert_refused(&gate, actions, &["50", "has moved since"]);
    let actions = approve(&mut gate, 50);
    assert_refused(&gate, actions, &["50", "withdrawn"]);
    assert_eq!(propose_home(&mut gate, 52, &READY), Ok(52));
    // A newer proposal does not supersede it.
    propose(&mut gate, proposal(8));
    assert_eq!(approve(&mut gate, 52), [GateAction::GoHome(ProposalId(52))]);
    assert!(propose_home(&mut gate, 53, &READY).is_err());
    let actions = approve(&mut gate, 8);
    assert_refused(&gate, actions, &["8", "on its way home"]);
    let actions = decide(&mut gate, 99, OperatorDecision::Stop);
    assert_eq!(actions, [GateAction::Cancel]);
    gate.finish(Duration::from_secs(9), false);
    let actions = approve(&mut gate, 52);
    assert_refused(&gate, actions, &["52", "already carried out"]);
    // The stop has withdrawn what was proposed, and the old observation is none any more.
    propose(&mut gate, proposal(80));
    let actions = approve(&mut gate, 80);
    assert_refused(&gate, actions, &["80", "9.000 s"]);
    gate.on_heightmap(Duration::from_secs(9), empty());
    let mut fresh = proposal(9);
    fresh.stamp = Duration::from_secs(9);
    propose(&mut gate, fresh);
    assert_eq!(propose_home(&mut gate, 54, &READY), Ok(54));
    assert!(matches!(approve(&mut gate, 9)[..], [GateAction::Move(_)]));
    let reason = propose_home(&mut gate, 55, &READY).unwrap_err();
    assert!(reason.contains("proposal 9"), "{reason}");
    gate.finish(Duration::from_secs(10), false);
    // The motion has withdrawn it.
    let actions = approve(&mut gate, 54);
    assert_refused(&gate, actions, &["54", "withdrawn"]);
}

#[test]
fn a_stop_a_rejection_and_a_deactivation_withdraw_the_way_home() {
    for (decision, outcome) in [
        (OperatorDecision::Stop, StepOutcome::Stopped),
        (OperatorDecision::Reject, StepOutcome::Rejected),
    ] {
        let mut gate = gate();
        gate.propose_home(ProposalId(50), Recovery::Home, &READY)
            .unwrap();
        let actions = decide(&mut gate, 50, decision);
        assert!(
            matches!(&actions[..], [GateAction::Report(report)] if report.outcome == outcome),
            "{actions:?}"
        );
        let actions = approve(&mut gate, 50);
        assert_refused(&gate, actions, &["50", "was"]);
    }
    let mut gate = gate();
    gate.propose_home(ProposalId(50), Recovery::Home, &READY)
        .unwrap();
    gate.deactivate();
    let actions = approve(&mut gate, 50);
    assert_refused(&gate, actions, &["50", "withdrawn"]);
}

#[test]
fn the_way_home_moves_unasked_only_where_nothing_needs_an_approval_and_nothing_was_stopped() {
    for (require_approval, moves) in [
        (RequireApproval::Always, false),
        (RequireApproval::Unsure { threshold: 0.0 }, false),
        (RequireApproval::Never, true),
    ] {
        let mut gate = ApprovalGate::new(GateRules {
            require_approval,
            ..rules()
        });
        let id = ProposalId(50);
        gate.propose_home(id, Recovery::Home, &READY).unwrap();
        assert_eq!(gate.moves_unasked(id), moves);
        gate.remember_stop();
        assert!(!gate.moves_unasked(id));
        // The way home is no reason for other motions to go on by themselves.
        approve(&mut gate, 50);
        gate.finish(NOW, false);
        assert!(!gate.is_automatic());
    }
}

#[test]
fn memory_is_bounded() {
    let mut gate = gate();
    for id in 0..10_000 {
        propose(&mut gate, proposal(id));
        gate.on_heightmap(Duration::from_millis(id), empty());
    }
    // What was forgotten is unknown again, what is remembered is superseded.
    assert_eq!(gate.status(ProposalId(8_000)), None);
    assert!(gate.status(ProposalId(9_500)).is_some());
}

#[test]
fn what_is_held_is_put_down_by_an_approval_of_that_very_proposal_and_no_way_home_is() {
    let mut gate = gate();
    let propose =
        |gate: &mut ApprovalGate, id, recovery| gate.propose_home(ProposalId(id), recovery, &READY);
    propose(&mut gate, 50, Recovery::Home).unwrap();
    // Another recovery is another proposal, and takes the place of the one before.
    assert_eq!(
        propose(&mut gate, 51, Recovery::PutDown),
        Ok(ProposalId(51))
    );
    assert_eq!(
        propose(&mut gate, 52, Recovery::PutDown),
        Ok(ProposalId(51))
    );
    let refused = gate.on_confirmation(ProposalId(50), OperatorDecision::Approve, &READY, NOW);
    assert!(
        matches!(refused[..], [GateAction::Report(_)]),
        "{refused:?}"
    );
    let moved = gate.on_confirmation(ProposalId(51), OperatorDecision::Approve, &READY, NOW);
    assert_eq!(moved, [GateAction::PutDown(ProposalId(51))]);
    gate.finish(NOW, false);
    let again = gate.on_confirmation(ProposalId(51), OperatorDecision::Approve, &READY, NOW);
    assert!(matches!(again[..], [GateAction::Report(_)]), "{again:?}");
}

#[test]
fn an_approval_waits_for_the_rehearsal_of_its_motion_and_a_stop_ends_the_wait() {
    let approve = OperatorDecision::Approve;
    let id = ProposalId(7);
    let mut gate = gate();
    assert_eq!(gate.on_confirmation(id, approve, &UNREHEARSED, NOW), []);
    let deadline = gate.deadline().unwrap();
    assert!(deadline > NOW + rules().confirmation_grace);
    assert_eq!(gate.on_news(&UNREHEARSED, deadline - GRACE), []);
    let moved = gate.on_news(&READY, deadline - GRACE);
    assert!(matches!(&moved[..], [GateAction::Move(moved)] if moved.id == id));

    // Found to hit something.
    let mut gate = self::gate();
    assert_eq!(gate.on_confirmation(id, approve, &UNREHEARSED, NOW), []);
    let hits = Robot {
        no_plan: Some("the forearm would hit the table"),
        ..READY
    };
    let actions = gate.on_news(&hits, NOW);
    assert_refused(&gate, actions, &["forearm"]);

    // Not rehearsed in time.
    let mut gate = self::gate();
    assert_eq!(gate.on_confirmation(id, approve, &UNREHEARSED, NOW), []);
    let actions = gate.on_news(&UNREHEARSED, deadline);
    assert_refused(&gate, actions, &["7", "has not been checked", "5s"]);

    let mut gate = self::gate();
    assert_eq!(gate.on_confirmation(id, approve, &UNREHEARSED, NOW), []);
    gate.on_confirmation(id, OperatorDecision::Stop, &UNREHEARSED, NOW);
    assert_eq!(gate.on_news(&READY, NOW), []);
    assert_eq!(gate.pending(), None);
}

#[test]
fn a_way_home_that_was_rehearsed_from_elsewhere_or_on_another_view_has_to_be_called_for_again() {
    let mut gate = gate();
    gate.propose_home(ProposalId(50), Recovery::Home, &READY)
        .unwrap();
    let approve = OperatorDecision::Approve;
    let actions = gate.on_confirmation(ProposalId(50), approve, &UNREHEARSED, NOW);
    assert_refused(&gate, actions, &["50", "call for it again"]);
    let actions = decide(&mut gate, 50, approve);
    assert_refused(&gate, actions, &["50", "withdrawn"]);
}

#[test]
fn the_reason_of_a_refusal_is_found_in_its_text() {
    let id = ProposalId(7);
    let stamp = Duration::from_secs(10);
    let workspace = Box::new(Workspace::RAVENS);
    let change = |height_m| Change {
        area_m2: 1e-4,
        center_m: Point2::new(0.5, 0.0),
        height_m,
        near: true,
    };
    let outside = InvalidProposal::OutsideWorkspace {
        id,
        which: "pick",
        x_m: 7.0,
        y_m: 0.0,
        workspace,
    };
    let frame = InvalidProposal::Frame {
        id,
        actual: "camera".into(),
        expected: "world".into(),
    };
    let not_finite = InvalidProposal::NotFinite {
        id,
        which: "place",
        x_m: f64::NAN,
        y_m: 0.0,
        yaw_rad: 0.0,
    };
    let settings = InvalidProposal::Settings {
        id,
        name: "lift_m",
        value: 7.0,
        limit: 0.5,
    };
    let mut refusals: Vec<Refusal> = vec![
        Refusal::Unknown { id },
        Refusal::NothingToStop { id },
        outside.into(),
        frame.into(),
        not_finite.into(),
        settings.into(),
        InvalidProposal::DifferentContents { id }.into(),
        Refusal::Busy { id, moving: id },
        Refusal::Homing { id },
        Refusal::HomeFromElsewhere { id },
        Refusal::OldObservation {
            id,
            stamp,
            moved_until: stamp,
        },
        Refusal::NoSourceHeightmap { id, stamp },
        Refusal::OtherWorkspace { id, stamp },
        Refusal::ObservationChanged {
            id,
            stamp,
            change: change(Some(0.02)),
        },
        Refusal::ObservationChanged {
            id,
            stamp,
            change: change(None),
        },
        Refusal::NotRehearsed { id },
        Refusal::StopCame { id },
        Refusal::MotionBrokenOff { id },
    ];
    let statuses = ProposalStatus::ALL.iter().copied();
    refusals.extend(statuses.map(|status| Refusal::NotPending { id, status }));
    let obstacles = RefusalReason::ALL.iter().map(|reason| reason.because("7"));
    refusals.extend(obstacles.map(|obstacle| Refusal::Robot { id, obstacle }));
    for refusal in refusals {
        let text = refusal.to_string();
        assert_eq!(RefusalReason::of_text(&text), refusal.reason(), "{text}");
    }
    for (cause, reason) in [
        (MotionCause::Proposal(id), RefusalReason::Busy),
        (MotionCause::Home(id), RefusalReason::OnItsWayHome),
        (MotionCause::PutDown(id), RefusalReason::Busy),
    ] {
        assert_eq!(RefusalReason::of_text(&cause.busy_text()), reason);
    }
}

#[test]
fn after_a_stop_a_sure_proposal_asks_too_until_the_next_approval() {
    let rule = RequireApproval::Unsure { threshold: 0.9 };
    let sure = Proposal {
        success_probability: Some(0.95),
        ..proposal(7)
    };
    let mut unasked = Unasked::new(rule);
    assert!(unasked.moves(rule, &sure));
    assert!(!unasked.moves(rule, &proposal(8)), "nothing estimates it");
    unasked.stop();
    assert!(!unasked.moves(rule, &sure));
    unasked.go_on(rule);
    assert!(unasked.moves(rule, &sure));
    unasked.go_on(RequireApproval::Always);
    assert!(!unasked.is_on());
}
