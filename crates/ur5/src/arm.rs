//! Forward and inverse kinematics.

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Joint positions in rad: shoulder pan, shoulder lift, elbow, wrist 1, wrist 2, wrist 3.
pub type Joints = Vector6<f64>;

/// A pose for people, on one line: position and rotation vector.
pub(crate) fn pose_text(pose: &Isometry3<f64>) -> String {
    let (position_m, rotation_rad) = (pose.translation.vector, pose.rotation.scaled_axis());
    format!(
        "({:.4}, {:.4}, {:.4}) m, rotation vector ({:.4}, {:.4}, {:.4}) rad",
        position_m.x, position_m.y, position_m.z, rotation_rad.x, rotation_rad.y, rotation_rad.z
    )
}

/// Joint positions for people, on one line.
pub fn joints_text(joints_rad: &Joints) -> String {
    let positions = joints_rad.iter().map(|position| format!("{position:.4}"));
    format!("({}) rad", positions.collect::<Vec<_>>().join(", "))
}

/// A tip pose that no joint position within limits reaches.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "no joint position within limits reaches the tip pose {}",
    pose_text(tip)
)]
pub struct Unreachable {
    /// The pose asked for, in the world.
    pub tip: Isometry3<f64>,
}

/// The six lengths, in m, that make one UR arm differ from another (Denavit-Hartenberg; twist
/// angles pi/2, 0, 0, pi/2, -pi/2, 0).
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(missing_docs)]
pub struct DhLengths {
    pub d1_m: f64,
    pub a2_m: f64,
    pub a3_m: f64,
    pub d4_m: f64,
    pub d5_m: f64,
    pub d6_m: f64,
}

impl DhLengths {
    /// The published parameters of the UR5.
    pub const UR5: Self = Self {
        d1_m: 0.089159,
        a2_m: -0.425,
        a3_m: -0.39225,
        d4_m: 0.10915,
        d5_m: 0.09465,
        d6_m: 0.0823,
    };

    /// The published parameters of the UR3e.
    pub const UR3E: Self = Self {
        d1_m: 0.15185,
        a2_m: -0.24355,
        a3_m: -0.2132,
        d4_m: 0.13105,
        d5_m: 0.08535,
        d6_m: 0.0921,
    };

    /// The published parameters of the UR5e.
    pub const UR5E: Self = Self {
        d1_m: 0.1625,
        a2_m: -0.425,
        a3_m: -0.3922,
        d4_m: 0.1333,
        d5_m: 0.0997,
        d6_m: 0.0996,
    };

    /// The published parameters of the UR10e.
    pub const UR10E: Self = Self {
        d1_m: 0.1807,
        a2_m: -0.6127,
        a3_m: -0.57155,
        d4_m: 0.17415,
        d5_m: 0.11985,
        d6_m: 0.11655,
    };

