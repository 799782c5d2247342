//! What the driver says of the robot.

use std::time::Duration;

use msgs::convert::JointReading;
use ur5::{AtHome, Joints};

/// `ur_dashboard_msgs/RobotMode`: the only mode in which the arm moves.
const RUNNING: i8 = 7;
/// `ur_dashboard_msgs/SafetyMode`: the modes in which the arm moves.
const NORMAL: u8 = 1;
const REDUCED: u8 = 2;

/// The pins that the executor looks at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pins {
    /// Output that switches suction.
    pub suction: bool,
    /// Input of the vacuum sensor.
    pub vacuum: bool,
    /// Whether the enabling input is low; false where there is none.
    pub disabled: bool,
}

/// A state that the driver streams.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Newest<T> {
    /// The newest value.
    pub value: T,
    /// When it arrived: monotonic, from any origin.
    pub at: Duration,
    /// How many have arrived.
    pub count: u64,
}

impl<T> Newest<T> {
    /// The stream after one more value.
    pub fn next(before: Option<&Self>, value: T, at: Duration) -> Self {
        let count = before.map_or(1, |before| before.count + 1);
        Self { value, at, count }
    }
}

/// The newest status of the driver.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DriverStatus {
    /// `robot_mode`; the driver latches it and publishes changes only.
    pub robot_mode: Option<i8>,
    /// `safety_mode`, latched.
    pub safety_mode: Option<u8>,
    /// `robot_program_running`, latched.
    pub program_running: Option<bool>,
    /// `joint_states`
    pub joints: Option<Newest<JointReading>>,
    /// Arrival of the newest reading of the joints that came too long after the one before: this process or the driver stood still.
    pub interrupted_at: Option<Duration>,
    /// Since when the joints have stood still.
    pub still: Option<Still>,
    /// Whether the arm is out of the cameras' view.
    pub at_home: AtHome,
    /// `io_states`
    pub pins: Option<Newest<Pins>>,
    /// Arrival of the newest state of the pins in which the enabling input was low.
    pub disabled_at: Option<Duration>,
}

/// A run of joint readings at the same place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Still {
    /// Arrival of the first.
    pub since: Duration,
    /// The last two have the same stamp.
    pub in_time: bool,
    /// Arrival of the first with the newest stamp.
    pub stamp_since: Duration,
}

/// What counts as standing still.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StillRule {
    /// No joint is faster.
    pub speed_rad_s: f64,
    /// No joint moves further from one reading to the next.
    pub step_rad: f64,
    /// Longest pause between two readings.
    pub pause: Duration,
    /// Where the arm is out of the cameras' sight (rad).
    pub home_rad: Joints,
}

impl DriverStatus {
    /// Takes the next reading of the joints.
    pub fn read_joints(&mut self, reading: JointReading, at: Duration, rule: &StillRule) {
        let before = self.joints.as_ref();
        let still = before.is_some_and(|before| {
            let step = reading.positions_rad - before.value.positions_rad;
            reading.velocities_rad_s.amax() <= rule.speed_rad_s && step.amax() <= rule.step_rad
        });
        if before.is_some_and(|before| at.saturating_sub(before.at) > rule.pause) {
            self.interrupted_at = Some(at);
        }
        let in_time = before.is_some_and(|before| before.value.stamp == reading.stamp);
        let (positions, velocities) = (&reading.positions_rad, &reading.velocities_rad_s);
        self.at_home
            .read(reading.stamp, positions, velocities, &rule.home_rad);
        self.still = still.then(|| Still {
            since: self.still.map_or(at, |still| still.since),
            in_time,
            stamp_since: self
                .still
                .filter(|_| in_time)
                .map_or(at, |still| still.stamp_since),
        });
        self.joints = Some(Newest::next(before, reading, at));
    }

    /// Whether the joints stand still because simulated time does: the last two readings are of the time that the clock shows, or
    /// readings have had the same stamp for `pause`, where a node that ends hears of no clock any more. A driver whose time is not that
    /// of the clock may stamp two readings of an arm that is about to move alike.
    pub fn stands_in_time(&self, clock_ns: i64, pause: Duration) -> bool {
        let (Some(joints), Some(still)) = (self.joints, self.still) else {
            return false;
        };
        let of_the_clock =
            u128::try_from(clock_ns).is_ok_and(|now| now == joints.value.stamp.as_nanos());
        let for_long = joints.at.saturating_sub(still.stamp_since) >= pause;
        still.in_time && (of_the_clock || for_long)
    }

