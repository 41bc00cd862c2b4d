//! The streaming driver: one thread claims pieces of the file in order, a crew of workers decodes and uses them.
//!
//! The calling thread claims: it maps and populates the next window (so that a slow disk is read ahead of the work) and
//! passes it on through a bounded channel; who works never waits for the disk unless the disk is what is slow. In flight
//! are at most one window being claimed, [`AHEAD`] waiting and one a worker, and each is unmapped by the worker who used
//! it. The workers are threads of this pass alone: blocking on a channel within a shared pool could starve the pool. A pass
//! of a few claims is over before threads would have started: the calling thread works those itself.
//!
//! What is claimed depends on the file only, never on the crew. When several claims fail, the error of the first in file
//! order is the one returned: claims are taken up in order, and those before a failed one are always finished.

use super::map::{Input, WINDOW_BYTES, Window};
use crate::cores;
use crate::error::{Error, Result};
use crate::progress::Progress;
use crossbeam::channel::{Receiver, Sender, bounded};
use crossbeam::queue::ArrayQueue;
use std::panic::resume_unwind;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::SeqCst};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Claims that wait for a worker. A pass that has no more than these starts no threads.
const AHEAD: usize = 2;

/// Vertices in a chunk, and triangles that are decoded in order.
pub(super) const CHUNK: usize = 16_384;

/// Triangles of records of one length that are decoded before they are used: what they become (72 bytes for a face of an STL)
/// is still in a near cache then. Clustering an STL takes 3 % less so than by chunks.
const BITE: usize = 1024;

/// Who works a streaming pass. The pass counts the bytes it has been through into `progress`, and asks it whether to go on.
#[derive(Debug, Clone, Copy)]
pub struct Crew<'a> {
    /// Threads that decode and run the caller's step, beside the one that maps.
    pub workers: usize,
    /// Counts bytes, and can cancel the pass.
    pub progress: &'a Progress,
}

impl Crew<'_> {
    /// An upper bound on what a streaming pass of so many workers makes resident beside what its steps allocate: a window
    /// in the claiming hand, those that wait, and one with a decoded chunk for each worker.
    pub const fn stream_bytes(workers: usize) -> u64 {
        let windows = 1 + AHEAD + workers;
        ((windows + 2 * workers) * (WINDOW_BYTES + (64 << 10))) as u64
    }
}

/// Runs `work` on every claim that `next` yields (with the bytes it stands for), on `crew.workers` threads, each with a
/// `local` of its own, and returns those.
pub(super) fn pump<C: Send, L: Send>(
    crew: &Crew<'_>,
    mut next: impl FnMut() -> Result<Option<(C, u64)>>,
    local: impl Fn() -> L + Sync,
    work: impl Fn(&mut L, C) -> Result<()> + Sync,
) -> Result<Vec<L>> {
    let (first, end) = claim_first(crew, &mut next);
    if let Some(end) = end {
        let mut locals: Vec<L> = (0..crew.workers.max(1)).map(|_| local()).collect();
        for (claim, bytes) in first {
            work(&mut locals[0], claim)?;
            crew.progress.add(bytes);
        }
        return end.map(|()| locals);
    }
    let mut first = first.into_iter();
    let next = || first.next().map_or_else(&mut next, |claim| Ok(Some(claim)));
    let (sender, receiver) = bounded(AHEAD);
    let failure = Failure::default();
    let run = |receiver: Receiver<(u64, C, u64)>| {
        let _stop = StopOnPanic(&failure);
        let mut mine = local();
        for (ordinal, claim, bytes) in receiver {
            if failure.precedes(ordinal) {
                break;
            }
            match work(&mut mine, claim) {
                Ok(()) => crew.progress.add(bytes),
                Err(error) => failure.record(ordinal, error),
            }
        }
        mine
    };
    let locals = std::thread::scope(|scope| {
        let count = crew.workers.max(1);
        let workers: Vec<_> = (0..count)
            .map(|worker| {
                let (run, receiver) = (&run, receiver.clone());
                scope.spawn(move || {
                    cores::keep(worker, count);
                    run(receiver)
                })
            })
            .collect();
        // Only the workers hold receivers now: when the last of them leaves, sending fails instead of blocking.
        drop(receiver);
        claim_all(crew, next, sender, &failure);
        workers.into_iter().map(|w| w.join().unwrap_or_else(|panic| resume_unwind(panic))).collect()
    });
    failure.into_result().map(|()| locals)
}

