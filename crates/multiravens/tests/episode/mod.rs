//! Episodes of a problem.

use multiravens::{Environment, Problem};
use std::path::Path;
use ur5::WorkCell;

/// An environment of a problem of the repository.
pub fn environment(problem: &str) -> Environment {
    let problems = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/problems");
    let problem = Problem::load(&problems, problem).unwrap();
    Environment::new(&problem, &WorkCell::builtin().unwrap())
}
