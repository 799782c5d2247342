//! Time-parameterised joint trajectories.

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
pub enum PlanError {
    /// A pose on the way is out of reach.
    #[error(transparent)]
    Unreachable(#[from] Unreachable),
    /// The way leads through a singular position: joints would have to jump.
    #[error("the straight way to {tip} is singular at joints {joints}")]
    Singular {
        /// Where the way was to end.
        tip: Isometry3<f64>,
        /// Where it broke off.
        joints: Joints,
    },
    /// Empty, out of order, not finite, or beyond the joint limits.
    #[error("invalid trajectory: {0}")]
    Invalid(String),
}

/// Time between the points of a planned trajectory.
const STEP_S: f64 = 0.02;
/// A turn of the tip counts as the path of a point this far off its axis.
const LEVER_M: f64 = 0.1;
/// Largest joint acceleration of motions in joint space.
const JOINT_ACCELERATION_RAD_S2: f64 = 8.0;
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
        let peak = speed.min((0.5 * acceleration * distance).sqrt());
        let ramp_s = 2.0 * peak / acceleration;
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
                // Not a number fails the comparison.
                if !(speed <= limit) {
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
    /// acceleration and a continuous jerk; slower where a joint would turn too fast. A turn counts
    /// as the path of a point 0.1 m off the axis.
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
        // Not a number fails the comparison.
        if !(stretch <= MOST_STRETCH) {
            return Err(PlanError::Singular {
                tip: *to_tip,
                joints,
            });
        }
        Self::timed(curve.total_s * stretch, stretch, path)
    }

    /// The straight motion in joint space from rest to rest, as fast as joint speeds and
    /// accelerations allow; the joints start and stop together.
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
        let acceleration = JOINT_ACCELERATION_RAD_S2 / way.amax();
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
        let path = (0..=steps)
            .map(|i| match i {
                0 => (*from, Joints::zeros()),
                _ if i == steps => (*to, Joints::zeros()),
                _ => {
                    let (share, rate) = curve.at(curve.total_s * i as f64 / steps as f64);
                    (from + way * share, way * rate)
                }
            })
            .collect();
        Self::timed(curve.total_s, 1.0, path)
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

fn check_start(arm: &Arm, joints: &Joints) -> Result<(), PlanError> {
    if arm.within_limits(joints) {
        return Ok(());
    }
    let joints: Vec<f64> = joints.iter().copied().collect();
    Err(PlanError::Invalid(format!(
        "joints {joints:?} are beyond the arm's limits"
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
