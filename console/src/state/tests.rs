use super::*;
use crate::preview::ScoreMaps;
use crate::preview::tests::{planned, unplanned};
use crate::run::{Joints, NodeReport};
use crate::samples::{self, result};
use ::heightmap::Heightmap;
use bags::DemonstrationStep;
use pick_place::PrimitiveSettings;
use step_protocol::{Goal, ProposalStatus, RECOVERY_TIMEOUT, Reward};

const SETTINGS: PrimitiveSettings = PrimitiveSettings::RIGID;

/// A table of one cell of a metre.
fn image(height_m: f32) -> Heightmap {
    samples::image(samples::workspace(1, 1, 1.0), height_m)
}

fn heightmap(stamp_s: u64, height_m: f32) -> Observation {
    samples::observation(image(height_m), stamp_s)
}

fn goal(demonstration: &str, complete: bool) -> Goal {
    Goal {
        demonstration: demonstration.into(),
        complete,
        ..samples::goal(image(0.0))
    }
}

/// A proposal for the first step, made by this checkpoint.
fn proposal(id: u64, checkpoint: &str) -> Proposal {
    Proposal {
        checkpoint: checkpoint.into(),
        ..samples::proposal(id)
    }
}

/// An active console with an open proposal 7 and an operator, and what it commands.
pub(crate) fn proposed() -> (Console, ViewerId, mpsc::UnboundedReceiver<Command>) {
    let sessions = Sessions::new(4, Duration::from_secs(60));
    let console = Console::new(Run::new(samples::watch(&[])), sessions);
    let commands = console.connect();
    let ada = console.change(|state, now| {
        let ada = state.sessions.join("Ada", "key".into(), now).unwrap();
        state.sessions.take(ada, None).unwrap();
        state.run.on_joints(Joints::default(), now);
        state.on_heightmap(heightmap(0, 0.0), now);
        state.run.on_goal(goal("", false), now).unwrap();
        state.run.on_proposal(proposal(7, "")).unwrap();
        state.on_planned_motion(planned(7), now);
        ada
    });
    (console, ada, commands)
}

/// A demonstration of one step.
pub(crate) fn demonstration(problem: &str) -> Demonstration {
    let Proposal {
        action, settings, ..
    } = proposal(7, "");
    let step = DemonstrationStep {
        observation: image(0.0),
        action,
        settings,
        module: "lesson".into(),
        delta_reward: 1.0,
        outcome: pick_place::Outcome::Placed,
    };
    Demonstration {
        problem: problem.into(),
        seed: 0,
        start_seed: 0,
        steps: vec![step],
        last: image(0.1),
    }
}

/// A console whose state has something in every field.
pub(crate) fn with_everything() -> Console {
    let (console, ada, commands) = proposed();
    decide(&console, ada, 7, Decision::Approve).unwrap();
    let fault = StepResult {
        reason: "protective stop".into(),
        ..result(ProposalId(7), StepOutcome::Fault, 0)
    };
    console.change(|state, now| {
        state.on_result(&fault, now);
        state.on_heightmap(heightmap(0, 0.0), now);
        let reward = Reward {
            stamp: Duration::ZERO,
            delta: 0.0,
            total: 0.0,
            complete: false,
        };
        state.run.on_reward(reward);
        let scores = ScoreMaps {
            stamp: Duration::ZERO,
            rows: 1,
            cols: 2,
            rgb: vec![0; 6],
        };
        state.run.on_scores(scores);
        let report = NodeReport {
            node: "/gctn_policy".into(),
            state: "policy".into(),
            ..NodeReport::default()
        };
        state.run.on_report(report, now);
        let later = now + Duration::from_secs(1);
        state
            .run
            .on_joints(samples::joint("elbow_joint", 1.0), later);
        state.policy = Some(PolicyState {
            checkpoint: "new.safetensors".into(),
            previous: "old.safetensors".into(),
        });
        state.begin_lesson(ada).unwrap();
        state.on_recovery(Recovery::Home, ProposalId(9), true);
        state.on_planned_motion(planned(9), now);
        state.lesson_saved();
    });
    drop(commands);
    console
}

fn decide(console: &Console, viewer: ViewerId, id: u64, decision: Decision) -> Result<(), Refusal> {
    console.change(|state, now| state.decide(viewer, ProposalId(id), decision, now))
}

