//! What the cameras see, with where they stand, so that a proposal can be drawn on it. Images are only asked for while
//! somebody looks at them: they are most of the traffic of a cell.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use heightmap::{Intrinsics, TransformError, Transforms};
use nalgebra::Isometry3;
use serde::Serialize;

/// Images go on for so long after somebody has looked.
const LINGER: Duration = Duration::from_secs(5);

/// An image, and what is needed to draw on it.
#[derive(Clone, Debug, Default)]
struct Seen {
    /// Counts from 1.
    number: u64,
    stamp: Duration,
    frame: String,
    rgb: Arc<Vec<u8>>,
    intrinsics: Option<Intrinsics>,
}

/// The cameras.
#[derive(Debug)]
pub struct Cameras {
    world_frame: String,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    wanted_until: Option<Instant>,
    seen: BTreeMap<String, Seen>,
    transforms: Transforms,
}

/// A camera, as the API has it.
#[derive(Debug, Serialize)]
pub struct CameraState {
    name: String,
    /// Of the newest image, which counts from 1; 0 where none has come.
    number: u64,
    width_px: usize,
    height_px: usize,
    fx_px: f64,
    fy_px: f64,
    cx_px: f64,
    cy_px: f64,
    /// Model of the lens, as in `CameraInfo`.
    distortion_model: &'static str,
    /// Its coefficients, in the order of `CameraInfo.d`.
    distortion: Vec<f64>,
    /// Pose of the optical frame in the world, row by row: rotation and translation (m); `None` where it is not known.
    pose: Option<[[f64; 4]; 3]>,
}

impl Cameras {
    /// Cameras of these names, of which nothing is known.
    pub fn new(names: &[String], world_frame: &str) -> Self {
        let names = names.iter().filter(|name| !name.is_empty());
        Self {
            world_frame: world_frame.to_owned(),
            state: Mutex::new(State {
                wanted_until: None,
                seen: names.map(|name| (name.clone(), Seen::default())).collect(),
                transforms: Transforms::default(),
            }),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether somebody looks, or has looked a moment ago.
    pub fn are_wanted(&self) -> bool {
        let until = self.lock().wanted_until;
        until.is_some_and(|until| until > Instant::now())
    }

    /// Somebody looks: all cameras, and where they stand.
    pub fn look(&self) -> Vec<CameraState> {
        let mut state = self.lock();
        state.wanted_until = Some(Instant::now() + LINGER);
        let camera = |(name, seen): (&String, &Seen)| {
            let Intrinsics {
                width,
                height,
                fx_px,
                fy_px,
                cx_px,
                cy_px,
                distortion,
            } = seen.intrinsics?;
            let pose = state.transforms.world_from(&seen.frame, &self.world_frame);
            let pose = pose.ok().map(|pose| {
                let matrix = pose.to_homogeneous();
                std::array::from_fn(|row| std::array::from_fn(|col| matrix[(row, col)]))
            });
            Some(CameraState {
                name: name.clone(),
                number: seen.number,
                width_px: width,
                height_px: height,
                fx_px,
                fy_px,
                cx_px,
                cy_px,
                distortion_model: distortion.model(),
                distortion: distortion.coefficients(),
                pose,
            })
        };
        state.seen.iter().filter_map(camera).collect()
    }

    /// Number, width, height, and red, green and blue of each pixel of a camera's newest image.
    pub fn image(&self, name: &str) -> Option<(u64, usize, usize, Arc<Vec<u8>>)> {
        let state = self.lock();
        let seen = state.seen.get(name).filter(|seen| seen.number > 0)?;
        let Intrinsics { width, height, .. } = seen.intrinsics?;
        Some((seen.number, width, height, Arc::clone(&seen.rgb)))
    }

    /// The camera's calibration has come.
    pub fn on_intrinsics(&self, name: &str, intrinsics: Intrinsics) {
        if let Some(seen) = self.lock().seen.get_mut(name) {
            seen.intrinsics = Some(intrinsics);
        }
    }

    /// The calibration of a camera whose image of this stamp is to be shown: nothing before the calibration has come, and
    /// where the image is shown already.
    pub fn wants(&self, name: &str, stamp: Duration) -> Option<Intrinsics> {
        let state = self.lock();
        let seen = state.seen.get(name)?;
        let is_shown = seen.number > 0 && seen.stamp == stamp;
        seen.intrinsics.filter(|_| !is_shown)
    }

    /// An image has come: its optical frame, and red, green and blue of each pixel.
    pub fn on_image(&self, name: &str, stamp: Duration, frame: String, rgb: Vec<u8>) {
        if let Some(seen) = self.lock().seen.get_mut(name) {
            seen.number += 1;
            seen.stamp = stamp;
            seen.frame = frame;
            seen.rgb = Arc::new(rgb);
        }
    }

    /// The pose of a frame in its parent frame has come.
    ///
    /// # Errors
    /// When the frame has no name, or there are too many.
    pub fn on_transform(
        &self,
        parent: &str,
        child: &str,
        pose: Isometry3<f64>,
    ) -> Result<(), TransformError> {
        self.lock().transforms.insert(parent, child, pose)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_shown_with_calibration_and_pose_and_once_for_each_stamp() {
        let cameras = Cameras::new(&["front".into(), String::new()], "world");
        assert!(!cameras.are_wanted());
        assert!(cameras.look().is_empty());
        assert!(cameras.are_wanted());
        let [first, second] = [1, 2].map(Duration::from_secs);
        assert_eq!(cameras.wants("front", first), None);
        assert!(cameras.image("front").is_none());
        let intrinsics = Intrinsics {
            width: 3,
            height: 2,
            ..Intrinsics::RAVENS
        };
        cameras.on_intrinsics("front", intrinsics);
        assert_eq!(cameras.wants("front", first), Some(intrinsics));
        assert_eq!(cameras.wants("left", first), None);
        let image = |value: u8| [value, 0, 0].repeat(6);
        cameras.on_image("front", first, "optical".into(), image(5));
        assert_eq!(cameras.wants("front", first), None);
        let (number, width, height, rgb) = cameras.image("front").unwrap();
        assert_eq!((number, width, height, rgb[0]), (1, 3, 2, 5));
        assert!(cameras.wants("front", second).is_some());
        cameras.on_image("front", second, "optical".into(), image(6));
        assert_eq!(cameras.image("front").unwrap().0, 2);
        assert!(cameras.image("left").is_none());

        assert!(cameras.look()[0].pose.is_none());
        let along_x = |x_m| Isometry3::translation(x_m, 0.0, 0.0);
        let link = |parent, child, x_m| {
            let linked = cameras.on_transform(parent, child, along_x(x_m));
            linked.unwrap();
        };
        link("world", "link", 1.0);
        link("link", "optical", 2.0);
        let pose = cameras.look()[0].pose.unwrap();
        assert_eq!(
            pose,
            [
                [1.0, 0.0, 0.0, 3.0],
                [0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 1.0, 0.0]
            ]
        );
        // A circle of frames leads nowhere.
        link("optical", "link", 1.0);
        assert!(cameras.look()[0].pose.is_none());
    }
}
