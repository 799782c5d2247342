//! Which of several executors may move the arm, without middleware: of those that want to, the one with the highest id; and whoever may, until it
//! stops wanting to.

use std::time::Duration;

/// An executor says who it is as often.
pub(crate) const PERIOD: Duration = Duration::from_millis(100);
/// A candidate becomes active after so long without a word of one that goes before it.
const LISTENING: Duration = Duration::from_millis(700);
/// A candidate that looked at its messages no sooner than this after the time before has stood still, and may have missed some.
const STOOD_STILL: Duration = Duration::from_millis(300);
/// So many words of an active executor make sure that there is one: a single one may be its last, and a burst of them may be no executor's.
const WORDS_OF_ANOTHER: u32 = 4;
/// Words of one executor count where they come no sooner after each other: those of a process that speaks every [`PERIOD`], however late
/// the network is with one of them.
const BETWEEN_WORDS: Duration = Duration::from_millis(80);
/// Words that come later after each other are of an executor that was silent in between.
const SILENCE: Duration = Duration::from_secs(1);
/// Others that are listened to at a time.
const MAX_OTHERS: usize = 8;

/// Tells executors apart: drawn when a process starts.
pub(crate) type ExecutorId = [u8; 16];

/// What an executor says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Word {
    /// It wants to move the arm.
    Candidate(ExecutorId),
    /// It may.
    Active(ExecutorId),
}

/// Where an executor stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Standing {
    /// It listens to others.
    Candidate,
    /// It may move the arm.
    Active,
    /// It must not: another one may.
    Yielded,
}

/// One executor's claim to the arm.
///
/// - A candidate listens. One with a higher id, and one that is active, goes before it: it goes on listening as long as it hears of them, and yields to
///   an active one. Nobody yields to a candidate, which may die before it becomes active.
/// - Two may be active where they did not hear each other, as on two sides of a network that was cut, or after one stood still. When they do, the one with the
///   lower id yields.
#[derive(Clone, Debug)]
pub(crate) struct Claim {
    id: ExecutorId,
    standing: Standing,
    /// Since when no other one has said that it goes before this one.
    alone_since: Duration,
    /// Active ones that were heard.
    others: Vec<Other>,
    looked_at: Duration,
}

/// An executor that says that it is active.
#[derive(Clone, Copy, Debug)]
struct Other {
    id: ExecutorId,
    words: u32,
    heard_at: Duration,
}

impl Claim {
    pub(crate) fn new(id: ExecutorId, now: Duration) -> Self {
        Self {
            id,
            standing: Standing::Candidate,
            alone_since: now,
            others: Vec::new(),
            looked_at: now,
        }
    }

    pub(crate) fn standing(&self) -> Standing {
        self.standing
    }

    /// What this one says of itself, every [`PERIOD`] and when its standing has changed.
    pub(crate) fn word(&self) -> Option<Word> {
        match self.standing {
            Standing::Candidate => Some(Word::Candidate(self.id)),
            Standing::Active => Some(Word::Active(self.id)),
            Standing::Yielded => None,
        }
    }

    /// Another one, or this one, has said something.
    pub(crate) fn hear(&mut self, word: Word, now: Duration) {
        match (self.standing, word) {
            (_, Word::Candidate(id) | Word::Active(id)) if id == self.id => {}
            (Standing::Candidate, Word::Candidate(id)) if id > self.id => self.alone_since = now,
            (Standing::Candidate, Word::Active(id)) => {
                self.alone_since = now;
                self.yield_to(id, now);
            }
            (Standing::Active, Word::Active(id)) if id > self.id => self.yield_to(id, now),
            _ => {}
        }
    }

    /// Yields to an active executor once enough of its words have come.
    fn yield_to(&mut self, id: ExecutorId, now: Duration) {
        self.others
            .retain(|other| now.saturating_sub(other.heard_at) <= SILENCE);
        let Some(other) = self.others.iter_mut().find(|other| other.id == id) else {
            if self.others.len() == MAX_OTHERS {
                self.others.remove(0);
            }
            let (words, heard_at) = (1, now);
            return self.others.push(Other {
                id,
                words,
                heard_at,
            });
        };
        if now.saturating_sub(other.heard_at) < BETWEEN_WORDS {
            return;
        }
        other.words += 1;
        other.heard_at = now;
        if other.words >= WORDS_OF_ANOTHER {
            self.standing = Standing::Yielded;
        }
    }

