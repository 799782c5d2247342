//! The cameras of a simulated cell: they publish a scene for as long as it is still.

use std::sync::Arc;
use std::time::Duration;

use msgs::convert::ConvertError;
use multiravens::render::RenderError;
use node_kit::{Graph, Node, NodeError};
use simulated_cell::{NOISY_PERIOD, PublishSchedule, Shutter, SimulatedCell};
use tracing::warn;

use crate::cameras::{CameraTopics, Frame};

/// The cameras' topics, and what is published on them.
pub struct SceneCameras {
    topics: Arc<Vec<CameraTopics>>,
    /// Of noisy cameras where time goes on by itself.
    shutter: Option<Shutter>,
    /// What the cameras saw at this rest: one set of perfect cameras, several of noisy ones.
    sets: FrameSets<(usize, Frame)>,
}

/// Why a scene cannot be published.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// It cannot be rendered.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Its time is none of ROS.
    #[error(transparent)]
    Convert(#[from] ConvertError),
}

impl SceneCameras {
    /// Offers the topics of the cell's cameras.
    ///
    /// # Errors
    /// The middleware refuses.
    pub fn new(node: &Node, cell: &SimulatedCell, free_running: bool) -> Result<Self, NodeError> {
        let cameras = cell.environment().cell().cameras();
        let topics = cameras
            .iter()
            .map(|camera| CameraTopics::new(node, &camera.name));
        let topics: Arc<Vec<CameraTopics>> = Arc::new(topics.collect::<Result<_, _>>()?);
        let has_shutter = free_running && cell.environment().rig().is_some();
        let shutter = has_shutter.then(|| {
            let topics = Arc::clone(&topics);
            Shutter::new(
                move |shot| match Frame::new(shot.camera, shot.image, shot.time) {
                    Ok(frame) => topics[shot.index].publish(frame),
                    Err(error) => warn!("camera {}: {error}", shot.camera.name),
                },
            )
        });
        Ok(Self {
            topics,
            shutter,
            sets: FrameSets::default(),
        })
    }

    /// Whether they take images of a still scene anew, rather than that it has to be rendered again.
    pub fn take_anew(&self) -> bool {
        self.shutter.is_some()
    }

    /// Renders what is before them now.
    ///
    /// # Errors
    /// When it cannot be rendered.
    pub fn show(&mut self, cell: &mut SimulatedCell) -> Result<(), SceneError> {
        if let Some(shutter) = &mut self.shutter {
            shutter.show(Some(cell.still()?));
            return Ok(());
        }
        let mut sets: Vec<Vec<_>> = Vec::new();
        cell.take_images(|shot| {
            sets.resize_with(shot.set + 1, Vec::new);
            let frame = Frame::new(shot.camera, shot.image, shot.time)?;
            sets[shot.set].push((shot.index, frame));
            Ok::<_, SceneError>(())
        })?;
        self.sets = FrameSets { sets, next: 0 };
        Ok(())
    }

    /// The scene is not still any more.
    pub fn hide(&mut self) {
        self.sets = FrameSets::default();
        if let Some(shutter) = &mut self.shutter {
            shutter.show(None);
        }
    }

    /// Publishes the next set of images, and says when the one after it is due: all sets of a rest follow each other, and are repeated after a
    /// period.
    pub fn publish(
        &mut self,
        cell: &mut SimulatedCell,
        graph: &Graph,
        schedule: &mut PublishSchedule,
        period: Duration,
    ) {
        if let Some(shutter) = &self.shutter {
            // Nobody has to see what costs a core.
            let is_watched = || self.topics.iter().any(|camera| camera.is_watched(graph));
            if shutter.has_scene() && is_watched() {
                shutter.take(cell.count_set(), cell.time());
            }
            schedule.on_shutter(std::time::Instant::now(), period);
            return;
        }
        let (set, is_last) = self.sets.advance();
        for (camera, frame) in set {
            self.topics[*camera].publish(frame.clone());
        }
        let after = if is_last { period } else { NOISY_PERIOD };
        schedule.on_frames(std::time::Instant::now(), after);
    }
}

/// Sets of frames, one after the other, again and again.
struct FrameSets<F> {
    sets: Vec<Vec<F>>,
    next: usize,
}

impl<F> Default for FrameSets<F> {
    fn default() -> Self {
        Self {
            sets: Vec::new(),
            next: 0,
        }
    }
}

impl<F> FrameSets<F> {
    /// The next set, and whether it is the last one before all are repeated. No frames where there are no sets.
    fn advance(&mut self) -> (&[F], bool) {
        let set = self.sets.get(self.next).map_or(&[][..], Vec::as_slice);
        let is_last = self.next + 1 >= self.sets.len();
        self.next = if is_last { 0 } else { self.next + 1 };
        (set, is_last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_sets_come_one_after_the_other_and_again() {
        let mut sets = FrameSets {
            sets: vec![vec![1, 2], vec![3]],
            next: 0,
        };
        let seen: Vec<_> = (0..3)
            .map(|_| {
                let (set, is_last) = sets.advance();
                (set.to_vec(), is_last)
            })
            .collect();
        assert_eq!(
            seen,
            [(vec![1, 2], false), (vec![3], true), (vec![1, 2], false)]
        );
        assert_eq!(FrameSets::<u8>::default().advance(), (&[][..], true));
    }
}
