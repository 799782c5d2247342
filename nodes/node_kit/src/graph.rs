//! Who is there: what discovery knows.
//!
//! ros2-client's own `wait_for_*` depend on an event channel that all nodes of a participant share
//! and take from each other, so we look at the discovered endpoints instead.

use std::{
    fmt,
    time::{Duration, Instant},
};

use rustdds::{DomainParticipant, GUID, QosPolicies, RTPSEntity, discovery::DiscoveredWriterData};

use crate::{service::CallError, statistics::Direction};

/// The type with which ros2-client subscribes to `/clock`.
const CLOCK_OF_ROS2_CLIENT: &str = "builtin_interfaces::msg::dds_::Time_";
pub(crate) const POLL_PERIOD: Duration = Duration::from_millis(20);

/// The ROS graph as one node has discovered it, without its own endpoints.
#[derive(Clone)]
pub struct Graph {
    participant: DomainParticipant,
}

impl Graph {
    pub(crate) fn new(participant: DomainParticipant) -> Self {
        Self { participant }
    }

    /// Number of publishers of a topic (absolute name).
    pub fn publishers(&self, topic: &str) -> usize {
        self.writers(&format!("rt{topic}"))
    }

    /// Number of subscriptions to a topic (absolute name).
    pub fn subscriptions(&self, topic: &str) -> usize {
        self.readers(&format!("rt{topic}"))
    }

    /// Whether a service (absolute name) has a server.
    pub fn has_service(&self, name: &str) -> bool {
        self.readers(&format!("rq{name}Request")) > 0 && self.writers(&format!("rr{name}Reply")) > 0
    }

    /// Whether an action (absolute name) has a server.
    pub fn has_action(&self, name: &str) -> bool {
        ["send_goal", "cancel_goal", "get_result"]
            .iter()
            .all(|service| self.has_service(&format!("{name}/_action/{service}")))
    }

    /// Waits until a topic has a subscription. `false`: it has none after `limit`.
    pub async fn wait_for_subscription(&self, topic: &str, limit: Duration) -> bool {
        self.wait(limit, || self.subscriptions(topic) > 0).await
    }

    /// Waits until a topic has a publisher. `false`: it has none after `limit`.
    pub async fn wait_for_publisher(&self, topic: &str, limit: Duration) -> bool {
        self.wait(limit, || self.publishers(topic) > 0).await
    }

    pub(crate) async fn wait_for_service(
        &self,
        name: &str,
        limit: Duration,
    ) -> Result<(), CallError> {
        self.wait(limit, || self.has_service(name))
            .await
            .then_some(())
            .ok_or_else(|| unavailable(name, limit))
    }

    pub(crate) async fn wait_for_action(
        &self,
        name: &str,
        limit: Duration,
    ) -> Result<(), CallError> {
        self.wait(limit, || self.has_action(name))
            .await
            .then_some(())
            .ok_or_else(|| unavailable(name, limit))
    }

    /// Which endpoints of other nodes cannot talk to these, which DDS passes over in silence.
    pub(crate) fn conflicts(&self, endpoints: &[Endpoint]) -> Vec<Conflict> {
        let own = self.participant.guid().prefix;
        let mut conflicts = Vec::new();
        for reader in self.participant.discovered_readers() {
            let guid = reader.reader_proxy.remote_reader_guid;
            let data = &reader.subscription_topic_data;
            // Every node made with ros2-client has such a reader.
            let known = data.topic_name() == "rt/clock" && data.type_name() == CLOCK_OF_ROS2_CLIENT;
            let writers = endpoints
                .iter()
                .filter(|ours| ours.direction == Direction::Out && ours.is_on(data.topic_name()));
            for ours in writers.filter(|_| guid.prefix != own && !known) {
                conflicts.extend(ours.conflict(
                    guid,
                    data.type_name(),
                    &ours.policies,
                    &data.qos(),
                ));
            }
        }
        for writer in self.participant.discovered_writers() {
            let guid = writer.writer_proxy.remote_writer_guid;
            let data = &writer.publication_topic_data;
            let readers = endpoints
                .iter()
                .filter(|ours| ours.direction == Direction::In && ours.is_on(&data.topic_name));
            for ours in readers.filter(|_| guid.prefix != own) {
                conflicts.extend(ours.conflict(guid, &data.type_name, &data.qos(), &ours.policies));
            }
        }
        conflicts
    }

    /// Publishers of other participants, services included.
    pub(crate) fn discovered_writers(&self) -> Vec<DiscoveredWriterData> {
        let own = self.participant.guid().prefix;
        let mut writers = self.participant.discovered_writers();
        writers.retain(|writer| writer.writer_proxy.remote_writer_guid.prefix != own);
        writers
    }

    async fn wait(&self, limit: Duration, condition: impl Fn() -> bool) -> bool {
        let start = Instant::now();
        loop {
            if condition() {
                return true;
            }
            if start.elapsed() >= limit {
                return false;
            }
            tokio::time::sleep(POLL_PERIOD).await;
        }
    }

    fn readers(&self, dds_topic: &str) -> usize {
        let own = self.participant.guid().prefix;
        self.participant
            .discovered_readers()
            .iter()
            .filter(|reader| {
                reader.subscription_topic_data.topic_name() == dds_topic
                    && reader.reader_proxy.remote_reader_guid.prefix != own
            })
            .count()
    }

    fn writers(&self, dds_topic: &str) -> usize {
        let own = self.participant.guid().prefix;
        self.participant
            .discovered_writers()
            .iter()
            .filter(|writer| {
                writer.publication_topic_data.topic_name == dds_topic
                    && writer.writer_proxy.remote_writer_guid.prefix != own
            })
            .count()
    }
}

/// A publisher or subscription of this node.
#[derive(Clone, Debug)]
pub(crate) struct Endpoint {
    /// Absolute name of the topic.
    pub topic: String,
    pub direction: Direction,
    /// As DDS names it.
    pub type_name: String,
    pub policies: QosPolicies,
}

/// An endpoint of this node and one of another that do not fit together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Conflict {
    pub topic: String,
    pub remote: GUID,
    reason: String,
}

impl fmt::Display for Conflict {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}: {}", self.topic, self.reason)
    }
}

impl Endpoint {
    fn is_on(&self, dds_topic: &str) -> bool {
        dds_topic.strip_prefix("rt") == Some(self.topic.as_str())
    }

    fn conflict(
        &self,
        remote: GUID,
        type_name: &str,
        offered: &QosPolicies,
        requested: &QosPolicies,
    ) -> Option<Conflict> {
        let (ours, other) = match self.direction {
            Direction::In => ("subscription", "publisher"),
            Direction::Out => ("publisher", "subscription"),
        };
        let reason = if type_name != self.type_name {
            format!(
                "this {ours} has type {}, a {other} of another node ({remote:?}) has {type_name}",
                self.type_name
            )
        } else {
            let policy = offered.compliance_failure_wrt(requested)?;
            format!(
                "no messages between this {ours} and a {other} of another node ({remote:?}): the \
                 {policy:?} offered is less than the one requested"
            )
        };
        Some(Conflict {
            topic: self.topic.clone(),
            remote,
            reason,
        })
    }
}

fn unavailable(name: &str, waited: Duration) -> CallError {
    CallError::Unavailable {
        name: name.to_owned(),
        waited,
    }
}
