//! A node: its name, its topics, services, actions, time and diagnostics.

use std::{
    io,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
};

use msgs::{
    Action, Interface, Service, builtin_interfaces, diagnostic_msgs::DiagnosticArray, from_cdr,
    message_type_name, rmw_dds_common::ParticipantEntitiesInfo, rosgraph_msgs,
};
use ros2_client::{
    Name, NodeName, NodeOptions, RosoutRaw, ServiceMapping,
    action::{ActionClientQosPolicies, ActionServerQosPolicies},
};
use rustdds::{QosPolicies, Topic, TopicKind};
use tokio::{sync::watch, task::JoinHandle};
use tokio_util::sync::CancellationToken;
use tracing::{Instrument, error, warn};

use crate::{
    action::{ActionClient, ActionServer},
    arguments::RosArguments,
    clock::Clock,
    diagnostics::{self, Diagnostics, Level},
    endpoint::{Conflict, Direction, Endpoint},
    graph::{Graph, NodeNames},
    idempotent::{IdempotentServer, IdempotentService},
    invalid_parameter::InvalidParameter,
    logging,
    parameter_store::ParameterStore,
    parameters::Parameters,
    qos::{Qos, QosOverride},
    qos_overrides::QosOverrides,
    raw::{self, RawPublisher, RawQos, RawSubscription},
    reply_cache::ReplyCache,
    service::{ServiceClient, ServiceServer},
    statistics::Statistics,
    task_group::TaskGroup,
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
    /// A parameter below `qos_overrides` asks for what a topic cannot do without.
    #[error(transparent)]
    Override(#[from] InvalidParameter),
    /// The middleware refused.
    #[error("{what} {name}: {reason}")]
    Middleware {
        /// What was to be made.
        what: &'static str,
        /// Its name.
        name: String,
        /// The reason.
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
    scope: Scope,
}

/// The part of a node's life that tasks belong to: all of it, while it is configured, while it is active.
#[derive(Clone)]
struct Scope {
    end: CancellationToken,
    observed: Arc<AtomicBool>,
}

impl Scope {
    fn new(end: CancellationToken) -> Self {
        Self {
            end,
            observed: Arc::default(),
        }
    }
}

/// Polls, one every [`diagnostics::PERIOD`], before a conflict is reported without the other node's name, which comes
/// later than its endpoints: where its sample was lost, with the writer's next heartbeat (3 s in Fast DDS).
const POLLS_FOR_A_NAME: u64 = 8;

/// How long a conflict has been there, and whether it has been reported.
#[derive(Clone, Copy, Debug, Default)]
struct Sighting {
    looks: u64,
    told: bool,
}

impl Sighting {
    /// After one more look, with the other node's name known or not.
    fn after_look(self, named: bool) -> Self {
        let looks = self.looks + 1;
        Self {
            looks,
            told: self.told || looks > POLLS_FOR_A_NAME || named && looks > 1,
        }
    }
}

struct Inner {
    ros: Mutex<ros2_client::Node>,
    context: ros2_client::Context,
    arguments: RosArguments,
    /// Name before remapping, which remap rules and `-p` rules refer to.
    default_name: String,
    name: String,
    full_name: String,
    clock: Clock,
    parameters: Arc<ParameterStore>,
    qos_overrides: QosOverrides,
    statistics: Mutex<Vec<Arc<Statistics>>>,
    diagnostics: Diagnostics,
    span: tracing::Span,
    end: CancellationToken,
}

impl Inner {
    /// Endpoints of other nodes that cannot talk to ours: a warning once, a state while they last.
    fn report_conflicts(
        &self,
        graph: &Graph,
        names: &NodeNames,
        known: &mut Vec<(Conflict, Sighting)>,
    ) {
        let topics = self.statistics();
        let in_use = topics.iter().filter(|topic| topic.in_use());
        let endpoints: Vec<_> = in_use.flat_map(|topic| topic.endpoint.clone()).collect();
        drop(topics);
        let mut conflicts = Vec::new();
        let mut first = None;
        for conflict in graph.conflicts(&endpoints) {
            let name = names.of(conflict.remote);
            let text = conflict.describe(&self.full_name, name.as_deref());
            let before = known.iter().find(|(before, _)| *before == conflict);
            let before = before.map_or(Sighting::default(), |(_, sighting)| *sighting);
            let now = before.after_look(name.is_some());
            if now.told && !before.told {
                warn!("{text}");
            }
            first.get_or_insert(text);
            conflicts.push((conflict, now));
        }
        match first {
            Some(first) => self.diagnostics.set(
                "graph",
                Level::Error,
                first,
                [("conflicts", conflicts.len().to_string())],
            ),
            None => self.diagnostics.clear("graph"),
        }
        *known = conflicts;
    }
}

impl Inner {
    fn statistics(&self) -> MutexGuard<'_, Vec<Arc<Statistics>>> {
        self.statistics
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
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
        end: CancellationToken,
        default_name: &str,
        arguments: &RosArguments,
        use_sim_time: bool,
        parameters: ParameterStore,
        qos_overrides: QosOverrides,
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
            // Parameters are ours: what ros2-client offers knows no descriptions.
            .new_node(
                node_name,
                NodeOptions::new()
                    .enable_rosout(true)
                    .start_parameter_services(false),
            )
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
                full_name,
                clock,
                parameters: Arc::new(parameters),
                qos_overrides,
                statistics: Mutex::default(),
                diagnostics: Diagnostics::default(),
                span,
                end: end.clone(),
            }),
            scope: Scope::new(end),
        };
        // Not `spawn`: it ends when the ROS node is dropped, which tells it so.
        let spinning = async move {
            if let Err(error) = spinner.spin().await {
                error!("discovery stopped: {error}");
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

    /// The node's parameters: always the newest, and a wait for changes of those that may be set at run time.
    ///
    /// # Panics
    /// When `P` is not the type that the node was made with.
    pub fn parameters<P: Parameters>(&self) -> watch::Receiver<P> {
        let newest = self.inner.parameters.newest();
        newest.expect("the type of parameters that the node was made with")
    }

    pub(crate) fn parameter_store(&self) -> &Arc<ParameterStore> {
        &self.inner.parameters
    }

    /// Waits until what this handle belongs to is over: in a node's [`run`](crate::Active::run) until the node is
    /// deactivated or asked to end. Work that waits for it has two seconds to clean up; other work is dropped
    /// where it stands.
    pub async fn deactivated(&self) {
        self.scope.observed.store(true, Ordering::Relaxed);
        self.scope.end.cancelled().await;
    }

    /// Ends this node and its background tasks.
    pub fn stop(&self) {
        self.inner.end.cancel();
    }

    /// Whether the node, and with it the process, is to end.
    pub fn is_ending(&self) -> bool {
        self.inner.end.is_cancelled()
    }

    /// Cancelled when the node is to end.
    pub(crate) fn end(&self) -> &CancellationToken {
        &self.inner.end
    }

    /// The same node, for a part of its present life.
    pub(crate) fn scope(&self) -> Self {
        Self {
            inner: Arc::clone(&self.inner),
            scope: Scope::new(self.scope.end.child_token()),
        }
    }

    /// Ends what belongs to this part of the node's life.
    pub(crate) fn leave(&self) {
        self.scope.end.cancel();
    }

    pub(crate) fn observes_its_end(&self) -> bool {
        self.scope.observed.load(Ordering::Relaxed)
    }

    /// The span whose events go to `/rosout` under this node's name; enter it on other threads.
    pub fn span(&self) -> &tracing::Span {
        &self.inner.span
    }

    /// Runs a task in the node's span until it ends, or what this handle belongs to does: the active state, the
    /// configured one, the node.
    pub fn spawn<T: Send + 'static>(
        &self,
        task: impl Future<Output = T> + Send + 'static,
    ) -> JoinHandle<Option<T>> {
        let end = self.scope.end.clone();
        let task = async move { end.run_until_cancelled(task).await };
        tokio::spawn(task.instrument(self.inner.span.clone()))
    }

    /// Background tasks that outlive the active and the configured state.
    pub fn task_group(&self) -> TaskGroup {
        TaskGroup::new(self.inner.span.clone())
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
        let Inner {
            arguments,
            default_name,
            full_name,
            ..
        } = &*self.inner;
        arguments.resolve(default_name, full_name, name)
    }

    /// Publishes a topic.
    pub fn publisher<M: Interface>(
        &self,
        topic: &str,
        qos: Qos,
    ) -> Result<Publisher<M>, NodeError> {
        let (statistics, topic) = self.topic::<M>(topic, qos, Direction::Out)?;
        let inner = self
            .ros()
            .create_publisher(&topic, None)
            .map_err(|error| NodeError::middleware("publisher", &statistics.name, error))?;
        Ok(Publisher::new(inner, statistics))
    }

    /// Subscribes to a topic.
    pub fn subscription<M: Interface>(
        &self,
        topic: &str,
        qos: Qos,
    ) -> Result<Subscription<M>, NodeError> {
        let (statistics, topic) = self.topic::<M>(topic, qos, Direction::In)?;
        let inner = self
            .ros()
            .create_subscription(&topic, None)
            .map_err(|error| NodeError::middleware("subscription", &statistics.name, error))?;
        Ok(Subscription::new(inner, statistics))
    }

    /// Subscribes to a topic of images anew, reliably or not, whatever its profile says. What `qos_overrides` asks for wins.
    pub(crate) fn image_subscription<M: Interface>(
        &self,
        topic: &str,
        reliable: bool,
    ) -> Result<Subscription<M>, NodeError> {
        let full = self.resolve(topic);
        let mut wish = self
            .inner
            .qos_overrides
            .of(&full, Direction::In, Qos::Image)?;
        wish.reliable.get_or_insert(reliable);
        let dds_type = message_type_name::<M>().dds_msg_type();
        let policies = Qos::Image.policies(Direction::In, wish);
        // Counted, and compared with publishers, as what it is at least: it follows them.
        let asked_for = Qos::Image.policies(Direction::In, QosOverride::default());
        let endpoint = Endpoint {
            topic: full.clone(),
            direction: Direction::In,
            type_name: dds_type.clone(),
            policies: asked_for,
        };
        let topic = self.create_dds_topic(&full, dds_type, &policies)?;
        let statistics = self.statistics(Statistics::new(&full, Direction::In).of(endpoint));
        let inner = self
            .ros()
            .create_subscription(&topic, None)
            .map_err(|error| NodeError::middleware("subscription", &full, error))?;
        Ok(Subscription::new(inner, statistics))
    }

    /// Publishes a topic of any type (its full ROS name, for instance `std_msgs/msg/String`).
    pub fn raw_publisher(
        &self,
        topic: &str,
        type_name: &str,
        qos: RawQos,
    ) -> Result<RawPublisher, NodeError> {
        let (statistics, topic) = self.raw_topic(topic, type_name, qos, Direction::Out)?;
        RawPublisher::new(
            &self.inner.context.domain_participant(),
            &topic,
            qos,
            Arc::clone(&statistics),
        )
        .map_err(|error| NodeError::middleware("publisher", &statistics.name, format!("{error:?}")))
    }

    /// Subscribes to a topic of any type.
    pub fn raw_subscription(
        &self,
        topic: &str,
        type_name: &str,
        qos: RawQos,
    ) -> Result<RawSubscription, NodeError> {
        let (statistics, topic) = self.raw_topic(topic, type_name, qos, Direction::In)?;
        RawSubscription::new(
            &self.inner.context.domain_participant(),
            &topic,
            qos,
            Arc::clone(&statistics),
        )
        .map_err(|error| {
            NodeError::middleware("subscription", &statistics.name, format!("{error:?}"))
        })
    }

    fn raw_topic(
        &self,
        name: &str,
        type_name: &str,
        qos: RawQos,
        direction: Direction,
    ) -> Result<(Arc<Statistics>, Topic), NodeError> {
        let dds_type = raw::dds_type_name(type_name).ok_or_else(|| NodeError::Name {
            what: "type",
            name: type_name.to_owned(),
            reason: "expected PACKAGE/msg/NAME".to_owned(),
        })?;
        self.dds_topic(name, dds_type, qos.policies(), direction)
    }

    /// Answers a service.
    pub fn service_server<S: Service + 'static>(
        &self,
        service: &str,
    ) -> Result<ServiceServer<S>, NodeError> {
        let full = self.resolve(service);
        self.serve(
            service,
            self.statistics(Statistics::new(&full, Direction::In)),
        )
    }

    /// Answers a service that carries each request out once; `replies` outlives the server, so that it holds over a deactivation.
    pub fn idempotent_server<S: IdempotentService + 'static>(
        &self,
        service: &str,
        replies: &ReplyCache<S::Response>,
    ) -> Result<IdempotentServer<S>, NodeError> {
        let server = self.service_server(service)?;
        Ok(IdempotentServer::new(server, replies))
    }

    /// A service that every node has; `/diagnostics` names it only after errors.
    pub(crate) fn own_service<S: Service + 'static>(
        &self,
        service: &str,
    ) -> Result<ServiceServer<S>, NodeError> {
        let service = format!("~/{service}");
        let statistics = Statistics::new(&self.resolve(&service), Direction::In).quiet();
        self.serve(&service, self.statistics(statistics))
    }

    fn serve<S: Service + 'static>(
        &self,
        service: &str,
        statistics: Arc<Statistics>,
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
        Ok(ServiceServer::new(server, statistics, self.graph()))
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
        let statistics = self.statistics(Statistics::new(&full, Direction::In));
        self.span()
            .in_scope(|| {
                ActionServer::new(server, self.inner.clock.clone(), self.graph(), statistics)
            })
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

    /// The counters of a new endpoint: those of one of the same name that is gone, if there was one.
    fn statistics(&self, new: Statistics) -> Arc<Statistics> {
        let mut all = self.inner.statistics();
        let before = all
            .iter()
            .find(|old| old.counts_the_same_as(&new) && !old.in_use());
        if let Some(before) = before {
            return Arc::clone(before);
        }
        let statistics = Arc::new(new);
        all.push(Arc::clone(&statistics));
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
    ) -> Result<(Arc<Statistics>, Topic), NodeError> {
        let dds_type = message_type_name::<M>().dds_msg_type();
        let full = self.resolve(name);
        let wish = self.inner.qos_overrides.of(&full, direction, qos)?;
        self.dds_topic(name, dds_type, qos.policies(direction, wish), direction)
    }

    fn dds_topic(
        &self,
        name: &str,
        type_name: String,
        policies: QosPolicies,
        direction: Direction,
    ) -> Result<(Arc<Statistics>, Topic), NodeError> {
        let (full, _) = self.ros_name("topic", name)?;
        let topic = self.create_dds_topic(&full, type_name.clone(), &policies)?;
        let endpoint = Endpoint {
            topic: full.clone(),
            direction,
            type_name,
            policies,
        };
        let statistics = Statistics::new(&full, direction).of(endpoint);
        Ok((self.statistics(statistics), topic))
    }

    fn create_dds_topic(
        &self,
        full: &str,
        type_name: String,
        policies: &QosPolicies,
    ) -> Result<Topic, NodeError> {
        let participant = self.inner.context.domain_participant();
        participant
            .create_topic(format!("rt{full}"), type_name, policies, TopicKind::NoKey)
            .map_err(|error| NodeError::middleware("topic", full, format!("{error:?}")))
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

    /// Listens to who has which endpoints.
    fn follow_node_names(&self) -> Result<NodeNames, NodeError> {
        const TOPIC: &str = "ros_discovery_info";
        let qos = RawQos {
            reliable: true,
            transient_local: true,
            depth: 64,
        };
        let middleware = |error: rustdds::dds::result::CreateError| {
            NodeError::middleware("subscription", TOPIC, format!("{error:?}"))
        };
        let participant = self.inner.context.domain_participant();
        let dds_type = message_type_name::<ParticipantEntitiesInfo>().dds_msg_type();
        let topic = participant
            .create_topic(
                TOPIC.to_owned(),
                dds_type,
                &qos.policies(),
                TopicKind::NoKey,
            )
            .map_err(middleware)?;
        let statistics = self.statistics(Statistics::new(TOPIC, Direction::In).quiet());
        let mut said = RawSubscription::new(&participant, &topic, qos, Arc::clone(&statistics))
            .map_err(middleware)?;
        let names = NodeNames::default();
        let learning = names.clone();
        self.spawn_background(async move {
            loop {
                match from_cdr(&said.recv().await.data) {
                    Ok(participant) => learning.learn(participant),
                    Err(error) => statistics.reject(error),
                }
            }
        });
        Ok(names)
    }

    fn publish_diagnostics(&self) -> Result<(), NodeError> {
        let publisher = self.publisher::<DiagnosticArray>("/diagnostics", Qos::Event)?;
        // Weak, or the task would keep the node alive.
        let weak = Arc::downgrade(&self.inner);
        let graph = self.graph();
        let names = self.follow_node_names()?;
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
                let topics = node.statistics().clone();
                node.report_conflicts(&graph, &names, &mut known);
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Polls until a conflict is reported, when the other node's name is known from that poll on.
    fn told_after(named_from: u64) -> Vec<u64> {
        let mut sighting = Sighting::default();
        let mut told = Vec::new();
        for look in 1..=20 {
            let now = sighting.after_look(look >= named_from);
            if now.told && !sighting.told {
                told.push(look);
            }
            sighting = now;
        }
        told
    }

    #[test]
    fn a_conflict_waits_for_the_other_nodes_name_and_is_told_once_in_any_case() {
        assert_eq!(told_after(1), [2]);
        assert_eq!(told_after(5), [5]);
        assert_eq!(told_after(100), [POLLS_FOR_A_NAME + 1]);
    }
}
