//! Which vertices faces use: a bit each, where there is room for that.

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

    /// For the vertices of an indexed scan if a share of `bytes` holds them.
    pub(super) fn within(scan: &Scan, bytes: u64) -> Self {
        // Written, since what is looked at first is mapped twice.
        let words = (Self::bytes_within(scan, bytes) / 8) as usize;
        Used((0..words).into_par_iter().in_pieces(4096).map(|_| AtomicU64::new(0)).collect())
    }

    /// Bytes that such an account takes.
    pub(super) fn bytes_within(scan: &Scan, bytes: u64) -> u64 {
        let needed = bytes_for(scan.vertex_count());
        let fits = scan.layout() == Layout::Indexed && needed <= bytes / SHARE;
        if fits { needed } else { 0 }
    }

    /// Adds vertices of one word. Nearly all that come are there already, and are not written.
    #[inline(always)]
    fn add(&self, word: u32, bits: u64) {
        let Some(word) = self.0.get(word as usize) else { return };
        if word.load(Relaxed) & bits != bits {
            word.fetch_or(bits, Relaxed);
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

/// Words that a worker holds back.
const HELD_BACK: usize = 256;

/// Bytes of a [`Marker`].
pub(super) const MARKER_BYTES: usize = HELD_BACK * 12;

/// A worker's end of a [`Used`]: faces that follow one another use the same few words of vertices again and again.
/// Nothing counts until [`Marker::flush`].
pub(super) struct Marker<'a> {
    used: &'a Used,
    /// The number of each held word.
    numbers: Box<[u32; HELD_BACK]>,
    words: Box<[u64; HELD_BACK]>,
}

impl<'a> Marker<'a> {
    pub(super) fn new(used: &'a Used) -> Self {
        Marker { used, numbers: Box::new([0; HELD_BACK]), words: Box::new([0; HELD_BACK]) }
    }

    /// Adds a vertex.
    #[inline(always)]
    pub(super) fn add(&mut self, vertex: u32) {
        let number = vertex / 64;
        let slot = number as usize % HELD_BACK;
        if self.numbers[slot] != number {
            self.used.add(self.numbers[slot], std::mem::take(&mut self.words[slot]));
            self.numbers[slot] = number;
        }
        self.words[slot] |= 1 << (vertex % 64);
    }

    /// Hands on all that was held back.
    pub(super) fn flush(&mut self) {
        for (number, word) in self.numbers.iter().zip(&mut *self.words) {
            self.used.add(*number, std::mem::take(word));
        }
    }
}
