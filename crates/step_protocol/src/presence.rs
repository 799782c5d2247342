//! Whether an operator is present, as the operator's console says.

use std::time::Duration;

/// Time between messages that say whether the operator is present.
pub const PRESENCE_PERIOD: Duration = Duration::from_millis(200);

/// The last sign of the operator. Times are monotonic, from any origin.
#[derive(Clone, Copy, Debug)]
pub struct Presence {
    timeout: Duration,
    /// When the last message with `is_present` came; `None` after one without.
    present_at: Option<Duration>,
}

impl Presence {
    /// Nobody is present yet. A sign counts for `timeout`.
    pub fn new(timeout: Duration) -> Self {
        Self {
            timeout,
            present_at: None,
        }
    }

    /// The console has said whether the operator is present.
    pub fn on_message(&mut self, is_present: bool, now: Duration) {
        self.present_at = is_present.then_some(now);
    }

    /// When the presence expires without another message; `None` while nobody is present.
    pub fn deadline(&self) -> Option<Duration> {
        Some(self.present_at? + self.timeout)
    }

    /// Whether an operator is present.
    pub fn is_present(&self, now: Duration) -> bool {
        self.deadline().is_some_and(|deadline| now < deadline)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sign_counts_for_the_timeout_and_until_somebody_says_otherwise() {
        let timeout = Duration::from_secs(1);
        let start = Duration::from_secs(7);
        let mut presence = Presence::new(timeout);
        assert!(!presence.is_present(start));
        presence.on_message(true, start);
        assert!(presence.is_present(start + timeout / 2));
        assert!(!presence.is_present(start + timeout));
        presence.on_message(true, start + timeout);
        assert!(presence.is_present(start + timeout * 3 / 2));
        presence.on_message(false, start + timeout * 3 / 2);
        assert!(!presence.is_present(start + timeout * 3 / 2));
        assert_eq!(presence.deadline(), None);
    }
}
