//! Who acts in an evaluation: a policy, or a baseline that has learned nothing.

use gctn::{Evidence, Goal, GoalConditioning, Policy};
use heightmap::{Disk, Heightmap, Workspace};
use nalgebra::{Isometry2, Point2};
use pick_place::PickPlace;
use serde::{Deserialize, Serialize};

/// A height that changes by more than this has changed, for [`difference`].
const CHANGED_M: f32 = 0.006;

/// Who acts.
#[derive(Debug)]
pub enum Actor {
    /// A trained network.
    Policy(Box<Policy>),
    /// [`difference`]: what a score is worth that does not beat it.
    Difference,
}

/// What an actor does, and what it says of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Act {
    /// The action.
    pub action: PickPlace,
    /// What a network says of it.
    pub said: Option<Said>,
}

/// What a network says of its decision.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Said {
    /// In numbers that can be weighed.
    pub evidence: Evidence,
    /// Probability that the step is done already, of a network that says so.
    pub done: Option<f64>,
    /// Probability that the step earns its reward, of a checkpoint with a calibration.
    pub success: Option<f64>,
}

impl From<Policy> for Actor {
    fn from(policy: Policy) -> Self {
        Self::Policy(Box::new(policy))
    }
}

impl Actor {
    /// What it is conditioned on.
    pub fn conditioning(&self) -> GoalConditioning {
        match self {
            Self::Policy(policy) => policy.config().conditioning,
            Self::Difference => GoalConditioning::NextStep,
        }
    }

    /// The agent's name in reports: `sctn` with next-step goals or a sequence, `gctn` with the final goal, `difference`.
    pub fn name(&self) -> &'static str {
        match (self, self.conditioning()) {
            (Self::Difference, _) => "difference",
            (Self::Policy(_), GoalConditioning::Final) => "gctn",
            (Self::Policy(_), _) => "sctn",
        }
    }

    /// Probability that a step is done already, of a network that says so.
    pub fn done(
        &self,
        observation: &Heightmap,
        goal: Goal<'_>,
    ) -> Result<Option<f64>, gctn::Error> {
        match self {
            Self::Policy(policy) => policy.done(observation, goal),
            Self::Difference => Ok(None),
        }
    }

    /// Where to pick and to place; a policy picks nothing within an excluded disk (world).
    pub fn act(
        &self,
        observation: &Heightmap,
        goal: Goal<'_>,
        exclude: &[Disk],
    ) -> Result<Act, gctn::Error> {
        match self {
            Self::Policy(policy) => {
                let decision = policy.decide(observation, goal, exclude)?;
                Ok(Act {
                    action: PickPlace {
                        pick: decision.pick,
                        place: decision.place,
                    },
                    said: Some(Said {
                        evidence: decision.evidence,
                        done: decision.done,
                        success: decision.success,
                    }),
                })
            }
            Self::Difference => Ok(Act {
                action: difference(observation, goal.image),
                said: None,
            }),
        }
    }
}

/// The floor of every table, a rule without anything learned: picks at the middle of the cells that are lower in the goal by more
/// than 6 mm, places at the middle of those that are higher; at the middle of the workspace where there are none.
pub fn difference(observation: &Heightmap, goal: &Heightmap) -> PickPlace {
    let changes = observation.height_m.iter().zip(&goal.height_m);
    let changes: Vec<f32> = changes.map(|(seen, wanted)| wanted - seen).collect();
    let pose = |chosen: &dyn Fn(f32) -> bool| {
        let point_px = middle(&observation.workspace, &changes, chosen);
        let point_m = observation.workspace.point_m(&point_px);
        Isometry2::new(point_m.coords, 0.0)
    };
    PickPlace {
        pick: pose(&|change| change < -CHANGED_M),
        place: pose(&|change| change > CHANGED_M),
    }
}

/// Mean of the centres of the chosen cells, in image coordinates; the workspace's middle of none.
fn middle(workspace: &Workspace, changes: &[f32], chosen: &dyn Fn(f32) -> bool) -> Point2<f64> {
    let cells = changes.iter().enumerate();
    let cells = cells.filter(|(_, change)| chosen(**change));
    let (mut sum, mut count) = (nalgebra::Vector2::zeros(), 0.0);
    for (index, _) in cells {
        let (row, col) = (index / workspace.cols, index % workspace.cols);
        sum += nalgebra::Vector2::new(col as f64 + 0.5, row as f64 + 0.5);
        count += 1.0;
    }
    if count == 0.0 {
        return Point2::new(workspace.cols as f64 / 2.0, workspace.rows as f64 / 2.0);
    }
    Point2::from(sum / count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::Pixel;

    #[test]
    fn the_floor_picks_what_is_missing_and_places_where_something_is_new() {
        let flat = Heightmap::new(Workspace::RAVENS);
        let block = |row: usize, col: usize| {
            let mut heightmap = flat.clone();
            for row in row - 6..=row + 6 {
                for col in col - 6..=col + 6 {
                    heightmap.height_m[row * heightmap.workspace.cols + col] = 0.04;
                }
            }
            heightmap
        };
        let [from, to] = [(100, 40), (220, 120)].map(|(row, col)| Pixel { row, col });
        let action = difference(&block(from.row, from.col), &block(to.row, to.col));
        let near = |pose: &Isometry2<f64>, pixel: Pixel| {
            (pose.translation.vector - flat.workspace.center(pixel).coords).norm() < 1e-9
        };
        assert!(
            near(&action.pick, from) && near(&action.place, to),
            "{action:?}"
        );
        // Where nothing changes it still says something that is on the table.
        let nothing = difference(&flat, &flat);
        assert!(
            flat.workspace
                .pixel(&nothing.pick.translation.vector.into())
                .is_some()
        );
    }
}
