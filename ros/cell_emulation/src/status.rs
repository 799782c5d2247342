//! What the driver publishes of the robot's state.

use driver_model::Modes;
use msgs::convert;
use msgs::sensor_msgs::JointState;
use msgs::std_msgs::{Bool, Float64, Header};
use msgs::ur_dashboard_msgs::{RobotMode, SafetyMode};
use msgs::ur_msgs::{IOStates, ToolDataMsg};
use node_kit::{Node, NodeError, Publisher, Qos};
use simulated_cell::Pins;
use ur5::Joints;

use crate::pins::pins_to_msg;

/// The driver's status topics.
pub struct StatusPublishers {
    joint_names: [String; 6],
    joint_states: Publisher<JointState>,
    io_states: Publisher<IOStates>,
    tool_data: Publisher<ToolDataMsg>,
    /// Percent.
    speed_scaling: Publisher<Float64>,
    robot_mode: Publisher<RobotMode>,
    safety_mode: Publisher<SafetyMode>,
    program_running: Publisher<Bool>,
}

impl StatusPublishers {
    /// Offers the topics, with the names of the arm's joints.
    ///
    /// # Errors
    /// The middleware refuses.
    pub fn new(node: &Node, joint_names: &[String; 6]) -> Result<Self, NodeError> {
        let status = |name| format!("io_and_status_controller/{name}");
        let scaling = "speed_scaling_state_broadcaster/speed_scaling";
        Ok(Self {
            joint_names: joint_names.clone(),
            joint_states: node.publisher("joint_states", Qos::Event)?,
            io_states: node.publisher(&status("io_states"), Qos::Event)?,
            tool_data: node.publisher(&status("tool_data"), Qos::Event)?,
            speed_scaling: node.publisher(scaling, Qos::Event)?,
            robot_mode: node.publisher(&status("robot_mode"), Qos::Latched)?,
            safety_mode: node.publisher(&status("safety_mode"), Qos::Latched)?,
            program_running: node.publisher(&status("robot_program_running"), Qos::Latched)?,
        })
    }

    /// Publishes where the joints are and how fast they move.
    pub fn publish_joints(
        &self,
        header: Header,
        positions_rad: &Joints,
        velocities_rad_s: &Joints,
    ) {
        let state =
            convert::joint_state_to_msg(header, &self.joint_names, positions_rad, velocities_rad_s);
        self.joint_states.publish(state);
    }

    /// Publishes all pins, the tool's voltage and how much of the commanded speed the arm has (fraction of 1).
    pub fn publish_io(&self, pins: &Pins, tool_voltage: u8, speed_scaling: f64) {
        self.tool_data.publish(ToolDataMsg {
            tool_output_voltage: tool_voltage,
            tool_mode: ToolDataMsg::TOOL_RUNNING_MODE,
            ..Default::default()
        });
        self.speed_scaling.publish(Float64 {
            data: 100.0 * speed_scaling,
        });
        self.io_states.publish(pins_to_msg(pins));
    }

    /// Publishes robot mode, safety mode and whether the driver's program runs.
    pub fn publish_modes(&self, modes: Modes) {
        self.robot_mode.publish(RobotMode {
            mode: modes.robot_mode,
        });
        self.safety_mode.publish(SafetyMode {
            mode: modes.safety_mode,
        });
        self.program_running.publish(Bool {
            data: modes.program_running,
        });
    }
}
