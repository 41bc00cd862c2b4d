//! What each cell learns from its faces: a quadric and first moments, in integers.
//!
//! A cell's sums are 14 numbers in fixed point about the cell's centre, with the cell's side as unit of length: `A`
//! (6), `b` (3), `c`, `w` and `Σ w·p` (3). Integers make the sums independent of the order of faces, of the threads
//! and of how a scan is cut up. With a unit normal, a plane through a point of the cell and |p| ≤ ½, no lane of a
//! contribution is larger than its weight, so one comparison of weights guards all 14 against overflow of their 32
//! bits; a line that would overflow moves to a side table of 64-bit sums. Which cells have a line there is decided by
//! their weight alone.
//!
//! Lines are 64 bytes. A lock for each would cost more than adding to it does, so one lock is for a *region* of cells, and
//! workers wait until they have some contributions to one. Where faces come in scan order they hit the same cell many times
//! in a row: each worker gathers these in a small write-back cache first.

use super::pages::Pages;
use super::shares::{LANES, PADDED, PADDED_WEIGHT, Plane, Shares, TOGETHER, padded, quanta, row};
use crate::cores::InPieces;
use fearless_simd::{Simd, i32x16, prelude::*};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// Largest weight of a line, with some room for the rounding of single contributions.
const LIMIT: i64 = (1 << 31) - (1 << 20);
/// Largest weight of one contribution: 2¹⁴ of them do not overflow a side sum. A face of that weight has thousands of
/// times the area that the whole scan was estimated to have.
const HEAVIEST: f32 = (1u64 << 48) as f32;

/// Regions that cells are in; each has a lock. Half as many are no faster with two workers, and more workers would wait for
/// one another.
const REGIONS: usize = 16;
/// Cells that follow one another in a region before it is the next one's turn, so that workers who are in the same part of
/// a scan seldom wait for one another.
const TURN: usize = 16;
/// Contributions to a region that wait for one another, so that locks do not count, and waits for memory overlap. With half
/// as many in twice the regions, clustering takes 4 to 5 % longer where vertices are shuffled.
const WAITING: usize = 64;

/// Lines in a worker's cache: 256 KiB, which stays in the second-level cache, and holds the cells of most buckets: of half
/// of them, faces in no order take a tenth longer.
const CACHED: usize = 4096;
/// The owner of an empty line.
const NOBODY: u32 = u32::MAX;

/// One cell in so many may have sums in the side table, which takes about 150 bytes for each while it grows.
const ASIDE: usize = 32;
/// Bytes of the side table for each cell.
const SIDE_BYTES: usize = 5;

/// Bytes of sums for so many cells.
pub(super) const fn bytes_for(cells: usize) -> usize {
    cells * (size_of::<Line>() + SIDE_BYTES)
}

/// Bytes of a worker's cache, and of what it is about to add.
pub(super) const CACHE_BYTES: usize =
    CACHED * (size_of::<Line>() + size_of::<Owner>()) + REGIONS * size_of::<Waiting>();

/// A cell's sums, or what is added to them, in the order of a contribution.
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct Line([i32; PADDED]);

/// The sums of all cells.
pub(super) struct Totals {
    /// One region's after the other.
    lines: Pages<Line>,
    side: FxHashMap<u32, [i64; LANES]>,
}

/// The same while workers add to them.
pub(super) struct Sums<'a> {
    /// The lines of each region.
    regions: Vec<Mutex<&'a mut [Line]>>,
    side: Mutex<&'a mut FxHashMap<u32, [i64; LANES]>>,
    /// Cells that may have sums there.
    most_aside: usize,
    overflowed: AtomicBool,
}

/// 2^52 + 2^51: adding it leaves a double's nearest integer in the low bits of its mantissa, sign included.
const ROUNDER: f64 = 6_755_399_441_055_744.0;

/// A worker's access to the sums. Nothing counts until [`Gatherer::flush`].
pub(super) struct Gatherer<'a> {
    cache: Box<[Line; CACHED]>,
    owners: Box<[Owner; CACHED]>,
    leaving: Leaving<'a>,
}

