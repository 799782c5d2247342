//! Time-parameterised joint trajectories.

use crate::arm::{joints_text, pose_text};
use crate::{Arm, Joints, Unreachable};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector6};
use std::f64::consts::TAU;
use std::time::Duration;

/// A joint position and velocity at a time from the start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrajectoryPoint {
    /// Time from the start.
    pub time: Duration,
    /// Joint positions.
    pub positions_rad: Joints,
    /// Joint velocities.
    pub velocities_rad_s: Joints,
}

/// Points in order of time; cubic Hermite in between, as the UR driver does.
///
/// Times are whole nanoseconds, so that a trajectory passes through
/// `trajectory_msgs/JointTrajectory` unchanged.
#[derive(Clone, Debug, PartialEq)]
pub struct JointTrajectory {
    points: Vec<TrajectoryPoint>,
}

/// A motion that cannot be planned, or a trajectory that is not one.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum PlanError {
    /// A pose on the way is out of reach.
    #[error(transparent)]
    Unreachable(#[from] Unreachable),
    /// The way leads through a singular position: joints would have to jump.
    #[error(
        "the straight way to {} is singular at joints {}",
        pose_text(tip),
        joints_text(joints)
    )]
    Singular { tip: Isometry3<f64>, joints: Joints },
    /// Empty, out of order, not finite, or beyond the joint limits.
    #[error("invalid trajectory: {0}")]
    Invalid(String),
}

/// Time between the points of a planned trajectory.
const STEP_S: f64 = 0.02;
/// A ramp spans some points at least, or the cubics between them would not show it.
const SHORTEST_RAMP_S: f64 = 5.0 * STEP_S;
/// A turn of the tip counts as the path of a point this far off its axis.
const LEVER_M: f64 = 0.1;
/// Largest joint acceleration of motions in joint space.
const JOINT_ACCELERATION_RAD_S2: f64 = 12.0;
/// A joint that moves further from one point to the next has jumped to another solution.
const JUMP_RAD: f64 = 0.5;
/// A line that joint speeds stretch by more than this is as good as singular.
const MOST_STRETCH: f64 = 50.0;

/// Rest to rest with smooth acceleration: ramps whose acceleration is a raised cosine, so that
/// the jerk is continuous too, and a cruise in between.
struct SCurve {
    distance: f64,
    peak: f64,
    ramp_s: f64,
    total_s: f64,
}

impl SCurve {
    fn new(distance: f64, speed: f64, acceleration: f64) -> Self {
        // A ramp to speed v takes 2 v / a and covers v^2 / a.
        let mut peak = speed.min((0.5 * acceleration * distance).sqrt());
        let mut ramp_s = 2.0 * peak / acceleration;
        if ramp_s < SHORTEST_RAMP_S {
            ramp_s = SHORTEST_RAMP_S;
            peak = speed.min(distance / ramp_s);
        }
        let total_s = if peak > 0.0 {
            ramp_s + distance / peak
        } else {
            0.0
        };
        Self {
            distance,
            peak,
            ramp_s,
            total_s,
        }
    }

    /// Distance and speed at a time.
    fn at(&self, time_s: f64) -> (f64, f64) {
        let left_s = self.total_s - time_s;
        if time_s <= 0.0 {
            (0.0, 0.0)
        } else if left_s <= 0.0 {
            (self.distance, 0.0)
        } else if time_s < self.ramp_s {
            self.ramp(time_s)
        } else if left_s < self.ramp_s {
            let (distance, speed) = self.ramp(left_s);
            (self.distance - distance, speed)
        } else {
            (self.peak * (time_s - 0.5 * self.ramp_s), self.peak)
        }
    }

    fn ramp(&self, time_s: f64) -> (f64, f64) {
        let u = time_s / self.ramp_s;
        let speed = self.peak * (u - (TAU * u).sin() / TAU);
        let distance =
            self.peak * self.ramp_s * (0.5 * u * u + ((TAU * u).cos() - 1.0) / (TAU * TAU));
        (distance, speed)
    }
}

impl JointTrajectory {
    /// The most points that a trajectory may have.
    pub const MAX_POINTS: usize = 10_000;
    /// The longest that a trajectory may take.
    pub const MAX_DURATION: Duration = Duration::from_secs(600);