    /// The arms whose parameters are known, by the names that the UR driver gives them (`ur_type`). Source: Universal Robots, "DH
    /// parameters for calculations of kinematics and dynamics".
    pub const MODELS: [(&'static str, Self); 4] = [
        ("ur3e", Self::UR3E),
        ("ur5", Self::UR5),
        ("ur5e", Self::UR5E),
        ("ur10e", Self::UR10E),
    ];

    /// The lengths that joint origins of a UR arm have, calibrated or not.
    pub fn of_origins(origins: &[Isometry3<f64>; 6]) -> Self {
        let at = |joint: usize| origins[joint].translation.vector;
        Self {
            d1_m: at(0).z,
            a2_m: at(2).x,
            a3_m: at(3).x,
            d4_m: at(3).z,
            d5_m: -at(4).y,
            d6_m: at(5).y,
        }
    }

    /// The largest difference of a length (m).
    pub fn difference_m(&self, other: &Self) -> f64 {
        let list = |lengths: &Self| {
            [
                lengths.d1_m,
                lengths.a2_m,
                lengths.a3_m,
                lengths.d4_m,
                lengths.d5_m,
                lengths.d6_m,
            ]
        };
        let pairs = list(self).into_iter().zip(list(other));
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    /// Name of the known arm whose lengths are nearest, if each is within 20 mm.
    pub fn model(&self) -> Option<&'static str> {
        let models = Self::MODELS.into_iter();
        let with_difference = models.map(|(name, lengths)| (self.difference_m(&lengths), name));
        let (difference_m, name) = with_difference.min_by(|a, b| a.0.total_cmp(&b.0))?;
        (difference_m < 0.02).then_some(name)
    }

    /// Pose of each joint's frame in the frame before it, at joint position zero. Each joint turns
    /// about the z of its frame. The last frame is the flange.
    pub fn joint_origins(&self) -> [Isometry3<f64>; 6] {
        let quarter =
            |turns: f64| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), turns * FRAC_PI_2);
        let origin =
            |x, y, z, turns| Isometry3::from_parts(Translation3::new(x, y, z), quarter(turns));
        [
            origin(0.0, 0.0, self.d1_m, 0.0),
            origin(0.0, 0.0, 0.0, 1.0),
            origin(self.a2_m, 0.0, 0.0, 0.0),
            origin(self.a3_m, 0.0, self.d4_m, 0.0),
            origin(0.0, -self.d5_m, 0.0, 1.0),
            origin(0.0, self.d6_m, 0.0, -1.0),
        ]
    }
}

/// The arm from its base in the world to the suction tip.
#[derive(Clone, Debug)]
pub struct Arm {
    /// Pose of the arm's kinematic base (`base_link_inertia`) in the world.
    pub world_from_base: Isometry3<f64>,
    /// Pose of the suction tip in the flange frame (tool0); the tip's z points out of the tool.
    pub flange_from_tip: Isometry3<f64>,
    /// Pose of each joint's frame in the frame before it, at joint position zero, as the URDF or the arm's calibration says.
    pub(crate) origins: [Isometry3<f64>; 6],
    /// Whether `origins` are those of `lengths`.
    pub(crate) nominal: bool,
    /// Lengths of the arm as built by drawing: those of the closed form.
    pub lengths: DhLengths,
    /// Joint limits, lower and upper.
    pub limits_rad: (Joints, Joints),
    /// Largest joint speed.
    pub max_speed_rad_s: Joints,
    /// Largest joint acceleration of planned motions. Universal Robots publishes none; see [`Self::DEFAULT_ACCELERATION_RAD_S2`].
    pub max_acceleration_rad_s2: Joints,
    /// Largest joint jerk of planned motions.
    pub max_jerk_rad_s3: Joints,
    /// Where the arm rests, out of the cameras' sight.
    pub home: Joints,
    /// Over the middle of the workspace, elbow up, tool down. The solutions nearest to it cover
    /// the workspace without a change of posture.
    pub ready: Joints,
}

/// Limits that cannot be set.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{name} is {value}, expected {expected}")]
pub struct LimitError {
    /// Name of the limit.
    pub name: &'static str,
    /// What it was.
    pub value: f64,
    /// What was expected.
    pub expected: String,
}

/// Up to eight joint positions.
#[derive(Clone, Copy, Debug)]
pub struct Solutions {
    found: [Joints; 8],
    count: usize,
}

impl std::ops::Deref for Solutions {
    type Target = [Joints];
    fn deref(&self) -> &[Joints] {
        &self.found[..self.count]
    }
}

