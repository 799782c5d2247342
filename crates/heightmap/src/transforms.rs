//! Frames and where they stand in each other, as `/tf_static` tells them (REP-105).

use std::collections::BTreeMap;

use nalgebra::Isometry3;

/// No camera hangs on a longer chain of frames than this.
const MAX_CHAIN: usize = 32;
/// More frames than this are no work cell.
const MAX_FRAMES: usize = 10_000;

/// Frames, each with its parent and its pose in it. A leading slash of a name, which tf names had once, does not count.
///
/// ```
/// use heightmap::Transforms;
/// use nalgebra::Isometry3;
///
/// let mut transforms = Transforms::default();
/// transforms.insert("world", "mast", Isometry3::translation(1.0, 0.0, 0.0))?;
/// transforms.insert("mast", "camera", Isometry3::translation(0.0, 0.0, 2.0))?;
/// let pose = transforms.world_from("camera", "world")?;
/// assert_eq!((pose.translation.x, pose.translation.z), (1.0, 2.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Transforms {
    /// By child frame: its parent, and its pose in the parent.
    parents: BTreeMap<String, (String, Isometry3<f64>)>,
}

/// A transform that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TransformError {
    /// A frame without a name.
    #[error("child_frame_id is empty, expected the name of a frame")]
    NoName,
    /// More frames than a cell has.
    #[error("more than {MAX_FRAMES} frames")]
    TooMany,
}

/// No chain of frames leads from a camera to the world.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("frame {frame:?} is not connected to {world:?}: no transform for {missing:?}")]
pub struct Unconnected {
    frame: String,
    world: String,
    missing: String,
}

fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

impl Transforms {
    /// Takes over the pose of a frame in its parent.
    ///
    /// # Errors
    /// When the frame has no name, or there are too many. Nothing changes then.
    pub fn insert(
        &mut self,
        parent: &str,
        child: &str,
        pose: Isometry3<f64>,
    ) -> Result<(), TransformError> {
        let child = plain(child);
        if child.is_empty() {
            return Err(TransformError::NoName);
        }
        if !self.parents.contains_key(child) && self.parents.len() >= MAX_FRAMES {
            return Err(TransformError::TooMany);
        }
        let parent = plain(parent).to_owned();
        self.parents.insert(child.to_owned(), (parent, pose));
        Ok(())
    }

    /// Whether two names are those of one frame.
    pub fn is_same(frame: &str, other: &str) -> bool {
        plain(frame) == plain(other)
    }

    /// Pose of a frame in another one that hangs on the same root.
    pub fn between(&self, to: &str, from: &str) -> Option<Isometry3<f64>> {
        let (to_root, root_from_to) = self.up(to, None);
        let (from_root, root_from_from) = self.up(from, None);
        (to_root == from_root).then(|| root_from_to.inv_mul(&root_from_from))
    }

    /// Pose of a frame in the world.
    ///
    /// # Errors
    /// When no chain of frames leads there; names the frame whose parent is missing.
    pub fn world_from(&self, frame: &str, world: &str) -> Result<Isometry3<f64>, Unconnected> {
        let world = plain(world);
        match self.up(frame, Some(world)) {
            (at, pose) if at == world => Ok(pose),
            (missing, _) => Err(Unconnected {
                frame: frame.to_owned(),
                world: world.to_owned(),
                missing: missing.to_owned(),
            }),
        }
    }

    /// The frame at the end of a frame's chain, or `top` where the chain passes it, and the frame's pose in that.
    fn up<'a>(&'a self, frame: &'a str, top: Option<&str>) -> (&'a str, Isometry3<f64>) {
        let (mut at, mut pose) = (plain(frame), Isometry3::identity());
        for _ in 0..MAX_CHAIN {
            if Some(at) == top {
                break;
            }
            let Some((parent, parent_from_at)) = self.parents.get(at) else {
                break;
            };
            pose = parent_from_at * pose;
            at = parent;
        }
        (at, pose)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Vector3, vector};

    fn transforms(links: &[(&str, &str, Isometry3<f64>)]) -> Transforms {
        let mut transforms = Transforms::default();
        for (parent, child, pose) in links {
            transforms.insert(parent, child, *pose).unwrap();
        }
        transforms
    }

    #[test]
    fn poses_are_chained_up_to_the_world() {
        let mast = Isometry3::new(vector![1.0, 0.0, 0.5], Vector3::z() * 0.3);
        let camera = Isometry3::new(vector![0.0, 0.2, 0.1], Vector3::x() * 2.0);
        let transforms = transforms(&[("mast", "/optical", camera), ("/world", "mast", mast)]);
        let pose = transforms.world_from("optical", "world").unwrap();
        assert!((pose.inv_mul(&(mast * camera))).translation.vector.norm() < 1e-12);
        assert!(transforms.world_from("mast", "/world").is_ok());
    }

    #[test]
    fn frames_on_one_root_have_a_pose_in_each_other() {
        let depth = Isometry3::new(vector![0.0, -0.015, 0.0], Vector3::z() * 0.01);
        let color = Isometry3::new(vector![0.0, 0.015, 0.0], Vector3::x() * -0.02);
        let transforms = transforms(&[
            ("camera_link", "depth_optical", depth),
            ("camera_link", "color_optical", color),
            ("elsewhere", "other", depth),
        ]);
        let pose = transforms
            .between("color_optical", "/depth_optical")
            .unwrap();
        let expected = color.inv_mul(&depth).translation.vector;
        assert!((pose.translation.vector - expected).norm() < 1e-12);
        assert_eq!(transforms.between("color_optical", "other"), None);
        assert_eq!(transforms.between("color_optical", "nowhere"), None);
    }

    #[test]
    fn missing_links_and_circles_are_named() {
        let here = Isometry3::identity();
        let transforms = transforms(&[
            ("mast", "optical", here),
            ("b", "a", here),
            ("a", "b", here),
        ]);
        let error = transforms.world_from("optical", "world").unwrap_err();
        assert_eq!(
            error.to_string(),
            "frame \"optical\" is not connected to \"world\": no transform for \"mast\""
        );
        assert!(transforms.world_from("a", "world").is_err());
    }

    #[test]
    fn a_frame_without_a_name_is_refused() {
        let mut transforms = Transforms::default();
        let here = Isometry3::identity();
        assert_eq!(
            transforms.insert("world", "/", here),
            Err(TransformError::NoName)
        );
    }
}
