//! The workspace: SE(2) poses in metres and in cells.

use crate::arrays;
use crate::problems::value_error;
use heightmap::Workspace;
use nalgebra::Point2;
use numpy::{PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// The part of the table that heightmaps cover.
#[pyclass(frozen, eq, name = "Workspace", module = "multiravens", from_py_object)]
#[derive(Clone, Copy, PartialEq)]
pub struct PyWorkspace(pub Workspace);

#[pymethods]
impl PyWorkspace {
    /// The workspace of Ravens where nothing else is said.
    #[new]
    #[pyo3(signature = (*, x_m=0.25, y_m=-0.5, rows=320, cols=160, pixel_size_m=0.003125, z_min_m=-0.002, z_max_m=0.28))]
    fn new(
        x_m: f64,
        y_m: f64,
        rows: usize,
        cols: usize,
        pixel_size_m: f64,
        z_min_m: f64,
        z_max_m: f64,
    ) -> PyResult<Self> {
        let workspace = Workspace {
            origin_m: Point2::new(x_m, y_m),
            rows,
            cols,
            pixel_size_m,
            z_min_m,
            z_max_m,
        };
        workspace.check().map_err(value_error)?;
        Ok(Self(workspace))
    }

    /// Smallest x (m).
    #[getter]
    fn x_m(&self) -> f64 {
        self.0.origin_m.x
    }

    /// Smallest y (m).
    #[getter]
    fn y_m(&self) -> f64 {
        self.0.origin_m.y
    }

    /// Number of rows, along +y.
    #[getter]
    fn rows(&self) -> usize {
        self.0.rows
    }

    /// Number of columns, along +x.
    #[getter]
    fn cols(&self) -> usize {
        self.0.cols
    }

    /// Edge of a cell (m).
    #[getter]
    fn pixel_size_m(&self) -> f64 {
        self.0.pixel_size_m
    }

    /// Lowest height that counts (m).
    #[getter]
    fn z_min_m(&self) -> f64 {
        self.0.z_min_m
    }

    /// Greatest height that counts (m).
    #[getter]
    fn z_max_m(&self) -> f64 {
        self.0.z_max_m
    }

    /// Poses x (m), y (m), yaw (rad) of poses in cells: row, col, yaw (rad). Whole numbers are the middle of a cell.
    ///
    /// Both arrays have the shape (..., 3).
    fn poses_from_pixels<'py>(
        &self,
        py: Python<'py>,
        pixels: PyReadonlyArrayDyn<'py, f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.convert(py, "pixels", &pixels, |[row, col, yaw]| {
            let point = self.0.point_m(&Point2::new(col + 0.5, row + 0.5));
            [point.x, point.y, yaw]
        })
    }

    /// The inverse of `poses_from_pixels`.
    fn pixels_from_poses<'py>(
        &self,
        py: Python<'py>,
        poses: PyReadonlyArrayDyn<'py, f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        self.convert(py, "poses", &poses, |[x, y, yaw]| {
            let point = self.0.point_px(&Point2::new(x, y));
            [point.y - 0.5, point.x - 0.5, yaw]
        })
    }

    fn __repr__(&self) -> String {
        let Workspace {
            origin_m,
            rows,
            cols,
            pixel_size_m,
            z_min_m,
            z_max_m,
        } = self.0;
        format!(
            "Workspace(x_m={}, y_m={}, rows={rows}, cols={cols}, pixel_size_m={pixel_size_m}, z_min_m={z_min_m}, z_max_m={z_max_m})",
            origin_m.x, origin_m.y
        )
    }
}

impl PyWorkspace {
    fn convert<'py>(
        &self,
        py: Python<'py>,
        name: &str,
        given: &PyReadonlyArrayDyn<'py, f64>,
        one: impl Fn([f64; 3]) -> [f64; 3],
    ) -> PyResult<Bound<'py, PyAny>> {
        let shape = given.shape().to_vec();
        if shape.last() != Some(&3) {
            return Err(PyValueError::new_err(format!(
                "{name}: has the shape {shape:?}, expected 3 at its end"
            )));
        }
        let values: Vec<f64> = given.as_array().iter().copied().collect();
        let converted = values.as_chunks::<3>().0.iter().flat_map(|pose| one(*pose));
        Ok(arrays::array(py, &shape, converted.collect())?.into_any())
    }
}
