//! `sctn compare`: how far policies are from demonstrated steps.

use crate::root::Root;
use anyhow::{Context, Result, bail};
use bags::Demonstration;
use clap::Args;
use gctn::{Device, Goal, GoalConditioning, Policy, Precision};
use learning::recorded_run;
use nalgebra::Isometry2;
use pick_place::PickPlace;
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};

/// Arguments of `sctn compare`.
#[derive(Args)]
pub struct Compare {
    /// Checkpoints of the policies
    #[arg(long, required = true, num_args = 1..)]
    checkpoints: Vec<PathBuf>,
    /// Where the policies compute: cpu, cuda or cuda:N
    #[arg(long, default_value_t)]
    device: Device,
    /// Bags with steps that none of them was trained on: demonstrations, taught tasks or recorded runs
    #[arg(long, required = true, num_args = 1..)]
    demos: Vec<PathBuf>,
    /// What the policies are shown of each of them: a demonstration of its scene, with its goals in the same order, from another start [default: itself]
    #[arg(long, num_args = 1..)]
    shown: Vec<PathBuf>,
    /// Print a JSON object last
    #[arg(long)]
    json: bool,
}

/// How far a proposal is from what was demonstrated.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Distance {
    pick_m: f64,
    place_m: f64,
    /// Between the turns of the object, 0 to pi; an object that looks the same turned may be turned otherwise.
    turn_rad: f64,
}

impl fmt::Display for Distance {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            formatter,
            "pick {:.1} mm, place {:.1} mm, turn {:.1} degrees",
            1000.0 * self.pick_m,
            1000.0 * self.place_m,
            self.turn_rad.to_degrees()
        )
    }
}

impl Distance {
    fn between(proposed: &PickPlace, shown: &PickPlace) -> Self {
        let turn = |action: &PickPlace| action.pick.rotation.rotation_to(&action.place.rotation);
        Self {
            pick_m: (proposed.pick.translation.vector - shown.pick.translation.vector).norm(),
            place_m: (proposed.place.translation.vector - shown.place.translation.vector).norm(),
            turn_rad: turn(proposed).angle_to(&turn(shown)).abs(),
        }
    }
}

/// Where an object is picked or placed, in the world frame.
#[derive(Clone, Copy, Debug, Serialize)]
struct Pose {
    x_m: f64,
    y_m: f64,
    yaw_rad: f64,
}

#[derive(Clone, Copy, Debug, Serialize)]
struct Action {
    pick: Pose,
    place: Pose,
}

impl From<&PickPlace> for Action {
    fn from(action: &PickPlace) -> Self {
        let pose = |pose: &Isometry2<f64>| Pose {
            x_m: pose.translation.x,
            y_m: pose.translation.y,
            yaw_rad: pose.rotation.angle(),
        };
        Self {
            pick: pose(&action.pick),
            place: pose(&action.place),
        }
    }
}

/// A demonstrated step, what each policy proposes for it, and how far that is from what was shown.
#[derive(Debug, Serialize)]
struct Step {
    demonstration: PathBuf,
    step: usize,
    shown: Action,
    proposed: Vec<Action>,
    distances: Vec<Distance>,
}

#[derive(Debug, Serialize)]
struct Report {
    checkpoints: Vec<PathBuf>,
    /// Medians over all steps, for each checkpoint.
    median: Vec<Distance>,
    steps: Vec<Step>,
}

impl Compare {
    pub fn run(self, _: &Root) -> Result<()> {
        self.device.check()?;
        gctn::set_threads(1);
        let load = |path: &PathBuf| {
            Policy::load_for(path, self.device, Precision::F32)
                .with_context(|| format!("--checkpoints: {}", path.display()))
        };
        let policies = self.checkpoints.iter().map(load);
        let policies: Vec<_> = policies.collect::<Result<_>>()?;
        let mut steps = Vec::new();
        if !self.shown.is_empty() && self.shown.len() != self.demos.len() {
            let (shown, demos) = (self.shown.len(), self.demos.len());
            bail!(
                "--shown: {shown} demonstrations, expected one for each of the {demos} of --demos"
            );
        }
        for (index, path) in self.demos.iter().enumerate() {
            let shown = self.shown.get(index).unwrap_or(path);
            compare(path, shown, &policies, &mut steps)?;
        }
        if steps.is_empty() {
            bail!("--demos: no step that brought the table closer to the goal");
        }
        let median = (0..policies.len()).map(|policy| median(&steps, policy));
        let report = Report {
            median: median.collect(),
            checkpoints: self.checkpoints,
            steps,
        };
        for (checkpoint, distance) in report.checkpoints.iter().zip(&report.median) {
            println!(
                "{}: {distance} from {} demonstrated steps (median)",
                checkpoint.display(),
                report.steps.len()
            );
        }
        if self.json {
            println!("{}", serde_json::to_string(&report)?);
        }
        Ok(())
    }
}

