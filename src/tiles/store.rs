//! Records on scratch, by block.

use crate::error::Result;
use crate::scratch::{Scratch, ScratchFile};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::{Mutex, PoisonError};

/// Records of one length. Writers work side by side; who reads puts what comes into an order of its own.
pub(super) struct Store {
    file: ScratchFile,
    record_bytes: usize,
    /// Records that a writer holds back, to sort them by block.
    held_back: usize,
    /// As they are written.
    fresh: Mutex<Vec<Run>>,
    /// By group, once they were sorted into some.
    runs: Vec<Run>,
}

/// Records of one block that lie together.
#[derive(Debug, Clone, Copy)]
struct Run {
    block: u64,
    /// The number of the first among all that were written, and in the lowest [`COUNT_BITS`] how many there are.
    place: u64,
}

const COUNT_BITS: u32 = 24;

impl Run {
    fn first(self) -> u64 {
        self.place >> COUNT_BITS
    }

    fn records(self) -> usize {
        (self.place & ((1 << COUNT_BITS) - 1)) as usize
    }
}

/// Where the records of a group are, until the store's are sorted into others.
pub type Group = Range<usize>;

impl Store {
    /// Of records of this length, with so many bytes for each writer.
    pub fn new(record_bytes: usize, writer_bytes: u64, scratch: &Scratch) -> Result<Self> {
        let held_back = (writer_bytes as usize / (2 * record_bytes + 16)).clamp(64, (1 << COUNT_BITS) - 1);
        Ok(Store { file: scratch.file()?, record_bytes, held_back, fresh: Mutex::default(), runs: Vec::new() })
    }

    pub fn writer(&self) -> Writer<'_> {
        Writer { store: self, keys: Vec::new(), held: Vec::new(), written: 0 }
    }

    /// Sorts blocks into groups: the number of each, in order, and where its records are.
    pub fn groups(&mut self, of: impl Fn(u64) -> u64 + Sync) -> Vec<(u64, Group)> {
        let mut fresh = std::mem::take(self.fresh.get_mut().unwrap_or_else(PoisonError::into_inner));
        // Nearly always all of them are, and then there is one list, not two.
        if self.runs.is_empty() {
            std::mem::swap(&mut self.runs, &mut fresh);
        }
        self.runs.append(&mut fresh);
        self.runs.par_sort_unstable_by_key(|run| (of(run.block), run.place));
        let mut end = 0;
        let group = |same: &[Run]| {
            let first = end;
            end += same.len();
            (of(same[0].block), first..end)
        };
        self.runs.chunk_by(|a, b| of(a.block) == of(b.block)).map(group).collect()
    }

    /// How many records a group has.
    pub fn records(&self, group: &Group) -> usize {
        self.runs[group.clone()].iter().map(|run| run.records()).sum()
    }

    /// Reads a group's records, one behind the other; `bytes` is as long as they are.
    pub fn read(&self, group: &Group, mut bytes: &mut [u8]) -> Result<()> {
        let is_next = |a: &Run, b: &Run| a.first() + a.records() as u64 == b.first();
        for together in self.runs[group.clone()].chunk_by(is_next) {
            let records: usize = together.iter().map(|run| run.records()).sum();
            let (now, rest) = bytes.split_at_mut(records * self.record_bytes);
            self.file.read_exact_at(now, together[0].first() * self.record_bytes as u64)?;
            bytes = rest;
        }
        Ok(())
    }

    /// Gives every record of a group to `take`.
    pub fn each(&self, group: &Group, mut take: impl FnMut(&[u8])) -> Result<()> {
        let mut bytes = Vec::new();
        for run in &self.runs[group.clone()] {
            bytes.resize(run.records() * self.record_bytes, 0);
            self.file.read_exact_at(&mut bytes, run.first() * self.record_bytes as u64)?;
            bytes.chunks_exact(self.record_bytes).for_each(&mut take);
        }
        Ok(())
    }
}

/// The group of a number among those of [`Store::groups`]; one of no records, if it is not there.
pub(super) fn find(groups: &[(u64, Group)], number: u64) -> Group {
    groups.binary_search_by_key(&number, |(number, _)| *number).map_or(0..0, |at| groups[at].1.clone())
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
        let mut first = self.store.file.append(&sorted)? / length as u64;
        let mut fresh = self.store.fresh.lock().unwrap_or_else(PoisonError::into_inner);
        for same in self.keys.chunk_by(|a, b| a.0 == b.0) {
            fresh.push(Run { block: same[0].0, place: first << COUNT_BITS | same.len() as u64 });
            first += same.len() as u64;
        }
        drop(fresh);
        self.keys.clear();
        self.held.clear();
        Ok(())
    }
}
