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
    /// The image of the demonstration before the next-step goal, for networks conditioned on a sequence; others
    /// do not look at it.
    pub previous: Option<&'a Heightmap>,
}

impl<'a> From<&'a Heightmap> for Goal<'a> {
    fn from(image: &'a Heightmap) -> Self {
        Self {
            image,
            last: None,
            previous: None,
        }
    }
}

impl<'a> Goal<'a> {
    /// The next step of a demonstration: its images before and after, v_{k-1} and v_k.
    pub fn step(previous: &'a Heightmap, image: &'a Heightmap) -> Self {
        Self {
            image,
            last: None,
            previous: Some(previous),
        }
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
    /// Whether the goal is reached already in the observation: there is nothing to pick, and pick and place teach
    /// nothing but, to networks that say so, that the step is done.
    pub done: bool,
}
