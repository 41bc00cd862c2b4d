//! What each cell learns from its faces: a quadric and first moments, in integers.
//!
//! A cell's sums are 14 numbers in fixed point about the cell's centre, with the cell's side as unit of length: `A`
//! (6), `b` (3), `c`, `w` and `Σ w·p` (3). Integers make the sums independent of the order of faces, of the threads
//! and of how a scan is cut up. With a unit normal, a plane through a point of the cell and |p| ≤ ½, no lane of a
//! contribution is larger than its weight, so one comparison of weights guards all 14 against overflow of their 32
//! bits; a line that would overflow moves to a side table of 64-bit sums. Which cells have a line there is decided by
//! their weight alone.
//!
//! Lines are 64 bytes with their lock. Locking one for every contribution would cost more than the arithmetic, so each
//! worker gathers in a small write-back cache first: faces in scan order hit the same cell many times in a row.

use super::grid::STEPS;
use crate::cores::InPieces;
use glam::{Vec3, Vec4, Vec4Swizzles};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use wide::{f32x4, i32x4};

/// Lanes of a cell's sums: `Axx Axy Axz bx Ayy Ayz by Azz bz c w Σwx Σwy Σwz`.
pub(super) const LANES: usize = 14;
/// The lane of the weight.
const WEIGHT: usize = 10;
/// Lanes of a contribution, so that four vectors make it: the same before the weight, two unused, `Σwx Σwy Σwz w`.
const PADDED: usize = 16;
/// The lane of a contribution's weight.
const PADDED_WEIGHT: usize = PADDED - 1;
/// Largest weight of a line, with some room for the rounding of single contributions.
const LIMIT: i64 = (1 << 31) - (1 << 20);
/// Largest weight of one contribution: 2¹⁴ of them do not overflow a side sum. A face of that weight has thousands of
/// times the area that the whole scan was estimated to have.
const HEAVIEST: f32 = (1u64 << 48) as f32;

/// Shares whose lines are fetched together: few enough for the first-level cache.
const AT_ONCE: usize = 64;

/// Lines in a worker's cache: 128 KiB, which stays in the second-level cache.
const CACHED: usize = 2048;
/// The owner of an empty line.
const NOBODY: u32 = u32::MAX;

/// Bytes of a cell's line.
pub(super) const LINE_BYTES: usize = size_of::<Line>();
/// One cell in so many may have sums in the side table, which takes about 150 bytes for each while it grows.
const ASIDE: usize = 32;
/// Bytes of the side table for each cell.
pub(super) const SIDE_BYTES: usize = 5;
/// Bytes of a worker's cache.
pub(super) const CACHE_BYTES: usize = CACHED * (size_of::<Cached>() + 4);

#[derive(Default)]
#[repr(align(64))]
struct Line(Mutex<[i32; LANES]>);

/// The sums of all cells.
pub(super) struct Sums {
    lines: Vec<Line>,
    side: Mutex<FxHashMap<u32, [i64; LANES]>>,
    overflowed: AtomicBool,
}

/// A face's unit normal (zero for one without area), and its weight in quanta, which is at least 1.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Plane(pub(super) [f32; 4]);

impl Plane {
    /// The unit normal.
    pub(super) fn normal(&self) -> Vec3 {
        Vec4::from(self.0).truncate()
    }

    #[inline(always)]
    fn weight(&self) -> f32 {
        self.0[3]
    }
}

/// One face's share in a cell: the mean of those corners that are in it, and which of some planes goes through it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Share {
    /// The sum of the corners' places in steps from the cell's least corner, and 0.
    sum: [i32; 4],
    cell: u32,
    plane: u16,
    corners: u16,
}

/// What sums of so many places are to be multiplied by for their mean in cells.
const MEAN: [f32; 4] = [0.0, 1.0 / STEPS as f32, 1.0 / (2.0 * STEPS as f32), 1.0 / (3.0 * STEPS as f32)];
/// From a cell's least corner to its centre; and 1, which is where the weight is to be.
const CENTRE: f32x4 = f32x4::new([-0.5, -0.5, -0.5, 1.0]);