    /// Takes the next state of the pins.
    pub fn read_pins(&mut self, pins: Pins, at: Duration) {
        if pins.disabled {
            self.disabled_at = Some(at);
        }
        self.pins = Some(Newest::next(self.pins.as_ref(), pins, at));
    }
}

impl DriverStatus {
    /// Why the arm must not move now, if there is a reason. Modes are latched, so that the streams
    /// of joint and pin states tell whether the driver is alive: neither may be older than
    /// `max_age`.
    pub fn obstacle(&self, now: Duration, max_age: Duration) -> Option<String> {
        // The safety mode is why: an emergency stop switches the power off, too.
        if let Some(stop) = self.safety_stop() {
            return Some(stop);
        }
        if self.safety_mode.is_none() {
            return Some("the driver has not published its safety mode".into());
        }
        match self.robot_mode {
            Some(RUNNING) => {}
            Some(mode) => {
                return Some(format!(
                    "robot mode is {mode}, expected RUNNING ({RUNNING})"
                ));
            }
            None => return Some("the driver has not published its robot mode".into()),
        }
        match self.program_running {
            Some(true) => {}
            Some(false) => return Some("the robot program is not running".into()),
            None => return Some("the driver has not said whether its program runs".into()),
        }
        let disabled = self.pins.is_some_and(|pins| pins.value.disabled);
        let disabled = disabled.then(|| "the enabling input is low (driver.enable_pin)".into());
        self.silence(now, max_age).or(disabled)
    }

    /// Why the driver counts as lost, if it does: neither joint nor pin states may be older than `max_age`.
    pub fn silence(&self, now: Duration, max_age: Duration) -> Option<String> {
        let arrivals = [
            ("joint_states", self.joints.map(|joints| joints.at)),
            ("io_states", self.pins.map(|pins| pins.at)),
        ];
        arrivals.into_iter().find_map(|(topic, at)| {
            let Some(at) = at else {
                return Some(format!("no {topic} have arrived"));
            };
            let age = now.saturating_sub(at);
            (age > max_age).then(|| {
                format!(
                    "the newest {topic} are {:.1} s old, expected at most {:.1} s",
                    age.as_secs_f64(),
                    max_age.as_secs_f64()
                )
            })
        })
    }

    /// The safety mode, where it is one in which the robot stops.
    pub fn safety_stop(&self) -> Option<String> {
        match self.safety_mode? {
            NORMAL | REDUCED => None,
            mode => Some(format!(
                "safety mode is {}, expected NORMAL or REDUCED",
                safety_mode_name(mode)
            )),
        }
    }

