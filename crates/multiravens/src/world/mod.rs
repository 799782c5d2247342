//! The physics of the table top: a Rapier world with the settings that small, light objects need.
//!
//! Lengths in metres, frame `world` (see [`heightmap`]). Nothing here knows an arm, a task or a
//! camera.

mod bead_chain;
mod convert;
mod suction;
#[cfg(test)]
mod tests;

pub use bead_chain::BeadChain;
pub use ur5::Shape;

use bead_chain::WHIP_M_S;
use convert::{from_point, from_pose, from_vector, to_pose};
use nalgebra::{Isometry3, Point3, Unit, Vector3};
use rapier3d::prelude::{
    ColliderBuilder, ColliderHandle, PhysicsWorld, Pose, RigidBodyBuilder, RigidBodyHandle,
    Rotation, SharedShape, SpringCoefficients, Vector,
};
use std::f32::consts::FRAC_PI_2;
use std::sync::Arc;
use std::time::Duration;
use suction::Suction;

/// Physics steps in a second of simulated time.
pub const STEPS_PER_SECOND: u32 = 480;

/// The engine's substeps of a step, and as many where a chain's joint gapes further than this, a
/// bead whips, or a held body is twisted further than this in the grip: the cable is pulled hard, or
/// hits something.
const SUBSTEPS: (usize, usize) = (4, 16);
const GAPING_M: f64 = 0.8e-3;
const TWISTED_RAD: f64 = 0.1;

/// Manifold points closer than this count as contact.
const CONTACT_DISTANCE_M: f32 = 0.2e-3;

/// What holds a body in place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mobility {
    /// Bolted to the table.
    Fixed,
    /// Free to move.
    Free {
        /// Mass.
        mass_kg: f64,
        /// What the suction cup pulls with at most while it holds the body.
        suction_force_n: f64,
    },
}

/// A body to add to the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    /// Geometry.
    pub shape: Shape,
    /// Pose of the shape's centre in the world.
    pub pose: Isometry3<f64>,
    /// Fixed or free.
    pub mobility: Mobility,
    /// Coulomb friction coefficient.
    pub friction: f64,
    /// Colour.
    pub rgb: [u8; 3],
}

/// A shape at its pose in the frame of its body.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Component {
    /// Geometry.
    pub shape: Shape,
    /// Pose of the shape's centre in the body's frame.
    pub pose: Isometry3<f64>,
}

impl From<Shape> for Component {
    fn from(shape: Shape) -> Self {
        Self {
            shape,
            pose: Isometry3::identity(),
        }
    }
}

/// A body of a [`World`], in the order in which bodies were added.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BodyId(usize);

/// A body as added.
#[derive(Clone, Debug)]
struct Body {
    handle: RigidBodyHandle,
    collider: ColliderHandle,
    components: Arc<[Component]>,
    rgb: [u8; 3],
    suction_force_n: f32,
    fixed: bool,
}

/// Bodies on a table whose top is z = 0, and a compliant suction tip.
///
/// A clone goes on exactly as the original would, bit for bit.
pub struct World {
    physics: PhysicsWorld,
    bodies: Vec<Body>,
    chains: Vec<BeadChain>,
    suction: Suction,
    steps: u64,
}

impl Clone for World {
    fn clone(&self) -> Self {
        let physics = &self.physics;
        Self {
            physics: PhysicsWorld {
                gravity: physics.gravity,
                integration_parameters: physics.integration_parameters,
                islands: physics.islands.clone(),
                broad_phase: physics.broad_phase.clone(),
                narrow_phase: physics.narrow_phase.clone(),
                bodies: physics.bodies.clone(),
                colliders: physics.colliders.clone(),
                impulse_joints: physics.impulse_joints.clone(),
                // The rest is room to work in, or unused.
                ..PhysicsWorld::default()
            },
            bodies: self.bodies.clone(),
            chains: self.chains.clone(),
            suction: self.suction.clone(),
            steps: self.steps,
        }
    }
}

