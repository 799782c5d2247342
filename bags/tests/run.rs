//! A recorded run as a demonstration: what was approved, placed and confirmed, and nothing else.

use bags::{BagWriter, Compression, Demonstration, DemonstrationError, Qos};
use heightmap::{Heightmap, Workspace};
use msgs::builtin_interfaces::Time;
use msgs::convert;
use msgs::sctn_msgs::{self, PickPlace, Reward, StepConfirmation, StepResult};
use msgs::std_msgs::Header;
use pick_place::PrimitiveSettings;
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;

/// Writes a run message by message, one a millisecond; stamps are seconds.
struct Run {
    bag: BagWriter,
    now: Duration,
}

fn header(second: i32) -> Header {
    Header {
        stamp: Time {
            sec: second,
            nanosec: 0,
        },
        frame_id: "world".into(),
    }
}

/// The workspace of a second has that height everywhere.
fn heightmap(second: i32) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace {
        rows: 4,
        cols: 3,
        ..Workspace::RAVENS
    });
    heightmap.height_m.fill(second as f32 / 100.0);
    heightmap
}

impl Run {
    fn new(path: &Path) -> Self {
        let mut bag = BagWriter::create(path, Compression::None).unwrap();
        bag.note("seed", 7);
        Self {
            bag,
            now: Duration::ZERO,
        }
    }

    fn write<T: msgs::Interface>(&mut self, topic: &str, message: &T) {
        let topic = self.bag.add::<T>(topic, Qos::RELIABLE).unwrap();
        self.now += Duration::from_millis(1);
        self.bag.write(topic, self.now, message).unwrap();
    }

    fn see(&mut self, second: i32) {
        let message = convert::heightmap_to_msg(heightmap(second), header(second), 3, 1.0).unwrap();
        self.write("/cell/heightmap", &message);
    }

    fn propose(&mut self, id: u64, step_and_attempt: (u32, u32), second: i32) {
        self.propose_on("/cell/pick_place", id, step_and_attempt, second);
    }

    fn propose_on(&mut self, topic: &str, id: u64, (step, attempt): (u32, u32), second: i32) {
        let proposal = PickPlace {
            header: header(second),
            id,
            problem: "placing".into(),
            step,
            attempt,
            pick: msgs::geometry_msgs::Pose2D {
                x: 0.5,
                y: id as f64 / 100.0,
                theta: 0.0,
            },
            settings: convert::settings_to_msg(&PrimitiveSettings::RIGID),
            module: format!("module {step}"),
            ..PickPlace::default()
        };
        self.write(topic, &proposal);
    }

    fn say(&mut self, id: u64, decision: u8) {
        let confirmation = StepConfirmation {
            proposal_id: id,
            decision,
            ..StepConfirmation::default()
        };
        self.write("/cell/step_confirmation", &confirmation);
    }

    fn end(&mut self, id: u64, outcome: u8, second: i32) {
        let result = StepResult {
            header: header(second),
            proposal_id: id,
            outcome,
            ..StepResult::default()
        };
        self.write("/cell/step_result", &result);
    }

    fn reward(&mut self, delta: f64, second: i32) {
        let reward = Reward {
            header: header(second),
            delta,
            ..Reward::default()
        };
        self.write("/cell/reward", &reward);
    }
}

/// Four steps: placed; rejected, then dropped, then placed; refused twice; placed, but never seen afterwards.
fn write(path: &Path, rewards: bool) {
    let mut run = Run::new(path);
    run.see(1);
    run.propose(10, (1, 0), 1);
    run.say(10, StepConfirmation::APPROVE);
    run.end(10, StepResult::PLACED, 5);
    if rewards {
        run.reward(0.25, 5);
    }
    run.say(10, StepConfirmation::ADVANCE);
    run.see(5);
    run.propose(20, (2, 0), 5);
    run.say(20, StepConfirmation::REJECT);
    run.end(20, StepResult::REJECTED, 6);
    run.propose(21, (2, 1), 5);
    run.say(21, StepConfirmation::APPROVE);
    run.end(21, StepResult::DROPPED, 9);
    if rewards {
        run.reward(0.0, 9);
    }
    run.say(21, StepConfirmation::RETRY);
    run.see(9);
    run.propose(22, (2, 2), 9);
    run.say(22, StepConfirmation::APPROVE);
    run.end(22, StepResult::PLACED, 13);
    // A second approval is refused; the motion has been made all the same.
    run.say(22, StepConfirmation::APPROVE);
    run.end(22, StepResult::REFUSED, 13);
    run.say(22, StepConfirmation::ADVANCE);
    run.see(13);
    run.propose(30, (3, 0), 13);
    run.say(30, StepConfirmation::APPROVE);
    run.end(30, StepResult::PLACED, 17);
    run.say(30, StepConfirmation::RETRY);
    run.see(17);
    run.propose(31, (3, 1), 17);
    run.say(31, StepConfirmation::APPROVE);
    run.end(31, StepResult::PLACED, 21);
    run.say(31, StepConfirmation::ADVANCE);
    run.bag.finish().unwrap();
}

