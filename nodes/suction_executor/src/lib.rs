//! Node that executes approved proposals through the UR driver interface.
//!
//! [`step_protocol::ApprovalGate`] decides what may move, without middleware; the rest moves it through the driver's own
//! topics, service and actions, and reports.

mod cell;
mod node;
mod parameters;
mod stop_memory;

pub use node::{ExecutorNode, configure};
pub use parameters::{JointLimits, Limits, SuctionExecutorParameters};
