//! Episodes of the problem *stacking*.

mod episode;

use multiravens::Environment;
use nalgebra::{Isometry2, Vector2};
use pick_place::{Outcome, PickPlace};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn environment() -> Environment {
    episode::environment("stacking")
}

#[test]
fn demonstrations_build_the_pyramid_block_by_block() {
    let mut environment = environment();
    for seed in 0..20 {
        environment.reset(seed).unwrap();
        assert_eq!(environment.max_steps(), 8);
        while !environment.is_done() {
            let action = environment.demonstrate().expect("something is left to do");
            let report = environment.step(&action).unwrap();
            assert_eq!(report.outcome, Outcome::Placed, "seed {seed}");
            assert!(report.settled, "seed {seed}");
            assert!(
                (report.delta_reward - 1.0 / 6.0).abs() < 1e-9,
                "seed {seed}"
            );
        }
        assert!(environment.is_complete(), "seed {seed}");
        assert_eq!(environment.steps(), 6);
    }
}

#[test]
fn blocks_at_random_on_the_stand_solve_nothing() {
    let mut environment = environment();
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut total = 0.0;
    const EPISODES: u64 = 12;
    for seed in 0..EPISODES {
        environment.reset(seed).unwrap();
        while !environment.is_done() {
            let world = environment.cell().world();
            // The first body is the stand. A policy of random pixels seldom grips anything: this
            // one always aims at a block and at the stand, which is still not enough.
            let bodies: Vec<_> = world.bodies().collect();
            let block = world.position(bodies[rng.random_range(1..bodies.len())]);
            let stand = world.position(bodies[0]);
            let mut off = |far: f64| rng.random_range(-far..far);
            // A block may have been pushed off the table's edge.
            let pick = Vector2::new(
                (block.x + off(0.02)).clamp(0.25, 0.749),
                (block.y + off(0.02)).clamp(-0.5, 0.499),
            );
            let place = Vector2::new(stand.x + off(0.08), stand.y + off(0.08));
            let report = environment
                .step(&PickPlace {
                    pick: Isometry2::new(pick, 0.0),
                    place: Isometry2::new(place, off(3.0)),
                })
                .unwrap();
            assert!(report.settled, "seed {seed}");
        }
        assert!(!environment.is_complete());
        total += environment.total_reward();
    }
    assert!(total / EPISODES as f64 * 100.0 < 5.0, "{total}");
}
