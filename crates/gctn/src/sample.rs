//! Training samples.

use heightmap::Heightmap;
use nalgebra::Isometry2;

/// What the observation should become.
#[derive(Clone, Copy, Debug)]
pub struct Goal<'a> {
    /// The next-step goal, or the final one of a network that is conditioned on it alone.
    pub image: &'a Heightmap,
    /// The final goal, for networks conditioned on both.
    pub last: Option<&'a Heightmap>,
}

impl<'a> From<&'a Heightmap> for Goal<'a> {
    fn from(image: &'a Heightmap) -> Self {
        Self { image, last: None }
    }
}

impl<'a> Goal<'a> {
    /// The images there are.
    pub(crate) fn images(self) -> impl Iterator<Item = &'a Heightmap> {
        std::iter::once(self.image).chain(self.last)
    }
}

/// One step of a demonstration: what was seen, what it should become, what was done.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    /// What was seen before the step.
    pub observation: &'a Heightmap,
    /// What to get nearer to.
    pub goal: Goal<'a>,
    /// Where the gripper picked, in the world.
    pub pick: Isometry2<f64>,
    /// Where it placed, in the world. The object was turned by the yaw of place less that of pick.
    pub place: Isometry2<f64>,
}
