//! Forward and inverse kinematics.

use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Joint positions in rad: shoulder pan, shoulder lift, elbow, wrist 1, wrist 2, wrist 3.
pub type Joints = Vector6<f64>;

/// A tip pose that no joint position within limits reaches.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("no joint position within limits reaches the tip pose {tip}")]
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
    /// The arm's lengths.
    pub lengths: DhLengths,
    /// Joint limits, lower and upper.
    pub limits_rad: (Joints, Joints),
    /// Largest joint speed.
    pub max_speed_rad_s: Joints,
    /// Where the arm rests, out of the cameras' sight.
    pub home: Joints,
    /// Over the middle of the workspace, elbow up, tool down. The solutions nearest to it cover
    /// the workspace without a change of posture.
    pub ready: Joints,
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

impl Arm {
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
        let mut links = self.lengths.joint_origins();
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

    /// All joint positions in (-2 pi, 2 pi) that put the tip at `tip`, limits aside.
    ///
    /// Where wrist 1 and wrist 3 are parallel there are infinitely many; then wrist 3 is
    /// `wrist_3_rad` and wrist 1 does the rest.
    pub fn solutions(&self, tip: &Isometry3<f64>, wrist_3_rad: f64) -> Solutions {
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
        if radius.is_nan() || radius < d4 - REACH_ROUNDING_M || radius == 0.0 {
            return solutions;
        }
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
                if !(-1.0 - REACH_ROUNDING_M..=1.0 + REACH_ROUNDING_M).contains(&cosine) {
                    continue;
                }
                let cosine = cosine.clamp(-1.0, 1.0);
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
