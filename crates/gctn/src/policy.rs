//! Decisions.

use heightmap::Heightmap;
use nalgebra::Isometry2;
use std::path::Path;

use crate::{Device, Error, ModelCard, NetworkConfig, Precision};

/// A trained network that decides.
#[derive(Debug)]
pub struct Policy {}

/// Probabilities over a grid that covers the heightmap.
#[derive(Clone, Debug, PartialEq)]
pub struct ScoreMap {
    /// Rows (along +y).
    pub rows: usize,
    /// Columns (along +x).
    pub cols: usize,
    /// Row-major probabilities.
    pub scores: Vec<f32>,
}

/// Where to pick and where to place.
#[derive(Clone, Debug, PartialEq)]
pub struct Decision {
    /// Where to pick, in the world; yaw 0.
    pub pick: Isometry2<f64>,
    /// Where to place, in the world; the object is to be turned by its yaw, in (-pi, pi].
    pub place: Isometry2<f64>,
    /// Probability of the picked cell.
    pub pick_score: f64,
    /// Probability of the placed cell and rotation.
    pub place_score: f64,
    /// Probabilities of pick cells; excluded ones have 0.
    pub pick_map: ScoreMap,
    /// Probabilities of place cells at the rotation decided on. They sum to less than 1: the rest is with
    /// the other rotations.
    pub place_map: ScoreMap,
}

impl Policy {
    /// Loads a checkpoint for the processor in 32-bit floats.
    pub fn load(path: &Path) -> Result<Self, Error> {
        Self::load_for(path, Device::Cpu, Precision::F32)
    }

    /// Loads a checkpoint. Refuses another version, missing, further or misshapen tensors, numbers that
    /// are not finite and truncated files.
    pub fn load_for(_path: &Path, _device: Device, _precision: Precision) -> Result<Self, Error> {
        todo!()
    }

    /// The network's configuration.
    pub fn config(&self) -> &NetworkConfig {
        todo!()
    }

    /// What its maker wrote about it.
    pub fn card(&self) -> &ModelCard {
        todo!()
    }

    /// Decides where to pick and where to place, given what is seen and what it should become. Cells near
    /// an excluded pick (world) are left out. The same input and number of threads give the same bits.
    pub fn decide(
        &self,
        _observation: &Heightmap,
        _goal: &Heightmap,
        _exclude: &[Isometry2<f64>],
    ) -> Result<Decision, Error> {
        todo!()
    }
}
