//! Open borders of the scan, held in place without connectivity.
//!
//! Clustering is a simplicial map, so an edge of the intermediate mesh with an odd number of faces can only come from
//! open border of the scan: it shows which cells hold some. In those cells, each face's directed edges `x₀ → x₁` add
//! `e₁ = Σ (x₁ − x₀)` and `e₂ = Σ x₀ × x₁` (Lindstrom and Silva, *A memory insensitive technique for large model
//! simplification*, 2001): an interior edge is there once each way and cancels, exactly since these are integers, so
//! what is left is border, and `|e₁ × x + e₂|²` is the squared distance from it times its squared length.
//!
//! It costs a second pass over the faces, and only scans with borders pay it; where more cells are open than memory is
//! left for, more such passes.

use super::corners::{Faces, Sink};
use super::grid::{Corner, LOCAL_BITS, STEPS, coordinates, is_far};
use super::sums::Totals;
use super::table::{CellTable, mix};
use crate::mesh::groups::Groups;
use crate::quadric::Quadric;
use glam::DVec3;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};

/// Cells that are looked at together.
const PART: usize = 1 << 12;

/// Cells on an edge with an odd number of faces, as flags by the triples' own numbering. Triples are sorted, and the least
/// cell of each leads it.
pub(super) fn open_cells(triples: &[[u32; 3]], cells: usize) -> Vec<bool> {
    // Edges by their lesser end: of a cell these are two of each triple that it leads, and among those of others' what the
    // two that do not lead have between them.
    let mut between = Groups::default();
    between.rebuild(cells, triples.len(), |range| triples[range].iter().map(|&[_, b, c]| (b.min(c), b.max(c))));
    let open_from = |first: usize| {
        let (mut found, mut ends) = (Vec::new(), Vec::new());
        let mut led = &triples[triples.partition_point(|triple| (triple[0] as usize) < first)..];
        for cell in first as u32..(first + PART).min(cells) as u32 {
            let (own, later) = led.split_at(led.iter().take_while(|triple| triple[0] == cell).count());
            led = later;
            let all =
                own.iter().flat_map(|triple| [triple[1], triple[2]]).chain(between.of(cell as usize).iter().copied());
            // Ends that are there an even number of times cancel. Of most cells all do, and nothing is to be sorted.
            if all.clone().fold(0, |odd, end| odd ^ mix(end.into())) == 0 {
                continue;
            }
            ends.clear();
            ends.extend(all);
            ends.sort_unstable();
            for same in ends.chunk_by(|u, v| u == v).filter(|same| same.len() % 2 == 1) {
                found.extend([cell, same[0]]);
            }
        }
        found
    };
    let parts = (0..cells).into_par_iter().step_by(PART).with_max_len(1);
    let found: Vec<Vec<u32>> = parts.map(open_from).collect();
    let mut open = vec![false; cells];
    found.into_iter().flatten().for_each(|cell| open[cell as usize] = true);
    open
}

/// Ranges of ranks that hold at most `most` open cells each, and all of those together.
pub(super) fn shares(open: &[bool], most: usize) -> Vec<Range<u32>> {
    let mut shares = Vec::new();
    let (mut first, mut held) = (0, 0);
    for (rank, _) in open.iter().enumerate().filter(|(_, open)| **open) {
        if held == most {
            shares.push(first..rank as u32);
            (first, held) = (rank as u32, 0);
        }
        held += 1;
    }
    if held > 0 {
        shares.push(first..open.len() as u32);
    }
    shares
}

/// Cells without border.
const CLOSED: u32 = u32::MAX;

/// The border sums of all open cells.
pub(super) struct Borders {
    /// Each cell's place in `sums`, or [`CLOSED`].
    slots: Vec<u32>,
    /// `e₁` and `e₂` in steps, about the cell's least corner, modulo 2⁶⁴.
    sums: Vec<[AtomicI64; 6]>,
}

/// Bytes a cell, and for each open one more, of [`Borders`].
pub(super) const BYTES_A_CELL: usize = 4;
pub(super) const BYTES_AN_OPEN_CELL: usize = size_of::<[AtomicI64; 6]>();

