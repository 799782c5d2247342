//! The ten problems of the paper (its list of problems in section V).

use multiravens::{Environment, Problem};
use std::path::{Path, PathBuf};
use ur5::WorkCell;

/// Name, and the modules in the order in which they are solved.
const PROBLEMS: [(&str, &[&str]); 10] = [
    ("placing", &["placing"]),
    ("stacking", &["stacking"]),
    ("chaining", &["chaining"]),
    ("routing", &["routing"]),
    ("placing_routing", &["placing", "routing"]),
    ("stacking_routing", &["stacking", "routing"]),
    ("placing_chaining", &["placing", "chaining"]),
    ("placing_stacking", &["placing", "stacking"]),
    (
        "placing_chaining_routing",
        &["placing", "chaining", "routing"],
    ),
    (
        "placing_stacking_routing",
        &["placing", "stacking", "routing"],
    ),
];

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems")
}

#[test]
fn every_problem_loads_and_comes_to_rest_unsolved() {
    let work_cell = WorkCell::builtin().unwrap();
    for (name, modules) in PROBLEMS {
        let problem = Problem::load(&folder(), name).unwrap();
        let mut environment = Environment::new(&problem, &work_cell);
        for seed in 0..5 {
            environment.reset(seed).unwrap();
            assert!(environment.cell().is_settled(), "{name}, seed {seed}");
            assert_eq!(environment.total_reward(), 0.0, "{name}, seed {seed}");
            let built: Vec<_> = environment.tasks().map(|(name, _)| name).collect();
            assert_eq!(built, modules, "{name}");
            assert!(environment.demonstrate().is_some(), "{name}, seed {seed}");
        }
    }
}

#[test]
fn a_module_stands_at_the_same_place_in_every_problem() {
    let mut anchors = std::collections::BTreeMap::new();
    for (name, _) in PROBLEMS {
        let problem = Problem::load(&folder(), name).unwrap();
        for placement in problem.modules() {
            let anchor = anchors.entry(placement.name).or_insert(placement.anchor);
            assert_eq!(*anchor, placement.anchor, "{} in {name}", placement.name);
        }
    }
    assert_eq!(anchors.len(), 4);
}

#[test]
fn the_names_in_the_folder_are_found() {
    let mut expected = PROBLEMS.map(|(name, _)| name).to_vec();
    let arranging = [
        "kitting",
        "l_pieces",
        "pattern",
        "row_by_size",
        "sorting",
        "two_towers",
    ];
    expected.extend(arranging);
    expected.sort_unstable();
    assert_eq!(Problem::names(&folder()).unwrap(), expected);
}

#[test]
fn a_scene_without_goals_loads_and_is_never_complete() {
    let work_cell = WorkCell::builtin().unwrap();
    let scenes = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/scenes");
    for name in Problem::names(&scenes).unwrap() {
        let problem = Problem::load(&scenes, &name).unwrap();
        let mut environment = Environment::new(&problem, &work_cell);
        environment.reset(10_000).unwrap();
        assert!(environment.cell().is_settled(), "{name}");
        assert_eq!(environment.goal_count(), 0, "{name}");
        assert!(environment.demonstrate().is_none(), "{name}");
        let assessment = environment.assess();
        assert_eq!(assessment.total_reward, 0.0, "{name}");
        assert!(!assessment.complete, "{name}");
    }
}
