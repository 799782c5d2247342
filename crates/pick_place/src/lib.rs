//! The suction pick-and-place primitive as a state machine over a small robot trait.

mod primitive;
mod robot;
mod settings;
mod touchdown;

pub use primitive::{Command, Next, Outcome, Phase, PickPlace, Primitive, PrimitiveError, Report};
pub use robot::{ExecuteError, Robot, execute, execute_on, go_home};
pub use settings::{PrimitiveSettings, SettingsError};
pub use touchdown::Touchdown;
