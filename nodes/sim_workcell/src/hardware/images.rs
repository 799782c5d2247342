//! Camera images: rendered when the scene rests, and published until it changes.

use std::time::Duration;

use camera_noise::Rig;
use cell_emulation::cameras::Frame;
use heightmap::Camera;
use msgs::convert::ConvertError;
use multiravens::render::RgbdImage;
use node_kit::Level;
use tracing::{info, warn};

use super::Hardware;

/// Period of noisy cameras: 30 Hz.
const NOISY_PERIOD: Duration = Duration::from_nanos(33_333_333);
/// They run free: each takes its images this much after the one before it, so that the first and the last of three are 14 ms apart.
const NOISY_OFFSET: Duration = Duration::from_millis(7);

/// What noisy cameras take of a still scene: as many sets as their model says, one after the other, each image with noise of its own.
pub(super) fn noisy_sets(
    rig: &Rig,
    cameras: &[Camera],
    images: &[RgbdImage],
    time: Duration,
    taken: u64,
) -> Result<Vec<Vec<(usize, Frame)>>, ConvertError> {
    let mut sets = Vec::new();
    for set in 0..rig.model().frames as u32 {
        let mut frames = Vec::new();
        for (index, (camera, image)) in cameras.iter().zip(images).enumerate() {
            if rig.is_missing(index) {
                continue;
            }
            let mut image = image.clone();
            let frame = taken + u64::from(set);
            rig.apply(
                index,
                &camera.intrinsics,
                frame,
                &mut image.rgb,
                &mut image.depth_m,
            );
            let stamp = time + set * NOISY_PERIOD + index as u32 * NOISY_OFFSET;
            frames.push((index, Frame::new(camera, &image, stamp)?));
        }
        sets.push(frames);
    }
    Ok(sets)
}

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
        let time = self.cell.time();
        let rig = self.cell.environment().rig().cloned();
        let cell = self.cell.environment_mut().cell_mut();
        let cameras = cell.cameras().to_vec();
        let images = cell.render()?;
        self.frames = match &rig {
            None => {
                let frames = cameras.iter().zip(images).enumerate();
                let frames = frames
                    .map(|(index, (camera, image))| Ok((index, Frame::new(camera, image, time)?)));
                vec![frames.collect::<Result<_, ConvertError>>()?]
            }
            Some(rig) => noisy_sets(rig, &cameras, images, time, self.sets_taken)?,
        };
        self.sets_taken += self.frames.len() as u64;
        self.next_set = 0;
        Ok(())
    }

    pub(super) fn publish_frames(&mut self) {
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
