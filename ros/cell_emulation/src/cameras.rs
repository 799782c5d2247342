//! What the three cameras see, and where everything is, as messages.

use std::time::Duration;

use heightmap::Camera;
use msgs::convert::{self, ConvertError};
use msgs::geometry_msgs::TransformStamped;
use msgs::sensor_msgs::{CameraInfo, Image};
use msgs::tf2_msgs::TFMessage;
use multiravens::render::RgbdImage;
use node_kit::{Graph, Node, NodeError, Publisher, Qos};
use ur5::{Joints, WorkCell};

/// One capture of one camera.
#[derive(Clone)]
pub struct Frame {
    color: Image,
    depth: Image,
    info: CameraInfo,
}

impl Frame {
    /// Messages of a rendered view.
    pub fn new(camera: &Camera, image: &RgbdImage, stamp: Duration) -> Result<Self, ConvertError> {
        let header = convert::header(stamp, &optical_frame(&camera.name))?;
        Ok(Self {
            color: convert::color_to_msg(header.clone(), &camera.intrinsics, image.rgb.clone())?,
            depth: convert::depth_to_msg(header.clone(), &camera.intrinsics, &image.depth_m)?,
            info: convert::intrinsics_to_msg(header, &camera.intrinsics),
        })
    }
}

/// Where the frames of one camera go.
pub struct CameraTopics {
    color: Publisher<Image>,
    depth: Publisher<Image>,
    info: Publisher<CameraInfo>,
}

impl CameraTopics {
    /// Topics `NAME/color/...` and `NAME/depth/...`.
    pub fn new(node: &Node, name: &str) -> Result<Self, NodeError> {
        Ok(Self {
            color: node.publisher(&format!("{name}/color/image_raw"), Qos::Image)?,
            depth: node.publisher(&format!("{name}/depth/image_rect_raw"), Qos::Image)?,
            info: node.publisher(&format!("{name}/color/camera_info"), Qos::Event)?,
        })
    }

    /// Whether somebody subscribes to its images.
    pub fn is_watched(&self, graph: &Graph) -> bool {
        let topics = [self.color.topic(), self.depth.topic()];
        topics.iter().any(|topic| graph.subscriptions(topic) > 0)
    }

    /// Publishes one capture.
    pub fn publish(&self, frame: Frame) {
        self.info.publish(frame.info);
        self.color.publish(frame.color);
        self.depth.publish(frame.depth);
    }
}

/// What follows the camera's name in that of its optical frame.
const OPTICAL_FRAME: &str = "_camera_optical_frame";

/// Name of a camera's optical frame, as in the URDF.
fn optical_frame(camera: &str) -> String {
    format!("{camera}{OPTICAL_FRAME}")
}

/// Where the cameras are.
pub fn camera_transforms(
    cameras: &[Camera],
    world_frame: &str,
    stamp: Duration,
) -> Result<TFMessage, ConvertError> {
    let transforms = cameras.iter().map(|camera| {
        Ok::<_, ConvertError>(TransformStamped {
            header: convert::header(stamp, world_frame)?,
            child_frame_id: optical_frame(&camera.name),
            transform: convert::isometry_to_msg(&camera.world_from_camera),
        })
    });
    Ok(TFMessage {
        transforms: transforms.collect::<Result<_, _>>()?,
    })
}

/// Where the links of the cell are: those that stand still, without the cameras, or those that the arm's
/// joints move.
pub fn link_transforms(
    cell: &WorkCell,
    joints: &Joints,
    moving: bool,
    world_frame: &str,
    stamp: Duration,
) -> Result<TFMessage, ConvertError> {
    let root = cell.root();
    let wanted = cell
        .frames
        .iter()
        .filter(|frame| frame.joint.is_some() == moving && !frame.child.ends_with(OPTICAL_FRAME));
    let transforms = wanted.map(|frame| {
        let parent = if frame.parent == root {
            world_frame
        } else {
            &frame.parent
        };
        Ok::<_, ConvertError>(TransformStamped {
            header: convert::header(stamp, parent)?,
            child_frame_id: frame.child.clone(),
            transform: convert::isometry_to_msg(&frame.pose(joints)),
        })
    });
    Ok(TFMessage {
        transforms: transforms.collect::<Result<_, _>>()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use heightmap::Intrinsics;
    use nalgebra::Isometry3;

    #[test]
    fn a_frame_holds_what_was_rendered() {
        let camera = Camera {
            name: "front".into(),
            intrinsics: Intrinsics::RAVENS,
            world_from_camera: Isometry3::translation(1.0, 0.0, 0.75),
        };
        let mut image = RgbdImage::new(&camera.intrinsics);
        image.rgb[3..6].copy_from_slice(&[1, 2, 3]);
        image.depth_m[1] = 0.5;
        let frame = Frame::new(&camera, &image, Duration::new(3, 4)).unwrap();
        assert_eq!(frame.color.header.frame_id, "front_camera_optical_frame");
        assert_eq!(
            (
                frame.depth.header.stamp.sec,
                frame.depth.header.stamp.nanosec
            ),
            (3, 4)
        );
        assert_eq!(frame.color.header, frame.info.header);
        let (mut rgb, mut depth_m) = (Vec::new(), Vec::new());
        let intrinsics = convert::intrinsics_from_msg(&frame.info).unwrap();
        assert_eq!(intrinsics, camera.intrinsics);
        convert::color_from_msg(&frame.color, &intrinsics, &mut rgb).unwrap();
        convert::depth_from_msg(&frame.depth, &mut depth_m).unwrap();
        assert_eq!((rgb, depth_m), (image.rgb, image.depth_m));
        let tf = camera_transforms(std::slice::from_ref(&camera), "world", Duration::ZERO).unwrap();
        assert_eq!(tf.transforms[0].child_frame_id, frame.color.header.frame_id);
        let pose = convert::isometry_from_msg(&tf.transforms[0].transform).unwrap();
        assert_eq!(pose, camera.world_from_camera);
    }

    #[test]
    fn the_links_hang_on_the_world_frame_and_the_cameras_are_left_to_their_own_transforms() {
        let cell = WorkCell::builtin().unwrap();
        let now = Duration::from_secs(2);
        let said = |moving| link_transforms(&cell, &cell.arm.ready, moving, "cell", now).unwrap();
        let (fixed, moving) = (said(false).transforms, said(true).transforms);
        assert_eq!(moving.len(), 6);
        let base = fixed.iter().find(|one| one.child_frame_id == "base_link");
        assert_eq!(base.unwrap().header.frame_id, "cell");
        assert!(
            fixed.iter().all(
                |one| !one.child_frame_id.contains("optical") && one.header.frame_id != "world"
            )
        );
        assert!(moving.iter().all(|one| one.header.stamp.sec == 2));
        // Together with the cameras they are all frames of the cell.
        assert_eq!(fixed.len() + moving.len() + 3, cell.frames.len());
    }
}
