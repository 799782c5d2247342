//! The suction pick-and-place primitive as a state machine over a small robot trait.

mod primitive;

pub use primitive::{Outcome, Phase, PickPlace, PrimitiveSettings, Robot, execute};
