//! A stop or fault outlives the process: what was stopped does not go on by itself after a restart.

use std::io;
use std::path::{Path, PathBuf};

use tracing::error;

/// A file that is there from a stop or fault until the next approval, and during every motion; its text says why
/// ([`step_protocol::StopRecord`]).
#[derive(Debug)]
pub struct StopFile {
    /// Nothing where stops are not to be remembered.
    path: Option<PathBuf>,
    /// Its text; nothing where there is no file.
    text: Option<String>,
}

impl StopFile {
    /// Reads the file of the process before, and makes sure that it can be written; an empty path for no file.
    ///
    /// # Errors
    /// The file cannot be read, or nothing can be written beside it.
    pub fn open(path: &Path) -> io::Result<Self> {
        if path.as_os_str().is_empty() {
            return Ok(Self {
                path: None,
                text: None,
            });
        }
        let text = match std::fs::read_to_string(path) {
            Ok(text) => Some(text),
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
            text,
        })
    }

    /// What has stopped the executor; nothing where it may go on.
    pub fn text(&self) -> Option<&str> {
        self.text.as_deref()
    }

    /// Writes what the next process has to know; nothing removes the file. A failure stands in the log: a stop must not wait for it.
    pub fn keep(&mut self, text: Option<String>) {
        if self.text == text {
            return;
        }
        if let Some(path) = &self.path {
            let kept = match &text {
                Some(text) => std::fs::write(path, text),
                None => std::fs::remove_file(path),
            };
            match kept {
                Err(error) if text.is_some() => {
                    error!("{}: the stop is not remembered: {error}", path.display());
                }
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    error!("{}: {error}", path.display());
                }
                Ok(()) | Err(_) => {}
            }
        }
        self.text = text;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the next process would know.
    fn recalled(path: &Path) -> Option<String> {
        StopFile::open(path).unwrap().text
    }

    #[test]
    fn the_next_process_reads_what_was_kept_until_nothing_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state/of/the/cell/stopped");
        let mut file = StopFile::open(&path).unwrap();
        assert_eq!(file.text(), None);
        file.keep(None);
        for text in ["stop of proposal 7", "proposal 8: PROTECTIVE_STOP"] {
            file.keep(Some(text.to_owned()));
            assert_eq!(recalled(&path).as_deref(), Some(text));
        }
        // Another process.
        let mut file = StopFile::open(&path).unwrap();
        assert_eq!(file.text(), Some("proposal 8: PROTECTIVE_STOP"));
        file.keep(None);
        assert_eq!(recalled(&path), None);
        // Somebody has removed it.
        file.keep(Some("stop".to_owned()));
        std::fs::remove_file(&path).unwrap();
        file.keep(None);
        assert_eq!(recalled(&path), None);
    }

    #[test]
    fn without_a_path_nothing_is_written() {
        let mut none = StopFile::open(Path::new("")).unwrap();
        none.keep(Some("stop".to_owned()));
        assert_eq!(none.text(), Some("stop"));
        none.keep(None);
    }

    #[test]
    fn a_file_that_cannot_be_read_or_written_is_refused_at_the_start() {
        let folder = tempfile::tempdir().unwrap();
        // A folder is no file, and a file no folder.
        assert!(StopFile::open(folder.path()).is_err());
        let file = folder.path().join("file");
        std::fs::write(&file, "").unwrap();
        assert!(StopFile::open(&file.join("stopped")).is_err());
    }
}
