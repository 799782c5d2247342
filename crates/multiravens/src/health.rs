//! What the physics does at its worst, under policies that know nothing of the task.

use crate::cell::{Cell, CellError};
use crate::environment::{Environment, EnvironmentError};
use crate::world::{BodyId, Shape, World};
use heightmap::{Pixel, Workspace};
use nalgebra::{Isometry2, Vector2, Vector3};
use pick_place::{ExecuteError, PickPlace};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;

/// Stream of the seed's random numbers that the policies draw from.
const POLICY_STREAM: u64 = 1 << 33;

/// The worst of what was seen at all physics steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Extremes {
    /// Widest gap of a joint of a cable or chain.
    pub joint_error_m: f64,
    /// How deep a bead was in a peg.
    pub depth_in_peg_m: f64,
    /// How deep a free body was in the table.
    pub depth_in_table_m: f64,
    /// Speed of the fastest free body.
    pub speed_m_s: f64,
}

impl Extremes {
    /// What a healthy world never exceeds: joints of 2 mm, half a bead's radius, 2 m/s.
    pub const LIMITS: Self = Self {
        joint_error_m: 2e-3,
        depth_in_peg_m: 3e-3,
        depth_in_table_m: 3e-3,
        speed_m_s: 2.0,
    };

    /// Looks at a world.
    pub fn look(&mut self, world: &World) {
        self.joint_error_m = self.joint_error_m.max(world.widest_joint_error_m());
        self.speed_m_s = self.speed_m_s.max(world.fastest_m_s());
        for body in world.bodies().filter(|body| !world.is_fixed(*body)) {
            let below = -lowest_m(world, body);
            self.depth_in_table_m = self.depth_in_table_m.max(below);
            let Shape::Sphere { radius_m } = world.shape(body) else {
                continue;
            };
            for peg in world.bodies().filter(|body| world.is_fixed(*body)) {
                let depth = depth_in_peg_m(world, body, radius_m, peg);
                self.depth_in_peg_m = self.depth_in_peg_m.max(depth);
            }
        }
    }
}

/// Height of a body's lowest point.
fn lowest_m(world: &World, body: BodyId) -> f64 {
    let lowest = world.components(body).iter().map(|component| {
        let pose = world.pose(body) * component.pose;
        // The world's downwards direction, seen from the shape.
        let down = pose.rotation.inverse() * -Vector3::z();
        let reach = match component.shape {
            Shape::Sphere { radius_m } => radius_m,
            Shape::Cuboid { size_m } => 0.5 * size_m.dot(&down.abs()),
            Shape::Cylinder { radius_m, length_m } => {
                0.5 * length_m * down.z.abs() + radius_m * down.xy().norm()
            }
        };
        pose.translation.z - reach
    });
    lowest.fold(f64::INFINITY, f64::min)
}

/// How deep a ball is in an upright cylinder; nothing in anything else.
fn depth_in_peg_m(world: &World, ball: BodyId, radius_m: f64, peg: BodyId) -> f64 {
    let Shape::Cylinder {
        radius_m: peg_m,
        length_m,
    } = world.shape(peg)
    else {
        return 0.0;
    };
    let off = world.position(ball) - world.position(peg);
    let from_side = peg_m + radius_m - off.xy().norm();
    let from_above = length_m / 2.0 + radius_m - off.z;
    from_side.min(from_above)
}

/// A policy that knows nothing, or hardly anything, of the task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum BaselinePolicy {
    /// Picks and places at random pixels, with a random turn.
    Pixels,
    /// Picks a random body somewhere, and places it at a random pixel.
    Bodies,
    /// Repeats the demonstrator's first action.
    Repeat,
    /// Drags what was added last, a cable's end, straight to the last goal.
    Drag,
}

impl BaselinePolicy {
    fn act(self, environment: &Environment, rng: &mut ChaCha8Rng) -> Option<PickPlace> {
        let world = environment.cell().world();
        match self {
            Self::Pixels => Some(PickPlace {
                pick: pixel(rng, 0.0),
                place: pixel(rng, PI),
            }),
            Self::Bodies => {
                let free: Vec<_> = world.bodies().filter(|b| !world.is_fixed(*b)).collect();
                let body = *free.choose(rng)?;
                let most = match world.shape(body) {
                    Shape::Sphere { radius_m } => 0.5 * radius_m,
                    Shape::Cylinder { radius_m, .. } => radius_m,
                    Shape::Cuboid { size_m } => 0.6 * size_m.x,
                };
                let mut off = || rng.random_range(-most..most);
                let at = world.position(body).xy().coords + Vector2::new(off(), off());
                let pick = Workspace::RAVENS.pixel(&at.into())?;
                Some(PickPlace {
                    pick: Workspace::RAVENS.pose(pick, 0.0),
                    place: pixel(rng, PI),
                })
            }
            Self::Drag => {
                let end = world.position(world.bodies().last()?).xy();
                let goal = environment.tasks().last()?.1.goal_poses().pop()?;
                let goal = goal.translation.vector.xy();
                Some(PickPlace {
                    pick: Isometry2::new(end.coords, 0.0),
                    place: Isometry2::new(goal, 0.0),
                })
            }
            Self::Repeat => None,
        }
    }
}

