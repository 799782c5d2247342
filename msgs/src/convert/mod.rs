//! Checked conversions between messages and library types.
//!
//! What comes from outside is hostile until one of the `*_from_msg` functions has let it pass: sizes, ranges,
//! finite numbers, names. The errors name the field and what was expected; the caller adds the topic.

mod camera;
mod error;
mod heightmap;
mod motion;
mod preview;
mod step;
mod time;
mod transforms;

pub use camera::{
    color_from_msg, color_to_msg, depth_from_msg, depth_to_msg, depth_to_msg_mm,
    intrinsics_from_msg, intrinsics_to_msg,
};
pub use error::ConvertError;
pub use heightmap::{header, heightmap_from_msg, heightmap_to_msg};
pub use motion::{
    JointReading, isometry_from_msg, isometry_to_msg, joint_reading_from_msg, joint_state_to_msg,
    joint_trajectory_from_msg, joint_trajectory_to_msg, joints_from_msg, outcome_from_msg,
    outcome_to_msg, phase_to_msg, pick_place_from_msg, pin_level, pose2d_from_msg, pose2d_to_msg,
    settings_from_msg, settings_to_msg, trajectory_points_to_msg,
};
pub use preview::{compressed_preview, grid_map, points, preview_image};
pub use step::{
    confirmation_from_msg, confirmation_refused_from_msg, confirmation_refused_to_msg,
    confirmation_to_msg, goal_from_msg, goal_to_msg, observation_from_msg, proposal_from_msg,
    proposal_to_msg, result_from_msg, result_to_msg, reward_from_msg,
};
pub use time::{duration_from_msg, duration_to_msg, time_from_msg, time_to_msg};
pub use transforms::{InvalidTransform, transforms_from_msg};
