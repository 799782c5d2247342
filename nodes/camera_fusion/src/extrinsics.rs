//! Where the cameras stand: from `/tf_static`, or from a calibration file.

use std::{collections::BTreeMap, fs, io, path::Path};

use msgs::{
    convert::{self, ConvertError},
    tf2_msgs::TFMessage,
};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::Deserialize;

/// No camera hangs on a longer chain of frames than this.
const MAX_CHAIN: usize = 32;
/// More frames than this are no work cell.
const MAX_FRAMES: usize = 10_000;

/// Frames and their parents, as `/tf_static` says.
#[derive(Clone, Debug, Default)]
pub struct Transforms {
    /// By child frame: its parent, and its pose in the parent.
    parents: BTreeMap<String, (String, Isometry3<f64>)>,
}

/// A transform that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TransformError {
    /// A pose that is not valid.
    #[error("transform of {child:?}: {source}")]
    Convert {
        /// The child frame.
        child: String,
        /// Which field.
        source: ConvertError,
    },
    /// A frame without a name.
    #[error("child_frame_id is empty, expected the name of a frame")]
    NoName,
    /// More frames than a cell has.
    #[error("more than {MAX_FRAMES} frames")]
    TooMany,
}

/// No chain of frames leads from a camera to the world.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("frame {frame:?} is not connected to {world:?}: no transform for {missing:?}")]
pub struct Unconnected {
    frame: String,
    world: String,
    missing: String,
}

/// tf names had a leading slash once.
pub(crate) fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

impl Transforms {
    /// Takes over what the message says; refused transforms change nothing.
    pub fn update(&mut self, message: TFMessage) -> Vec<TransformError> {
        let mut errors = Vec::new();
        for stamped in message.transforms {
            let child = plain(&stamped.child_frame_id).to_owned();
            if child.is_empty() {
                errors.push(TransformError::NoName);
            } else if !self.parents.contains_key(&child) && self.parents.len() >= MAX_FRAMES {
                errors.push(TransformError::TooMany);
            } else {
                match convert::isometry_from_msg(&stamped.transform) {
                    Ok(pose) => {
                        let parent = plain(&stamped.header.frame_id).to_owned();
                        self.parents.insert(child, (parent, pose));
                    }
                    Err(source) => errors.push(TransformError::Convert { child, source }),
                }
            }
        }
        errors
    }

    /// Pose of a frame in another one that hangs on the same root.
    pub fn between(&self, to: &str, from: &str) -> Option<Isometry3<f64>> {
        let (to_root, root_from_to) = self.up(to);
        let (from_root, root_from_from) = self.up(from);
        (to_root == from_root).then(|| root_from_to.inv_mul(&root_from_from))
    }

    /// The frame that no transform leads up from, at the end of a frame's chain, and the frame's pose in it.
    fn up<'a>(&'a self, frame: &'a str) -> (&'a str, Isometry3<f64>) {
        let (mut at, mut pose) = (plain(frame), Isometry3::identity());
        for _ in 0..MAX_CHAIN {
            let Some((parent, parent_from_at)) = self.parents.get(at) else {
                break;
            };
            pose = parent_from_at * pose;
            at = parent;
        }
        (at, pose)
    }

    /// Pose of a frame in the world.
    pub fn world_from(&self, frame: &str, world: &str) -> Result<Isometry3<f64>, Unconnected> {
        let (mut at, world) = (plain(frame), plain(world));
        let mut pose = Isometry3::identity();
        for _ in 0..MAX_CHAIN {
            if at == world {
                return Ok(pose);
            }
            let Some((parent, parent_from_at)) = self.parents.get(at) else {
                break;
            };
            pose = parent_from_at * pose;
            at = parent;
        }
        Err(Unconnected {
            frame: frame.to_owned(),
            world: world.to_owned(),
            missing: at.to_owned(),
        })
    }
}

