//! The operator's corrections that succeeded, as demonstrations of one step.

use bags::{Demonstration, DemonstrationStep};
use heightmap::Heightmap;
use step_protocol::Proposal;

use super::{Decision, PastStep, Run};

/// Characters of a problem's name in that of a correction.
const PROBLEM_CHARACTERS: usize = 12;

impl Run {
    /// Proposals of a person that were carried out, were confirmed, and whose result is in view; each once, with its name.
    pub fn take_corrections(&mut self) -> Vec<(String, Demonstration)> {
        let mut taken = Vec::new();
        for step in &mut self.steps {
            let is_persons =
                !step.proposal.author.is_empty() && step.proposal.checkpoint.is_empty();
            let is_confirmed = step.decision == Some(Decision::Advance);
            if step.is_kept || !is_persons || !is_confirmed {
                continue;
            }
            match demonstration(step) {
                Some(correction) => taken.push(correction),
                // Its result is not in view yet.
                None if step.after.is_none() => continue,
                None => {}
            }
            step.is_kept = true;
        }
        taken
    }
}

/// The step as a demonstration; nothing where what was before or after it was not seen, or its motion was broken off.
fn demonstration(step: &PastStep) -> Option<(String, Demonstration)> {
    let PastStep {
        proposal,
        outcome,
        before: Some(before),
        after: Some(after),
        ..
    } = step
    else {
        return None;
    };
    let outcome = outcome.motion()?;
    let name = name(proposal);
    let step = DemonstrationStep {
        observation: Heightmap::clone(&before.heightmap),
        action: proposal.action,
        settings: proposal.settings,
        module: proposal.module.clone(),
        delta_reward: 1.0,
        outcome,
    };
    let demonstration = Demonstration {
        // Steps of different corrections are never those of one scene.
        problem: name.clone(),
        seed: 0,
        start_seed: 0,
        steps: vec![step],
        last: Heightmap::clone(&after.heightmap),
    };
    Some((name, demonstration))
}

/// Problem, step and id of the proposal.
fn name(
    Proposal {
        problem, step, id, ..
    }: &Proposal,
) -> String {
    let problem: String = problem
        .chars()
        .filter(|character| character.is_ascii_alphanumeric() || *character == '_')
        .take(PROBLEM_CHARACTERS)
        .collect();
    format!("{problem}-{step}-{:016x}", id.0)
}
