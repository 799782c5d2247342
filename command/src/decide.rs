//! `sctn decide`.

use crate::policy::PolicyArguments;
use crate::root::Root;
use anyhow::{Context as _, Result};
use bags::Demonstration;
use clap::Args;
use learning::goal;
use nalgebra::Isometry2;
use serde::Serialize;
use std::path::PathBuf;

/// Arguments of `sctn decide`.
#[derive(Args)]
pub struct Decide {
    /// Bag of a demonstration or of a recorded run
    bag: PathBuf,
    #[command(flatten)]
    policy: PolicyArguments,
}

/// What a policy decides before a step, shown what the demonstration reached next.
#[derive(Serialize)]
struct Step {
    /// x (m), y (m), yaw (rad).
    pick: [f64; 3],
    place: [f64; 3],
    pick_score: f64,
    place_score: f64,
    /// Probability that the step is done already, of a network that says so.
    done: Option<f64>,
    /// Probability that the step earns its reward, of a checkpoint with a calibration.
    success: Option<f64>,
}

impl Decide {
    pub fn run(self, root: &Root) -> Result<()> {
        let policy = self.policy.load(root)?;
        let demonstration = Demonstration::read(&self.bag)?;
        let goals = demonstration.goals();
        let first = demonstration.observation(0);
        let mut steps = Vec::new();
        let mut reached = 0;
        for step in &demonstration.steps {
            let goal = goal(first, &goals, reached, policy.config().conditioning)
                .with_context(|| format!("{}: earns no reward", self.bag.display()))?;
            let decision = policy.decide(&step.observation, goal, &[])?;
            reached += usize::from(step.delta_reward > 0.0);
            steps.push(Step {
                pick: numbers(&decision.pick),
                place: numbers(&decision.place),
                pick_score: decision.pick_score,
                place_score: decision.place_score,
                done: decision.done,
                success: decision.success,
            });
        }
        println!("{}", serde_json::to_string(&steps)?);
        Ok(())
    }
}

fn numbers(pose: &Isometry2<f64>) -> [f64; 3] {
    let position = pose.translation.vector;
    [position.x, position.y, pose.rotation.angle()]
}
