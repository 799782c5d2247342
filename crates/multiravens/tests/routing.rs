//! Episodes of the problem *routing*.

use multiravens::{Environment, EnvironmentError, Problem};
use nalgebra::{Isometry2, Vector2};
use pick_place::PickPlace;
use std::path::Path;
use ur5::WorkCell;

fn environment() -> Environment {
    let problems = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
    let problem = Problem::load(&problems, "routing").unwrap();
    Environment::new(&problem, &WorkCell::builtin().unwrap())
}

#[test]
fn demonstrations_route_the_cable() {
    let mut environment = environment();
    let seeds = 20;
    let mut complete = 0;
    for seed in 0..seeds {
        environment.reset(seed).unwrap();
        while let (false, Some(action)) = (environment.is_done(), environment.demonstrate()) {
            let report = environment.step(&action).unwrap();
            assert!(report.settled, "seed {seed}");
        }
        complete += u64::from(environment.is_complete());
    }
    assert!(complete * 100 >= seeds * 95, "{complete} of {seeds}");
}

#[test]
fn dragging_the_end_straight_to_its_goal_solves_nothing() {
    let mut environment = environment();
    for seed in 0..4 {
        environment.reset(seed).unwrap();
        while !environment.is_done() {
            let world = environment.cell().world();
            let end = world.position(world.bodies().last().unwrap());
            let (_, task) = environment.tasks().next().unwrap();
            let goal = task.goal_poses().pop().unwrap().translation.vector;
            let at = |x: f64, y: f64| Isometry2::new(Vector2::new(x, y), 0.0);
            let drag = PickPlace {
                pick: at(end.x, end.y),
                place: at(goal.x, goal.y),
            };
            match environment.step(&drag) {
                Ok(report) => assert_eq!(report.total_reward, 0.0, "seed {seed}"),
                Err(EnvironmentError::Action { .. }) => break,
                Err(error) => panic!("{error}"),
            }
        }
    }
}
