//! Noisy cameras of a cell whose time is the wall clock's: they take images of a still scene all the time. The noise of a set takes longer to draw
//! than the hardware's thread may be away.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;

use cell_emulation::cameras::{CameraTopics, Frame};
use simulated_cell::StillScene;
use tracing::warn;

/// A set of images to take.
struct Job {
    scene: Arc<StillScene>,
    /// Which scene it is.
    number: u64,
    set: u64,
    time: Duration,
}

/// Takes sets of images on a thread of its own, one after the other.
pub(super) struct Shutter {
    jobs: mpsc::SyncSender<Job>,
    /// The scene before the cameras, if there is one, ...
    scene: Option<Arc<StillScene>>,
    /// ... and its number; images of another one are not sent.
    present: Arc<AtomicU64>,
}

impl Shutter {
    pub(super) fn new(cameras: Arc<Vec<CameraTopics>>) -> Self {
        // Without a place to wait: a job is taken only by a thread that is free.
        let (jobs, waiting) = mpsc::sync_channel::<Job>(0);
        let present = Arc::new(AtomicU64::new(0));
        thread::spawn({
            let present = Arc::clone(&present);
            move || {
                for job in waiting {
                    take(&job, &cameras, &present);
                }
            }
        });
        Self {
            jobs,
            scene: None,
            present,
        }
    }

    /// Another scene is before the cameras, or one that moves.
    pub(super) fn show(&mut self, scene: Option<StillScene>) {
        self.present.fetch_add(1, Ordering::AcqRel);
        self.scene = scene.map(Arc::new);
    }

    pub(super) fn has_scene(&self) -> bool {
        self.scene.is_some()
    }

    /// Takes a set of images, unless the one before is not ready yet: a camera that is too slow leaves sets out.
    pub(super) fn take(&self, set: u64, time: Duration) {
        let Some(scene) = &self.scene else {
            return;
        };
        let job = Job {
            scene: Arc::clone(scene),
            number: self.present.load(Ordering::Acquire),
            set,
            time,
        };
        // Full: the thread is not free.
        let _ = self.jobs.try_send(job);
    }
}

fn take(job: &Job, topics: &[CameraTopics], present: &AtomicU64) {
    let scene = &job.scene;
    for (index, (camera, topics)) in scene.cameras().iter().zip(topics).enumerate() {
        let Some(image) = scene.take(index, job.set) else {
            continue;
        };
        if present.load(Ordering::Acquire) != job.number {
            return;
        }
        match Frame::new(camera, &image, scene.time_of(index, job.time)) {
            Ok(frame) => topics.publish(frame),
            Err(error) => warn!("camera {}: {error}", camera.name),
        }
    }
}