#[test]
fn an_approval_is_sent_once_with_the_name_of_who_decides() {
    let (console, ada, mut commands) = proposed();
    decide(&console, ada, 7, Decision::Approve).unwrap();
    let Ok(Command::Confirm(confirmation)) = commands.try_recv() else {
        panic!("expected a confirmation");
    };
    assert_eq!(confirmation.operator_name, "Ada");
    assert_eq!(
        (confirmation.proposal_id, confirmation.decision),
        (ProposalId(7), OperatorDecision::Approve)
    );
    // A second click, or a replayed request.
    let refusal = decide(&console, ada, 7, Decision::Approve).unwrap_err();
    assert!(refusal.reason.contains("moving"), "{refusal:?}");
    assert!(commands.try_recv().is_err());
}

#[test]
fn the_operator_changes_the_policy_and_goes_back() {
    let (console, ada, mut commands) = proposed();
    let back = || console.change(|state, _| state.use_previous_checkpoint(ada));
    assert!(back().unwrap_err().reason.contains("not changed"));
    let bob = console.change(|state, now| state.sessions.join("Bob", "b".into(), now).unwrap());
    let load =
        |viewer| console.change(|state, _| state.use_checkpoint(viewer, "new.safetensors".into()));
    load(bob).unwrap_err();
    load(ada).unwrap();
    let expected = Command::LoadCheckpoint("new.safetensors".into(), "Ada".into());
    assert_eq!(commands.try_recv().unwrap(), expected);
    console.change(|state, _| {
        state.policy = Some(PolicyState {
            checkpoint: "new.safetensors".into(),
            previous: "old.safetensors".into(),
        });
    });
    back().unwrap();
    let expected = Command::LoadCheckpoint("old.safetensors".into(), "Ada".into());
    assert_eq!(commands.try_recv().unwrap(), expected);
}

#[test]
fn a_decision_on_another_proposal_than_the_present_one_is_refused() {
    let (console, ada, mut commands) = proposed();
    let refusal = decide(&console, ada, 6, Decision::Approve).unwrap_err();
    assert!(refusal.reason.contains("Proposal 6"), "{refusal:?}");
    assert!(commands.try_recv().is_err());
}

#[test]
fn everybody_may_stop_and_only_the_operator_does_anything_else() {
    let (console, _, mut commands) = proposed();
    let bob = console.change(|state, now| state.sessions.join("Bob", "b".into(), now).unwrap());
    assert!(decide(&console, bob, 7, Decision::Approve).is_err());
    assert!(
        console
            .change(|state, _| state.recover(bob, Recovery::Home))
            .is_err()
    );
    assert!(console.change(|state, _| state.set_step(bob, 1)).is_err());
    assert!(commands.try_recv().is_err());
    decide(&console, bob, 0, Decision::Stop).unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
}

#[test]
fn our_own_confirmation_that_comes_back_late_changes_nothing() {
    let (console, ada, mut commands) = proposed();
    decide(&console, ada, 7, Decision::Approve).unwrap();
    let Ok(Command::Confirm(confirmation)) = commands.try_recv() else {
        panic!("expected a confirmation");
    };
    let refused = StepResult {
        status: Some(ProposalStatus::Pending),
        ..result(ProposalId(7), StepOutcome::Refused, 0)
    };
    console.change(|state, now| state.on_result(&refused, now));
    console.change(|state, now| state.on_confirmation(&confirmation, now));
    decide(&console, ada, 7, Decision::Approve).unwrap();
}

#[test]
fn a_motion_that_stops_by_itself_stops_the_run_for_everybody() {
    let (console, ada, mut commands) = proposed();
    decide(&console, ada, 7, Decision::Approve).unwrap();
    commands.try_recv().unwrap();
    let stopped = result(ProposalId(7), StepOutcome::Stopped, 0);
    console.change(|state, now| state.on_result(&stopped, now));
    let Ok(Command::Confirm(stop)) = commands.try_recv() else {
        panic!("expected a stop");
    };
    assert_eq!(stop.decision, OperatorDecision::Stop);
    // One stop is enough, and an operator's own needs no other.
    console.change(|state, now| state.on_result(&stopped, now));
    assert!(commands.try_recv().is_err());
}

#[test]
fn an_inactive_console_refuses_what_it_could_not_pass_on() {
    let (console, ada, commands) = proposed();
    drop(commands);
    let refusal = decide(&console, ada, 7, Decision::Approve).unwrap_err();
    assert!(refusal.reason.contains("not active"), "{refusal:?}");
}

