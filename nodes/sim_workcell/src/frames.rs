//! What the three cameras see, as messages.

use std::time::Duration;

use heightmap::Camera;
use msgs::convert::{self, ConvertError};
use msgs::geometry_msgs::TransformStamped;
use msgs::sensor_msgs::{CameraInfo, Image};
use msgs::tf2_msgs::TFMessage;
use multiravens::render::RgbdImage;
use node_kit::{Node, NodeError, Publisher, Qos};

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

    /// Publishes one capture.
    pub fn publish(&self, frame: Frame) {
        self.info.publish(frame.info);
        self.color.publish(frame.color);
        self.depth.publish(frame.depth);
    }
}

/// Name of a camera's optical frame, as in the URDF.
fn optical_frame(camera: &str) -> String {
    format!("{camera}_camera_optical_frame")
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
        convert::depth_from_msg(&frame.depth, &intrinsics, &mut depth_m).unwrap();
        assert_eq!((rgb, depth_m), (image.rgb, image.depth_m));
        let tf = camera_transforms(std::slice::from_ref(&camera), "world", Duration::ZERO).unwrap();
        assert_eq!(tf.transforms[0].child_frame_id, frame.color.header.frame_id);
        let pose = convert::isometry_from_msg(&tf.transforms[0].transform).unwrap();
        assert_eq!(pose, camera.world_from_camera);
    }
}