    /// Checks points that came from outside: 1 to [`Self::MAX_POINTS`], finite, times strictly
    /// increasing up to [`Self::MAX_DURATION`]. See [`Self::check_limits`] for an arm's limits.
    ///
    /// # Errors
    /// [`PlanError::Invalid`] says which point is wrong and why.
    pub fn new(points: Vec<TrajectoryPoint>) -> Result<Self, PlanError> {
        let invalid = |reason: String| Err(PlanError::Invalid(reason));
        if points.is_empty() {
            return invalid("no points".into());
        }
        if points.len() > Self::MAX_POINTS {
            return invalid(format!(
                "{} points, expected at most {}",
                points.len(),
                Self::MAX_POINTS
            ));
        }
        for (i, point) in points.iter().enumerate() {
            let finite = |joints: &Joints| joints.iter().all(|q| q.is_finite());
            if !finite(&point.positions_rad) {
                return invalid(format!("positions of point {i} are not finite"));
            }
            if !finite(&point.velocities_rad_s) {
                return invalid(format!("velocities of point {i} are not finite"));
            }
            if point.time > Self::MAX_DURATION {
                return invalid(format!(
                    "point {i} at {:?}, expected at most {:?}",
                    point.time,
                    Self::MAX_DURATION
                ));
            }
            if i > 0 && point.time <= points[i - 1].time {
                return invalid(format!(
                    "point {i} at {:?}, expected a time after {:?}",
                    point.time,
                    points[i - 1].time
                ));
            }
        }
        Ok(Self { points })
    }

    /// Whether the arm may follow: positions within its limits and, to 5 %, its joint speeds,
    /// between the points too.
    ///
    /// # Errors
    /// [`PlanError::Invalid`] names the first joint and point beyond a limit.
    pub fn check_limits(&self, arm: &Arm) -> Result<(), PlanError> {
        let (lower, upper) = &arm.limits_rad;
        for (i, point) in self.points.iter().enumerate() {
            let next = self.points.get(i + 1).unwrap_or(point);
            for joint in 0..6 {
                let segment = Cubic::new(point, next, joint);
                let (least, most) = segment.position_range();
                if least < lower[joint] || most > upper[joint] {
                    return Err(PlanError::Invalid(format!(
                        "joint {joint} goes to {least:.4}..{most:.4} rad after point {i}, expected {:.4}..{:.4}",
                        lower[joint], upper[joint]
                    )));
                }
                let speed = segment.peak_speed();
                let limit = 1.05 * arm.max_speed_rad_s[joint];
                if speed > limit {
                    return Err(PlanError::Invalid(format!(
                        "joint {joint} turns at {speed:.3} rad/s after point {i}, expected at most {limit:.3}"
                    )));
                }
            }
        }
        Ok(())
    }

    /// The points.
    pub fn points(&self) -> &[TrajectoryPoint] {
        &self.points
    }

    /// Time of the last point.
    pub fn duration(&self) -> Duration {
        self.last().time
    }

    /// The last point.
    pub fn last(&self) -> &TrajectoryPoint {
        &self.points[self.points.len() - 1]
    }

    /// Joint positions at a time, clamped to the ends.
    pub fn sample(&self, time: Duration) -> Joints {
        self.state(time).positions_rad
    }

    /// Joint positions and velocities at a time, clamped to the ends.
    pub fn state(&self, time: Duration) -> TrajectoryPoint {
        let after = self.points.partition_point(|point| point.time <= time);
        self.interpolate(after, time)
    }