#[test]
fn a_lesson_is_shown_judged_taken_back_and_becomes_a_demonstration() {
    let (console, ada, mut commands) = proposed();
    let pose = |x_m| Pose {
        x_m,
        y_m: 0.5,
        yaw_rad: 0.0,
    };
    let show = |console: &Console| {
        console.change(|state, now| state.show_step(ada, pose(0.2), pose(0.8), SETTINGS, now))
    };
    show(&console).unwrap_err();
    console.change(|state, _| state.begin_lesson(ada)).unwrap();
    let refusal = decide(&console, ada, 7, Decision::Approve).unwrap_err();
    assert!(refusal.reason.contains("lesson"), "{refusal:?}");
    // Moves once, and says how it went.
    let mut finish = |console: &Console, stamp_s: u64| {
        let Ok(Command::Propose(proposal)) = commands.try_recv() else {
            panic!("expected a proposal");
        };
        let execute = || console.change(|state, now| state.execute_step(ada, now));
        // Nothing can be carried out before the executor has planned it.
        execute().unwrap_err();
        console.change(|state, now| {
            state.on_planned_motion(planned(proposal.id.0), now);
            assert_eq!(state.pending_motion().unwrap().proposal_id, proposal.id);
        });
        // It is shown, and moves when the person says so.
        assert!(commands.try_recv().is_err());
        execute().unwrap();
        execute().unwrap_err();
        let Ok(Command::Confirm(approval)) = commands.try_recv() else {
            panic!("expected its approval");
        };
        let approved = (approval.proposal_id, approval.decision);
        assert_eq!(approved, (proposal.id, OperatorDecision::Approve));
        console.change(|state, now| {
            let placed = result(proposal.id, StepOutcome::Placed, stamp_s);
            state.on_result(&placed, now);
            state.judge_step(ada, true).unwrap_err();
            state.on_heightmap(heightmap(stamp_s, stamp_s as f32), now);
        });
        *proposal
    };
    let judge = |console: &Console, reached| {
        console
            .change(|state, _| state.judge_step(ada, reached))
            .unwrap();
    };
    show(&console).unwrap();
    finish(&console, 1);
    show(&console).unwrap_err();
    judge(&console, true);
    // Missed: not kept.
    show(&console).unwrap();
    finish(&console, 2);
    judge(&console, false);
    show(&console).unwrap();
    finish(&console, 3);
    judge(&console, true);
    // Taken back: the arm moves the other way.
    console
        .change(|state, now| state.undo_step(ada, now))
        .unwrap();
    let back = finish(&console, 4);
    let [pick, place] = [back.action.pick, back.action.place].map(|pose| pose.translation.x);
    assert_eq!((pick, place), (0.8, 0.2));
    judge(&console, true);
    let save = |name: &str| console.change(|state, _| state.lesson_demonstration(ada, name));
    for name in ["", "../up", "a name", "x/y"] {
        assert!(save(name).is_err(), "{name:?}");
    }
    let demonstration = save("three_blocks").unwrap();
    assert_eq!(demonstration.problem, "three_blocks");
    assert_eq!(demonstration.steps.len(), 1);
    assert_eq!(demonstration.steps[0].delta_reward, 1.0);
    assert_eq!(demonstration.steps[0].action.place.translation.x, 0.8);
    assert_eq!(demonstration.last.height_m, [1.0]);

    let folder = tempfile::tempdir().unwrap();
    let library = crate::library::Library::new(folder.path().join("library"));
    assert!(library.list().is_empty());
    library.save("three_blocks", &demonstration).unwrap();
    let taken = library.save("three_blocks", &demonstration).unwrap_err();
    assert!(taken.reason.contains("already"), "{taken:?}");
    let listed = library.list();
    assert_eq!(listed.len(), 1);
    assert_eq!(
        (listed[0].name.as_str(), listed[0].step_count),
        ("three_blocks", 1)
    );
    assert!(listed[0].runs.is_empty());
    assert_eq!(library.picture("three_blocks", 1).unwrap().height_m, [1.0]);
    assert!(library.picture("three_blocks", 2).is_err());
    assert!(library.picture("../three_blocks", 0).is_err());
}

