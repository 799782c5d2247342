//! The QoS profiles of the system; nothing bypasses them.

use std::ops::RangeInclusive;

use ros2_client::qos::{Durability, History, QosProfile, WhenFull};
use rustdds::{QosPolicies, QosPolicyBuilder, policy};

use crate::endpoint::Direction;

/// What is asked for one endpoint; the profile's own where nothing is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct QosOverride {
    pub depth: Option<i64>,
    pub reliable: Option<bool>,
    pub transient_local: Option<bool>,
}

/// How a topic is delivered (REP-2003, and the design's choices).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Qos {
    /// Camera images and other large streams: best effort, volatile, depth 4. A lost image is
    /// replaced by the next; a slow reader costs the writer nothing.
    Image,
    /// State that a late joiner must have (heightmap, goal, tf_static, robot mode): reliable,
    /// transient local, depth 1.
    Latched,
    /// Things that happen once (confirmations, proposals, results) and small streams: reliable,
    /// volatile, so that nothing is replayed to a late joiner.
    Event,
    /// Requests and replies of services and actions: reliable, volatile.
    Service,
}

impl Qos {
    /// As DDS policies. The resource limit bounds what RustDDS keeps of a topic: on the reader's
    /// side everything that has arrived, otherwise 64 samples (400 MB for six camera topics); on the
    /// writer's side what has not been acknowledged.
    pub(crate) fn policies(self, direction: Direction, wish: QosOverride) -> QosPolicies {
        let limit = match direction {
            Direction::In => self.reader_limit(),
            Direction::Out => self.writer_limit(),
        };
        let depth = wish.depth.map_or(self.depth(), |depth| depth as i32);
        let limit = limit.max(depth);
        let infinite = rustdds::Duration::INFINITE;
        let builder = QosPolicyBuilder::new()
            .deadline(policy::Deadline(infinite))
            .lifespan(policy::Lifespan { duration: infinite })
            .liveliness(policy::Liveliness::Automatic {
                lease_duration: infinite,
            });
        let builder = match wish.reliable.unwrap_or(self != Self::Image) {
            false => builder.best_effort(),
            // A publisher waits this long for readers that do not keep up, then the sample is
            // counted as dropped.
            true => builder.reliable(rustdds::Duration::from_millis(100)),
        };
        builder
            .durability(match self {
                Self::Latched => policy::Durability::TransientLocal,
                _ => policy::Durability::Volatile,
            })
            .history(policy::History::KeepLast { depth })
            .resource_limits(policy::ResourceLimits {
                max_samples: limit,
                max_instances: 1,
                max_samples_per_instance: limit,
            })
            .build()
    }

    /// For services and actions, which ros2-client creates from its own profile type.
    pub(crate) fn profile(self) -> QosProfile {
        QosProfile::publisher_default()
            .reliability_reliable(WhenFull::DEFAULT)
            .durability(match self {
                Self::Latched => Durability::TransientLocal,
                _ => Durability::Volatile,
            })
            .history(History::KeepLast {
                depth: self.depth() as usize,
            })
    }

    /// Depths that may be asked for instead of the profile's own. A latched topic has one newest message; what happens once must not
    /// push out what has not been acknowledged, and ROS's own default is 10.
    pub(crate) fn depths(self) -> RangeInclusive<i64> {
        match self {
            Self::Image => 1..=64,
            Self::Latched => 1..=1,
            Self::Event | Self::Service => 10..=4096,
        }
    }

    const fn depth(self) -> i32 {
        match self {
            Self::Image => 4,
            Self::Latched => 1,
            Self::Event | Self::Service => 64,
        }
    }

    const fn reader_limit(self) -> i32 {
        match self {
            Self::Image | Self::Latched => 8,
            Self::Event | Self::Service => 256,
        }
    }

    /// A reader that was killed acknowledges nothing until its lease ends after 50 s. A small stream
    /// of 50 messages a second gets past that without a wait.
    const fn writer_limit(self) -> i32 {
        match self {
            Self::Image | Self::Latched => 8,
            Self::Event | Self::Service => 4096,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_latched_topics_are_replayed_to_late_joiners() {
        for qos in [Qos::Image, Qos::Event, Qos::Service] {
            assert!(
                qos.policies(Direction::Out, QosOverride::default())
                    .is_volatile(),
                "{qos:?}"
            );
        }
        assert!(
            !Qos::Latched
                .policies(Direction::Out, QosOverride::default())
                .is_volatile()
        );
    }

    #[test]
    fn only_images_are_best_effort() {
        assert!(
            !Qos::Image
                .policies(Direction::Out, QosOverride::default())
                .is_reliable()
        );
        for qos in [Qos::Latched, Qos::Event, Qos::Service] {
            assert!(
                qos.policies(Direction::Out, QosOverride::default())
                    .is_reliable(),
                "{qos:?}"
            );
        }
    }
}
