//! Who is there: what discovery knows.
//!
//! ros2-client's own `wait_for_*` depend on an event channel that all nodes of a participant share
//! and take from each other, so we look at the discovered endpoints instead.

use std::time::{Duration, Instant};

use rustdds::{DomainParticipant, RTPSEntity};

use crate::service::CallError;

const POLL_PERIOD: Duration = Duration::from_millis(20);

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

fn unavailable(name: &str, waited: Duration) -> CallError {
    CallError::Unavailable {
        name: name.to_owned(),
        waited,
    }
}
