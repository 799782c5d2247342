//! Rust types made at build time from the ROS interface files, and checked conversions to library types.