#[test]
fn a_motion_of_a_lesson_that_cannot_be_planned_is_not_approved_and_the_lesson_goes_on() {
    let (console, ada, mut commands) = proposed();
    let pose = |x_m| Pose {
        x_m,
        y_m: 0.5,
        yaw_rad: 0.0,
    };
    console.change(|state, _| state.begin_lesson(ada)).unwrap();
    let mut shown = |x_m| {
        console
            .change(|state, now| state.show_step(ada, pose(x_m), pose(0.8), SETTINGS, now))
            .unwrap();
        let Ok(Command::Propose(proposal)) = commands.try_recv() else {
            panic!("expected a proposal");
        };
        proposal.id.0
    };
    let noted = |console: &Console| {
        let json: serde_json::Value =
            serde_json::from_str(&console.snapshot(None).unwrap()).unwrap();
        let notices = json["notices"].as_array().unwrap();
        notices.last().unwrap()["reason"].to_string()
    };
    let motion = unplanned(shown(0.2), "pick is out of reach");
    console.change(|state, now| state.on_planned_motion(motion, now));
    assert!(noted(&console).contains("out of reach"));
    // The next one is never planned.
    let id = shown(0.3);
    let later =
        |seconds| console.change(|state, now| state.ask_again(now + Duration::from_secs(seconds)));
    assert!(!later(1));
    assert!(later(6));
    assert!(noted(&console).contains("has not planned"));
    // Then it is, too late.
    console.change(|state, now| state.on_planned_motion(planned(id), now));
    shown(0.4);
    assert!(commands.try_recv().is_err());
}

#[test]
fn a_shown_step_is_changed_stopped_and_proposed_again_when_another_proposal_supersedes_it() {
    let (console, ada, mut commands) = proposed();
    let pose = |x_m| Pose {
        x_m,
        y_m: 0.5,
        yaw_rad: 0.0,
    };
    let show = |x_m| {
        console
            .change(|state, now| state.show_step(ada, pose(x_m), pose(0.8), SETTINGS, now))
            .unwrap();
    };
    let mut proposed = || match commands.try_recv() {
        Ok(Command::Propose(proposal)) => proposal,
        other => panic!("expected a proposal: {other:?}"),
    };
    let plan = |id: ProposalId| {
        console.change(|state, now| state.on_planned_motion(planned(id.0), now));
    };
    let phase = || {
        let json: serde_json::Value =
            serde_json::from_str(&console.snapshot(None).unwrap()).unwrap();
        json["lesson"]["phase"].as_str().unwrap().to_owned()
    };
    console.change(|state, _| state.begin_lesson(ada)).unwrap();
    show(0.2);
    plan(proposed().id);
    assert_eq!(phase(), "previewing");
    console.change(|state, _| state.change_step(ada)).unwrap();
    assert_eq!(phase(), "choosing");
    console
        .change(|state, _| state.change_step(ada))
        .unwrap_err();
    // A stop leaves nothing that could be carried out.
    show(0.3);
    plan(proposed().id);
    decide(&console, ada, 0, Decision::Stop).unwrap();
    assert_eq!(phase(), "choosing");
    console
        .change(|state, now| state.execute_step(ada, now))
        .unwrap_err();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    let mut proposed = || match commands.try_recv() {
        Ok(Command::Propose(proposal)) => proposal,
        other => panic!("expected a proposal: {other:?}"),
    };
    // The policy proposes meanwhile.
    show(0.4);
    let first = proposed();
    plan(first.id);
    console
        .change(|state, now| state.on_proposal(proposal(8, ""), now))
        .unwrap();
    assert_eq!(phase(), "planning");
    let again = proposed();
    assert_ne!(again.id, first.id);
    assert_eq!(again.action, first.action);
    // Our own comes back, and the policy's once more: nothing new.
    for message in [*again.clone(), proposal(8, "")] {
        console
            .change(|state, now| state.on_proposal(message, now))
            .unwrap();
    }
    plan(again.id);
    console
        .change(|state, now| state.execute_step(ada, now))
        .unwrap();
    let Ok(Command::Confirm(approval)) = commands.try_recv() else {
        panic!("expected an approval");
    };
    assert_eq!(approval.proposal_id, again.id);
}

