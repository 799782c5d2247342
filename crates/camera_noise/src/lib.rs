//! What real RGB-D cameras do to clean images, drawn from a seed.

mod image;
mod model;
mod rig;

pub use model::{
    Clutter, Color, Depth, Edges, Extrinsics, Holes, Light, Perturbation, PerturbationError,
};
pub use rig::{ClutterItem, DepthSteps, Rig};

/// The example of the README is run as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
