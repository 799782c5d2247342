//! Parameters of the node.

use std::path::PathBuf;

use heightmap::Workspace;
use nalgebra::Point2;
use node_kit::{InvalidParameter, Parameters};
use serde::{Deserialize, Serialize};

/// A heightmap of more cells than this does not fit the time that a fusion may take.
const MAX_CELLS: usize = 1 << 22;

/// Explained in config/camera_fusion.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct CameraFusionParameters {
    pub cameras: Vec<String>,
    pub world_frame: String,
    pub calibration: PathBuf,
    pub tolerance_s: f64,
    pub camera_timeout_s: f64,
    pub workspace: WorkspaceParameters,
}

/// The volume that heightmaps cover.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct WorkspaceParameters {
    pub origin_x_m: f64,
    pub origin_y_m: f64,
    pub rows: usize,
    pub cols: usize,
    pub pixel_size_m: f64,
    pub z_min_m: f64,
    pub z_max_m: f64,
}

impl Default for CameraFusionParameters {
    fn default() -> Self {
        Self {
            cameras: ["front", "left", "right"].map(str::to_owned).to_vec(),
            world_frame: "world".into(),
            calibration: PathBuf::new(),
            tolerance_s: 0.02,
            camera_timeout_s: 2.0,
            workspace: WorkspaceParameters::default(),
        }
    }
}

impl Default for WorkspaceParameters {
    fn default() -> Self {
        let ravens = Workspace::RAVENS;
        Self {
            origin_x_m: ravens.origin_m.x,
            origin_y_m: ravens.origin_m.y,
            rows: ravens.rows,
            cols: ravens.cols,
            pixel_size_m: ravens.pixel_size_m,
            z_min_m: ravens.z_min_m,
            z_max_m: ravens.z_max_m,
        }
    }
}

impl WorkspaceParameters {
    pub(crate) fn workspace(&self) -> Workspace {
        Workspace {
            origin_m: Point2::new(self.origin_x_m, self.origin_y_m),
            rows: self.rows,
            cols: self.cols,
            pixel_size_m: self.pixel_size_m,
            z_min_m: self.z_min_m,
            z_max_m: self.z_max_m,
        }
    }
}

impl Parameters for CameraFusionParameters {
    fn validate(&self) -> Result<(), InvalidParameter> {
        if self.cameras.is_empty() {
            return Err(InvalidParameter::new("cameras", "must name at least one"));
        }
        for (index, camera) in self.cameras.iter().enumerate() {
            if self.cameras[..index].contains(camera) {
                return Err(InvalidParameter::new(
                    "cameras",
                    format!("{camera} stands there twice"),
                ));
            }
        }
        if self.world_frame.is_empty() {
            return Err(InvalidParameter::new("world_frame", "must not be empty"));
        }
        if !(self.tolerance_s.is_finite() && self.tolerance_s >= 0.0) {
            return Err(InvalidParameter::new(
                "tolerance_s",
                format!("must be 0 or more, is {}", self.tolerance_s),
            ));
        }
        InvalidParameter::unless_positive("camera_timeout_s", self.camera_timeout_s)?;
        let WorkspaceParameters {
            origin_x_m,
            origin_y_m,
            rows,
            cols,
            pixel_size_m,
            z_min_m,
            z_max_m,
        } = self.workspace;
        InvalidParameter::unless_positive("workspace.pixel_size_m", pixel_size_m)?;
        for (name, value) in [
            ("workspace.origin_x_m", origin_x_m),
            ("workspace.origin_y_m", origin_y_m),
            ("workspace.z_min_m", z_min_m),
        ] {
            if !value.is_finite() {
                return Err(InvalidParameter::new(
                    name,
                    format!("must be finite, is {value}"),
                ));
            }
        }
        if !(z_max_m.is_finite() && z_max_m > z_min_m) {
            return Err(InvalidParameter::new(
                "workspace.z_max_m",
                format!("must be above z_min_m = {z_min_m}, is {z_max_m}"),
            ));
        }
        let cells = rows.saturating_mul(cols);
        if cells == 0 || cells > MAX_CELLS {
            return Err(InvalidParameter::new(
                "workspace.rows",
                format!("rows * cols must be 1 to {MAX_CELLS}, is {cells}"),
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_file_holds_the_defaults() {
        let text = include_str!("../../../config/camera_fusion.yaml");
        let read: CameraFusionParameters =
            node_kit::load_text("camera_fusion.yaml", text, "/cell/camera_fusion").unwrap();
        assert_eq!(read, CameraFusionParameters::default());
    }

    #[test]
    fn impossible_values_are_refused_by_name() {
        let refusal = |spoil: fn(&mut CameraFusionParameters)| {
            let mut parameters = CameraFusionParameters::default();
            spoil(&mut parameters);
            parameters.validate().unwrap_err().name
        };
        assert_eq!(refusal(|p| p.cameras.clear()), "cameras");
        assert_eq!(refusal(|p| p.cameras[1] = "front".into()), "cameras");
        assert_eq!(refusal(|p| p.tolerance_s = f64::NAN), "tolerance_s");
        assert_eq!(refusal(|p| p.camera_timeout_s = 0.0), "camera_timeout_s");
        assert_eq!(refusal(|p| p.workspace.rows = 0), "workspace.rows");
        assert_eq!(refusal(|p| p.workspace.z_max_m = -1.0), "workspace.z_max_m");
    }
}
