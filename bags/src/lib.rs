//! rosbag2 MCAP bags: writing, reading, demonstrations.
//!
//! A bag is a folder with `metadata.yaml` and `NAME_0.mcap`, as `ros2 bag` writes it. While it is written it is
//! called `NAME.partial`, so that a folder with the bag's own name is always whole.

mod definition;
mod demonstration;
mod error;
mod info;
mod metadata;
mod packing;
mod qos;
mod reader;
mod run;
mod scan;
mod sqlite;
mod verify;
mod writer;

pub use definition::{installed_definition, standard_definition};
pub use demonstration::{Demonstration, DemonstrationError, DemonstrationStep};
pub use error::BagError;
pub use info::{BagInfo, FileInfo, RunInfo, TopicInfo, outcome_name};
pub use qos::Qos;
pub use reader::{BagReader, FileSummary, Messages, RawMessage, Topic};
pub use run::LeftOut;
pub use verify::{
    Finding, Findings, Recovery, Verification, VerifiedFile, VerifiedTopic, recover, verify,
};
pub use writer::{BagWriter, Compression, Stamps, TopicHandle, WriteOptions, partial_path};
