//! `meta/sctn.json`: what the columns of a data set do not hold, for the way back.

use bags::Demonstration;
use heightmap::Workspace;
use pick_place::{Outcome, PrimitiveSettings};
use serde::{Deserialize, Serialize};

/// Path within a data set.
pub const FILE: &str = "meta/sctn.json";

/// One entry for each episode.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Extra {
    pub episodes: Vec<Episode>,
}

/// Seeds, workspace and steps of a demonstration.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Episode {
    pub seed: u64,
    pub start_seed: u64,
    pub workspace: Workspace,
    pub steps: Vec<Step>,
}

/// A step; the action in 64 bits.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// x (m), y (m), yaw (rad) of the pick, then of the place.
    pub action: [f64; 6],
    pub module: String,
    pub delta_reward: f64,
    pub outcome: Outcome,
    pub settings: PrimitiveSettings,
}

impl From<&Demonstration> for Episode {
    fn from(demonstration: &Demonstration) -> Self {
        let steps = demonstration.steps.iter().map(|step| Step {
            action: step.action.to_array(),
            module: step.module.clone(),
            delta_reward: step.delta_reward,
            outcome: step.outcome,
            settings: step.settings,
        });
        Self {
            seed: demonstration.seed,
            start_seed: demonstration.start_seed,
            workspace: demonstration.last.workspace,
            steps: steps.collect(),
        }
    }
}
