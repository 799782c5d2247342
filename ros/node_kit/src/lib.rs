//! What ros2-client leaves to us: the one place where our nodes meet the middleware.
//!
//! A node is a library with an `async fn configure(node: Node, parameters: P) -> anyhow::Result<A>`, where `A` is [`Active`], a `pub fn start` that
//! gives it to [`Context::start`], and a small binary that calls [`main`]. A process may start several.

mod action;
mod answerable;
mod arguments;
mod clock;
mod context;
mod diagnostics;
mod endpoint;
mod graph;
mod idempotent;
mod image_subscription;
mod invalid_parameter;
mod lifecycle;
pub mod logging;
mod node;
mod parameter_services;
mod parameter_store;
mod parameters;
mod plain;
mod qos;
mod qos_overrides;
mod raw;
mod reply_cache;
mod security;
mod service;
mod shared_parameters;
mod statistics;
mod task_group;
mod topic;
mod when;

pub use action::{ActionClient, ActionServer, GoalId, GoalStatus, NewGoal, RunningGoal, SentGoal};
pub use arguments::{ArgumentError, ParameterSource, Remap, RosArguments};
pub use clock::{Clock, ns_from_stamp, stamp_from_ns};
pub use context::{Context, ContextError, Network, NodeLife, main, wait_for_end};
pub use diagnostics::{Diagnostics, Level};
pub use graph::Graph;
pub use idempotent::{IdempotentServer, IdempotentService, NewRequest};
pub use image_subscription::ImageSubscription;
pub use invalid_parameter::InvalidParameter;
pub use lifecycle::{Active, LifecycleClient, LifecycleError, State, Transition};
pub use node::{Node, NodeError};
pub use parameters::{
    Loaded, NoParameters, ParameterError, Parameters, Range, Ranges, load as load_parameters,
    load_text, mistakes_in_documentation,
};
pub use plain::plain_node;
pub use qos::Qos;
pub use qos_overrides::QosOverrides;
pub use raw::{
    AsBytes, NoCdr, Offer, PublisherId, RawMessage, RawPublisher, RawQos, RawSubscription,
};
pub use reply_cache::ReplyCache;
pub use security::SecurityError;
pub use service::{CallError, CallOptions, RequestId, ServiceClient, ServiceServer};
pub use shared_parameters::{ChangeParameters, load_work_cell};
pub use statistics::{Snapshot, Statistics};
pub use task_group::TaskGroup;
pub use topic::{Publisher, Subscription};
pub use when::when;