impl Share {
    /// In the cell of one to three `corners`, whose places' fields add up to `sum`.
    #[inline(always)]
    pub(super) fn new(cell: u32, plane: usize, sum: u64, corners: u16) -> Self {
        // The first two apart by a word's half, so that they are stored together.
        let low = sum & 0xffff | (sum & 0xffff_0000) << 16;
        let sum = [low as i32, (low >> 32) as i32, (sum >> 32) as i32, 0];
        Share { sum, cell, plane: plane as u16, corners }
    }

    /// What the plane with `weight` through the share's place adds, in quanta: about the cell's centre, lengths in
    /// cells. Single precision is finer than the rounding to quanta that follows.
    #[inline(always)]
    fn lanes(&self, plane: &Plane, weight: f32) -> [Vec4; PADDED / 4] {
        let mean = f32x4::splat(MEAN[usize::from(self.corners) % MEAN.len()]);
        let place = Vec4::from((i32x4::from(self.sum).round_float() * mean + CENTRE).to_array());
        let n = Vec4::from(plane.0);
        let along = n * place;
        let u = n.with_w(-((along.x + along.y) + along.z));
        let m = u * weight;
        [u * m.xxxx(), u.yzwz() * m.yyyz(), u.wwww() * m.zwww(), place * weight]
    }
}

/// 2^52 + 2^51: adding it leaves a double's nearest integer in the low bits of its mantissa, sign included.
const ROUNDER: f64 = 6_755_399_441_055_744.0;

/// A line in a worker's cache.
#[derive(Clone, Copy)]
#[repr(align(64))]
struct Cached([i32; PADDED]);

/// A worker's access to the sums. Nothing counts until [`Gatherer::flush`].
pub(super) struct Gatherer<'a> {
    sums: &'a Sums,
    cache: Box<[Cached; CACHED]>,
    owners: Box<[u32; CACHED]>,
}

impl<'a> Gatherer<'a> {
    pub(super) fn new(sums: &'a Sums) -> Self {
        Gatherer { sums, cache: Box::new([Cached([0; PADDED]); CACHED]), owners: Box::new([NOBODY; CACHED]) }
    }

    /// Adds shares in `planes` to their cells, by way of the cache: for faces whose neighbours come next.
    pub(super) fn add(&mut self, planes: &[Plane], shares: &[Share]) {
        for share in shares {
            let Some(quanta) = self.round(planes, share) else { continue };
            let (cell, place) = (share.cell, share.cell as usize % CACHED);
            let line = &mut self.cache[place].0;
            // Neither is negative or beyond the limit.
            let weight = line[PADDED_WEIGHT].cast_unsigned() + quanta[PADDED_WEIGHT].cast_unsigned();
            if self.owners[place] != cell || weight > LIMIT as u32 {
                self.sums.write_back(self.owners[place], line);
                self.owners[place] = cell;
            }
            for (sum, x) in line.iter_mut().zip(quanta) {
                *sum = sum.wrapping_add(x);
            }
        }
    }

    /// Adds shares in `planes` to their cells at once: for faces from anywhere. Lines are brought near first, so that the
    /// waits for them overlap.
    pub(super) fn add_now(&mut self, planes: &[Plane], shares: &[Share]) {
        for shares in shares.chunks(AT_ONCE) {
            let mut poisoned = false;
            for share in shares {
                poisoned |= self.sums.lines[share.cell as usize].0.is_poisoned();
            }
            std::hint::black_box(poisoned);
            for share in shares {
                if let Some(quanta) = self.round(planes, share) {
                    self.sums.add(share.cell, &quanta);
                }
            }
        }
    }

    /// A share in the 32 bits of a line; what does not fit goes aside at once.
    #[inline(always)]
    fn round(&self, planes: &[Plane], share: &Share) -> Option<[i32; PADDED]> {
        let plane = &planes[usize::from(share.plane)];
        if plane.weight() > LIMIT as f32 {
            self.add_wide(plane, share);
            return None;
        }
        // A weight at the limit still fits 32 bits, and the other lanes are no larger.
        let lanes = share.lanes(plane, plane.weight());
        let rounded = lanes.map(|x| f32x4::from(x.to_array()).fast_round_int().to_array());
        Some(bytemuck::cast(rounded))
    }

