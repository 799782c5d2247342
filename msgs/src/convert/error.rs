//! What can be wrong with a message.

/// A message that cannot be converted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[allow(missing_docs, reason = "each message names its fields")]
pub enum ConvertError {
    /// A sequence has another length than other fields ask for.
    #[error("{field} has {actual} elements, expected {expected}")]
    Size {
        field: &'static str,
        actual: usize,
        expected: usize,
    },
    /// A number is infinite or not a number.
    #[error("{field} is not finite, expected a finite number")]
    NotFinite { field: &'static str },
    /// An element of a sequence is infinite or not a number.
    #[error("{field}[{index}] is not finite, expected a finite number")]
    ElementNotFinite { field: &'static str, index: usize },
    /// Any other value that is out of range or not known.
    #[error("{field} is {actual}, expected {expected}")]
    Unexpected {
        field: &'static str,
        actual: String,
        expected: String,
    },
    /// A part of the message.
    #[error("{field}.{source}")]
    Part {
        field: &'static str,
        source: Box<ConvertError>,
    },
    /// Points that make no trajectory.
    #[error("trajectory points: {0}")]
    Trajectory(Box<ur5::PlanError>),
}

impl From<ur5::PlanError> for ConvertError {
    fn from(error: ur5::PlanError) -> Self {
        Self::Trajectory(Box::new(error))
    }
}

pub(super) fn unexpected(
    field: &'static str,
    actual: impl std::fmt::Display,
    expected: impl Into<String>,
) -> ConvertError {
    ConvertError::Unexpected {
        field,
        actual: actual.to_string(),
        expected: expected.into(),
    }
}

pub(super) fn finite(field: &'static str, value: f64) -> Result<f64, ConvertError> {
    if value.is_finite() {
        Ok(value)
    } else {
        Err(ConvertError::NotFinite { field })
    }
}

pub(super) fn all_finite(field: &'static str, values: &[f64]) -> Result<(), ConvertError> {
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(ConvertError::ElementNotFinite { field, index }),
        None => Ok(()),
    }
}

pub(super) fn positive(field: &'static str, value: f64) -> Result<f64, ConvertError> {
    if finite(field, value)? > 0.0 {
        Ok(value)
    } else {
        Err(unexpected(field, value, "a positive number"))
    }
}

pub(super) fn size(
    field: &'static str,
    actual: usize,
    expected: usize,
) -> Result<(), ConvertError> {
    if actual == expected {
        Ok(())
    } else {
        Err(ConvertError::Size {
            field,
            actual,
            expected,
        })
    }
}
