//! Demonstrations as training samples.

use crate::goal::known_images;
use crate::sampling::{Sampling, SamplingError};
use bags::{Demonstration, DemonstrationError};
use gctn::{Goal, GoalConditioning, Sample};
use heightmap::Heightmap;
use multiravens::EpisodeSeed;
use rand::{Rng, RngExt};
use std::path::{Path, PathBuf};

/// Demonstrations in memory, and which of their steps can be learned from.
#[derive(Debug, Default)]
pub struct DataSet {
    demonstrations: Vec<Indexed>,
}

#[derive(Debug)]
struct Indexed {
    demonstration: Demonstration,
    /// Steps that lead to a delta reward, now or later.
    steps: Vec<Step>,
    /// Module of each such step.
    modules: Vec<String>,
}

#[derive(Clone, Copy, Debug)]
struct Step {
    index: usize,
    /// Index of the observation after the first positive delta reward from this step on.
    next_goal: usize,
    /// Index of the observation after the second one; the same where there is none.
    goal_after: usize,
}

/// Why demonstrations cannot be learned from.
#[derive(Debug, thiserror::Error)]
pub enum DataSetError {
    /// The folder cannot be listed.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Fewer demonstrations than asked for.
    #[error("{}: holds {found} demonstrations, expected {expected}", path.display())]
    TooFew {
        /// The folder.
        path: PathBuf,
        /// Demonstrations found.
        found: usize,
        /// Demonstrations asked for.
        expected: usize,
    },
    /// A demonstration that is none.
    #[error(transparent)]
    Demonstration(#[from] DemonstrationError),
    /// A demonstration of another problem.
    #[error("{}: a demonstration of the problem {actual}, expected {expected}", path.display())]
    Problem {
        /// The bag.
        path: PathBuf,
        /// The problem it was made for.
        actual: String,
        /// The problem expected.
        expected: String,
    },
    /// A demonstration without any delta reward.
    #[error(
        "the demonstration of {problem} with seed {seed} earns no reward: there is no goal to learn from"
    )]
    NoReward {
        /// The problem.
        problem: String,
        /// The seed.
        seed: u64,
    },
    /// Weights that do not fit the demonstrations.
    #[error(transparent)]
    Sampling(#[from] SamplingError),
}

/// Where the demonstration of a problem and seed lies within a folder of demonstrations: in
/// `PROBLEM/SCENE`, from another start in `PROBLEM/SCENE_START`.
pub fn demonstration_path(
    directory: &Path,
    problem: &str,
    seed: impl Into<EpisodeSeed>,
) -> PathBuf {
    let EpisodeSeed { scene, start } = seed.into();
    let folder = directory.join(problem);
    if scene == start {
        folder.join(format!("{scene:06}"))
    } else {
        folder.join(format!("{scene:06}_{start:06}"))
    }
}

/// The bag of a recorded run: the folder itself, or its subfolder `run` as `sctn launch --record` leaves it.
pub fn recorded_run(folder: &Path) -> Option<PathBuf> {
    let candidates = [folder.to_owned(), folder.join("run")];
    let mut candidates = candidates.into_iter();
    candidates.find(|path| path.join("metadata.yaml").is_file())
}

