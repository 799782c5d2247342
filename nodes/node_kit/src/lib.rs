//! What ros2-client leaves to us: the one place where our nodes meet the middleware.
//!
//! A node is a library with `pub async fn run(node: Node, parameters: P) -> anyhow::Result<()>` and
//! a small binary that calls [`main`]; [`Context::start`] composes several in one process.

mod action;
mod arguments;
mod clock;
mod context;
mod diagnostics;
mod graph;
pub mod logging;
mod node;
mod parameters;
mod qos;
mod raw;
mod service;
mod statistics;
mod topic;

pub use action::{ActionClient, ActionServer, GoalId, GoalStatus, NewGoal, RunningGoal, SentGoal};
pub use arguments::{ArgumentError, ParameterSource, Remap, RosArguments};
pub use clock::{Clock, ns_from_stamp, stamp_from_ns};
pub use context::{Context, ContextError, Network, main, wait_for_end};
pub use diagnostics::{Diagnostics, Level};
pub use graph::Graph;
pub use node::{Node, NodeError};
pub use parameters::{InvalidParameter, Loaded, ParameterError, Parameters, load_text};
pub use qos::Qos;
pub use raw::{Offer, PublisherId, RawMessage, RawPublisher, RawQos, RawSubscription};
pub use service::{CallError, CallOptions, RequestId, ServiceClient, ServiceServer};
pub use statistics::{Snapshot, Statistics};
pub use topic::{Publisher, Subscription};
