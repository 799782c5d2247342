//! The check of one motion.

use crate::Terrain;
use crate::terrain::Column;
use nalgebra::{Isometry3, Point2, Point3, Vector3};
use parry3d::math::{Pose, Rotation, Vector};
use parry3d::shape::{Ball, Cuboid, Cylinder};
use std::time::Duration;
use ur5::{Arm, Body, JointTrajectory, Joints, Shape, WorkCell, joints_text};

/// Distances to keep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Margins {
    /// From everything fixed and from the heightmap.
    pub obstacle_m: f64,
    /// Of tool and carried object from the heightmap while the tip is slow: no faster than 0.2 m/s on its whole way. Work between things that
    /// stand close together is slow, and a slow arm is where it should be.
    pub slow_m: f64,
    /// Between links that are not neighbours, and between a link and the carried object.
    pub self_m: f64,
}

impl Default for Margins {
    fn default() -> Self {
        Self {
            obstacle_m: 0.01,
            slow_m: 0.003,
            self_m: 0.004,
        }
    }
}

/// A margin that is no distance.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} is {value_m}, expected 0 to {MOST_M} m")]
pub struct MarginsError {
    name: &'static str,
    value_m: f64,
}

/// Larger margins than this are meant for other arms.
const MOST_M: f64 = 0.2;

/// A rigid object at the tip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Carried {
    /// What encloses it.
    pub shape: Shape,
    /// Pose of the shape in the frame of the suction tip (z points out of the tool).
    pub tip_from_shape: Isometry3<f64>,
    /// Whether it is the part at the cup of something long and thin, a cable: it yields to what it meets on the table, so that the heightmap is no
    /// obstacle to it.
    pub yields: bool,
}

impl Carried {
    /// Largest distance of its points from the tip's axis.
    pub fn radius_m(&self) -> f64 {
        self.tip_from_shape.translation.vector.xy().norm() + radius_m(&self.shape)
    }
}

/// Where contact is wanted: a descent ends here or a rise begins here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contact {
    /// Middle of a circle in the world's xy-plane.
    pub center_m: Point2<f64>,
    /// Its radius.
    pub radius_m: f64,
    /// The tool may touch what is in the circle and higher than this, ...
    pub above_m: f64,
    /// ... up to this height. A carried object may touch anything in it.
    pub up_to_m: f64,
}

impl Contact {
    /// Whether the tool may touch something of this height in the circle.
    fn allows(&self, height_m: f64) -> bool {
        height_m > self.above_m && height_m <= self.up_to_m
    }
}

/// What is there beside the cell, for one motion.
#[derive(Clone, Debug, Default)]
pub struct Scene<'a> {
    /// What stands on the table.
    pub terrain: Option<&'a Terrain>,
    /// What the gripper holds.
    pub carried: Option<Carried>,
    /// Where contact is wanted.
    pub contacts: Vec<Contact>,
}

/// A motion that keeps its margins.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Clearance {
    /// The least distance found, margins not subtracted; distances beyond 50 mm over the margin are not looked at closely.
    pub least_m: f64,
    /// Joint positions at which distances were computed.
    pub samples: usize,
}

/// A motion that must not be carried out.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "{} s after its start the motion brings {body} to {distance_m:.3} m from {obstacle}, expected {margin_m} m or more, with the joints at {joints}",
    time.as_secs_f64()
)]
pub struct Collision {
    /// Time from the start of the motion.
    pub time: Duration,
    /// The link, or "the carried object".
    pub body: String,
    /// The link or "the heightmap at (x, y)".
    pub obstacle: String,
    /// Distance of the two, 0 where they overlap.
    pub distance_m: f64,
    /// Distance to keep.
    pub margin_m: f64,
    /// Joint positions there, as text.
    pub joints: String,
}

/// Between samples nothing moves further than this, or than the distance left.
const RESOLUTION_M: f64 = 0.002;
/// A tip that is nowhere faster is slow.
const SLOW_M_S: f64 = 0.2;
/// Speeds are looked at in steps of this time.
const SPEED_TICK: Duration = Duration::from_millis(20);
/// Motions are looked at in steps of this time to know how far they go.
const TICK: Duration = Duration::from_micros(500);
/// Distances of more than this over the margin need not be known exactly.
const FAR_M: f64 = 0.05;
/// The same for the heightmap.
const LOOK_M: f64 = 0.02;
/// Columns of the heightmap reach down to here.
const BOTTOM_M: f64 = -0.05;
/// The link that carries the gripper.
const TOOL: usize = 5;

