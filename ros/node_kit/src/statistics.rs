//! What a topic has carried, for diagnostics.

use std::{
    fmt::Display,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::{Duration, Instant},
};

use tracing::warn;

use crate::endpoint::{Direction, Endpoint};

/// At most one warning per period and topic, so that a flood of bad messages floods no log.
const WARNING_PERIOD: Duration = Duration::from_secs(1);

/// Counters of one topic or service endpoint.
#[derive(Debug)]
pub struct Statistics {
    pub(crate) name: String,
    pub(crate) direction: Direction,
    /// Of a topic.
    pub(crate) endpoint: Option<Endpoint>,
    /// Not worth a line in `/diagnostics` while all is well.
    pub(crate) quiet: bool,
    messages: AtomicU64,
    dropped: AtomicU64,
    errors: AtomicU64,
    recent: Mutex<Recent>,
}

#[derive(Debug, Default)]
struct Recent {
    message: Option<Instant>,
    error: Option<String>,
    warning: Option<Instant>,
    suppressed: u64,
}

/// Counters at one moment.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Messages sent or received whole.
    pub messages: u64,
    /// Messages that never arrived or that no reader took in time.
    pub dropped: u64,
    /// Messages that could not be read, or that the node refused.
    pub errors: u64,
    /// Time since the last whole message.
    pub age: Option<Duration>,
    /// The last error's text.
    pub last_error: Option<String>,
}

impl Statistics {
    pub(crate) fn new(name: &str, direction: Direction) -> Self {
        Self {
            name: name.to_owned(),
            direction,
            endpoint: None,
            quiet: false,
            messages: AtomicU64::new(0),
            dropped: AtomicU64::new(0),
            errors: AtomicU64::new(0),
            recent: Mutex::default(),
        }
    }

    pub(crate) fn of(self, endpoint: Endpoint) -> Self {
        let endpoint = Some(endpoint);
        Self { endpoint, ..self }
    }

    pub(crate) fn quiet(self) -> Self {
        Self {
            quiet: true,
            ..self
        }
    }

    /// Whether the endpoint is still there: it holds these counters too.
    pub(crate) fn in_use(self: &Arc<Self>) -> bool {
        Arc::strong_count(self) > 1
    }

    pub(crate) fn counts_the_same_as(&self, other: &Self) -> bool {
        self.name == other.name
            && self.direction == other.direction
            && self.endpoint == other.endpoint
    }

    fn recent(&self) -> MutexGuard<'_, Recent> {
        self.recent.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn count_message(&self) {
        self.messages.fetch_add(1, Relaxed);
        self.recent().message = Some(Instant::now());
    }

    pub(crate) fn count_dropped(&self, count: u64) {
        self.dropped.fetch_add(count, Relaxed);
    }

    /// Absolute name of the topic or service.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Counts a message that cannot be used, and warns, at most once a second, naming the topic.
    /// `reason` names the field and says what was expected.
    pub fn reject(&self, reason: impl Display) {
        self.errors.fetch_add(1, Relaxed);
        let reason = reason.to_string();
        let mut recent = self.recent();
        let due = recent
            .warning
            .is_none_or(|last| last.elapsed() >= WARNING_PERIOD);
        if due {
            let suppressed = std::mem::take(&mut recent.suppressed);
            recent.warning = Some(Instant::now());
            recent.error = Some(reason.clone());
            drop(recent);
            if suppressed > 0 {
                warn!("{}: {reason} (and {suppressed} more before)", self.name);
            } else {
                warn!("{}: {reason}", self.name);
            }
        } else {
            recent.suppressed += 1;
            recent.error = Some(reason);
        }
    }

    /// The counters now.
    pub fn snapshot(&self) -> Snapshot {
        let recent = self.recent();
        Snapshot {
            messages: self.messages.load(Relaxed),
            dropped: self.dropped.load(Relaxed),
            errors: self.errors.load(Relaxed),
            age: recent.message.map(|last| last.elapsed()),
            last_error: recent.error.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejected_messages_are_counted_and_the_last_reason_is_kept() {
        let statistics = Statistics::new("/goal", Direction::In);
        statistics.count_message();
        statistics.reject("step: expected 1..9, found 0");
        statistics.reject("stamp: negative");
        let snapshot = statistics.snapshot();
        assert_eq!((snapshot.messages, snapshot.errors), (1, 2));
        assert_eq!(snapshot.last_error.as_deref(), Some("stamp: negative"));
        assert!(snapshot.age.is_some());
    }
}
