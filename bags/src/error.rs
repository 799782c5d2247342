//! What can go wrong with a bag.

use mcap::McapError;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A bag that cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum BagError {
    /// The system refused.
    #[error("{}: {source}", path.display())]
    Io { path: PathBuf, source: io::Error },
    /// No space left.
    #[error("{}: the disk is full; the messages up to the last flush are kept", path.display())]
    DiskFull { path: PathBuf },
    /// Bags are never overwritten.
    #[error("{}: exists already, expected a new name", path.display())]
    Exists { path: PathBuf },
    /// An earlier writer stopped half-way.
    #[error("{}: a half-written bag of an earlier run, expected none; recover or remove it", path.display())]
    HalfWritten { path: PathBuf },
    /// Something else, or nothing.
    #[error("{}: not a bag: {reason}", path.display())]
    NotABag { path: PathBuf, reason: String },
    /// The file has no end: its writer stopped half-way, or it was cut.
    #[error("{}: ends early, expected a finished MCAP file; its writer stopped half-way or it was cut", path.display())]
    Truncated { path: PathBuf },
    /// The contents contradict themselves.
    #[error("{}: damaged: {reason}", path.display())]
    Damaged { path: PathBuf, reason: String },
    /// A topic cannot have two types.
    #[error("topic {topic} is written as {actual} already, expected {expected}")]
    Conflict {
        topic: String,
        actual: String,
        expected: String,
    },
    /// A message of another type than asked for.
    #[error("topic {topic} holds {actual}, expected {expected}")]
    Type {
        topic: String,
        actual: String,
        expected: String,
    },
    /// The type has changed since the bag was written.
    #[error(
        "topic {topic} was written with another definition of {type_name}: hash {actual}, expected {expected}"
    )]
    Definition {
        topic: String,
        type_name: String,
        actual: String,
        expected: String,
    },
    /// Not valid CDR.
    #[error("topic {topic} at {time:?}: {source}")]
    Message {
        topic: String,
        time: Duration,
        source: msgs::CdrError,
    },
    /// A message that rosbag2 compressed, and that is not valid Zstandard.
    #[error("topic {topic} at {time:?}: cannot be uncompressed: {reason}")]
    Packed {
        topic: String,
        time: Duration,
        reason: String,
    },
    /// A time that the format cannot hold.
    #[error("time {0:?}, expected less than 2^64 ns")]
    Time(Duration),
}

impl BagError {
    pub(crate) fn io(path: &Path, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::StorageFull
            | io::ErrorKind::QuotaExceeded
            | io::ErrorKind::FileTooLarge => Self::DiskFull { path },
            io::ErrorKind::UnexpectedEof => Self::Truncated { path },
            _ => Self::Io { path, source },
        }
    }

    pub(crate) fn mcap(path: &Path, error: McapError) -> Self {
        match error {
            McapError::Io(source) => Self::io(path, source),
            McapError::UnexpectedEof | McapError::BadFooter => Self::Truncated {
                path: path.to_owned(),
            },
            other => Self::Damaged {
                path: path.to_owned(),
                reason: other.to_string(),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::io::BufWriter;

    #[test]
    fn a_full_disk_is_told_apart() {
        // Linux's device on which nothing has room.
        let path = Path::new("/dev/full");
        let mut writer = mcap::Writer::new(BufWriter::new(File::create(path).unwrap())).unwrap();
        let error = writer.flush().unwrap_err();
        assert!(matches!(
            BagError::mcap(path, error),
            BagError::DiskFull { .. }
        ));
    }
}
