//! Cameras and fusion.

use crate::arrays;
use crate::problems::value_error;
use crate::workspace::PyWorkspace;
use heightmap::{Camera, Distortion, Fusion, Heightmap, Intrinsics, View, Workspace};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use numpy::PyReadonlyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// A calibrated RGB-D camera.
#[pyclass(frozen, eq, name = "Camera", module = "multiravens", from_py_object)]
#[derive(Clone, PartialEq)]
pub struct PyCamera(Camera);

#[pymethods]
impl PyCamera {
    #[new]
    #[pyo3(signature = (name, *, width, height, fx_px, fy_px, cx_px, cy_px, position_m, orientation_xyzw, distortion=vec![], distortion_model="plumb_bob"))]
    #[allow(clippy::too_many_arguments, reason = "all have names in Python")]
    fn new(
        name: String,
        width: usize,
        height: usize,
        fx_px: f64,
        fy_px: f64,
        cx_px: f64,
        cy_px: f64,
        position_m: [f64; 3],
        orientation_xyzw: [f64; 4],
        distortion: Vec<f64>,
        distortion_model: &str,
    ) -> PyResult<Self> {
        let [x, y, z, w] = orientation_xyzw;
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        if !(norm.is_finite() && norm > 1e-6) {
            return Err(PyValueError::new_err(format!(
                "camera {name}: orientation_xyzw is {orientation_xyzw:?}, expected a quaternion"
            )));
        }
        let distortion = Distortion::from_model(distortion_model, &distortion)
            .map_err(|error| PyValueError::new_err(format!("camera {name}: {error}")))?;
        let camera = Camera {
            name,
            intrinsics: Intrinsics {
                width,
                height,
                fx_px,
                fy_px,
                cx_px,
                cy_px,
                distortion,
            },
            world_from_camera: Isometry3::from_parts(
                Translation3::from(position_m),
                UnitQuaternion::from_quaternion(quaternion),
            ),
        };
        camera.check().map_err(value_error)?;
        Ok(Self(camera))
    }

    /// The three cameras of Ravens, which the simulated cell has: front, left, right.
    #[staticmethod]
    fn ravens() -> Vec<Self> {
        Camera::ravens().map(Self).into()
    }

    /// Its name.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Columns of its images.
    #[getter]
    fn width(&self) -> usize {
        self.0.intrinsics.width
    }

    /// Rows of its images.
    #[getter]
    fn height(&self) -> usize {
        self.0.intrinsics.height
    }

    /// Focal lengths and principal point: fx, fy, cx, cy (px).
    #[getter]
    fn intrinsics_px(&self) -> [f64; 4] {
        let Intrinsics {
            fx_px,
            fy_px,
            cx_px,
            cy_px,
            ..
        } = self.0.intrinsics;
        [fx_px, fy_px, cx_px, cy_px]
    }

    /// World from optical frame, float64, (4, 4): x right, y down, z forward.
    #[getter]
    fn world_from_camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let matrix = self.0.world_from_camera.to_homogeneous().transpose();
        Ok(arrays::array(py, &[4, 4], matrix.as_slice().to_vec())?.into_any())
    }

    fn __repr__(&self) -> String {
        format!(
            "<Camera {}, {} x {}>",
            self.0.name,
            self.width(),
            self.height()
        )
    }
}

/// Fuses RGB-D images into a heightmap: the highest point of each cell, its colour the mean over the views that saw it.
///
/// `colors` are uint8, (height, width, 3); `depths` float32 (m) along the optical axis, (height, width), 0 or not finite where
/// nothing was measured. Returns colour, uint8, (rows, cols, 3), and height (m), float32, (rows, cols).
#[pyfunction]
#[pyo3(signature = (cameras, colors, depths, workspace=None))]
#[allow(clippy::needless_pass_by_value, reason = "pyo3 gives arguments away")]
pub fn fuse<'py>(
    py: Python<'py>,
    cameras: Vec<PyCamera>,
    colors: Vec<PyReadonlyArrayDyn<'py, u8>>,
    depths: Vec<PyReadonlyArrayDyn<'py, f32>>,
    workspace: Option<PyWorkspace>,
) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyAny>)> {
    for (name, count) in [("colors", colors.len()), ("depths", depths.len())] {
        if count != cameras.len() {
            return Err(PyValueError::new_err(format!(
                "{name}: has {count} images, expected {}, one for each camera",
                cameras.len()
            )));
        }
    }
    let mut images = Vec::new();
    for ((camera, color), depth) in cameras.iter().zip(&colors).zip(&depths) {
        let (rows, cols) = (camera.height(), camera.width());
        let name = |what: &str| format!("{what} of camera {}", camera.name());
        arrays::check_shape(&name("color"), color, &[rows, cols, 3])?;
        arrays::check_shape(&name("depth"), depth, &[rows, cols])?;
        let rgb: Vec<u8> = color.as_array().iter().copied().collect();
        let depth_m: Vec<f32> = depth.as_array().iter().copied().collect();
        images.push((rgb, depth_m));
    }
    let mut heightmap = Heightmap::new(workspace.map_or(Workspace::RAVENS, |given| given.0));
    let fused = py.detach(|| {
        let views = cameras.iter().zip(&images);
        let views: Vec<View<'_>> = views
            .map(|(camera, (rgb, depth_m))| View {
                camera: &camera.0,
                rgb,
                depth_m,
            })
            .collect();
        Fusion::default().fuse(&views, &mut heightmap)
    });
    fused.map_err(value_error)?;
    let Workspace { rows, cols, .. } = heightmap.workspace;
    let color = arrays::array(py, &[rows, cols, 3], heightmap.rgb)?.into_any();
    let height = arrays::array(py, &[rows, cols], heightmap.height_m)?.into_any();
    Ok((color, height))
}
