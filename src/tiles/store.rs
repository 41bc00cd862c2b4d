//! Records on scratch, by block.

use super::grid::Lie;
use crate::error::Result;
use crate::scratch::{Scratch, ScratchFile};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// Records of one length. Writers work side by side; who reads puts what comes into an order of its own.
pub(super) struct Store {
    file: ScratchFile,
    record_bytes: usize,
    /// Records that a writer holds back, to sort them by block.
    held_back: usize,
    end: AtomicU64,
    runs: Mutex<Vec<Run>>,
}

/// Records of one block that lie together.
#[derive(Debug, Clone, Copy)]
pub struct Run {
    block: u64,
    offset: u64,
    records: u32,
}

/// Runs of each tile.
pub(super) type Tiles = BTreeMap<u64, Vec<Run>>;

/// How many records some runs have.
pub(super) fn records(runs: &[Run]) -> u64 {
    runs.iter().map(|run| u64::from(run.records)).sum()
}

impl Store {
    /// Of records of this length, with so many bytes for each writer.
    pub fn new(record_bytes: usize, writer_bytes: u64, scratch: &Scratch) -> Result<Self> {
        let held_back = (writer_bytes as usize / (2 * record_bytes + 16)).max(64);
        Ok(Store { file: scratch.file()?, record_bytes, held_back, end: AtomicU64::new(0), runs: Mutex::default() })
    }

    pub fn writer(&self) -> Writer<'_> {
        Writer { store: self, keys: Vec::new(), held: Vec::new(), written: 0 }
    }

    /// What tiles hold.
    pub fn tiles(&self, lie: Lie) -> Tiles {
        let mut tiles = Tiles::new();
        for run in self.runs.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            tiles.entry(lie.tile(run.block)).or_default().push(*run);
        }
        tiles
    }

    /// What blocks hold.
    pub fn blocks(&self) -> Tiles {
        let mut blocks = Tiles::new();
        for run in self.runs.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            blocks.entry(run.block).or_default().push(*run);
        }
        blocks
    }

    /// Reads runs, one behind the other; `bytes` is as long as they are.
    pub fn read(&self, runs: &[Run], mut bytes: &mut [u8]) -> Result<()> {
        for run in runs {
            let (now, rest) = bytes.split_at_mut(run.records as usize * self.record_bytes);
            self.file.read_exact_at(now, run.offset)?;
            bytes = rest;
        }
        Ok(())
    }

    /// Gives every record of some runs to `take`.
    pub fn each(&self, runs: &[Run], mut take: impl FnMut(&[u8])) -> Result<()> {
        let mut bytes = Vec::new();
        for run in runs {
            bytes.resize(run.records as usize * self.record_bytes, 0);
            self.read(std::slice::from_ref(run), &mut bytes)?;
            bytes.chunks_exact(self.record_bytes).for_each(&mut take);
        }
        Ok(())
    }
}

/// One writer's end of a [`Store`].
pub(super) struct Writer<'a> {
    store: &'a Store,
    keys: Vec<(u64, u32)>,
    held: Vec<u8>,
    /// Records that were pushed.
    pub written: u64,
}

impl Writer<'_> {
    /// Adds a record, which comes in parts.
    #[inline]
    pub fn push(&mut self, block: u64, parts: &[&[u8]]) -> Result<()> {
        self.keys.push((block, self.keys.len() as u32));
        parts.iter().for_each(|part| self.held.extend_from_slice(part));
        self.written += 1;
        if self.keys.len() >= self.store.held_back { self.flush() } else { Ok(()) }
    }

    /// Writes what is held back.
    pub fn flush(&mut self) -> Result<()> {
        if self.keys.is_empty() {
            return Ok(());
        }
        self.keys.sort_unstable();
        let length = self.store.record_bytes;
        let mut sorted = Vec::with_capacity(self.held.len());
        for &(_, i) in &self.keys {
            sorted.extend_from_slice(&self.held[i as usize * length..][..length]);
        }
        let mut offset = self.store.end.fetch_add(sorted.len() as u64, Relaxed);
        self.store.file.write_all_at(&sorted, offset)?;
        let mut runs = self.store.runs.lock().unwrap_or_else(PoisonError::into_inner);
        for same in self.keys.chunk_by(|a, b| a.0 == b.0) {
            runs.push(Run { block: same[0].0, offset, records: same.len() as u32 });
            offset += (same.len() * length) as u64;
        }
        drop(runs);
        self.keys.clear();
        self.held.clear();
        Ok(())
    }
}