#[test]
fn the_way_home_is_shown_and_moves_only_when_the_operator_approves_it() {
    let (console, ada, mut commands) = proposed();
    console
        .change(|state, _| state.recover(ada, Recovery::Home))
        .unwrap();
    let asked = Command::Recover(Recovery::Home, "Ada".into());
    assert_eq!(commands.try_recv().unwrap(), asked);
    console.change(|state, _| state.on_recovery(Recovery::Home, ProposalId(9), true));
    let refusal = decide(&console, ada, 9, Decision::Approve).unwrap_err();
    assert!(refusal.reason.contains("not been shown"), "{refusal:?}");
    console.change(|state, now| state.on_planned_motion(planned(9), now));
    let pending =
        || console.read(|state, _| state.pending_motion().map(|motion| motion.proposal_id.0));
    assert_eq!(pending(), Some(9));
    let bob = console.change(|state, now| state.sessions.join("Bob", "b".into(), now).unwrap());
    decide(&console, bob, 9, Decision::Approve).unwrap_err();
    // Left: nothing is sent, and the proposal of the run is shown again.
    decide(&console, ada, 9, Decision::Reject).unwrap();
    assert_eq!(pending(), Some(7));
    decide(&console, ada, 9, Decision::Approve).unwrap_err();
    assert!(commands.try_recv().is_err());
    console.change(|state, _| state.on_recovery(Recovery::Home, ProposalId(9), true));
    decide(&console, ada, 9, Decision::Approve).unwrap();
    let Ok(Command::Confirm(approval)) = commands.try_recv() else {
        panic!("expected an approval");
    };
    let expected = (ProposalId(9), OperatorDecision::Approve);
    assert_eq!((approval.proposal_id, approval.decision), expected);
    assert_eq!(approval.operator_name, "Ada");
    let home = || console.read(|state, _| state.home);
    assert!(home().unwrap().approved);
    let at_home = result(ProposalId(9), StepOutcome::AtHome, 0);
    console.change(|state, now| state.on_result(&at_home, now));
    assert_eq!(home(), None);
    // A stop withdraws it.
    console.change(|state, _| state.on_recovery(Recovery::Home, ProposalId(10), true));
    decide(&console, bob, 0, Decision::Stop).unwrap();
    assert_eq!(home(), None);
}

#[test]
fn what_is_held_is_put_down_only_when_the_operator_approves_it_and_only_while_something_is_held() {
    let (console, ada, mut commands) = proposed();
    let put_down = || console.change(|state, _| state.recover(ada, Recovery::PutDown));
    let refusal = put_down().unwrap_err();
    assert!(refusal.reason.contains("holds nothing"), "{refusal:?}");
    console.change(|state, _| state.run.on_pins(None, Some(true)));
    put_down().unwrap();
    let asked = Command::Recover(Recovery::PutDown, "Ada".into());
    assert_eq!(commands.try_recv().unwrap(), asked);
    // Where it cannot be planned, there is nothing to approve.
    console.change(|state, now| {
        state.on_recovery(Recovery::PutDown, ProposalId(9), true);
        state.on_planned_motion(unplanned(9, "putting down: something stands there"), now);
    });
    let refusal = decide(&console, ada, 9, Decision::Approve).unwrap_err();
    assert!(refusal.reason.contains("cannot be put down"), "{refusal:?}");
    assert!(commands.try_recv().is_err());
    console.change(|state, now| {
        state.on_recovery(Recovery::PutDown, ProposalId(10), true);
        state.on_planned_motion(planned(10), now);
    });
    decide(&console, ada, 10, Decision::Approve).unwrap();
    let Ok(Command::Confirm(approval)) = commands.try_recv() else {
        panic!("expected an approval");
    };
    let expected = (ProposalId(10), OperatorDecision::Approve);
    assert_eq!((approval.proposal_id, approval.decision), expected);
}

