//! Who is there: what discovery knows.
//!
//! ros2-client's own `wait_for_*` depend on an event channel that all nodes of a participant share
//! and take from each other, so we look at the discovered endpoints instead.

use std::{
    collections::BTreeMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use msgs::rmw_dds_common::ParticipantEntitiesInfo;
use ros2_client::Gid;
use rustdds::{DomainParticipant, GUID, RTPSEntity, discovery::DiscoveredWriterData};

use crate::endpoint::{Conflict, Direction, Endpoint};

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

    /// Whether every publisher of a topic (absolute name) offers reliability. None: it has no publisher.
    pub(crate) fn offers_reliability(&self, topic: &str) -> Option<bool> {
        let dds_topic = format!("rt{topic}");
        let writers = self.discovered_writers();
        writers
            .iter()
            .filter(|writer| writer.publication_topic_data.topic_name == dds_topic)
            .map(|writer| writer.publication_topic_data.qos().is_reliable())
            .reduce(|all, one| all && one)
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

    /// Waits until a service has a server. `false`: it has none after `limit`.
    pub(crate) async fn wait_for_service(&self, name: &str, limit: Duration) -> bool {
        self.wait(limit, || self.has_service(name)).await
    }

    /// Waits until an action has a server. `false`: it has none after `limit`.
    pub(crate) async fn wait_for_action(&self, name: &str, limit: Duration) -> bool {
        self.wait(limit, || self.has_action(name)).await
    }

    /// Discovered readers of a topic, as DDS names it.
    pub(crate) fn reader_ids(&self, dds_topic: &str) -> Vec<GUID> {
        let readers = self.participant.discovered_readers();
        readers
            .iter()
            .filter(|reader| reader.subscription_topic_data.topic_name() == dds_topic)
            .map(|reader| reader.reader_proxy.remote_reader_guid)
            .collect()
    }

    /// Whether an endpoint is one of this participant.
    pub(crate) fn is_own(&self, endpoint: GUID) -> bool {
        endpoint.prefix == self.participant.guid().prefix
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

/// Participants whose nodes are remembered.
const MAX_PARTICIPANTS: usize = 1024;

/// Which endpoint belongs to which node, as all say on `ros_discovery_info`.
#[derive(Clone, Debug, Default)]
pub(crate) struct NodeNames {
    participants: Arc<Mutex<BTreeMap<[u8; 16], ParticipantEntitiesInfo>>>,
}

impl NodeNames {
    fn participants(&self) -> MutexGuard<'_, BTreeMap<[u8; 16], ParticipantEntitiesInfo>> {
        self.participants
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn learn(&self, said: ParticipantEntitiesInfo) {
        let mut participants = self.participants();
        if participants.len() == MAX_PARTICIPANTS {
            participants.pop_first();
        }
        participants.insert(said.gid.data, said);
    }

    /// The full name of the node that an endpoint belongs to.
    pub(crate) fn of(&self, endpoint: GUID) -> Option<String> {
        let gid = Gid::from(endpoint).to_bytes16();
        self.participants().values().find_map(|participant| {
            participant.node_entities_info_seq.iter().find_map(|node| {
                let mut gids = node.reader_gid_seq.iter().chain(&node.writer_gid_seq);
                gids.any(|known| known.data == gid).then(|| {
                    format!(
                        "{}/{}",
                        node.node_namespace.trim_end_matches('/'),
                        node.node_name
                    )
                })
            })
        })
    }
}