/// The first claims, one more than [`AHEAD`] if there are so many; else how claiming has ended.
fn claim_first<C>(
    crew: &Crew,
    next: &mut impl FnMut() -> Result<Option<(C, u64)>>,
) -> (Vec<(C, u64)>, Option<Result<()>>) {
    let mut first = Vec::new();
    while first.len() <= AHEAD {
        match crew.progress.check().and_then(|()| next()) {
            Ok(Some(claim)) => first.push(claim),
            Ok(None) => return (first, Some(Ok(()))),
            Err(error) => return (first, Some(Err(error))),
        }
    }
    (first, None)
}

/// Sends claim after claim until there are no more, nobody takes them or something failed.
fn claim_all<C>(
    crew: &Crew<'_>,
    mut next: impl FnMut() -> Result<Option<(C, u64)>>,
    sender: Sender<(u64, C, u64)>,
    failure: &Failure,
) {
    for ordinal in 0.. {
        if failure.precedes(ordinal) {
            return;
        }
        match crew.progress.check().and_then(|()| next()) {
            Ok(Some((claim, bytes))) => {
                if sender.send((ordinal, claim, bytes)).is_err() {
                    return;
                }
            }
            Ok(None) => return,
            Err(error) => return failure.record(ordinal, error),
        }
    }
}

/// What becomes of items, given the worker's number and that of the first item.
type Work<'a, T> = dyn Fn(usize, u64, &[T]) -> Result<()> + Sync + 'a;

/// What each worker of a pass owns, by the worker's number. Passes that decode text, or whatever else takes longer than a
/// call through a pointer a chunk, are compiled once in this way, not once for each of their callers.
pub(super) struct Slots<W>(Vec<Mutex<W>>);

impl<W> Slots<W> {
    /// One for each of the crew.
    pub fn new(crew: &Crew<'_>, worker: impl Fn() -> W) -> Self {
        Slots((0..crew.workers.max(1)).map(|_| Mutex::new(worker())).collect())
    }

    /// That of one worker, which nobody else asks for.
    pub fn of(&self, worker: usize) -> MutexGuard<'_, W> {
        self.0[worker].lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// All of them.
    pub fn into_inner(self) -> Vec<W> {
        self.0.into_iter().map(|slot| slot.into_inner().unwrap_or_else(PoisonError::into_inner)).collect()
    }
}

/// Numbers for the workers of a pass.
#[derive(Default)]
pub(super) struct Numbering(AtomicUsize);

impl Numbering {
    /// The next one.
    pub fn next(&self) -> usize {
        self.0.fetch_add(1, SeqCst)
    }
}

/// The failure of the earliest claim.
struct Failure {
    ordinal: AtomicU64,
    error: Mutex<Option<Error>>,
}

impl Default for Failure {
    fn default() -> Self {
        Failure { ordinal: AtomicU64::new(u64::MAX), error: Mutex::new(None) }
    }
}

impl Failure {
    fn precedes(&self, ordinal: u64) -> bool {
        self.ordinal.load(SeqCst) < ordinal
    }

    fn record(&self, ordinal: u64, error: Error) {
        let mut kept = self.error.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if kept.is_none() || !self.precedes(ordinal) {
            *kept = Some(error);
            self.ordinal.store(ordinal, SeqCst);
        }
    }

    fn into_result(self) -> Result<()> {
        match self.error.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()) {
            Some(error) => Err(error),
            None => Ok(()),
        }
    }
}

/// A worker that panics ends the pass for all: nobody would take up what it had claimed.
struct StopOnPanic<'a>(&'a Failure);

impl Drop for StopOnPanic<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.ordinal.store(0, SeqCst);
        }
    }
}

