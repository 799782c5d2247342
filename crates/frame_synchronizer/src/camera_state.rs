//! What has arrived of one camera, and its images as the fusion takes them: in metres, for the pixels of the colour image.

use std::collections::VecDeque;
use std::time::Duration;

use heightmap::{Camera, Transforms};
use nalgebra::Isometry3;

use super::{Calibration, ColorImage, DepthReader, Image, InputError, Stream, Used};

/// What has arrived of one camera.
pub(super) struct CameraState<I> {
    name: String,
    /// From the calibration file, which wins over `/tf_static`.
    pub(super) fixed_pose: Option<Isometry3<f64>>,
    /// Of the colour image, from the last calibration.
    pub(super) intrinsics: Calibration,
    /// Of the depth image.
    pub(super) depth_intrinsics: Calibration,
    pub(super) color: VecDeque<(Duration, I)>,
    pub(super) depth: VecDeque<(Duration, I)>,
    pub(super) rgb: Vec<u8>,
    /// For the pixels of the colour image.
    pub(super) depth_m: Vec<f32>,
    depth_reader: DepthReader,
    /// Nothing has come for a while.
    pub(super) silent: bool,
}

impl<I: Image> CameraState<I> {
    /// Nothing has arrived yet. `fixed_pose` is that of the calibration file.
    pub(super) fn new(name: &str, fixed_pose: Option<Isometry3<f64>>) -> Self {
        Self {
            name: name.to_owned(),
            fixed_pose,
            intrinsics: None,
            depth_intrinsics: None,
            color: VecDeque::new(),
            depth: VecDeque::new(),
            rgb: Vec::new(),
            depth_m: Vec::new(),
            depth_reader: DepthReader::default(),
            silent: false,
        }
    }

    /// Converts the images nearest to a stamp. Images that cannot be used are dropped, so that they are
    /// complained about once.
    pub(super) fn view(
        &mut self,
        index: usize,
        reference: Duration,
        transforms: &Transforms,
        world_frame: &str,
    ) -> Result<(Camera, Used), Vec<InputError>> {
        let invalid = |stream, reason: String| InputError::new(index, stream, reason);
        let nearest = |waiting: &VecDeque<(Duration, I)>| {
            let stamps = waiting.iter().map(|(stamp, _)| stamp.abs_diff(reference));
            let nearest = stamps.enumerate().min_by_key(|(_, distance)| *distance);
            nearest.map(|(position, _)| position)
        };
        let (Some(color), Some(depth)) = (nearest(&self.color), nearest(&self.depth)) else {
            return Err(vec![invalid(Stream::Color, "no image".into())]);
        };
        let intrinsics = match &self.intrinsics {
            Some(Ok(intrinsics)) => *intrinsics,
            Some(Err(reason)) => {
                return Err(vec![invalid(
                    Stream::Info,
                    format!("images cannot be used without a valid calibration: {reason}"),
                )]);
            }
            None => {
                let reason = "images cannot be used without a calibration, none has arrived";
                return Err(vec![InputError::pending(index, Stream::Info, reason)]);
            }
        };
        let color_frame = self.color[color].1.frame().to_owned();
        let pose = match self.fixed_pose {
            Some(pose) => Ok(pose),
            None => transforms.world_from(&color_frame, world_frame),
        };
        let world_from_camera = match pose {
            Ok(pose) => pose,
            Err(error) => {
                let reason = format!("header.frame_id: {error}");
                return Err(vec![InputError::pending(index, Stream::Color, reason)]);
            }
        };
        let camera = Camera {
            name: self.name.clone(),
            intrinsics,
            world_from_camera,
        };
        if let Err(error) = camera.check() {
            return Err(vec![invalid(Stream::Info, error.to_string())]);
        }
        let used = Used {
            color: self.color[color].0,
            depth: self.depth[depth].0,
        };
        let mut bad = Vec::new();
        let read = self.color[color].1.read_color(&intrinsics, &mut self.rgb);
        if let Err(error) = read {
            bad.push(invalid(Stream::Color, error.to_string()));
            self.color.remove(color);
        }
        let color_image = ColorImage {
            index,
            camera: &camera,
            frame: &color_frame,
        };
        let read = self.depth_reader.read(
            &self.depth[depth].1,
            &self.depth_intrinsics,
            &color_image,
            transforms,
            &mut self.depth_m,
        );
        match read {
            Ok(()) => {}
            // It can be used when what is missing comes.
            Err(missing) if missing.pending => bad.push(missing),
            Err(refused) => {
                bad.push(refused);
                self.depth.remove(depth);
            }
        }
        if bad.is_empty() {
            Ok((camera, used))
        } else {
            Err(bad)
        }
    }
}
