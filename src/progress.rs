//! Progress and cancellation, shared by every stage: stages count, `main` shows.
//!
//! All counters are relaxed atomics: they inform, they never decide, so they cannot change a byte of the result.

use crate::error::{Error, Result};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, AtomicUsize, Ordering::Relaxed};

/// The stage that is running, in the order of the pipeline.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Stage {
    /// Opening the scan, counting what its header does not say, loading it when it fits.
    Read = 0,
    /// Binning vertices and summing quadrics per cell.
    Cluster = 1,
    /// Batched collapse.
    Collapse = 2,
    /// Moving the result to where the scan is.
    Refit = 3,
    /// Encoding, syncing and renaming the result.
    Write = 4,
    /// Measuring how far two meshes are from each other.
    Measure = 5,
    /// Carrying over what vertices carry.
    Carry = 6,
    /// Taking pictures.
    Render = 7,
}

impl Stage {
    /// The stage's word in reports and on the terminal.
    pub fn word(self) -> &'static str {
        ["read", "cluster", "collapse", "refit", "write", "measure", "carry", "render"][self as usize]
    }
}

/// How far a run is. One per run; shared by reference with every worker.
#[derive(Debug, Default)]
pub struct Progress {
    stage: AtomicU8,
    done: AtomicU64,
    total: AtomicU64,
    signal: Arc<AtomicUsize>,
}

impl Progress {
    /// A progress that `signal` can cancel: a non-zero value is the signal that asked the run to end.
    pub fn cancelled_by(signal: Arc<AtomicUsize>) -> Self {
        Progress { signal, ..Default::default() }
    }

    /// One that the same signal cancels and that nobody sees: for steps of a stage that counts something else.
    pub fn unseen(&self) -> Progress {
        Progress::cancelled_by(self.signal.clone())
    }

    /// Enters a stage of `total` steps (bytes, vertices or faces, as the stage counts).
    pub fn begin(&self, stage: Stage, total: u64) {
        self.done.store(0, Relaxed);
        self.total.store(total, Relaxed);
        self.stage.store(stage as u8, Relaxed);
    }

    /// Counts `n` further steps.
    pub fn add(&self, n: u64) {
        self.done.fetch_add(n, Relaxed);
    }

    /// `(stage, done, total)` now.
    pub fn now(&self) -> (Stage, u64, u64) {
        let stage = match self.stage.load(Relaxed) {
            0 => Stage::Read,
            1 => Stage::Cluster,
            2 => Stage::Collapse,
            3 => Stage::Refit,
            4 => Stage::Write,
            5 => Stage::Measure,
            6 => Stage::Carry,
            _ => Stage::Render,
        };
        (stage, self.done.load(Relaxed), self.total.load(Relaxed))
    }

    /// `Err(Interrupted)` once a signal has arrived. Stages ask between chunks and between passes.
    pub fn check(&self) -> Result<()> {
        match self.signal.load(Relaxed) {
            0 => Ok(()),
            signal => Err(Error::Interrupted { signal: signal as i32, left: "nothing was written" }),
        }
    }
}