    #[cold]
    fn add_wide(&self, plane: &Plane, share: &Share) {
        let lanes: [f32; PADDED] =
            bytemuck::cast(share.lanes(plane, plane.weight().min(HEAVIEST)).map(|x| x.to_array()));
        let wide = lanes.map(|x| ((f64::from(x) + ROUNDER).to_bits() as i64).wrapping_sub(ROUNDER.to_bits() as i64));
        self.sums.add_aside(share.cell, &unpad(&wide));
    }

    /// Hands all that was gathered to the sums.
    pub(super) fn flush(&mut self) {
        for (line, owner) in self.cache.iter_mut().zip(&mut *self.owners) {
            self.sums.write_back(*owner, &mut line.0);
            *owner = NOBODY;
        }
    }
}

/// A contribution's or a cached line's lanes without the unused ones.
#[inline(always)]
fn unpad<T: Copy>(lanes: &[T; PADDED]) -> [T; LANES] {
    std::array::from_fn(|i| match i {
        ..WEIGHT => lanes[i],
        WEIGHT => lanes[PADDED_WEIGHT],
        _ => lanes[i + PADDED_WEIGHT - LANES],
    })
}

impl Sums {
    /// Sums of zero for `cells` cells.
    pub(super) fn new(cells: usize) -> Self {
        let lines = (0..cells).into_par_iter().in_pieces(4096).map(|_| Line::default()).collect();
        Sums { lines, side: Mutex::default(), overflowed: AtomicBool::new(false) }
    }

    /// Whether more cells have outgrown their lines than there is room for: a larger unit of weight is needed.
    pub(super) fn overflowed(&self) -> bool {
        self.overflowed.load(Relaxed)
    }

    /// Adds a cached line to its owner's and empties it.
    #[inline(never)]
    fn write_back(&self, owner: u32, cached: &mut [i32; PADDED]) {
        self.add(owner, &std::mem::replace(cached, [0; PADDED]));
    }

    #[inline(always)]
    fn add(&self, owner: u32, gathered: &[i32; PADDED]) {
        let gathered = unpad(gathered);
        let Some(line) = self.lines.get(owner as usize) else { return };
        // A worker that panicked has left nothing half done here: lanes are added without a call that could.
        let mut line = line.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if i64::from(line[WEIGHT]) + i64::from(gathered[WEIGHT]) > LIMIT {
            self.add_aside(owner, &line.map(i64::from));
            *line = gathered;
        } else {
            for (sum, x) in line.iter_mut().zip(gathered) {
                *sum = sum.wrapping_add(x);
            }
        }
    }

    #[cold]
    fn add_aside(&self, cell: u32, lanes: &[i64; LANES]) {
        let mut side = self.side.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        if side.len() > self.lines.len() / ASIDE + 1024 {
            return self.overflowed.store(true, Relaxed);
        }
        let sums = side.entry(cell).or_insert([0; LANES]);
        for (sum, x) in sums.iter_mut().zip(lanes) {
            *sum = sum.wrapping_add(*x);
        }
    }

    /// The sums as they are once all workers have flushed.
    pub(super) fn into_totals(self) -> Totals {
        Totals { lines: self.lines, side: self.side.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner()) }
    }
}

/// The sums of all cells, complete.
pub(super) struct Totals {
    lines: Vec<Line>,
    side: FxHashMap<u32, [i64; LANES]>,
}

impl Totals {
    /// A cell's sums, in the order of [`LANES`].
    pub(super) fn of(&self, cell: u32) -> [i64; LANES] {
        let line = self.lines[cell as usize].0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let mut total = line.map(i64::from);
        if let Some(aside) = self.side.get(&cell) {
            for (sum, x) in total.iter_mut().zip(aside) {
                *sum = sum.wrapping_add(*x);
            }
        }
        total
    }

