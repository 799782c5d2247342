//! Compliant, force-limited suction.
//!
//! The arm moves a kinematic head; a light dynamic tip follows it on springs of limited force. A
//! rigid tip that over-pulls a cable would open the cable's joints and drag beads through pegs.

use super::convert::to_pose;
use super::{BodyId, CONTACT_DISTANCE_M, World};
use nalgebra::Isometry3;
use rapier3d::prelude::{
    ColliderBuilder, ColliderHandle, FixedJointBuilder, GenericJointBuilder, Group,
    ImpulseJointHandle, InteractionGroups, JointAxesMask, JointAxis, MassProperties, MotorModel,
    PhysicsWorld, Pose, RigidBodyBuilder, RigidBodyHandle, Vector,
};

/// Half of the width and of the length of the tool's end, a box because the engine's contacts of
/// boxes are the steadiest. Long, or a cable could lie down on top of it.
const TIP_HALF_M: (f32, f32) = (0.004, 0.035);
const TIP_MASS_KG: f32 = 0.1;
const TIP_INERTIA_KG_M2: f32 = 1e-4;
const STIFFNESS_N_M: f32 = 3158.0;
const DAMPING_N_S_M: f32 = 50.0;
/// Force limit while nothing is held.
const EMPTY_FORCE_N: f32 = 5.0;
/// A tip pushed this far back into the tool counts as contact, whatever pushes: a held bead may
/// come down on its own neighbour.
const PUSHED_BACK_M: f32 = 3e-3;
/// After a release the tool collides again when it has left the place by this much: a cable may
/// lie round it.
const LEFT_M: f32 = 0.03;
/// How far the cup reaches when suction goes on: it may have bounced a little.
const GRASP_DISTANCE_M: f32 = 1e-3;
const LINEAR: [JointAxis; 3] = [JointAxis::LinX, JointAxis::LinY, JointAxis::LinZ];

#[derive(Clone)]
pub(super) struct Suction {
    head: RigidBodyHandle,
    tip: RigidBodyHandle,
    tip_collider: ColliderHandle,
    spring: ImpulseJointHandle,
    grip: Option<Grip>,
    /// Where something was released that the tool may still be among.
    released_at: Option<Vector>,
}

#[derive(Clone)]
struct Grip {
    joint: ImpulseJointHandle,
    body: BodyId,
    /// As gripped.
    held_from_tip: Pose,
}

impl Suction {
    pub(super) fn new(physics: &mut PhysicsWorld, tip: &Isometry3<f64>) -> Self {
        let pose = to_pose(tip);
        let head = physics.insert_body(RigidBodyBuilder::kinematic_position_based().pose(pose));
        let inertia = Vector::splat(TIP_INERTIA_KG_M2);
        let body = RigidBodyBuilder::dynamic()
            .pose(pose)
            .additional_mass_properties(MassProperties::new(Vector::ZERO, TIP_MASS_KG, inertia))
            .gravity_scale(0.0)
            // A moving kinematic body does not wake what is joined to it.
            .can_sleep(false);
        // From the tip's frame back into the tool.
        let (half_width, half_height) = TIP_HALF_M;
        let cup = ColliderBuilder::cuboid(half_width, half_width, half_height)
            .translation(Vector::new(0.0, 0.0, -half_height))
            .density(0.0)
            .friction(0.5);
        let (tip, tip_collider) = physics.insert(body, cup);
        let mut spring = GenericJointBuilder::new(JointAxesMask::ANG_AXES).contacts_enabled(false);
        for axis in LINEAR {
            spring = spring
                .motor_model(axis, MotorModel::ForceBased)
                .motor_position(axis, 0.0, STIFFNESS_N_M, DAMPING_N_S_M)
                .motor_max_force(axis, EMPTY_FORCE_N);
        }
        let spring = physics
            .impulse_joints
            .insert(head, tip, spring.build(), true);
        Self {
            head,
            tip,
            tip_collider,
            spring,
            grip: None,
            released_at: None,
        }
    }

    /// Where the arm brings the head by the end of the next step.
    pub(super) fn lead(&mut self, physics: &mut PhysicsWorld, tip: &Isometry3<f64>) {
        let pose = to_pose(tip);
        physics.bodies[self.head].set_next_kinematic_position(pose);
        if let Some(at) = self.released_at
            && (pose.translation - at).length() > LEFT_M
        {
            self.released_at = None;
            self.collide(physics, true);
        }
    }

