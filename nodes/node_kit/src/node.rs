//! A node: its name, its topics, services, actions, time and diagnostics.

use std::{
    io,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
};

use msgs::{
    Action, Interface, Service, builtin_interfaces, diagnostic_msgs::DiagnosticArray,
    message_type_name, rosgraph_msgs,
};
use ros2_client::{
    Name, NodeName, NodeOptions, ParameterValue, RosoutRaw, ServiceMapping,
    action::{ActionClientQosPolicies, ActionServerQosPolicies},
};
use rustdds::{Topic, TopicKind};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;
use tracing::{Instrument, error, warn};

use crate::{
    action::{ActionClient, ActionServer},
    arguments::RosArguments,
    clock::Clock,
    diagnostics::{self, Diagnostics, Level},
    graph::{Conflict, Endpoint, Graph},
    logging,
    qos::Qos,
    raw::{self, RawPublisher, RawQos, RawSubscription},
    service::{ServiceClient, ServiceServer},
    statistics::{Direction, Statistics},
    topic::{Publisher, Subscription},
};

/// Why a node, topic, service or action cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// A name breaks the rules of ROS 2.
    #[error("{what} {name:?} is not a ROS name: {reason}")]
    Name {
        /// What was to be named.
        what: &'static str,
        /// The name, remapped.
        name: String,
        /// Which rule.
        reason: String,
    },
    /// The middleware refused.
    #[error("{what} {name}: {reason}")]
    Middleware {
        /// What was to be made.
        what: &'static str,
        /// Its name.
        name: String,
        /// Why.
        reason: String,
    },
}

impl NodeError {
    fn middleware(what: &'static str, name: &str, reason: impl std::fmt::Display) -> Self {
        Self::Middleware {
            what,
            name: name.to_owned(),
            reason: reason.to_string(),
        }
    }
}

/// A ROS 2 node. Clones are the same node.
#[derive(Clone)]
pub struct Node {
    inner: Arc<Inner>,
}

struct Inner {
    ros: Mutex<ros2_client::Node>,
    context: ros2_client::Context,
    arguments: RosArguments,
    /// Name before remapping, which remap rules and `-p` rules refer to.
    default_name: String,
    name: String,
    namespace: String,
    full_name: String,
    clock: Clock,
    statistics: Mutex<Vec<Arc<Statistics>>>,
    endpoints: Mutex<Vec<Endpoint>>,
    diagnostics: Diagnostics,
    span: tracing::Span,
    shutdown: CancellationToken,
    shutdown_observed: AtomicBool,
}

impl Inner {
    /// Endpoints of other nodes that cannot talk to ours: a warning once, a state while they last.
    fn report_conflicts(&self, graph: &Graph, known: &mut Vec<Conflict>) {
        let endpoints = self
            .endpoints
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .clone();
        let conflicts = graph.conflicts(&endpoints);
        for conflict in conflicts.iter().filter(|now| !known.contains(now)) {
            warn!("{conflict}");
        }
        match conflicts.first() {
            Some(first) => self.diagnostics.set(
                "graph",
                Level::Error,
                first.to_string(),
                [("conflicts", conflicts.len().to_string())],
            ),
            None => self.diagnostics.clear("graph"),
        }
        *known = conflicts;
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        logging::unregister(&self.full_name);
    }
}

impl Node {
    pub(crate) fn new(
        context: ros2_client::Context,
        shutdown: CancellationToken,
        default_name: &str,
        arguments: &RosArguments,
        use_sim_time: bool,
        declared: Vec<(String, ParameterValue)>,
    ) -> Result<Self, NodeError> {
        let name = arguments.node_name(default_name);
        let namespace = arguments.namespace(default_name);
        let namespace = format!("/{}", namespace.trim_matches('/'));
        let node_name = NodeName::new(&namespace, name).map_err(|reason| NodeError::Name {
            what: "node",
            name: format!("{namespace} {name}"),
            reason: reason.to_string(),
        })?;
        let full_name = node_name.fully_qualified_name();
        let mut ros = context
            .new_node(node_name, options(declared))
            .map_err(|error| NodeError::middleware("node", &full_name, error))?;
        let spinner = ros
            .spinner()
            .map_err(|error| NodeError::middleware("node", &full_name, error))?;
        let clock = Clock::new(use_sim_time);
        let span = logging::span(&full_name);
        logging::register(&full_name, ros.rosout_writer(), clock.clone());
        let node = Self {
            inner: Arc::new(Inner {
                ros: Mutex::new(ros),
                context,
                arguments: arguments.clone(),
                default_name: default_name.to_owned(),
                name: name.to_owned(),
                namespace,
                full_name,
                clock,
                statistics: Mutex::default(),
                endpoints: Mutex::default(),
                diagnostics: Diagnostics::default(),
                span,
                shutdown,
                shutdown_observed: AtomicBool::new(false),
            }),
        };
        // Not `spawn`: it ends when the ROS node is dropped, which tells it so.
        let spinning = async move {
            if let Err(error) = spinner.spin().await {
                error!("discovery and parameter services stopped: {error}");
            }
        };
        tokio::spawn(spinning.instrument(node.inner.span.clone()));
        node.follow_clock()?;
        node.publish_diagnostics()?;
        Ok(node)
    }

