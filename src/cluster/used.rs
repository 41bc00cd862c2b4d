//! Which vertices faces use: a bit each, where there is room for that, and binned vertices do not note it themselves
//! (`resident.rs`).

use crate::cores::InPieces;
use crate::read::{Layout, Scan};
use rayon::prelude::*;
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

    /// For so many vertices.
    pub(super) fn of(vertices: u64) -> Self {
        // Written, since what is looked at first is mapped twice.
        let words = vertices.div_ceil(64) as usize;
        Used((0..words).into_par_iter().in_pieces(4096).map(|_| AtomicU64::new(0)).collect())
    }

    /// For the vertices of an indexed scan if a share of `bytes` holds them.
    pub(super) fn within(scan: &Scan, bytes: u64) -> Self {
        if Self::bytes_within(scan, bytes) == 0 { Self::nothing() } else { Self::of(scan.vertex_count()) }
    }

    /// Bytes that such an account takes.
    pub(super) fn bytes_within(scan: &Scan, bytes: u64) -> u64 {
        let needed = bytes_for(scan.vertex_count());
        let fits = scan.layout() == Layout::Indexed && needed <= bytes / SHARE;
        if fits { needed } else { 0 }
    }

    /// Adds a vertex.
    #[inline(always)]
    pub(super) fn add(&self, vertex: u32) {
        self.add_bits(vertex as usize / 64, 1 << (vertex % 64));
    }

    /// Adds those vertices, from `first` on, that are marked with 1; others are with 0. The first is the first of a word.
    pub(super) fn add_marked(&self, first: u32, marks: &[u8]) {
        // Of eight bytes that are 0 or 1, the upmost of the product has the bits.
        let bits = |eight: &[u8; 8]| u64::from_le_bytes(*eight).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        for (word, marks) in (first as usize / 64..).zip(marks.as_chunks::<64>().0) {
            self.add_bits(word, marks.as_chunks::<8>().0.iter().rev().fold(0, |word, eight| word << 8 | bits(eight)));
        }
    }

    /// Adds vertices of one word. Nearly all that come are there already, and are not written.
    #[inline(always)]
    fn add_bits(&self, word: usize, bits: u64) {
        let Some(word) = self.0.get(word) else { return };
        if word.load(Relaxed) & bits != bits {
            word.fetch_or(bits, Relaxed);
        }
    }

    /// Whether there is an account.
    pub(super) fn is_kept(&self) -> bool {
        !self.0.is_empty()
    }

    /// How many of `vertices` were not added; `None` without an account.
    pub(super) fn unused(&self, vertices: u64) -> Option<u64> {
        let count = || self.0.iter().map(|word| u64::from(word.load(Relaxed).count_ones())).sum::<u64>();
        self.is_kept().then(|| vertices - count())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_vertex_that_is_added_counts_once() {
        let used = Used::of(64_000);
        let vertices: Vec<u32> = (0..64_000u32).filter(|v| v * v % 7 < 3 || v % 1000 > 990).collect();
        let mut marks = vec![0; 64_000];
        for v in vertices.iter().chain(vertices.iter().rev()) {
            if v % 3 == 0 { marks[*v as usize] = 1 } else { used.add(*v) }
        }
        (0..64_000).step_by(256).zip(marks.chunks(256)).for_each(|(first, marks)| used.add_marked(first, marks));
        assert_eq!(used.unused(64_000), Some(64_000 - vertices.len() as u64));
        for v in 0..64_000 {
            let word = used.0[v as usize / 64].load(Relaxed);
            assert_eq!(word >> (v % 64) & 1 == 1, vertices.binary_search(&v).is_ok(), "{v}");
        }
    }
}