/// A shape on its carrier, ready for queries.
#[derive(Clone, Debug)]
struct Part {
    link: String,
    /// None: fixed in the world.
    carrier: Option<usize>,
    pose: Isometry3<f64>,
    shape: Shape,
    radius_m: f64,
}

/// Checks motions of the arm of a cell.
#[derive(Clone, Debug)]
pub struct CollisionChecker {
    arm: Arm,
    margins: Margins,
    moving: Vec<Part>,
    fixed: Vec<Part>,
    /// The link that the arm turns on: it counts as one of the arm's.
    base: String,
    /// For each joint, how far from its axis a point of arm or tool can be.
    reach_m: [f64; 6],
}

impl CollisionChecker {
    /// For the arm and the collision shapes of a cell.
    ///
    /// # Errors
    /// When a margin is negative, not finite or larger than 0.2 m.
    pub fn new(cell: &WorkCell, margins: Margins) -> Result<Self, MarginsError> {
        for (name, value_m) in [
            ("the margin to obstacles", margins.obstacle_m),
            ("the margin of slow motions", margins.slow_m),
            ("the margin between links", margins.self_m),
        ] {
            if !(0.0..=MOST_M).contains(&value_m) {
                return Err(MarginsError { name, value_m });
            }
        }
        let part = |body: &Body| Part {
            link: body.link.clone(),
            carrier: body.moving_link,
            pose: body.pose,
            shape: body.shape,
            radius_m: radius_m(&body.shape),
        };
        let (moving, fixed): (Vec<Part>, Vec<Part>) = cell
            .collisions
            .iter()
            .map(part)
            .partition(|part| part.carrier.is_some());
        let base = cell.frames.iter().find(|frame| frame.joint == Some(0));
        // From joint to joint, and from there to the end of the parts of each link.
        let arm = cell.arm.clone();
        let mut reach_m = [0.0; 6];
        let mut beyond_m = 0.0f64;
        for joint in (0..6).rev() {
            let parts = moving.iter().filter(|part| part.carrier == Some(joint));
            let ends = parts.map(|part| part.pose.translation.vector.norm() + part.radius_m);
            let own_m = ends.fold(beyond_m, f64::max);
            reach_m[joint] = own_m;
            beyond_m = own_m + arm.joint_origins()[joint].translation.vector.norm();
        }
        Ok(Self {
            arm,
            margins,
            moving,
            fixed,
            base: base.map_or_else(String::new, |frame| frame.parent.clone()),
            reach_m,
        })
    }

    /// The margins.
    pub fn margins(&self) -> Margins {
        self.margins
    }

    /// Largest distance of the tool from its own axis, below the flange.
    pub(crate) fn tool_radius_m(&self) -> f64 {
        let tool = self
            .moving
            .iter()
            .filter(|part| part.carrier == Some(TOOL) && part.pose.translation.z > 0.0);
        let across = tool.map(|part| {
            part.pose.translation.vector.xy().norm() + part.shape.extent_m(&Vector3::x())
        });
        across.fold(0.0, f64::max)
    }

    /// Whether the arm may follow a trajectory through a scene.
    ///
    /// # Errors
    /// The first collision on the way, margins included.
    pub fn check(
        &self,
        trajectory: &JointTrajectory,
        scene: &Scene<'_>,
    ) -> Result<Clearance, Box<Collision>> {
        let mut reach_m = self.reach_m;
        if let Some(carried) = &scene.carried {
            let tip_m = self.arm.flange_from_tip.translation.vector.norm();
            let end_m =
                tip_m + carried.tip_from_shape.translation.vector.norm() + radius_m(&carried.shape);
            let mut beyond_m = end_m;
            for joint in (0..6).rev() {
                reach_m[joint] = f64::max(reach_m[joint], beyond_m);
                beyond_m += self.arm.joint_origins()[joint].translation.vector.norm();
            }
        }
        let moved_m = |from: &Joints, to: &Joints| {
            (to - from)
                .iter()
                .zip(reach_m)
                .map(|(turn, reach_m)| turn.abs() * reach_m)
                .sum::<f64>()
        };
        let end = trajectory.duration();
        let mut sampler = trajectory.sampler();
        let near_m = match self.is_slow(trajectory) {
            true => self.margins.slow_m,
            false => self.margins.obstacle_m,
        };
        let mut clearance = Clearance {
            least_m: f64::INFINITY,
            samples: 0,
        };
        let mut last = sampler.state(Duration::ZERO).positions_rad;
        let mut left_m = self.sample(&last, Duration::ZERO, scene, near_m, &mut clearance)?;
        let mut previous = (Duration::ZERO, last);
        let mut time = Duration::ZERO;
        while time < end {
            time = (time + TICK).min(end);
            let joints = sampler.state(time).positions_rad;
            if moved_m(&last, &joints) > left_m.max(RESOLUTION_M) {
                // The tick before is as far as the distance reached, or this one where it was the last sample.
                let (at, sampled) = if previous.1 == last {
                    (time, joints)
                } else {
                    previous
                };
                left_m = self.sample(&sampled, at, scene, near_m, &mut clearance)?;
                last = sampled;
                if moved_m(&last, &joints) > left_m.max(RESOLUTION_M) {
                    left_m = self.sample(&joints, time, scene, near_m, &mut clearance)?;
                    last = joints;
                }
            }
            previous = (time, joints);
        }
        if previous.1 != last {
            self.sample(&previous.1, previous.0, scene, near_m, &mut clearance)?;
        }
        Ok(clearance)
    }

