//! Episodes of the problem *placing*, with the arm, the suction and the cameras.

mod episode;

use multiravens::{Environment, EnvironmentError};
use nalgebra::{Isometry2, Vector2};
use pick_place::{Outcome, PickPlace};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn environment() -> Environment {
    episode::environment("placing")
}

fn at(x: f64, y: f64) -> Isometry2<f64> {
    Isometry2::new(Vector2::new(x, y), 0.0)
}

#[test]
fn demonstrations_solve_the_problem_in_nine_steps() {
    let mut environment = environment();
    for seed in 0..20 {
        environment.reset(seed).unwrap();
        assert_eq!(environment.total_reward(), 0.0);
        let mut steps = 0;
        while !environment.is_done() {
            assert_eq!(environment.module(), Some("placing"));
            let action = environment.demonstrate().expect("something is left to do");
            let report = environment.step(&action).unwrap();
            steps += 1;
            assert_eq!(report.outcome, Outcome::Placed, "seed {seed}");
            assert!(report.settled);
            assert!(
                (report.delta_reward - 1.0 / 9.0).abs() < 1e-9,
                "seed {seed}"
            );
            assert!(environment.cell().is_home() && !environment.cell().is_holding());
            assert_eq!(environment.cell().time(), report.time);
        }
        assert!(environment.is_complete());
        assert_eq!((steps, environment.steps()), (9, 9));
        assert!((environment.total_reward() - 1.0).abs() < 1e-9);
        assert_eq!(environment.demonstrate(), None);
        let again = PickPlace {
            pick: at(0.5, 0.0),
            place: at(0.5, 0.0),
        };
        assert!(matches!(
            environment.step(&again),
            Err(EnvironmentError::Over)
        ));
    }
}

#[test]
fn other_seeds_give_other_scenes_and_other_actions() {
    let mut environment = environment();
    environment.reset(1).unwrap();
    let (state, action) = (environment.state_hash(), environment.demonstrate());
    environment.reset(2).unwrap();
    assert_ne!(environment.state_hash(), state);
    assert_ne!(environment.demonstrate(), action);
}

#[test]
fn random_actions_neither_panic_nor_leave_anything_moving_nor_solve_the_problem() {
    let mut environment = environment();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for seed in 0..8 {
        environment.reset(seed).unwrap();
        while !environment.is_done() {
            let pick = if rng.random_bool(0.7) {
                // Somewhere on a body: gripped off centre, or at its edge.
                let world = environment.cell().world();
                let bodies: Vec<_> = world.bodies().collect();
                let body = world.position(bodies[rng.random_range(0..bodies.len())]);
                let mut off = || rng.random_range(-0.025..0.025);
                at(
                    (body.x + off()).clamp(0.25, 0.749),
                    (body.y + off()).clamp(-0.5, 0.499),
                )
            } else {
                at(rng.random_range(0.25..0.75), rng.random_range(-0.5..0.5))
            };
            let place = Isometry2::new(
                Vector2::new(rng.random_range(0.35..0.65), rng.random_range(-0.2..0.2)),
                rng.random_range(-3.0..3.0),
            );
            let report = environment.step(&PickPlace { pick, place }).unwrap();
            assert!(report.settled, "seed {seed}");
        }
        assert!(!environment.is_complete());
    }
}

#[test]
fn an_action_that_is_not_finite_or_off_the_table_moves_nothing() {
    let mut environment = environment();
    environment.reset(0).unwrap();
    let before = (environment.state_hash(), environment.cell().time());
    let good = at(0.5, 0.0);
    let bad = [
        at(f64::NAN, 0.0),
        at(0.5, f64::INFINITY),
        Isometry2::new(Vector2::new(0.5, 0.0), f64::NAN),
        at(0.2499, 0.0),
        at(0.7501, 0.0),
        at(0.5, -0.5001),
        at(0.5, 0.5001),
        at(-1e300, 1e300),
    ];
    for bad in bad {
        for (pick, place, which) in [(bad, good, "pick"), (good, bad, "place")] {
            let error = environment.step(&PickPlace { pick, place }).unwrap_err();
            assert!(matches!(error, EnvironmentError::Action { .. }));
            assert!(error.to_string().contains(which), "{error}");
        }
    }
    assert_eq!(environment.steps(), 0);
    assert_eq!(
        (environment.state_hash(), environment.cell().time()),
        before
    );
}

#[test]
fn the_corners_of_the_table_can_be_worked_at() {
    let mut environment = environment();
    for (x, y) in [
        (0.251, -0.499),
        (0.251, 0.499),
        (0.749, -0.499),
        (0.749, 0.499),
    ] {
        environment.reset(0).unwrap();
        let action = PickPlace {
            pick: at(x, y),
            place: at(0.5, 0.0),
        };
        let report = environment.step(&action).unwrap();
        assert_eq!(report.outcome, Outcome::GraspFailed);
    }
}