/// Whose a cached line is, and what weight is in it: apart from the line, which is on its way to memory whenever its
/// cell comes twice in a row.
#[derive(Clone, Copy)]
struct Owner {
    cell: u32,
    weight: u32,
}

impl<'a> Gatherer<'a> {
    pub(super) fn new(sums: &'a Sums<'a>) -> Self {
        let cache = Box::new([Line([0; PADDED]); CACHED]);
        let owners = Box::new([Owner { cell: NOBODY, weight: 0 }; CACHED]);
        Gatherer { cache, owners, leaving: Leaving::new(sums) }
    }

    /// Adds shares in `planes` to their cells, by way of the cache: for faces whose neighbours come next. `weights` are those
    /// of the planes, rounded.
    #[inline(always)]
    pub(super) fn add<V: Simd, const P: usize, const MOST: usize>(
        &mut self,
        simd: V,
        (planes, weights): (&[Plane; P], &[i32; P]),
        shares: &Shares<MOST>,
    ) {
        for first in (0..shares.count).step_by(TOGETHER) {
            let quanta = quanta(simd, planes, shares, first);
            let some = first..shares.count.min(first + TOGETHER);
            for (at, quanta) in some.zip(&quanta) {
                let (cell, plane) = (shares.cells[at], usize::from(shares.planes[at]) % P);
                let place = cell as usize % CACHED;
                let (line, owner) = (&mut self.cache[place].0, &mut self.owners[place]);
                // Neither is negative or beyond 31 bits.
                let (before, weight) = (owner.weight, weights[plane].cast_unsigned());
                owner.weight = before + weight;
                if (owner.cell != cell) | (owner.weight > LIMIT as u32) {
                    if i64::from(weight) > LIMIT {
                        owner.weight = before;
                        self.leaving.sums.add_wide(cell, &planes[plane], shares.places[at]);
                        continue;
                    }
                    self.leaving.put(owner.cell, line);
                    *owner = Owner { cell, weight };
                    *line = [0; PADDED];
                }
                (i32x16::load_array_ref(simd, line) + i32x16::load_array_ref(simd, quanta)).store_array(line);
            }
        }
    }

    /// Adds shares in `planes` to their cells without the cache: for faces from anywhere.
    #[inline(always)]
    pub(super) fn add_apart<V: Simd, const P: usize, const MOST: usize>(
        &mut self,
        simd: V,
        (planes, weights): (&[Plane; P], &[i32; P]),
        shares: &Shares<MOST>,
    ) {
        for first in (0..shares.count).step_by(TOGETHER) {
            let quanta = quanta(simd, planes, shares, first);
            for (at, quanta) in (first..shares.count).zip(&quanta) {
                let (cell, plane) = (shares.cells[at], usize::from(shares.planes[at]) % P);
                match i64::from(weights[plane]) > LIMIT {
                    true => self.leaving.sums.add_wide(cell, &planes[plane], shares.places[at]),
                    false => self.leaving.put(cell, quanta),
                }
            }
        }
    }

    /// Hands all that was gathered to the sums.
    pub(super) fn flush(&mut self) {
        for (line, owner) in self.cache.iter_mut().zip(&mut *self.owners) {
            self.leaving.put(owner.cell, &line.0);
            (line.0, *owner) = ([0; PADDED], Owner { cell: NOBODY, weight: 0 });
        }
        self.leaving.flush();
    }
}

/// What a worker is about to add to the sums.
struct Leaving<'a> {
    sums: &'a Sums<'a>,
    /// To each region.
    waiting: Vec<Waiting>,
}

/// Contributions to one region.
#[derive(Clone)]
struct Waiting {
    lines: [Line; WAITING],
    cells: [u32; WAITING],
    count: usize,
}

impl<'a> Leaving<'a> {
    fn new(sums: &'a Sums<'a>) -> Self {
        let none = Waiting { lines: [Line([0; PADDED]); WAITING], cells: [NOBODY; WAITING], count: 0 };
        Leaving { sums, waiting: vec![none; REGIONS] }
    }