    /// Samples at times that go forward without searching.
    pub fn sampler(&self) -> Sampler<'_> {
        Sampler {
            trajectory: self,
            after: 0,
        }
    }

    /// The state at a time before point `after` and not before the one ahead of it.
    fn interpolate(&self, after: usize, time: Duration) -> TrajectoryPoint {
        let at_rest = |point: &TrajectoryPoint| TrajectoryPoint {
            time,
            positions_rad: point.positions_rad,
            velocities_rad_s: Joints::zeros(),
        };
        if after == 0 {
            return at_rest(&self.points[0]);
        }
        if after == self.points.len() {
            return at_rest(self.last());
        }
        let (start, end) = (&self.points[after - 1], &self.points[after]);
        let u = (time - start.time).as_secs_f64() / (end.time - start.time).as_secs_f64();
        let mut state = at_rest(start);
        for joint in 0..6 {
            let cubic = Cubic::new(start, end, joint);
            state.positions_rad[joint] = cubic.position(u);
            state.velocities_rad_s[joint] = cubic.speed(u);
        }
        state
    }

    /// The tip on a straight line (rotation by slerp) from rest to rest, with bounded speed and
    /// acceleration and a continuous jerk; slower as a whole where a joint would go beyond its speed,
    /// acceleration or jerk. A turn counts as the path of a point 0.1 m off the axis.
    ///
    /// # Errors
    /// When the way leaves the reach or crosses a singular position, when `from` is beyond the
    /// limits, and when speed or acceleration are not positive.
    pub fn line(
        arm: &Arm,
        from: &Joints,
        to_tip: &Isometry3<f64>,
        speed_m_s: f64,
        acceleration_m_s2: f64,
    ) -> Result<Self, PlanError> {
        check_start(arm, from)?;
        check_positive("speed", speed_m_s)?;
        check_positive("acceleration", acceleration_m_s2)?;
        let start = arm.tip(from);
        let shift = to_tip.translation.vector - start.translation.vector;
        let turn = (to_tip.rotation * start.rotation.inverse()).scaled_axis();
        let distance = shift.norm().max(LEVER_M * turn.norm());
        if !distance.is_finite() {
            return Err(Unreachable { tip: *to_tip }.into());
        }
        // The tip is there already, but for rounding.
        let distance = if distance < 1e-9 { 0.0 } else { distance };
        let curve = SCurve::new(distance, speed_m_s, acceleration_m_s2);
        let steps = step_count(curve.total_s)?;
        let mut path = Vec::with_capacity(steps + 1);
        let mut stretch = 1.0f64;
        let mut joints = *from;
        for i in 0..=steps {
            let (travelled, speed) = curve.at(curve.total_s * i as f64 / steps as f64);
            let (share, rate) = if i == steps || distance == 0.0 {
                (1.0, 0.0)
            } else {
                (travelled / distance, speed / distance)
            };
            if i > 0 {
                let tip = Isometry3::from_parts(
                    Translation3::from(start.translation.vector + shift * share),
                    UnitQuaternion::from_scaled_axis(turn * share) * start.rotation,
                );
                let next = arm.solve(if i == steps { to_tip } else { &tip }, &joints)?;
                if (next - joints).amax() > JUMP_RAD {
                    return Err(PlanError::Singular {
                        tip: *to_tip,
                        joints,
                    });
                }
                joints = next;
            }
            let mut velocities = Joints::zeros();
            if rate > 0.0 {
                let twist = Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z) * rate;
                velocities =
                    arm.jacobian(&joints)
                        .lu()
                        .solve(&twist)
                        .ok_or(PlanError::Singular {
                            tip: *to_tip,
                            joints,
                        })?;
                stretch = stretch.max(velocities.component_div(&arm.max_speed_rad_s).amax());
            }
            path.push((joints, velocities));
        }
        if stretch > MOST_STRETCH {
            return Err(PlanError::Singular {
                tip: *to_tip,
                joints,
            });
        }
        let stretch = stretch.max(stretch_for_acceleration(arm, curve.total_s, &path));
        Self::timed(curve.total_s * stretch, stretch, path)
    }

    /// The straight motion in joint space from rest to rest, as fast as joint speeds,
    /// accelerations and jerks allow; the joints start and stop together.
    ///
    /// # Errors
    /// When either end is beyond the limits.
    pub fn joint_space(arm: &Arm, from: &Joints, to: &Joints) -> Result<Self, PlanError> {
        Self::joint_space_within(arm, from, to, f64::INFINITY)
    }

    /// As [`Self::joint_space`], with the tip no faster than a speed.
    ///
    /// # Errors
    /// When either end is beyond the limits or the speed is not positive.
    pub fn joint_space_within(
        arm: &Arm,
        from: &Joints,
        to: &Joints,
        tip_speed_m_s: f64,
    ) -> Result<Self, PlanError> {
        check_start(arm, from)?;
        check_start(arm, to)?;
        check_positive("tip speed", tip_speed_m_s)?;
        let way = to - from;
        // Share of the way per second that each bound allows.
        let mut speed = way
            .zip_map(&arm.max_speed_rad_s, |way, speed| speed / way.abs())
            .min();
        let acceleration = way
            .zip_map(&arm.max_acceleration_rad_s2, |way, limit| {
                limit.min(JOINT_ACCELERATION_RAD_S2) / way.abs()
            })
            .min();
        if tip_speed_m_s.is_finite() {
            let samples = 64;
            for i in 0..=samples {
                let joints = from + way * (i as f64 / samples as f64);
                let tip = (arm.jacobian(&joints) * way).fixed_rows::<3>(0).norm();
                speed = speed.min(tip_speed_m_s / tip);
            }
        }
        let curve = if way.amax() > 0.0 {
            SCurve::new(1.0, speed, acceleration)
        } else {
            SCurve::new(0.0, 1.0, 1.0)
        };
        let steps = step_count(curve.total_s)?;
        let path: Vec<_> = (0..=steps)
            .map(|i| match i {
                0 => (*from, Joints::zeros()),
                _ if i == steps => (*to, Joints::zeros()),
                _ => {
                    let (share, rate) = curve.at(curve.total_s * i as f64 / steps as f64);
                    (from + way * share, way * rate)
                }
            })
            .collect();
        let stretch = stretch_for_acceleration(arm, curve.total_s, &path);
        Self::timed(curve.total_s * stretch, stretch, path)
    }

    /// Spreads a path evenly over a time, and slows its velocities down by `stretch`.
    fn timed(total_s: f64, stretch: f64, path: Vec<(Joints, Joints)>) -> Result<Self, PlanError> {
        let steps = (path.len() - 1) as u128;
        let total_ns = (total_s.max(STEP_S) * 1e9).round() as u128;
        let points = path
            .into_iter()
            .enumerate()
            .map(|(i, (positions_rad, velocities_rad_s))| TrajectoryPoint {
                time: Duration::from_nanos((total_ns * i as u128 / steps) as u64),
                positions_rad,
                velocities_rad_s: velocities_rad_s / stretch,
            })
            .collect();
        Self::new(points)
    }
}

