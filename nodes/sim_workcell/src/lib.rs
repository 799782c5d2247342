//! Node that emulates the UR driver and the cameras, backed by Rapier.
//!
//! Simulated time advances only while a goal is active, so that a seed and the same goals give the
//! same states, frames and stamps, however slow the host. The wall clock decides only how often
//! what is at rest is said again.

mod node;
mod parameters;

#[cfg(not(test))]
pub use node::start;
pub use node::{HardwareNode, configure};
pub use parameters::SimWorkcellParameters;
