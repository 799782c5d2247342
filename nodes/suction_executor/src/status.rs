//! What the driver says of the robot.

use std::time::Duration;

use ur5::Joints;

/// `ur_dashboard_msgs/RobotMode`: the only mode in which the arm moves.
const RUNNING: i8 = 7;
/// `ur_dashboard_msgs/SafetyMode`: the modes in which the arm moves.
const NORMAL: u8 = 1;
const REDUCED: u8 = 2;

/// Positions and velocities of the joints as the driver last published them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointReading {
    /// Capture time.
    pub stamp: Duration,
    /// Positions.
    pub positions_rad: Joints,
    /// Velocities.
    pub velocities_rad_s: Joints,
}

/// The newest status of the driver. Times of arrival are monotonic and from any origin.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DriverStatus {
    /// `robot_mode`; the driver latches it and publishes changes only.
    pub robot_mode: Option<i8>,
    /// `safety_mode`, latched.
    pub safety_mode: Option<u8>,
    /// `robot_program_running`, latched.
    pub program_running: Option<bool>,
    /// Newest joint state and when it arrived.
    pub joints: Option<(JointReading, Duration)>,
    /// When the newest state of the pins arrived.
    pub io_states: Option<Duration>,
}

impl DriverStatus {
    /// Why the arm must not move now, if there is a reason. Modes are latched, so that the streams
    /// of joint and pin states tell whether the driver is alive: neither may be older than
    /// `max_age`.
    pub fn obstacle(&self, now: Duration, max_age: Duration) -> Option<String> {
        match self.robot_mode {
            Some(RUNNING) => {}
            Some(mode) => {
                return Some(format!(
                    "robot mode is {mode}, expected RUNNING ({RUNNING})"
                ));
            }
            None => return Some("the driver has not published its robot mode".into()),
        }
        match self.safety_mode {
            Some(NORMAL | REDUCED) => {}
            Some(mode) => {
                return Some(format!(
                    "safety mode is {}, expected NORMAL or REDUCED",
                    safety_mode_name(mode)
                ));
            }
            None => return Some("the driver has not published its safety mode".into()),
        }
        match self.program_running {
            Some(true) => {}
            Some(false) => return Some("the robot program is not running".into()),
            None => return Some("the driver has not said whether its program runs".into()),
        }
        let arrivals = [
            ("joint_states", self.joints.map(|(_, at)| at)),
            ("io_states", self.io_states),
        ];
        for (topic, at) in arrivals {
            let Some(at) = at else {
                return Some(format!("no {topic} have arrived"));
            };
            let age = now.saturating_sub(at);
            if age > max_age {
                return Some(format!(
                    "the newest {topic} are {:.1} s old, expected at most {:.1} s",
                    age.as_secs_f64(),
                    max_age.as_secs_f64()
                ));
            }
        }
        None
    }
}

fn safety_mode_name(mode: u8) -> String {
    let name = match mode {
        3 => "PROTECTIVE_STOP",
        4 => "RECOVERY",
        5 => "SAFEGUARD_STOP",
        6 => "SYSTEM_EMERGENCY_STOP",
        7 => "ROBOT_EMERGENCY_STOP",
        8 => "VIOLATION",
        9 => "FAULT",
        10 => "VALIDATE_JOINT_ID",
        12 => "AUTOMATIC_MODE_SAFEGUARD_STOP",
        13 => "SYSTEM_THREE_POSITION_ENABLING_STOP",
        _ => return format!("unknown ({mode})"),
    };
    name.to_owned()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    const AGE: Duration = Duration::from_secs(1);

    /// A driver that is ready at `now`.
    pub(crate) fn ready(now: Duration) -> DriverStatus {
        let reading = JointReading {
            stamp: Duration::from_secs(5),
            positions_rad: Joints::zeros(),
            velocities_rad_s: Joints::zeros(),
        };
        DriverStatus {
            robot_mode: Some(RUNNING),
            safety_mode: Some(NORMAL),
            program_running: Some(true),
            joints: Some((reading, now)),
            io_states: Some(now),
        }
    }

    #[test]
    fn a_ready_driver_is_no_obstacle_until_it_falls_silent() {
        let status = ready(Duration::from_secs(10));
        assert_eq!(status.obstacle(Duration::from_secs(11), AGE), None);
        let reason = status.obstacle(Duration::from_millis(11_001), AGE).unwrap();
        assert!(reason.contains("joint_states"), "{reason}");
        let silent_pins = DriverStatus {
            io_states: Some(Duration::from_secs(8)),
            ..status
        };
        let reason = silent_pins.obstacle(Duration::from_secs(10), AGE).unwrap();
        assert!(reason.contains("io_states"), "{reason}");
    }

    #[test]
    fn every_missing_or_wrong_part_of_the_status_is_an_obstacle_with_its_name() {
        let now = Duration::from_secs(10);
        let ready = ready(now);
        let cases = [
            (
                DriverStatus {
                    robot_mode: None,
                    ..ready.clone()
                },
                "robot mode",
            ),
            (
                DriverStatus {
                    robot_mode: Some(5),
                    ..ready.clone()
                },
                "robot mode is 5",
            ),
            (
                DriverStatus {
                    safety_mode: None,
                    ..ready.clone()
                },
                "safety mode",
            ),
            (
                DriverStatus {
                    safety_mode: Some(3),
                    ..ready.clone()
                },
                "PROTECTIVE_STOP",
            ),
            (
                DriverStatus {
                    safety_mode: Some(99),
                    ..ready.clone()
                },
                "99",
            ),
            (
                DriverStatus {
                    program_running: None,
                    ..ready.clone()
                },
                "program",
            ),
            (
                DriverStatus {
                    program_running: Some(false),
                    ..ready.clone()
                },
                "not running",
            ),
            (
                DriverStatus {
                    joints: None,
                    ..ready.clone()
                },
                "joint_states",
            ),
            (
                DriverStatus {
                    io_states: None,
                    ..ready.clone()
                },
                "io_states",
            ),
        ];
        for (status, expected) in cases {
            let reason = status.obstacle(now, AGE).unwrap();
            assert!(reason.contains(expected), "{reason}");
        }
        let reduced = DriverStatus {
            safety_mode: Some(REDUCED),
            ..ready
        };
        assert_eq!(reduced.obstacle(now, AGE), None);
    }
}