/// How far, in m, a pose may lie outside the reach and still count as fully stretched: rounding.
const REACH_ROUNDING_M: f64 = 1e-10;
/// What wrist 3 counts in the distance between joint positions. Turning it moves nothing but the
/// tip about itself; at full weight a turn would be traded for another posture of the whole arm.
const WRIST_3_WEIGHT: f64 = 0.1;
/// Sine of wrist 2 below which the axes of wrist 1 and wrist 3 count as parallel.
const WRIST_SINGULAR: f64 = 1e-9;
/// How far, in m, a calibrated arm may reach beyond the arm of the drawing, as seeds of the refinement are concerned.
const CALIBRATED_SLACK_M: f64 = 0.02;
/// Refinement ends when tip (m) and its orientation (rad) are this near; a solution must be within the second number.
const REFINED: f64 = 1e-11;
const REFINED_ENOUGH: f64 = 1e-6;
/// A refinement that turns a joint further has left its solution for another.
const REFINED_TURN_RAD: f64 = 1.0;
const REFINEMENTS: usize = 40;

impl Arm {
    /// Joint acceleration of planned motions where nothing else is set: above what the fastest transfers of the demonstrations need (22
    /// rad/s^2), so that they stay as recorded. A real arm gets less, by [`Self::set_motion_limits`]: `config/real_cell.yaml`.
    pub const DEFAULT_ACCELERATION_RAD_S2: f64 = 25.0;
    /// Joint jerk of planned motions where nothing else is set.
    pub const DEFAULT_JERK_RAD_S3: f64 = 800.0;

    /// Pose of each joint's frame in the frame before it, at joint position zero. Each joint turns about the z of its frame.
    pub fn joint_origins(&self) -> &[Isometry3<f64>; 6] {
        &self.origins
    }

    /// The same arm with other lengths, uncalibrated: to see whether joint positions are those of another model.
    pub fn with_lengths(&self, lengths: DhLengths) -> Self {
        Self {
            origins: lengths.joint_origins(),
            nominal: true,
            lengths,
            ..self.clone()
        }
    }

    /// Whether the joints sit as the drawing of the arm says, so that the closed form is the whole solution.
    pub fn is_nominal(&self) -> bool {
        self.nominal
    }

