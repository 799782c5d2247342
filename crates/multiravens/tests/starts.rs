//! Starts apart from scenes: the same fixtures, objects and goal, the loose objects elsewhere.

mod episode;

use multiravens::world::{BodyId, World};
use multiravens::{Environment, EnvironmentError, EpisodeSeed};
use nalgebra::{Isometry3, Vector3};
use proptest::prelude::*;

const MODULES: [&str; 4] = ["placing", "stacking", "chaining", "routing"];

fn loose(world: &World) -> Vec<BodyId> {
    world
        .bodies()
        .filter(|body| !world.is_fixed(*body))
        .collect()
}

/// What must not depend on the start: what all bodies are, where the fixtures stand, and the goals.
fn scene(environment: &Environment) -> (Vec<String>, Vec<Isometry3<f64>>, Vec<Isometry3<f64>>) {
    let world = environment.cell().world();
    let bodies = world.bodies();
    let looks = bodies.map(|body| {
        let (shape, rgb) = (world.shape(body), world.rgb(body));
        format!("{shape:?} {rgb:?} {}", world.is_fixed(body))
    });
    let fixed = world.bodies().filter(|body| world.is_fixed(*body));
    let goals = environment.tasks().flat_map(|(_, task)| task.goal_poses());
    (
        looks.collect(),
        fixed.map(|body| world.pose(body)).collect(),
        goals.collect(),
    )
}

fn positions(environment: &Environment) -> Vec<Vector3<f64>> {
    let world = environment.cell().world();
    let loose = loose(world).into_iter();
    loose.map(|body| world.position(body).coords).collect()
}

fn check(problem: &str, seed: EpisodeSeed) -> Result<(), TestCaseError> {
    let mut environment = episode::environment(problem);
    environment.reset(seed.scene).unwrap();
    let (own_scene, own) = (scene(&environment), positions(&environment));
    environment.reset(seed).unwrap();
    prop_assert_eq!(environment.seed(), seed);
    prop_assert!(environment.cell().is_settled());
    prop_assert_eq!(environment.total_reward(), 0.0);
    prop_assert_eq!(scene(&environment), own_scene);
    let other = positions(&environment);
    let moved = own
        .iter()
        .zip(&other)
        .map(|(own, other)| (own - other).norm());
    let furthest_m = moved.fold(0.0, f64::max);
    if seed.is_own_start() {
        prop_assert_eq!(furthest_m, 0.0);
    } else {
        // A start of chaining may by chance lie within a millimetre of the own one, as with scene 726389 and start 409796.
        prop_assert!(furthest_m > 1e-6, "the start is the same");
    }
    Ok(())
}

fn any_start() -> impl Strategy<Value = EpisodeSeed> {
    (0u64..1_000_000, 0u64..1_000_000).prop_map(|(scene, start)| EpisodeSeed { scene, start })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn another_start_of_placing_keeps_fixtures_and_goal(seed in any_start()) {
        check("placing", seed)?;
    }

    #[test]
    fn another_start_of_stacking_keeps_fixtures_and_goal(seed in any_start()) {
        check("stacking", seed)?;
    }

    #[test]
    fn another_start_of_chaining_keeps_fixtures_and_goal(seed in any_start()) {
        check("chaining", seed)?;
    }

    #[test]
    fn another_start_of_routing_keeps_fixtures_and_goal(seed in any_start()) {
        check("routing", seed)?;
    }

    #[test]
    fn another_start_of_a_composition_keeps_fixtures_and_goal(seed in any_start()) {
        check("placing_stacking_routing", seed)?;
        check("placing_chaining_routing", seed)?;
    }
}

#[test]
fn a_start_seed_equal_to_the_scene_seed_is_the_start_of_the_scene_alone() {
    for problem in MODULES {
        check(problem, 5.into()).unwrap();
        let mut environment = episode::environment(problem);
        environment.reset(5).unwrap();
        let alone = environment.state_hash();
        environment
            .reset(EpisodeSeed { scene: 5, start: 5 })
            .unwrap();
        assert_eq!(environment.state_hash(), alone, "{problem}");
    }
}

/// Goals in the order in which they are reached.
fn solve(environment: &mut Environment, seed: EpisodeSeed, follow: &[usize]) -> Vec<usize> {
    environment.reset(seed).unwrap();
    environment.follow(follow).unwrap();
    let mut order = Vec::new();
    while !environment.is_done() {
        let action = environment.demonstrate().unwrap();
        environment.step(&action).unwrap();
        let reached = environment.goals_reached();
        order.extend(
            reached
                .into_iter()
                .filter(|goal| !order.contains(goal))
                .collect::<Vec<_>>(),
        );
    }
    assert!(environment.is_complete(), "seed {seed}");
    order
}

#[test]
fn a_demonstrator_reaches_the_goals_in_the_order_of_another_demonstration() {
    for problem in [
        "placing",
        "stacking",
        "chaining",
        "placing_stacking_routing",
    ] {
        let mut environment = episode::environment(problem);
        for scene in [10_000, 10_002] {
            let order = solve(&mut environment, scene.into(), &[]);
            let ends = positions(&environment);
            let start = scene + 2;
            let followed = solve(&mut environment, EpisodeSeed { scene, start }, &order);
            assert_eq!(followed, order, "{problem}, scene {scene}");
            // Block by block, the same tower stands.
            if problem == "stacking" {
                for (own, other) in ends.iter().zip(positions(&environment)) {
                    assert!((own - other).norm() < 0.02, "scene {scene}");
                }
            }
        }
        // Not because there were but one order.
        let orders = [10_004, 10_006, 10_008, 10_010]
            .map(|scene| solve(&mut environment, scene.into(), &[]));
        assert!(orders.iter().any(|order| *order != orders[0]), "{problem}");
    }
}

#[test]
fn an_order_of_goals_that_are_not_there_is_refused() {
    let mut environment = episode::environment("chaining");
    environment.reset(0).unwrap();
    for order in [vec![2], vec![0, 0]] {
        let error = environment.follow(&order).unwrap_err();
        assert!(matches!(error, EnvironmentError::Order { .. }));
        assert!(error.to_string().contains("each of 0 to 1"), "{error}");
    }
}
