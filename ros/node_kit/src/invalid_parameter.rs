//! A parameter that cannot be used.

/// A value that a node cannot work with.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("parameter {name}: {reason}")]
pub struct InvalidParameter {
    /// Dotted name.
    pub name: String,
    /// What was expected, and what was found.
    pub reason: String,
}

impl InvalidParameter {
    /// `name` is dotted; `reason` says what was expected and what was found.
    pub fn new(name: impl Into<String>, reason: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            reason: reason.into(),
        }
    }
}
