//! A stop or fault outlives the process: what was stopped does not go on by itself after a restart.

use std::io;
use std::path::{Path, PathBuf};

use tracing::error;

/// A file that is there from a stop or fault until the next approval, and during every motion: where the process ends in the middle
/// of one, that is a stop too.
#[derive(Debug)]
pub(crate) struct StopMemory {
    /// Nothing where stops are not to be remembered.
    path: Option<PathBuf>,
    /// What has stopped the executor, until the next approval.
    stopped: Option<String>,
}

impl StopMemory {
    /// Reads the file of the process before, and makes sure that it can be written; an empty path for no file.
    ///
    /// # Errors
    /// The file cannot be read, or nothing can be written beside it.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        if path.as_os_str().is_empty() {
            return Ok(Self {
                path: None,
                stopped: None,
            });
        }
        let stopped = match std::fs::read_to_string(path) {
            Ok(reason) => Some(reason),
            Err(error) if error.kind() == io::ErrorKind::NotFound => None,
            Err(error) => return Err(error),
        };
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        // At a stop it would be too late to say that nothing can be written.
        let mut trial = path.as_os_str().to_owned();
        trial.push(".trial");
        std::fs::write(&trial, "")?;
        std::fs::remove_file(&trial)?;
        Ok(Self {
            path: Some(path.to_owned()),
            stopped,
        })
    }

    /// What has stopped the executor since the last approval, if something has.
    pub(crate) fn stopped(&self) -> Option<&str> {
        self.stopped.as_deref()
    }

    /// Something has stopped the executor.
    pub(crate) fn remember(&mut self, reason: &str) {
        self.write(reason);
        self.stopped = Some(reason.to_owned());
    }

    /// A motion begins. `lets_go_on`: it was approved, and what has stopped the executor before is over.
    pub(crate) fn begin(&mut self, motion: &str, lets_go_on: bool) {
        if lets_go_on {
            self.stopped = None;
        }
        if self.stopped.is_none() {
            self.write(&format!("the process ended in the middle of {motion}"));
        }
    }

    /// A motion has ended.
    pub(crate) fn end(&self) {
        if self.stopped.is_none()
            && let Some(path) = &self.path
            && let Err(error) = std::fs::remove_file(path)
            && error.kind() != io::ErrorKind::NotFound
        {
            error!("{}: {error}", path.display());
        }
    }

    fn write(&self, reason: &str) {
        if let Some(path) = &self.path
            && let Err(error) = std::fs::write(path, reason)
        {
            error!("{}: the stop is not remembered: {error}", path.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the next process would know.
    fn recalled(path: &Path) -> Option<String> {
        StopMemory::open(path).unwrap().stopped
    }

    #[test]
    fn a_stop_is_recalled_until_a_motion_is_approved_and_never_without_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state/of/the/cell/stopped");
        let mut memory = StopMemory::open(&path).unwrap();
        assert_eq!(memory.stopped(), None);
        memory.end();
        memory.remember("STOP by `anna`");
        assert_eq!(memory.stopped(), Some("STOP by `anna`"));
        // Another process.
        let mut memory = StopMemory::open(&path).unwrap();
        assert_eq!(memory.stopped(), Some("STOP by `anna`"));
        // The way home lets nothing go on.
        memory.begin("the way home", false);
        memory.end();
        assert_eq!(recalled(&path).as_deref(), Some("STOP by `anna`"));
        memory.begin("the motion of proposal 7", true);
        memory.end();
        assert_eq!(recalled(&path), None);
        let mut none = StopMemory::open(Path::new("")).unwrap();
        none.remember("STOP");
        none.begin("the motion of proposal 7", true);
        none.end();
    }

    #[test]
    fn a_process_that_ends_in_the_middle_of_a_motion_was_stopped() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stopped");
        for motion in ["the motion of proposal 7", "the way home"] {
            let mut memory = StopMemory::open(&path).unwrap();
            memory.begin(motion, motion != "the way home");
            // Killed here, another one would find it.
            assert!(recalled(&path).is_some_and(|reason| reason.contains(motion)));
            memory.end();
            assert_eq!(recalled(&path), None);
        }
        let mut memory = StopMemory::open(&path).unwrap();
        memory.begin("the motion of proposal 8", true);
        memory.remember("proposal 8: PROTECTIVE_STOP");
        memory.end();
        assert!(recalled(&path).is_some_and(|reason| reason.contains("PROTECTIVE_STOP")));
    }

    #[test]
    fn a_file_that_cannot_be_read_or_written_is_refused_at_the_start() {
        let folder = tempfile::tempdir().unwrap();
        // A folder is no file, and a file no folder.
        assert!(StopMemory::open(folder.path()).is_err());
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert!(StopMemory::open(&file.join("stopped")).is_err());
    }
}