    /// Whether the tip is nowhere faster than [`SLOW_M_S`].
    fn is_slow(&self, trajectory: &JointTrajectory) -> bool {
        let mut sampler = trajectory.sampler();
        let mut tip_m = |time| {
            let joints = sampler.state(time).positions_rad;
            self.arm.tip(&joints).translation.vector
        };
        let mut before = (Duration::ZERO, tip_m(Duration::ZERO));
        while before.0 < trajectory.duration() {
            let time = (before.0 + SPEED_TICK).min(trajectory.duration());
            let here_m = tip_m(time);
            // A little more for rounding.
            let most_m = 1.001 * SLOW_M_S * (time - before.0).as_secs_f64();
            if (here_m - before.1).norm() > most_m {
                return false;
            }
            before = (time, here_m);
        }
        true
    }

    /// Checks one joint position; how far everything is from its margin. `near_m`: the margin of tool and carried object from the heightmap.
    fn sample(
        &self,
        joints: &Joints,
        time: Duration,
        scene: &Scene<'_>,
        near_m: f64,
        clearance: &mut Clearance,
    ) -> Result<f64, Box<Collision>> {
        clearance.samples += 1;
        let links = self.arm.links(joints);
        let tip = links[TOOL] * self.arm.flange_from_tip;
        let collision = |body: &str, obstacle: String, distance_m: f64, margin_m: f64| {
            Box::new(Collision {
                time,
                body: body.into(),
                obstacle,
                distance_m,
                margin_m,
                joints: joints_text(joints),
            })
        };
        let mut left_m = f64::INFINITY;
        let mut count = |distance_m: f64, margin_m: f64| {
            clearance.least_m = clearance.least_m.min(distance_m);
            left_m = left_m.min(distance_m - margin_m);
            distance_m >= margin_m
        };
        let posed: Vec<(&Part, Isometry3<f64>)> = self
            .moving
            .iter()
            .map(|part| {
                let carrier = part.carrier.unwrap_or(0);
                (part, links[carrier] * part.pose)
            })
            .collect();
        let held = scene.carried.map(|carried| {
            let part = Part {
                link: "the carried object".into(),
                carrier: None,
                pose: Isometry3::identity(),
                radius_m: radius_m(&carried.shape),
                shape: carried.shape,
            };
            (part, tip * carried.tip_from_shape)
        });
        let held = held.as_ref().map(|(part, pose)| (part, *pose));
        for (part, pose) in posed.iter().copied().chain(held) {
            let touches = part.carrier.is_none();
            for other in &self.fixed {
                let is_base = other.link == self.base;
                // The base and the first link touch by design.
                if part.carrier == Some(0) && is_base {
                    continue;
                }
                let margin_m = match is_base && !touches {
                    true => self.margins.self_m,
                    false => self.margins.obstacle_m,
                };
                if touches || part.carrier == Some(TOOL) {
                    let top_m = other.pose.translation.z
                        + other
                            .shape
                            .extent_m(&other.pose.inverse_transform_vector(&Vector3::z()));
                    let here = Point2::from(pose.translation.vector.xy());
                    if scene.contacts.iter().any(|contact| {
                        (here - contact.center_m).norm() <= contact.radius_m
                            && (touches || contact.allows(top_m))
                    }) {
                        continue;
                    }
                }
                let distance_m = distance_m((part, &pose), (other, &other.pose), margin_m);
                if !count(distance_m, margin_m) {
                    return Err(collision(
                        &part.link,
                        other.link.clone(),
                        distance_m,
                        margin_m,
                    ));
                }
            }
            let yields = touches && scene.carried.is_some_and(|carried| carried.yields);
            if let Some(terrain) = scene.terrain.filter(|_| !yields) {
                let most_m = self.margins.obstacle_m.max(self.margins.slow_m);
                let is_tool = touches || part.carrier == Some(TOOL);
                let found = terrain_clearance(part, &pose, terrain, most_m, |at, height_m| {
                    if !is_tool {
                        return Some(self.margins.obstacle_m);
                    }
                    let mut here = scene
                        .contacts
                        .iter()
                        .filter(|contact| (at - contact.center_m).norm() <= contact.radius_m)
                        .peekable();
                    // Beside a contact the tool goes straight down or up.
                    let margin_m = match here.peek() {
                        Some(_) => near_m.min(self.margins.slow_m),
                        None => near_m,
                    };
                    let touch = here.any(|contact| touches || contact.allows(height_m));
                    (!touch).then_some(margin_m)
                });
                let (distance_m, margin_m) = (found.distance_m, found.margin_m);
                if !count(distance_m, margin_m) {
                    let (x, y) = (found.at.x, found.at.y);
                    let obstacle = format!("the heightmap at ({x:.3}, {y:.3})");
                    return Err(collision(&part.link, obstacle, distance_m, margin_m));
                }
            }
        }
        let margin_m = self.margins.self_m;
        for (i, (part, pose)) in posed.iter().enumerate() {
            // Neighbours touch by design; so do the gripper and what it holds, and the last wrist is beside that.
            let others = posed[..i]
                .iter()
                .copied()
                .filter(|(other, _)| {
                    part.carrier
                        .unwrap_or(0)
                        .abs_diff(other.carrier.unwrap_or(0))
                        >= 2
                })
                .chain(held.filter(|_| part.carrier.unwrap_or(0) < TOOL - 1));
            for (other, other_pose) in others {
                let distance_m = distance_m((part, pose), (other, &other_pose), margin_m);
                if !count(distance_m, margin_m) {
                    return Err(collision(
                        &other.link,
                        part.link.clone(),
                        distance_m,
                        margin_m,
                    ));
                }
            }
        }
        Ok(left_m)
    }
}

