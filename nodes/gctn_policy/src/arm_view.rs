//! Whether a heightmap may show the arm.

use std::future::pending;
use std::time::Duration;

use msgs::{convert, sensor_msgs::JointState};
use node_kit::{Node, Qos, Subscription};
use ur5::{AtHome, WorkCell};

use crate::GctnPolicyParameters;

/// Follows the arm, where that is asked for.
pub(crate) struct ArmView {
    work_cell: WorkCell,
    at_home: AtHome,
    /// Nothing where heightmaps count wherever the arm is.
    joint_states: Option<Subscription<JointState>>,
}

impl ArmView {
    pub(crate) fn new(node: &Node, parameters: &GctnPolicyParameters) -> anyhow::Result<Self> {
        let work_cell = node_kit::load_work_cell(&parameters.urdf)?;
        let joint_states = match parameters.observation_needs_home {
            true => Some(node.subscription("joint_states", Qos::Event)?),
            false => None,
        };
        Ok(Self {
            work_cell,
            at_home: AtHome::default(),
            joint_states,
        })
    }

    /// Waits for the next reading of the joints, and takes it; for ever where the arm is not followed.
    pub(crate) async fn follow(&mut self) {
        match &mut self.joint_states {
            Some(joint_states) => {
                let message = joint_states.recv().await;
                self.read(&message);
            }
            None => pending().await,
        }
    }

    /// Whether the arm may be seen in a heightmap of that stamp, which has just arrived.
    pub(crate) fn may_show_arm(&mut self, stamp: Duration) -> bool {
        while let Some(message) = self.joint_states.as_mut().and_then(Subscription::try_recv) {
            self.read(&message);
        }
        self.joint_states.is_some() && self.at_home.may_be_in_view(stamp)
    }

    fn read(&mut self, message: &JointState) {
        match convert::joint_reading_from_msg(message, &self.work_cell.joint_names) {
            Ok(reading) => self.at_home.read(
                reading.stamp,
                &reading.positions_rad,
                &reading.velocities_rad_s,
                &self.work_cell.arm.home,
            ),
            Err(error) => {
                if let Some(joint_states) = &mut self.joint_states {
                    joint_states.reject(error);
                }
            }
        }
    }
}
