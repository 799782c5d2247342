//! Episodes of the problem *chaining*.

mod episode;

use multiravens::world::Shape;
use multiravens::{Care, Environment};
use nalgebra::{Isometry2, Vector2};
use pick_place::PickPlace;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn environment() -> Environment {
    episode::environment("chaining")
}

fn at(x: f64, y: f64) -> Isometry2<f64> {
    Isometry2::new(Vector2::new(x, y), 0.0)
}

#[test]
fn demonstrations_wrap_the_chain_round_both_pegs() {
    let mut environment = environment();
    let seeds = 10;
    let mut complete = 0;
    for seed in 0..seeds {
        environment.reset(seed).unwrap();
        assert_eq!(
            (environment.total_reward(), environment.max_steps()),
            (0.0, 4)
        );
        while let (false, Some(action)) = (environment.is_done(), environment.demonstrate()) {
            let report = environment.step(&action).unwrap();
            assert!(report.settled, "seed {seed}");
            assert!([-0.5, 0.0, 0.5, 1.0].contains(&report.delta_reward));
            let world = environment.cell().world();
            assert!(world.widest_joint_error_m() < 5e-4, "seed {seed}");
            stays_out_of_pegs(&environment);
        }
        complete += u64::from(environment.is_complete());
    }
    assert!(complete * 100 >= seeds * 95, "{complete} of {seeds}");
}

fn stays_out_of_pegs(environment: &Environment) {
    let world = environment.cell().world();
    for peg in world.bodies() {
        let Shape::Cylinder { radius_m, length_m } = world.shape(peg) else {
            continue;
        };
        for bead in world.bodies() {
            if let Shape::Sphere { radius_m: bead_m } = world.shape(bead) {
                let p = world.position(bead);
                let off = (p.xy() - world.position(peg).xy()).norm();
                assert!(p.z > length_m - 1e-3 || off > radius_m + bead_m - 1e-3);
                assert!(p.z > bead_m - 1e-3);
            }
        }
    }
}

/// Of first moves of this many scenes, each gripped 5 mm beside in four directions, those that wrap the chain round a peg.
fn first_moves_that_may_be_missed(care: Care, scenes: u64) -> usize {
    let mut environment = environment();
    environment.set_care(care);
    let beside = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)];
    let succeeds = |(seed, (x, y)): (u64, (f64, f64))| {
        environment.reset(seed).unwrap();
        let mut action = environment.demonstrate().unwrap();
        action.pick.translation.vector += Vector2::new(x, y) * 5e-3;
        environment.step(&action).unwrap().delta_reward > 0.0
    };
    let tries = (0..scenes).flat_map(|scene| beside.map(|off| (scene, off)));
    tries.map(succeeds).filter(|good| *good).count()
}

#[test]
fn a_careful_demonstrators_moves_may_be_missed_by_some_millimetres() {
    let usual = first_moves_that_may_be_missed(Care::Usual, 10);
    let careful = first_moves_that_may_be_missed(Care::Careful, 10);
    println!("{usual} and {careful} of 40");
    assert!(careful >= usual, "{careful} of 40, {usual} with usual care");
    assert!(careful >= 38, "{careful} of 40");
}

#[test]
fn random_pixels_and_a_repeated_move_solve_nothing() {
    let mut environment = environment();
    environment.reset(1).unwrap();
    let repeated = environment.demonstrate().unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    for seed in 2..10 {
        environment.reset(seed).unwrap();
        while !environment.is_done() {
            let mut pixel = || at(rng.random_range(0.25..0.75), rng.random_range(-0.5..0.5));
            let random = PickPlace {
                pick: pixel(),
                place: pixel(),
            };
            let action = if seed % 2 == 0 { random } else { repeated };
            assert!(environment.step(&action).unwrap().settled);
        }
        assert!(!environment.is_complete(), "seed {seed}");
    }
}
