//! The operator's corrections that succeeded, as demonstrations of one step.

use bags::{Demonstration, DemonstrationStep};
use heightmap::Heightmap;
use step_protocol::Proposal;

use super::propose::fnv1a;
use super::{Decision, PastStep, Run};
use crate::lesson::LONGEST_NAME;

/// Most characters of a problem's name in that of a correction: those of a task's name.
const PROBLEM_CHARACTERS: usize = LONGEST_NAME;

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

/// The step as a demonstration; `None` where what was before or after it was not seen, or its motion was broken off.
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
    format!("{}-{step}-{:016x}", name_of_problem(problem), id.0)
}

/// The name of a problem as a part of a folder's name. One that is too long or has other characters than a folder's name is
/// shortened and given a number that no other has.
fn name_of_problem(problem: &str) -> String {
    let is_good = |character: &char| character.is_ascii_alphanumeric() || "-_".contains(*character);
    if problem.chars().count() <= PROBLEM_CHARACTERS && problem.chars().all(|one| is_good(&one)) {
        return problem.to_owned();
    }
    let number = format!("_{:08x}", fnv1a(problem.bytes()) as u32);
    let kept = problem.chars().filter(is_good);
    let start: String = kept.take(PROBLEM_CHARACTERS - number.len()).collect();
    start + &number
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_problems_never_share_the_name_of_their_corrections() {
        let problems = [
            "blocks_on_marks",
            "blocks_on_ma",
            "blocks_on_marks_2",
            "blocks-on-marks",
            "blocks on marks",
            "blocks.on.marks",
            &"x".repeat(40),
            &"x".repeat(41),
            &"x".repeat(42),
            "würfel",
            "wurfel",
            "",
        ];
        let names: std::collections::BTreeSet<_> = problems
            .iter()
            .map(|problem| name_of_problem(problem))
            .collect();
        assert_eq!(names.len(), problems.len(), "{names:?}");
        assert!(names.contains("blocks_on_marks") && names.contains("blocks-on-marks"));
        for name in names {
            assert!(name.len() <= PROBLEM_CHARACTERS, "{name}");
            crate::library::check_folder_name(&format!("{name}-4294967295-{:016x}", 7)).unwrap();
        }
    }
}
