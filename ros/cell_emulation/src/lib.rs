#![doc = include_str!("../README.md")]

mod acceptance;
pub mod cameras;
mod goal;
mod pins;
mod server;
mod status;
mod trajectory;

pub use self::acceptance::Acceptance;
pub use self::goal::{End, Goal, Motion};
pub use self::pins::{InvalidRequest, output_from_msg};
pub use self::server::{ActionNames, DriverServer, DriverState, Request};
pub use self::status::StatusPublishers;
pub use self::trajectory::Failure;
