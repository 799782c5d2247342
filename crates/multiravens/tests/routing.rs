//! Episodes of the problem *routing*.

mod episode;

use multiravens::{Environment, EnvironmentError};
use nalgebra::{Isometry2, Vector2};
use pick_place::PickPlace;

fn environment() -> Environment {
    episode::environment("routing")
}

#[test]
fn demonstrations_route_the_cable_peg_by_peg() {
    let mut environment = environment();
    let seeds = 10;
    let (mut complete, mut one_by_one) = (0, 0);
    for seed in 0..seeds {
        environment.reset(seed).unwrap();
        let one = 1.0 / environment.goal_count() as f64;
        let mut gains = 0;
        while let (false, Some(action)) = (environment.is_done(), environment.demonstrate()) {
            let report = environment.step(&action).unwrap();
            assert!(report.settled, "seed {seed}");
            gains += usize::from((report.delta_reward - one).abs() < 1e-9);
            let world = environment.cell().world();
            assert!(world.widest_joint_error_m() < 5e-4, "seed {seed}");
        }
        complete += u64::from(environment.is_complete());
        // An image after each peg and after the stretch.
        one_by_one += u64::from(gains == environment.goal_count());
    }
    assert!(complete * 100 >= seeds * 95, "{complete} of {seeds}");
    assert!(one_by_one * 100 >= seeds * 90, "{one_by_one} of {seeds}");
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
