//! Node that executes approved proposals through the UR driver interface.
//!
//! [`step_protocol::Executor`] decides, without middleware: it holds the gate that says what may move. [`rehearsal`] checks motions before they are
//! approved, [`ur_driver`] moves the arm. The node converts, calls and publishes.

mod cell;
mod node;
mod parameters;

#[cfg(not(test))]
pub use node::start;
pub use node::{ExecutorNode, configure};
pub use parameters::{JointLimits, Limits, SuctionExecutorParameters};
