//! What the driver publishes of its state: modes, joints, pins, feedback, transforms.

use std::time::Duration;

use cell_emulation::Goal;
use cell_emulation::cameras::{camera_transforms, link_transforms};
use msgs::convert::{self, ConvertError};
use msgs::rosgraph_msgs::Clock;
use msgs::std_msgs::Header;
use msgs::tf2_msgs::TFMessage;
use msgs::trajectory_msgs::JointTrajectoryPoint;
use simulated_cell::SimulatedCell;

use super::Hardware;
use ur5::WorkCell;

use crate::parameters::SimWorkcellParameters;

/// A client that sends commands reads the status; so long after the last command the status is published less often.
const ATTENTIVE: Duration = Duration::from_secs(1);
/// Factor of the status period while no client sends commands.
const INATTENTIVE_FACTOR: f64 = 5.0;

/// Where the cameras are, as their calibration has it, and the links that stand still.
pub(super) fn fixed_transforms(
    cell: &SimulatedCell,
    work_cell: &WorkCell,
    parameters: &SimWorkcellParameters,
) -> Result<TFMessage, ConvertError> {
    let (world, time) = (&parameters.world_frame, cell.time());
    let mut fixed = camera_transforms(&cell.calibrated_cameras(), world, time)?;
    if parameters.publish_robot {
        let links = link_transforms(work_cell, &work_cell.arm.home, false, world, time)?;
        fixed.transforms.extend(links.transforms);
    }
    Ok(fixed)
}

impl Hardware {
    pub(super) fn publish_modes(&self) {
        if !self.is_dead() {
            self.status.publish_modes(self.fault.modes());
        }
    }

    pub(super) fn header(&self) -> anyhow::Result<Header> {
        let time = self.cell.time();
        Ok(convert::header(time, &self.parameters.world_frame)?)
    }

    pub(super) fn publish_state(&mut self) -> anyhow::Result<()> {
        self.next_status = self.after(self.status_period_s());
        if self.is_dead() {
            return Ok(());
        }
        let header = self.header()?;
        if !self.parameters.hardware.free_running {
            self.clock.publish(Clock {
                clock: header.stamp,
            });
        }
        let deviation_rad = self.parameters.hardware.encoder_noise_rad;
        let joints_rad = self.noise.read(&self.cell.joints_rad(), deviation_rad);
        self.status
            .publish_joints(header, &joints_rad, &self.cell.velocities_rad_s());
        if let Some(tf) = &self.tf {
            tf.publish(link_transforms(
                &self.work_cell,
                &self.cell.joints_rad(),
                true,
                &self.parameters.world_frame,
                self.cell.time(),
            )?);
        }
        Ok(())
    }

    pub(super) fn publish_pins(&mut self) {
        if self.is_dead() {
            return;
        }
        self.published_pins = self.cell.pins();
        self.status.publish_io(
            &self.published_pins,
            self.cell.tool_voltage(),
            self.parameters.hardware.speed_scaling,
        );
        self.next_pins = self.after(self.status_period_s());
    }

    pub(super) fn publish_changed_pins(&mut self) {
        if self.cell.pins() != self.published_pins {
            self.publish_pins();
        }
    }

    pub(super) fn publish_feedback(&self, goal: &Goal, elapsed: Duration) -> anyhow::Result<()> {
        let point = JointTrajectoryPoint {
            positions: self.cell.joints_rad().iter().copied().collect(),
            velocities: self.cell.velocities_rad_s().iter().copied().collect(),
            time_from_start: convert::duration_to_msg(elapsed)?,
            ..Default::default()
        };
        goal.feedback(self.header()?, self.work_cell.joint_names.to_vec(), point);
        Ok(())
    }

    pub(super) fn status_period_s(&self) -> f64 {
        match self.last_command.elapsed() > ATTENTIVE {
            true => INATTENTIVE_FACTOR * self.parameters.status_period_s,
            false => self.parameters.status_period_s,
        }
    }
}