    /// Whether the enabling input is low, or has been since a time.
    pub fn is_disabled_since(&self, since: Duration) -> bool {
        self.pins.is_some_and(|pins| pins.value.disabled)
            || self.disabled_at.is_some_and(|at| at >= since)
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
mod tests {
    use super::*;

    const AGE: Duration = Duration::from_secs(1);

    /// A driver that is ready at `now`.
    fn ready(now: Duration) -> DriverStatus {
        let reading = JointReading {
            stamp: Duration::from_secs(5),
            positions_rad: Joints::zeros(),
            velocities_rad_s: Joints::zeros(),
        };
        DriverStatus {
            robot_mode: Some(RUNNING),
            safety_mode: Some(NORMAL),
            program_running: Some(true),
            joints: Some(Newest {
                value: reading,
                at: now,
                count: 1,
            }),
            still: None,
            interrupted_at: None,
            at_home: AtHome::default(),
            disabled_at: None,
            pins: Some(Newest {
                value: Pins::default(),
                at: now,
                count: 1,
            }),
        }
    }

    #[test]
    fn a_ready_driver_is_no_obstacle_until_it_falls_silent() {
        let status = ready(Duration::from_secs(10));
        assert_eq!(status.obstacle(Duration::from_secs(11), AGE), None);
        let reason = status.obstacle(Duration::from_millis(11_001), AGE).unwrap();
        assert!(reason.contains("joint_states"), "{reason}");
        let pins = Newest {
            value: Pins::default(),
            at: Duration::from_secs(8),
            count: 1,
        };
        let silent_pins = DriverStatus {
            pins: Some(pins),
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
            // An emergency stop, and the power off with it.
            (
                DriverStatus {
                    robot_mode: Some(3),
                    safety_mode: Some(7),
                    ..ready.clone()
                },
                "ROBOT_EMERGENCY_STOP",
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
                    pins: None,
                    ..ready.clone()
                },
                "io_states",
            ),
        ];
        for (status, expected) in cases {
            let reason = status.obstacle(now, AGE).unwrap();
            assert!(reason.contains(expected), "{reason}");
        }
        let mut disabled = ready.clone();
        let pins = |disabled| Pins {
            disabled,
            ..Pins::default()
        };
        disabled.read_pins(pins(true), now);
        let reason = disabled.obstacle(now, AGE).unwrap();
        assert!(reason.contains("enable_pin"), "{reason}");
        // What was low for a moment is remembered.
        disabled.read_pins(pins(false), now + AGE);
        assert_eq!(disabled.obstacle(now, AGE), None);
        assert!(disabled.is_disabled_since(now));
        assert!(!disabled.is_disabled_since(now + AGE));
        let reduced = DriverStatus {
            safety_mode: Some(REDUCED),
            ..ready
        };
        assert_eq!(reduced.obstacle(now, AGE), None);
    }

    #[test]
    fn two_readings_of_one_time_are_an_arm_at_rest_only_where_the_clock_shows_that_time() {
        let rule = StillRule {
            speed_rad_s: 1e-3,
            step_rad: 1e-4,
            pause: AGE,
            home_rad: Joints::repeat(1.1),
        };
        let mut status = ready(Duration::ZERO);
        let reading = status.joints.unwrap().value;
        let pause = Duration::from_millis(100);
        assert!(!status.stands_in_time(5_000_000_000, pause));
        status.read_joints(reading, Duration::ZERO, &rule);
        assert!(status.stands_in_time(5_000_000_000, pause));
        // Of a clock that is not the driver's.
        assert!(!status.stands_in_time(5_000_000_001, pause));
        assert!(!status.stands_in_time(-1, pause));
        // The clock is not heard any more.
        status.read_joints(reading, Duration::from_millis(99), &rule);
        assert!(!status.stands_in_time(-1, pause));
        status.read_joints(reading, Duration::from_millis(100), &rule);
        assert!(status.stands_in_time(-1, pause));
        let next = JointReading {
            stamp: reading.stamp + pause,
            ..reading
        };
        status.read_joints(next, Duration::from_millis(300), &rule);
        assert!(!status.stands_in_time(-1, pause));
    }

    #[test]
    fn joints_stand_still_when_neither_speed_nor_position_says_otherwise() {
        let rule = StillRule {
            speed_rad_s: 1e-3,
            step_rad: 1e-4,
            pause: AGE,
            home_rad: Joints::repeat(1.1),
        };
        let mut status = DriverStatus::default();
        let mut read = |at, stamp, position, speed| {
            let reading = JointReading {
                stamp: Duration::from_millis(stamp),
                positions_rad: Joints::repeat(position),
                velocities_rad_s: Joints::repeat(speed),
            };
            status.read_joints(reading, Duration::from_millis(at), &rule);
            status
                .still
                .map(|still| (still.since.as_millis(), still.in_time))
        };
        assert_eq!(read(0, 100, 1.0, 0.0), None);
        assert_eq!(read(1, 108, 1.0, 0.0), Some((1, false)));
        assert_eq!(read(2, 116, 1.00005, 0.0), Some((1, false)));
        assert_eq!(read(3, 116, 1.00005, 0.0), Some((1, true)));
        assert_eq!(read(4, 124, 1.00005, 0.01), None);
        assert_eq!(read(5, 132, 1.1, 0.0), None);
        assert_eq!(read(6, 132, 1.1, 0.0), Some((6, true)));
        let _ = read(7, 140, 1.1, 0.0);
        assert_eq!(status.joints.unwrap().count, 8);
        assert_eq!(status.interrupted_at, None);
        let late = status.joints.unwrap().value;
        status.read_joints(late, Duration::from_millis(1008), &rule);
        assert_eq!(status.interrupted_at, Some(Duration::from_millis(1008)));
        // At home since the first slow reading there.
        assert!(!status.at_home.may_be_in_view(Duration::from_millis(132)));
        assert!(status.at_home.may_be_in_view(Duration::from_millis(131)));
    }
}
