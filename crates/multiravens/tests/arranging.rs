//! The module *arranging*: what its files may say, what counts, and that its problems can be solved.

mod episode;

use multiravens::tasks::arranging::generator::Ranges;
use multiravens::{Environment, EpisodeSeed, Problem};
use nalgebra::{Isometry2, Vector2};
use pick_place::PickPlace;
use std::path::{Path, PathBuf};
use ur5::WorkCell;

/// The problems that are kept out of training.
const HELD_OUT: [&str; 6] = [
    "kitting",
    "l_pieces",
    "pattern",
    "row_by_size",
    "sorting",
    "two_towers",
];

fn config(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../../config")
        .join(path)
}

fn environment(text: &str) -> Environment {
    let problem = Problem::parse("test", text).unwrap();
    Environment::new(&problem, &WorkCell::builtin().unwrap())
}

fn solve(environment: &mut Environment, seed: EpisodeSeed) -> bool {
    environment.reset(seed).unwrap();
    while !environment.is_done() {
        let Some(action) = environment.demonstrate() else {
            break;
        };
        environment.step(&action).unwrap();
    }
    environment.is_complete()
}

#[test]
fn the_six_problems_are_held_out_and_solved_from_several_starts() {
    for name in HELD_OUT {
        let problem = Problem::load(&config("problems"), name).unwrap();
        assert!(problem.is_held_out(), "{name}");
        let mut environment = episode::environment(name);
        for scene in [10_000, 10_002] {
            for start in [scene, scene + 2] {
                let seed = EpisodeSeed { scene, start };
                assert!(solve(&mut environment, seed), "{name}, seed {seed}");
            }
        }
    }
}

#[test]
fn the_problems_of_the_paper_are_not_held_out() {
    for name in Problem::names(&config("problems")).unwrap() {
        let problem = Problem::load(&config("problems"), &name).unwrap();
        assert_eq!(
            problem.is_held_out(),
            HELD_OUT.contains(&name.as_str()),
            "{name}"
        );
    }
}

/// A cube onto a cube onto a plate, an L and two equal disks beside them.
const SMALL: &str = "modules:
  - name: arranging
    anchor: {x_m: 0.5, y_m: 0.0}
    parameters:
      area_m: [0.46, 0.7]
      fixtures:
        - {name: plate, shape: {kind: cuboid, size_m: [0.1, 0.1, 0.005]}, at: {y_m: 0.2}}
      objects:
        - {name: low, shape: {kind: cuboid, size_m: [0.04, 0.04, 0.04]}, color: red}
        - {name: high, shape: {kind: cuboid, size_m: [0.04, 0.04, 0.03]}, color: any}
        - {name: ell, shape: {kind: l, length_m: 0.08, width_m: 0.06, bar_m: 0.025, height_m: 0.02}, color: blue}
        - {name: disk, shape: {kind: cylinder, radius_m: 0.02, height_m: 0.012}, color: green, count: 2}
      start: {region: {x_m: [-0.18, 0.18], y_m: [-0.3, 0.05], yaw_rad: [-3.0, 3.0]}}
      goals:
        - {object: low, on: plate}
        - {object: high, on: low}
        - {object: ell, at: {x_m: 0.12, y_m: 0.1}, after: [low]}
        - {name: left, object: disk, at: {x_m: -0.12, y_m: 0.1}}
        - {name: right, object: disk, at: {x_m: -0.12, y_m: 0.2}}
";

#[test]
fn a_goal_counts_once_those_before_it_do() {
    let mut environment = environment(SMALL);
    environment.reset(1).unwrap();
    assert_eq!(environment.goal_count(), 5);
    // Named first, `high` and `ell` have to wait for `low`.
    environment.follow(&[2, 1]).unwrap();
    assert_eq!(environment.demonstrate(), None);
    environment.follow(&[0, 2, 1, 4, 3]).unwrap();
    let mut order = Vec::new();
    while !environment.is_done() {
        let action = environment.demonstrate().unwrap();
        environment.step(&action).unwrap();
        order.push(environment.goals_reached());
    }
    assert!(environment.is_complete());
    let expected: [&[usize]; 5] = [&[0], &[0, 2], &[0, 1, 2], &[0, 1, 2, 4], &[0, 1, 2, 3, 4]];
    assert_eq!(order, expected);
    // Without the cube below, what depends on it no longer counts.
    let low = environment.tasks().next().unwrap().1.goal_poses()[0];
    let world = environment.cell().world();
    let body = world
        .bodies()
        .find(|b| (world.position(*b).coords - low.translation.vector).norm() < 0.01);
    let body = body.unwrap();
    environment
        .cell_mut()
        .world_mut()
        .place(body, &nalgebra::Isometry3::translation(0.3, -0.2, 0.02));
    environment.assess();
    assert_eq!(environment.goals_reached(), [3, 4]);
}

