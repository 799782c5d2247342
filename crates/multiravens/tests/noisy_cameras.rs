//! What noisy cameras do to observations, and what the change test makes of it.

use camera_noise::{ClutterItem, Perturbation};
use heightmap::{ChangeRules, Heightmap, largest_change};
use multiravens::{Environment, Problem, render::LIGHT};
use nalgebra::{Isometry3, Point2, Translation3, UnitQuaternion, Vector3};
use std::path::Path;
use ur5::WorkCell;

fn folder() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../config"))
}

fn model(name: &str) -> Perturbation {
    Perturbation::load(&folder().join(format!("perturbations/{name}.yaml"))).unwrap()
}

fn environment(problem: &str) -> Environment {
    let problem = Problem::load(&folder().join("problems"), problem).unwrap();
    Environment::new(&problem, &WorkCell::builtin().unwrap())
}

#[test]
fn the_same_seed_and_session_give_the_same_observation_and_another_session_another() {
    let realsense = model("realsense");
    let observe = |perturbed: bool, session: u64| {
        let mut environment = environment("placing");
        environment.set_perturbation(perturbed.then_some(&realsense));
        environment.set_session(session);
        environment.reset(10_000).unwrap();
        environment.observe().unwrap().clone()
    };
    let first = observe(true, 0);
    assert_eq!(first, observe(true, 0));
    assert_ne!(first, observe(true, 1));
    let clean = observe(false, 0);
    assert_ne!(first, clean);
    // It is the same scene.
    let seen =
        (0..clean.height_m.len()).filter(|index| first.is_seen(*index) && clean.is_seen(*index));
    let errors: Vec<f32> = seen
        .map(|index| (first.height_m[index] - clean.height_m[index]).abs())
        .collect();
    let large = errors.iter().filter(|error| **error > 0.01).count();
    assert!(errors.len() > 45_000, "{}", errors.len());
    assert!(large < errors.len() / 50, "{large} of {}", errors.len());
}

#[test]
fn perfect_cameras_come_back_when_the_perturbation_is_taken_away() {
    let mut environment = environment("placing");
    environment.reset(10_000).unwrap();
    let clean = environment.observe().unwrap().clone();
    environment.set_perturbation(Some(&model("harsh")));
    environment.reset(10_000).unwrap();
    assert_ne!(clean, *environment.observe().unwrap());
    environment.set_perturbation(None);
    environment.reset(10_000).unwrap();
    assert_eq!(clean, *environment.observe().unwrap());
}

/// A free place for a small object within 15 to 45 mm of a point, and the height of what it stands on.
fn free_place(
    heightmap: &Heightmap,
    about: &Point2<f64>,
    start: usize,
) -> Option<(Point2<f64>, f64)> {
    (0..24).find_map(|step| {
        let angle = (start * 7 + step) as f64 * 0.9;
        let distance_m = 0.016 + 0.003 * ((start + step) % 10) as f64;
        let at = about + distance_m * nalgebra::Vector2::new(angle.cos(), angle.sin());
        let pixel = heightmap.workspace.pixel(&at)?;
        let (rows, cols) = (heightmap.workspace.rows, heightmap.workspace.cols);
        if pixel.row < 6 || pixel.col < 6 || pixel.row + 6 >= rows || pixel.col + 6 >= cols {
            return None;
        }
        let cells = (pixel.row - 5..=pixel.row + 5)
            .flat_map(|row| (pixel.col - 5..=pixel.col + 5).map(move |col| row * cols + col));
        let heights: Vec<f32> = cells
            .filter(|index| heightmap.is_seen(*index))
            .map(|index| heightmap.height_m[index])
            .collect();
        let (low, high) = heights
            .iter()
            .fold((1.0f32, -1.0f32), |(low, high), height| {
                (low.min(*height), high.max(*height))
            });
        (heights.len() == 121 && high - low < 1e-3).then_some((at, f64::from(low)))
    })
}

#[test]
#[ignore = "takes minutes"]
fn no_untouched_scene_counts_as_changed_and_a_small_object_beside_the_place_always_does() {
    let realsense = model("realsense");
    let rules = ChangeRules::default();
    let (mut untouched, mut refused, mut placed, mut missed) = (0, Vec::new(), 0, Vec::new());
    for (number, problem) in ["placing", "stacking", "chaining", "routing"]
        .into_iter()
        .enumerate()
    {
        for seed in (20_000..20_010u64).step_by(2) {
            let mut environment = environment(problem);
            environment.reset(seed).unwrap();
            let clean = environment.observe().unwrap().clone();
            let action = environment.demonstrate().unwrap();
            environment.set_perturbation(Some(&realsense));
            environment.reset(seed).unwrap();
            let around =
                [action.pick, action.place].map(|pose| Point2::from(pose.translation.vector));
            let source = environment.observe().unwrap().clone();
            for _ in 0..10 {
                let latest = environment.observe().unwrap();
                untouched += 1;
                if let Some(change) = largest_change(&source, latest, &rules, &around).unwrap() {
                    refused.push((problem, seed, change));
                }
            }
            let light = environment.rig().unwrap().light(&LIGHT);
            for start in 0..5 {
                let Some((at, floor_m)) = free_place(&clean, &around[1], 5 * number + start) else {
                    continue;
                };
                placed += 1;
                let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), start as f64);
                let item = ClutterItem {
                    size_m: Vector3::new(0.015, 0.015, 0.01),
                    pose: Isometry3::from_parts(
                        Translation3::new(at.x, at.y, floor_m + 0.005),
                        yaw,
                    ),
                    rgb: [200, 180, 40],
                };
                environment.cell_mut().perturb(light, vec![item]);
                let latest = environment.observe().unwrap();
                match largest_change(&source, latest, &rules, &around).unwrap() {
                    Some(change) if (change.center_m - at).norm() < 0.02 => {}
                    other => missed.push((problem, seed, at, other)),
                }
            }
        }
    }
    println!(
        "{untouched} untouched, {} refused; {placed} objects, {} missed",
        refused.len(),
        missed.len()
    );
    assert_eq!(untouched, 200);
    assert!(placed >= 40, "{placed}");
    assert!(refused.is_empty(), "{refused:?}");
    assert!(missed.is_empty(), "{missed:?}");
}