#[test]
fn only_steps_that_were_placed_confirmed_and_seen_are_kept() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("run");
    write(&path, true);
    let (demonstration, left_out) = Demonstration::read_run(&path).unwrap().unwrap();
    assert_eq!(
        (demonstration.problem.as_str(), demonstration.seed),
        ("placing", 7)
    );
    let modules: Vec<&str> = demonstration
        .steps
        .iter()
        .map(|step| step.module.as_str())
        .collect();
    assert_eq!(modules, ["module 1", "module 2"]);
    assert_eq!(demonstration.steps[0].observation, heightmap(1));
    // What the dropped attempt has changed is part of it.
    assert_eq!(demonstration.steps[1].observation, heightmap(9));
    assert_eq!(demonstration.last, heightmap(13));
    assert_eq!(demonstration.steps[0].delta_reward, 0.25);
    // Nothing was measured: the operator's word counts.
    assert_eq!(demonstration.steps[1].delta_reward, 0.5);
    assert_eq!(demonstration.steps[1].action.pick.translation.y, 0.22);
    let reasons: Vec<(u64, &str)> = left_out
        .iter()
        .map(|left_out| (left_out.proposal_id, left_out.reason.as_str()))
        .collect();
    assert_eq!(
        reasons,
        [
            (20, "it ended as: rejected"),
            (21, "it ended as: dropped"),
            (30, "the operator said retry"),
            (31, "no heightmap shows what came of it"),
        ]
    );
    // The same through the door for all demonstrations, and written as one of ours.
    let read = Demonstration::read(&path).unwrap();
    assert_eq!(read, demonstration);
    let copy = folder.path().join("copy");
    demonstration.write(&copy).unwrap();
    assert_eq!(Demonstration::read(&copy).unwrap(), demonstration);
    assert!(Demonstration::read_run(&copy).unwrap().is_none());
}

#[test]
fn a_cell_without_rewards_teaches_too() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("run");
    write(&path, false);
    let demonstration = Demonstration::read(&path).unwrap();
    assert_eq!(demonstration.goals().len(), 2);
    assert_eq!(
        demonstration.steps[0].delta_reward + demonstration.steps[1].delta_reward,
        1.0
    );
}

#[test]
fn a_step_that_came_as_a_goal_of_the_action_is_one_like_the_others() {
    let folder = TempDir::new().unwrap();
    for (with_topic, steps) in [(true, 2), (false, 1)] {
        let path = folder.path().join(format!("run_{with_topic}"));
        let mut run = Run::new(&path);
        run.see(1);
        if with_topic {
            run.propose(10, (1, 0), 1);
            run.say(10, StepConfirmation::APPROVE);
            run.end(10, StepResult::PLACED, 5);
            run.say(10, StepConfirmation::ADVANCE);
            run.see(5);
        }
        run.propose_on(
            "/cell/pick_place_goal",
            20,
            (2, 0),
            if with_topic { 5 } else { 1 },
        );
        run.say(20, StepConfirmation::APPROVE);
        run.end(20, StepResult::PLACED, 9);
        run.say(20, StepConfirmation::ADVANCE);
        run.see(9);
        run.bag.finish().unwrap();
        let (demonstration, left_out) = Demonstration::read_run(&path).unwrap().unwrap();
        assert_eq!(left_out, []);
        assert_eq!(demonstration.steps.len(), steps);
        let last = demonstration.steps.last().unwrap();
        assert_eq!(
            (last.module.as_str(), last.action.pick.translation.y),
            ("module 2", 0.2)
        );
        assert_eq!(demonstration.last, heightmap(9));
    }
}

#[test]
fn goals_of_two_cells_in_one_bag_are_told() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("run");
    let mut run = Run::new(&path);
    run.see(1);
    run.say(1, StepConfirmation::APPROVE);
    run.end(1, StepResult::PLACED, 5);
    run.propose_on("/cell/pick_place_goal", 1, (1, 0), 1);
    run.propose_on("/other/pick_place_goal", 2, (1, 0), 1);
    run.bag.finish().unwrap();
    let error = Demonstration::read(&path).unwrap_err().to_string();
    assert!(
        error.contains("/cell/pick_place_goal, /other/pick_place_goal"),
        "{error}"
    );
}

#[test]
fn a_run_in_which_nothing_succeeded_is_refused() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("run");
    let mut run = Run::new(&path);
    run.see(1);
    run.propose(10, (1, 0), 1);
    run.say(10, StepConfirmation::APPROVE);
    run.end(10, StepResult::GRASP_FAILED, 5);
    run.bag.finish().unwrap();
    let error = Demonstration::read(&path).unwrap_err();
    assert!(matches!(
        error,
        DemonstrationError::NoSteps { proposals: 1, .. }
    ));
}

#[test]
fn two_cells_in_one_bag_are_told() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("run");
    let mut run = Run::new(&path);
    run.say(1, StepConfirmation::APPROVE);
    run.see(1);
    let message = convert::heightmap_to_msg(heightmap(1), header(1), 3, 1.0).unwrap();
    run.write::<sctn_msgs::Heightmap>("/other/heightmap", &message);
    run.bag.finish().unwrap();
    let error = Demonstration::read(&path).unwrap_err().to_string();
    assert!(
        error.contains("/cell/heightmap, /other/heightmap"),
        "{error}"
    );
}
