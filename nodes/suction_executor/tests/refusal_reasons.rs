//! What the driver says of itself has the reason that a person can do something about.

use std::time::Duration;

use step_protocol::RefusalReason;
use ur_driver::status::{DriverStatus, Newest, Pins};

const NOW: Duration = Duration::from_secs(100);
const MAX_AGE: Duration = Duration::from_secs(1);

/// A robot that may move, but for its joints, which nobody has read.
fn status() -> DriverStatus {
    let mut status = DriverStatus {
        robot_mode: Some(7),
        safety_mode: Some(1),
        program_running: Some(true),
        ..DriverStatus::default()
    };
    status.read_pins(Pins::default(), NOW);
    status
}

#[test]
fn every_obstacle_of_the_driver_has_its_reason() {
    let silent = status();
    let none = DriverStatus::default();
    let mut off = status();
    off.robot_mode = Some(3);
    let mut unknown_mode = status();
    unknown_mode.robot_mode = None;
    let mut stopped = status();
    stopped.safety_mode = Some(3);
    let mut idle = status();
    idle.program_running = Some(false);
    let mut unknown_program = status();
    unknown_program.program_running = None;
    for (status, reason) in [
        (silent, RefusalReason::DriverSilent),
        (none, RefusalReason::DriverSilent),
        (off, RefusalReason::RobotMode),
        (unknown_mode, RefusalReason::DriverSilent),
        (stopped, RefusalReason::SafetyMode),
        (idle, RefusalReason::RobotProgram),
        (unknown_program, RefusalReason::DriverSilent),
    ] {
        let text = status.obstacle(NOW, MAX_AGE).expect("an obstacle");
        assert_eq!(RefusalReason::of_text(&text), reason, "{text}");
    }
}

#[test]
fn pins_that_are_old_or_disabled_have_their_reason() {
    let joints = ur_joints();
    let mut old = status();
    old.joints = Some(joints);
    let late = NOW + Duration::from_secs(5);
    let text = old.obstacle(late, MAX_AGE).expect("an obstacle");
    let reason = RefusalReason::of_text(&text);
    assert_eq!(reason, RefusalReason::DriverSilent, "{text}");
    let mut disabled = old;
    let pins = Pins {
        disabled: true,
        ..Pins::default()
    };
    disabled.read_pins(pins, NOW);
    let text = disabled.obstacle(NOW, MAX_AGE).expect("an obstacle");
    assert_eq!(
        RefusalReason::of_text(&text),
        RefusalReason::Disabled,
        "{text}"
    );
}

fn ur_joints() -> Newest<msgs::convert::JointReading> {
    let reading = msgs::convert::JointReading {
        stamp: NOW,
        positions_rad: ur5::Joints::zeros(),
        velocities_rad_s: ur5::Joints::zeros(),
    };
    Newest::next(None, reading, NOW)
}