    fn collide(&self, physics: &mut PhysicsWorld, collides: bool) {
        let groups = if collides {
            InteractionGroups::all()
        } else {
            InteractionGroups::all().with_filter(Group::NONE)
        };
        physics.colliders[self.tip_collider].set_collision_groups(groups);
    }

    fn limit_force(&self, physics: &mut PhysicsWorld, newton: f32) {
        if let Some(joint) = physics.impulse_joints.get_mut(self.spring, true) {
            for axis in LINEAR {
                joint.data.set_motor_max_force(axis, newton);
            }
        }
    }
}

/// Suction.
impl World {
    /// Switches suction on: grips the nearest free body in touch with the tip, if there is one.
    pub fn grasp(&mut self) -> bool {
        if self.suction.grip.is_some() {
            return true;
        }
        let Some(body) = self.graspable() else {
            return false;
        };
        let handle = self.bodies[body.0].handle;
        let tip_pose = *self.physics.bodies[self.suction.tip].position();
        let held_from_tip = self.physics.bodies[handle].position().inv_mul(&tip_pose);
        let joint = FixedJointBuilder::new()
            .contacts_enabled(false)
            .local_frame2(held_from_tip)
            .build();
        let joint = self
            .physics
            .impulse_joints
            .insert(self.suction.tip, handle, joint, true);
        self.suction.grip = Some(Grip {
            joint,
            body,
            held_from_tip,
        });
        let force_n = self.bodies[body.0].suction_force_n;
        self.suction.limit_force(&mut self.physics, force_n);
        // What is held shields the cup.
        self.suction.released_at = None;
        self.suction.collide(&mut self.physics, false);
        true
    }

    /// Switches suction off.
    pub fn release(&mut self) {
        if let Some(grip) = self.suction.grip.take() {
            self.physics.impulse_joints.remove(grip.joint, true);
            self.suction.limit_force(&mut self.physics, EMPTY_FORCE_N);
            let head = self.physics.bodies[self.suction.head].translation();
            self.suction.released_at = Some(head);
        }
    }

    /// The body held.
    pub fn held(&self) -> Option<BodyId> {
        self.suction.grip.as_ref().map(|grip| grip.body)
    }

    /// Whether the tip touches something; while it holds a body, whether that body touches
    /// anything but the tip and the bodies joined to it, or pushes the tip back.
    pub fn touches(&self) -> bool {
        let head = self.physics.bodies[self.suction.head].position();
        let tip = self.physics.bodies[self.suction.tip].position();
        if head.inv_mul(tip).translation.z < -PUSHED_BACK_M {
            return true;
        }
        let (collider, held) = match &self.suction.grip {
            Some(grip) => {
                let body = &self.bodies[grip.body.0];
                (body.collider, Some(body.handle))
            }
            None => (self.suction.tip_collider, None),
        };
        let colliders = &self.physics.colliders;
        let near = self.physics.narrow_phase.contact_pairs_with(collider);
        near.filter(|pair| Self::distance_m(pair).is_some_and(|d| d < CONTACT_DISTANCE_M))
            .any(|pair| {
                let other = if pair.collider1 == collider {
                    pair.collider2
                } else {
                    pair.collider1
                };
                let other = colliders.get(other).and_then(|c| c.parent());
                match (held, other) {
                    (Some(held), Some(other)) => {
                        let joints = &self.physics.impulse_joints;
                        joints.joints_between(held, other).next().is_none()
                    }
                    _ => true,
                }
            })
    }

    /// How far what is held is turned away from how it was gripped.
    pub(super) fn twist_rad(&self) -> f64 {
        self.suction.grip.as_ref().map_or(0.0, |grip| {
            let held = self.physics.bodies[self.bodies[grip.body.0].handle].position();
            let tip = self.physics.bodies[self.suction.tip].position();
            let now = held.inv_mul(tip).rotation;
            now.angle_between(grip.held_from_tip.rotation).into()
        })
    }

    /// How far the tip is behind the head.
    pub fn lag_m(&self) -> f64 {
        let bodies = &self.physics.bodies;
        let lag = bodies[self.suction.head].translation() - bodies[self.suction.tip].translation();
        lag.length().into()
    }

    fn graspable(&self) -> Option<BodyId> {
        let near = self.bodies.iter().enumerate().filter(|(_, b)| !b.fixed);
        let near = near.filter_map(|(index, body)| {
            let pair = self
                .physics
                .narrow_phase
                .contact_pair(self.suction.tip_collider, body.collider)?;
            let distance = Self::distance_m(pair)?;
            (distance < GRASP_DISTANCE_M).then_some((distance, BodyId(index)))
        });
        near.min_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, body)| body)
    }
}
