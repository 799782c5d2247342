//! rosbag2 MCAP bags: writing, reading, demonstrations.
//!
//! A bag is a folder with `metadata.yaml` and `NAME_0.mcap`, as `ros2 bag` writes it. While it is written it is
//! called `NAME.partial`, so that a folder with the bag's own name is always whole.

mod demonstration;
mod error;
mod metadata;
mod qos;
mod reader;
mod writer;

pub use demonstration::{Demonstration, DemonstrationError, DemonstrationStep};
pub use error::BagError;
pub use qos::Qos;
pub use reader::{BagReader, Messages, RawMessage, Topic};
pub use writer::{BagWriter, Compression, TopicHandle, partial_path};
