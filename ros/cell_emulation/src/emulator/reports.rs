//! What is published of the cell: joints, pins, modes, and what the cameras see.

use std::time::{Duration, Instant};

use msgs::convert;
use msgs::rosgraph_msgs::Clock;
use msgs::std_msgs::Header;
use node_kit::Level;
use tracing::{info, warn};

use crate::goal::Goal;

use super::{Emulator, EmulatorError};

impl Emulator {
    pub(super) fn publish_modes(&self) {
        if !self.is_dead() {
            self.status.publish_modes(self.driver().fault().modes());
        }
    }

    pub(super) fn header(&self) -> Result<Header, EmulatorError> {
        let time = self.cell.time();
        Ok(convert::header(time, &self.settings.world_frame)?)
    }

    pub(super) fn publish_state(&mut self) -> Result<(), EmulatorError> {
        let period = self.status_period();
        self.schedule.on_status(Instant::now(), period);
        if self.is_dead() {
            return Ok(());
        }
        let header = self.header()?;
        if !self.settings.hardware.free_running {
            self.clock.publish(Clock {
                clock: header.stamp,
            });
        }
        let joints_rad = self.cell.joints_rad();
        let deviation_rad = self.settings.hardware.encoder_noise_rad;
        let read_rad = self.noise.read(&joints_rad, deviation_rad);
        self.status
            .publish_joints(header, &read_rad, &self.cell.velocities_rad_s());
        self.robot.publish_links(&joints_rad, self.cell.time())?;
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
            self.settings.hardware.speed_scaling,
        );
        let period = self.status_period();
        self.schedule.on_pins(Instant::now(), period);
    }

    pub(super) fn publish_changed_pins(&mut self) {
        if self.cell.pins() != self.published_pins {
            self.publish_pins();
        }
    }

    pub(super) fn publish_feedback(
        &self,
        goal: &Goal,
        elapsed: Duration,
    ) -> Result<(), EmulatorError> {
        let joints = [&self.cell.joints_rad(), &self.cell.velocities_rad_s()];
        let names = &self.work_cell.joint_names;
        Ok(goal.feedback(self.header()?, names, joints, elapsed)?)
    }

    /// Renders what the cameras see now, publishes it, and says how the simulation is.
    pub(super) fn publish_scene(&mut self) -> Result<(), EmulatorError> {
        let settled = self.cell.environment().cell().is_settled();
        if !settled {
            warn!("the bodies have not come to rest; the frames show them in motion");
        }
        self.cameras.show(&mut self.cell)?;
        self.publish_frames();
        let (environment, time) = (self.cell.environment(), self.cell.time());
        let hash = format!("{:016x}", environment.state_hash());
        let (level, said) = match settled {
            true => (Level::Ok, "at rest"),
            false => (Level::Warn, "not at rest"),
        };
        info!("{said} at {time:?}: state {hash}");
        let values = [
            ("simulated_time_s", format!("{:.9}", time.as_secs_f64())),
            ("state_hash", hash),
            ("steps", environment.steps().to_string()),
            ("total_reward", environment.total_reward().to_string()),
        ];
        self.node
            .diagnostics()
            .set("simulation", level, said, values);
        Ok(())
    }

    pub(super) fn publish_frames(&mut self) {
        let period = Duration::from_secs_f64(self.settings.frames_period_s);
        let graph = self.node.graph();
        self.cameras
            .publish(&mut self.cell, &graph, &mut self.schedule, period);
    }

    pub(super) fn status_period(&self) -> Duration {
        Duration::from_secs_f64(self.settings.status_period_s)
    }
}