    /// Base name, remapped.
    pub fn name(&self) -> &str {
        &self.inner.name
    }

    /// Namespace and name.
    pub fn full_name(&self) -> &str {
        &self.inner.full_name
    }

    /// The time as this node sees it (`use_sim_time`).
    pub fn clock(&self) -> &Clock {
        &self.inner.clock
    }

    /// The time as a message stamp.
    pub fn now(&self) -> builtin_interfaces::Time {
        self.inner.clock.now()
    }

    /// States that `/diagnostics` shows beside the topics' counters.
    pub fn diagnostics(&self) -> &Diagnostics {
        &self.inner.diagnostics
    }

    /// What discovery knows.
    pub fn graph(&self) -> Graph {
        Graph::new(self.inner.context.domain_participant())
    }

    /// Waits until the process is told to end. A node that waits for it gets two seconds to tidy
    /// up; one that does not is dropped where it stands.
    pub async fn shutdown(&self) {
        self.inner.shutdown_observed.store(true, Ordering::Relaxed);
        self.inner.shutdown.cancelled().await;
    }

    /// Ends this node and its background tasks.
    pub fn stop(&self) {
        self.inner.shutdown.cancel();
    }

    pub(crate) fn shutdown_token(&self) -> &CancellationToken {
        &self.inner.shutdown
    }

    pub(crate) fn observes_shutdown(&self) -> bool {
        self.inner.shutdown_observed.load(Ordering::Relaxed)
    }

    /// The span whose events go to `/rosout` under this node's name; enter it on other threads.
    pub fn span(&self) -> &tracing::Span {
        &self.inner.span
    }

