//! What can go wrong while topics are recorded or played.

use bags::BagError;
use node_kit::NodeError;
use std::path::PathBuf;

/// A recording or a playback that cannot begin or go on.
#[derive(Debug, thiserror::Error)]
#[allow(
    missing_docs,
    reason = "the message of each variant explains its fields"
)]
pub enum TransportError {
    /// The bag cannot be read or written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The middleware or a name of ROS.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The system refused.
    #[error("{what}: {source}")]
    Io {
        what: String,
        source: std::io::Error,
    },
    /// The recording broke off; the messages up to then are kept.
    #[error(
        "record {}: {source}; what was written until then is in {}: sctn bag recover", bag.display(), partial.display()
    )]
    BrokenOff {
        bag: PathBuf,
        partial: PathBuf,
        source: Box<TransportError>,
    },
    /// A thread of this crate ended without a result.
    #[error("the thread {0:?} panicked")]
    Panicked(&'static str),
    /// An option out of its range.
    #[error("{option} is {value}, expected {expected}")]
    Option {
        option: &'static str,
        value: String,
        expected: String,
    },
    /// The bag holds nothing to play.
    #[error("{}: {reason}", bag.display())]
    NothingToPlay { bag: PathBuf, reason: String },
}
