#![doc = include_str!("../README.md")]

mod carry_out;
#[cfg(test)]
mod fixtures;
mod planned;
mod rehearsals;
mod robot_now;
mod surface;

pub use planned::PlannedPrimitive;
pub use rehearsals::{Reading, RehearsalRules, Rehearsals};
pub use robot_now::{HOME_SETTINGS, Picked, Rehearsed, RobotNow, Subject};
pub use surface::touchdown;
