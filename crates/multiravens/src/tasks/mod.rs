//! Task modules: one file each, one line each in [`REGISTRY`].

mod chaining;
mod placing;
mod routing;
mod stacking;

use crate::world::World;
use nalgebra::{Isometry2, Isometry3, Vector2};
use pick_place::{PickPlace, PrimitiveSettings};
use rand_chacha::ChaCha8Rng;
use serde::de::DeserializeOwned;
use serde_yaml_ng::Value;
use std::fmt;

/// All task modules: the name in problem files, and what reads their parameters.
pub const REGISTRY: &[(&str, Configure)] = &[
    ("chaining", chaining::configure),
    ("placing", placing::configure),
    ("routing", routing::configure),
    ("stacking", stacking::configure),
];

/// Reads and checks the `parameters` of a module in a problem file.
pub type Configure = fn(Value) -> Result<Box<dyn TaskModule>, ParameterError>;

/// Parameters that a module does not take.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ParameterError(pub String);

/// A task module with its parameters: what an episode's task is drawn from.
pub trait TaskModule: Send + Sync + fmt::Debug {
    /// Edge lengths, along the anchor's x and y, of the rectangle about the anchor that holds all
    /// the module's bodies at the start and in the goal.
    fn footprint_m(&self) -> Vector2<f64>;

    /// Draws a task and adds its bodies to the world, about the anchor.
    fn build(
        &self,
        world: &mut World,
        anchor: &Isometry2<f64>,
        rng: &mut ChaCha8Rng,
    ) -> Box<dyn Task>;
}

/// A task of one episode.
pub trait Task: Send {
    /// Number of delta rewards: `n` of the paper's table I (for routing also the stretch).
    fn goal_count(&self) -> usize;

    /// Steps after which an episode is over.
    fn max_steps(&self) -> usize;

    /// Heights and speeds of the primitive while this task is being solved.
    fn settings(&self) -> PrimitiveSettings;

    /// Where things should be: what the reward looks at.
    fn goal_poses(&self) -> Vec<Isometry3<f64>>;

    /// Number of goals reached, at most [`Self::goal_count`]. Called once on the settled start and
    /// once after every step, in order, so that a task may remember what was reached before.
    fn reached(&mut self, world: &World) -> usize;

    /// The next action of a stochastic demonstrator that sees the true state; nothing when there
    /// is nothing left to do.
    fn demonstrate(&mut self, world: &World, rng: &mut ChaCha8Rng) -> Option<PickPlace>;
}

/// Reads parameters; a module without any may leave them out.
fn read_parameters<P: DeserializeOwned + Default>(value: Value) -> Result<P, ParameterError> {
    match value {
        Value::Null => Ok(P::default()),
        value => serde_yaml_ng::from_value(value).map_err(|e| ParameterError(e.to_string())),
    }
}

/// Refuses a value outside a range.
fn check_range(name: &str, value: f64, low: f64, high: f64) -> Result<(), ParameterError> {
    // NaN is in no range.
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(ParameterError(format!(
            "{name} is {value}, expected {low} to {high}"
        )))
    }
}

/// A planar pose lifted to a height.
fn at_height(pose: &Isometry2<f64>, z_m: f64) -> Isometry3<f64> {
    let yaw = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, pose.rotation.angle());
    let t = pose.translation;
    Isometry3::from_parts(nalgebra::Translation3::new(t.x, t.y, z_m), yaw)
}