/// Samples a trajectory at times that go forward.
#[derive(Clone, Debug)]
pub struct Sampler<'a> {
    trajectory: &'a JointTrajectory,
    after: usize,
}

impl Sampler<'_> {
    /// As [`JointTrajectory::state`]; `time` is not before that of the last call.
    pub fn state(&mut self, time: Duration) -> TrajectoryPoint {
        let points = &self.trajectory.points;
        while self.after < points.len() && points[self.after].time <= time {
            self.after += 1;
        }
        self.trajectory.interpolate(self.after, time)
    }
}

/// One joint between two points: c0 + c1 u + c2 u^2 + c3 u^3 with u in 0..1.
struct Cubic {
    c: [f64; 4],
    duration_s: f64,
}

impl Cubic {
    fn new(start: &TrajectoryPoint, end: &TrajectoryPoint, joint: usize) -> Self {
        let duration_s = (end.time - start.time).as_secs_f64();
        let (p0, p1) = (start.positions_rad[joint], end.positions_rad[joint]);
        let v0 = start.velocities_rad_s[joint] * duration_s;
        let v1 = end.velocities_rad_s[joint] * duration_s;
        let way = p1 - p0;
        Self {
            c: [p0, v0, 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way],
            duration_s,
        }
    }

    fn position(&self, u: f64) -> f64 {
        let [c0, c1, c2, c3] = self.c;
        c0 + u * (c1 + u * (c2 + u * c3))
    }

    fn speed(&self, u: f64) -> f64 {
        let [_, c1, c2, c3] = self.c;
        (c1 + u * (2.0 * c2 + u * 3.0 * c3)) / self.duration_s
    }

    fn peak_speed(&self) -> f64 {
        if self.duration_s == 0.0 {
            return 0.0;
        }
        let vertex = -self.c[2] / (3.0 * self.c[3]);
        let inside = if vertex > 0.0 && vertex < 1.0 {
            vertex
        } else {
            0.0
        };
        [0.0, inside, 1.0]
            .map(|u| self.speed(u).abs())
            .into_iter()
            .fold(0.0, f64::max)
    }

    fn position_range(&self) -> (f64, f64) {
        let [_, c1, c2, c3] = self.c;
        // Where the speed is zero: 3 c3 u^2 + 2 c2 u + c1 = 0, in the form that survives c3 = 0.
        let root = (c2 * c2 - 3.0 * c3 * c1).max(0.0).sqrt();
        let sum = -(c2 + root.copysign(c2));
        let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
        for u in [0.0, 1.0, c1 / sum, sum / (3.0 * c3)] {
            if (0.0..=1.0).contains(&u) {
                least = least.min(self.position(u));
                most = most.max(self.position(u));
            }
        }
        (least, most)
    }
}

/// By how much a path, whose points are evenly spread over a time, has to be stretched in time for its joint accelerations and jerks to keep
/// the arm's limits; at least 1. Accelerations go with the square of the stretch, jerks with its cube.
fn stretch_for_acceleration(arm: &Arm, total_s: f64, path: &[(Joints, Joints)]) -> f64 {
    let step_s = total_s / (path.len() - 1) as f64;
    let accelerations: Vec<Joints> = path
        .windows(2)
        .map(|pair| (pair[1].1 - pair[0].1) / step_s)
        .collect();
    let mut stretch = 1.0f64;
    for (i, acceleration) in accelerations.iter().enumerate() {
        let share = acceleration
            .component_div(&arm.max_acceleration_rad_s2)
            .amax();
        stretch = stretch.max(share.sqrt());
        if i > 0 {
            let jerk = (acceleration - accelerations[i - 1]) / step_s;
            stretch = stretch.max(jerk.component_div(&arm.max_jerk_rad_s3).amax().cbrt());
        }
    }
    stretch
}

