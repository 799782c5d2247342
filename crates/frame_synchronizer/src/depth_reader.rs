//! Depth images as the fusion takes them: in metres, for the pixels of the colour image.

use heightmap::{Camera, DepthRegistration, Intrinsics, Transforms, has_shape_of, scale_depth};

use super::{Image, InputError, Stream};

/// A calibration as it arrived, or what is wrong with it; none before the first.
pub type Calibration = Option<Result<Intrinsics, String>>;

/// The colour image that a depth image is brought to.
#[derive(Clone, Copy, Debug)]
pub struct ColorImage<'a> {
    /// Index of the camera, for errors.
    pub index: usize,
    /// The camera that took it.
    pub camera: &'a Camera,
    /// Name of its optical frame.
    pub frame: &'a str,
}

/// Reads the depth images of one camera.
#[derive(Debug, Default)]
pub struct DepthReader {
    /// As it was measured.
    measured_m: Vec<f32>,
    registration: DepthRegistration,
}

impl DepthReader {
    /// Fills `depth_m` from a depth image: as it is where it is of the colour image's frame and size, scaled where only the size differs,
    /// registered where the frame differs, by way of the transform between both frames and the depth image's own calibration.
    ///
    /// # Errors
    /// What is wrong with the image, or what of these is missing.
    pub fn read<I: Image>(
        &mut self,
        image: &I,
        calibration: &Calibration,
        color: &ColorImage<'_>,
        transforms: &Transforms,
        depth_m: &mut Vec<f32>,
    ) -> Result<(), InputError> {
        let ColorImage {
            index,
            camera,
            frame: color_frame,
        } = *color;
        let refuse = |stream, reason: String| InputError::new(index, stream, reason);
        let size_px = image.size_px();
        let depth_frame = image.frame();
        let expected = &camera.intrinsics;
        let read = image.read_depth(&mut self.measured_m);
        read.map_err(|error| refuse(Stream::Depth, error.to_string()))?;
        if Transforms::is_same(depth_frame, color_frame) {
            if size_px == (expected.width, expected.height) {
                std::mem::swap(depth_m, &mut self.measured_m);
            } else if has_shape_of(expected, size_px.0, size_px.1) {
                scale_depth(&self.measured_m, size_px, expected, depth_m);
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
        let intrinsics = match calibration {
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
        self.registration
            .register(&self.measured_m, &depth_camera, camera, depth_m);
        Ok(())
    }
}