    /// Time has passed, and everything that has arrived was heard.
    pub(crate) fn look(&mut self, now: Duration) {
        let stood_still = now.saturating_sub(self.looked_at) > STOOD_STILL;
        self.looked_at = now;
        if self.standing != Standing::Candidate {
            return;
        }
        if stood_still {
            self.alone_since = now;
        } else if now.saturating_sub(self.alone_since) >= LISTENING {
            self.standing = Standing::Active;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    fn id(number: u8) -> ExecutorId {
        [number; 16]
    }

    /// Lets time pass, as a process does that looks every [`PERIOD`].
    fn pass(claim: &mut Claim, from: u64, to: u64) {
        for at in (from..=to).step_by(PERIOD.as_millis() as usize) {
            claim.look(ms(at));
        }
    }

    #[test]
    fn one_alone_becomes_active_and_one_that_hears_of_it_yields() {
        let mut first = Claim::new(id(1), ms(0));
        pass(&mut first, 0, 600);
        assert_eq!(first.word(), Some(Word::Candidate(id(1))));
        pass(&mut first, 700, 700);
        assert_eq!(first.word(), Some(Word::Active(id(1))));
        // Its own words, and those of candidates, change nothing.
        first.hear(Word::Active(id(1)), ms(800));
        first.hear(Word::Candidate(id(9)), ms(800));
        assert_eq!(first.standing(), Standing::Active);

        let mut second = Claim::new(id(9), ms(5000));
        pass(&mut second, 5000, 5600);
        for at in [5650, 5750, 5850] {
            second.hear(Word::Active(id(1)), ms(at));
        }
        pass(&mut second, 5900, 6500);
        assert_eq!(second.standing(), Standing::Candidate);
        second.hear(Word::Active(id(1)), ms(6500));
        assert_eq!(
            (second.standing(), second.word()),
            (Standing::Yielded, None)
        );
    }

    #[test]
    fn a_burst_of_words_is_no_other_executor() {
        let mut claim = Claim::new(id(1), ms(0));
        pass(&mut claim, 0, 700);
        let burst = |claim: &mut Claim, from: u64| {
            for at in from..from + 200 {
                claim.hear(Word::Active(id(0xff)), ms(at));
            }
        };
        for from in [1000, 9000] {
            burst(&mut claim, from);
        }
        // Any ids in any order.
        for at in 20_000..20_900 {
            claim.hear(Word::Active([(at * 7 % 251 + 2) as u8; 16]), ms(at));
        }
        assert_eq!(claim.standing(), Standing::Active);
    }

    #[test]
    fn of_two_candidates_the_lower_one_waits_as_long_as_the_other_one_lives() {
        let mut low = Claim::new(id(1), ms(0));
        for at in (0..=2000).step_by(100) {
            low.hear(Word::Candidate(id(2)), ms(at));
            low.look(ms(at));
        }
        assert_eq!(low.standing(), Standing::Candidate);
        // The other one has died before it became active.
        pass(&mut low, 2100, 2700);
        assert_eq!(low.standing(), Standing::Active);
    }

    #[test]
    fn a_candidate_that_stood_still_listens_anew() {
        let mut claim = Claim::new(id(1), ms(0));
        pass(&mut claim, 0, 300);
        pass(&mut claim, 5000, 5600);
        assert_eq!(claim.standing(), Standing::Candidate);
        pass(&mut claim, 5700, 5700);
        assert_eq!(claim.standing(), Standing::Active);
    }

    /// One executor of a simulated network.
    #[derive(Clone, Debug)]
    struct Process {
        start: u64,
        death: Option<u64>,
        claim: Option<Claim>,
    }

    impl Process {
        fn is_active(&self) -> bool {
            let claim = self.claim.as_ref();
            claim.is_some_and(|claim| claim.standing() == Standing::Active)
        }
    }

    /// Time between two moments of the simulation, in ms.
    const MOMENT: u64 = 10;

    /// Runs executors beside each other until `end`, in ms. Words take up to 100 ms, and of two in a row at most one is lost. While `is_cut` says so,
    /// nothing gets through. Calls `watch` at each moment.
    fn run(
        processes: &mut [Process],
        end: u64,
        seed: u64,
        is_cut: impl Fn(u64) -> bool,
        mut watch: impl FnMut(u64, &[Process]) -> Result<(), TestCaseError>,
    ) -> Result<(), TestCaseError> {
        use std::hash::{DefaultHasher, Hash as _, Hasher as _};
        let count = processes.len();
        let draw = |what: (u64, usize, usize)| {
            let mut hash = DefaultHasher::new();
            (seed, what).hash(&mut hash);
            hash.finish()
        };
        let mut lost_before = vec![false; count * count];
        let mut under_way: Vec<(u64, usize, Word)> = Vec::new();
        for now in (0..end).step_by(MOMENT as usize) {
            let (due, later): (Vec<_>, Vec<_>) =
                under_way.into_iter().partition(|(at, ..)| *at <= now);
            under_way = later;
            for (_, to, word) in due {
                if let Some(claim) = &mut processes[to].claim {
                    claim.hear(word, ms(now));
                }
            }
            for (from, process) in processes.iter_mut().enumerate() {
                if process.death.is_some_and(|death| death <= now) {
                    process.claim = None;
                    continue;
                }
                if now < process.start {
                    continue;
                }
                let number = draw((0, from, 0)).to_be_bytes();
                let id = std::array::from_fn(|at| number[at % 8]);
                let claim = process.claim.get_or_insert_with(|| Claim::new(id, ms(now)));
                if (now - process.start) % PERIOD.as_millis() as u64 >= MOMENT {
                    continue;
                }
                claim.look(ms(now));
                let Some(word) = claim.word() else {
                    continue;
                };
                for to in (0..count).filter(|to| *to != from) {
                    let drawn = draw((now, from, to));
                    let lost = &mut lost_before[from * count + to];
                    *lost = !*lost && drawn.is_multiple_of(3);
                    if !*lost && !is_cut(now) {
                        under_way.push((now + drawn / 3 % 100, to, word));
                    }
                }
            }
            watch(now, processes)?;
        }
        Ok(())
    }

    fn actives(processes: &[Process]) -> usize {
        processes
            .iter()
            .filter(|process| process.is_active())
            .count()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(500))]

        #[test]
        fn never_are_two_active_and_never_is_none_for_ever(
            starts in prop::collection::vec((0..1500u64, prop::option::weighted(0.3, 0..4000u64)), 2..5),
            seed in any::<u64>(),
        ) {
            let mut processes: Vec<Process> = starts
                .iter()
                .map(|(start, lives)| Process { start: *start, death: lives.map(|lives| start + lives), claim: None })
                .collect();
            let mut yielded = 0;
            let mut was_active = false;
            run(&mut processes, 12_000, seed, |_| false, |now, processes| {
                prop_assert!(actives(processes) <= 1, "two are active at {now} ms");
                let is_yielded = |process: &&Process| {
                    process.claim.as_ref().is_some_and(|claim| claim.standing() == Standing::Yielded)
                };
                let now_yielded = processes.iter().filter(is_yielded).count();
                was_active |= actives(processes) > 0;
                prop_assert!(now_yielded <= yielded || was_active, "one yields to nobody at {now} ms");
                yielded = now_yielded;
                Ok(())
            })?;
            let waits = processes.iter().filter_map(|process| process.claim.as_ref());
            let waits = waits.filter(|claim| claim.standing() == Standing::Candidate).count();
            prop_assert_eq!(waits * (1 - actives(&processes)), 0, "some wait for nobody");
            if starts.iter().all(|(_, death)| death.is_none()) {
                prop_assert_eq!(actives(&processes), 1);
            }
        }

        #[test]
        fn two_that_became_active_on_two_sides_of_a_cut_are_one_after_it(starts in prop::collection::vec(0..1500u64, 2..5), seed in any::<u64>()) {
            let mut processes: Vec<Process> = starts
                .iter()
                .map(|start| Process { start: *start, death: None, claim: None })
                .collect();
            let mut most = 0;
            run(&mut processes, 6000, seed, |now| now < 3000, |now, processes| {
                most = most.max(actives(processes));
                prop_assert!(now < 4500 || actives(processes) == 1, "{} are active at {now} ms", actives(processes));
                Ok(())
            })?;
            prop_assert_eq!(most, starts.len());
        }
    }
}