#[test]
fn what_looks_the_same_is_the_same_and_what_does_not_is_not() {
    let text = SMALL;
    let mut environment = environment(text);
    environment.reset(2).unwrap();
    let poses = environment.tasks().next().unwrap().1.goal_poses();
    let world = environment.cell().world();
    let bodies: Vec<_> = world
        .bodies()
        .filter(|body| !world.is_fixed(*body))
        .collect();
    let [low, _, ell, disk, other_disk] = bodies[..] else {
        panic!("five objects");
    };
    let mut reached = |body, goal: usize, yaw_rad: f64| {
        let turn = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, yaw_rad);
        let mut pose = poses[goal];
        pose.rotation *= turn;
        environment.cell_mut().world_mut().place(body, &pose);
        environment.assess();
        environment.goals_reached()
    };
    // A cube by its quarter turns, not by less.
    assert_eq!(reached(low, 0, 0.8), []);
    assert_eq!(reached(low, 0, std::f64::consts::FRAC_PI_2), [0]);
    // An L has but one yaw.
    assert_eq!(reached(ell, 2, std::f64::consts::PI), [0]);
    assert_eq!(reached(ell, 2, std::f64::consts::FRAC_PI_2), [0]);
    assert_eq!(reached(ell, 2, 0.1), [0, 2]);
    // Any disk, any yaw.
    assert_eq!(reached(other_disk, 3, 1.0), [0, 2, 3]);
    assert_eq!(reached(disk, 4, 2.0), [0, 2, 3, 4]);
}

#[test]
fn the_demonstrator_clears_what_is_in_the_way() {
    let mut environment = environment(SMALL);
    environment.reset(3).unwrap();
    let goal = environment.tasks().next().unwrap().1.goal_poses()[0];
    let world = environment.cell().world();
    let disk = world.bodies().last().unwrap();
    let at = world.position(disk).xy();
    // A disk on the plate, where the cube belongs.
    let to = |p: Vector2<f64>| Isometry2::new(p, 0.0);
    let wrong = PickPlace {
        pick: to(at.coords),
        place: to(goal.translation.vector.xy()),
    };
    environment.step(&wrong).unwrap();
    assert_eq!(environment.total_reward(), 0.0);
    environment.follow(&[0, 1]).unwrap();
    let action = environment.demonstrate().unwrap();
    let off = action.pick.translation.vector - goal.translation.vector.xy();
    assert!(off.norm() < 0.01, "picks the disk");
    environment.step(&action).unwrap();
    while !environment.is_done() {
        let action = environment.demonstrate().unwrap();
        environment.step(&action).unwrap();
    }
    assert!(environment.is_complete());
}

fn error(find: &str, replace: &str) -> String {
    assert_eq!(SMALL.matches(find).count(), 1, "{find}");
    Problem::parse("test", &SMALL.replace(find, replace)).unwrap_err()
}

