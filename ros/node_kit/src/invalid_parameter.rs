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

    /// For a text that a node cannot do without: `Ok` unless it is empty.
    ///
    /// # Errors
    /// Says that it must not be empty.
    pub fn unless_given(name: &str, text: &str) -> Result<(), Self> {
        match text.is_empty() {
            true => Err(Self::new(name, "must not be empty")),
            false => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_text_is_refused_by_the_parameters_name() {
        assert_eq!(
            InvalidParameter::unless_given("world_frame", "world"),
            Ok(())
        );
        let error = InvalidParameter::unless_given("world_frame", "").unwrap_err();
        assert_eq!(
            error.to_string(),
            "parameter world_frame: must not be empty"
        );
    }
}
