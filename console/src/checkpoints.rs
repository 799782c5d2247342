//! The folders of checkpoints that the policy can be given.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::UNIX_EPOCH;

use serde::Serialize;

use crate::lesson::check_name;
use crate::refusal::Refusal;

/// Most checkpoints that are listed.
const MOST: usize = 1000;
const EXTENSION: &str = "safetensors";

/// A checkpoint in one of the folders.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Checkpoint {
    /// Name of its file, without the extension.
    pub name: String,
    /// When it was saved: seconds since 1970.
    pub saved_at_s: u64,
}

/// The checkpoints of the folders.
#[derive(Debug)]
pub struct Checkpoints {
    folders: [PathBuf; 2],
}

impl Checkpoints {
    /// The folders need not be there yet; of two checkpoints of a name the one of the first folder counts.
    pub fn new(folders: [PathBuf; 2]) -> Self {
        Self { folders }
    }

    /// All checkpoints, newest first. Reads the folders.
    pub fn list(&self) -> Vec<Checkpoint> {
        let folders = self.folders.iter();
        let mut found: Vec<_> = folders
            .filter_map(|folder| std::fs::read_dir(folder).ok())
            .flatten()
            .flatten()
            .take(MOST)
            .filter_map(|file| {
                let path = file.path();
                let name = path.file_stem()?.to_str()?.to_owned();
                let is_checkpoint = path.extension().is_some_and(|end| end == EXTENSION);
                check_name(&name).ok().filter(|()| is_checkpoint)?;
                let saved = file.metadata().ok()?.modified().ok()?;
                let saved_at_s = saved.duration_since(UNIX_EPOCH).ok()?.as_secs();
                Some(Checkpoint { name, saved_at_s })
            })
            .collect();
        found.sort_by(|a, b| (b.saved_at_s, &a.name).cmp(&(a.saved_at_s, &b.name)));
        let mut names = BTreeSet::new();
        found.retain(|found| names.insert(found.name.clone()));
        found
    }

    /// Where a checkpoint is.
    ///
    /// # Errors
    /// When there is none of that name.
    pub fn path(&self, name: &str) -> Result<PathBuf, Refusal> {
        check_name(name)?;
        let in_folder = |folder: &PathBuf| folder.join(name).with_extension(EXTENSION);
        let mut paths = self.folders.iter().map(in_folder);
        let found = paths.find(|path| path.is_file());
        let found = found.and_then(|path| std::path::absolute(path).ok());
        found.ok_or_else(|| {
            Refusal::new(
                format!("There is no checkpoint {name}."),
                "Choose another one, or look at the parameter checkpoints.",
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checkpoints_are_listed_by_name_and_nothing_else_is() {
        let folder = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::new(["no/such/folder".into(), folder.path().to_owned()]);
        for file in ["one.safetensors", "README.md", "two.safetensors.partial"] {
            std::fs::write(folder.path().join(file), "").unwrap();
        }
        let names: Vec<_> = checkpoints
            .list()
            .into_iter()
            .map(|found| found.name)
            .collect();
        assert_eq!(names, ["one"]);
        assert!(
            checkpoints
                .path("one")
                .unwrap()
                .ends_with("one.safetensors")
        );
        for name in ["two", "../one", "", "README"] {
            assert!(checkpoints.path(name).is_err(), "{name}");
        }
    }
}
