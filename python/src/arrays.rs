//! Rust values as arrays of numpy, and back.

use heightmap::Heightmap;
use numpy::ndarray::{ArrayD, IxDyn};
use numpy::{Element, IntoPyArray, PyArrayDyn, PyReadonlyArrayDyn, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// An array of a shape; the values are row-major, and as many as the shape says.
pub fn array<'py, T: Element>(
    py: Python<'py>,
    shape: &[usize],
    values: Vec<T>,
) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
    let array = ArrayD::from_shape_vec(IxDyn(shape), values)
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(array.into_pyarray(py))
}

/// Refuses an array of another shape, by its name.
pub fn check_shape<T: Element>(
    name: &str,
    array: &PyReadonlyArrayDyn<'_, T>,
    expected: &[usize],
) -> PyResult<()> {
    if array.shape() == expected {
        return Ok(());
    }
    Err(PyValueError::new_err(format!(
        "{name}: has the shape {:?}, expected {expected:?}",
        array.shape()
    )))
}

/// `color` and `height` of a heightmap, as a dictionary.
pub fn heightmap<'py>(py: Python<'py>, heightmap: &Heightmap) -> PyResult<Bound<'py, PyDict>> {
    let (rows, cols) = (heightmap.workspace.rows, heightmap.workspace.cols);
    let dictionary = PyDict::new(py);
    let color = array(py, &[rows, cols, 3], heightmap.rgb.clone())?;
    let height = array(py, &[rows, cols], heightmap.height_m.clone())?;
    dictionary.set_item("color", color)?;
    dictionary.set_item("height", height)?;
    Ok(dictionary)
}