    /// Adds to a cell's sums.
    pub(super) fn add(&mut self, cell: u32, extra: [i64; LANES]) {
        let line = self.lines[cell as usize].0.get_mut().unwrap_or_else(|poisoned| poisoned.into_inner());
        let sums: [i64; LANES] = std::array::from_fn(|i| i64::from(line[i]) + extra[i]);
        if sums.iter().all(|x| i32::try_from(*x).is_ok()) {
            *line = sums.map(|x| x as i32);
        } else {
            let aside = self.side.entry(cell).or_insert([0; LANES]);
            *aside = std::array::from_fn(|i| aside[i].wrapping_add(extra[i]));
        }
    }

    /// Cells that outgrew their line.
    pub(super) fn outgrown(&self) -> usize {
        self.side.len()
    }
}

#[cfg(test)]
mod tests {
    use super::super::grid::FIELD_BITS;
    use super::*;

    fn shares(count: u64) -> Vec<(Plane, Share)> {
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
                (Plane(n.extend(w).to_array()), Share::new(cell, 0, places, corners as u16))
            })
            .collect()
    }

    /// What a share adds, lane by lane.
    fn lanes_of((plane, share): &(Plane, Share)) -> [f32; LANES] {
        let [x, y, z, w] = plane.0;
        let p: [f32; 3] =
            std::array::from_fn(|k| share.sum[k] as f32 * (1.0 / (f32::from(share.corners) * 8192.0)) - 0.5);
        let u = [x, y, z, -((x * p[0] + y * p[1]) + z * p[2])];
        let m = u.map(|x| x * w);
        let quadric = [(0, 0), (1, 0), (2, 0), (3, 0), (1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (3, 3)];
        std::array::from_fn(|i| match i {
            ..WEIGHT => u[quadric[i].0] * m[quadric[i].1],
            WEIGHT => w,
            _ => p[i - WEIGHT - 1] * w,
        })
    }

    fn gather(shares: &[(Plane, Share)], workers: usize) -> (Vec<[i64; LANES]>, usize) {
        let sums = Sums::new(5000);
        std::thread::scope(|scope| {
            for part in shares.chunks(shares.len().div_ceil(workers)) {
                let sums = &sums;
                scope.spawn(move || {
                    let mut gatherer = Gatherer::new(sums);
                    for (some, turn) in part.chunks(100).zip(0..) {
                        let planes: Vec<Plane> = some.iter().map(|(plane, _)| *plane).collect();
                        let shares: Vec<Share> =
                            some.iter().zip(0..).map(|((_, share), plane)| Share { plane, ..*share }).collect();
                        if turn % 2 == 0 { gatherer.add(&planes, &shares) } else { gatherer.add_now(&planes, &shares) }
                    }
                    gatherer.flush();
                });
            }
        });
        let totals = sums.into_totals();
        ((0..5000).map(|cell| totals.of(cell)).collect(), totals.outgrown())
    }

    #[test]
    fn sums_are_exact_whatever_the_order_and_the_threads() {
        let mut shares = shares(30_000);
        let mut expected = vec![[0i64; LANES]; 5000];
        for share in &shares {
            for (sum, x) in expected[share.1.cell as usize].iter_mut().zip(lanes_of(share)) {
                *sum += x.round_ties_even() as i64;
            }
        }
        let (one, outgrown) = gather(&shares, 1);
        assert_eq!(one, expected);
        assert!(outgrown >= 4, "the side table was not used: {outgrown}");
        shares.reverse();
        let (three, outgrown_by_three) = gather(&shares, 3);
        assert_eq!(three, expected);
        assert_eq!(outgrown, outgrown_by_three);
    }

    #[test]
    fn a_line_is_a_cache_line() {
        assert_eq!(LINE_BYTES, 64);
        assert_eq!(size_of::<Cached>(), 64);
    }

    #[test]
    fn no_lane_exceeds_the_weight() {
        for share in shares(10_000) {
            assert!(lanes_of(&share).iter().all(|x| x.abs() <= share.0.weight() * (1.0 + 1e-6)));
        }
    }
}
