//! Demonstrations: nothing is lost, and a bag that holds none is refused with the reason.

use bags::{
    BagError, BagWriter, Compression, Demonstration, DemonstrationError, DemonstrationStep, Qos,
    partial_path,
};
use heightmap::{Heightmap, Workspace};
use msgs::sctn_msgs;
use nalgebra::{Isometry2, Vector2};
use pick_place::{Outcome, PickPlace, PrimitiveSettings};
use proptest::prelude::*;
use std::path::Path;
use std::time::Duration;
use tempfile::TempDir;

const SETTINGS: PrimitiveSettings = PrimitiveSettings {
    clearance_m: 0.32,
    lift_m: 0.1,
    travel_m_s: 1.0,
    carry_m_s: 0.5,
    descend_m_s: 0.25,
    acceleration_m_s2: 4.0,
};

fn observation(seed: u64) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace {
        rows: 4,
        cols: 3,
        ..Workspace::RAVENS
    });
    for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
        *byte = seed.rotate_left(index as u32) as u8;
    }
    for (index, height) in heightmap.height_m.iter_mut().enumerate() {
        *height = seed.rotate_left(7 * index as u32) as u16 as f32 / 3.0;
    }
    heightmap
}

fn demonstration(seed: u64, rewards: &[f64]) -> Demonstration {
    let outcomes = [
        Outcome::Placed,
        Outcome::NoContact,
        Outcome::GraspFailed,
        Outcome::Dropped,
        Outcome::LagAborted,
    ];
    let steps = rewards.iter().enumerate().map(|(index, &delta_reward)| {
        let noise = seed.wrapping_mul(index as u64 + 1);
        let pose = |bits: u64| {
            Isometry2::new(
                Vector2::new(bits as u8 as f64 / 7.0, 0.1),
                f64::from(bits as u8) / 41.0,
            )
        };
        DemonstrationStep {
            observation: observation(noise),
            action: PickPlace {
                pick: pose(noise),
                place: pose(noise >> 8),
            },
            settings: SETTINGS,
            module: format!("module {}", index % 2),
            delta_reward,
            outcome: outcomes[index % outcomes.len()],
        }
    });
    Demonstration {
        problem: "placing".into(),
        seed,
        start_seed: seed / 3,
        steps: steps.collect(),
        last: observation(!seed),
    }
}

fn read(path: &Path) -> Result<Demonstration, DemonstrationError> {
    Demonstration::read(path)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn demonstrations_are_read_back_bit_for_bit(seed: u64, rewards in prop::collection::vec(-1.0..1.0, 0..8)) {
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("000000");
        let demonstration = demonstration(seed, &rewards);
        demonstration.write(&path).unwrap();
        prop_assert_eq!(read(&path).unwrap(), demonstration);
    }
}

#[test]
fn the_same_demonstration_gives_the_same_bytes() {
    let folder = TempDir::new().unwrap();
    let bytes = |name: &str| {
        let path = folder.path().join(name).join("000000");
        std::fs::create_dir(path.parent().unwrap()).unwrap();
        demonstration(3, &[0.5, 0.0, 0.5]).write(&path).unwrap();
        ["000000_0.mcap", "metadata.yaml"].map(|file| std::fs::read(path.join(file)).unwrap())
    };
    assert_eq!(bytes("a"), bytes("b"));
}

#[test]
fn goals_are_the_observations_after_a_reward() {
    let demonstration = demonstration(5, &[0.5, 0.0, -0.1, 0.6]);
    assert_eq!(
        demonstration.goals(),
        [&demonstration.steps[1].observation, &demonstration.last]
    );
}

#[test]
fn the_bag_shows_the_next_goal_of_each_step() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("000005");
    let demonstration = demonstration(5, &[0.0, 0.5, 0.5, 0.0]);
    demonstration.write(&path).unwrap();
    let bag = bags::BagReader::open(&path).unwrap();
    let goals: Vec<sctn_msgs::Goal> = bag
        .messages_between(&["/goal"], Duration::ZERO, Duration::MAX)
        .map(|message| message.unwrap().decode().unwrap())
        .collect();
    // Number of the goal, the observation that it is, and the one before it. The last step leads to no reward and has no goal.
    let expected = [(1, 2, 0), (1, 2, 0), (2, 3, 2)];
    assert_eq!(goals.len(), expected.len());
    for (goal, (number, image, previous)) in goals.into_iter().zip(expected) {
        assert_eq!((goal.step, goal.step_count), (number, 2));
        let observation = |heightmap| msgs::convert::heightmap_from_msg(heightmap).unwrap();
        assert_eq!(
            &observation(goal.heightmap),
            demonstration.observation(image)
        );
        assert_eq!(
            &observation(goal.previous),
            demonstration.observation(previous)
        );
    }
}

