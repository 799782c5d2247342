//! The problems that come with the package, and those of files.

use multiravens::Problem;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::path::Path;

/// Name and text of each file of `config/problems`, by name.
const PROBLEMS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/problems.rs"));

/// A problem by its name, or by the path of its file.
pub fn problem(name: &str) -> PyResult<Problem> {
    if name.ends_with(".yaml") {
        return Problem::load_file(Path::new(name)).map_err(value_error);
    }
    let Some((_, text)) = PROBLEMS.iter().find(|(known, _)| *known == name) else {
        return Err(PyValueError::new_err(format!(
            "problem: no problem {name:?}, expected the path of a file NAME.yaml or one of {}",
            problem_names().join(", ")
        )));
    };
    Problem::parse(name, text)
        .map_err(|reason| PyValueError::new_err(format!("{name}.yaml: {reason}")))
}

/// A `ValueError` with the message of an error.
pub fn value_error(error: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Names of the problems that come with the package.
#[pyfunction]
pub fn problem_names() -> Vec<&'static str> {
    PROBLEMS.iter().map(|(name, _)| *name).collect()
}

/// Whether no policy may be trained on a problem: it measures what policies do with what they never saw.
#[pyfunction]
#[pyo3(name = "is_held_out")]
pub fn is_held_out(problem: &str) -> PyResult<bool> {
    Ok(self::problem(problem)?.is_held_out())
}
