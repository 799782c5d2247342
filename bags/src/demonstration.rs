//! Demonstrations: what was seen and done, step by step.

use heightmap::Heightmap;
use pick_place::{Outcome, PickPlace, PrimitiveSettings};

/// A rollout of one episode: a demonstration, a run of a policy, or an operator's approved run.
#[derive(Clone, Debug, PartialEq)]
pub struct Demonstration {
    /// Name of the problem.
    pub problem: String,
    /// Seed of the episode.
    pub seed: u64,
    /// The steps, in order.
    pub steps: Vec<DemonstrationStep>,
    /// What was seen after the last step.
    pub last: Heightmap,
}

/// One step of a demonstration.
#[derive(Clone, Debug, PartialEq)]
pub struct DemonstrationStep {
    /// What was seen before the action.
    pub observation: Heightmap,
    /// The action.
    pub action: PickPlace,
    /// Heights and speeds that the action was carried out with.
    pub settings: PrimitiveSettings,
    /// The task module that was being solved.
    pub module: String,
    /// Change of the reward by this step.
    pub delta_reward: f64,
    /// How the primitive ended.
    pub outcome: Outcome,
}

impl Demonstration {
    /// The demonstration sequence images v_1..v_D: what was seen after each positive delta reward
    /// (paper, section IV-A).
    pub fn goals(&self) -> impl Iterator<Item = &Heightmap> {
        let after = self
            .steps
            .iter()
            .skip(1)
            .map(|step| &step.observation)
            .chain([&self.last]);
        self.steps
            .iter()
            .zip(after)
            .filter(|(step, _)| step.delta_reward > 0.0)
            .map(|(_, after)| after)
    }
}

/// A bag that does not hold a demonstration. (Its reader and writer are being written.)
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct DemonstrationError(String);

impl Demonstration {
    /// Reads a demonstration.
    pub fn read(_path: &std::path::Path) -> Result<Self, DemonstrationError> {
        Err(DemonstrationError("not written yet".into()))
    }

    /// Writes a demonstration.
    pub fn write(&self, _path: &std::path::Path) -> Result<(), DemonstrationError> {
        Err(DemonstrationError("not written yet".into()))
    }
}