/// Radius of a ball about the middle of a shape that holds all of it.
fn radius_m(shape: &Shape) -> f64 {
    match shape {
        Shape::Cuboid { size_m } => 0.5 * size_m.norm(),
        Shape::Cylinder { radius_m, length_m } => radius_m.hypot(0.5 * length_m),
        Shape::Sphere { radius_m } => *radius_m,
    }
}

/// Distance of two parts: exact near the margin, a lower bound further away.
fn distance_m(a: (&Part, &Isometry3<f64>), b: (&Part, &Isometry3<f64>), margin_m: f64) -> f64 {
    let bound = |(from, from_pose): (&Part, &Isometry3<f64>),
                 (to, to_pose): (&Part, &Isometry3<f64>)| {
        let center = Point3::from(from_pose.translation.vector);
        to.shape
            .distance_m(&to_pose.inverse_transform_point(&center))
            - from.radius_m
    };
    let least_m = bound(a, b).max(bound(b, a));
    if least_m > margin_m + FAR_M {
        return least_m;
    }
    exact_distance_m(a, b)
}

fn exact_distance_m(
    (a, a_pose): (&Part, &Isometry3<f64>),
    (b, b_pose): (&Part, &Isometry3<f64>),
) -> f64 {
    let (a_pose, a_shape) = prepared(a_pose, &a.shape);
    let (b_pose, b_shape) = prepared(b_pose, &b.shape);
    parry3d::query::distance(&a_pose, a_shape.as_shape(), &b_pose, b_shape.as_shape())
        .map_or(0.0, |found| f64::from(found.distance))
}

/// A shape of parry, on the stack.
enum Prepared {
    Cuboid(Cuboid),
    Cylinder(Cylinder),
    Ball(Ball),
}

impl Prepared {
    fn as_shape(&self) -> &dyn parry3d::shape::Shape {
        match self {
            Self::Cuboid(shape) => shape,
            Self::Cylinder(shape) => shape,
            Self::Ball(shape) => shape,
        }
    }
}

