//! Calibration files: where the cameras stand, by name.

use std::collections::BTreeMap;
use std::path::Path;
use std::{fs, io};

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::Deserialize;

/// A calibration file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationFileError {
    /// It cannot be read.
    #[error("calibration {path}: {source}")]
    File {
        /// The file.
        path: String,
        /// The reason.
        source: io::Error,
    },
    /// It holds something else.
    #[error("calibration {path}: {reason}")]
    Content {
        /// The file.
        path: String,
        /// Where and why.
        reason: String,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CalibrationFile {
    cameras: BTreeMap<String, PoseEntry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseEntry {
    translation_m: [f64; 3],
    rotation_xyzw: [f64; 4],
}

/// Poses of optical frames in the world by camera name, from YAML:
/// `cameras: {front: {translation_m: [x, y, z], rotation_xyzw: [x, y, z, w]}}`.
///
/// # Errors
/// The file cannot be read, or does not have this form.
pub fn read_calibration(
    path: &Path,
) -> Result<BTreeMap<String, Isometry3<f64>>, CalibrationFileError> {
    let shown = path.display().to_string();
    let text = fs::read_to_string(path).map_err(|source| CalibrationFileError::File {
        path: shown.clone(),
        source,
    })?;
    let content = |reason: String| CalibrationFileError::Content {
        path: shown.clone(),
        reason,
    };
    let file: CalibrationFile =
        serde_yaml_ng::from_str(&text).map_err(|error| content(error.to_string()))?;
    file.cameras
        .into_iter()
        .map(|(camera, entry)| {
            let [x, y, z, w] = entry.rotation_xyzw;
            let quaternion = Quaternion::new(w, x, y, z);
            let finite = entry.translation_m.iter().all(|part| part.is_finite());
            let unit = (quaternion.norm() - 1.0).abs() < 1e-3;
            if !(finite && unit) {
                return Err(content(format!(
                    "camera {camera}: expected a finite translation_m and a rotation_xyzw of length 1"
                )));
            }
            let pose = Isometry3::from_parts(
                Translation3::from(entry.translation_m),
                UnitQuaternion::new_normalize(quaternion),
            );
            Ok((camera, pose))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::vector;

    #[test]
    fn the_example_is_the_calibration_of_the_simulated_cell() {
        let example = concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/calibration.yaml");
        let poses = read_calibration(Path::new(example)).unwrap();
        for camera in heightmap::Camera::ravens() {
            let apart = camera.world_from_camera.inv_mul(&poses[&camera.name]);
            assert!(apart.translation.vector.norm() < 1e-9 && apart.rotation.angle() < 1e-9);
        }
    }

    #[test]
    fn calibration_files_are_read_and_bad_ones_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("cell.yaml");
        fs::write(
            &path,
            "cameras:\n  front: {translation_m: [1, 0, 2], rotation_xyzw: [1, 0, 0, 0]}\n",
        )
        .unwrap();
        let poses = read_calibration(&path).unwrap();
        assert_eq!(poses["front"].translation.vector, vector![1.0, 0.0, 2.0]);
        fs::write(
            &path,
            "cameras:\n  front: {translation_m: [1, 0, 2], rotation_xyzw: [1, 1, 0, 0]}\n",
        )
        .unwrap();
        let error = read_calibration(&path).unwrap_err().to_string();
        assert!(
            error.contains("cell.yaml") && error.contains("front"),
            "{error}"
        );
    }
}
