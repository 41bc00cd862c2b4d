//! Which vertices faces use: a bit each, where there is room for that.

use crate::read::{Layout, Scan};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Share of the room for binned vertices that may go into counting, at most.
const SHARE: u64 = 4;

/// Bytes for so many vertices.
pub(super) fn bytes_for(vertices: u64) -> u64 {
    8 * vertices.div_ceil(64)
}

/// A set of vertices that workers add to together.
pub(super) struct Used(Vec<AtomicU64>);

impl Used {
    /// Keeps no account.
    pub(super) fn nothing() -> Self {
        Used(Vec::new())
    }

    /// For the vertices of an indexed scan if a share of `bytes` holds them.
    pub(super) fn within(scan: &Scan, bytes: u64) -> Self {
        let needed = bytes_for(scan.vertex_count());
        let fits = scan.layout() == Layout::Indexed && needed <= bytes / SHARE;
        Used(bytemuck::zeroed_vec(if fits { (needed / 8) as usize } else { 0 }))
    }

    /// Bytes that it takes.
    pub(super) fn bytes(&self) -> u64 {
        8 * self.0.len() as u64
    }

    /// Adds a vertex. Nearly all that come are there already, and are not written.
    #[inline(always)]
    pub(super) fn add(&self, vertex: u32) {
        let Some(word) = self.0.get(vertex as usize / 64) else { return };
        let bit = 1 << (vertex % 64);
        if word.load(Relaxed) & bit == 0 {
            word.fetch_or(bit, Relaxed);
        }
    }

    /// What a vertex's bit is in.
    #[inline(always)]
    pub(super) fn word(&self, vertex: u32) -> u64 {
        self.0.get(vertex as usize / 64).map_or(0, |word| word.load(Relaxed))
    }

    /// How many of `vertices` were not added; `None` without an account.
    pub(super) fn unused(&self, vertices: u64) -> Option<u64> {
        let count = || self.0.iter().map(|word| u64::from(word.load(Relaxed).count_ones())).sum::<u64>();
        (!self.0.is_empty()).then(|| vertices - count())
    }
}
