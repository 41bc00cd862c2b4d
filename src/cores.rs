//! Threads, and the cores that they run on.
//!
//! Where there are as many workers as cores, each keeps to a core of its own. Left to itself, the system wakes a worker on
//! the core of whoever wakes it more often than one would think: where cores are virtual, one that sleeps does not look
//! idle, and half of all wake-ups of a thread were found to wait until the waking one slept (0.4 ms for a stage of as
//! much). Where there are fewer workers than cores, others want the rest, and nobody is kept anywhere.

use crate::error::{Error, Result};
use rayon::iter::{IndexedParallelIterator, MaxLen, MinLen};
use std::num::NonZero;
use std::sync::LazyLock;

/// How many cores this process may use, as far as the system says.
pub fn count() -> usize {
    GIVEN.count
}

/// What the process was given, asked before any thread is kept anywhere.
static GIVEN: LazyLock<Given> = LazyLock::new(|| Given {
    count: std::thread::available_parallelism().map_or(1, NonZero::get),
    #[cfg(target_os = "linux")]
    cores: rustix::thread::sched_getaffinity(None).ok(),
});

struct Given {
    count: usize,
    /// Which cores, where that is known.
    #[cfg(target_os = "linux")]
    cores: Option<rustix::thread::CpuSet>,
}

/// Works with so many threads of rayon's.
pub fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).start_handler(move |worker| keep(worker, threads));
    pool.build().map_err(|e| Error::usage(format!("cannot start {threads} threads: {e}")))?.install(work)
}

/// Has the calling thread keep to a core of its own if the `workers` of which it is one are as many as there are cores.
/// Else it may run on any of them, wherever the thread that started it was kept.
#[cfg(target_os = "linux")]
pub fn keep(worker: usize, workers: usize) {
    use rustix::thread::{CpuSet, sched_setaffinity};
    let Some(given) = &GIVEN.cores else { return };
    let mut mine = *given;
    // Of more cores than the process is granted the time of, any may be the one to run on.
    if workers == GIVEN.count
        && workers == given.count() as usize
        && let Some(core) = (0..CpuSet::MAX_CPU).filter(|core| given.is_set(*core)).nth(worker)
    {
        mine.clear();
        mine.set(core);
    }
    // A thread that the system lets run anywhere does what it should, too, only later.
    let _ = sched_setaffinity(None, &mine);
}

/// Elsewhere threads run where the system sees fit.
#[cfg(not(target_os = "linux"))]
pub fn keep(_worker: usize, _workers: usize) {}

/// Pieces for each thread. Left to itself, rayon halves work twice for two threads, and who has finished waits for a last
/// piece of up to a quarter: 32 of the 500 ms of the search that a refit begins with.
const PIECES: usize = 32;

/// Loops that all threads finish at nearly the same time.
pub trait InPieces: IndexedParallelIterator {
    /// In pieces of at least so many items, and as many pieces as that allows up to [`PIECES`] a thread.
    fn in_pieces(self, least: usize) -> MaxLen<MinLen<Self>> {
        let most = self.len() / (PIECES * rayon::current_num_threads());
        self.with_min_len(least).with_max_len(most.max(1))
    }
}

impl<I: IndexedParallelIterator> InPieces for I {}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;
    use rustix::thread::sched_getaffinity;

    #[test]
    fn as_many_workers_as_cores_have_one_each_and_what_they_start_is_free() {
        let all = sched_getaffinity(None).unwrap();
        let kept = |worker: usize, workers: usize| {
            let start = move || {
                keep(worker, workers);
                // Threads begin where the one that starts them is kept.
                let started = std::thread::spawn(|| {
                    keep(0, count() + 1);
                    sched_getaffinity(None).unwrap()
                });
                (sched_getaffinity(None).unwrap(), started.join().unwrap())
            };
            std::thread::spawn(start).join().unwrap()
        };
        let (first, started) = kept(0, count());
        assert!(started == all);
        if all.count() as usize == count() {
            assert_eq!(first.count(), 1);
        }
        if count() > 1 {
            let (last, _) = kept(count() - 1, count());
            assert!(all.count() as usize != count() || last != first);
            assert!(kept(0, count() - 1).0 == all);
        }
        assert_eq!(on_threads(3, || Ok(rayon::current_num_threads())).unwrap(), 3);
    }
}
