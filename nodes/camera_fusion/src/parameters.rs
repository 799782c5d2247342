//! Parameters of the node.

use std::path::PathBuf;
use std::time::Duration;

use frame_synchronizer::Settings;
use heightmap::{StillSettings, Workspace};
use msgs::CameraPreset;
use nalgebra::Point2;
use node_kit::{InvalidParameter, Parameters, Range};
use serde::{Deserialize, Serialize};

/// A heightmap of more cells than this does not fit the time that a fusion may take.
const MAX_CELLS: usize = 1 << 22;

/// Explained in config/camera_fusion.yaml.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[allow(missing_docs)]
pub struct CameraFusionParameters {
    pub cameras: Vec<String>,
    pub camera_preset: CameraPreset,
    pub world_frame: String,
    pub calibration: PathBuf,
    pub tolerance_s: f64,
    pub camera_timeout_s: f64,
    pub fuse_without_silent: bool,
    pub frames: usize,
    pub percentile: f64,
    pub edge_step_m: f64,
    pub clock_skew_limit_s: f64,
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
            camera_preset: CameraPreset::Simulated,
            world_frame: "world".into(),
            calibration: PathBuf::new(),
            tolerance_s: 0.02,
            camera_timeout_s: 2.0,
            fuse_without_silent: false,
            frames: 1,
            percentile: 0.75,
            edge_step_m: 0.02,
            clock_skew_limit_s: 1.0,
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
    /// As the fusion takes it.
    pub fn workspace(&self) -> Workspace {
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

impl CameraFusionParameters {
    /// How far apart images of one set may be.
    pub fn tolerance(&self) -> Duration {
        Duration::from_secs_f64(self.tolerance_s)
    }

    /// How the median is taken; nothing where each set of images is a heightmap.
    pub fn still(&self) -> Option<StillSettings> {
        (self.frames > 1).then_some(StillSettings {
            frames: self.frames,
            percentile: self.percentile,
            edge_step_m: self.edge_step_m as f32,
        })
    }

    /// As the synchronizer takes them.
    pub(crate) fn settings(&self) -> Settings {
        Settings {
            cameras: self.cameras.clone(),
            world_frame: self.world_frame.clone(),
            tolerance: self.tolerance(),
            workspace: self.workspace.workspace(),
            still: self.still(),
            fuse_without_silent: self.fuse_without_silent,
        }
    }
}

impl Parameters for CameraFusionParameters {
    const DOCUMENTATION: &'static str = include_str!("../../../config/camera_fusion.yaml");
    const RANGES: &'static [(&'static str, Range)] = &[
        ("tolerance_s", Range::NOT_NEGATIVE),
        ("camera_timeout_s", Range::DURATION_S),
        ("frames", Range::Integer(1, 31)),
        ("percentile", Range::SHARE),
        ("edge_step_m", Range::POSITIVE),
        ("clock_skew_limit_s", Range::POSITIVE),
        ("workspace.pixel_size_m", Range::POSITIVE),
        ("workspace.origin_x_m", Range::FINITE),
        ("workspace.origin_y_m", Range::FINITE),
        ("workspace.z_min_m", Range::FINITE),
        ("workspace.z_max_m", Range::FINITE),
        ("workspace.rows", Range::Integer(1, MAX_CELLS as i64)),
        ("workspace.cols", Range::Integer(1, MAX_CELLS as i64)),
    ];
    const CHANGEABLE: &'static [&'static str] = &["tolerance_s", "camera_timeout_s"];

    fn validate(&self) -> Result<(), InvalidParameter> {
        if self.cameras.is_empty() {
            return Err(InvalidParameter::new("cameras", "must name at least one"));
        }
        for (index, camera) in self.cameras.iter().enumerate() {
            if camera.is_empty() {
                return Err(InvalidParameter::new("cameras", "a name must not be empty"));
            }
            if self.cameras[..index].contains(camera) {
                return Err(InvalidParameter::new(
                    "cameras",
                    format!("{camera} stands there twice"),
                ));
            }
        }
        InvalidParameter::unless_given("world_frame", &self.world_frame)?;
        let WorkspaceParameters {
            rows,
            cols,
            z_min_m,
            z_max_m,
            ..
        } = self.workspace;
        if z_max_m <= z_min_m {
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
    fn the_configuration_file_explains_every_parameter_and_shows_its_default() {
        let mistakes =
            node_kit::mistakes_in_documentation::<CameraFusionParameters>("camera_fusion");
        assert_eq!(mistakes, [""; 0]);
    }

    #[test]
    fn a_preset_is_read_by_its_name_and_an_unknown_one_is_refused() {
        let read = |preset: &str| {
            let text = format!("/**: {{ros__parameters: {{camera_preset: {preset}}}}}");
            node_kit::load_text::<CameraFusionParameters>("cell.yaml", &text, "/camera_fusion")
        };
        for name in CameraPreset::names() {
            assert_eq!(read(name).unwrap().camera_preset.to_string(), name);
        }
        let error = read("kinect").unwrap_err().to_string();
        assert!(
            error.contains("camera_preset") && error.contains("realsense_aligned"),
            "{error}"
        );
    }

    #[test]
    fn impossible_values_are_refused_by_name() {
        let refusal = |spoil: fn(&mut CameraFusionParameters)| {
            let mut parameters = CameraFusionParameters::default();
            spoil(&mut parameters);
            parameters.check().unwrap_err().name
        };
        assert_eq!(refusal(|p| p.cameras.clear()), "cameras");
        assert_eq!(refusal(|p| p.cameras[1] = "front".into()), "cameras");
        assert_eq!(refusal(|p| p.cameras[1].clear()), "cameras");
        assert_eq!(refusal(|p| p.tolerance_s = f64::NAN), "tolerance_s");
        assert_eq!(refusal(|p| p.camera_timeout_s = 0.0), "camera_timeout_s");
        assert_eq!(refusal(|p| p.frames = 0), "frames");
        assert_eq!(refusal(|p| p.percentile = 1.5), "percentile");
        assert_eq!(refusal(|p| p.workspace.rows = 0), "workspace.rows");
        assert_eq!(refusal(|p| p.workspace.z_max_m = -1.0), "workspace.z_max_m");
    }
}
