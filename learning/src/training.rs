//! The training loop.

use crate::data_set::{DataSet, DataSetError, DrawRules, DrawnSample};
use crate::recipe::Recipe;
use gctn::{Batch, BatchMaker, Losses, ModelCard, Storage, Trainer};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

/// Stream of the seed's random numbers that samples are drawn from; step `n` draws from this one plus
/// `n`, so that a resumed training draws what an uninterrupted one would have.
const SAMPLING_STREAM: u64 = 1 << 40;

/// A training under way in its folder: `state.safetensors` to go on from, `snapshots/`, and in the end
/// `policy.safetensors`.
#[derive(Debug)]
pub struct Training {
    sampler: Arc<Sampler>,
    directory: PathBuf,
    trainer: Trainer,
    /// Begun by the first step, and again after a failed one.
    prefetch: Option<Prefetch>,
}

/// Draws the samples of each gradient step.
#[derive(Debug)]
struct Sampler {
    recipe: Recipe,
    data: DataSet,
    maker: BatchMaker,
}

impl Sampler {
    /// The batch of the gradient step after `step` others.
    fn batch(&self, step: u64) -> Result<Batch, TrainingError> {
        let Recipe {
            training,
            network,
            sampling,
            goal_jitter,
            shown,
            ..
        } = &self.recipe;
        let mut rng = ChaCha8Rng::seed_from_u64(training.seed);
        rng.set_stream(SAMPLING_STREAM + step);
        let rules = DrawRules {
            sampling,
            conditioning: network.conditioning,
            goal_jitter: *goal_jitter,
            shown: *shown,
        };
        let drawn = (0..training.batch).map(|_| self.data.draw(&rules, &mut rng));
        let drawn = drawn.collect::<Result<Vec<_>, _>>()?;
        let samples: Vec<_> = drawn.iter().map(DrawnSample::sample).collect();
        Ok(self.maker.batch(step, &samples)?)
    }
}

/// A thread that makes the batches of the next gradient steps while the present one is computed.
#[derive(Debug)]
struct Prefetch {
    /// `None` only while the thread is waited for.
    batches: Option<Receiver<Result<Batch, TrainingError>>>,
    thread: Option<JoinHandle<()>>,
}

impl Prefetch {
    /// Batches that wait, besides the one being made.
    const WAITING: usize = 1;

    /// Batches from this step on, in order.
    fn start(sampler: Arc<Sampler>, first: u64) -> Self {
        let (sender, batches) = sync_channel(Self::WAITING);
        let make = move || {
            let mut steps = first..;
            // Ends where nobody receives any more.
            while steps
                .next()
                .is_some_and(|step| sender.send(sampler.batch(step)).is_ok())
            {}
        };
        Self {
            batches: Some(batches),
            thread: Some(std::thread::spawn(make)),
        }
    }

    /// The next batch.
    fn next(&self) -> Result<Batch, TrainingError> {
        let batch = self
            .batches
            .as_ref()
            .and_then(|batches| batches.recv().ok());
        batch.unwrap_or(Err(TrainingError::Prefetch))
    }
}

