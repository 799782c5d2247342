//! A server that answers goals late, one after the other.

use std::collections::VecDeque;
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What becomes of a goal request that was waiting.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Answer<G> {
    /// The goal is accepted and begins.
    Accept(G),
    /// The goal is rejected because another one is active.
    Busy(G),
}

/// Goal requests of one action that wait for their answer.
///
/// As a node whose goal callback blocks: it works on one request at a time, and those that come meanwhile wait. Whether a
/// goal is active counts when the request's turn has come.
#[derive(Clone, Debug)]
pub struct AcceptanceQueue<G> {
    range: (Duration, Duration),
    rng: ChaCha8Rng,
    waiting: VecDeque<G>,
    /// When the first of them is answered.
    due: Option<Duration>,
}

impl<G> AcceptanceQueue<G> {
    /// Requests are answered after a time drawn evenly from a range.
    pub fn new(min: Duration, max: Duration, seed: u64) -> Self {
        Self {
            range: (min, max.max(min)),
            rng: ChaCha8Rng::seed_from_u64(seed),
            waiting: VecDeque::new(),
            due: None,
        }
    }

    /// Changes the range for requests whose turn has not come.
    pub fn set_range(&mut self, min: Duration, max: Duration) {
        self.range = (min, max.max(min));
    }

    /// A goal request has come.
    pub fn push(&mut self, goal: G, now: Duration) {
        self.waiting.push_back(goal);
        if self.due.is_none() {
            self.due = Some(now + self.draw());
        }
    }

    /// When [`Self::pop`] has something to say next.
    pub fn due(&self) -> Option<Duration> {
        self.due
    }

    /// The answer that is due, if one is.
    pub fn pop(&mut self, now: Duration, busy: bool) -> Option<Answer<G>> {
        if self.due.is_none_or(|due| now < due) {
            return None;
        }
        let goal = self.waiting.pop_front();
        // A rejection takes no time, and what waits behind an accepted goal is rejected.
        self.due = (!self.waiting.is_empty()).then_some(now);
        goal.map(if busy { Answer::Busy } else { Answer::Accept })
    }

    /// Forgets everything that waits, as a process that has died.
    pub fn clear(&mut self) -> impl Iterator<Item = G> {
        self.due = None;
        std::mem::take(&mut self.waiting).into_iter()
    }

    fn draw(&mut self) -> Duration {
        let (min, max) = self.range;
        min + (max - min).mul_f64(self.rng.random_range(0.0..=1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn a_goal_is_accepted_late_and_within_the_range() {
        for seed in 0..20 {
            let mut queue = AcceptanceQueue::new(ms(1000), ms(2000), seed);
            queue.push("descent", ms(500));
            assert_eq!(queue.pop(ms(1499), false), None);
            let due = queue.due().unwrap();
            assert!(ms(1500) <= due && due <= ms(2500), "{due:?}");
            assert_eq!(queue.pop(due, false), Some(Answer::Accept("descent")));
            assert_eq!((queue.pop(due, false), queue.due()), (None, None));
        }
    }

    #[test]
    fn a_repeated_goal_waits_for_the_first_and_is_then_busy() {
        let mut queue = AcceptanceQueue::new(ms(1500), ms(1500), 0);
        queue.push("descent", ms(0));
        queue.push("descent again", ms(1000));
        assert_eq!(queue.pop(ms(1400), false), None);
        assert_eq!(queue.pop(ms(1500), false), Some(Answer::Accept("descent")));
        assert_eq!(
            queue.pop(ms(1500), true),
            Some(Answer::Busy("descent again"))
        );
    }

    #[test]
    fn an_ideal_driver_answers_at_once() {
        let mut queue = AcceptanceQueue::new(ms(0), ms(0), 0);
        queue.push("descent", ms(7));
        assert_eq!(queue.pop(ms(7), false), Some(Answer::Accept("descent")));
    }

    #[test]
    fn a_process_that_died_has_forgotten_its_goals() {
        let mut queue = AcceptanceQueue::new(ms(100), ms(100), 0);
        queue.push(1, ms(0));
        queue.push(2, ms(0));
        assert_eq!(queue.clear().collect::<Vec<_>>(), [1, 2]);
        assert_eq!(queue.pop(ms(1000), false), None);
    }
}
