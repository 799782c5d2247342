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

    /// A problem by its name.
    pub fn problem(&self, name: &str) -> Result<Problem> {
        Ok(Problem::load(&self.join("config/problems"), name)?)
    }

    /// The policy that comes with the repository.
    pub fn shipped_checkpoint(&self) -> PathBuf {
        self.join("config/checkpoints/ten_problems.safetensors")
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
