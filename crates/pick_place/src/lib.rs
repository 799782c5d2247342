//! The suction pick-and-place primitive as a state machine over a small robot trait.

mod primitive;
mod put_down;
mod robot;
mod settings;
mod touchdown;

pub use primitive::{Command, Next, Outcome, Phase, PickPlace, Primitive, PrimitiveError, Report};
pub use put_down::{PutDown, put_down};
pub use robot::{ExecuteError, Robot, carry_out, execute, execute_on, go_home};
pub use settings::{PrimitiveSettings, SettingsError};
pub use touchdown::{ContactSettings, ContactSign, Touchdown};
