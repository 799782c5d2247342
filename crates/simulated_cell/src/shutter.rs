//! Noisy cameras of a cell whose time is the wall clock's: they take images of a still scene all the time. The noise of a set takes longer to draw
//! than the thread that moves the cell may be away.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;

use crate::{Shot, StillScene};

/// A set of images to take.
struct Job {
    scene: Arc<StillScene>,
    /// Which scene it is.
    number: u64,
    set: u64,
    time: Duration,
}

/// Takes sets of images on a thread of its own, one after the other.
pub struct Shutter {
    jobs: mpsc::SyncSender<Job>,
    /// The scene before the cameras, if there is one, ...
    scene: Option<Arc<StillScene>>,
    /// ... and its number; images of another one are not sent.
    present: Arc<AtomicU64>,
}

impl Shutter {
    /// Nothing is before the cameras. `send` gets each image that is taken, on the shutter's thread.
    pub fn new(mut send: impl FnMut(Shot<'_>) + Send + 'static) -> Self {
        // Without a place to wait: a job is taken only by a thread that is free.
        let (jobs, waiting) = mpsc::sync_channel::<Job>(0);
        let present = Arc::new(AtomicU64::new(0));
        thread::spawn({
            let present = Arc::clone(&present);
            move || {
                for job in waiting {
                    take(&job, &present, &mut send);
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
    pub fn show(&mut self, scene: Option<StillScene>) {
        self.present.fetch_add(1, Ordering::AcqRel);
        self.scene = scene.map(Arc::new);
    }

    /// Whether a still scene is before the cameras.
    pub fn has_scene(&self) -> bool {
        self.scene.is_some()
    }

    /// Takes a set of images, unless the one before is not ready yet: a camera that is too slow leaves sets out.
    pub fn take(&self, set: u64, time: Duration) {
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

fn take(job: &Job, present: &AtomicU64, send: &mut impl FnMut(Shot<'_>)) {
    let scene = &job.scene;
    for (index, camera) in scene.cameras().iter().enumerate() {
        let Some(image) = scene.take(index, job.set) else {
            continue;
        };
        if present.load(Ordering::Acquire) != job.number {
            return;
        }
        send(Shot {
            set: job.set as usize,
            index,
            camera,
            image: &image,
            time: scene.time_of(index, job.time),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::images::tests::cell;
    use std::time::Instant;

    const LIMIT: Duration = Duration::from_secs(20);

    /// A shutter that waits for a word before it sends an image: set and camera.
    fn shutter() -> (Shutter, mpsc::Sender<()>, mpsc::Receiver<(usize, usize)>) {
        let (go_on, words) = mpsc::channel();
        let (taken, images) = mpsc::channel();
        let shutter = Shutter::new(move |shot| {
            let _ = words.recv_timeout(LIMIT);
            let _ = taken.send((shot.set, shot.index));
        });
        (shutter, go_on, images)
    }

    /// Asks for a set until the thread has taken the job and sends its first image.
    fn first(
        shutter: &Shutter,
        set: u64,
        go_on: &mpsc::Sender<()>,
        images: &mpsc::Receiver<(usize, usize)>,
    ) -> (usize, usize) {
        let begun = Instant::now();
        go_on.send(()).unwrap();
        while begun.elapsed() < LIMIT {
            shutter.take(set, Duration::ZERO);
            if let Ok(image) = images.recv_timeout(Duration::from_millis(10)) {
                return image;
            }
        }
        panic!("no image");
    }

    #[test]
    fn a_shutter_that_is_busy_leaves_sets_out_and_one_without_scene_takes_nothing() {
        let (mut shutter, go_on, images) = shutter();
        shutter.take(1, Duration::ZERO);
        assert!(!shutter.has_scene());
        shutter.show(Some(cell(None).still().unwrap()));
        assert_eq!(first(&shutter, 2, &go_on, &images), (2, 0));
        // It waits with the second image of set 2.
        shutter.take(3, Duration::ZERO);
        for _ in 0..2 {
            go_on.send(()).unwrap();
        }
        let rest = [images.recv_timeout(LIMIT), images.recv_timeout(LIMIT)];
        assert_eq!(rest, [Ok((2, 1)), Ok((2, 2))]);
        assert_eq!(first(&shutter, 4, &go_on, &images), (4, 0));
    }

    #[test]
    fn images_of_a_scene_that_has_changed_are_not_sent() {
        let (mut shutter, go_on, images) = shutter();
        let mut cell = cell(None);
        shutter.show(Some(cell.still().unwrap()));
        assert_eq!(first(&shutter, 1, &go_on, &images), (1, 0));
        shutter.show(None);
        assert!(!shutter.has_scene());
        shutter.show(Some(cell.still().unwrap()));
        // The image that was on its way may still come; the third one of that set does not.
        let next = first(&shutter, 2, &go_on, &images);
        assert!(next == (1, 1) || next == (2, 0), "{next:?}");
        for _ in 0..3 {
            go_on.send(()).unwrap();
        }
        let mut rest = Vec::new();
        while rest.last() != Some(&(2, 2)) {
            if let Ok(image) = images.recv_timeout(Duration::from_millis(10)) {
                rest.push(image);
            } else {
                shutter.take(2, Duration::ZERO);
                let _ = go_on.send(());
            }
        }
        assert!(!rest.contains(&(1, 2)), "{rest:?}");
    }
}
