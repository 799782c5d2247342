//! How often the check of motions refuses what demonstrators do.

use collision::{CollisionChecker, Margins, rehearse};
use multiravens::{Environment, Problem};
use std::path::Path;
use ur5::WorkCell;

/// Actions of demonstrators, and the reasons of those that the check refuses.
fn refusals(problem: &str, seeds: &[u64]) -> (usize, Vec<String>) {
    let cell = WorkCell::builtin().unwrap();
    let checker = CollisionChecker::new(&cell, Margins::default()).unwrap();
    let folder = Path::new(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../config/problems"
    ));
    let mut environment = Environment::new(&Problem::load(folder, problem).unwrap(), &cell);
    let (mut count, mut refused) = (0, Vec::new());
    for seed in seeds {
        environment.reset(*seed).unwrap();
        while !environment.is_done() {
            let heightmap = environment.observe().unwrap().clone();
            let action = environment.demonstrate().unwrap();
            let settings = environment.settings().expect("a step is due");
            count += 1;
            let checked = rehearse(
                &checker,
                &cell.arm,
                &action,
                &settings,
                &cell.arm.home,
                false,
                Some(&heightmap),
            );
            if let Err(error) = checked {
                refused.push(format!("{problem} {seed}: {error}"));
            }
            environment.step(&action).unwrap();
        }
    }
    (count, refused)
}

#[test]
fn what_demonstrators_of_placing_and_stacking_do_is_free() {
    for problem in ["placing", "stacking"] {
        let (count, refused) = refusals(problem, &[10_000, 10_002]);
        assert!(
            count > 4 && refused.is_empty(),
            "{problem}: {count} actions, {refused:#?}"
        );
    }
}

#[test]
#[ignore = "takes minutes: prints how many actions of each problem are refused"]
fn rates_of_all_problems() {
    for problem in [
        "placing",
        "stacking",
        "chaining",
        "routing",
        "stacking_routing",
    ] {
        let (count, refused) = refusals(problem, &[10_000, 10_002, 10_004]);
        println!("{problem}: {count} actions, {} refused", refused.len());
        for reason in refused {
            println!("  {reason}");
        }
    }
}
