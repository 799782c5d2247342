//! Joints that follow a trajectory as a servo loop does.

use std::time::Duration;

use ur5::{JointTrajectory, Joints, PlanError, TrajectoryPoint};

/// A joint is further from its trajectory than the controller allows.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "joint {joint} is {deviation_rad:.4} rad from its trajectory, expected at most {tolerance_rad:.4} rad"
)]
pub struct PathDeviation {
    /// Index of the joint.
    pub joint: usize,
    /// Distance from where it should be (rad).
    pub deviation_rad: f64,
    /// Most that is allowed (rad).
    pub tolerance_rad: f64,
}

/// A servo loop: joints follow `delay` behind, at a share of the planned speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Servo {
    delay: Duration,
    scaling: f64,
}

/// Time between the points of a braking motion, and of one whose speed changes.
const BRAKING_STEP: Duration = Duration::from_millis(10);
/// How long the arm takes to another speed when the slider is moved.
const SLIDING_STEPS: u32 = 15;

impl Servo {
    /// `delay_s` behind (s), at `scaling` of the speed (0.01 to 1).
    pub fn new(delay_s: f64, scaling: f64) -> Self {
        Self {
            delay: Duration::from_secs_f64(delay_s.max(0.0)),
            scaling: scaling.clamp(0.01, 1.0),
        }
    }

    /// Whether joints are where their trajectory wants them.
    pub fn is_ideal(&self) -> bool {
        self.delay.is_zero() && self.scaling == 1.0
    }

    /// The trajectory that the joints take when they are asked for `desired`.
    ///
    /// # Errors
    /// Where it would be too long.
    pub fn actual(&self, desired: &JointTrajectory) -> Result<JointTrajectory, PlanError> {
        if self.is_ideal() {
            return Ok(desired.clone());
        }
        let late = |point: &TrajectoryPoint| TrajectoryPoint {
            time: point.time.div_f64(self.scaling) + self.delay,
            positions_rad: point.positions_rad,
            velocities_rad_s: point.velocities_rad_s * self.scaling,
        };
        let first = &desired.points()[0];
        let mut points = Vec::with_capacity(desired.points().len() + 2);
        // Still until the command arrives.
        if !(self.delay.is_zero() && first.time.is_zero()) {
            points.push(TrajectoryPoint {
                time: Duration::ZERO,
                positions_rad: first.positions_rad,
                velocities_rad_s: Joints::zeros(),
            });
        }
        points.extend(desired.points().iter().map(late));
        JointTrajectory::new(points)
    }

    /// Where the controller wants the joints at a time from the start (rad).
    pub fn desired(&self, desired: &JointTrajectory, elapsed: Duration) -> Joints {
        desired.sample(elapsed.mul_f64(self.scaling))
    }

    /// Compares where the joints are with where the controller wants them. Tolerances (rad) that are not positive allow everything.
    ///
    /// # Errors
    /// The first joint that is too far from its trajectory.
    pub fn check(
        &self,
        desired: &JointTrajectory,
        elapsed: Duration,
        actual_rad: &Joints,
        tolerances_rad: &Joints,
    ) -> Result<(), PathDeviation> {
        let wanted_rad = self.desired(desired, elapsed);
        for joint in 0..6 {
            let deviation_rad = (wanted_rad[joint] - actual_rad[joint]).abs();
            let tolerance_rad = tolerances_rad[joint];
            if tolerance_rad > 0.0 && deviation_rad > tolerance_rad {
                return Err(PathDeviation {
                    joint,
                    deviation_rad,
                    tolerance_rad,
                });
            }
        }
        Ok(())
    }

    /// What is left of a motion after a time, at another speed: `factor` times the present one, which is reached evenly within 0.15 s.
    ///
    /// # Errors
    /// Where it would be too long.
    pub fn slide(
        of: &JointTrajectory,
        elapsed: Duration,
        factor: f64,
    ) -> Result<JointTrajectory, PlanError> {
        let sliding_s = f64::from(SLIDING_STEPS) * BRAKING_STEP.as_secs_f64();
        let at = |way_s: f64, time: Duration, speed: f64| {
            let state = of.state(elapsed + Duration::from_secs_f64(way_s));
            TrajectoryPoint {
                time,
                positions_rad: state.positions_rad,
                velocities_rad_s: state.velocities_rad_s * speed,
            }
        };
        // Of the motion's own time, so much passes while the speed changes.
        let way_s = |share: f64| sliding_s * (share + 0.5 * (factor - 1.0) * share * share);
        let sliding = (0..=SLIDING_STEPS).map(|step| {
            let share = f64::from(step) / f64::from(SLIDING_STEPS);
            let speed = 1.0 + (factor - 1.0) * share;
            at(way_s(share), BRAKING_STEP * step, speed)
        });
        let slid = elapsed + Duration::from_secs_f64(way_s(1.0));
        let rest = of.points().iter().filter(|point| point.time > slid);
        let rest = rest.map(|point| {
            let way_s = (point.time - slid).as_secs_f64();
            TrajectoryPoint {
                time: Duration::from_secs_f64(sliding_s + way_s / factor),
                positions_rad: point.positions_rad,
                velocities_rad_s: point.velocities_rad_s * factor,
            }
        });
        // Points that fall together are one.
        let mut points: Vec<TrajectoryPoint> = sliding.collect();
        for point in rest {
            if points.last().is_none_or(|last| point.time > last.time) {
                points.push(point);
            }
        }
        JointTrajectory::new(points)
    }

