//! Demonstrations that evaluations show, kept as bags in a folder.

use crate::data_set::demonstration_path;
use crate::evaluation::EvaluationError;
use crate::rollout::demonstrate;
use bags::{Demonstration, DemonstrationError};
use camera_noise::Perturbation;
use multiravens::{Environment, EpisodeSeed, Problem};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use ur5::WorkCell;

/// A folder of the demonstrations of one problem that evaluations show: each is simulated once, and read from then on.
#[derive(Clone, Debug)]
pub struct ShownFolder {
    folder: PathBuf,
    problem: String,
}

/// A folder of shown demonstrations that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ShownError {
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The reason.
        source: std::io::Error,
    },
    /// A bag cannot be written or read.
    #[error(transparent)]
    Bag(#[from] DemonstrationError),
}

impl ShownFolder {
    /// A folder within `folder`, whose name stands for this very program, the problem, the work cell and the perturbation: what any
    /// other one has simulated is never shown.
    pub fn new(
        folder: &Path,
        problem: &Problem,
        work_cell: &WorkCell,
        perturbation: Option<&Perturbation>,
    ) -> Result<Self, ShownError> {
        let mut hasher = DefaultHasher::new();
        program()?.hash(&mut hasher);
        format!("{problem:?} {work_cell:?} {perturbation:?}").hash(&mut hasher);
        Ok(Self {
            folder: folder.join(format!("{:016x}", hasher.finish())),
            problem: problem.name().to_owned(),
        })
    }

    /// The demonstration of a seed, from the folder or of the environment. `None`: the demonstrator fails on this seed.
    pub(crate) fn demonstrate(
        &self,
        environment: &mut Environment,
        seed: EpisodeSeed,
    ) -> Result<Option<Demonstration>, EvaluationError> {
        let path = demonstration_path(&self.folder, &self.problem, seed);
        let failed = path.with_extension("failed");
        if failed.exists() {
            return Ok(None);
        }
        if path.exists() {
            let demonstration = Demonstration::read(&path).map_err(ShownError::from)?;
            return Ok(Some(demonstration));
        }
        let shown = shown(environment, seed)?;
        match &shown {
            Some(demonstration) => keep(demonstration, &path)?,
            None => {
                let write = std::fs::create_dir_all(self.folder.join(&self.problem))
                    .and_then(|()| std::fs::write(&failed, ""));
                write.map_err(io(&failed))?;
            }
        }
        Ok(shown)
    }
}

/// The demonstration of a seed. `None`: the demonstrator fails on it.
pub(crate) fn shown(
    environment: &mut Environment,
    seed: EpisodeSeed,
) -> Result<Option<Demonstration>, EvaluationError> {
    match demonstrate(environment, seed) {
        Ok(rollout) => Ok(rollout.complete.then_some(rollout.demonstration)),
        Err(source) => Err(EvaluationError::Environment {
            seed: seed.scene,
            source: Box::new(source),
        }),
    }
}

/// Writes a bag that appears whole or not at all: other threads and programs may write the same one.
fn keep(demonstration: &Demonstration, path: &Path) -> Result<(), ShownError> {
    let parent = path.parent().unwrap_or(path);
    std::fs::create_dir_all(parent).map_err(io(parent))?;
    let temporary = tempfile::tempdir_in(parent).map_err(io(parent))?;
    let bag = temporary.path().join("bag");
    demonstration.write(&bag)?;
    match std::fs::rename(&bag, path) {
        // Another one was faster, with the same bits.
        Err(_) if path.exists() => Ok(()),
        renamed => Ok(renamed.map_err(io(path))?),
    }
}

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> ShownError + use<> {
    let path = path.to_owned();
    |source| ShownError::Io { path, source }
}

/// A number that stands for the running program: what it simulates changes only with it.
fn program() -> Result<u32, ShownError> {
    static PROGRAM: OnceLock<u32> = OnceLock::new();
    if let Some(program) = PROGRAM.get() {
        return Ok(*program);
    }
    let path = std::env::current_exe().map_err(io(Path::new("the running program")))?;
    let bytes = std::fs::read(&path).map_err(io(&path))?;
    Ok(*PROGRAM.get_or_init(|| crc32c::crc32c(&bytes)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Actor, Episodes, Evaluation, Start, evaluate};

    fn config() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../config")
    }

    /// Two episodes of the rule that has learned nothing.
    fn evaluation(
        start: Start,
        perturbation: Option<&Perturbation>,
        shown: Option<&Path>,
    ) -> Evaluation {
        let problem = Problem::load(&config().join("problems"), "stacking").unwrap();
        let work_cell = WorkCell::builtin().unwrap();
        let plan = Episodes {
            first_seed: 10_000,
            count: 2,
            start,
        };
        let mut actors = [Actor::Difference];
        let evaluation = evaluate(
            &problem,
            &work_cell,
            &mut actors,
            &plan,
            perturbation,
            shown,
            |_, _| (),
        );
        Evaluation {
            seconds: 0.0,
            ..evaluation.unwrap()
        }
    }

    #[test]
    fn demonstrations_from_the_folder_change_no_result() {
        let folder = tempfile::tempdir().unwrap();
        let mild = Perturbation::load(&config().join("perturbations/mild.yaml")).unwrap();
        for (start, perturbation) in [(Start::Same, None), (Start::Other, Some(&mild))] {
            let simulated = evaluation(start, perturbation, None);
            for _ in 0..2 {
                let kept = evaluation(start, perturbation, Some(folder.path()));
                assert_eq!(simulated, kept, "{start:?}");
            }
        }
        // One folder for each perturbation, with two episodes.
        let entries = |path: PathBuf| path.read_dir().unwrap().map(|entry| entry.unwrap().path());
        let kept: Vec<_> = entries(folder.path().to_owned()).collect();
        assert_eq!(kept.len(), 2);
        for kept in kept {
            assert_eq!(entries(kept.join("stacking")).count(), 2);
        }
    }

    #[test]
    fn what_is_kept_is_shown_and_damage_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let whole = evaluation(Start::Same, None, Some(folder.path()));
        let problem = Problem::load(&config().join("problems"), "stacking").unwrap();
        let work_cell = WorkCell::builtin().unwrap();
        let kept = ShownFolder::new(folder.path(), &problem, &work_cell, None).unwrap();
        let path = |seed| demonstration_path(&kept.folder, "stacking", seed);
        // Were the first one simulated again, its episode would be there.
        std::fs::write(path(10_000).with_extension("failed"), "").unwrap();
        let without = evaluation(Start::Same, None, Some(folder.path()));
        assert_eq!(without.skipped_seeds, [10_000]);
        assert_eq!(without.reports[0], whole.reports[1]);

        std::fs::remove_file(path(10_002).join("metadata.yaml")).unwrap();
        let mut environment = Environment::new(&problem, &work_cell);
        let error = kept.demonstrate(&mut environment, 10_002.into());
        let error = error.unwrap_err().to_string();
        assert!(error.contains("010002"), "{error}");
    }
}