#[test]
fn an_error_names_line_and_field_and_what_was_expected() {
    let cases = [
        (
            error("kind: l,", "kind: cone,"),
            ["line 11", "objects[2].shape", "unknown variant `cone`"],
        ),
        (
            error("on: low}", "on: lwo}"),
            ["line 16", "goals[1].on", "no fixture or goal `lwo`"],
        ),
        (
            error("after: [low]", "after: [ell]"),
            ["line 17", "goals[2]", "ell after ell"],
        ),
        (
            error(
                "{object: low, on: plate}",
                "{object: low, on: plate, after: [high]}",
            ),
            ["line 15", "goals[0]", "low after high after low"],
        ),
        (
            error("y_m: 0.2}}\n      objects", "y_m: 0.9}}\n      objects"),
            ["line 7", "fixtures[0].at", "expected within the area"],
        ),
        (
            error("at: {x_m: -0.12, y_m: 0.2}", "at: {x_m: -0.12, y_m: 0.11}"),
            ["line 19", "goals[4].at", "`right` overlaps the goal `left`"],
        ),
        (
            error("at: {x_m: 0.12, y_m: 0.1}", "at: {x_m: 0.03, y_m: 0.2}"),
            ["line 17", "goals[2].at", "overlaps"],
        ),
        (
            error("at: {x_m: 0.12, y_m: 0.1}", "at: {x_m: 0.22, y_m: 0.1}"),
            ["line 17", "goals[2].at", "x 0.180 to 0.260"],
        ),
        (
            error(
                "{object: low, on: plate}",
                "{object: low, on: plate, at: {x_m: 0.06}}",
            ),
            ["line 15", "goals[0].at", "beside `plate`"],
        ),
        (
            error("count: 2", "count: 1"),
            ["line 12", "objects[3].count", "expected at least 2"],
        ),
        (
            error("color: red", "color: rde"),
            ["line 9", "objects[0].color", "no colour `rde`"],
        ),
        (
            error("name: high", "name: low"),
            ["line 10", "objects[1]", "the name `low`"],
        ),
        (
            error("[-0.3, 0.05]", "[0.05, -0.3]"),
            ["line 13", "start.region.y_m", "two numbers in order"],
        ),
        (
            error(
                "[-0.18, 0.18], y_m: [-0.3, 0.05]",
                "[0, 0.02], y_m: [-0.3, -0.28]",
            ),
            ["line 13", "start", "no room for"],
        ),
        (
            error("size_m: [0.04, 0.04, 0.03]", "size_m: [0.04, 0.04, 0.0]"),
            ["line 10", "objects[1].shape.size_m[2]", "expected 0.001"],
        ),
        (
            error("area_m: [0.46, 0.7]", "area_m: [0.46, 7]"),
            ["line 5", "area_m[1]", "expected 0.05 to 1"],
        ),
    ];
    for (error, expected) in cases {
        for part in expected {
            assert!(error.contains(part), "`{part}` is not in: {error}");
        }
    }
}

#[test]
fn a_tower_that_falls_is_refused() {
    // A beam that lies well on the cube, until a disk stands on its far end.
    let text = SMALL.replace("size_m: [0.04, 0.04, 0.03]", "size_m: [0.1, 0.03, 0.01]");
    let stands = text.replace("on: low}", "on: low, at: {x_m: 0.012}}");
    Problem::parse("test", &stands).unwrap();
    let at = "{name: left, object: disk, at: {x_m: -0.12, y_m: 0.1}}";
    assert!(stands.contains(at));
    let falls = stands.replace(at, "{name: left, object: disk, on: high, at: {x_m: 0.035}}");
    let error = Problem::parse("test", &falls).unwrap_err();
    assert!(
        error.contains(".at: ") && error.contains("does not stay"),
        "{error}"
    );
}

#[test]
fn drawn_problems_can_be_read_differ_and_are_solved() {
    let ranges = Ranges::load(&config("arrangements.yaml")).unwrap();
    let texts: Vec<_> = (0..12)
        .map(|seed| ranges.generate(2 * seed).unwrap())
        .collect();
    assert_eq!(
        texts[3],
        ranges.generate(6).unwrap(),
        "a seed gives the same problem"
    );
    let mut solved = 0;
    for (index, text) in texts.iter().enumerate() {
        assert!(!texts[..index].contains(text));
        let mut environment = environment(text);
        for seed in [EpisodeSeed::from(0), EpisodeSeed { scene: 0, start: 2 }] {
            solved += usize::from(solve(&mut environment, seed));
        }
    }
    assert!(solved >= 22, "{solved} of 24");
}

#[test]
fn ranges_that_make_no_sense_are_refused_by_file_and_field() {
    let text = std::fs::read_to_string(config("arrangements.yaml")).unwrap();
    let folder = std::env::temp_dir().join(format!("arrangements_{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("ranges.yaml");
    for (find, replace, expected) in [
        ("goals: [3, 7]", "goals: [0, 7]", "goals"),
        ("goals: [3, 7]", "goals: [7, 3]", "goals"),
        ("stacked: 0.3", "stacked: 1.3", "stacked: is 1.3"),
        ("stacked: 0.3", "piled: 0.3", "piled"),
        (
            "size_m: [0.026, 0.06]",
            "size_m: [0.06, 0.026]",
            "size_m: is [0.06, 0.026]",
        ),
    ] {
        std::fs::write(&file, text.replace(find, replace)).unwrap();
        let error = Ranges::load(&file).unwrap_err().to_string();
        assert!(
            error.contains("ranges.yaml") && error.contains(expected),
            "{error}"
        );
    }
    std::fs::remove_dir_all(&folder).unwrap();
}
