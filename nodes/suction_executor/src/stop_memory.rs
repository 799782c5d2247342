//! A stop or fault outlives the process: what was stopped does not go on by itself after a restart.

use std::io;
use std::path::PathBuf;

use tracing::error;

/// A file that is there from a stop or fault until the next approval.
#[derive(Clone, Debug)]
pub(crate) struct StopMemory {
    /// Nothing where stops are not to be remembered.
    path: Option<PathBuf>,
}

impl StopMemory {
    /// Keeps its memory in a file; an empty path for none.
    pub(crate) fn new(path: PathBuf) -> Self {
        let path = (!path.as_os_str().is_empty()).then_some(path);
        Self { path }
    }

    /// What has stopped the executor before this process, if something has.
    ///
    /// # Errors
    /// The file cannot be read.
    pub(crate) fn recall(&self) -> io::Result<Option<String>> {
        let Some(path) = &self.path else {
            return Ok(None);
        };
        match std::fs::read_to_string(path) {
            Ok(reason) => Ok(Some(reason)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// Something has stopped the executor.
    pub(crate) fn remember(&self, reason: &str) {
        if let Some(path) = &self.path
            && let Err(error) = std::fs::write(path, reason)
        {
            error!("{}: the stop is not remembered: {error}", path.display());
        }
    }

    /// An approval lets things go on.
    pub(crate) fn forget(&self) {
        if let Some(path) = &self.path
            && let Err(error) = std::fs::remove_file(path)
            && error.kind() != io::ErrorKind::NotFound
        {
            error!("{}: {error}", path.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_is_recalled_until_it_is_forgotten_and_never_without_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stopped");
        let memory = StopMemory::new(path.clone());
        assert_eq!(memory.recall().unwrap(), None);
        memory.forget();
        memory.remember("STOP by `anna`");
        // Another process.
        let memory = StopMemory::new(path);
        assert_eq!(memory.recall().unwrap().as_deref(), Some("STOP by `anna`"));
        memory.forget();
        assert_eq!(memory.recall().unwrap(), None);
        let none = StopMemory::new(PathBuf::new());
        none.remember("STOP");
        assert_eq!(none.recall().unwrap(), None);
        // A folder is no file.
        assert!(StopMemory::new(folder.path().to_owned()).recall().is_err());
    }
}
