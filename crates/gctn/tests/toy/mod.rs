//! A toy of the real work: square blocks, each with a dark edge, on a grey table; the goal shows one of them
//! elsewhere and turned.
#![allow(dead_code)] // Test and example use different parts.

use gctn::{Decision, Goal, Sample};
use heightmap::{Heightmap, Pixel, Workspace};
use nalgebra::{Isometry2, Point2, Vector2};
use rand::{Rng, RngExt};
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use std::f64::consts::TAU;

const EDGE_M: f64 = 0.04;
const COLORS: [[u8; 3]; 6] = [
    [255, 87, 89],
    [78, 121, 167],
    [89, 169, 79],
    [237, 201, 72],
    [176, 122, 161],
    [118, 183, 178],
];

/// One step: an observation, a goal, and how to get there.
pub struct Toy {
    pub observation: Heightmap,
    pub goal: Heightmap,
    /// v_{k-1} and v_k of a demonstration of another start.
    pub shown: [Heightmap; 2],
    pub pick: Isometry2<f64>,
    pub place: Isometry2<f64>,
    /// The block to move: where it lies, and where the goal shows it.
    pub block: Isometry2<f64>,
    pub wanted: Isometry2<f64>,
}

impl Toy {
    /// Another seed, another scene. The block is turned by one of `rotations`.
    pub fn new(seed: u64, rotations: u32) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        // Poses apart from each other; the last is the goal's.
        let mut poses: Vec<Isometry2<f64>> = Vec::new();
        while poses.len() < 5 {
            let position =
                Vector2::new(rng.random_range(0.30..0.70), rng.random_range(-0.44..0.44));
            let far =
                |pose: &Isometry2<f64>| (pose.translation.vector - position).norm() > 1.6 * EDGE_M;
            if poses.iter().all(far) {
                poses.push(Isometry2::new(position, rng.random_range(0.0..TAU)));
            }
        }
        let turn = TAU * f64::from(rng.random_range(0..rotations)) / f64::from(rotations);
        let block = poses[0];
        let wanted = Isometry2::new(poses[4].translation.vector, block.rotation.angle() + turn);
        let first = rng.random_range(0..COLORS.len());
        let color = |index: usize| COLORS[(first + index) % COLORS.len()];
        let mut before: Vec<_> = (0..4).map(|index| (poses[index], color(index))).collect();
        let observation = render(&before, rng);
        before[0].0 = wanted;
        let goal = render(&before, rng);
        // The other start: the same blocks, but only the wanted pose is the same.
        let other_rng = &mut ChaCha8Rng::seed_from_u64(seed);
        other_rng.set_stream(1);
        let mut elsewhere: Vec<_> = before.clone();
        let mut others: Vec<Isometry2<f64>> = vec![wanted];
        while others.len() < 5 {
            let (x, y) = (0.30..0.70, -0.44..0.44);
            let position = Vector2::new(other_rng.random_range(x), other_rng.random_range(y));
            let far =
                |pose: &Isometry2<f64>| (pose.translation.vector - position).norm() > 1.6 * EDGE_M;
            if others.iter().all(far) {
                others.push(Isometry2::new(position, other_rng.random_range(0.0..TAU)));
            }
        }
        for (block, pose) in elsewhere.iter_mut().zip(&others[1..]) {
            block.0 = *pose;
        }
        let first_image = render(&elsewhere, other_rng);
        elsewhere[0].0 = wanted;
        let shown = [first_image, render(&elsewhere, other_rng)];
        let mut inside = || rng.random_range(-0.35 * EDGE_M..0.35 * EDGE_M);
        let point = Point2::new(inside(), inside());
        let pick = Isometry2::new((block * point).coords, 0.0);
        let place = Isometry2::new((wanted * point).coords, turn);
        Self {
            observation,
            goal,
            shown,
            pick,
            place,
            block,
            wanted,
        }
    }

    pub fn sample(&self) -> Sample<'_> {
        Sample {
            observation: &self.observation,
            goal: (&self.goal).into(),
            pick: self.pick,
            place: self.place,
            done: false,
        }
    }

    /// The same step, shown by the demonstration of another start: the blocks that stay stand elsewhere, and so does the one
    /// that moves.
    pub fn shown_elsewhere(&self) -> Sample<'_> {
        Sample {
            goal: Goal::step(&self.shown[0], &self.shown[1]),
            ..self.sample()
        }
    }

    /// How far from where the goal shows it the block ends up (m), and how far turned (rad); none if it was
    /// not picked.
    pub fn error(&self, decision: &Decision) -> Option<(f64, f64)> {
        let pick = Point2::from(decision.pick.translation.vector);
        let held = self.block.inverse_transform_point(&pick);
        if held.x.abs().max(held.y.abs()) > EDGE_M / 2.0 {
            return None;
        }
        let moved = decision.place * decision.pick.inverse() * self.block;
        let distance_m = (moved.translation.vector - self.wanted.translation.vector).norm();
        let turn_rad = moved.rotation.rotation_to(&self.wanted.rotation).angle();
        Some((distance_m, turn_rad.abs()))
    }
}

fn render(blocks: &[(Isometry2<f64>, [u8; 3])], rng: &mut impl Rng) -> Heightmap {
    let mut heightmap = Heightmap::new(Workspace::RAVENS);
    let workspace = heightmap.workspace;
    for row in 0..workspace.rows {
        for col in 0..workspace.cols {
            let center = workspace.center(Pixel { row, col });
            let on = blocks.iter().find_map(|(pose, rgb)| {
                let point = pose.inverse_transform_point(&center);
                let inside = point.x.abs().max(point.y.abs()) <= EDGE_M / 2.0;
                let dark = point.x > EDGE_M / 4.0;
                inside.then(|| rgb.map(|channel| if dark { channel / 4 } else { channel }))
            });
            let (rgb, height_m) = on.map_or(([120; 3], 0.0), |rgb| (rgb, EDGE_M as f32));
            let index = row * workspace.cols + col;
            heightmap.height_m[index] = height_m + rng.random_range(-0.001..0.001);
            for (channel, value) in rgb.into_iter().enumerate() {
                heightmap.rgb[3 * index + channel] =
                    value.saturating_add_signed(rng.random_range(-4..4));
            }
        }
    }
    heightmap
}
