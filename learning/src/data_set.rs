//! Demonstrations as training samples.

use crate::images::{ImageId, ImageMemory, ImageStore};
use crate::sampling::{Sampling, SamplingError};
use bags::{Demonstration, DemonstrationError};
use gctn::{Goal, GoalConditioning, Sample};
use heightmap::Heightmap;
use multiravens::EpisodeSeed;
use pick_place::PickPlace;
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Demonstrations, their images compressed, and which of their steps can be learned from.
#[derive(Debug)]
pub struct DataSet {
    demonstrations: Vec<Indexed>,
    images: ImageStore,
    /// Demonstrations of the same problem and scene, by their indices.
    scenes: BTreeMap<(String, u64), Vec<usize>>,
    /// For each demonstration how often it and all before it are drawn; empty where all are drawn alike.
    draws: Vec<f64>,
}

impl Default for DataSet {
    /// With the usual bounds, and a file for what is beyond them in the folder for temporary files.
    fn default() -> Self {
        Self::new(ImageMemory::default(), &std::env::temp_dir())
    }
}

#[derive(Debug)]
struct Indexed {
    scene: (String, u64),
    /// The observations, that after the last step included.
    observations: Vec<ImageId>,
    actions: Vec<PickPlace>,
    /// Steps that lead to a delta reward, now or later.
    steps: Vec<Step>,
    /// Module of each such step.
    modules: Vec<String>,
    /// Indices of the observations after a positive delta reward: the demonstration's sequence.
    goals: Vec<usize>,
}

#[derive(Clone, Copy, Debug)]
struct Step {
    index: usize,
    /// Number, in the sequence, of the observation after the first positive delta reward from this step on.
    goal: usize,
}

/// What of a scene's demonstrations a sample of the conditioning `sequence` shows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Shown {
    /// Share of samples that are shown the very demonstration that they are of; the others are shown one of
    /// another start of the same scene, where there is one.
    pub same_start: f64,
    /// Share of samples whose step is done already: what is seen is the state after it, or a later one.
    pub done: f64,
}

impl Default for Shown {
    fn default() -> Self {
        Self {
            same_start: 0.15,
            done: 0.0,
        }
    }
}

/// How samples are drawn.
#[derive(Clone, Copy, Debug)]
pub struct DrawRules<'a> {
    /// Which step is drawn how often.
    pub sampling: &'a Sampling,
    /// What a sample shows as its goal.
    pub conditioning: GoalConditioning,
    /// Probability that a next-step goal is the one after the next. Not with the conditioning `sequence`.
    pub goal_jitter: f64,
    /// For the conditioning `sequence`.
    pub shown: Shown,
}

/// A drawn sample with its images.
#[derive(Clone, Debug)]
pub struct DrawnSample {
    observation: Arc<Heightmap>,
    image: Arc<Heightmap>,
    last: Option<Arc<Heightmap>>,
    previous: Option<Arc<Heightmap>>,
    action: PickPlace,
    done: bool,
}

impl DrawnSample {
    /// What a trainer takes.
    pub fn sample(&self) -> Sample<'_> {
        Sample {
            observation: &self.observation,
            goal: Goal {
                image: &self.image,
                last: self.last.as_deref(),
                previous: self.previous.as_deref(),
            },
            pick: self.action.pick,
            place: self.action.place,
            done: self.done,
        }
    }
}

