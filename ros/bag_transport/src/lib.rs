//! Records topics of any type into rosbag2 bags, and plays bags onto topics.
//!
//! [`Recorder`] and [`Player`] work on a [`node_kit::Node`] that the caller makes; the bags are those of the crate `bags`.

mod error;
mod player;
mod recorder;

pub use error::TransportError;
pub use player::{Order, Played, Player, PlayerOptions};
pub use recorder::{
    End, Progress, RECORDED_SUFFIX, Recorder, RecorderOptions, Recording, Selection, TopicCount,
};

/// Types whose messages are large: RustDDS keeps as many messages as the depth of the QoS says, also those that were taken.
const LARGE_TYPES: [&str; 3] = [
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/CompressedImage",
];