    /// Limits acceleration and jerk of all joints in planned motions.
    ///
    /// # Errors
    /// When one is not positive.
    pub fn set_motion_limits(
        &mut self,
        acceleration_rad_s2: f64,
        jerk_rad_s3: f64,
    ) -> Result<(), LimitError> {
        for (name, value) in [
            ("the joint acceleration (rad/s^2)", acceleration_rad_s2),
            ("the joint jerk (rad/s^3)", jerk_rad_s3),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                let expected = "more than 0".into();
                return Err(LimitError {
                    name,
                    value,
                    expected,
                });
            }
        }
        self.max_acceleration_rad_s2 = Joints::repeat(acceleration_rad_s2);
        self.max_jerk_rad_s3 = Joints::repeat(jerk_rad_s3);
        Ok(())
    }

    /// Keeps wrist 3 within so much of its home position (rad), both ways, as a hose or a cable along the arm allows.
    ///
    /// # Errors
    /// When the turn is not at least half a circle: less would leave poses without a solution.
    pub fn set_hose_limit(&mut self, turn_rad: f64) -> Result<(), LimitError> {
        if !(turn_rad >= PI && turn_rad.is_finite()) {
            return Err(LimitError {
                name: "the turn of wrist 3 that the hose allows (rad)",
                value: turn_rad,
                expected: format!("{PI:.4} or more"),
            });
        }
        let (lower, upper) = &mut self.limits_rad;
        lower[5] = lower[5].max(self.home[5] - turn_rad);
        upper[5] = upper[5].min(self.home[5] + turn_rad);
        Ok(())
    }

    /// The pose of the tip that points straight down at height `z_m` over a planar pose: z down,
    /// turned by the pose's yaw about the world's z.
    pub fn tip_down(pose: &nalgebra::Isometry2<f64>, z_m: f64) -> Isometry3<f64> {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI);
        let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), pose.rotation.angle());
        let at = Translation3::new(pose.translation.x, pose.translation.y, z_m);
        Isometry3::from_parts(at, yaw * down)
    }

    /// Poses in the world of the six moving links, shoulder to flange.
    pub fn links(&self, joints: &Joints) -> [Isometry3<f64>; 6] {
        let mut pose = self.world_from_base;
        let mut links = self.origins;
        for (link, angle) in links.iter_mut().zip(joints.iter()) {
            pose = pose * *link * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), *angle);
            *link = pose;
        }
        links
    }

    /// Pose of the suction tip in the world.
    pub fn tip(&self, joints: &Joints) -> Isometry3<f64> {
        self.links(joints)[5] * self.flange_from_tip
    }

    /// Velocity of the tip in the world (linear, then angular) per joint velocity.
    pub fn jacobian(&self, joints: &Joints) -> Matrix6<f64> {
        let links = self.links(joints);
        let tip = (links[5] * self.flange_from_tip).translation.vector;
        let mut jacobian = Matrix6::zeros();
        for (i, link) in links.iter().enumerate() {
            let axis = link.rotation * Vector3::z();
            let linear = axis.cross(&(tip - link.translation.vector));
            jacobian.fixed_view_mut::<3, 1>(0, i).copy_from(&linear);
            jacobian.fixed_view_mut::<3, 1>(3, i).copy_from(&axis);
        }
        jacobian
    }

    /// Whether every joint is finite and within its limits.
    pub fn within_limits(&self, joints: &Joints) -> bool {
        let (lower, upper) = &self.limits_rad;
        // Not a number fails both comparisons.
        (0..6).all(|i| joints[i] >= lower[i] && joints[i] <= upper[i])
    }

    /// Up to eight joint positions in (-2 pi, 2 pi) that put the tip at `tip`, limits aside.
    ///
    /// The closed form solves the arm of the drawing. For a calibrated arm each of its solutions is refined by Newton's method until
    /// the tip is within 1e-6 m and rad; those that cannot be are left out.
    ///
    /// Where wrist 1 and wrist 3 are parallel there are infinitely many; then wrist 3 is
    /// `wrist_3_rad`, or near it, and wrist 1 does the rest.
    pub fn solutions(&self, tip: &Isometry3<f64>, wrist_3_rad: f64) -> Solutions {
        if self.nominal {
            return self.closed_form(tip, wrist_3_rad, REACH_ROUNDING_M);
        }
        let mut solutions = Solutions {
            found: [Joints::zeros(); 8],
            count: 0,
        };
        for seed in self
            .closed_form(tip, wrist_3_rad, CALIBRATED_SLACK_M)
            .iter()
        {
            if let Some(joints) = self.refine(tip, seed) {
                solutions.found[solutions.count] = joints.map(|q| q % TAU);
                solutions.count += 1;
            }
        }
        solutions
    }

    /// The joint position near a seed that puts the tip at `tip`, by Newton's method, damped where it would go astray.
    fn refine(&self, tip: &Isometry3<f64>, seed: &Joints) -> Option<Joints> {
        let error = |joints: &Joints| {
            let present = self.tip(joints);
            let shift = tip.translation.vector - present.translation.vector;
            let turn = (tip.rotation * present.rotation.inverse()).scaled_axis();
            Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z)
        };
        let (mut joints, mut damping) = (*seed, 1e-9);
        let mut off = error(&joints);
        for _ in 0..REFINEMENTS {
            if off.amax() < REFINED {
                break;
            }
            let jacobian = self.jacobian(&joints);
            let normal = jacobian.transpose() * jacobian + Matrix6::identity() * damping;
            let step = normal.cholesky()?.solve(&(jacobian.transpose() * off));
            let next = joints + step;
            let next_off = error(&next);
            // Not a number fails the comparison.
            if next_off.norm() < off.norm() {
                (joints, off) = (next, next_off);
                damping = (damping * 0.1).max(1e-12);
            } else {
                damping *= 100.0;
            }
        }
        (off.amax() < REFINED_ENOUGH && (joints - seed).amax() < REFINED_TURN_RAD).then_some(joints)
    }

    /// The solutions of the arm of the drawing; a pose up to `slack_m` out of its reach counts as fully stretched.
    fn closed_form(&self, tip: &Isometry3<f64>, wrist_3_rad: f64, slack_m: f64) -> Solutions {
        let DhLengths {
            d1_m: d1,
            a2_m: a2,
            a3_m: a3,
            d4_m: d4,
            d5_m: d5,
            d6_m: d6,
        } = self.lengths;
        let mut solutions = Solutions {
            found: [Joints::zeros(); 8],
            count: 0,
        };
        let flange = self
            .world_from_base
            .inv_mul(&(tip * self.flange_from_tip.inverse()));
        let turn = flange.rotation.to_rotation_matrix();
        let turn = turn.matrix();
        // Where wrist 2's axis meets wrist 3's. It lies d4 off the plane that the upper arm, the
        // forearm and the base's axis span.
        let wrist = flange.translation.vector - d6 * turn.column(2);
        let radius = wrist.x.hypot(wrist.y);
        if radius.is_nan() || radius < d4 - slack_m || radius == 0.0 {
            return solutions;
        }
        // Rounding counts in the cosine as in the reach; a longer slack in m.
        let cosine_slack = if self.nominal {
            slack_m
        } else {
            slack_m * (a2.abs() + a3.abs()) / (a2 * a3).abs()
        };
        let bearing = wrist.y.atan2(wrist.x);
        let offset = (d4 / radius).min(1.0).asin();
        for q1 in [bearing + offset, bearing + PI - offset] {
            let (s1, c1) = q1.sin_cos();
            // The axis of shoulder lift, elbow and wrist 1, seen from the flange.
            let axis = turn.transpose() * Vector3::new(s1, -c1, 0.0);
            let sine = axis.x.hypot(axis.y);
            for sign in [1.0, -1.0] {
                let q5 = (sign * sine).atan2(axis.z);
                let q6 = if sine < WRIST_SINGULAR {
                    wrist_3_rad
                } else {
                    (-sign * axis.y).atan2(sign * axis.x)
                };
                let (s6, c6) = q6.sin_cos();
                let wrist_2_axis = turn * Vector3::new(-s6, -c6, 0.0);
                let pitch = (wrist_2_axis.x * c1 + wrist_2_axis.y * s1).atan2(-wrist_2_axis.z);
                // Two-link arm in its plane.
                let end = wrist - d5 * wrist_2_axis;
                let (u, v) = (end.x * c1 + end.y * s1, end.z - d1);
                let cosine = (u * u + v * v - a2 * a2 - a3 * a3) / (2.0 * a2 * a3);
                if !(-1.0 - cosine_slack..=1.0 + cosine_slack).contains(&cosine) {
                    continue;
                }
                // A calibrated arm starts a little bent from where the drawing's is stretched out, or its two
                // solutions would start from one.
                let most = if self.nominal { 1.0 } else { 0.995 };
                let cosine = cosine.clamp(-most, most);
                let bend = (1.0 - cosine * cosine).sqrt().atan2(cosine);
                for q3 in [bend, -bend] {
                    let (s3, c3) = q3.sin_cos();
                    let q2 = v.atan2(u) - (a3 * s3).atan2(a2 + a3 * c3);
                    let joints = Joints::new(q1, q2, q3, pitch - q2 - q3, q5, q6);
                    solutions.found[solutions.count] = joints.map(|q| q % TAU);
                    solutions.count += 1;
                }
                // Both signs are the same where the sine is zero.
                if sine < WRIST_SINGULAR {
                    break;
                }
            }
        }
        solutions
    }

    /// The joint position within limits nearest to `near` that puts the tip at `tip`: least squares
    /// over the joints, whole turns included, wrist 3 counting a tenth.
    ///
    /// # Errors
    /// When there is none, or the pose or `near` is not finite.
    pub fn solve(&self, tip: &Isometry3<f64>, near: &Joints) -> Result<Joints, Unreachable> {
        let mut best: Option<(f64, Joints)> = None;
        for solution in self.solutions(tip, near[5]).iter() {
            let Some(joints) = self.unwrap_near(solution, near) else {
                continue;
            };
            let way = joints - near;
            let distance = way.fixed_rows::<5>(0).norm_squared() + WRIST_3_WEIGHT * way[5].powi(2);
            if best.is_none_or(|(least, _)| distance < least) && distance.is_finite() {
                best = Some((distance, joints));
            }
        }
        best.map(|(_, joints)| joints)
            .ok_or(Unreachable { tip: *tip })
    }

    /// The same position with each joint turned by whole turns to be nearest to `near` within
    /// limits, if there is one.
    fn unwrap_near(&self, joints: &Joints, near: &Joints) -> Option<Joints> {
        let (lower, upper) = &self.limits_rad;
        let mut unwrapped = *joints;
        for i in 0..6 {
            let q = &mut unwrapped[i];
            *q += TAU * ((near[i] - *q) / TAU).round();
            if *q > upper[i] {
                *q -= TAU * ((*q - upper[i]) / TAU).ceil();
            } else if *q < lower[i] {
                *q += TAU * ((lower[i] - *q) / TAU).ceil();
            }
        }
        self.within_limits(&unwrapped).then_some(unwrapped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::WorkCell;
    use nalgebra::Isometry2;
    use proptest::prelude::*;

    fn arm() -> Arm {
        WorkCell::builtin().unwrap().arm
    }

    fn joints() -> impl Strategy<Value = Joints> {
        prop::array::uniform6(-3.1..3.1f64).prop_map(|q| Joints::from_column_slice(&q))
    }

    fn assert_same_pose(a: &Isometry3<f64>, b: &Isometry3<f64>) -> Result<(), TestCaseError> {
        prop_assert!(
            (a.translation.vector - b.translation.vector).norm() < 1e-9,
            "{a} {b}"
        );
        prop_assert!(a.rotation.angle_to(&b.rotation) < 1e-7, "{a} {b}");
        let (a, b) = (
            a.rotation.to_rotation_matrix(),
            b.rotation.to_rotation_matrix(),
        );
        prop_assert!((a.matrix() - b.matrix()).norm() < 1e-9);
        Ok(())
    }

    /// Away from the places where two of the eight solutions meet.
    fn is_regular(q: &Joints, arm: &Arm) -> bool {
        let wrist = arm.links(q)[4].translation.vector;
        q[2].sin().abs() > 1e-3
            && q[4].sin().abs() > 1e-3
            && wrist.x.hypot(wrist.y) > arm.lengths.d4_m + 1e-3
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        #[test]
        fn every_solution_puts_the_tip_where_it_was_asked(q in joints()) {
            let arm = arm();
            let tip = arm.tip(&q);
            let solutions = arm.solutions(&tip, q[5]);
            prop_assert!(!solutions.is_empty());
            for solution in solutions.iter() {
                assert_same_pose(&arm.tip(solution), &tip)?;
            }
        }

        #[test]
        fn inverse_kinematics_recovers_the_joints(q in joints()) {
            let arm = arm();
            prop_assume!(is_regular(&q, &arm));
            let solved = arm.solve(&arm.tip(&q), &q).unwrap();
            prop_assert!((solved - q).amax() < 1e-7, "{q} {solved}");
        }

        #[test]
        fn whole_turns_are_kept_where_limits_allow(q in joints(), turned in 0usize..6) {
            let arm = arm();
            prop_assume!(is_regular(&q, &arm) && turned != 2);
            let mut near = q;
            near[turned] -= TAU * q[turned].signum();
            let solved = arm.solve(&arm.tip(&q), &near).unwrap();
            prop_assert!((solved - near).amax() < 1e-7, "{near} {solved}");
        }

        #[test]
        fn the_jacobian_is_the_derivative_of_the_tip(q in joints(), i in 0usize..6) {
            let arm = arm();
            let step = 1e-6;
            let (mut low, mut high) = (q, q);
            low[i] -= step;
            high[i] += step;
            let (low, high) = (arm.tip(&low), arm.tip(&high));
            let linear = (high.translation.vector - low.translation.vector) / (2.0 * step);
            let angular = (high.rotation * low.rotation.inverse()).scaled_axis() / (2.0 * step);
            let jacobian = arm.jacobian(&q);
            let column = jacobian.column(i);
            prop_assert!((column.fixed_rows::<3>(0) - linear).norm() < 1e-7);
            prop_assert!((column.fixed_rows::<3>(3) - angular).norm() < 1e-7);
        }
    }

    /// Origins off the drawing as factory calibrations are: some tenths of a millimetre and some milliradians each.
    fn calibrated(errors: &[f64; 36]) -> Arm {
        let mut arm = arm();
        for (joint, origin) in arm.origins.iter_mut().enumerate() {
            let part = |i: usize, scale: f64| scale * errors[6 * joint + i];
            let shift = Translation3::new(part(0, 1e-3), part(1, 1e-3), part(2, 1e-3));
            let turn = Vector3::new(part(3, 4e-3), part(4, 4e-3), part(5, 4e-3));
            let error = Isometry3::from_parts(shift, UnitQuaternion::from_scaled_axis(turn));
            *origin *= error;
        }
        arm.nominal = false;
        arm
    }

    fn errors() -> impl Strategy<Value = [f64; 36]> {
        prop::collection::vec(-1.0..1.0f64, 36).prop_map(|list| list.try_into().unwrap())
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]

        #[test]
        fn a_calibrated_arm_is_solved_to_a_micrometre(q in joints(), errors in errors()) {
            let arm = calibrated(&errors);
            // Nearer to a singular position the drawing may have none of its solutions.
            let wrist = arm.links(&q)[4].translation.vector;
            let is_far = wrist.x.hypot(wrist.y) > arm.lengths.d4_m + 0.02;
            prop_assume!(is_far && q[4].sin().abs() > 0.15 && q[2].sin().abs() > 0.15);
            let tip = arm.tip(&q);
            let solved = arm.solve(&tip, &q).unwrap();
            prop_assert!((solved - q).amax() < 1e-6, "{q} {solved}");
            for solution in arm.solutions(&tip, q[5]).iter() {
                let off = arm.tip(solution).inv_mul(&tip);
                prop_assert!(off.translation.vector.norm() < 1e-6 && off.rotation.angle() < 2e-6, "{off}");
            }
            // What the drawing says instead is off by what calibrations are made for.
            let mut nominal = arm.clone();
            nominal.origins = nominal.lengths.joint_origins();
            nominal.nominal = true;
            let off_m = nominal.solve(&tip, &q).map_or(1.0, |joints| (arm.tip(&joints).translation.vector - tip.translation.vector).norm());
            prop_assert!(off_m > 1e-6, "{off_m}");
        }

        #[test]
        fn over_the_workspace_a_calibrated_arm_keeps_its_posture(
            x in 0.3..0.7f64, y in -0.4..0.4f64, yaw in -1.5..1.5f64, errors in errors(),
        ) {
            let (arm, calibrated) = (arm(), calibrated(&errors));
            let tip = Arm::tip_down(&Isometry2::new(nalgebra::Vector2::new(x, y), yaw), 0.05);
            let nominal = arm.solve(&tip, &arm.ready).unwrap();
            let solved = calibrated.solve(&tip, &arm.ready).unwrap();
            prop_assert!((solved - nominal).amax() < 0.1, "{solved} {nominal}");
            prop_assert!((calibrated.tip(&solved).translation.vector - tip.translation.vector).norm() < 1e-6);
        }

        #[test]
        fn a_hose_keeps_wrist_3_near_home_and_every_pose_in_reach(
            x in 0.3..0.7f64, y in -0.4..0.4f64, yaw in -3.1..3.1f64, near in joints(), turn in PI..5.0f64,
        ) {
            let mut arm = arm();
            let tip = Arm::tip_down(&Isometry2::new(nalgebra::Vector2::new(x, y), yaw), 0.05);
            arm.set_hose_limit(turn).unwrap();
            let solved = arm.solve(&tip, &near).unwrap();
            prop_assert!((solved[5] - arm.home[5]).abs() <= turn, "{}", solved[5]);
            prop_assert!((arm.tip(&solved).translation.vector - tip.translation.vector).norm() < 1e-9);
        }
    }

    #[test]
    fn limits_without_sense_are_refused_by_name() {
        let mut arm = arm();
        let before = arm.limits_rad;
        let error = arm.set_hose_limit(3.0).unwrap_err().to_string();
        assert!(
            error.contains("hose") && error.contains("3.1416"),
            "{error}"
        );
        assert!(arm.set_hose_limit(f64::NAN).is_err());
        assert_eq!(arm.limits_rad, before);
        let error = arm.set_motion_limits(0.0, 100.0).unwrap_err().to_string();
        assert!(error.contains("acceleration"), "{error}");
        let error = arm
            .set_motion_limits(5.0, f64::NAN)
            .unwrap_err()
            .to_string();
        assert!(error.contains("jerk"), "{error}");
        arm.set_motion_limits(5.0, 100.0).unwrap();
    }

    #[test]
    fn lengths_name_their_model() {
        for (name, lengths) in DhLengths::MODELS {
            assert_eq!(lengths.model(), Some(name));
            assert_eq!(DhLengths::of_origins(&lengths.joint_origins()), lengths);
        }
        let mut other = DhLengths::UR5;
        other.a2_m -= 0.05;
        assert_eq!(other.model(), None);
    }

    #[test]
    fn a_pose_beyond_the_reach_is_an_error_that_names_it() {
        let arm = arm();
        let far = Arm::tip_down(&Isometry2::new(nalgebra::Vector2::new(1.2, 0.0), 0.0), 0.1);
        let error = arm.solve(&far, &arm.home).unwrap_err();
        assert!(error.to_string().contains("1.2"), "{error}");
        // Inside the cylinder of radius d4 round the base's axis the wrist cannot go.
        let inside = Arm::tip_down(
            &Isometry2::new(nalgebra::Vector2::new(0.02, 0.02), 0.0),
            0.4,
        );
        assert!(arm.solve(&inside, &arm.home).is_err());
    }

    #[test]
    fn numbers_that_are_not_finite_are_an_error() {
        let arm = arm();
        let mut tip = arm.tip(&arm.home);
        tip.translation.x = f64::NAN;
        assert!(arm.solve(&tip, &arm.home).is_err());
        let mut near = arm.home;
        near[3] = f64::INFINITY;
        assert!(arm.solve(&arm.tip(&arm.home), &near).is_err());
    }

    #[test]
    fn with_parallel_wrist_axes_wrist_3_stays_where_it_is() {
        let arm = arm();
        for wrist_2 in [0.0, PI] {
            let q = Joints::new(0.3, -1.2, 1.4, -0.5, wrist_2, 0.7);
            let solved = arm.solve(&arm.tip(&q), &q).unwrap();
            assert!((solved - q).amax() < 1e-6, "{solved}");
        }
    }

    #[test]
    fn limits_exclude_solutions() {
        let mut arm = arm();
        let tip = arm.tip(&Joints::new(0.2, -1.5, 1.3, -1.2, -1.5, 0.0));
        for solution in arm.solutions(&tip, 0.0).iter() {
            let close = Joints::repeat(1e-6);
            arm.limits_rad = (solution - close, solution + close);
            assert!((arm.solve(&tip, &arm.home).unwrap() - solution).amax() < 1e-6);
        }
        arm.limits_rad = (Joints::repeat(3.0), Joints::repeat(3.1));
        assert!(arm.solve(&tip, &arm.home).is_err());
    }
}