/// Records of one size, back to back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Run {
    /// Where the first record begins.
    pub offset: u64,
    /// How many there are.
    pub count: u64,
    /// Bytes from one to the next.
    pub stride: usize,
}

impl Run {
    /// Records in a chunk: [`CHUNK`], or fewer when they are so long that a window would not hold as many.
    pub fn per_chunk(&self) -> usize {
        CHUNK.min(WINDOW_BYTES / self.stride).max(1)
    }

    /// Records in a window: as many whole chunks as fit.
    pub fn per_window(&self) -> usize {
        let chunk = self.per_chunk();
        chunk * (WINDOW_BYTES / (chunk * self.stride)).max(1)
    }

    /// A chunk of triangles' records in bites, with the number of the first of each.
    pub fn bites<'a>(&self, first: u64, chunk: &'a [u8]) -> impl Iterator<Item = (u64, &'a [u8])> {
        (first..).step_by(BITE).zip(chunk.chunks(BITE * self.stride).inspect(|bite| bring_near(bite)))
    }

    /// Where record `i` begins.
    pub fn byte(&self, i: u64) -> u64 {
        self.offset + i * self.stride as u64
    }

    /// The window that begins with record `first`, with the number of records that it holds.
    pub fn window(&self, input: &Input, first: u64) -> Result<(Window, usize)> {
        let records = (self.per_window() as u64).min(self.count - first) as usize;
        Ok((input.window(self.byte(first), records * self.stride)?, records))
    }

    /// Streams the run in chunks of whole records: `work` is given the ordinal of the chunk's first record and the bytes.
    pub fn pump<L: Send>(
        &self,
        input: &Input,
        crew: &Crew<'_>,
        local: impl Fn() -> L + Sync,
        work: impl Fn(&mut L, u64, &[u8]) -> Result<()> + Sync,
    ) -> Result<Vec<L>> {
        let mut first = 0;
        let next = || {
            if first >= self.count {
                return Ok(None);
            }
            let (window, records) = self.window(input, first)?;
            let claim = (first, window);
            first += records as u64;
            let bytes = claim.1.len() as u64;
            Ok(Some((claim, bytes)))
        };
        let per_chunk = self.per_chunk();
        pump(crew, next, local, |mine, (first, window)| {
            for (i, chunk) in window.chunks(per_chunk * self.stride).enumerate() {
                work(mine, first + (i * per_chunk) as u64, chunk)?;
            }
            Ok(())
        })
    }
}

/// Has bytes of a window brought near, so that the waits for them overlap: what decodes them does so much beside looking
/// at them that a processor does not look far enough ahead. Clustering an STL takes 3 % less so, a PLY 1 %.
fn bring_near(bytes: &[u8]) {
    const LINE: usize = 64;
    std::hint::black_box(bytes.iter().step_by(LINE).fold(0, |any, byte| any | byte));
}

