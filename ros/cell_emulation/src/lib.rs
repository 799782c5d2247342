#![doc = include_str!("../README.md")]

mod acceptance;
pub mod cameras;
mod emulator;
mod goal;
mod health;
mod pins;
mod robot;
mod scene;
mod server;
mod settings;
mod status;
mod trajectory;

pub use self::acceptance::Acceptance;
pub use self::emulator::{Command, Emulator, EmulatorError, Shared, refused_reset};
pub use self::goal::{End, Goal, Motion};
pub use self::health::FaultChange;
pub use self::pins::{InvalidRequest, output_from_msg};
pub use self::robot::RobotPublishers;
pub use self::scene::{SceneCameras, SceneError};
pub use self::server::{ActionNames, DriverServer, DriverState, Request};
pub use self::settings::EmulatorSettings;
pub use self::status::StatusPublishers;
pub use self::trajectory::Failure;
