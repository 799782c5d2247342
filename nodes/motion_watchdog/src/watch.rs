//! Whether the executor has died in the middle of a motion, without middleware.

use std::time::{Duration, Instant};

/// The executor's last heartbeat.
#[derive(Clone, Copy, Debug)]
pub struct Watch {
    timeout: Duration,
    /// When the last heartbeat of a motion under way came; `None` after one that says that nothing moves.
    moving_at: Option<Instant>,
}

impl Watch {
    /// Nothing moves yet. In a motion a heartbeat counts for `timeout`.
    pub fn new(timeout: Duration) -> Self {
        Self {
            timeout,
            moving_at: None,
        }
    }

    /// A heartbeat has come.
    pub fn on_heartbeat(&mut self, moving: bool, now: Instant) {
        self.moving_at = moving.then_some(now);
    }

    /// When the executor will count as dead without another heartbeat.
    pub fn deadline(&self) -> Option<Instant> {
        Some(self.moving_at? + self.timeout)
    }

    /// Whether the executor has died in the middle of a motion. Says so once for each motion.
    pub fn has_died(&mut self, now: Instant) -> bool {
        let died = self.deadline().is_some_and(|deadline| now >= deadline);
        if died {
            self.moving_at = None;
        }
        died
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_silence_in_the_middle_of_a_motion_is_a_death_and_it_is_told_once() {
        let timeout = Duration::from_millis(200);
        let start = Instant::now();
        let mut watch = Watch::new(timeout);
        assert!(!watch.has_died(start + 100 * timeout));
        watch.on_heartbeat(true, start);
        assert!(!watch.has_died(start + timeout / 2));
        watch.on_heartbeat(true, start + timeout / 2);
        assert!(!watch.has_died(start + timeout));
        assert_eq!(watch.deadline(), Some(start + timeout * 3 / 2));
        assert!(watch.has_died(start + timeout * 3 / 2));
        assert!(!watch.has_died(start + 2 * timeout));
        watch.on_heartbeat(true, start + 3 * timeout);
        watch.on_heartbeat(false, start + 3 * timeout);
        assert!(!watch.has_died(start + 100 * timeout));
    }
}
