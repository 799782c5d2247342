//! Topics of any type, as CDR bytes: for recorders and players.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use futures::StreamExt as _;
use rustdds::{
    DomainParticipant, GUID, QosPolicies, QosPolicyBuilder, RepresentationIdentifier, Timestamp,
    Topic, bytes::Bytes, dds::result::CreateResult, no_key, policy,
};

use crate::{
    graph::{Graph, POLL_PERIOD},
    statistics::Statistics,
};

/// Bytes of the CDR header: representation and options.
const CDR_HEADER: usize = 4;

/// How a topic is offered or asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RawQos {
    /// Reliable, else best effort.
    pub reliable: bool,
    /// Transient local, else volatile.
    pub transient_local: bool,
    /// Messages that are kept for a slow reader, or until they are taken.
    pub depth: u32,
}

impl RawQos {
    pub(crate) fn policies(self) -> QosPolicies {
        let infinite = rustdds::Duration::INFINITE;
        let depth = self.depth.clamp(1, 1 << 16) as i32;
        let builder = QosPolicyBuilder::new()
            .deadline(policy::Deadline(infinite))
            .lifespan(policy::Lifespan { duration: infinite })
            .liveliness(policy::Liveliness::Automatic {
                lease_duration: infinite,
            })
            .durability(if self.transient_local {
                policy::Durability::TransientLocal
            } else {
                policy::Durability::Volatile
            })
            .history(policy::History::KeepLast { depth })
            .resource_limits(policy::ResourceLimits {
                max_samples: depth,
                max_instances: 1,
                max_samples_per_instance: depth,
            });
        if self.reliable {
            builder.reliable(rustdds::Duration::from_millis(100))
        } else {
            builder.best_effort()
        }
        .build()
    }
}

/// A publisher of another node.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Offer {
    /// Absolute name of the topic.
    pub topic: String,
    /// Its type, for instance `sensor_msgs/msg/Image`.
    pub type_name: String,
    /// What is offered; DDS does not tell the depth.
    pub qos: RawQos,
    /// Who offers it.
    pub publisher: PublisherId,
}

/// A publisher, told apart from all others.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct PublisherId(GUID);

impl Graph {
    /// The topics that other participants publish, by name; services and actions' services are left out.
    pub fn offers(&self) -> Vec<Offer> {
        let writers = self.discovered_writers().into_iter();
        let mut offers: Vec<Offer> = writers
            .filter_map(|writer| {
                let data = writer.publication_topic_data;
                Some(Offer {
                    topic: data.topic_name.strip_prefix("rt")?.to_owned(),
                    type_name: ros_type_name(&data.type_name)?,
                    qos: RawQos {
                        reliable: matches!(
                            data.reliability,
                            Some(policy::Reliability::Reliable { .. })
                        ),
                        transient_local: data
                            .durability
                            .is_some_and(|durability| durability != policy::Durability::Volatile),
                        depth: 10,
                    },
                    publisher: PublisherId(writer.writer_proxy.remote_writer_guid),
                })
            })
            .collect();
        offers.sort();
        offers
    }

    /// Waits until every one of these topics (absolute names) has a subscription; those that have none after
    /// `limit`.
    pub async fn wait_for_subscriptions(&self, topics: &[String], limit: Duration) -> Vec<String> {
        let end = tokio::time::Instant::now() + limit;
        loop {
            let unheard = topics.iter().filter(|topic| self.subscriptions(topic) == 0);
            let unheard: Vec<String> = unheard.cloned().collect();
            if unheard.is_empty() || tokio::time::Instant::now() >= end {
                return unheard;
            }
            tokio::time::sleep(POLL_PERIOD).await;
        }
    }
}

/// `sensor_msgs/msg/Image` of `sensor_msgs::msg::dds_::Image_`.
fn ros_type_name(dds: &str) -> Option<String> {
    let (package, name) = dds.split_once("::dds_::")?;
    let name = name.strip_suffix('_')?;
    Some(format!("{}/{name}", package.replace("::", "/")))
}

/// `sensor_msgs::msg::dds_::Image_` of `sensor_msgs/msg/Image`.
pub(crate) fn dds_type_name(ros: &str) -> Option<String> {
    let (package, name) = ros.rsplit_once('/')?;
    Some(format!("{}::dds_::{name}_", package.replace('/', "::")))
}

/// A message as bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawMessage {
    /// CDR with its header.
    pub data: Vec<u8>,
    /// Who sent it.
    pub publisher: PublisherId,
    /// When it was sent by the sender's clock, nanoseconds since the epoch.
    pub sent_ns: Option<u64>,
    /// Messages of the same publisher that never arrived, since the last one.
    pub lost_before: u64,
}

type Reader = no_key::SimpleDataReader<Vec<u8>, AsBytes>;
type Writer = no_key::DataWriter<Vec<u8>, AsBytes>;

/// Receives a topic of any type.
pub struct RawSubscription {
    reader: Reader,
    // The reader stops with it.
    _subscriber: rustdds::Subscriber,
    statistics: Arc<Statistics>,
    sequence: BTreeMap<GUID, i64>,
}

impl RawSubscription {
    pub(crate) fn new(
        participant: &DomainParticipant,
        topic: &Topic,
        qos: RawQos,
        statistics: Arc<Statistics>,
    ) -> CreateResult<Self> {
        let subscriber = participant.create_subscriber(&qos.policies())?;
        Ok(Self {
            reader: subscriber.create_simple_datareader_no_key(topic, Some(qos.policies()))?,
            _subscriber: subscriber,
            statistics,
            sequence: BTreeMap::new(),
        })
    }