#[test]
fn a_run_of_a_taught_task_is_counted_with_its_checkpoint_when_the_policy_has_moved_something() {
    let (console, ada, mut commands) = proposed();
    let on_goal = |goal| {
        console
            .change(|state, now| state.on_goal(goal, now))
            .unwrap()
    };
    console.change(|state, _| state.on_loaded("blocks".into(), "blocks/0".into()));
    on_goal(goal("blocks/0", false));
    // The one of before has no checkpoint.
    console.change(|state, now| {
        state.run = Run::new(samples::watch(&[]));
        state.run.on_joints(Joints::default(), now);
        state.on_heightmap(heightmap(0, 0.0), now);
        state.on_goal(goal("blocks/0", false), now).unwrap();
        state.on_proposal(proposal(7, "any_start"), now).unwrap();
        state.on_planned_motion(planned(7), now);
    });
    decide(&console, ada, 7, Decision::Approve).unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    console.change(|state, now| {
        state.on_result(&result(ProposalId(7), StepOutcome::Placed, 1), now);
        state.on_heightmap(heightmap(2, 0.0), now);
    });
    let began = RunEvent::Began {
        run: 7,
        demonstration: "blocks".into(),
        goals: "blocks/0".into(),
        checkpoint: "any_start".into(),
    };
    assert_eq!(commands.try_recv().unwrap(), Command::Record(began.clone()));
    on_goal(goal("blocks/0", true));
    let completed = Command::Record(RunEvent::Completed { run: 7 });
    assert_eq!(commands.try_recv().unwrap(), completed);
    // A run that another console has begun is completed; one that another demonstration ended is not.
    console.change(|state, _| state.resume_run(began.clone()));
    on_goal(goal("blocks/0", false));
    on_goal(goal("blocks/0", true));
    assert_eq!(commands.try_recv().unwrap(), completed);
    console.change(|state, _| state.resume_run(began));
    on_goal(goal("other/0", false));
    on_goal(goal("blocks/0", true));
    assert!(commands.try_recv().is_err());
}

#[test]
fn a_correction_that_the_operator_confirms_is_kept_once_as_a_demonstration_of_one_step() {
    let (console, ada, mut commands) = proposed();
    let pose = |x_m| Pose {
        x_m,
        y_m: 0.5,
        yaw_rad: 0.0,
    };
    let id = console
        .change(|state, _| state.correct(ada, pose(0.2), pose(0.8)))
        .unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Propose(_))));
    console.change(|state, now| state.on_planned_motion(planned(id.0), now));
    decide(&console, ada, id.0, Decision::Approve).unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    let placed = result(id, StepOutcome::Placed, 1);
    console.change(|state, now| state.on_result(&placed, now));
    decide(&console, ada, id.0, Decision::Advance).unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    // What it has led to is not in view yet.
    assert!(commands.try_recv().is_err());
    console.change(|state, now| state.on_heightmap(heightmap(2, 0.5), now));
    let Ok(Command::Keep(correction)) = commands.try_recv() else {
        panic!("expected a correction");
    };
    let (name, demonstration) = *correction;
    assert_eq!(name, format!("-1-{:016x}", id.0));
    assert_eq!(demonstration.problem, name);
    assert_eq!(demonstration.steps.len(), 1);
    assert_eq!(demonstration.steps[0].action.place.translation.x, 0.8);
    assert_eq!(demonstration.last.height_m, [0.5]);
    console.change(|state, now| state.on_heightmap(heightmap(2, 0.5), now));
    assert!(commands.try_recv().is_err());
    let folder = tempfile::tempdir().unwrap();
    let libraries = crate::library::Libraries::new(folder.path());
    libraries.corrections.save(&name, &demonstration).unwrap();
    assert_eq!(libraries.tasks(), []);
    assert_eq!(libraries.corrections.list()[0].name, name);
    let picture = libraries.holding(&name).picture(&name, 1).unwrap();
    assert_eq!(picture.height_m, [0.5]);
}