/// Streams what can only be decoded in order (text, records of unequal length): the claiming thread decodes, the workers
/// use. `fill` appends up to about a chunk of items to the empty buffer it is given and returns the bytes it went through;
/// none appended means the end. `work` gets the worker's number and the ordinal of the first item of each chunk.
pub(super) fn pump_decoded<T: Send>(
    crew: &Crew<'_>,
    fill: &mut dyn FnMut(&mut Vec<T>) -> Result<u64>,
    work: &Work<'_, T>,
) -> Result<()> {
    let numbers = Numbering::default();
    let spent = ArrayQueue::new(crew.workers.max(1) + AHEAD + 1);
    let mut first = 0;
    let next = || {
        let mut items: Vec<T> = spent.pop().unwrap_or_default();
        let bytes = fill(&mut items)?;
        let claim = (first, items);
        first += claim.1.len() as u64;
        Ok(if claim.1.is_empty() { None } else { Some((claim, bytes)) })
    };
    let workers = pump(
        crew,
        next,
        || numbers.next(),
        |mine, (first, mut items)| {
            for (i, chunk) in items.chunks(CHUNK).enumerate() {
                work(*mine, first + (i * CHUNK) as u64, chunk)?;
            }
            items.clear();
            // A full queue only means that the buffer is not needed again.
            let _ = spent.push(items);
            Ok(())
        },
    );
    workers.map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn numbers(n: u64) -> impl FnMut() -> Result<Option<(u64, u64)>> {
        let mut i = 0;
        move || {
            i += 1;
            Ok((i <= n).then_some((i - 1, 1)))
        }
    }

    #[test]
    fn every_claim_is_worked_once_by_any_crew() {
        for (workers, claims) in [0, 1, 2, 3, 8].into_iter().flat_map(|w| [0, 1, 2, 3, 4, 1000].map(|n| (w, n))) {
            let progress = Progress::default();
            let crew = Crew { workers, progress: &progress };
            let sums = pump(
                &crew,
                numbers(claims),
                || 0,
                |sum, i| {
                    *sum += i + 1;
                    Ok(())
                },
            )
            .unwrap();
            assert_eq!(sums.len(), workers.max(1));
            assert_eq!(sums.iter().sum::<u64>(), claims * (claims + 1) / 2);
            assert_eq!(progress.now().1, claims);
        }
    }

    #[test]
    fn a_pass_of_a_few_claims_is_worked_by_its_caller() {
        let progress = Progress::default();
        let here = std::thread::current().id();
        let alone = |claims: u64| {
            let crew = Crew { workers: 2, progress: &progress };
            let workers = pump(&crew, numbers(claims), Vec::new, |mine, _| {
                mine.push(std::thread::current().id());
                Ok(())
            });
            workers.unwrap().into_iter().flatten().all(|thread| thread == here)
        };
        assert!(alone(AHEAD as u64));
        assert!(!alone(AHEAD as u64 + 1));
    }

    #[test]
    fn the_first_failure_in_file_order_is_the_one_told() {
        let progress = Progress::default();
        for workers in [1, 2, 5] {
            for _ in 0..50 {
                let error = pump(
                    &Crew { workers, progress: &progress },
                    numbers(100),
                    || (),
                    |_, i| {
                        if i == 37 {
                            std::thread::sleep(std::time::Duration::from_micros(200));
                        }
                        if i >= 37 { Err(Error::input(Path::new("f"), format!("claim {i}"))) } else { Ok(()) }
                    },
                )
                .unwrap_err();
                assert_eq!(error.to_string(), "f: claim 37");
            }
        }
    }

    #[test]
    fn a_failed_claim_comes_after_the_failures_of_those_before_it() {
        let progress = Progress::default();
        for good in 1..=5 {
            let mut i = 0;
            let next = || {
                i += 1;
                if i > good { Err(Error::input(Path::new("f"), "claiming")) } else { Ok(Some((i, 1))) }
            };
            let fail_last = |_: &mut (), i: i32| {
                std::thread::sleep(std::time::Duration::from_millis(5));
                if i == good { Err(Error::input(Path::new("f"), "working")) } else { Ok(()) }
            };
            let error = pump(&Crew { workers: 2, progress: &progress }, next, || (), fail_last).unwrap_err();
            assert_eq!(error.to_string(), "f: working");
        }
    }

    #[test]
    fn a_cancelled_pass_ends() {
        let signal = std::sync::Arc::new(std::sync::atomic::AtomicUsize::new(0));
        let progress = Progress::cancelled_by(signal.clone());
        let crew = Crew { workers: 2, progress: &progress };
        let error = pump(
            &crew,
            || Ok(Some(((), 1))),
            || (),
            |_, _| {
                signal.store(15, SeqCst);
                Ok(())
            },
        )
        .unwrap_err();
        assert_eq!(error.exit_code(), 143);
    }

    #[test]
    #[should_panic(expected = "a worker's own words")]
    fn a_panic_is_passed_on() {
        let progress = Progress::default();
        let crew = Crew { workers: 3, progress: &progress };
        let _ = pump(&crew, || Ok(Some(((), 1))), || (), |_, _| panic!("a worker's own words"));
    }
}
