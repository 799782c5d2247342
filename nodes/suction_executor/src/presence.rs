//! Whether an operator is present, as the operator's console says.

use std::time::{Duration, Instant};

/// The last sign of the operator.
#[derive(Clone, Copy, Debug)]
pub struct Presence {
    timeout: Duration,
    /// When it was last said that the operator is present; nothing since it was said that nobody is.
    present_at: Option<Instant>,
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
    pub fn on_message(&mut self, is_present: bool, now: Instant) {
        self.present_at = is_present.then_some(now);
    }

    /// When the operator will not be present any more without another sign; nothing where nobody is.
    pub fn deadline(&self) -> Option<Instant> {
        Some(self.present_at? + self.timeout)
    }

    /// Whether an operator is present.
    pub fn is_present(&self, now: Instant) -> bool {
        self.deadline().is_some_and(|deadline| now < deadline)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sign_counts_for_the_timeout_and_until_somebody_says_otherwise() {
        let timeout = Duration::from_secs(1);
        let start = Instant::now();
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