/// Median distances of a policy from the steps, by its index.
fn median(steps: &[Step], policy: usize) -> Distance {
    let middle = |value: fn(&Distance) -> f64| {
        let mut values: Vec<_> = steps
            .iter()
            .map(|step| value(&step.distances[policy]))
            .collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    Distance {
        pick_m: middle(|distance| distance.pick_m),
        place_m: middle(|distance| distance.place_m),
        turn_rad: middle(|distance| distance.turn_rad),
    }
}

/// Median distances of a policy from the steps of demonstrations, and the number of the steps.
pub fn held_out(policy: Policy, demos: &[PathBuf]) -> Result<(Distance, usize)> {
    let policies = [policy];
    let mut steps = Vec::new();
    for path in demos {
        compare(path, path, &policies, &mut steps)?;
    }
    if steps.is_empty() {
        bail!("--held-out: no step that brought the table closer to the goal");
    }
    Ok((median(&steps, 0), steps.len()))
}

/// Has every policy propose for every step of a demonstration that brought the table closer to the goal, by the images of the
/// step of that number that brought the shown one closer to its goal.
fn compare(path: &Path, shown: &Path, policies: &[Policy], steps: &mut Vec<Step>) -> Result<()> {
    let read = |path: &Path, option: &str| -> Result<Demonstration> {
        let bag = recorded_run(path)
            .with_context(|| format!("{option}: {} holds no bag", path.display()))?;
        Ok(Demonstration::read(&bag)?)
    };
    let demonstration = read(path, "--demos")?;
    let shown_demonstration = read(shown, "--shown")?;
    let goals = shown_demonstration.goals();
    let progress = demonstration.goal_steps();
    if progress.len() != goals.len() {
        bail!(
            "--shown: {} has {} steps that brought the table closer to the goal, expected {}, as {} has",
            shown.display(),
            goals.len(),
            progress.len(),
            path.display()
        );
    }
    // The image before a goal shows what the steps before it have done.
    let begins = std::iter::once(shown_demonstration.observation(0)).chain(goals.iter().copied());
    for (index, (before, after)) in progress.into_iter().zip(begins.zip(goals.iter().copied())) {
        let step = &demonstration.steps[index];
        let propose = |policy: &Policy| {
            let goal = match policy.config().conditioning {
                GoalConditioning::Sequence => Goal::step(before, after),
                GoalConditioning::NextStep => after.into(),
                other => bail!(
                    "--checkpoints: a policy is conditioned on {other:?}, expected next_step or sequence"
                ),
            };
            let decision = policy.decide(&step.observation, goal, &[])?;
            Ok(PickPlace {
                pick: decision.pick,
                place: decision.place,
            })
        };
        let proposed: Vec<_> = policies.iter().map(propose).collect::<Result<_>>()?;
        steps.push(Step {
            demonstration: path.to_owned(),
            step: index + 1,
            shown: (&step.action).into(),
            distances: proposed
                .iter()
                .map(|proposed| Distance::between(proposed, &step.action))
                .collect(),
            proposed: proposed.iter().map(Action::from).collect(),
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;

    #[test]
    fn distances_are_of_places_and_of_the_turn_of_the_object() {
        let pose = |x, yaw| Isometry2::new(Vector2::new(x, 0.0), yaw);
        let shown = PickPlace {
            pick: pose(0.1, 0.0),
            place: pose(0.2, 0.5),
        };
        // The same turn from another yaw of the gripper.
        let proposed = PickPlace {
            pick: pose(0.13, 3.0),
            place: pose(0.24, 3.5),
        };
        let distance = Distance::between(&proposed, &shown);
        assert!((distance.pick_m - 0.03).abs() < 1e-12 && (distance.place_m - 0.04).abs() < 1e-12);
        assert!(distance.turn_rad < 1e-12, "{distance:?}");
        let proposed = PickPlace {
            place: pose(0.24, 2.5),
            ..proposed
        };
        assert!((Distance::between(&proposed, &shown).turn_rad - 1.0).abs() < 1e-12);
    }
}
