//! Publishers and subscriptions that count what passes.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use ros2_client::{Gid, MessageInfo, ReadError};

use msgs::Interface;

use crate::statistics::Statistics;

/// Publishes one topic.
pub struct Publisher<M: Interface> {
    inner: ros2_client::Publisher<M>,
    statistics: Arc<Statistics>,
}

impl<M: Interface> Publisher<M> {
    pub(crate) fn new(inner: ros2_client::Publisher<M>, statistics: Arc<Statistics>) -> Self {
        Self { inner, statistics }
    }

    /// Sends a message; it is moved and serialised once. A message that the middleware does not
    /// take (a reader that does not keep up) is counted and warned about.
    pub fn publish(&self, message: M) {
        match self.inner.publish(message) {
            Ok(()) => self.statistics.count_message(),
            Err(error) => {
                self.statistics.count_dropped(1);
                self.statistics
                    .reject(format_args!("message not sent: {}", error.forget_data()));
            }
        }
    }

    /// Absolute name of the topic.
    pub fn topic(&self) -> &str {
        &self.statistics.name
    }

    /// The counters of this topic.
    pub fn statistics(&self) -> &Arc<Statistics> {
        &self.statistics
    }
}

/// Receives one topic.
pub struct Subscription<M: Interface> {
    inner: ros2_client::Subscription<M>,
    statistics: Arc<Statistics>,
    /// Last sequence number of each publisher: a gap is a lost message.
    sequence: BTreeMap<Gid, i64>,
}

/// More publishers than this on one topic are not followed for lost messages.
const MAX_PUBLISHERS: usize = 64;

impl<M: Interface> Subscription<M> {
    pub(crate) fn new(inner: ros2_client::Subscription<M>, statistics: Arc<Statistics>) -> Self {
        Self {
            inner,
            statistics,
            sequence: BTreeMap::new(),
        }
    }

    /// The next message. Messages that cannot be decoded are counted, warned about and skipped.
    /// Can be cancelled (as in `select!`) without losing a message.
    pub async fn recv(&mut self) -> M {
        loop {
            match self.inner.async_take().await {
                Ok((message, info)) => return self.received(message, &info),
                Err(error) => self.failed(error).await,
            }
        }
    }

    /// The next message if one has arrived.
    pub fn try_recv(&mut self) -> Option<M> {
        loop {
            match self.inner.take() {
                Ok(Some((message, info))) => return Some(self.received(message, &info)),
                Ok(None) => return None,
                Err(ReadError::Deserialization { reason }) => self.statistics.reject(reason),
                Err(error) => {
                    self.statistics.reject(error);
                    return None;
                }
            }
        }
    }

    /// Counts a message that was decoded but cannot be used; `reason` names the field and says
    /// what was expected.
    pub fn reject(&self, reason: impl std::fmt::Display) {
        self.statistics.reject(reason);
    }

    /// Absolute name of the topic.
    pub fn topic(&self) -> &str {
        &self.statistics.name
    }

    /// The counters of this topic.
    pub fn statistics(&self) -> &Arc<Statistics> {
        &self.statistics
    }

    fn received(&mut self, message: M, info: &MessageInfo) -> M {
        self.statistics.count_message();
        let (publisher, number) = (info.publisher_gid(), info.sequence_number());
        let room = self.sequence.len() < MAX_PUBLISHERS;
        match self.sequence.get_mut(&publisher) {
            Some(last) => {
                let lost = number.saturating_sub(*last).saturating_sub(1);
                self.statistics.count_dropped(lost.max(0) as u64);
                *last = number.max(*last);
            }
            None if room => {
                self.sequence.insert(publisher, number);
            }
            None => {}
        }
        message
    }

    async fn failed(&self, error: ReadError) {
        match error {
            ReadError::Deserialization { reason } => self.statistics.reject(reason),
            error => {
                self.statistics.reject(error);
                // Not the message's fault: do not spin if it stays.
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        }
    }
}
