//! rosbag2 MCAP bags: writing, reading, demonstrations.

mod demonstration;

pub use demonstration::{Demonstration, DemonstrationError, DemonstrationStep};
