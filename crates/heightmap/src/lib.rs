//! Workspace and pixel conventions, camera model, and fusion of RGB-D views into a heightmap.
//!
//! Frames: `world` is the robot base frame of REP-103 (x forward, y left, z up, metres). A camera's
//! optical frame has x right, y down, z forward. Heightmap rows run along +y, columns along +x; cell
//! (0, 0) lies at the corner of the smallest x and y.

mod camera;
mod change;
mod distortion;
mod fusion;
pub mod picture;
mod registration;
mod still;
mod transforms;
mod workspace;

pub use camera::{Camera, CameraError, Intrinsics};
pub use change::{BlobRule, Change, ChangeRules, OtherWorkspace, largest_change};
pub use distortion::{Distortion, LensError};
pub use fusion::{Fusion, FusionError, FusionReport, View};
pub use registration::{DepthRegistration, has_shape_of, scale_depth};
pub use still::{StillFusion, StillSettings};
pub use transforms::{TransformError, Transforms, Unconnected};
pub use workspace::{Disk, Heightmap, HeightmapError, Pixel, Workspace, WorkspaceError};

/// The examples of the README are run as tests.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
