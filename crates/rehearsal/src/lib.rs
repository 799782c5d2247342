#![doc = include_str!("../README.md")]

mod planned;
mod robot_now;
mod surface;

pub use planned::PlannedPrimitive;
pub use robot_now::{HOME_SETTINGS, Picked, Rehearsed, RobotNow, Subject};
pub use surface::touchdown;
