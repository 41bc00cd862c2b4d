//! Binned vertices, 8 bytes each: in memory when they fit, in a scratch file when they do not.
//!
//! The file is read with positioned reads only: pages of it that the system keeps in memory are the system's, not
//! ours, so the resident set stays what the arithmetic says.

use super::grid::Corner;
use crate::error::Result;
use crate::scratch::{Scratch, ScratchFile};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Vertices a page of a [`PageCache`] holds.
const PAGE: usize = 512;
/// Pages that a [`PageCache`] holds, a power of two.
const PAGES: usize = 512;

/// Bytes of a [`PageCache`].
pub(super) const PAGE_CACHE_BYTES: usize = PAGES * PAGE * 8;

/// One [`Corner`] a vertex.
pub(super) enum Spill {
    /// All in memory.
    Resident(Vec<AtomicU64>),
    /// On scratch.
    Filed(SpillFile),
}

/// The scratch file of a [`Spill`].
pub(super) struct SpillFile {
    file: ScratchFile,
    vertices: u64,
}

impl Spill {
    /// Whether a spill for `vertices` vertices is resident: if they take at most `resident_bytes`.
    pub(super) fn is_resident(vertices: u64, resident_bytes: u64) -> bool {
        vertices.saturating_mul(8) <= resident_bytes
    }

    /// A spill for `vertices` vertices, resident if they take at most `resident_bytes`.
    pub(super) fn new(vertices: u64, resident_bytes: u64, scratch: &Scratch) -> Result<Self> {
        if Spill::is_resident(vertices, resident_bytes) {
            return Ok(Spill::Resident(bytemuck::zeroed_vec(vertices as usize)));
        }
        Ok(Spill::Filed(SpillFile { file: scratch.file()?, vertices }))
    }

    /// Stores the corners of consecutive vertices.
    pub(super) fn write(&self, first: u64, corners: &[Corner]) -> Result<()> {
        match self {
            Spill::Resident(all) => {
                for (to, corner) in all[first as usize..].iter().zip(corners) {
                    to.store(corner.0, Relaxed);
                }
                Ok(())
            }
            Spill::Filed(spill) => spill.file.write_all_at(bytemuck::cast_slice(corners), first * 8),
        }
    }
}

impl SpillFile {
    /// Number of vertices.
    pub(super) fn vertices(&self) -> u64 {
        self.vertices
    }

    /// Reads the corners of consecutive vertices.
    pub(super) fn read(&self, first: u64, corners: &mut [Corner]) -> Result<()> {
        self.file.read_exact_at(bytemuck::cast_slice_mut(corners), first * 8)
    }
}

/// A worker's window on a spill file: 2 MiB of pages, found by the low bits of their number. Scans in a sensible order
/// hit it; others are joined instead.
pub(super) struct PageCache<'a> {
    spill: &'a SpillFile,
    pages: Vec<Corner>,
    /// The number of each held page; one that no vertex has for none.
    held: Vec<u32>,
}

impl<'a> PageCache<'a> {
    pub(super) fn new(spill: &'a SpillFile) -> Self {
        PageCache { spill, pages: bytemuck::zeroed_vec(PAGES * PAGE), held: vec![u32::MAX; PAGES] }
    }

    /// The corner of a vertex.
    #[inline(always)]
    pub(super) fn get(&mut self, vertex: u32) -> Result<Corner> {
        let page = vertex / PAGE as u32;
        let slot = page as usize % PAGES;
        if self.held[slot] != page {
            self.fetch(slot, page)?;
        }
        Ok(self.pages[slot * PAGE + vertex as usize % PAGE])
    }

    #[cold]
    fn fetch(&mut self, slot: usize, page: u32) -> Result<()> {
        self.held[slot] = u32::MAX;
        let first = u64::from(page) * PAGE as u64;
        let count = (self.spill.vertices() - first).min(PAGE as u64) as usize;
        self.spill.read(first, &mut self.pages[slot * PAGE..][..count])?;
        self.held[slot] = page;
        Ok(())
    }
}
