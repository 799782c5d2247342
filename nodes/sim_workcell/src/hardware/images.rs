//! Camera images: rendered when the scene rests, and published until it changes.

use std::time::{Duration, Instant};

use cell_emulation::cameras::Frame;
use node_kit::Level;
use simulated_cell::NOISY_PERIOD;
use tracing::{info, warn};

use super::Hardware;

impl Hardware {
    /// Renders the cameras' frames and publishes them.
    pub(super) fn publish_scene(&mut self) -> anyhow::Result<()> {
        let time = self.cell.time();
        let settled = self.cell.environment().cell().is_settled();
        if !settled {
            warn!("the bodies have not come to rest; the frames show them in motion");
        }
        self.render()?;
        self.publish_frames();
        let environment = self.cell.environment();
        let level = if settled { Level::Ok } else { Level::Warn };
        let values = [
            ("simulated_time_s", format!("{:.9}", time.as_secs_f64())),
            ("state_hash", format!("{:016x}", environment.state_hash())),
            ("steps", environment.steps().to_string()),
            ("total_reward", environment.total_reward().to_string()),
        ];
        let said = if settled { "at rest" } else { "not at rest" };
        self.node
            .diagnostics()
            .set("simulation", level, said, values);
        info!(
            "{said} at {time:?}: state {:016x}",
            environment.state_hash()
        );
        Ok(())
    }

    /// Renders what the cameras see now.
    pub(super) fn render(&mut self) -> anyhow::Result<()> {
        if let Some(shutter) = &mut self.shutter {
            shutter.show(Some(self.cell.still()?));
            return Ok(());
        }
        let mut frames: Vec<Vec<_>> = Vec::new();
        self.cell.take_images(|shot| {
            frames.resize_with(shot.set + 1, Vec::new);
            let frame = Frame::new(shot.camera, shot.image, shot.time)?;
            frames[shot.set].push((shot.index, frame));
            anyhow::Ok(())
        })?;
        self.frames = frames;
        self.next_set = 0;
        Ok(())
    }

    /// The scene is not still any more.
    pub(super) fn forget_scene(&mut self) {
        self.frames.clear();
        if let Some(shutter) = &mut self.shutter {
            shutter.show(None);
        }
    }

    pub(super) fn publish_frames(&mut self) {
        if let Some(shutter) = &self.shutter {
            // Nobody has to see what costs a core.
            let graph = self.node.graph();
            if shutter.has_scene() && self.cameras.iter().any(|camera| camera.is_watched(&graph)) {
                let set = self.cell.count_set();
                shutter.take(set, self.cell.time());
            }
            // In time, however long something else took.
            let period = Duration::from_secs_f64(self.parameters.frames_period_s);
            self.next_frames = (self.next_frames + period).max(Instant::now());
            return;
        }
        for (camera, frame) in self.frames.get(self.next_set).into_iter().flatten() {
            self.cameras[*camera].publish(frame.clone());
        }
        self.next_set += 1;
        if self.next_set < self.frames.len() {
            self.next_frames = self.after(NOISY_PERIOD.as_secs_f64());
        } else {
            self.next_set = 0;
            self.next_frames = self.after(self.parameters.frames_period_s);
        }
    }
}