/// A calibration file that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// It cannot be read.
    #[error("calibration {path}: {source}")]
    File {
        /// The file.
        path: String,
        /// Why.
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
pub fn read_calibration(path: &Path) -> Result<BTreeMap<String, Isometry3<f64>>, CalibrationError> {
    let shown = path.display().to_string();
    let text = fs::read_to_string(path).map_err(|source| CalibrationError::File {
        path: shown.clone(),
        source,
    })?;
    let content = |reason: String| CalibrationError::Content {
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
    use msgs::{
        geometry_msgs::{Transform, TransformStamped},
        std_msgs::Header,
    };
    use nalgebra::{Vector3, vector};

    fn stamped(parent: &str, child: &str, pose: &Isometry3<f64>) -> TransformStamped {
        TransformStamped {
            header: Header {
                frame_id: parent.into(),
                ..Header::default()
            },
            child_frame_id: child.into(),
            transform: convert::isometry_to_msg(pose),
        }
    }

    #[test]
    fn poses_are_chained_up_to_the_world() {
        let mast = Isometry3::new(vector![1.0, 0.0, 0.5], Vector3::z() * 0.3);
        let camera = Isometry3::new(vector![0.0, 0.2, 0.1], Vector3::x() * 2.0);
        let mut transforms = Transforms::default();
        let errors = transforms.update(TFMessage {
            transforms: vec![
                stamped("mast", "/optical", &camera),
                stamped("/world", "mast", &mast),
            ],
        });
        assert!(errors.is_empty());
        let pose = transforms.world_from("optical", "world").unwrap();
        assert!((pose.inv_mul(&(mast * camera))).translation.vector.norm() < 1e-12);
    }

    #[test]
    fn frames_on_one_root_have_a_pose_in_each_other() {
        let depth = Isometry3::new(vector![0.0, -0.015, 0.0], Vector3::z() * 0.01);
        let color = Isometry3::new(vector![0.0, 0.015, 0.0], Vector3::x() * -0.02);
        let mut transforms = Transforms::default();
        transforms.update(TFMessage {
            transforms: vec![
                stamped("camera_link", "depth_optical", &depth),
                stamped("camera_link", "color_optical", &color),
                stamped("elsewhere", "other", &depth),
            ],
        });
        let pose = transforms
            .between("color_optical", "/depth_optical")
            .unwrap();
        assert!(
            (pose.translation.vector - color.inv_mul(&depth).translation.vector).norm() < 1e-12
        );
        assert_eq!(transforms.between("color_optical", "other"), None);
        assert_eq!(transforms.between("color_optical", "nowhere"), None);
    }

    #[test]
    fn missing_links_and_circles_are_named() {
        let mut transforms = Transforms::default();
        let here = Isometry3::identity();
        transforms.update(TFMessage {
            transforms: vec![
                stamped("mast", "optical", &here),
                stamped("b", "a", &here),
                stamped("a", "b", &here),
            ],
        });
        let error = transforms.world_from("optical", "world").unwrap_err();
        assert_eq!(
            error.to_string(),
            "frame \"optical\" is not connected to \"world\": no transform for \"mast\""
        );
        assert!(transforms.world_from("a", "world").is_err());
    }

    #[test]
    fn a_transform_that_is_none_is_refused_and_the_others_count() {
        let mut transforms = Transforms::default();
        let nothing = TransformStamped {
            child_frame_id: "left".into(),
            transform: Transform {
                rotation: msgs::geometry_msgs::Quaternion {
                    x: f64::NAN,
                    ..Default::default()
                },
                ..Default::default()
            },
            ..Default::default()
        };
        let good = stamped("world", "right", &Isometry3::identity());
        let errors = transforms.update(TFMessage {
            transforms: vec![nothing, good],
        });
        assert_eq!(errors.len(), 1);
        assert!(errors[0].to_string().contains("left"), "{}", errors[0]);
        assert!(transforms.world_from("right", "world").is_ok());
    }

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