impl DataSet {
    /// Adds the first `count` demonstrations of a problem, in order of their seeds, from a folder that
    /// `sctn demos` wrote.
    pub fn load(
        &mut self,
        directory: &Path,
        problem: &str,
        count: usize,
    ) -> Result<(), DataSetError> {
        let folder = directory.join(problem);
        let io = |source| DataSetError::Io {
            path: folder.clone(),
            source,
        };
        let mut bags: Vec<(u64, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(&folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            // Anything else in the folder, such as a half-written bag, has no seed for a name.
            if let Some(seed) = path
                .file_name()
                .and_then(|name| name.to_str()?.parse().ok())
            {
                bags.push((seed, path));
            }
        }
        bags.sort();
        if bags.len() < count {
            return Err(DataSetError::TooFew {
                path: folder,
                found: bags.len(),
                expected: count,
            });
        }
        bags[..count]
            .iter()
            .try_for_each(|(_, path)| self.load_bag(path, &[problem.to_owned()]))
    }

    /// Adds the demonstration of one bag, also that of a recorded run, which must be of one of these problems.
    pub fn load_bag(&mut self, path: &Path, problems: &[String]) -> Result<(), DataSetError> {
        let demonstration = Demonstration::read(path)?;
        if !problems.contains(&demonstration.problem) {
            return Err(DataSetError::Problem {
                path: path.to_owned(),
                actual: demonstration.problem,
                expected: problems.join(" or "),
            });
        }
        self.push(demonstration)
    }

    /// Adds a demonstration.
    pub fn push(&mut self, demonstration: Demonstration) -> Result<(), DataSetError> {
        let mut steps = Vec::with_capacity(demonstration.steps.len());
        let mut goals = None;
        for (index, step) in demonstration.steps.iter().enumerate().rev() {
            if step.delta_reward > 0.0 {
                goals = Some((index + 1, goals.map_or(index + 1, |(next, _)| next)));
            }
            // Steps after the last reward lead nowhere.
            if let Some((next_goal, goal_after)) = goals {
                steps.push(Step {
                    index,
                    next_goal,
                    goal_after,
                });
            }
        }
        if steps.is_empty() {
            let Demonstration { problem, seed, .. } = demonstration;
            return Err(DataSetError::NoReward { problem, seed });
        }
        steps.reverse();
        let modules = steps
            .iter()
            .map(|step| demonstration.steps[step.index].module.clone())
            .collect();
        self.demonstrations.push(Indexed {
            demonstration,
            steps,
            modules,
        });
        Ok(())
    }

    /// Number of demonstrations.
    pub fn len(&self) -> usize {
        self.demonstrations.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.demonstrations.is_empty()
    }

    /// Number of steps that can be learned from.
    pub fn step_count(&self) -> usize {
        self.demonstrations
            .iter()
            .map(|indexed| indexed.steps.len())
            .sum()
    }

    /// What a goal module compares with, of a demonstration drawn uniformly: its first image and those after its rewards.
    pub fn draw_images<R: Rng>(&self, rng: &mut R) -> Result<Vec<&Heightmap>, DataSetError> {
        if self.is_empty() {
            return Err(SamplingError::Empty.into());
        }
        let indexed = &self.demonstrations[rng.random_range(0..self.demonstrations.len())];
        Ok(known_images(&indexed.demonstration))
    }

    /// Draws a sample: a demonstration uniformly, then a step by its weights (paper, section IV-B). With
    /// probability `goal_jitter` its goal is the one after the next.
    pub fn draw<R: Rng>(
        &self,
        sampling: &Sampling,
        conditioning: GoalConditioning,
        goal_jitter: f64,
        rng: &mut R,
    ) -> Result<Sample<'_>, DataSetError> {
        if self.is_empty() {
            return Err(SamplingError::Empty.into());
        }
        let indexed = &self.demonstrations[rng.random_range(0..self.demonstrations.len())];
        let step = indexed.steps[sampling.draw(&indexed.modules, rng)?];
        let jittered = goal_jitter > 0.0 && rng.random::<f64>() < goal_jitter;
        let observation = |index| indexed.demonstration.observation(index);
        let next = observation(if jittered {
            step.goal_after
        } else {
            step.next_goal
        });
        let last = observation(indexed.demonstration.steps.len());
        let goal = match conditioning {
            GoalConditioning::NextStep => next.into(),
            GoalConditioning::Final => last.into(),
            GoalConditioning::Both => Goal {
                image: next,
                last: Some(last),
            },
        };
        let action = &indexed.demonstration.steps[step.index].action;
        Ok(Sample {
            observation: observation(step.index),
            goal,
            pick: action.pick,
            place: action.place,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bags::DemonstrationStep;
    use heightmap::Workspace;
    use nalgebra::Isometry2;
    use pick_place::{Outcome, PickPlace, PrimitiveSettings};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// The observation before step `i` has height `i` everywhere.
    fn demonstration(delta_rewards: &[f64]) -> Demonstration {
        let workspace = Workspace {
            rows: 2,
            cols: 2,
            ..Workspace::RAVENS
        };
        let observation = |index: usize| {
            let mut heightmap = Heightmap::new(workspace);
            heightmap.height_m.fill(index as f32);
            heightmap
        };
        let steps = delta_rewards
            .iter()
            .enumerate()
            .map(|(index, &delta_reward)| DemonstrationStep {
                observation: observation(index),
                action: PickPlace {
                    pick: Isometry2::identity(),
                    place: Isometry2::translation(index as f64, 0.0),
                },
                settings: PrimitiveSettings::RIGID,
                module: "placing".into(),
                delta_reward,
                outcome: Outcome::Placed,
            });
        Demonstration {
            problem: "placing".into(),
            seed: 0,
            start_seed: 0,
            steps: steps.collect(),
            last: observation(delta_rewards.len()),
        }
    }

    #[test]
    fn the_goal_is_the_first_observation_with_a_reward_after_the_step() {
        let mut data = DataSet::default();
        data.push(demonstration(&[0.0, 0.5, 0.5, 0.0])).unwrap();
        // The fourth step leads to no reward.
        assert_eq!(data.step_count(), 3);
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for _ in 0..50 {
            let sample = data
                .draw(&Sampling::Plain, GoalConditioning::NextStep, 0.0, &mut rng)
                .unwrap();
            let expected = [2.0, 2.0, 3.0][sample.observation.height_m[0] as usize];
            assert_eq!(sample.goal.image.height_m[0], expected);
            assert_eq!(
                sample.place.translation.x,
                f64::from(sample.observation.height_m[0])
            );
            let sample = data
                .draw(&Sampling::Plain, GoalConditioning::Final, 0.0, &mut rng)
                .unwrap();
            assert_eq!(sample.goal.image.height_m[0], 4.0);
            let sample = data
                .draw(&Sampling::Plain, GoalConditioning::Both, 0.0, &mut rng)
                .unwrap();
            assert_eq!(sample.goal.last.unwrap().height_m[0], 4.0);
        }
    }

    #[test]
    fn a_jittered_goal_is_the_one_after_the_next() {
        let mut data = DataSet::default();
        data.push(demonstration(&[0.0, 0.5, 0.5])).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut later = 0;
        for _ in 0..2000 {
            let sample = data
                .draw(&Sampling::Plain, GoalConditioning::NextStep, 0.25, &mut rng)
                .unwrap();
            let goal = sample.goal.image.height_m[0];
            let next = [2.0, 2.0, 3.0][sample.observation.height_m[0] as usize];
            assert!(goal == next || goal == 3.0);
            later += usize::from(goal != next);
        }
        // A quarter of the two steps that have a goal after the next.
        assert!((270..400).contains(&later), "{later}");
    }

    #[test]
    fn a_demonstration_without_reward_is_refused() {
        let error = DataSet::default()
            .push(demonstration(&[0.0, 0.0]))
            .unwrap_err();
        assert!(error.to_string().contains("placing"), "{error}");
    }
}