    /// The motion that stops the joints on the way of `actual`, from a time on: their speed falls evenly to zero.
    ///
    /// # Errors
    /// Never for a trajectory that was valid.
    pub fn brake(
        actual: &JointTrajectory,
        elapsed: Duration,
        braking: Duration,
    ) -> Result<JointTrajectory, PlanError> {
        let total_s = braking.as_secs_f64();
        let steps = (total_s / BRAKING_STEP.as_secs_f64()).ceil().max(1.0);
        let points = (0..=steps as u32).map(|step| {
            let share = f64::from(step) / steps;
            let way_s = total_s * (share - 0.5 * share * share);
            let state = actual.state(elapsed + Duration::from_secs_f64(way_s));
            TrajectoryPoint {
                time: braking
                    .mul_f64(share)
                    .max(Duration::from_nanos(u64::from(step))),
                positions_rad: state.positions_rad,
                velocities_rad_s: state.velocities_rad_s * (1.0 - share),
            }
        });
        JointTrajectory::new(points.collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn a_motion_whose_speed_changes_goes_the_same_way_and_takes_its_new_time() {
        let slower = Servo::slide(&turn(), ms(600), 0.5).unwrap();
        // From where it is, at the speed that it has, to the same end.
        let start = slower.state(ms(0));
        assert!((start.positions_rad[0] - turn().sample(ms(600))[0]).abs() < 1e-9);
        let speed = |time| (slower.sample(ms(time + 5))[0] - slower.sample(ms(time))[0]) / 0.005;
        assert!((speed(0) - 1.0).abs() < 0.05, "{}", speed(0));
        assert!((speed(200) - 0.5).abs() < 1e-6, "{}", speed(200));
        assert!((slower.last().positions_rad[0] - 1.0).abs() < 1e-9);
        // 0.6 s are left of it: 0.1125 s pass in 0.15 s, the rest at half the speed.
        let expected_s = 0.15 + (0.6 - 0.1125) / 0.5;
        assert!((slower.duration().as_secs_f64() - expected_s).abs() < 1e-6);
        // At its very end nothing is left.
        let end = Servo::slide(&turn(), ms(1190), 0.1).unwrap();
        assert!((end.last().positions_rad[0] - 1.0).abs() < 1e-6);
    }

    /// Turns the base by a rad in a second.
    fn turn() -> JointTrajectory {
        let point = |time, base_rad, base_rad_s| {
            let mut positions_rad = Joints::zeros();
            positions_rad[0] = base_rad;
            let mut velocities_rad_s = Joints::zeros();
            velocities_rad_s[0] = base_rad_s;
            TrajectoryPoint {
                time,
                positions_rad,
                velocities_rad_s,
            }
        };
        JointTrajectory::new(vec![
            point(ms(0), 0.0, 0.0),
            point(ms(200), 0.1, 1.0),
            point(ms(1000), 0.9, 1.0),
            point(ms(1200), 1.0, 0.0),
        ])
        .unwrap()
    }

    #[test]
    fn an_ideal_servo_changes_nothing() {
        assert_eq!(Servo::new(0.0, 1.0).actual(&turn()).unwrap(), turn());
    }

    #[test]
    fn joints_come_late_and_the_controller_sees_it() {
        let servo = Servo::new(0.03, 1.0);
        let actual = servo.actual(&turn()).unwrap();
        assert_eq!(actual.duration(), ms(1230));
        let at = ms(600);
        let deviation = servo.desired(&turn(), at)[0] - actual.sample(at)[0];
        assert!((deviation - 0.03).abs() < 1e-9, "{deviation}");
        let check =
            |tolerance| servo.check(&turn(), at, &actual.sample(at), &Joints::repeat(tolerance));
        assert_eq!(check(0.05), Ok(()));
        assert_eq!(check(-1.0), Ok(()));
        assert_eq!(check(0.02).unwrap_err().joint, 0);
    }

    #[test]
    fn a_slow_slider_stretches_time_and_is_no_deviation() {
        let servo = Servo::new(0.0, 0.5);
        let actual = servo.actual(&turn()).unwrap();
        assert_eq!(actual.duration(), ms(2400));
        for time in [0, 300, 1000, 1900, 2400].map(ms) {
            let tolerance = Joints::repeat(1e-9);
            servo
                .check(&turn(), time, &actual.sample(time), &tolerance)
                .unwrap();
        }
    }

    #[test]
    fn braking_begins_where_the_joints_are_and_ends_at_rest_on_the_way() {
        let actual = turn();
        let braking = Servo::brake(&actual, ms(500), ms(100)).unwrap();
        assert_eq!(braking.sample(Duration::ZERO), actual.sample(ms(500)));
        assert_eq!(braking.duration(), ms(100));
        // Half the way of going on at full speed.
        let way = braking.last().positions_rad[0] - actual.sample(ms(500))[0];
        assert!((way - 0.05).abs() < 1e-6, "{way}");
        assert_eq!(braking.last().velocities_rad_s, Joints::zeros());
        Servo::brake(&actual, ms(500), Duration::ZERO).unwrap();
    }
}