    /// Takes what is to be added to a cell, if it is one.
    #[inline(always)]
    fn put(&mut self, cell: u32, line: &[i32; PADDED]) {
        if cell == NOBODY {
            return;
        }
        let waiting = &mut self.waiting[region(cell)];
        let at = waiting.count % WAITING;
        (waiting.lines[at].0, waiting.cells[at]) = (*line, cell);
        waiting.count += 1;
        if waiting.count == WAITING {
            self.sums.add(waiting);
        }
    }

    fn flush(&mut self) {
        self.waiting.iter_mut().for_each(|waiting| self.sums.add(waiting));
    }
}

/// A contribution's or a line's lanes without the unused ones.
#[inline(always)]
fn unpad(lanes: &[i32; PADDED]) -> [i64; LANES] {
    std::array::from_fn(|lane| lanes[padded(lane)].into())
}

/// The region that a cell is in.
#[inline(always)]
fn region(cell: u32) -> usize {
    cell as usize / TURN % REGIONS
}

/// Which of the region's lines is the cell's.
#[inline(always)]
fn place_in_region(cell: u32) -> usize {
    cell as usize / (TURN * REGIONS) * TURN + cell as usize % TURN
}

/// Where a region's lines begin among those of so many cells; behind the last region, their end.
#[inline(always)]
fn begin(region: usize, cells: usize) -> usize {
    const ROUND: usize = TURN * REGIONS;
    cells / ROUND * TURN * region + (TURN * region).min(cells % ROUND)
}

impl<'a> Sums<'a> {
    /// Opens `totals` to workers: what they add is there once all have flushed.
    pub(super) fn of(totals: &'a mut Totals) -> Self {
        let cells = totals.lines.len();
        let most_aside = cells / ASIDE + 1024;
        let mut rest = &mut *totals.lines;
        let mut next = |region: usize| {
            let (lines, later) =
                std::mem::take(&mut rest).split_at_mut(begin(region + 1, cells) - begin(region, cells));
            rest = later;
            Mutex::new(lines)
        };
        let regions = (0..REGIONS).map(&mut next).collect();
        Sums { regions, side: Mutex::new(&mut totals.side), most_aside, overflowed: AtomicBool::new(false) }
    }

    /// Whether more cells have outgrown their lines than there is room for: a larger unit of weight is needed.
    pub(super) fn overflowed(&self) -> bool {
        self.overflowed.load(Relaxed)
    }

    /// Adds what waits.
    #[inline(never)]
    fn add(&self, waiting: &mut Waiting) {
        let count = std::mem::take(&mut waiting.count).min(WAITING);
        let (cells, lines) = (&waiting.cells[..count], &waiting.lines[..count]);
        let Some(first) = cells.first() else { return };
        // A worker that panicked has left nothing half done here: lanes are added without a call that could.
        let mut region = self.regions[region(*first)].lock().unwrap_or_else(PoisonError::into_inner);
        fetch(cells.iter().map(|cell| &region[place_in_region(*cell)]));
        for (cell, Line(extra)) in cells.iter().zip(lines) {
            let Line(sums) = &mut region[place_in_region(*cell)];
            if i64::from(sums[PADDED_WEIGHT]) + i64::from(extra[PADDED_WEIGHT]) > LIMIT {
                self.add_aside(*cell, &unpad(sums));
                *sums = *extra;
            } else {
                sums.iter_mut().zip(extra).for_each(|(sum, x)| *sum = sum.wrapping_add(*x));
            }
        }
    }

    /// Adds what a plane adds that does not fit 32 bits.
    #[cold]
    fn add_wide(&self, cell: u32, plane: &Plane, place: u64) {
        let row = row(plane, plane.weight().min(HEAVIEST), place);
        let rounded = |x: f32| ((f64::from(x) + ROUNDER).to_bits() as i64).wrapping_sub(ROUNDER.to_bits() as i64);
        self.add_aside(cell, &std::array::from_fn(|lane| rounded(row[padded(lane)])));
    }

