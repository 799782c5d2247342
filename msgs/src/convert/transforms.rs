//! Frames of `/tf_static`.

use ::heightmap::TransformError;
use nalgebra::Isometry3;

use super::{ConvertError, isometry_from_msg};
use crate::tf2_msgs::TFMessage;

/// A transform that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("transform of {child:?}: {source}")]
pub struct InvalidTransform {
    child: String,
    source: InvalidPart,
}

#[derive(Clone, Debug, PartialEq, thiserror::Error)]
enum InvalidPart {
    #[error(transparent)]
    Pose(#[from] ConvertError),
    #[error(transparent)]
    Frame(#[from] TransformError),
}

/// Gives each transform of a message to `insert`: parent, child, and pose of the child in the parent. Those that cannot be used
/// are left out, and returned.
pub fn transforms_from_msg(
    message: &TFMessage,
    mut insert: impl FnMut(&str, &str, Isometry3<f64>) -> Result<(), TransformError>,
) -> Vec<InvalidTransform> {
    let mut invalid = Vec::new();
    for transform in &message.transforms {
        let (parent, child) = (&transform.header.frame_id, &transform.child_frame_id);
        let pose = isometry_from_msg(&transform.transform).map_err(InvalidPart::from);
        let inserted = pose.and_then(|pose| Ok(insert(parent, child, pose)?));
        if let Err(source) = inserted {
            invalid.push(InvalidTransform {
                child: child.clone(),
                source,
            });
        }
    }
    invalid
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry_msgs::TransformStamped;
    use ::heightmap::Transforms;

    #[test]
    fn a_transform_that_is_none_is_refused_and_the_others_count() {
        let stamped = |child: &str, x| {
            let mut stamped = TransformStamped {
                child_frame_id: child.into(),
                ..TransformStamped::default()
            };
            stamped.header.frame_id = "world".into();
            stamped.transform.rotation.w = 1.0;
            stamped.transform.rotation.x = x;
            stamped
        };
        let transforms = vec![
            stamped("left", f64::NAN),
            stamped("", 0.0),
            stamped("right", 0.0),
        ];
        let mut known = Transforms::default();
        let invalid = transforms_from_msg(&TFMessage { transforms }, |parent, child, pose| {
            known.insert(parent, child, pose)
        });
        let reasons: Vec<_> = invalid.iter().map(ToString::to_string).collect();
        assert_eq!(reasons.len(), 2);
        assert!(
            reasons[0].starts_with("transform of \"left\": "),
            "{reasons:?}"
        );
        assert!(
            reasons[1].contains("child_frame_id is empty"),
            "{reasons:?}"
        );
        assert!(known.world_from("right", "world").is_ok());
    }
}