impl Drop for Prefetch {
    fn drop(&mut self) {
        self.batches = None;
        // A panic of the thread has been printed, and `next` has failed.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Why a training cannot begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainingError {
    /// The folder holds another training.
    #[error("{}: already holds a training; resume it, or name another folder", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
    },
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// The network, its optimiser or a checkpoint.
    #[error(transparent)]
    Network(#[from] gctn::Error),
    /// The demonstrations.
    #[error(transparent)]
    Data(#[from] DataSetError),
    /// The thread that draws samples panicked.
    #[error("the thread that draws samples has stopped")]
    Prefetch,
}

impl Training {
    /// Begins a training, or goes on with the one that the folder holds.
    pub fn open(
        recipe: Recipe,
        mut data: DataSet,
        directory: &Path,
        resume: bool,
    ) -> Result<Self, TrainingError> {
        let state = directory.join("state.safetensors");
        let trainer = if resume {
            Trainer::resume(&state, &recipe.network, &recipe.training)?
        } else if state.exists() {
            return Err(TrainingError::Occupied {
                path: directory.to_owned(),
            });
        } else {
            let trainer = Trainer::new(&recipe.network, &recipe.training)?;
            match &recipe.start_from {
                Some(checkpoint) => trainer.starting_from(checkpoint)?,
                None => trainer,
            }
        };
        data.weigh(&recipe.draws);
        let snapshots = directory.join("snapshots");
        std::fs::create_dir_all(&snapshots).map_err(|source| TrainingError::Io {
            path: snapshots,
            source,
        })?;
        Ok(Self {
            sampler: Arc::new(Sampler {
                maker: trainer.batch_maker(),
                recipe,
                data,
            }),
            directory: directory.to_owned(),
            trainer,
            prefetch: None,
        })
    }

    /// The recipe.
    pub fn recipe(&self) -> &Recipe {
        &self.sampler.recipe
    }

    /// Gradient steps done.
    pub fn step(&self) -> u64 {
        self.trainer.step()
    }

    /// Learning rate of the next step.
    pub fn learning_rate(&self) -> f64 {
        self.trainer.learning_rate()
    }

    /// Whether all gradient steps are done.
    pub fn is_done(&self) -> bool {
        self.step() >= self.recipe().training.steps
    }

    /// One gradient step. The samples of the next ones are drawn, decoded and augmented meanwhile, on a thread.
    pub fn advance(&mut self) -> Result<Losses, TrainingError> {
        let start = || Prefetch::start(Arc::clone(&self.sampler), self.trainer.step());
        // Not kept after a failed step: the batch that waits is of the step after it.
        let prefetch = self.prefetch.take().unwrap_or_else(start);
        let losses = self.trainer.train_batch(prefetch.next()?)?;
        self.prefetch = Some(prefetch);
        Ok(losses)
    }

    /// Whether the present step is one after which a snapshot is taken.
    pub fn is_snapshot_due(&self) -> bool {
        self.recipe()
            .snapshot_steps()
            .any(|step| step == self.step())
    }

    /// Writes a snapshot; gives its path. [`Training::save_state`] follows once what is to be known of the snapshot is kept.
    pub fn save_snapshot(&self, card: &ModelCard) -> Result<PathBuf, TrainingError> {
        let path = self
            .directory
            .join("snapshots")
            .join(format!("{:07}.safetensors", self.step()));
        self.trainer.save_checkpoint(&path, Storage::F16, card)?;
        Ok(path)
    }

    /// Writes the state that [`Training::open`] resumes.
    pub fn save_state(&self) -> Result<(), TrainingError> {
        let path = self.directory.join("state.safetensors");
        Ok(self.trainer.save_state(&path)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data_set::Shown;
    use crate::recipe::{Demonstrations, Validation};
    use crate::sampling::Sampling;
    use bags::{Demonstration, DemonstrationStep};
    use gctn::{Compact, Network, NetworkConfig, TrainingConfig};
    use heightmap::{Heightmap, Workspace};
    use nalgebra::Isometry2;
    use pick_place::{Outcome, PickPlace, PrimitiveSettings};
    use std::collections::BTreeMap;
    use std::ffi::OsString;
    use std::fs::DirEntry;

    fn recipe(seed: u64) -> Recipe {
        Recipe {
            problems: vec!["placing".into()],
            demonstrations: Demonstrations::Each(2),
            generated: 0,
            network: NetworkConfig {
                rows: 48,
                cols: 32,
                rotations: 8,
                ..NetworkConfig::new(Network::Compact(Compact {
                    channels: [4, 4, 8, 8],
                    window_cells: 5,
                    ..Compact::default()
                }))
            },
            start_from: None,
            training: TrainingConfig {
                seed,
                steps: 6,
                ..TrainingConfig::compact()
            },
            sampling: Sampling::CompStep,
            draws: [("placing".into(), 2.0)].into(),
            goal_jitter: 0.3,
            shown: Shown::default(),
            decoded_mb: 1,
            compressed_mb: 0,
            snapshots: 3,
            average: 1,
            validation: Validation {
                episodes: 0,
                seed: 1,
            },
        }
    }

    fn data() -> DataSet {
        let workspace = Workspace {
            rows: 48,
            cols: 32,
            ..Workspace::RAVENS
        };
        let observation = |mark: usize| {
            let mut heightmap = Heightmap::new(workspace);
            for (index, byte) in heightmap.rgb.iter_mut().enumerate() {
                *byte = (index * (mark + 3) % 251) as u8;
            }
            heightmap
        };
        let corner = workspace.origin_m.coords;
        let pose = |x_m, y_m| Isometry2::new(corner + nalgebra::Vector2::new(x_m, y_m), 0.0);
        let mut data = DataSet::default();
        for seed in [0, 2] {
            let step = |index: usize| DemonstrationStep {
                observation: observation(index + seed as usize),
                action: PickPlace {
                    pick: pose(0.02, 0.03 + 0.01 * index as f64),
                    place: pose(0.07, 0.1),
                },
                settings: PrimitiveSettings::RIGID,
                module: if index < 2 { "placing" } else { "routing" }.into(),
                delta_reward: 0.25,
                outcome: Outcome::Placed,
            };
            data.push(Demonstration {
                problem: "placing".into(),
                seed,
                start_seed: seed,
                steps: (0..4).map(step).collect(),
                last: observation(9),
            })
            .unwrap();
        }
        data
    }

    /// The bytes of the last snapshot, after a stop at a step and a resume where one is given.
    fn trained(seed: u64, mut stop: Option<u64>) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let open = |resume| Training::open(recipe(seed), data(), folder.path(), resume).unwrap();
        let mut training = open(false);
        let mut snapshot = None;
        while !training.is_done() {
            training.advance().unwrap();
            if training.is_snapshot_due() {
                snapshot = Some(training.save_snapshot(&ModelCard::new()).unwrap());
                training.save_state().unwrap();
            }
            if stop.take_if(|step| *step == training.step()).is_some() {
                // The steps since the last snapshot are lost, and done again.
                training = open(true);
            }
        }
        std::fs::read(snapshot.unwrap()).unwrap()
    }

    #[test]
    fn one_seed_gives_one_policy_stopped_or_not() {
        let whole = trained(0, None);
        assert!(whole == trained(0, None), "twice the same");
        assert!(
            whole == trained(0, Some(5)),
            "stopped after step 5, resumed from 4"
        );
        assert!(whole != trained(1, None), "another seed");
    }

    /// Names the number of threads to [`training_in_its_own_process`].
    const THREADS: &str = "LEARNING_TEST_THREADS";

    /// Nanoseconds that each thread of this process has run.
    fn run_times() -> BTreeMap<OsString, u64> {
        let run_time = |task: DirEntry| {
            let text = std::fs::read_to_string(task.path().join("schedstat")).unwrap();
            let (run_ns, _) = text.split_once(' ').unwrap();
            (task.file_name(), run_ns.parse().unwrap())
        };
        let tasks = std::fs::read_dir("/proc/self/task").unwrap();
        tasks.map(|task| run_time(task.unwrap())).collect()
    }

    /// Run by the test below: other tests of this process have threads, too.
    #[test]
    #[ignore = "a part of the test below"]
    fn training_in_its_own_process() {
        let mut recipe = recipe(0);
        recipe.training.threads = std::env::var(THREADS).unwrap().parse().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let mut training = Training::open(recipe, data(), folder.path(), false).unwrap();
        // The first steps begin the threads.
        for _ in 0..2 {
            training.advance().unwrap();
        }
        let before = run_times();
        while !training.is_done() {
            training.advance().unwrap();
        }
        let after = run_times();
        let have_run = |(task, run_ns): &(&OsString, &u64)| before.get(*task) != Some(*run_ns);
        println!("{} threads compute", after.iter().filter(have_run).count());
    }

    #[test]
    fn as_many_threads_compute_as_a_training_is_told_and_one_more_draws_the_samples() {
        let computing = |threads: usize| {
            let test = "training::tests::training_in_its_own_process";
            let output = std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--ignored", "--exact", test, "--nocapture"])
                .env(THREADS, threads.to_string())
                .output()
                .unwrap();
            let text = String::from_utf8(output.stdout).unwrap();
            let words: Vec<&str> = text.split_whitespace().collect();
            let found = words
                .windows(3)
                .find(|words| words[1..] == ["threads", "compute"]);
            let number = found.and_then(|words| words[0].parse::<usize>().ok());
            number.unwrap_or_else(|| panic!("{text}"))
        };
        // libtorch begins a second pool of so many threads, of pthreadpool, that none of our layers uses: it does not run.
        for threads in [1, 2, 3, 5] {
            assert_eq!(computing(threads), threads + 1);
        }
    }

    #[test]
    fn a_training_begins_with_the_weights_of_a_checkpoint() {
        let folder = tempfile::tempdir().unwrap();
        let mut first = Training::open(recipe(0), data(), folder.path(), false).unwrap();
        let losses = first.advance().unwrap();
        let card = ModelCard::new();
        let snapshot = first.save_snapshot(&card).unwrap();
        let open = |recipe: Recipe| {
            let folder = tempfile::tempdir().unwrap();
            Training::open(recipe, data(), folder.path(), false)
        };
        let onward = |start_from| Recipe {
            start_from,
            ..recipe(0)
        };
        // The same first samples: what the first step has learned is seen.
        let again = open(onward(None)).unwrap().advance().unwrap();
        assert_eq!(losses, again);
        let further = open(onward(Some(snapshot.clone()))).unwrap().advance();
        let further = further.unwrap();
        assert!(
            further.pick + further.place < losses.pick + losses.place,
            "{losses:?} {further:?}"
        );
        let mut other = onward(Some(snapshot));
        other.network.rotations = 4;
        let error = open(other).unwrap_err().to_string();
        assert!(error.contains("expected {"), "{error}");
    }

    #[test]
    fn a_folder_with_a_training_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let mut training = Training::open(recipe(0), data(), folder.path(), false).unwrap();
        training.advance().unwrap();
        training.save_state().unwrap();
        let error = Training::open(recipe(0), data(), folder.path(), false).unwrap_err();
        assert!(error.to_string().contains("resume"), "{error}");
    }
}
