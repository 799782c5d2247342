//! Training samples.

use heightmap::Heightmap;
use nalgebra::Isometry2;

/// One step of a demonstration: what was seen, what it should become, what was done.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    /// What was seen before the step.
    pub observation: &'a Heightmap,
    /// What to get nearer to.
    pub goal: &'a Heightmap,
    /// Where the gripper picked, in the world.
    pub pick: Isometry2<f64>,
    /// Where it placed, in the world. The object was turned by the yaw of place less that of pick.
    pub place: Isometry2<f64>,
}
