//! Checkpoints.

use std::collections::BTreeMap;

/// What the maker of a checkpoint says about it: title to text.
pub type ModelCard = BTreeMap<String, String>;

/// How weights are stored on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Storage {
    /// As they are.
    F32,
    /// Rounded to 16-bit floats: half the size.
    F16,
}