#[test]
fn the_rest_of_a_killed_run_is_replaced_and_a_whole_bag_is_not() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("000001");
    std::mem::forget(BagWriter::create(&path, Compression::None).unwrap());
    assert!(partial_path(&path).exists());
    demonstration(1, &[1.0]).write(&path).unwrap();
    assert!(!partial_path(&path).exists());
    let error = demonstration(2, &[1.0]).write(&path).unwrap_err();
    assert!(matches!(
        error,
        DemonstrationError::Bag(BagError::Exists { .. })
    ));
    assert_eq!(read(&path).unwrap().seed, 1);
}

#[test]
fn a_bag_that_names_no_start_shows_the_own_start_of_its_scene() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("000006");
    demonstration(6, &[1.0]).write(&path).unwrap();
    let metadata = path.join("metadata.yaml");
    let text = std::fs::read_to_string(&metadata).unwrap();
    let lines: Vec<_> = text.lines().collect();
    let old: Vec<_> = lines
        .iter()
        .filter(|line| !line.contains("start_seed"))
        .collect();
    assert_eq!(old.len(), lines.len() - 1);
    let old: String = old.iter().map(|line| format!("{line}\n")).collect();
    std::fs::write(&metadata, old).unwrap();
    let read = read(&path).unwrap();
    assert_eq!((read.seed, read.start_seed), (6, 6));
    assert_eq!(read.name(), "placing/6");
    assert_eq!(demonstration(6, &[1.0]).name(), "placing/6/2");
}

#[test]
fn a_bag_without_a_demonstration_says_what_is_missing() {
    let folder = TempDir::new().unwrap();
    let refusal = |name: &str, fill: &dyn Fn(&mut BagWriter)| {
        let path = folder.path().join(name);
        let mut writer = BagWriter::create(&path, Compression::None).unwrap();
        fill(&mut writer);
        writer.finish().unwrap();
        read(&path).unwrap_err().to_string()
    };
    let none = refusal("none", &|_| ());
    assert!(
        none.ends_with("custom_data.problem is None, expected the name of a problem"),
        "{none}"
    );
    let seed = refusal("seed", &|bag| {
        bag.note("problem", "placing");
        bag.note("seed", "x");
    });
    assert!(
        seed.ends_with("custom_data.seed is Some(\"x\"), expected a seed"),
        "{seed}"
    );
    let start = refusal("start", &|bag| {
        bag.note("problem", "placing");
        bag.note("seed", 1);
        bag.note("start_seed", "-2");
    });
    assert!(
        start.ends_with("custom_data.start_seed is Some(\"-2\"), expected a seed"),
        "{start}"
    );
    let notes = |bag: &mut BagWriter| {
        bag.note("problem", "placing");
        bag.note("seed", 1);
    };
    let empty = refusal("empty", &notes);
    assert!(
        empty.ends_with("step 1: the end, expected /heightmap"),
        "{empty}"
    );
    let actions = refusal("actions", &|bag| {
        notes(bag);
        let topic = bag
            .add::<sctn_msgs::PickPlace>("/pick_place", Qos::RELIABLE)
            .unwrap();
        bag.write(topic, Duration::ZERO, &sctn_msgs::PickPlace::default())
            .unwrap();
    });
    assert!(
        actions.ends_with("step 1: a message on /pick_place, expected /heightmap"),
        "{actions}"
    );
    let hostile = refusal("hostile", &|bag| {
        notes(bag);
        let topic = bag
            .add::<sctn_msgs::Heightmap>("/heightmap", Qos::LATCHED)
            .unwrap();
        bag.write(topic, Duration::ZERO, &sctn_msgs::Heightmap::default())
            .unwrap();
    });
    assert!(
        hostile.ends_with("topic /heightmap, step 1: rows is 0, expected at least 1"),
        "{hostile}"
    );
}
