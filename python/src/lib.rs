//! The extension module behind the Python package `multiravens`: what its functions and classes do is written in
//! `package/multiravens/_multiravens.pyi` and in the docstrings below.

mod arrays;
mod camera;
mod demonstration;
mod episode;
mod episodes;
mod parallel;
mod problems;
mod workspace;

#[pyo3::pymodule]
mod _multiravens {
    #[pymodule_export]
    use super::camera::{PyCamera, fuse};
    #[pymodule_export]
    use super::demonstration::{PyDemonstration, demonstrate, read_demonstration};
    #[pymodule_export]
    use super::episodes::Episodes;
    #[pymodule_export]
    use super::problems::{is_held_out, problem_names};
    #[pymodule_export]
    use super::workspace::PyWorkspace;
}
