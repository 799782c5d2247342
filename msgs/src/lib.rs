//! Rust types made at build time from the ROS interface files, and checked conversions to library types.
//!
//! There is a module per ROS package: [`sctn_msgs`], whose files lie in this folder, and the standard packages
//! in use, whose files lie in `vendor/`. A type is named as in ROS, without `msg`: `sensor_msgs::Image`. The
//! parts of a service are `SetIORequest` and `SetIOResponse`, those of an action `FollowJointTrajectoryGoal`,
//! `-Result` and `-Feedback`.

pub mod bounded;
mod camera_topics;
mod cdr;
pub mod convert;
mod interface;
#[allow(clippy::all, rustdoc::bare_urls)]
mod interfaces {
    include!(concat!(env!("OUT_DIR"), "/interfaces.rs"));
}

pub use camera_topics::{CameraPreset, CameraTopicNames, UnknownPreset};
pub use cdr::{CdrError, from_cdr, from_recorded_cdr, to_cdr, to_cdr_in};
pub use interface::{
    Action, Description, Interface, Service, Visitor, description, message_type_name,
};
pub use interfaces::*;
pub use serde_bytes::ByteBuf;
