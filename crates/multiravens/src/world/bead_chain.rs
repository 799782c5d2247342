//! Chains of beads: cables and closed loops.

use super::convert::to_vector;
use super::{BodyId, Mobility, Part, Shape, World};
use nalgebra::{Isometry3, Point3, Vector3};
use rapier3d::prelude::{
    ImpulseJointHandle, RigidBodyBuilder, RigidBodyHandle, SphericalJointBuilder, Vector,
};

/// Radius of a bead.
pub const BEAD_RADIUS_M: f64 = 0.006;
/// Distance of neighbouring beads' centres (deformable-ravens).
pub const BEAD_PITCH_M: f64 = 0.01414;
const BEAD_MASS_KG: f64 = 0.01;
const BEAD_FRICTION: f64 = 0.4;
/// A held bead over-pulls its chain no harder than this.
const BEAD_SUCTION_FORCE_N: f64 = 2.5;
/// Without damping a chain jitters for seconds, or never rests.
const LINEAR_DAMPING: f32 = 1.0;
const ANGULAR_DAMPING: f32 = 5.0;
/// A bead above this speed is damped the more the faster it is, per second and m/s: a cable dragged
/// fast cracks like a whip, and nothing else in the engine takes that energy out.
pub(super) const WHIP_M_S: f64 = 0.6;
const WHIP_DAMPING: f64 = 400.0;

/// Beads on ball-and-socket joints.
#[derive(Clone, Debug)]
pub struct BeadChain {
    /// The beads in order.
    pub beads: Vec<BodyId>,
    /// Whether the last bead is joined to the first.
    pub closed: bool,
    joints: Vec<(ImpulseJointHandle, RigidBodyHandle, RigidBodyHandle)>,
}

impl World {
    /// Adds a chain whose beads lie at `centers`, neighbours [`BeadChain::PITCH_M`] apart.
    ///
    /// `anchored` fixes the first bead to the table. `rgb` gives the colour of each bead.
    pub fn add_bead_chain(
        &mut self,
        centers: &[Point3<f64>],
        closed: bool,
        anchored: bool,
        rgb: impl Fn(usize) -> [u8; 3],
    ) -> BeadChain {
        let beads: Vec<_> = centers
            .iter()
            .enumerate()
            .map(|(index, center)| {
                let fixed = anchored && index == 0;
                let mobility = if fixed {
                    Mobility::Fixed
                } else {
                    Mobility::Free {
                        mass_kg: BEAD_MASS_KG,
                        suction_force_n: BEAD_SUCTION_FORCE_N,
                    }
                };
                let part = Part {
                    shape: Shape::Sphere {
                        radius_m: BEAD_RADIUS_M,
                    },
                    pose: Isometry3::translation(center.x, center.y, center.z),
                    mobility,
                    friction: BEAD_FRICTION,
                    rgb: rgb(index),
                };
                let builder = if fixed {
                    RigidBodyBuilder::fixed()
                } else {
                    RigidBodyBuilder::dynamic()
                        .linear_damping(LINEAR_DAMPING)
                        .angular_damping(ANGULAR_DAMPING)
                };
                let components = [part.shape.into()];
                self.insert(&part, &components, builder, BEAD_SUCTION_FORCE_N as f32)
            })
            .collect();
        let links = if closed {
            beads.len()
        } else {
            beads.len().saturating_sub(1)
        };
        let joints = (0..links)
            .map(|index| {
                let (parent, child) = (beads[index], beads[(index + 1) % beads.len()]);
                let offset: Vector3<f64> = self.position(child) - self.position(parent);
                let (parent, child) = (self.bodies[parent.0].handle, self.bodies[child.0].handle);
                // Anchored at the child's centre and with contacts, so that neighbours cannot
                // fold onto each other.
                let joint = SphericalJointBuilder::new()
                    .local_anchor1(to_vector(&offset))
                    .local_anchor2(Vector::ZERO)
                    .contacts_enabled(true)
                    .build();
                let joint = self
                    .physics
                    .impulse_joints
                    .insert(parent, child, joint, true);
                (joint, parent, child)
            })
            .collect();
        let chain = BeadChain {
            beads,
            closed,
            joints,
        };
        self.chains.push(chain.clone());
        chain
    }

    /// Speed of the fastest bead of all chains; 0 when they sleep.
    pub(super) fn fastest_bead_m_s(&self) -> f64 {
        let beads = self.chains.iter().flat_map(|chain| &chain.beads);
        let speeds = beads.map(|bead| {
            let body = &self.physics.bodies[self.bodies[bead.0].handle];
            if body.is_sleeping() {
                0.0
            } else {
                f64::from(body.linvel().length())
            }
        });
        speeds.fold(0.0, f64::max)
    }

    /// Damps beads that whip.
    pub(super) fn brake_fast_beads(&mut self) {
        for bead in self.chains.iter().flat_map(|chain| &chain.beads) {
            let handle = self.bodies[bead.0].handle;
            let body = &self.physics.bodies[handle];
            let excess_m_s = (f64::from(body.linvel().length()) - WHIP_M_S).max(0.0);
            let damping = LINEAR_DAMPING + (WHIP_DAMPING * excess_m_s) as f32;
            if damping != body.linear_damping() && !body.is_fixed() {
                self.physics.bodies[handle].set_linear_damping(damping);
            }
        }
    }

    /// The widest gap of the joints of all chains.
    pub fn widest_joint_error_m(&self) -> f64 {
        let errors = self.chains.iter().map(|chain| self.joint_error_m(chain));
        errors.fold(0.0, f64::max)
    }

    /// The widest gap of a chain's joints: how far the solver lets it be torn apart.
    pub fn joint_error_m(&self, chain: &BeadChain) -> f64 {
        let gaps = chain.joints.iter().filter_map(|(joint, parent, child)| {
            let data = self.physics.impulse_joints.get(*joint)?.data;
            let bodies = &self.physics.bodies;
            let anchor1 = bodies[*parent]
                .position()
                .transform_point(data.local_anchor1());
            let anchor2 = bodies[*child]
                .position()
                .transform_point(data.local_anchor2());
            Some(f64::from((anchor1 - anchor2).length()))
        });
        gaps.fold(0.0, f64::max)
    }
}

impl BeadChain {
    /// Radius of a bead.
    pub const BEAD_RADIUS_M: f64 = BEAD_RADIUS_M;
    /// Distance of neighbouring beads' centres.
    pub const PITCH_M: f64 = BEAD_PITCH_M;
}