/// Why demonstrations cannot be learned from.
#[derive(Debug, thiserror::Error)]
pub enum DataSetError {
    /// The folder cannot be listed.
    #[error("{}: {source}", path.display())]
    Io {
        /// The folder.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// Fewer demonstrations than asked for.
    #[error("{}: holds {found} demonstrations, expected {expected}", path.display())]
    TooFew {
        /// The folder.
        path: PathBuf,
        /// Demonstrations found, each scene counted once.
        found: usize,
        /// Demonstrations asked for.
        expected: usize,
    },
    /// An image cannot be compressed, or not be decoded again.
    #[error("an image of the data set: {0}")]
    Image(std::io::Error),
    /// A bag that holds no valid demonstration.
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

/// How the names of the problems begin that `sctn problems` draws; a seed follows.
pub const GENERATED: &str = "arranged_";

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
    /// An empty data set that keeps so much of its images in memory. What is beyond lies in a file without a name in `folder`,
    /// which disappears with the process.
    pub fn new(memory: ImageMemory, folder: &Path) -> Self {
        Self {
            demonstrations: Vec::new(),
            images: ImageStore::new(memory, folder),
            scenes: BTreeMap::new(),
            draws: Vec::new(),
        }
    }

    /// From now on the demonstrations that it holds are drawn so many times as often as one of a problem that is not named;
    /// `generated` names those of [`GENERATED`] problems. Numbers above 0.
    pub fn weigh(&mut self, times: &BTreeMap<String, f64>) {
        self.draws.clear();
        if times.is_empty() {
            return;
        }
        let mut sum = 0.0;
        let draws = self.demonstrations.iter().map(|indexed| {
            let name = match &*indexed.scene.0 {
                name if name.starts_with(GENERATED) => "generated",
                name => name,
            };
            sum += times.get(name).copied().unwrap_or(1.0);
            sum
        });
        self.draws = draws.collect();
    }

    /// Adds the demonstrations of the first `count` scenes of a problem, in order of their seeds, from a folder that
    /// `sctn demos` wrote: those of their own starts, or of all starts.
    pub fn load(
        &mut self,
        directory: &Path,
        problem: &str,
        count: usize,
        all_starts: bool,
    ) -> Result<(), DataSetError> {
        let folder = directory.join(problem);
        let io = |source| DataSetError::Io {
            path: folder.clone(),
            source,
        };
        let mut scenes: BTreeMap<u64, Vec<(u64, PathBuf)>> = BTreeMap::new();
        for entry in std::fs::read_dir(&folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let name = path.file_name().and_then(|name| name.to_str());
            // Anything else in the folder, such as a half-written bag, has no seed for a name.
            let Some(seed) = name.and_then(demonstration_seed) else {
                continue;
            };
            if seed.is_own_start() || all_starts {
                scenes
                    .entry(seed.scene)
                    .or_default()
                    .push((seed.start, path));
            }
        }
        if scenes.len() < count {
            return Err(DataSetError::TooFew {
                path: folder,
                found: scenes.len(),
                expected: count,
            });
        }
        for starts in scenes.values_mut().take(count) {
            starts.sort();
            for (_, path) in starts {
                self.load_bag(path, &[problem.to_owned()])?;
            }
        }
        Ok(())
    }

    /// Adds one scene of each of the first `count` problems that `sctn problems` has drawn, in order of their seeds, from a folder
    /// that `sctn demos` wrote.
    pub fn load_generated(
        &mut self,
        directory: &Path,
        count: usize,
        all_starts: bool,
    ) -> Result<(), DataSetError> {
        let io = |source| DataSetError::Io {
            path: directory.to_owned(),
            source,
        };
        let mut names = Vec::new();
        for entry in std::fs::read_dir(directory).map_err(io)? {
            let name = entry.map_err(io)?.file_name();
            let name = name.to_str().filter(|name| name.starts_with(GENERATED));
            names.extend(name.map(str::to_owned));
        }
        if names.len() < count {
            return Err(DataSetError::TooFew {
                path: directory.join(format!("{GENERATED}*")),
                found: names.len(),
                expected: count,
            });
        }
        names.sort();
        names
            .iter()
            .take(count)
            .try_for_each(|name| self.load(directory, name, 1, all_starts))
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
        let rewards = demonstration.steps.iter().enumerate();
        let rewards = rewards.filter(|(_, step)| step.delta_reward > 0.0);
        let goals: Vec<usize> = rewards.map(|(index, _)| index + 1).collect();
        // Steps after the last reward lead nowhere.
        let steps: Vec<Step> = (0..demonstration.steps.len())
            .filter_map(|index| {
                let goal = goals.iter().position(|goal| *goal > index)?;
                Some(Step { index, goal })
            })
            .collect();
        if steps.is_empty() {
            let Demonstration { problem, seed, .. } = demonstration;
            return Err(DataSetError::NoReward { problem, seed });
        }
        let modules = steps
            .iter()
            .map(|step| demonstration.steps[step.index].module.clone())
            .collect();
        let observations = (0..=demonstration.steps.len())
            .map(|index| self.images.add(demonstration.observation(index)))
            .collect::<Result<_, _>>()
            .map_err(DataSetError::Image)?;
        let scene = (demonstration.problem, demonstration.seed);
        let number = self.demonstrations.len();
        self.scenes.entry(scene.clone()).or_default().push(number);
        self.demonstrations.push(Indexed {
            scene,
            observations,
            actions: demonstration.steps.iter().map(|step| step.action).collect(),
            steps,
            modules,
            goals,
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

    /// Number of scenes: demonstrations of other starts of a scene count once.
    pub fn scene_count(&self) -> usize {
        self.scenes.len()
    }

    /// Bytes that the compressed images take, in memory and in a file.
    pub fn image_bytes(&self) -> [u64; 2] {
        self.images.compressed_bytes()
    }

    fn image(&self, id: ImageId) -> Result<Arc<Heightmap>, DataSetError> {
        self.images.get(id).map_err(DataSetError::Image)
    }

    fn draw_demonstration<R: Rng>(&self, rng: &mut R) -> Result<usize, DataSetError> {
        match self.demonstrations.is_empty() {
            true => Err(SamplingError::Empty.into()),
            false => Ok(match self.draws.last() {
                None => rng.random_range(0..self.demonstrations.len()),
                Some(sum) => {
                    let drawn = rng.random::<f64>() * sum;
                    let number = self.draws.partition_point(|until| *until <= drawn);
                    number.min(self.draws.len() - 1)
                }
            }),
        }
    }

    /// What a goal module compares with, of a demonstration drawn uniformly: its first image and those after its rewards.
    pub fn draw_images<R: Rng>(&self, rng: &mut R) -> Result<Vec<Arc<Heightmap>>, DataSetError> {
        let indexed = &self.demonstrations[self.draw_demonstration(rng)?];
        let known = std::iter::once(0).chain(indexed.goals.iter().copied());
        known
            .map(|index| self.image(indexed.observations[index]))
            .collect()
    }

    /// Draws a sample: a demonstration uniformly, then a step by its weights (paper, section IV-B). With the conditioning
    /// `sequence` it is shown a demonstration of its scene, see [`Shown`].
    pub fn draw<R: Rng>(
        &self,
        rules: &DrawRules<'_>,
        rng: &mut R,
    ) -> Result<DrawnSample, DataSetError> {
        let number = self.draw_demonstration(rng)?;
        let indexed = &self.demonstrations[number];
        let step = indexed.steps[rules.sampling.draw(&indexed.modules, rng)?];
        let image = |of: &Indexed, index: usize| self.image(of.observations[index]);
        let action = indexed.actions[step.index];
        if rules.conditioning == GoalConditioning::Sequence {
            let shown = self.draw_shown(number, step.goal, rules.shown.same_start, rng);
            let before = step.goal.checked_sub(1).map_or(0, |goal| shown.goals[goal]);
            let done = rng.random::<f64>() < rules.shown.done;
            let seen = match done {
                false => step.index,
                true => {
                    let after = indexed.goals[step.goal];
                    let last = indexed.observations.len() - 1;
                    // The state right after the step as often as all later ones.
                    match rng.random::<bool>() {
                        true => after,
                        false => rng.random_range(after..=last),
                    }
                }
            };
            return Ok(DrawnSample {
                observation: image(indexed, seen)?,
                image: image(shown, shown.goals[step.goal])?,
                last: None,
                previous: Some(image(shown, before)?),
                action,
                done,
            });
        }
        let jittered = rules.goal_jitter > 0.0 && rng.random::<f64>() < rules.goal_jitter;
        let goal = match jittered {
            true => (step.goal + 1).min(indexed.goals.len() - 1),
            false => step.goal,
        };
        let next = indexed.goals[goal];
        let last = indexed.observations.len() - 1;
        let (shown, last) = match rules.conditioning {
            GoalConditioning::Final => (last, None),
            GoalConditioning::Both => (next, Some(last)),
            GoalConditioning::NextStep | GoalConditioning::Sequence => (next, None),
        };
        Ok(DrawnSample {
            observation: image(indexed, step.index)?,
            image: image(indexed, shown)?,
            last: last.map(|last| image(indexed, last)).transpose()?,
            previous: None,
            action,
            done: false,
        })
    }

    /// The demonstration that a sample of demonstration `number` is shown for its goal `goal`.
    fn draw_shown<R: Rng>(
        &self,
        number: usize,
        goal: usize,
        same_start: f64,
        rng: &mut R,
    ) -> &Indexed {
        let own = &self.demonstrations[number];
        let others = self.scenes[&own.scene].iter();
        let others = others.filter(|other| **other != number);
        let others: Vec<&Indexed> = others
            .map(|other| &self.demonstrations[*other])
            .filter(|other| other.goals.len() > goal)
            .collect();
        if others.is_empty() || rng.random::<f64>() < same_start {
            return own;
        }
        others[rng.random_range(0..others.len())]
    }
}

/// The seed of a demonstration's folder, see [`demonstration_path`].
fn demonstration_seed(name: &str) -> Option<EpisodeSeed> {
    match name.split_once('_') {
        None => name.parse::<u64>().ok().map(EpisodeSeed::from),
        Some((scene, start)) => Some(EpisodeSeed {
            scene: scene.parse().ok()?,
            start: start.parse().ok()?,
        }),
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

    fn rules(conditioning: GoalConditioning, goal_jitter: f64) -> DrawRules<'static> {
        DrawRules {
            sampling: &Sampling::Plain,
            conditioning,
            goal_jitter,
            shown: Shown::default(),
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
            let mut draw = |conditioning| data.draw(&rules(conditioning, 0.0), &mut rng).unwrap();
            let drawn = draw(GoalConditioning::NextStep);
            let sample = drawn.sample();
            let expected = [2.0, 2.0, 3.0][sample.observation.height_m[0] as usize];
            assert_eq!(sample.goal.image.height_m[0], expected);
            assert_eq!(
                sample.place.translation.x,
                f64::from(sample.observation.height_m[0])
            );
            let drawn = draw(GoalConditioning::Final);
            assert_eq!(drawn.sample().goal.image.height_m[0], 4.0);
            let drawn = draw(GoalConditioning::Both);
            assert_eq!(drawn.sample().goal.last.unwrap().height_m[0], 4.0);
        }
    }

    #[test]
    fn a_jittered_goal_is_the_one_after_the_next() {
        let mut data = DataSet::default();
        data.push(demonstration(&[0.0, 0.5, 0.5])).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut later = 0;
        for _ in 0..2000 {
            let rules = rules(GoalConditioning::NextStep, 0.25);
            let drawn = data.draw(&rules, &mut rng).unwrap();
            let sample = drawn.sample();
            let goal = sample.goal.image.height_m[0];
            let next = [2.0, 2.0, 3.0][sample.observation.height_m[0] as usize];
            assert!(goal == next || goal == 3.0);
            later += usize::from(goal != next);
        }
        // A quarter of the two steps that have a goal after the next.
        assert!((270..400).contains(&later), "{later}");
    }

    #[test]
    fn a_sequence_is_shown_from_the_other_starts_of_the_scene() {
        let mut data = DataSet::default();
        // Three starts of a scene, one of another; heights tell them apart by hundreds.
        for (seed, start_seed, first) in [(0, 0, 0.0), (0, 2, 100.0), (0, 4, 200.0), (2, 2, 300.0)]
        {
            let mut made = demonstration(&[0.0, 0.5, 0.5, 0.0]);
            made.seed = seed;
            made.start_seed = start_seed;
            let observations = made.steps.iter_mut().map(|step| &mut step.observation);
            for observation in observations.chain([&mut made.last]) {
                observation
                    .height_m
                    .iter_mut()
                    .for_each(|height| *height += first);
            }
            data.push(made).unwrap();
        }
        assert_eq!((data.len(), data.scene_count()), (4, 2));
        let rules = DrawRules {
            shown: Shown {
                same_start: 0.25,
                done: 0.5,
            },
            ..rules(GoalConditioning::Sequence, 0.0)
        };
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let (mut own, mut done, mut of_three) = (0, 0, 0);
        for _ in 0..2000 {
            let drawn = data.draw(&rules, &mut rng).unwrap();
            let sample = drawn.sample();
            let of = |heightmap: &Heightmap| {
                let height = heightmap.height_m[0];
                ((height / 100.0) as usize, height as usize % 100)
            };
            let (seen, shown) = (of(sample.observation), of(sample.goal.image));
            let previous = of(sample.goal.previous.unwrap());
            assert_eq!(previous.0, shown.0, "both images are of one demonstration");
            assert_eq!(seen.0 == 3, shown.0 == 3, "of the same scene");
            assert!([(0, 2), (2, 3)].contains(&(previous.1, shown.1)));
            if sample.done {
                assert!(seen.1 >= shown.1);
            } else {
                assert!((previous.1..shown.1).contains(&seen.1));
            }
            done += usize::from(sample.done);
            if seen.0 < 3 {
                of_three += 1;
                own += usize::from(seen.0 == shown.0);
            }
        }
        assert!((900..1100).contains(&done), "{done}");
        let share = own as f64 / of_three as f64;
        assert!((0.2..0.3).contains(&share), "{share}");
    }

    #[test]
    fn a_problem_of_weight_three_is_drawn_three_times_as_often() {
        let mut data = DataSet::default();
        for (problem, first) in [
            ("placing", 0.0),
            ("arranged_000004", 100.0),
            ("routing", 200.0),
        ] {
            let mut made = demonstration(&[0.5]);
            made.problem = problem.into();
            made.steps[0].observation.height_m.fill(first);
            data.push(made).unwrap();
        }
        let draws = [("placing", 3.0), ("generated", 0.5)];
        data.weigh(&draws.map(|(name, times)| (name.to_owned(), times)).into());
        let rules = rules(GoalConditioning::NextStep, 0.0);
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let mut counts = [0; 3];
        for _ in 0..4500 {
            let drawn = data.draw(&rules, &mut rng).unwrap();
            counts[drawn.sample().observation.height_m[0] as usize / 100] += 1;
        }
        for (count, expected) in counts.into_iter().zip([3000, 500, 1000_i32]) {
            assert!((expected - count).abs() < 120, "{counts:?}");
        }
    }

    #[test]
    fn generated_problems_are_loaded_in_order_of_their_seeds_and_one_scene_of_each() {
        let folder = tempfile::tempdir().unwrap();
        for (problem, seed, start_seed) in [
            ("placing", 0, 0),
            ("arranged_000004", 0, 0),
            ("arranged_000002", 0, 0),
            ("arranged_000002", 0, 2),
            ("arranged_000002", 2, 2),
        ] {
            let mut made = demonstration(&[0.5]);
            (made.problem, made.seed, made.start_seed) = (problem.into(), seed, start_seed);
            let scene = EpisodeSeed {
                scene: seed,
                start: start_seed,
            };
            let path = demonstration_path(folder.path(), problem, scene);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            made.write(&path).unwrap();
        }
        let load = |count, all_starts| {
            let mut data = DataSet::default();
            let loaded = data.load_generated(folder.path(), count, all_starts);
            loaded.map(|()| (data.len(), data.scene_count()))
        };
        assert_eq!(load(1, true).unwrap(), (2, 1));
        assert_eq!(load(2, true).unwrap(), (3, 2));
        assert_eq!(load(2, false).unwrap(), (2, 2));
        let error = load(3, true).unwrap_err().to_string();
        assert!(
            error.contains("arranged_*") && error.contains("2 demonstrations, expected 3"),
            "{error}"
        );
    }

    #[test]
    fn folders_are_named_by_scene_and_start() {
        let folder = Path::new("demos");
        for seed in [
            EpisodeSeed::from(12),
            EpisodeSeed {
                scene: 12,
                start: 14,
            },
        ] {
            let path = demonstration_path(folder, "placing", seed);
            let name = path.file_name().unwrap().to_str().unwrap();
            assert_eq!(demonstration_seed(name), Some(seed));
        }
        assert_eq!(demonstration_seed("000012.part"), None);
        assert_eq!(demonstration_seed("000012_x"), None);
    }

    #[test]
    fn a_demonstration_without_reward_is_refused() {
        let error = DataSet::default()
            .push(demonstration(&[0.0, 0.0]))
            .unwrap_err();
        assert!(error.to_string().contains("placing"), "{error}");
    }
}
