//! rosbag2 MCAP bags: writing, reading, demonstrations.