    #[cold]
    fn add_aside(&self, cell: u32, lanes: &[i64; LANES]) {
        let mut side = self.side.lock().unwrap_or_else(PoisonError::into_inner);
        if side.len() > self.most_aside {
            return self.overflowed.store(true, Relaxed);
        }
        let sums = side.entry(cell).or_insert([0; LANES]);
        for (sum, x) in sums.iter_mut().zip(lanes) {
            *sum = sum.wrapping_add(*x);
        }
    }
}

/// Brings lines near, so that the waits for them overlap.
#[inline(always)]
fn fetch<'a>(lines: impl Iterator<Item = &'a Line>) {
    std::hint::black_box(lines.fold(0, |all, line| all | line.0[0]));
}

impl Totals {
    /// Sums of zero for `cells` cells, which faces touch in a sensible order or in none. Fails if there is no memory.
    pub(super) fn new(cells: usize, coherent: bool) -> std::io::Result<Self> {
        let mut lines = Pages::zeroed(cells, coherent)?;
        // Written, since what is looked at first is mapped twice.
        lines.par_iter_mut().in_pieces(4096).for_each(|line| *line = Line([0; PADDED]));
        Ok(Totals { lines, side: FxHashMap::default() })
    }

    fn place(&self, cell: u32) -> usize {
        begin(region(cell), self.lines.len()) + place_in_region(cell)
    }

    /// Brings cells' sums near, for those who ask for all of them next.
    pub(super) fn fetch(&self, cells: &[u32]) {
        fetch(cells.iter().map(|cell| &self.lines[self.place(*cell)]));
    }

    /// A cell's sums, in the order of [`LANES`].
    pub(super) fn of(&self, cell: u32) -> [i64; LANES] {
        let mut total = unpad(&self.lines[self.place(cell)].0);
        if let Some(aside) = self.side.get(&cell) {
            for (sum, x) in total.iter_mut().zip(aside) {
                *sum = sum.wrapping_add(*x);
            }
        }
        total
    }

    /// Adds to a cell's sums.
    pub(super) fn add(&mut self, cell: u32, extra: [i64; LANES]) {
        let place = self.place(cell);
        let Line(line) = &mut self.lines[place];
        let before = unpad(line);
        let sums: [i64; LANES] = std::array::from_fn(|lane| before[lane] + extra[lane]);
        if sums.iter().all(|x| i32::try_from(*x).is_ok()) {
            sums.iter().enumerate().for_each(|(lane, x)| line[padded(lane)] = *x as i32);
        } else {
            let aside = self.side.entry(cell).or_insert([0; LANES]);
            *aside = std::array::from_fn(|lane| aside[lane].wrapping_add(extra[lane]));
        }
    }

    /// Cells that outgrew their line.
    pub(super) fn outgrown(&self) -> usize {
        self.side.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cluster::grid::FIELD_BITS;
    use crate::cluster::shares::{ONE_CORNER, WEIGHT};
    use crate::vectors::levels;
    use fearless_simd::{Level, dispatch};
    use glam::Vec3;

    /// A share by itself: its plane, its cell and its place.
    type Share = (Plane, u32, u64);

    fn shares(count: u64) -> Vec<Share> {
        let mut state = 7u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f32 / (1u64 << 31) as f32
        };
        (0..count)
            .map(|i| {
                let n = Vec3::new(random() - 0.5, random() - 0.5, random() - 0.5).normalize_or_zero();
                // Every tenth outgrows a line at once, cell 3 by and by.
                let w = if i % 10 == 0 { 3e9 } else { 2e7 } * random() + 1.0;
                let corners = 1 + i % 3;
                let places = (0..3).fold(0, |all, _| (all << FIELD_BITS) + (8191.0 * random()) as u64 * corners);
                let cell = (random() * 5000.0) as u32 % if i % 3 == 0 { 4 } else { 5000 };
                (Plane(n.extend(w).to_array()), cell, places + corners * ONE_CORNER)
            })
            .collect()
    }