impl World {
    /// An empty table, the suction tip at `tip` (see [`Self::step`]).
    pub fn new(tip: &Isometry3<f64>) -> Self {
        let mut physics = PhysicsWorld {
            gravity: Vector::new(0.0, 0.0, -9.81),
            ..PhysicsWorld::default()
        };
        let parameters = &mut physics.integration_parameters;
        parameters.dt = 1.0 / STEPS_PER_SECOND as f32;
        // Tolerances for objects of centimetres, not metres.
        parameters.length_unit = 0.1;
        // It would stop a fast bead at a peg while its neighbours go on, and tear the joints.
        parameters.max_ccd_substeps = 0;
        // Recycled contacts are stale by millimetres at this scale.
        parameters.contact_recycling = false;
        parameters.contact_softness = SpringCoefficients {
            natural_frequency: 60.0,
            damping_ratio: 10.0,
        };
        parameters.static_contact_softness = SpringCoefficients {
            natural_frequency: 120.0,
            damping_ratio: 10.0,
        };
        // A half-space: contacts with a box as large as the table are sometimes wrong by
        // millimetres in f32. What slips over the table's edge comes to rest beside it.
        let up = Unit::new_unchecked(Vector::Z);
        physics.insert_collider(ColliderBuilder::halfspace(up).friction(0.5), None);
        let suction = Suction::new(&mut physics, tip);
        Self {
            physics,
            bodies: Vec::new(),
            chains: Vec::new(),
            suction,
            steps: 0,
        }
    }

    /// Adds a body.
    pub fn add(&mut self, part: &Part) -> BodyId {
        self.add_compound(part, &[part.shape.into()])
    }

    /// Adds a rigid body like `part`, but made of several cuboids instead of its shape.
    pub fn add_compound(&mut self, part: &Part, components: &[Component]) -> BodyId {
        let (builder, suction_force_n) = match part.mobility {
            Mobility::Fixed => (RigidBodyBuilder::fixed(), 0.0),
            Mobility::Free {
                suction_force_n, ..
            } => (RigidBodyBuilder::dynamic(), suction_force_n as f32),
        };
        self.insert(part, components, builder, suction_force_n)
    }

    fn insert(
        &mut self,
        part: &Part,
        components: &[Component],
        builder: RigidBodyBuilder,
        suction_force_n: f32,
    ) -> BodyId {
        let free = part.mobility != Mobility::Fixed;
        let collider = match *components {
            [Component { shape, pose }] if pose == Isometry3::identity() => collider(&shape, free),
            _ => {
                let shapes = components.iter().map(|component| {
                    let shape = collider(&component.shape, free).shape;
                    (to_pose(&component.pose), shape)
                });
                ColliderBuilder::compound(shapes.collect())
            }
        };
        let collider = match part.mobility {
            Mobility::Fixed => collider,
            Mobility::Free { mass_kg, .. } => collider.mass(mass_kg as f32),
        };
        let (handle, collider) = self.physics.insert(
            builder.pose(to_pose(&part.pose)),
            collider.friction(part.friction as f32),
        );
        self.bodies.push(Body {
            handle,
            collider,
            components: components.into(),
            rgb: part.rgb,
            suction_force_n,
            fixed: !free,
        });
        BodyId(self.bodies.len() - 1)
    }

    /// All bodies, in the order in which they were added.
    pub fn bodies(&self) -> impl Iterator<Item = BodyId> + use<> {
        (0..self.bodies.len()).map(BodyId)
    }

    /// Pose of a body's centre.
    pub fn pose(&self, body: BodyId) -> Isometry3<f64> {
        from_pose(self.physics.bodies[self.bodies[body.0].handle].position())
    }

    /// Position of a body's centre.
    pub fn position(&self, body: BodyId) -> Point3<f64> {
        from_point(self.physics.bodies[self.bodies[body.0].handle].translation())
    }

    /// Geometry of a body; of one made of several shapes, that of the first.
    pub fn shape(&self, body: BodyId) -> Shape {
        self.bodies[body.0].components[0].shape
    }

    /// The shapes that a body is made of.
    pub fn components(&self, body: BodyId) -> &[Component] {
        &self.bodies[body.0].components
    }

    /// Whether a body is bolted to the table.
    pub fn is_fixed(&self, body: BodyId) -> bool {
        self.bodies[body.0].fixed
    }

    /// Colour of a body.
    pub fn rgb(&self, body: BodyId) -> [u8; 3] {
        self.bodies[body.0].rgb
    }

    /// Moves a body, at rest, to a pose: to set up a scene.
    pub fn place(&mut self, body: BodyId, pose: &Isometry3<f64>) {
        let body = &mut self.physics.bodies[self.bodies[body.0].handle];
        body.set_position(to_pose(pose), true);
        body.set_linvel(Vector::ZERO, true);
        body.set_angvel(Vector::ZERO, true);
    }

    /// Speed of the fastest free body, in m/s.
    pub fn fastest_m_s(&self) -> f64 {
        let speeds = self.bodies.iter().map(|body| {
            let body = &self.physics.bodies[body.handle];
            // A sleeping body rests, whatever its last velocity was.
            if body.is_sleeping() || body.is_fixed() {
                0.0
            } else {
                f64::from(body.linvel().length())
            }
        });
        speeds.fold(0.0, f64::max)
    }