#[test]
fn what_the_graph_answers_is_said_and_a_stopped_run_that_goes_on_is_shown_so() {
    let (console, ada, mut commands) = proposed();
    let noted = || {
        let json: serde_json::Value =
            serde_json::from_str(&console.snapshot(None).unwrap()).unwrap();
        let notices = json["notices"].as_array().unwrap();
        notices.last().unwrap()["reason"]
            .as_str()
            .unwrap()
            .to_owned()
    };
    decide(&console, ada, 7, Decision::Stop).unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    let phase = || console.read(|state, _| state.run.phase());
    console.change(|state, now| state.on_set_step_answer(Err("no such step".into()), now));
    assert!(noted().contains("no such step"));
    assert_eq!(phase(), RunPhase::Stopped);
    // The oracle has not heard of the stop: no other goal comes.
    console.change(|state, now| state.on_set_step_answer(Ok(()), now));
    assert_eq!(phase(), RunPhase::Proposed);

    let busy = || Err("the arm is on its way home".to_owned());
    console.change(|state, now| state.on_recovery_answer(Recovery::Home, busy(), now));
    assert!(noted().contains("There is no way home"));
    let proposed = Ok((ProposalId(9), true));
    console.change(|state, now| state.on_recovery_answer(Recovery::Home, proposed, now));
    assert_eq!(
        console.read(|state, _| state.home.unwrap().proposal_id),
        ProposalId(9)
    );

    let path = std::path::Path::new("policies/new.safetensors");
    let missing = || Err("no such file".to_owned());
    console.change(|state, now| state.on_checkpoint_answer(path, missing(), now));
    assert!(noted().contains("kept its checkpoint: no such file"));
    let policy = PolicyState {
        checkpoint: "policies/new.safetensors".into(),
        previous: "old".into(),
    };
    console.change(|state, now| state.on_checkpoint_answer(path, Ok(policy.clone()), now));
    assert!(noted().contains("uses new from"));
    assert_eq!(console.read(|state, _| state.policy.clone()), Some(policy));

    let goals = || Some("blocks/0".to_owned());
    let not_found = Err("not found".to_owned());
    console.change(|state, now| state.on_load_answer("blocks".into(), goals(), not_found, now));
    assert!(noted().contains("not loaded: not found"));
    assert_eq!(console.read(|state, _| state.repetition.clone()), None);
    let loaded = Ok("blocks, 1 step".to_owned());
    console.change(|state, now| state.on_load_answer("blocks".into(), goals(), loaded, now));
    assert!(noted().contains("repeats blocks, 1 step."));
    assert!(console.read(|state, _| state.repetition.is_some()));
}

#[test]
fn a_recovery_is_called_for_again_where_the_executor_has_not_heard_of_the_operator() {
    let (console, _, _commands) = proposed();
    let absent = "no operator is present (require_presence)";
    // So long after the first call.
    let repeats = |reason: &str, waited| {
        let answer: Answer<()> = Err(reason.to_owned());
        console.read(|state, now| state.repeats_recovery(&answer, now, now + waited))
    };
    let moment = Duration::from_millis(100);
    assert!(repeats(absent, moment));
    assert!(!repeats("the arm is on its way home", moment));
    // Then it is right.
    assert!(!repeats(absent, Duration::from_secs(5)));
    // The page is in sight, but the executor hears nothing of it.
    let heard = |state: &mut State, now| {
        let ada = state.sessions.operator().unwrap();
        state.sessions.heard(ada, true, now + RECOVERY_TIMEOUT);
    };
    console.change_quietly(heard);
    assert!(repeats(absent, RECOVERY_TIMEOUT - moment));
    assert!(!repeats(absent, RECOVERY_TIMEOUT));
}

#[test]
fn a_way_home_whose_approval_is_not_answered_is_shown_again() {
    let (console, ada, mut commands) = proposed();
    console.change(|state, now| {
        state.on_recovery(Recovery::Home, ProposalId(9), true);
        state.on_planned_motion(planned(9), now);
    });
    decide(&console, ada, 9, Decision::Approve).unwrap();
    assert!(matches!(commands.try_recv(), Ok(Command::Confirm(_))));
    let later =
        |seconds| console.change(|state, now| state.ask_again(now + Duration::from_secs(seconds)));
    let is_approved = || console.read(|state, _| state.home.unwrap().approved);
    assert!(!later(1));
    assert!(is_approved());
    assert!(later(7));
    assert!(!is_approved());
}

#[test]
fn where_nothing_follows_the_console_rejects_once_more_for_an_operator_only() {
    let (console, ada, mut commands) = proposed();
    let superseded = StepResult {
        status: Some(ProposalStatus::Superseded),
        ..result(ProposalId(7), StepOutcome::Refused, 0)
    };
    console.change(|state, now| state.on_result(&superseded, now));
    let later =
        |seconds| console.change(|state, now| state.ask_again(now + Duration::from_secs(seconds)));
    later(0);
    assert!(commands.try_recv().is_err());
    later(11);
    let Ok(Command::Confirm(rejection)) = commands.try_recv() else {
        panic!("expected a rejection");
    };
    let expected = (ProposalId(7), OperatorDecision::Reject);
    assert_eq!((rejection.proposal_id, rejection.decision), expected);
    console.change(|state, _| state.sessions.leave(ada));
    later(30);
    assert!(commands.try_recv().is_err());
}
