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

/// Words that a worker holds back.
const HELD_BACK: usize = 1024;

/// Bytes of a [`Marker`].
pub(super) const MARKER_BYTES: usize = HELD_BACK * (4 + 64);

/// A worker's end of a [`Used`]. Nothing counts until [`Marker::flush`].
pub(super) struct Marker<'a> {
    used: &'a Used,
    held: Option<Held>,
}

/// Faces that follow one another use the same few words of vertices again and again.
struct Held {
    /// The number of each held word.
    numbers: Box<[u32; HELD_BACK]>,
    /// Held words, a byte a bit: a byte is only ever written. A bit would have to wait for the one before it in its word,
    /// which is most often the one of the corner before.
    bytes: Box<[[u8; 64]; HELD_BACK]>,
}

impl<'a> Marker<'a> {
    /// For faces that are `coherent`, which use the vertices of some [`HELD_BACK`] words for a while, or from anywhere:
    /// nothing is held back of those.
    pub(super) fn new(used: &'a Used, coherent: bool) -> Self {
        let held = || Held { numbers: Box::new([0; HELD_BACK]), bytes: Box::new([[0; 64]; HELD_BACK]) };
        Marker { used, held: coherent.then(held) }
    }

    /// Adds a vertex.
    #[inline(always)]
    pub(super) fn add(&mut self, vertex: u32) {
        let (number, bit) = (vertex / 64, vertex % 64);
        let Some(held) = &mut self.held else { return self.used.add(number, 1 << bit) };
        let slot = number as usize % HELD_BACK;
        if held.numbers[slot] != number {
            held.hand_on(slot, self.used);
            held.numbers[slot] = number;
        }
        held.bytes[slot][bit as usize] = 1;
    }

    /// Hands on all that was held back.
    pub(super) fn flush(&mut self) {
        if let Some(held) = &mut self.held {
            (0..HELD_BACK).for_each(|slot| held.hand_on(slot, self.used));
        }
    }
}

impl Held {
    /// Hands on what was held back of a word.
    #[inline(never)]
    fn hand_on(&mut self, slot: usize, used: &Used) {
        let bytes = std::mem::replace(&mut self.bytes[slot], [0; 64]);
        // Of eight bytes that are 0 or 1, the upmost of the product has the bits.
        let bits = |eight: &[u8; 8]| u64::from_le_bytes(*eight).wrapping_mul(0x0102_0408_1020_4080) >> 56;
        let word = bytes.as_chunks::<8>().0.iter().rev().fold(0, |word, eight| word << 8 | bits(eight));
        used.add(self.numbers[slot], word);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_vertex_that_is_added_counts_once() {
        let used = Used((0..1000).map(|_| AtomicU64::new(0)).collect());
        let vertices: Vec<u32> = (0..64_000u32).filter(|v| v * v % 7 < 3 || v % 1000 > 990).collect();
        let (mut one, mut other) = (Marker::new(&used, true), Marker::new(&used, false));
        for v in vertices.iter().chain(vertices.iter().rev()) {
            if v % 3 == 0 { one.add(*v) } else { other.add(*v) }
        }
        one.flush();
        other.flush();
        assert_eq!(used.unused(64_000), Some(64_000 - vertices.len() as u64));
        for v in 0..64_000 {
            let word = used.0[v as usize / 64].load(Relaxed);
            assert_eq!(word >> (v % 64) & 1 == 1, vertices.binary_search(&v).is_ok(), "{v}");
        }
    }
}