impl Borders {
    /// Sums of zero for the cells whose `ranks` are open and in `share`.
    pub(super) fn new(open: &[bool], ranks: &[u32], share: Range<u32>) -> Self {
        let mut next = 0;
        let mut slot = |rank: &u32| {
            if !share.contains(rank) || !open[*rank as usize] {
                return CLOSED;
            }
            next += 1;
            next - 1
        };
        let slots: Vec<u32> = ranks.iter().map(&mut slot).collect();
        Borders { slots, sums: bytemuck::zeroed_vec(next as usize) }
    }

    /// Adds the edge between two positions in steps from the least corner of a cell.
    fn add(&self, slot: u32, from: [i64; 3], to: [i64; 3]) {
        let minor = |i: usize, j: usize| i64::wrapping_sub(from[i].wrapping_mul(to[j]), from[j].wrapping_mul(to[i]));
        let e = [to[0] - from[0], to[1] - from[1], to[2] - from[2], minor(1, 2), minor(2, 0), minor(0, 1)];
        for (sum, x) in self.sums[slot as usize].iter().zip(e) {
            sum.fetch_add(x, Relaxed);
        }
    }

    /// Adds each open cell's border to its sums with some weight, in quanta of `quantum` cells².
    pub(super) fn add_to(&self, totals: &mut Totals, weight: f64, quantum: f64) {
        for (cell, slot) in self.slots.iter().enumerate().filter(|(_, slot)| **slot != CLOSED) {
            let q = self.quadric(*slot);
            let [xx, xy, xz, yy, yz, zz] = q.a;
            let lanes = [xx, xy, xz, q.b.x, yy, yz, q.b.y, zz, q.b.z, q.c, 0.0, 0.0, 0.0, 0.0];
            totals.add(cell as u32, lanes.map(|x| (x * (weight / quantum)).round() as i64));
        }
    }

    /// `|e₁ × x + e₂|²` about the centre of a cell, lengths in cells.
    fn quadric(&self, slot: u32) -> Quadric {
        let [a, b, c, d, e, f] = self.sums[slot as usize].each_ref().map(|x| x.load(Relaxed) as f64);
        let e1 = DVec3::new(a, b, c) / STEPS;
        let e2 = DVec3::new(d, e, f) / (STEPS * STEPS) + e1.cross(DVec3::splat(0.5));
        let (n, m) = (e1.length_squared(), e1);
        let a = [n - m.x * m.x, -m.x * m.y, -m.x * m.z, n - m.y * m.y, -m.y * m.z, n - m.z * m.z];
        Quadric { a, b: e2.cross(e1), c: e2.length_squared(), w: 0.0 }
    }
}

/// One worker of the border pass.
pub(super) struct BorderWorker<'a> {
    pub(super) table: &'a CellTable,
    pub(super) borders: &'a Borders,
}

impl BorderWorker<'_> {
    #[cold]
    fn add(&self, face: [Corner; 3], slots: [u32; 3]) {
        let keys = face.map(|corner| self.table.key(corner.cell()));
        let at = keys.map(coordinates);
        let place = |corner: usize, about: usize| -> [i64; 3] {
            let local = face[corner].local();
            std::array::from_fn(|k| ((at[corner][k] - at[about][k]) << LOCAL_BITS) + i64::from(local[k]))
        };
        for (from, to) in [(0, 1), (1, 2), (2, 0)] {
            // An edge that leads far away is left out wherever it occurs: its products would overflow.
            if is_far(keys[from] | keys[to]) {
                continue;
            }
            if slots[from] != CLOSED {
                self.borders.add(slots[from], place(from, from), place(to, from));
            }
            if slots[to] != CLOSED && slots[to] != slots[from] {
                self.borders.add(slots[to], place(from, to), place(to, to));
            }
        }
    }
}

impl Sink for BorderWorker<'_> {
    fn take(&mut self, [a, b, c]: Faces, _: usize) {
        for ((a, b), c) in a.iter().zip(b).zip(c) {
            let face = [*a, *b, *c];
            let slots = face.map(|corner| self.borders.slots[corner.cell() as usize]);
            if slots != [CLOSED; 3] {
                self.add(face, slots);
            }
        }
    }
}
