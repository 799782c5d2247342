//! The factory calibration of an arm, as the UR driver extracts it.

use crate::work_cell::WorkCellError;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use serde::Deserialize;
use std::path::Path;

/// Where the joints of one very arm sit: the block `kinematics` of a file that `ur_calibration` writes
/// (`ros2 launch ur_calibration calibration_correction.launch.py`), known as `calibration.yaml`.
#[derive(Clone, Debug, PartialEq)]
pub struct ArmCalibration {
    /// Pose of each joint's frame in the frame before it, at joint position zero, shoulder pan first.
    pub origins: [Isometry3<f64>; 6],
    /// What the file calls the calibration (`calib_...`), if it does.
    pub hash: Option<String>,
    /// The file, for errors.
    pub(crate) path: String,
}

#[derive(Deserialize)]
struct File {
    kinematics: Kinematics,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Kinematics {
    shoulder: Origin,
    upper_arm: Origin,
    forearm: Origin,
    wrist_1: Origin,
    wrist_2: Origin,
    wrist_3: Origin,
    hash: Option<String>,
}

/// Metres and radians, as in a URDF.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Origin {
    x: f64,
    y: f64,
    z: f64,
    roll: f64,
    pitch: f64,
    yaw: f64,
}

impl ArmCalibration {
    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, or as [`Self::parse`].
    pub fn load(path: &Path) -> Result<Self, WorkCellError> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|error| WorkCellError::Unreadable {
            path: name.clone(),
            reason: error.to_string(),
        })?;
        Self::parse(&text, &name)
    }

    /// Reads the text of a file. `path` names it in errors.
    ///
    /// # Errors
    /// When it has no block `kinematics` with the six links, or a number in it is not finite.
    pub fn parse(text: &str, path: &str) -> Result<Self, WorkCellError> {
        let unreadable = |reason| WorkCellError::Unreadable {
            path: path.into(),
            reason,
        };
        let file: File = serde_yaml_ng::from_str(text).map_err(|error| {
            unreadable(format!(
                "{error}, expected the block `kinematics` that the UR driver's ur_calibration writes"
            ))
        })?;
        let Kinematics {
            shoulder,
            upper_arm,
            forearm,
            wrist_1,
            wrist_2,
            wrist_3,
            hash,
        } = file.kinematics;
        let links = [
            ("shoulder", shoulder),
            ("upper_arm", upper_arm),
            ("forearm", forearm),
            ("wrist_1", wrist_1),
            ("wrist_2", wrist_2),
            ("wrist_3", wrist_3),
        ];
        let mut origins = [Isometry3::identity(); 6];
        for (origin, (name, link)) in origins.iter_mut().zip(links) {
            let numbers = [link.x, link.y, link.z, link.roll, link.pitch, link.yaw];
            if !numbers.iter().all(|number| number.is_finite()) {
                return Err(unreadable(format!(
                    "kinematics.{name} has a number that is not finite"
                )));
            }
            *origin = Isometry3::from_parts(
                Translation3::new(link.x, link.y, link.z),
                UnitQuaternion::from_euler_angles(link.roll, link.pitch, link.yaw),
            );
        }
        Ok(Self {
            origins,
            hash,
            path: path.into(),
        })
    }
}