fn check_start(arm: &Arm, joints: &Joints) -> Result<(), PlanError> {
    let (lower, upper) = &arm.limits_rad;
    // Not a number fails both comparisons.
    let within = |joint: &usize| joints[*joint] >= lower[*joint] && joints[*joint] <= upper[*joint];
    let Some(joint) = (0..6).find(|joint| !within(joint)) else {
        return Ok(());
    };
    Err(PlanError::Invalid(format!(
        "joint {joint} of {} is beyond the arm's limits, expected {:.4} to {:.4} rad",
        joints_text(joints),
        lower[joint],
        upper[joint]
    )))
}

fn check_positive(what: &str, value: f64) -> Result<(), PlanError> {
    if value > 0.0 {
        return Ok(());
    }
    Err(PlanError::Invalid(format!(
        "{what} is {value}, expected more than 0"
    )))
}

/// Number of intervals of about [`STEP_S`].
fn step_count(total_s: f64) -> Result<usize, PlanError> {
    let steps = (total_s / STEP_S).ceil().max(1.0);
    if steps < JointTrajectory::MAX_POINTS as f64 {
        return Ok(steps as usize);
    }
    Err(PlanError::Invalid(format!(
        "the motion would take {total_s:.1} s"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::WorkCell;
    use nalgebra::{Isometry2, Vector2};
    use proptest::prelude::*;

    fn arm() -> Arm {
        WorkCell::builtin().unwrap().arm
    }

    fn over(x: f64, y: f64, yaw_rad: f64, z_m: f64) -> Isometry3<f64> {
        Arm::tip_down(&Isometry2::new(Vector2::new(x, y), yaw_rad), z_m)
    }

    fn tip_pose() -> impl Strategy<Value = Isometry3<f64>> {
        // Without the corners, which the arm reaches only low.
        (0.3..0.65f64, -0.4..0.4f64, -1.5..1.5f64, -0.01..0.2f64)
            .prop_map(|(x, y, yaw_rad, z_m)| over(x, y, yaw_rad, z_m))
    }

    fn assert_within_joint_speeds(arm: &Arm, trajectory: &JointTrajectory) {
        trajectory.check_limits(arm).unwrap();
        for point in trajectory.points() {
            let share = point
                .velocities_rad_s
                .component_div(&arm.max_speed_rad_s)
                .amax();
            assert!(share <= 1.0 + 1e-9, "{share}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn a_line_is_straight_within_a_tenth_of_a_millimetre(
            start in tip_pose(), end in tip_pose(), speed in 0.05..1.0f64, acceleration in 0.5..5.0f64,
        ) {
            let arm = arm();
            let from = arm.solve(&start, &arm.ready).unwrap();
            let line = JointTrajectory::line(&arm, &from, &end, speed, acceleration).unwrap();
            prop_assert_eq!(line.points()[0].time, Duration::ZERO);
            prop_assert_eq!(line.points()[0].positions_rad, from);
            prop_assert!((arm.tip(&line.last().positions_rad).to_homogeneous() - end.to_homogeneous()).amax() < 1e-9);
            let way = end.translation.vector - start.translation.vector;
            prop_assume!(way.norm() > 1e-3);
            let mut sampler = line.sampler();
            let mut before: Option<(f64, f64)> = None;
            let tick_s = 1.0 / 480.0;
            for tick in 0.. {
                let time = Duration::from_secs_f64(f64::from(tick) * tick_s);
                if time > line.duration() {
                    break;
                }
                let state = sampler.state(time);
                prop_assert_eq!(&state, &line.state(time));
                let tip = arm.tip(&state.positions_rad).translation.vector;
                let along = (tip - start.translation.vector).dot(&way) / way.norm();
                let aside = (tip - start.translation.vector - way.normalize() * along).norm();
                prop_assert!(aside < 1e-4, "{} m off the line", aside);
                // Speed and acceleration by finite differences, with 5 % for their coarseness.
                if let Some((last, last_speed)) = before {
                    let present = (along - last) / tick_s;
                    prop_assert!(present <= 1.05 * speed, "{} m/s", present);
                    let change = (present - last_speed).abs() / tick_s;
                    prop_assert!(tick == 1 || change <= 1.05 * acceleration + 0.1, "{} m/s2", change);
                    before = Some((along, present));
                } else {
                    before = Some((along, 0.0));
                }
            }
            assert_within_joint_speeds(&arm, &line);
        }

        #[test]
        fn velocities_are_those_of_the_positions(start in tip_pose(), end in tip_pose()) {
            let arm = arm();
            let from = arm.solve(&start, &arm.ready).unwrap();
            let line = JointTrajectory::line(&arm, &from, &end, 0.5, 2.0).unwrap();
            // Three points of the path give the derivative in the middle one to second order.
            for three in line.points().windows(3) {
                let elapsed_s = (three[2].time - three[0].time).as_secs_f64();
                let slope = (three[2].positions_rad - three[0].positions_rad) / elapsed_s;
                prop_assert!((slope - three[1].velocities_rad_s).amax() < 0.05);
            }
        }

        #[test]
        fn joint_space_goes_straight_from_rest_to_rest(
            from in prop::array::uniform6(-3.0..3.0f64), to in prop::array::uniform6(-3.0..3.0f64), tip_speed in 0.1..2.0f64,
        ) {
            let arm = arm();
            let (from, to) = (Joints::from(from), Joints::from(to));
            let way = JointTrajectory::joint_space_within(&arm, &from, &to, tip_speed).unwrap();
            assert_within_joint_speeds(&arm, &way);
            let (first, last) = (way.points()[0], *way.last());
            prop_assert_eq!((first.positions_rad, last.positions_rad), (from, to));
            prop_assert_eq!((first.velocities_rad_s, last.velocities_rad_s), (Joints::zeros(), Joints::zeros()));
            for point in way.points() {
                let share = (point.positions_rad - from).dot(&(to - from)) / (to - from).norm_squared();
                prop_assert!((from + (to - from) * share - point.positions_rad).amax() < 1e-9);
                let speed = (arm.jacobian(&point.positions_rad) * point.velocities_rad_s).fixed_rows::<3>(0).norm();
                prop_assert!(speed < 1.02 * tip_speed, "{}", speed);
            }
            let free = JointTrajectory::joint_space(&arm, &from, &to).unwrap();
            prop_assert!(free.duration() <= way.duration());
        }

        #[test]
        fn limits_hold_between_points_too(q0 in -1.0..1.0f64, q1 in -1.0..1.0f64, v0 in -3.0..3.0f64, v1 in -3.0..3.0f64) {
            let point = |time, q, v| TrajectoryPoint {
                time: Duration::from_secs_f64(time),
                positions_rad: Joints::repeat(q),
                velocities_rad_s: Joints::repeat(v),
            };
            let trajectory = JointTrajectory::new(vec![point(0.0, q0, v0), point(1.0, q1, v1)]).unwrap();
            let states: Vec<_> = (0..=1000).map(|i| trajectory.state(Duration::from_millis(i))).collect();
            let range = |value: &dyn Fn(&TrajectoryPoint) -> f64| {
                states.iter().map(value).fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
            };
            let (low, high) = range(&|state| state.positions_rad[0]);
            let mut arm = arm();
            arm.max_speed_rad_s = Joints::repeat(100.0);
            let margin = 1e-4;
            arm.limits_rad = (Joints::repeat(low - margin), Joints::repeat(high + margin));
            prop_assert!(trajectory.check_limits(&arm).is_ok());
            arm.limits_rad.0 = Joints::repeat(low + margin);
            prop_assert!(trajectory.check_limits(&arm).is_err());
            arm.limits_rad = (Joints::repeat(low - margin), Joints::repeat(high - margin));
            prop_assert!(trajectory.check_limits(&arm).is_err());
        }
    }

    /// Largest joint acceleration and jerk, from velocities at the points.
    fn peaks(trajectory: &JointTrajectory) -> (f64, f64) {
        let points = trajectory.points();
        let step_s = (points[1].time - points[0].time).as_secs_f64();
        let accelerations: Vec<Joints> = points
            .windows(2)
            .map(|pair| (pair[1].velocities_rad_s - pair[0].velocities_rad_s) / step_s)
            .collect();
        let jerks = accelerations
            .windows(2)
            .map(|pair| ((pair[1] - pair[0]) / step_s).amax());
        let jerk = jerks.fold(0.0, f64::max);
        let acceleration = accelerations.iter().map(|a| a.amax()).fold(0.0, f64::max);
        (acceleration, jerk)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn joints_keep_to_their_acceleration_and_jerk(
            start in tip_pose(), end in tip_pose(), speed in 0.05..1.5f64, limit in 2.0..20.0f64, jerk in 30.0..1000.0f64,
        ) {
            let mut arm = arm();
            let free_arm = arm.clone();
            arm.set_motion_limits(limit, jerk).unwrap();
            let from = arm.solve(&start, &arm.ready).unwrap();
            let line = JointTrajectory::line(&arm, &from, &end, speed, 8.0).unwrap();
            let way = JointTrajectory::joint_space(&arm, &from, &arm.home).unwrap();
            for trajectory in [&line, &way] {
                let (most, most_jerk) = peaks(trajectory);
                prop_assert!(most <= limit * 1.001, "{most} rad/s2");
                prop_assert!(most_jerk <= jerk * 1.001, "{most_jerk} rad/s3");
            }
            // It is the same path, no faster than without the limits; and where those are kept it is the same motion.
            let free = JointTrajectory::line(&free_arm, &from, &end, speed, 8.0).unwrap();
            let later_s = line.duration().as_secs_f64() - free.duration().as_secs_f64();
            let stays_within = { let (a, j) = peaks(&free); a < 0.99 * limit && j < 0.99 * jerk };
            prop_assert!(later_s > -1e-9 || limit > Arm::DEFAULT_ACCELERATION_RAD_S2 || jerk > Arm::DEFAULT_JERK_RAD_S3);
            prop_assert!(!stays_within || later_s < 1e-9, "{later_s} s later");
            for (a, b) in line.points().iter().zip(free.points()) {
                prop_assert_eq!(a.positions_rad, b.positions_rad);
            }
        }
    }

    #[test]
    #[ignore = "prints how fast the joints of the primitive's motions accelerate"]
    fn peaks_of_fast_transfers() {
        let mut arm = arm();
        arm.set_motion_limits(1e6, 1e9).unwrap();
        let (mut line_most, mut way_most) = ((0.0f64, 0.0f64), (0.0f64, 0.0f64));
        let steps = |from: f64, to: f64, count: i32| {
            (0..=count).map(move |i| from + (to - from) * f64::from(i) / f64::from(count))
        };
        for (x0, y0) in steps(0.3, 0.7, 4).flat_map(|x| steps(-0.45, 0.45, 6).map(move |y| (x, y)))
        {
            for (x1, y1) in
                steps(0.3, 0.7, 4).flat_map(|x| steps(-0.45, 0.45, 6).map(move |y| (x, y)))
            {
                for (turn, height) in [(-1.5, 0.2), (1.5, 0.1), (0.0, 0.2)] {
                    let Ok(from) = arm.solve(&over(x0, y0, turn, height), &arm.ready) else {
                        continue;
                    };
                    if let Ok(line) =
                        JointTrajectory::line(&arm, &from, &over(x1, y1, -turn, height), 0.8, 4.0)
                    {
                        let (a, j) = peaks(&line);
                        line_most = (line_most.0.max(a), line_most.1.max(j));
                    }
                    let way =
                        JointTrajectory::joint_space_within(&arm, &arm.home, &from, 1.5).unwrap();
                    let (a, j) = peaks(&way);
                    way_most = (way_most.0.max(a), way_most.1.max(j));
                }
            }
        }
        println!("lines: {line_most:?}; joint space: {way_most:?}");
    }

    #[test]
    fn a_half_turn_on_the_spot_takes_its_time() {
        let arm = arm();
        let from = arm.solve(&over(0.5, 0.0, -1.5, 0.1), &arm.ready).unwrap();
        let turn = JointTrajectory::line(&arm, &from, &over(0.5, 0.0, 1.6, 0.1), 0.5, 3.0).unwrap();
        assert!(
            turn.duration() > Duration::from_millis(600),
            "{:?}",
            turn.duration()
        );
        assert!((turn.last().positions_rad - from)[5].abs() > 3.0);
    }

    #[test]
    fn a_line_to_where_the_tip_is_takes_one_step() {
        let arm = arm();
        let from = arm.solve(&over(0.5, 0.0, 0.0, 0.1), &arm.ready).unwrap();
        let stay = JointTrajectory::line(&arm, &from, &arm.tip(&from), 0.5, 3.0).unwrap();
        assert!((stay.last().positions_rad - from).amax() < 1e-9);
        assert_eq!(stay.points().len(), 2);
        let stay = JointTrajectory::joint_space(&arm, &from, &from).unwrap();
        assert_eq!(stay.points().len(), 2);
    }

    #[test]
    fn a_line_that_passes_too_near_the_base_is_slowed_down() {
        let arm = arm();
        let from = arm.solve(&over(0.25, -0.2, 0.0, 0.1), &arm.ready).unwrap();
        let line =
            JointTrajectory::line(&arm, &from, &over(0.25, 0.2, 0.0, 0.1), 1.5, 10.0).unwrap();
        assert_within_joint_speeds(&arm, &line);
        assert!(line.duration() > Duration::from_millis(500));
    }

    #[test]
    fn a_line_out_of_reach_or_through_a_singularity_is_an_error() {
        let arm = arm();
        let from = arm.solve(&over(0.6, 0.0, 0.0, 0.1), &arm.ready).unwrap();
        let far = JointTrajectory::line(&arm, &from, &over(1.3, 0.0, 0.0, 0.1), 0.5, 2.0);
        assert!(matches!(far, Err(PlanError::Unreachable(_))), "{far:?}");
        let reason = far.unwrap_err().to_string();
        assert!(
            reason.contains("tip pose (") && !reason.contains('\n'),
            "{reason}"
        );
        // Straight through the base's axis.
        let through = JointTrajectory::line(&arm, &from, &over(-0.6, 0.0, 0.0, 0.1), 0.5, 2.0);
        assert!(through.is_err());
        // Tool horizontal and sideways: wrist 1 and wrist 3 become parallel on the way.
        let folded = Joints::new(0.0, -1.5, 1.6, -1.7, -0.3, 0.0);
        let mut to = arm.tip(&Joints::new(0.0, -1.5, 1.6, -1.7, 0.3, 0.0));
        to.translation.z += 0.02;
        let flips = JointTrajectory::line(&arm, &folded, &to, 0.5, 2.0);
        assert!(
            matches!(flips, Err(PlanError::Singular { .. })),
            "{flips:?}"
        );
    }

    #[test]
    fn bad_requests_are_refused_by_name() {
        let arm = arm();
        let from = arm.ready;
        let to = arm.tip(&from);
        for (speed, acceleration, name) in [
            (0.0, 1.0, "speed"),
            (f64::NAN, 1.0, "speed"),
            (1.0, -1.0, "acceleration"),
            (1e-9, 1.0, "would take"),
        ] {
            let to = over(0.5, 0.1, 0.0, 0.1);
            let error = JointTrajectory::line(&arm, &from, &to, speed, acceleration).unwrap_err();
            assert!(error.to_string().contains(name), "{error}");
        }
        let outside = Joints::repeat(10.0);
        let error = JointTrajectory::line(&arm, &outside, &to, 1.0, 1.0).unwrap_err();
        assert!(error.to_string().contains("limits"), "{error}");
        assert!(JointTrajectory::joint_space(&arm, &from, &outside).is_err());
        assert!(JointTrajectory::joint_space(&arm, &Joints::repeat(f64::NAN), &from).is_err());
        let mut nowhere = to;
        nowhere.translation.x = f64::NAN;
        assert!(JointTrajectory::line(&arm, &from, &nowhere, 1.0, 1.0).is_err());
    }

    #[test]
    fn hostile_points_are_refused_with_a_reason() {
        let point = |ms| TrajectoryPoint {
            time: Duration::from_millis(ms),
            positions_rad: Joints::zeros(),
            velocities_rad_s: Joints::zeros(),
        };
        let refusal = |points| JointTrajectory::new(points).unwrap_err().to_string();
        assert!(refusal(vec![]).contains("no points"));
        assert!(refusal(vec![point(0), point(0)]).contains("point 1"));
        assert!(refusal(vec![point(5), point(9), point(7)]).contains("point 2"));
        let mut bad = point(4);
        bad.positions_rad[3] = f64::NAN;
        assert!(refusal(vec![point(0), bad]).contains("positions of point 1 are not finite"));
        let mut bad = point(4);
        bad.velocities_rad_s[3] = f64::INFINITY;
        assert!(refusal(vec![bad]).contains("velocities of point 0"));
        assert!(refusal((0..=10_000).map(point).collect()).contains("10001 points"));
        assert!(refusal(vec![point(0), point(u64::MAX / 2_000_000)]).contains("at most"));
        assert!(JointTrajectory::new(vec![point(0)]).is_ok());
        assert!(JointTrajectory::new((0..10_000).map(point).collect()).is_ok());
    }

    #[test]
    fn points_that_are_too_fast_or_beyond_the_limits_are_named() {
        let arm = arm();
        let point = |ms, elbow| {
            let mut positions_rad = Joints::zeros();
            positions_rad[2] = elbow;
            TrajectoryPoint {
                time: Duration::from_millis(ms),
                positions_rad,
                velocities_rad_s: Joints::zeros(),
            }
        };
        let check = |points| JointTrajectory::new(points).unwrap().check_limits(&arm);
        assert_eq!(check(vec![point(0, 0.0), point(1000, 1.0)]), Ok(()));
        let error = check(vec![point(0, 0.0), point(100, 1.0)])
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("joint 2 turns at 15.000 rad/s after point 0"),
            "{error}"
        );
        let error = check(vec![point(0, 0.0), point(5000, 3.2)])
            .unwrap_err()
            .to_string();
        assert!(error.contains("joint 2 goes to"), "{error}");
        let error = check(vec![point(0, -3.2)]).unwrap_err().to_string();
        assert!(error.contains("after point 0"), "{error}");
    }
}
