//! Images and transforms for the page. Images are only asked for while somebody looks at them: they are most of the
//! traffic of a cell.

use std::sync::Arc;
use std::time::Duration;

use console::Cameras;
use msgs::CameraTopicNames;
use msgs::convert::{self, ConvertError};
use msgs::sensor_msgs::{CameraInfo, Image};
use msgs::tf2_msgs::TFMessage;
use node_kit::{Node, Qos};

/// Time between checks whether a browser shows camera images.
const POLL: Duration = Duration::from_millis(250);

/// Keeps the transforms, for as long as the node is active.
pub async fn follow_transforms(node: Node, cameras: Arc<Cameras>) -> anyhow::Result<()> {
    let mut transforms = node.subscription::<TFMessage>("/tf_static", Qos::Latched)?;
    loop {
        let message = transforms.recv().await;
        let insert = |parent: &str, child: &str, pose| cameras.on_transform(parent, child, pose);
        for invalid in convert::transforms_from_msg(&message, insert) {
            transforms.reject(invalid);
        }
    }
}

/// Keeps the newest image of a camera while somebody looks, for as long as the node is active.
pub async fn follow(
    node: Node,
    cameras: Arc<Cameras>,
    name: String,
    topics: CameraTopicNames,
) -> anyhow::Result<()> {
    let mut poll = tokio::time::interval(POLL);
    loop {
        poll.tick().await;
        if !cameras.are_wanted() {
            continue;
        }
        let mut infos = node.subscription::<CameraInfo>(&topics.color_info, Qos::Image)?;
        let mut images = node.subscription::<Image>(&topics.color, Qos::Image)?;
        while cameras.are_wanted() {
            tokio::select! {
                message = infos.recv() => match convert::intrinsics_from_msg(&message) {
                    Ok(intrinsics) => cameras.on_intrinsics(&name, intrinsics),
                    Err(error) => infos.reject(error),
                },
                message = images.recv() => {
                    if let Err(reason) = show(&cameras, &name, message) {
                        images.reject(reason);
                    }
                }
                _ = poll.tick() => {}
            }
        }
    }
}

/// Shows an image that is not shown already.
fn show(cameras: &Cameras, name: &str, message: Image) -> Result<(), ConvertError> {
    let stamp = convert::time_from_msg(&message.header.stamp)?;
    if let Some(intrinsics) = cameras.wants(name, stamp) {
        let mut rgb = Vec::new();
        convert::color_from_msg(&message, &intrinsics, &mut rgb)?;
        cameras.on_image(name, stamp, message.header.frame_id, rgb);
    }
    Ok(())
}