fn prepared(pose: &Isometry3<f64>, shape: &Shape) -> (Pose, Prepared) {
    let vector = |v: Vector3<f64>| Vector::new(v.x as f32, v.y as f32, v.z as f32);
    let prepared = match *shape {
        Shape::Cuboid { size_m } => Prepared::Cuboid(Cuboid::new(vector(0.5 * size_m))),
        Shape::Cylinder { radius_m, length_m } => {
            Prepared::Cylinder(Cylinder::new((0.5 * length_m) as f32, radius_m as f32))
        }
        Shape::Sphere { radius_m } => Prepared::Ball(Ball::new(radius_m as f32)),
    };
    // Cylinders of parry lie along y, ours along z.
    let mut rotation = pose.rotation;
    if matches!(shape, Shape::Cylinder { .. }) {
        rotation *= nalgebra::UnitQuaternion::from_axis_angle(
            &Vector3::x_axis(),
            std::f64::consts::FRAC_PI_2,
        );
    }
    let q = rotation.coords.cast::<f32>();
    let rotation = Rotation::from_xyzw(q.x, q.y, q.z, q.w).normalize();
    (
        Pose::from_parts(vector(pose.translation.vector), rotation),
        prepared,
    )
}

/// How near a part is to a terrain.
struct TerrainClearance {
    distance_m: f64,
    margin_m: f64,
    /// Where the terrain is nearest its margin.
    at: Point2<f64>,
}

impl TerrainClearance {
    fn left_m(&self) -> f64 {
        self.distance_m - self.margin_m
    }
}

/// Where the columns of a terrain leave a part the least over the margin that each has, which is `most_m` or less. Columns without a margin are left
/// out; what leaves more than [`LOOK_M`] is not looked at.
fn terrain_clearance(
    part: &Part,
    pose: &Isometry3<f64>,
    terrain: &Terrain,
    most_m: f64,
    margin_m: impl Fn(Point2<f64>, f64) -> Option<f64>,
) -> TerrainClearance {
    let center = pose.translation.vector;
    let extent = Vector3::from_fn(|axis, _| {
        let along = pose.inverse_transform_vector(&Vector3::ith(axis, 1.0));
        part.shape.extent_m(&along)
    });
    let lowest_m = center.z - extent.z;
    let far = |distance_m| TerrainClearance {
        distance_m,
        margin_m: 0.0,
        at: Point2::from(center.xy()),
    };
    let over_all_m = lowest_m - terrain.highest_m();
    if over_all_m > most_m + LOOK_M {
        return far(over_all_m - most_m);
    }
    let look_at = |columns: &mut dyn Iterator<Item = Column>| {
        let mut nearest = far(LOOK_M);
        for Column {
            at,
            size_m,
            height_m,
        } in columns
        {
            let beside = (at.coords - center.xy()).abs() - extent.xy();
            let beside = beside
                .add_scalar(-0.5 * size_m)
                .sup(&nalgebra::Vector2::zeros());
            let above_m = (lowest_m - height_m).max(0.0);
            let bound_m = beside.norm().hypot(above_m);
            if bound_m - most_m >= nearest.left_m() {
                continue;
            }
            let Some(margin_m) = margin_m(at, height_m) else {
                continue;
            };
            let length_m = (height_m - BOTTOM_M).max(1e-3);
            let column = Part {
                link: String::new(),
                carrier: None,
                pose: Isometry3::identity(),
                shape: Shape::Cuboid {
                    size_m: Vector3::new(size_m, size_m, length_m),
                },
                radius_m: 0.0,
            };
            let column_pose = Isometry3::translation(at.x, at.y, height_m - 0.5 * length_m);
            let distance_m = exact_distance_m((part, pose), (&column, &column_pose));
            if distance_m - margin_m < nearest.left_m() {
                nearest = TerrainClearance {
                    distance_m,
                    margin_m,
                    at,
                };
            }
        }
        nearest
    };
    let around = extent.xy().add_scalar(most_m + LOOK_M);
    let middle = Point2::from(center.xy());
    let (low, high) = (middle - around, middle + around);
    let nearest = look_at(&mut terrain.columns(low, high));
    if nearest.left_m() >= 0.0 {
        return nearest;
    }
    // Too near by the columns, which are wider than what was seen: by its cells.
    look_at(&mut terrain.cells(low, high))
}
