//! Subscriptions to images, which ask for lost packets again where the publisher keeps them.

use std::{sync::Arc, time::Duration};

use msgs::Interface;
use tracing::{debug, warn};

use crate::{
    node::{Node, NodeError},
    statistics::Statistics,
    topic::Subscription,
};

/// How often the publishers are looked at.
const LOOK_PERIOD: Duration = Duration::from_millis(500);

/// Receives a topic of images: reliably while every publisher offers that, so that a fragment that the network loses is sent again, else best
/// effort. An image has some hundred datagrams, and one lost is the whole image lost.
pub struct ImageSubscription<M: Interface> {
    node: Node,
    inner: Subscription<M>,
    reliable: bool,
    look: tokio::time::Interval,
}

impl<M: Interface> ImageSubscription<M> {
    /// Subscribes; best effort until the publishers are known.
    pub fn new(node: &Node, topic: &str) -> Result<Self, NodeError> {
        let mut look = tokio::time::interval(LOOK_PERIOD);
        look.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        Ok(Self {
            inner: node.image_subscription(topic, false)?,
            node: node.clone(),
            reliable: false,
            look,
        })
    }

    /// The next message, as [`Subscription::recv`].
    pub async fn recv(&mut self) -> M {
        loop {
            tokio::select! {
                biased;
                _ = self.look.tick() => self.follow_publishers(),
                message = self.inner.recv() => return message,
            }
        }
    }

    /// The counters of this topic.
    pub fn statistics(&self) -> &Arc<Statistics> {
        self.inner.statistics()
    }

    /// Subscribes anew where what the publishers offer has changed.
    fn follow_publishers(&mut self) {
        let topic = self.inner.topic().to_owned();
        let offered = self.node.graph().offers_reliability(&topic);
        let reliable = offered.unwrap_or(self.reliable);
        if reliable == self.reliable {
            return;
        }
        match self.node.image_subscription(&topic, reliable) {
            Ok(inner) => {
                debug!("{topic}: subscribed anew, reliable: {reliable}");
                self.inner = inner;
                self.reliable = reliable;
            }
            Err(error) => warn!("{topic}: stays as it is subscribed: {error}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        arguments::RosArguments,
        context::{Context, Network},
        parameters::NoParameters,
        qos::Qos,
    };
    use msgs::std_msgs::Header;
    use tokio::time::timeout;

    const LIMIT: Duration = Duration::from_secs(60);

    #[tokio::test(flavor = "multi_thread")]
    async fn images_are_received_reliably_while_every_publisher_offers_that() {
        let context = Context::new(Network::unused().unwrap());
        let node = |name: &str| {
            let (node, NoParameters {}) = context.node(name, &RosArguments::default()).unwrap();
            node
        };
        let (sender, receiver) = (node("sender"), node("receiver"));
        let mut images = ImageSubscription::<Header>::new(&receiver, "images").unwrap();
        assert!(!images.reliable);
        let message = |frame_id: &str| Header {
            frame_id: frame_id.into(),
            ..Header::default()
        };
        let reliable = sender.publisher::<Header>("images", Qos::Event).unwrap();
        timeout(LIMIT, async {
            while !images.reliable {
                reliable.publish(message("reliable"));
                let _ = timeout(Duration::from_millis(100), images.recv()).await;
            }
        })
        .await
        .expect("reliable after the publisher's discovery");
        reliable.publish(message("again"));
        timeout(LIMIT, images.recv()).await.expect("a message");
        // One that keeps nothing would not be heard by a reliable subscription.
        let other = sender.publisher::<Header>("images", Qos::Image).unwrap();
        timeout(LIMIT, async {
            loop {
                other.publish(message("best effort"));
                let received = timeout(Duration::from_millis(100), images.recv()).await;
                if received.is_ok_and(|header| header.frame_id == "best effort") {
                    return;
                }
            }
        })
        .await
        .expect("a message of the best-effort publisher");
        assert!(!images.reliable);
        context.shutdown();
    }
}