    /// The next message. Can be cancelled without losing one.
    pub async fn recv(&mut self) -> RawMessage {
        loop {
            let next = {
                let stream = self.reader.as_async_stream();
                futures::pin_mut!(stream);
                stream.next().await
            };
            match next {
                Some(Ok(change)) => {
                    self.statistics.count_message();
                    let publisher = change.writer_guid();
                    let number = i64::from(change.sequence_number);
                    let last = self.sequence.insert(publisher, number);
                    let lost = last.map_or(0, |last| number.saturating_sub(last).saturating_sub(1));
                    let lost_before = lost.max(0) as u64;
                    self.statistics.count_dropped(lost_before);
                    return RawMessage {
                        publisher: PublisherId(publisher),
                        sent_ns: change.source_timestamp().map(nanoseconds),
                        lost_before,
                        data: change.into_value(),
                    };
                }
                Some(Err(error)) => {
                    self.statistics.reject(error);
                    tokio::time::sleep(Duration::from_millis(1)).await;
                }
                None => tokio::time::sleep(Duration::from_millis(10)).await,
            }
        }
    }

    /// Absolute name of the topic.
    pub fn topic(&self) -> &str {
        &self.statistics.name
    }
}

/// Of seconds as a 32.32 fixed point number.
fn nanoseconds(time: Timestamp) -> u64 {
    let ticks = time.to_ticks();
    (ticks >> 32) * 1_000_000_000 + (((ticks & 0xffff_ffff) * 1_000_000_000) >> 32)
}

/// Publishes a topic of any type.
pub struct RawPublisher {
    writer: Writer,
    statistics: Arc<Statistics>,
}

impl RawPublisher {
    pub(crate) fn new(
        participant: &DomainParticipant,
        topic: &Topic,
        qos: RawQos,
        statistics: Arc<Statistics>,
    ) -> CreateResult<Self> {
        let publisher = participant.create_publisher(&qos.policies())?;
        let writer = publisher.create_datawriter_no_key(topic, Some(qos.policies()))?;
        Ok(Self { writer, statistics })
    }

    /// Sends a message given as little-endian CDR with its header, as nearly all are. `false`: it is not, or the middleware did
    /// not take it; counted and warned about.
    pub fn publish(&self, mut cdr: Vec<u8>) -> bool {
        if cdr.len() < CDR_HEADER || cdr[..2] != [0, 1] {
            self.statistics
                .reject("message not sent: expected little-endian CDR with its header");
            return false;
        }
        cdr.drain(..CDR_HEADER);
        match self.writer.write(cdr, Some(Timestamp::now())) {
            Ok(()) => {
                self.statistics.count_message();
                true
            }
            Err(error) => {
                self.statistics.count_dropped(1);
                self.statistics
                    .reject(format_args!("message not sent: {}", error.forget_data()));
                false
            }
        }
    }

    /// Waits until all reliable subscriptions have acknowledged everything; `false` if they have not after `limit`.
    /// Blocks.
    pub fn wait_until_heard(&self, limit: Duration) -> bool {
        self.writer.wait_for_acknowledgments(limit).unwrap_or(false)
    }

    /// Absolute name of the topic.
    pub fn topic(&self) -> &str {
        &self.statistics.name
    }
}

/// No (de)serialisation for RustDDS: messages stay the bytes that they are.
#[derive(Clone)]
pub struct AsBytes;

/// Parameter lists and XCDR2, which ROS does not send.
#[derive(Debug, thiserror::Error)]
#[error("{0:?} is no plain CDR")]
pub struct NoCdr(RepresentationIdentifier);

impl no_key::DeserializerAdapter<Vec<u8>> for AsBytes {
    type Error = NoCdr;
    type Decoded = Vec<u8>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[
            RepresentationIdentifier::CDR_LE,
            RepresentationIdentifier::CDR_BE,
        ]
    }

    fn transform_decoded(decoded: Vec<u8>) -> Vec<u8> {
        decoded
    }
}

impl no_key::DefaultDecoder<Vec<u8>> for AsBytes {
    type Decoder = Self;
    const DECODER: Self = Self;
}

impl no_key::Decode<'_, Vec<u8>> for AsBytes {
    type Error = NoCdr;

    fn decode_bytes(
        self,
        input: &[u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Vec<u8>, NoCdr> {
        let representation = match encoding {
            RepresentationIdentifier::CDR_LE => 1,
            RepresentationIdentifier::CDR_BE => 0,
            other => return Err(NoCdr(other)),
        };
        let mut data = Vec::with_capacity(CDR_HEADER + input.len());
        data.extend([0, representation, 0, 0]);
        data.extend(input);
        Ok(data)
    }
}

impl no_key::SerializerAdapter<Vec<u8>> for AsBytes {
    type Error = NoCdr;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &Vec<u8>) -> Result<Bytes, NoCdr> {
        Ok(Bytes::copy_from_slice(value))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn type_names_go_to_dds_and_back() {
        for (ros, dds) in [
            ("sensor_msgs/msg/Image", "sensor_msgs::msg::dds_::Image_"),
            ("sctn_msgs/msg/Goal", "sctn_msgs::msg::dds_::Goal_"),
        ] {
            assert_eq!(dds_type_name(ros).unwrap(), dds);
            assert_eq!(ros_type_name(dds).unwrap(), ros);
        }
        assert_eq!(ros_type_name("no_ros_type"), None);
        assert_eq!(dds_type_name("no_ros_type"), None);
    }
}