    /// What a share adds, lane by lane.
    fn lanes_of((plane, _, place): &Share) -> [f32; LANES] {
        let [x, y, z, w] = plane.0;
        let [px, py, pz, corners] = [0, 16, 32, 48].map(|shift| f32::from((place >> shift) as u16));
        let p = [px, py, pz].map(|sum| sum * (1.0 / (corners * 8192.0)) - 0.5);
        let u = [x, y, z, -((x * p[0] + y * p[1]) + z * p[2])];
        let m = u.map(|x| x * w);
        let quadric = [(0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (3, 3)];
        std::array::from_fn(|i| match i {
            ..WEIGHT => u[quadric[i].0] * m[quadric[i].1],
            WEIGHT => w,
            _ => p[i - WEIGHT - 1] * w,
        })
    }

    #[inline(always)]
    fn gather_some<V: Simd>(simd: V, gatherer: &mut Gatherer, some: &[Share], turn: usize) {
        const P: usize = 100;
        let (mut planes, mut weights, mut shares) = ([Plane::default(); P], [0; P], Shares::<{ P + TOGETHER }>::new());
        for (i, (plane, cell, place)) in some.iter().enumerate() {
            planes[i] = *plane;
            weights[i] = plane.weight().round_ties_even() as i32;
            shares.put_if(false, 0, 0, 0);
            shares.put_if(true, *cell, *place, i);
        }
        match turn % 2 {
            0 => gatherer.add(simd, (&planes, &weights), &shares),
            _ => gatherer.add_apart(simd, (&planes, &weights), &shares),
        }
    }

    fn gather(level: Level, shares: &[Share], workers: usize) -> (Vec<[i64; LANES]>, usize) {
        let mut totals = Totals::new(5000, true).unwrap();
        let sums = Sums::of(&mut totals);
        std::thread::scope(|scope| {
            for part in shares.chunks(shares.len().div_ceil(workers)) {
                let sums = &sums;
                scope.spawn(move || {
                    let mut gatherer = Gatherer::new(sums);
                    for (turn, some) in part.chunks(100).enumerate() {
                        dispatch!(level, simd => gather_some(simd, &mut gatherer, some, turn));
                    }
                    gatherer.flush();
                });
            }
        });
        ((0..5000).map(|cell| totals.of(cell)).collect(), totals.outgrown())
    }

    #[test]
    fn sums_are_exact_whatever_the_order_and_the_threads() {
        let mut shares = shares(30_000);
        let mut expected = vec![[0i64; LANES]; 5000];
        for share in &shares {
            for (sum, x) in expected[share.1 as usize].iter_mut().zip(lanes_of(share)) {
                *sum += x.round_ties_even() as i64;
            }
        }
        for level in levels() {
            let (one, outgrown) = gather(level, &shares, 1);
            assert_eq!(one, expected);
            assert!(outgrown >= 4, "the side table was not used: {outgrown}");
            shares.reverse();
            let (three, outgrown_by_three) = gather(level, &shares, 3);
            assert_eq!(three, expected);
            assert_eq!(outgrown, outgrown_by_three);
        }
    }

    #[test]
    fn every_cell_has_a_line_of_its_own() {
        for cells in [0, 1, 17, 511, 512, 513, 5000] {
            let mut totals = Totals::new(cells as usize, false).unwrap();
            let mut places: Vec<usize> = (0..cells).map(|cell| totals.place(cell)).collect();
            places.sort_unstable();
            assert!(places.into_iter().eq(0..cells as usize));
            let lengths: Vec<usize> = Sums::of(&mut totals).regions.iter().map(|r| r.lock().unwrap().len()).collect();
            assert!((0..cells).all(|cell| place_in_region(cell) < lengths[region(cell)]), "{cells}");
        }
    }

    #[test]
    fn a_line_is_a_cache_line() {
        assert_eq!(size_of::<Line>(), 64);
    }

    #[test]
    fn no_lane_exceeds_the_weight() {
        for share in shares(10_000) {
            assert!(lanes_of(&share).iter().all(|x| x.abs() <= share.0.weight() * (1.0 + 1e-6)));
        }
    }
}