/// A random pixel's centre, turned by at most `turn_rad`.
fn pixel(rng: &mut ChaCha8Rng, turn_rad: f64) -> Isometry2<f64> {
    let workspace = Workspace::RAVENS;
    let pixel = Pixel {
        row: rng.random_range(0..workspace.rows),
        col: rng.random_range(0..workspace.cols),
    };
    workspace.pose(pixel, turn_rad * rng.random_range(-1.0..1.0))
}

/// What an episode came to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Checkup {
    /// The worst of all its physics steps.
    pub extremes: Extremes,
    /// Whether all bodies came to rest after every step.
    pub settled: bool,
    /// Whether all numbers stayed finite.
    pub finite: bool,
    /// Steps that the primitive refused or could not end.
    pub failed_steps: usize,
    /// Whether all goals were reached at the end.
    pub complete: bool,
    /// Reward of the last state.
    pub total_reward: f64,
}

/// Plays the episode of a seed under a policy, the demonstrator where none is given, and looks at
/// the world after every physics step.
///
/// # Errors
/// When the environment cannot be set up; what goes wrong in the episode is part of the result.
pub fn check_up(
    environment: &mut Environment,
    seed: u64,
    policy: Option<BaselinePolicy>,
) -> Result<Checkup, EnvironmentError> {
    environment.reset(seed)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(POLICY_STREAM);
    let mut checkup = Checkup {
        settled: true,
        finite: true,
        ..Checkup::default()
    };
    checkup.extremes.look(environment.cell().world());
    let mut repeated = None;
    for _ in 0..environment.max_steps() {
        if environment.is_done() {
            break;
        }
        let action = match policy {
            Some(BaselinePolicy::Repeat) => {
                repeated = repeated.or_else(|| environment.demonstrate());
                repeated
            }
            Some(policy) => policy.act(environment, &mut rng),
            None => environment.demonstrate(),
        };
        // A policy that aims at a body beside the table has nothing to do in this step.
        let Some(action) = action else {
            continue;
        };
        let extremes = &mut checkup.extremes;
        let watch = |cell: &Cell| {
            // What does not move was looked at before.
            if cell.world().fastest_m_s() > 0.0 {
                extremes.look(cell.world());
            }
        };
        match environment.step_watched(&action, watch) {
            Ok(report) => checkup.settled &= report.settled,
            Err(
                EnvironmentError::Cell(CellError::Broken)
                | EnvironmentError::Primitive(ExecuteError::Robot {
                    error: CellError::Broken,
                    ..
                }),
            ) => {
                checkup.finite = false;
                break;
            }
            // The drag of an end beside the table is refused, and changes nothing.
            Err(EnvironmentError::Action { .. }) => break,
            Err(_) => {
                checkup.failed_steps += 1;
                break;
            }
        }
    }
    checkup.complete = environment.is_complete();
    checkup.total_reward = environment.total_reward();
    Ok(checkup)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::{Mobility, Part};
    use nalgebra::Isometry3;

    fn scene(bead: Vector3<f64>, block: Isometry3<f64>) -> World {
        let mut world = World::new(&Isometry3::translation(0.0, 0.0, 0.5));
        let mut add = |shape, pose, mobility| {
            world.add(&Part {
                shape,
                pose,
                mobility,
                friction: 0.5,
                rgb: [255; 3],
            })
        };
        let peg = Shape::Cylinder {
            radius_m: 0.015,
            length_m: 0.02,
        };
        add(peg, Isometry3::translation(0.5, 0.0, 0.01), Mobility::Fixed);
        let free = Mobility::Free {
            mass_kg: 0.01,
            suction_force_n: 3.0,
        };
        let pose = Isometry3::translation(0.5 + bead.x, bead.y, bead.z);
        add(Shape::Sphere { radius_m: 0.006 }, pose, free);
        let size_m = Vector3::repeat(0.04);
        add(Shape::Cuboid { size_m }, block, free);
        world
    }

    fn look(world: &World) -> Extremes {
        let mut extremes = Extremes::default();
        extremes.look(world);
        extremes
    }

    #[test]
    fn depths_are_measured_from_the_nearest_face() {
        let away = Isometry3::translation(0.6, 0.3, 0.1);
        // Touching, then 2 mm into the side, 1 mm into the top, 4 mm into the table.
        for (bead, in_peg, in_table) in [
            (Vector3::new(0.021, 0.0, 0.006), 0.0, 0.0),
            (Vector3::new(0.0, 0.019, 0.006), 2e-3, 0.0),
            (Vector3::new(0.003, 0.0, 0.025), 1e-3, 0.0),
            (Vector3::new(0.05, 0.0, 0.002), 0.0, 4e-3),
        ] {
            let extremes = look(&scene(bead, away));
            assert!((extremes.depth_in_peg_m - in_peg).abs() < 1e-6, "{bead}");
            assert!(
                (extremes.depth_in_table_m - in_table).abs() < 1e-6,
                "{bead}"
            );
        }
        // A block on its edge is half a diagonal high.
        let tilt = nalgebra::UnitQuaternion::from_euler_angles(PI / 4.0, 0.0, 0.0);
        let height = 0.02 * 2f64.sqrt() - 1e-3;
        let block = Isometry3::from_parts(nalgebra::Translation3::new(0.6, 0.3, height), tilt);
        let extremes = look(&scene(Vector3::new(0.05, 0.0, 0.006), block));
        assert!((extremes.depth_in_table_m - 1e-3).abs() < 1e-6);
    }
}
