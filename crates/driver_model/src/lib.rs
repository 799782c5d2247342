//! How a real robot driver behaves where an ideal one would be kinder: late answers, busy servers, servo lag, noise, vacuum that
//! takes time, stops and faults. Times are passed in; nothing here knows ROS, a clock or physics.

mod acceptance;
mod controllers;
mod noise;
mod safety;
mod servo;
mod settings;
mod vacuum;

pub use acceptance::{AcceptanceQueue, Answer};
pub use controllers::{CONTACT_SINCE, Controller, Controllers, SwitchError};
pub use noise::EncoderNoise;
pub use safety::{Fault, Modes};
pub use servo::{PathDeviation, Servo};
pub use settings::HardwareSettings;
pub use vacuum::{Vacuum, Valves};
