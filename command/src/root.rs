//! Where config/ and urdf/ are.

use anyhow::{Context, Result, bail};
use multiravens::Problem;
use std::path::{Path, PathBuf};
use ur5::WorkCell;

/// The folder that holds config/ and urdf/.
#[derive(Clone, Debug)]
pub struct Root(PathBuf);

impl Root {
    /// The folder given, or the nearest one above the current folder or the program.
    pub fn find(given: Option<PathBuf>) -> Result<Self> {
        let is_root =
            |path: &Path| path.join("config/problems").is_dir() && path.join("urdf").is_dir();
        if let Some(path) = given {
            if !is_root(&path) {
                bail!(
                    "--root {}: expected a folder that holds config/problems and urdf",
                    path.display()
                );
            }
            return Ok(Self(path));
        }
        let current = std::env::current_dir().context("current folder")?;
        let program = std::env::current_exe().context("path of the program")?;
        let above = current.ancestors().chain(program.ancestors());
        let found = above
            // Installed as a ROS package, the files are in share/.
            .flat_map(|path| [path.to_owned(), path.join("share/sctn_nodes")])
            .find(|path| is_root(path));
        let found = found.context(
            "no config/problems and urdf above the current folder: name their folder with --root",
        )?;
        Ok(Self(found))
    }

    /// A path below.
    pub fn join(&self, path: impl AsRef<Path>) -> PathBuf {
        self.0.join(path)
    }

    /// A problem by its name, or by the path of its file.
    pub fn problem(&self, name: &str) -> Result<Problem> {
        if name.ends_with(".yaml") {
            return Ok(Problem::load_file(Path::new(name))?);
        }
        Ok(Problem::load(&self.join("config/problems"), name)?)
    }

    /// The folder of a problem's file and the problem's name, as the simulated cell takes them.
    pub fn problem_place(&self, name: &str) -> (PathBuf, String) {
        let path = Path::new(name);
        match (name.strip_suffix(".yaml"), path.file_stem(), path.parent()) {
            (Some(_), Some(stem), Some(folder)) => {
                let here = folder.as_os_str().is_empty();
                let folder = if here { Path::new(".") } else { folder };
                (folder.to_owned(), stem.to_string_lossy().into_owned())
            }
            _ => (self.join("config/problems"), name.to_owned()),
        }
    }

    /// Refuses problems that are kept out of training.
    pub fn check_trainable(&self, problems: &[String]) -> Result<()> {
        for name in problems {
            let file = self.join("config/problems").join(format!("{name}.yaml"));
            // The files of problems drawn at random are elsewhere.
            if file.exists() && self.problem(name)?.is_held_out() {
                bail!(
                    "{}: held out of all training, expected another problem to train on",
                    file.display()
                );
            }
        }
        Ok(())
    }

    /// The policy that comes with the repository.
    pub fn shipped_checkpoint(&self) -> PathBuf {
        self.join("config/checkpoints/ten_problems.safetensors")
    }

    /// The policy that comes with the repository for demonstrations of another start; it is conditioned on the images before and
    /// after each step.
    pub fn any_start_checkpoint(&self) -> PathBuf {
        self.join("config/checkpoints/any_start.safetensors")
    }

    /// The embedding that comes with the repository.
    pub fn shipped_embedding(&self) -> PathBuf {
        self.join("config/checkpoints/embedding.safetensors")
    }

    /// The work cell.
    pub fn work_cell(&self) -> Result<WorkCell> {
        Ok(WorkCell::load(&self.join("urdf/workcell.urdf"))?)
    }
}
