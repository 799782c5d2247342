//! How often the check of motions refuses what demonstrators do.

use collision::{CollisionChecker, Margins, Situation, rehearse};
use heightmap::Heightmap;
use multiravens::{Environment, Problem};
use nalgebra::Point2;
use pick_place::PickPlace;
use std::path::Path;
use ur5::WorkCell;

/// Actions of demonstrators, the reasons of those that the check refuses, and how many it lets pass although a post stands in their way.
fn refusals(problem: &str, seeds: &[u64]) -> (usize, Vec<String>, usize) {
    let cell = WorkCell::builtin().unwrap();
    let checker = CollisionChecker::new(&cell, Margins::default()).unwrap();
    let folder = Path::new(concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../config/problems"
    ));
    let mut environment = Environment::new(&Problem::load(folder, problem).unwrap(), &cell);
    let (mut count, mut refused, mut through) = (0, Vec::new(), 0);
    for seed in seeds {
        environment.reset(*seed).unwrap();
        while !environment.is_done() {
            let heightmap = environment.observe().unwrap().clone();
            let action = environment.demonstrate().unwrap();
            let settings = environment.settings().expect("a step is due");
            count += 1;
            let check = |heightmap: &Heightmap| {
                let (arm, home) = (&cell.arm, &cell.arm.home);
                let situation = Situation {
                    joints: home,
                    holds: false,
                    heightmap: Some(heightmap),
                    touchdown: None,
                };
                rehearse(&checker, arm, &action, &settings, &situation)
            };
            if let Err(error) = check(&heightmap) {
                refused.push(format!("{problem} {seed}: {error}"));
            }
            through += usize::from(check(&with_post(&heightmap, &action)).is_ok());
            environment.step(&action).unwrap();
        }
    }
    (count, refused, through)
}

/// A post of 0.3 m half-way between pick and place.
fn with_post(heightmap: &Heightmap, action: &PickPlace) -> Heightmap {
    let (pick, place) = (
        action.pick.translation.vector,
        action.place.translation.vector,
    );
    let middle = Point2::from(0.5 * (pick + place));
    let mut with = heightmap.clone();
    let pixel = with
        .workspace
        .pixel(&middle)
        .expect("between two that are inside");
    let cols = with.workspace.cols;
    for row in pixel.row.saturating_sub(2)..pixel.row + 2 {
        with.height_m[row * cols + pixel.col.saturating_sub(2)..row * cols + pixel.col + 2]
            .fill(0.3);
    }
    with
}

#[test]
fn what_demonstrators_do_is_free_and_a_post_in_their_way_is_found() {
    for problem in ["placing", "stacking", "routing"] {
        let (count, refused, through) = refusals(problem, &[10_000, 10_002]);
        assert!(
            count >= 5 && refused.is_empty(),
            "{problem}: {count} actions, {refused:#?}"
        );
        assert_eq!(through, 0, "{problem}: {count} actions through a post");
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
        let (count, refused, through) = refusals(problem, &[10_000, 10_002, 10_004]);
        println!(
            "{problem}: {count} actions, {} refused, {through} through a post",
            refused.len()
        );
        for reason in refused {
            println!("  {reason}");
        }
    }
}
