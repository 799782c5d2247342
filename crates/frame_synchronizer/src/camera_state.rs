//! What has arrived of one camera, and its images as the fusion takes them: in metres, for the pixels of the colour image.

use std::collections::VecDeque;
use std::time::Duration;

use heightmap::{Camera, Intrinsics, Transforms, has_shape_of, register_depth, scale_depth};
use nalgebra::Isometry3;

use super::{Image, InputError, Stream, Used};

/// A calibration as it arrived, or what is wrong with it; none before the first.
type Calibration = Option<Result<Intrinsics, String>>;

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
    /// As it was measured.
    measured_m: Vec<f32>,
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
            measured_m: Vec::new(),
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
        match self.register(index, depth, &color_frame, &camera, transforms) {
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

    /// Fills `depth_m` from a depth image: as it is where it is of the colour image's frame and size, scaled where only the size differs,
    /// registered where the frame differs, by way of the transform between both frames and the depth image's own calibration.
    fn register(
        &mut self,
        index: usize,
        depth: usize,
        color_frame: &str,
        camera: &Camera,
        transforms: &Transforms,
    ) -> Result<(), InputError> {
        let refuse = |stream, reason: String| InputError::new(index, stream, reason);
        let image = &self.depth[depth].1;
        let size_px = image.size_px();
        let depth_frame = image.frame();
        let expected = &camera.intrinsics;
        let read = image.read_depth(&mut self.measured_m);
        read.map_err(|error| refuse(Stream::Depth, error.to_string()))?;
        if Transforms::is_same(depth_frame, color_frame) {
            if size_px == (expected.width, expected.height) {
                std::mem::swap(&mut self.depth_m, &mut self.measured_m);
            } else if has_shape_of(expected, size_px.0, size_px.1) {
                scale_depth(&self.measured_m, size_px, expected, &mut self.depth_m);
            } else {
                return Err(refuse(
                    Stream::Depth,
                    format!(
                        "width and height are {} and {}, expected those of the colour image, {} and {}, or the same shape in another \
                         size",
                        size_px.0, size_px.1, expected.width, expected.height
                    ),
                ));
            }
            return Ok(());
        }
        let differ = format!(
            "header.frame_id is {depth_frame:?}, expected that of the colour image, {color_frame:?}, since depth must be registered to it"
        );
        let Some(color_from_depth) = transforms.between(color_frame, depth_frame) else {
            let reason = format!("{differ}, or transforms between the two frames");
            return Err(InputError::pending(index, Stream::Depth, reason));
        };
        let intrinsics = match &self.depth_intrinsics {
            Some(Ok(intrinsics)) => *intrinsics,
            Some(Err(reason)) => {
                let reason =
                    format!("{differ}, or a valid calibration of the depth image: {reason}");
                return Err(refuse(Stream::DepthInfo, reason));
            }
            None => {
                let reason =
                    format!("{differ}, or a calibration of the depth image, none has arrived");
                return Err(InputError::pending(index, Stream::DepthInfo, reason));
            }
        };
        let depth_camera = Camera {
            name: format!("{} depth", camera.name),
            intrinsics,
            world_from_camera: camera.world_from_camera * color_from_depth,
        };
        let checked = depth_camera.check();
        checked.map_err(|error| refuse(Stream::DepthInfo, error.to_string()))?;
        if size_px != (intrinsics.width, intrinsics.height) {
            return Err(refuse(
                Stream::Depth,
                format!(
                    "width and height are {} and {}, expected those of its calibration, {} and {}",
                    size_px.0, size_px.1, intrinsics.width, intrinsics.height
                ),
            ));
        }
        register_depth(&self.measured_m, &depth_camera, camera, &mut self.depth_m);
        Ok(())
    }
}
