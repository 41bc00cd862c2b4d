//! Binned vertices in memory, 8 bytes each.
//!
//! A face's corners are looked up here, and that it has these vertices is noted in the same words, for which nothing else
//! has to be brought near: with a set of bits beside them clustering took 5 to 12 % longer. The bit is a cell number's
//! highest, so that is done where cells are few enough to leave it free.

use super::grid::Corner;
use super::pages::Pages;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use zerocopy::transmute_mut;

/// Set in the word of a vertex that a face has.
const USED: u64 = 1 << 63;

/// Numbers of so many cells leave [`USED`] free, and set it makes no corner [`Corner::NOWHERE`]: that would be one more.
const FEW_CELLS: usize = (1 << 24) - 1;

/// One [`Corner`] a vertex.
pub(super) struct Resident {
    words: Pages<u64>,
    /// [`USED`], or nothing.
    mark: u64,
}

/// The same while workers write to them, or ask for them.
#[derive(Clone, Copy)]
pub(super) struct Binned<'a> {
    words: &'a [AtomicU64],
    mark: u64,
}

impl Resident {
    /// Room for so many vertices, which faces have in a sensible order or in none. Fails if there is no memory.
    pub(super) fn of(vertices: u64, coherent: bool) -> std::io::Result<Self> {
        Ok(Resident { words: Pages::zeroed(vertices as usize, coherent)?, mark: 0 })
    }

    /// Opens them to workers.
    pub(super) fn open(&mut self) -> Binned<'_> {
        Binned { words: transmute_mut!(&mut *self.words), mark: self.mark }
    }

    /// All are written, and in so many cells. From now on vertices that faces have are noted, if that can be.
    pub(super) fn close(&mut self, cells: usize) {
        self.mark = if cells <= FEW_CELLS { USED } else { 0 };
    }

    /// Whether they are noted.
    pub(super) fn notes_used(&self) -> bool {
        self.mark != 0
    }

    /// How many vertices no face has, if they are noted. No face has one that is nowhere: that is an error.
    pub(super) fn unused(&self) -> Option<u64> {
        let is_unused = |word: u64| u64::from(word & USED == 0 || word == Corner::NOWHERE.0);
        let count = |words: &[u64]| words.iter().map(|word| is_unused(*word)).sum::<u64>();
        self.notes_used().then(|| self.words.par_chunks(1 << 14).map(count).sum())
    }
}

impl Binned<'_> {
    /// Stores the corners of consecutive vertices.
    pub(super) fn write(self, first: u64, corners: &[Corner]) {
        for (word, corner) in self.words[first as usize..].iter().zip(corners) {
            word.store(corner.0, Relaxed);
        }
    }

    /// The corner of a vertex that a face has.
    #[inline(always)]
    pub(super) fn corner(self, vertex: u32) -> Corner {
        let word = &self.words[vertex as usize];
        let found = word.load(Relaxed);
        // Whoever else stores at the same time stores the same. Most vertices are noted already, but which are is as good
        // as random.
        word.store(found | self.mark, Relaxed);
        if found == Corner::NOWHERE.0 { Corner::NOWHERE } else { Corner(found & !self.mark) }
    }

    /// Has corners that lie anywhere brought near, so that the waits for them overlap.
    #[inline(always)]
    pub(super) fn fetch(self, triangles: &[[u32; 3]]) {
        let near = |bits: u64, v: &u32| bits | self.words[*v as usize].load(Relaxed);
        std::hint::black_box(triangles.as_flattened().iter().fold(0, near));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_corner_is_what_was_written_and_those_that_are_not_asked_for_are_unused() {
        for cells in [FEW_CELLS, FEW_CELLS + 1] {
            let mut corners: Vec<Corner> =
                (0..50_000u32).map(|v| Corner::at(v * 331 % cells as u32, v.into())).collect();
            corners[7] = Corner::at(cells as u32 - 1, (1 << 39) - 1);
            corners[8] = Corner::NOWHERE;
            let mut resident = Resident::of(corners.len() as u64, cells == FEW_CELLS).unwrap();
            assert!(resident.words.iter().all(|word| *word == 0));
            resident.open().write(20, &corners[20..]);
            resident.open().write(0, &corners[..20]);
            resident.close(cells);
            assert_eq!(resident.notes_used(), cells == FEW_CELLS);
            resident.open().fetch(&[[0, 8, 49_999]]);
            for _ in 0..2 {
                let asked = (0..50_000u32).filter(|v| v % 5 != 3);
                let binned = resident.open();
                assert!(asked.into_iter().all(|v| binned.corner(v) == corners[v as usize]));
                assert_eq!(resident.unused(), (cells == FEW_CELLS).then_some(10_000));
            }
            assert_eq!(resident.open().corner(8), Corner::NOWHERE);
        }
    }
}
