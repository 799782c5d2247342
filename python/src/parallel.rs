//! Work on several threads.

use std::sync::atomic::{AtomicUsize, Ordering};

/// A thread panicked: a bug in this program.
#[derive(Debug, thiserror::Error)]
#[error("a thread of the simulation panicked; what it printed says where")]
pub struct Panicked;

/// `work(0)` to `work(count - 1)` on at most so many threads, in this order in the result. With one thread on the caller's.
pub fn run<R: Send>(
    threads: usize,
    count: usize,
    work: impl Fn(usize) -> R + Sync,
) -> Result<Vec<R>, Panicked> {
    let next = AtomicUsize::new(0);
    let take = || {
        let mut done = Vec::new();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            if index >= count {
                return done;
            }
            done.push((index, work(index)));
        }
    };
    let threads = threads.min(count);
    let mut done = if threads <= 1 {
        take()
    } else {
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..threads).map(|_| scope.spawn(take)).collect();
            let mut all = Vec::new();
            for thread in threads {
                all.extend(thread.join().map_err(|_| Panicked)?);
            }
            Ok(all)
        })?
    };
    done.sort_by_key(|(index, _)| *index);
    Ok(done.into_iter().map(|(_, result)| result).collect())
}

/// The cores that this process may use.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, |cores| cores.get())
}
