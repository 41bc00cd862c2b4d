//! What faces add to cells: shares of their planes, as rows of integers.

use super::grid::{FIELD_BITS, STEPS};
use crate::vectors;
use fearless_simd::{Simd, f32x4, f32x16, i32x16, prelude::*, u32x16, u64x8};
use glam::{Vec3, Vec4};

/// Lanes of a cell's sums: `Axx Axy Axz bx Ayy Ayz by Azz bz c w Σwx Σwy Σwz`.
pub(super) const LANES: usize = 14;
/// The lane of the weight.
pub(super) const WEIGHT: usize = 10;
/// Lanes of a contribution, so that four vectors make it: the same before the weight, two unused, `Σwx Σwy Σwz w`.
pub(super) const PADDED: usize = 16;
/// The lane of a contribution's weight.
pub(super) const PADDED_WEIGHT: usize = PADDED - 1;

/// Where a lane is in a contribution.
pub(super) const fn padded(lane: usize) -> usize {
    match lane {
        ..WEIGHT => lane,
        WEIGHT => PADDED_WEIGHT,
        _ => lane + PADDED_WEIGHT - LANES,
    }
}

/// A face's unit normal (zero for one without area), and its weight in quanta, which is at least 1.
#[derive(Debug, Clone, Copy, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(super) struct Plane(pub(super) [f32; 4]);

impl Plane {
    /// The unit normal.
    pub(super) fn normal(&self) -> Vec3 {
        Vec4::from(self.0).truncate()
    }

    #[inline(always)]
    pub(super) fn weight(&self) -> f32 {
        self.0[3]
    }
}

/// Shares of faces in cells, some of them: each the mean of those corners that are in the cell, and which of some planes goes
/// through it.
pub(super) struct Shares<const MOST: usize> {
    /// Of each the sum of its corners' fields; above them, how often [`ONE_CORNER`] was added.
    pub(super) places: [u64; MOST],
    pub(super) cells: [u32; MOST],
    pub(super) planes: [u16; MOST],
    /// How many there are. Behind them there is room for [`TOGETHER`] more.
    pub(super) count: usize,
}

impl<const MOST: usize> Shares<MOST> {
    /// None.
    pub(super) fn new() -> Self {
        Shares { places: [0; MOST], cells: [0; MOST], planes: [0; MOST], count: 0 }
    }

    /// Puts one down, which counts if `is_so`.
    #[inline(always)]
    pub(super) fn put_if(&mut self, is_so: bool, cell: u32, place: u64, plane: usize) {
        let at = self.count % MOST;
        (self.places[at], self.cells[at], self.planes[at]) = (place, cell, plane as u16);
        self.count += usize::from(is_so);
    }
}

/// Above the fields of a place, one for a corner.
pub(super) const ONE_CORNER: u64 = 1 << CORNERS_FROM;
const CORNERS_FROM: u32 = 3 * FIELD_BITS;

/// Shares that are worked out together.
pub(super) const TOGETHER: usize = 16;

/// What sums of so many places are to be multiplied by for their mean in cells.
const MEAN: [f32; 4] = [0.0, 1.0 / STEPS as f32, 1.0 / (2.0 * STEPS as f32), 1.0 / (3.0 * STEPS as f32)];
/// From a cell's least corner to its centre.
const CENTRE: f32 = -0.5;