    /// Velocity of a body's centre.
    pub fn velocity_m_s(&self, body: BodyId) -> Vector3<f64> {
        from_vector(self.physics.bodies[self.bodies[body.0].handle].linvel())
    }

    /// Whether a state became non-finite; the engine freezes such bodies.
    pub fn is_broken(&self) -> bool {
        !self.physics.quarantine().is_empty()
    }

    /// One step of 1 / [`STEPS_PER_SECOND`] while the arm puts the suction tip at `tip`, whose z
    /// points out of the tool.
    pub fn step(&mut self, tip: &Isometry3<f64>) {
        self.suction.lead(&mut self.physics, tip);
        self.physics.integration_parameters.num_solver_iterations = self.substeps();
        self.brake_fast_beads();
        self.physics.step();
        self.steps += 1;
    }

    /// Enough for the next step to keep the joints of chains together.
    ///
    /// More come by doubling: a substep closes a gap at once, the shorter it is the faster, and
    /// where all set in together beads were thrown at 2.4 m/s.
    fn substeps(&self) -> usize {
        let (usual, strained) = SUBSTEPS;
        let last = self.physics.integration_parameters.num_solver_iterations;
        let speed_m_s = self.fastest_bead_m_s();
        // What rests needs no look at its joints.
        let strains = speed_m_s > WHIP_M_S
            || self.twist_rad() > TWISTED_RAD
            || speed_m_s > 0.0 && self.widest_joint_error_m() > GAPING_M;
        if strains {
            (2 * last).clamp(usual, strained)
        } else {
            usual
        }
    }

    /// Simulated time.
    pub fn time(&self) -> Duration {
        time_of(self.steps)
    }

    /// FNV-1a over the bits of every body's pose and of the time: equal states, equal hashes.
    pub fn state_hash(&self) -> u64 {
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        let mut eat = |bytes: &[u8]| {
            for byte in bytes {
                hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
            }
        };
        eat(&self.steps.to_le_bytes());
        for body in &self.bodies {
            let pose = self.physics.bodies[body.handle].position();
            let (t, q) = (pose.translation, pose.rotation);
            for value in [t.x, t.y, t.z, q.x, q.y, q.z, q.w] {
                eat(&value.to_bits().to_le_bytes());
            }
        }
        hash
    }

    /// Distance of the nearest manifold point between two colliders, if they are near.
    fn distance_m(pair: &rapier3d::geometry::ContactPair) -> Option<f32> {
        let points = pair.manifolds().iter().flat_map(|m| &m.points);
        points.map(|point| point.dist).reduce(f32::min)
    }
}

fn collider(shape: &Shape, free: bool) -> ColliderBuilder {
    match *shape {
        Shape::Sphere { radius_m } => ColliderBuilder::ball(radius_m as f32),
        Shape::Cylinder { radius_m, length_m } if free => {
            disk(radius_m as f32, length_m as f32 / 2.0)
        }
        Shape::Cylinder { radius_m, length_m } => {
            // The engine's cylinders stand along y.
            ColliderBuilder::cylinder(length_m as f32 / 2.0, radius_m as f32)
                .rotation(Vector::new(FRAC_PI_2, 0.0, 0.0))
        }
        Shape::Cuboid { size_m } => {
            let half = size_m / 2.0;
            ColliderBuilder::cuboid(half.x as f32, half.y as f32, half.z as f32)
        }
    }
}

/// A cylinder as a regular prism of twelve sides, made of six boxes. The engine's own cylinder
/// never rests when it leans on something: its contacts jump between features.
fn disk(radius: f32, half_height: f32) -> ColliderBuilder {
    const BOXES: usize = 6;
    let step = std::f32::consts::PI / BOXES as f32;
    let (half_width, half_length) = (step / 2.0).sin_cos();
    let shape = SharedShape::cuboid(radius * half_length, radius * half_width, half_height);
    let boxes = (0..BOXES).map(|index| {
        let turn = Vector::new(0.0, 0.0, index as f32 * step);
        (
            Pose::from_rotation(Rotation::from_scaled_axis(turn)),
            shape.clone(),
        )
    });
    ColliderBuilder::compound(boxes.collect())
}

/// Duration of a number of physics steps.
pub(crate) fn time_of(steps: u64) -> Duration {
    let steps_per_second = u64::from(STEPS_PER_SECOND);
    let nanos = (steps % steps_per_second) * 1_000_000_000 / steps_per_second;
    Duration::new(steps / steps_per_second, nanos as u32)
}