    /// Runs a task in the node's span until it ends or the node does.
    pub fn spawn<T: Send + 'static>(
        &self,
        task: impl Future<Output = T> + Send + 'static,
    ) -> JoinHandle<Option<T>> {
        let shutdown = self.inner.shutdown.clone();
        let task = async move { shutdown.run_until_cancelled(task).await };
        tokio::spawn(task.instrument(self.inner.span.clone()))
    }

    /// Runs blocking work (a network, a simulator) in the node's span on a thread of its own.
    pub fn spawn_blocking<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> JoinHandle<T> {
        let span = self.inner.span.clone();
        tokio::task::spawn_blocking(move || span.in_scope(work))
    }

    fn spawn_background(&self, task: impl Future<Output = ()> + Send + 'static) {
        self.spawn(task);
    }

    /// Absolute name of a topic, service or action after remapping.
    pub fn resolve(&self, name: &str) -> String {
        self.inner
            .arguments
            .resolve(&self.inner.default_name, &self.inner.namespace, name)
    }

    /// Publishes a topic.
    pub fn publisher<M: Interface>(
        &self,
        topic: &str,
        qos: Qos,
    ) -> Result<Publisher<M>, NodeError> {
        let (name, topic) = self.topic::<M>(topic, qos, Direction::Out)?;
        let inner = self
            .ros()
            .create_publisher(&topic, None)
            .map_err(|error| NodeError::middleware("publisher", &name, error))?;
        Ok(Publisher::new(
            inner,
            self.statistics(&name, Direction::Out),
        ))
    }

    /// Subscribes to a topic.
    pub fn subscription<M: Interface>(
        &self,
        topic: &str,
        qos: Qos,
    ) -> Result<Subscription<M>, NodeError> {
        let (name, topic) = self.topic::<M>(topic, qos, Direction::In)?;
        let inner = self
            .ros()
            .create_subscription(&topic, None)
            .map_err(|error| NodeError::middleware("subscription", &name, error))?;
        Ok(Subscription::new(
            inner,
            self.statistics(&name, Direction::In),
        ))
    }

    /// Publishes a topic of any type (its full ROS name, for instance `std_msgs/msg/String`).
    pub fn raw_publisher(
        &self,
        topic: &str,
        type_name: &str,
        qos: RawQos,
    ) -> Result<RawPublisher, NodeError> {
        let (name, topic) = self.raw_topic(topic, type_name, qos)?;
        let middleware = |error: rustdds::dds::result::CreateError| {
            NodeError::middleware("publisher", &name, format!("{error:?}"))
        };
        let participant = self.inner.context.domain_participant();
        let publisher = participant
            .create_publisher(&qos.policies())
            .map_err(middleware)?;
        let writer = publisher
            .create_datawriter_no_key(&topic, Some(qos.policies()))
            .map_err(middleware)?;
        Ok(RawPublisher::new(
            writer,
            self.statistics(&name, Direction::Out),
        ))
    }

    /// Subscribes to a topic of any type.
    pub fn raw_subscription(
        &self,
        topic: &str,
        type_name: &str,
        qos: RawQos,
    ) -> Result<RawSubscription, NodeError> {
        let (name, topic) = self.raw_topic(topic, type_name, qos)?;
        let middleware = |error: rustdds::dds::result::CreateError| {
            NodeError::middleware("subscription", &name, format!("{error:?}"))
        };
        let participant = self.inner.context.domain_participant();
        let subscriber = participant
            .create_subscriber(&qos.policies())
            .map_err(middleware)?;
        let reader = subscriber
            .create_simple_datareader_no_key(&topic, Some(qos.policies()))
            .map_err(middleware)?;
        Ok(RawSubscription::new(
            reader,
            subscriber,
            self.statistics(&name, Direction::In),
        ))
    }

    fn raw_topic(
        &self,
        name: &str,
        type_name: &str,
        qos: RawQos,
    ) -> Result<(String, Topic), NodeError> {
        let (full, _) = self.ros_name("topic", name)?;
        let dds_type = raw::dds_type_name(type_name).ok_or_else(|| NodeError::Name {
            what: "type",
            name: type_name.to_owned(),
            reason: "expected PACKAGE/msg/NAME".to_owned(),
        })?;
        let topic = self
            .inner
            .context
            .domain_participant()
            .create_topic(
                format!("rt{full}"),
                dds_type,
                &qos.policies(),
                TopicKind::NoKey,
            )
            .map_err(|error| NodeError::middleware("topic", &full, format!("{error:?}")))?;
        Ok((full, topic))
    }

    /// Answers a service.
    pub fn service_server<S: Service + 'static>(
        &self,
        service: &str,
    ) -> Result<ServiceServer<S>, NodeError> {
        let (full, name) = self.ros_name("service", service)?;
        let server = self
            .ros()
            .create_server(
                ServiceMapping::Enhanced,
                &name,
                &S::type_name(),
                Qos::Service.profile(),
                Qos::Service.profile(),
            )
            .map_err(|error| NodeError::middleware("service", &full, error))?;
        Ok(ServiceServer::new(
            server,
            self.statistics(&full, Direction::In),
        ))
    }

    /// Calls a service.
    pub fn service_client<S: Service + 'static>(
        &self,
        service: &str,
    ) -> Result<ServiceClient<S>, NodeError> {
        let (full, name) = self.ros_name("service", service)?;
        let client = self
            .ros()
            .create_client(
                ServiceMapping::Enhanced,
                &name,
                &S::type_name(),
                Qos::Service.profile(),
                Qos::Service.profile(),
            )
            .map_err(|error| NodeError::middleware("service client", &full, error))?;
        Ok(ServiceClient::new(client, self.graph(), full))
    }

    /// Carries out an action.
    pub fn action_server<A: Action + 'static>(
        &self,
        action: &str,
    ) -> Result<ActionServer<A>, NodeError> {
        let (full, name) = self.ros_name("action", action)?;
        let qos = ActionServerQosPolicies {
            goal_service: Qos::Service.profile(),
            result_service: Qos::Service.profile(),
            cancel_service: Qos::Service.profile(),
            feedback_publisher: Qos::Event.profile(),
            status_publisher: Qos::Latched.profile(),
        };
        let server = self
            .ros()
            .create_action_server(ServiceMapping::Enhanced, &name, &A::type_name(), qos)
            .map_err(|error| NodeError::middleware("action", &full, error))?;
        let statistics = self.statistics(&full, Direction::In);
        self.span()
            .in_scope(|| ActionServer::new(server, self.inner.clock.clone(), statistics))
            .map_err(|error: io::Error| NodeError::middleware("action", &full, error))
    }

    /// Has an action carried out.
    pub fn action_client<A: Action + 'static>(
        &self,
        action: &str,
    ) -> Result<ActionClient<A>, NodeError> {
        let (full, name) = self.ros_name("action", action)?;
        let qos = ActionClientQosPolicies {
            goal_service: Qos::Service.profile(),
            result_service: Qos::Service.profile(),
            cancel_service: Qos::Service.profile(),
            feedback_subscription: Qos::Event.profile(),
            status_subscription: Qos::Latched.profile(),
        };
        let client = self
            .ros()
            .create_action_client(ServiceMapping::Enhanced, &name, &A::type_name(), qos)
            .map_err(|error| NodeError::middleware("action client", &full, error))?;
        Ok(ActionClient::new(client, self.graph(), full))
    }

    fn ros(&self) -> MutexGuard<'_, ros2_client::Node> {
        self.inner
            .ros
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn statistics(&self, name: &str, direction: Direction) -> Arc<Statistics> {
        let statistics = Arc::new(Statistics::new(name, direction));
        self.inner
            .statistics
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(Arc::clone(&statistics));
        statistics
    }

    fn ros_name(&self, what: &'static str, name: &str) -> Result<(String, Name), NodeError> {
        let full = self.resolve(name);
        let parsed = Name::parse(&full).map_err(|reason| NodeError::Name {
            what,
            name: full.clone(),
            reason: reason.to_string(),
        })?;
        Ok((full, parsed))
    }

    /// A DDS topic with our own policies, as ros2-client's profiles know no resource limits.
    fn topic<M: Interface>(
        &self,
        name: &str,
        qos: Qos,
        direction: Direction,
    ) -> Result<(String, Topic), NodeError> {
        let (full, _) = self.ros_name("topic", name)?;
        let endpoint = Endpoint {
            topic: full.clone(),
            direction,
            type_name: message_type_name::<M>().dds_msg_type(),
            policies: qos.policies(direction),
        };
        let topic = self
            .inner
            .context
            .domain_participant()
            .create_topic(
                format!("rt{full}"),
                endpoint.type_name.clone(),
                &endpoint.policies,
                TopicKind::NoKey,
            )
            .map_err(|error| NodeError::middleware("topic", &full, format!("{error:?}")))?;
        let endpoints = &self.inner.endpoints;
        endpoints
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push(endpoint);
        Ok((full, topic))
    }

    fn follow_clock(&self) -> Result<(), NodeError> {
        if !self.inner.clock.is_simulated() {
            return Ok(());
        }
        // Best effort, as rcl has it. A reliable writer would also wait for ros2-client's own readers
        // of /clock, which have the wrong type and acknowledge nothing.
        let mut ticks = self.subscription::<rosgraph_msgs::Clock>("/clock", Qos::Image)?;
        let clock = self.inner.clock.clone();
        self.spawn_background(async move {
            loop {
                let tick = ticks.recv().await;
                clock.set(&tick.clock);
            }
        });
        Ok(())
    }

    fn publish_diagnostics(&self) -> Result<(), NodeError> {
        let publisher = self.publisher::<DiagnosticArray>("/diagnostics", Qos::Event)?;
        // Weak, or the task would keep the node alive.
        let weak = Arc::downgrade(&self.inner);
        let graph = self.graph();
        self.spawn_background(async move {
            let mut previous = Vec::new();
            let mut known = Vec::new();
            let mut ticks = tokio::time::interval(diagnostics::PERIOD);
            ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
            loop {
                ticks.tick().await;
                let Some(node) = weak.upgrade() else {
                    return;
                };
                let topics = node
                    .statistics
                    .lock()
                    .unwrap_or_else(PoisonError::into_inner)
                    .clone();
                node.report_conflicts(&graph, &mut known);
                publisher.publish(node.diagnostics.report(
                    &node.full_name,
                    node.clock.now(),
                    &topics,
                    &mut previous,
                ));
            }
        });
        Ok(())
    }
}

/// Parameters are read at start; the services show them and refuse changes.
fn options(declared: Vec<(String, ParameterValue)>) -> NodeOptions {
    let mut options = NodeOptions::new().enable_rosout(true);
    for (name, value) in &declared {
        options = options.declare_parameter(name, value.clone());
    }
    options.parameter_validator(Box::new(move |name, value| {
        let unchanged = declared
            .iter()
            .any(|(declared, start)| declared == name && start == value);
        unchanged
            .then_some(())
            .ok_or_else(|| format!("{name} is read-only; restart the node with another value"))
    }))
}