/// What planes add through places, a row for each of them, in quanta: about the cell's centre, lengths in cells. Single
/// precision is finer than the rounding to quanta that follows.
#[inline(always)]
fn rows<V: Simd>(simd: V, planes: [&Plane; TOGETHER], places: &[u64; TOGETHER]) -> [f32x16<V>; TOGETHER] {
    let of = |x: f32| f32x16::splat(simd, x);
    let (low, high) = places.split_at(TOGETHER / 2);
    let (low, high) = (u64x8::from_slice(simd, low), u64x8::from_slice(simd, high));
    let mask = u64x8::splat(simd, (1 << FIELD_BITS) - 1);
    let field = |shift: u32| ((low >> shift) & mask).narrow((high >> shift) & mask);
    let corners = field(CORNERS_FROM);
    let is = |n: u32, m: f32x16<V>| corners.simd_eq(u32x16::splat(simd, n)).select(of(MEAN[n as usize]), m);
    let mean = is(1, is(2, of(MEAN[3])));
    let along = |axis: u32| field(axis * FIELD_BITS).bitcast::<i32x16<V>>().to_float::<f32x16<V>>() * mean + of(CENTRE);
    let [px, py, pz] = [along(0), along(1), along(2)];

    let [x, y, z, w] = columns(simd, planes);
    let d = -((x * px + y * py) + z * pz);
    let [mx, my, mz, md] = [x * w, y * w, z * w, d * w];
    let none = of(0.0);
    transposed([
        x * mx,
        y * mx,
        z * mx,
        d * mx,
        y * my,
        z * my,
        d * my,
        z * mz,
        d * mz,
        d * md,
        none,
        none,
        px * w,
        py * w,
        pz * w,
        w,
    ])
}

/// The numbers of planes, side by side.
#[inline(always)]
fn columns<V: Simd>(simd: V, planes: [&Plane; TOGETHER]) -> [f32x16<V>; 4] {
    let [pa, pb, pc, pd] = quarter(simd, planes, 0);
    let [qa, qb, qc, qd] = quarter(simd, planes, 4);
    let [ra, rb, rc, rd] = quarter(simd, planes, 8);
    let [sa, sb, sc, sd] = quarter(simd, planes, 12);
    [
        pa.combine(qa).combine(ra.combine(sa)),
        pb.combine(qb).combine(rb.combine(sb)),
        pc.combine(qc).combine(rc.combine(sc)),
        pd.combine(qd).combine(rd.combine(sd)),
    ]
}

/// The same of four of them.
#[inline(always)]
fn quarter<V: Simd>(simd: V, planes: [&Plane; TOGETHER], first: usize) -> [f32x4<V>; 4] {
    let row = |i: usize| f32x4::load_array_ref(simd, &planes[first + i].0);
    vectors::transposed([row(0), row(1), row(2), row(3)])
}

/// Rows as columns.
#[inline(always)]
fn transposed<V: Simd>(mut rows: [f32x16<V>; 16]) -> [f32x16<V>; 16] {
    for _ in 0..4 {
        let was = rows;
        for i in 0..8 {
            (rows[2 * i], rows[2 * i + 1]) = was[i].interleave(was[i + 8]);
        }
    }
    rows
}

/// What one plane of that weight adds through a place.
pub(super) fn row(plane: &Plane, weight: f32, place: u64) -> [f32; PADDED] {
    let mean = MEAN[(place >> CORNERS_FROM) as usize % MEAN.len()];
    let [px, py, pz] = [0, 1, 2].map(|axis| f32::from((place >> (axis * FIELD_BITS)) as u16) * mean + CENTRE);
    let [x, y, z, _] = plane.0;
    let d = -((x * px + y * py) + z * pz);
    let [mx, my, mz, md] = [x, y, z, d].map(|u| u * weight);
    let (p, w) = ([px, py, pz].map(|p| p * weight), weight);
    [x * mx, y * mx, z * mx, d * mx, y * my, z * my, d * my, z * mz, d * mz, d * md, 0.0, 0.0, p[0], p[1], p[2], w]
}

/// What shares from `first` on add, as far as it fits the 32 bits of a line: a weight at the limit still does, and the other
/// lanes are no larger.
#[inline(always)]
pub(super) fn quanta<V: Simd, const P: usize, const MOST: usize>(
    simd: V,
    planes: &[Plane; P],
    shares: &Shares<MOST>,
    first: usize,
) -> [[i32; PADDED]; TOGETHER] {
    let planes = std::array::from_fn(|i| &planes[usize::from(shares.planes[first + i]) % P]);
    let places = std::array::from_fn(|i| shares.places[first + i]);
    let mut quanta = [[0; PADDED]; TOGETHER];
    for (quanta, row) in quanta.iter_mut().zip(rows(simd, planes, &places)) {
        row.round_ties_even().to_int::<i32x16<V>>().store_array(quanta);
    }
    quanta
}
