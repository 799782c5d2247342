//! The driver's topics, as a status.

use std::time::{Duration, Instant};

use msgs::convert::{self, pin_level};
use msgs::sensor_msgs::JointState;
use msgs::std_msgs::Bool;
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::IOStates;
use node_kit::{Node, NodeError, Qos, TaskGroup};
use tokio::sync::watch;
use ur5::WorkCell;

use crate::DriverParameters;
use crate::status::{DriverStatus, Pins, StillRule};

/// Joints move less than this from one reading to the next while they stand still: the noise of encoders of 2e-5 rad.
const STILL_STEP_RAD: f64 = 2e-4;

/// Keeps the newest status of the driver, also while a motion is stopped because the node ends.
pub(crate) fn follow_status(
    node: &Node,
    tasks: &TaskGroup,
    driver: &DriverParameters,
    work_cell: &WorkCell,
    origin: Instant,
) -> Result<watch::Receiver<DriverStatus>, NodeError> {
    let topic = |name| format!("{}/{name}", driver.io_and_status);
    let mut joint_states = node.subscription::<JointState>("joint_states", Qos::Event)?;
    let mut io_states = node.subscription::<IOStates>(&topic("io_states"), Qos::Event)?;
    let mut robot_modes = node.subscription::<RobotMode>(&topic("robot_mode"), Qos::Latched)?;
    let mut safety_modes = node.subscription::<SafetyMode>(&topic("safety_mode"), Qos::Latched)?;
    let mut running = node.subscription::<Bool>(&topic("robot_program_running"), Qos::Latched)?;
    let joint_names = work_cell.joint_names.clone();
    let (suction_pin, vacuum_pin) = (driver.suction_pin, driver.vacuum_pin);
    let enable_pin = u8::try_from(driver.enable_pin).ok();
    let rule = StillRule {
        speed_rad_s: driver.rest_speed_rad_s,
        step_rad: STILL_STEP_RAD,
        pause: Duration::from_secs_f64(driver.status_max_age_s),
        home_rad: work_cell.arm.home,
    };
    let (sender, receiver) = watch::channel(DriverStatus::default());
    tasks.spawn(async move {
        loop {
            tokio::select! {
                message = joint_states.recv() => match convert::joint_reading_from_msg(&message, &joint_names) {
                    Ok(reading) => sender.send_modify(|status| {
                        status.read_joints(reading, origin.elapsed(), &rule);
                    }),
                    Err(error) => joint_states.reject(error),
                },
                message = io_states.recv() => {
                    let suction = pin_level(&message.digital_out_states, suction_pin);
                    let vacuum = pin_level(&message.digital_in_states, vacuum_pin);
                    let enabled = match enable_pin {
                        Some(pin) => pin_level(&message.digital_in_states, pin),
                        None => Some(true),
                    };
                    match (suction, vacuum, enabled) {
                        (Some(suction), Some(vacuum), Some(enabled)) => sender.send_modify(|status| {
                            let pins = Pins { suction, vacuum, disabled: !enabled };
                            status.read_pins(pins, origin.elapsed());
                        }),
                        _ => io_states.reject(format_args!(
                            "expected digital_out_states of pin {suction_pin} and digital_in_states of pins {vacuum_pin}{}",
                            enable_pin.map_or_else(String::new, |pin| format!(" and {pin}"))
                        )),
                    }
                }
                message = robot_modes.recv() => {
                    sender.send_modify(|status| status.robot_mode = Some(message.mode));
                }
                message = safety_modes.recv() => {
                    sender.send_modify(|status| status.safety_mode = Some(message.mode));
                }
                message = running.recv() => {
                    sender.send_modify(|status| status.program_running = Some(message.data));
                }
            }
        }
    });
    Ok(receiver)
}
