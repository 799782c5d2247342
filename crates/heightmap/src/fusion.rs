//! Fusion of RGB-D views into a heightmap.

use crate::{Camera, Heightmap};

/// One RGB-D image and the camera that took it.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Row-major, three bytes a pixel.
    pub rgb: &'a [u8],
    /// Row-major distance along the optical axis; 0 or not finite where nothing was measured.
    pub depth_m: &'a [f32],
}

/// What a fusion has used.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FusionReport {
    /// Number of views.
    pub views: usize,
    /// Share of cells that at least one view saw.
    pub coverage: f64,
}

/// A view that does not fit its camera.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum FusionError {
    /// An image has another size than its camera's.
    #[error("camera {camera}: {what} has {actual} elements, expected {expected}")]
    Size {
        /// Name of the camera.
        camera: String,
        /// Which image.
        what: &'static str,
        /// Elements found.
        actual: usize,
        /// Elements expected.
        expected: usize,
    },
}

/// Fuses views; owns the scratch memory so that a fusion allocates nothing.
#[derive(Debug, Default)]
pub struct Fusion {}

impl Fusion {
    /// Highest point per cell wins; colour is the mean over the views that saw the cell
    /// (Zeng et al., CoRL 2020). Overwrites `out`, whose workspace says what to cover.
    pub fn fuse(
        &mut self,
        _views: &[View<'_>],
        _out: &mut Heightmap,
    ) -> Result<FusionReport, FusionError> {
        todo!()
    }
}
