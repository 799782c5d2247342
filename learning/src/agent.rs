//! The agents of the paper (section VI-A).

use crate::sampling::Sampling;
use gctn::GoalConditioning;
use serde::{Deserialize, Serialize};
use std::fmt;

/// An agent of the paper: what it is conditioned on, and which steps it learns from how often.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Agent {
    /// Final goal, all steps alike.
    Gctn,
    /// Final goal, step weights.
    GctnStep,
    /// Final goal, modules alike, step weights.
    GctnUnifStep,
    /// Final goal, modules by complexity, step weights.
    GctnCompStep,
    /// Next-step goal, all steps alike.
    Sctn,
    /// Next-step goal, step weights.
    SctnStep,
    /// Next-step goal, modules alike, step weights.
    SctnUnifStep,
    /// Next-step goal, modules by complexity, step weights.
    SctnCompStep,
}

impl Agent {
    /// All of them, in the order of the paper's tables.
    pub const ALL: [Self; 8] = [
        Self::Gctn,
        Self::GctnStep,
        Self::GctnUnifStep,
        Self::GctnCompStep,
        Self::Sctn,
        Self::SctnStep,
        Self::SctnUnifStep,
        Self::SctnCompStep,
    ];

    /// The goal it is shown.
    pub fn conditioning(self) -> GoalConditioning {
        match self {
            Self::Gctn | Self::GctnStep | Self::GctnUnifStep | Self::GctnCompStep => {
                GoalConditioning::Final
            }
            Self::Sctn | Self::SctnStep | Self::SctnUnifStep | Self::SctnCompStep => {
                GoalConditioning::NextStep
            }
        }
    }

    /// Which step it draws how often.
    pub fn sampling(self) -> Sampling {
        match self {
            Self::Gctn | Self::Sctn => Sampling::Plain,
            Self::GctnStep | Self::SctnStep => Sampling::Step,
            Self::GctnUnifStep | Self::SctnUnifStep => Sampling::UnifStep,
            Self::GctnCompStep | Self::SctnCompStep => Sampling::CompStep,
        }
    }

    /// The agent of the same settings that the paper trains on single tasks, where there are no modules to
    /// weigh against each other.
    pub fn single_task(self) -> Self {
        match self {
            Self::GctnUnifStep | Self::GctnCompStep => Self::GctnStep,
            Self::SctnUnifStep | Self::SctnCompStep => Self::SctnStep,
            other => other,
        }
    }

    /// Its name in recipes and file names.
    pub fn slug(self) -> String {
        // As in the paper, in lower case.
        self.to_string().to_lowercase().replace('-', "_")
    }
}

/// As in the paper's tables.
impl fmt::Display for Agent {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Gctn => "GCTN",
            Self::GctnStep => "GCTN-Step",
            Self::GctnUnifStep => "GCTN-Unif-Step",
            Self::GctnCompStep => "GCTN-Comp-Step",
            Self::Sctn => "SCTN",
            Self::SctnStep => "SCTN-Step",
            Self::SctnUnifStep => "SCTN-Unif-Step",
            Self::SctnCompStep => "SCTN-Comp-Step",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_what_recipes_say() {
        for agent in Agent::ALL {
            let read: Agent = serde_yaml_ng::from_str(&agent.slug()).unwrap();
            assert_eq!(read, agent);
        }
    }
}
