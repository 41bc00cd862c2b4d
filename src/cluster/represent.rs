//! Representatives: where each cell's vertex goes, and the quadric it takes along.

use super::Representative;
use super::grid::Grid;
use super::shares::LANES;
use super::sums::Totals;
use super::table::CellTable;
use crate::cores::InPieces;
use crate::mesh::{Coordinate, narrow, widen};
use crate::quadric::{PackedQuadric, Quadric};
use fearless_simd::{Level, Simd, dispatch};
use glam::DVec3;
use rayon::prelude::*;

/// How hard the mean pulls. At 1e-2 sharp edges round (a turbine blade's squared deviation grows by a fifth), at 1e-4
/// noise decides along directions about which the planes say little, and twice as many faces turn back.
const PULL: f64 = 1e-3;

/// Cells that are worked out together, and whose sums are fetched together: few enough for the first-level cache.
const AT_ONCE: usize = 64;

/// All that a representative is made of.
pub(super) struct Evidence<'a> {
    pub(super) representative: Representative,
    pub(super) grid: &'a Grid,
    pub(super) table: &'a CellTable,
    pub(super) totals: &'a Totals,
    /// Unit of weight, in cells².
    pub(super) quantum: f64,
}

impl Evidence<'_> {
    /// Positions and quadrics of `cells`, in their order.
    pub(super) fn represent<S: Coordinate>(&self, cells: &[u32]) -> (Vec<[S; 3]>, Vec<PackedQuadric>) {
        let mut positions: Vec<[S; 3]> = bytemuck::zeroed_vec(cells.len());
        let mut quadrics: Vec<PackedQuadric> = bytemuck::zeroed_vec(cells.len());
        let places = positions.par_chunks_mut(AT_ONCE).zip(quadrics.par_chunks_mut(AT_ONCE));
        cells.par_chunks(AT_ONCE).zip(places).in_pieces(4).for_each(|(cells, (positions, quadrics))| {
            self.totals.fetch(cells);
            dispatch!(Level::new(), simd => self.some(simd, cells, positions, quadrics));
        });
        (positions, quadrics)
    }

    /// The same of a few, as wide as vectors.
    #[inline(always)]
    fn some<V: Simd, S: Coordinate>(
        &self,
        _: V,
        cells: &[u32],
        positions: &mut [[S; 3]],
        quadrics: &mut [PackedQuadric],
    ) {
        let mut all = Lanes([[0.0; AT_ONCE]; LANES]);
        for (i, cell) in cells.iter().enumerate().take(AT_ONCE) {
            for (lane, sum) in all.0.iter_mut().zip(self.totals.of(*cell)) {
                lane[i] = sum as f64;
            }
        }
        let places = all.places(self.representative, self.quantum);
        let represented = positions.iter_mut().zip(quadrics).zip(cells);
        for (i, ((position, packed), cell)) in represented.enumerate().take(AT_ONCE) {
            let local = DVec3::new(places[0][i], places[1][i], places[2][i]);
            (*position, *packed) = self.framed(self.table.key(*cell), local, &all.quadric(i, self.quantum));
        }
    }

    /// The position of a place in a cell, about its centre in cells, and what the cell's quadric is about that.
    #[inline(always)]
    fn framed<S: Coordinate>(&self, key: u64, local: DVec3, quadric: &Quadric) -> ([S; 3], PackedQuadric) {
        let position = narrow::<S>(self.grid.position(key, local));
        // The quadric goes about the position as it is stored. Weights are areas in ordinary cells, lengths in this one.
        let (h, area) = (self.grid.side(key), self.grid.cell * self.grid.cell);
        let stored = (widen(position) - self.grid.position(key, DVec3::ZERO)) / h;
        let mut q = quadric.shifted(stored);
        q.a.iter_mut().for_each(|x| *x *= area);
        let framed = Quadric { a: q.a, b: q.b * (area * h), c: q.c * (area * h * h), w: q.w * area };
        (position, framed.pack())
    }
}

/// The sums of some cells, lane by lane in the order of [`LANES`].
struct Lanes([[f64; AT_ONCE]; LANES]);

impl Lanes {
    /// Where each cell's representative goes, by axis, about its centre, lengths in cells.
    #[inline(always)]
    fn places(&self, representative: Representative, quantum: f64) -> [[f64; AT_ONCE]; 3] {
        let [mut x, mut y, mut z] = [[0.0; AT_ONCE]; 3];
        for i in 0..AT_ONCE {
            let place = match representative {
                Representative::Mean => self.mean(i),
                Representative::Quadric => place(&self.quadric(i, quantum), self.mean(i)),
            };
            (x[i], y[i], z[i]) = (place.x, place.y, place.z);
        }
        [x, y, z]
    }

    /// A cell's quadric about its centre, lengths in cells.
    #[inline(always)]
    fn quadric(&self, i: usize, quantum: f64) -> Quadric {
        let of = |lane: usize| self.0[lane][i] * quantum;
        let a = [of(0), of(1), of(2), of(4), of(5), of(7)];
        Quadric { a, b: DVec3::new(of(3), of(6), of(8)), c: of(9), w: of(10) }
    }

    /// The mean of the surface in a cell, likewise.
    #[inline(always)]
    fn mean(&self, i: usize) -> DVec3 {
        let w = self.0[10][i];
        let of = |lane: usize| if w > 0.0 { self.0[lane][i] / w } else { 0.0 };
        DVec3::new(of(11), of(12), of(13))
    }
}

/// Where the quadric is least, along the way there from the mean as far as the cell goes.
#[inline(always)]
fn place(quadric: &Quadric, mean: DVec3) -> DVec3 {
    let (least, is_one) = quadric.minimiser_if_one(mean, PULL);
    let way = |least: f64, mean: f64| if is_one { least - mean } else { 0.0 };
    let way = DVec3::new(way(least.x, mean.x), way(least.y, mean.y), way(least.z, mean.z));
    let share = |mean: f64, way: f64| {
        let room = 0.5 - mean.abs().copysign(mean * way);
        room.max(0.0) / way.abs().max(f64::MIN_POSITIVE)
    };
    let share = 1.0f64.min(share(mean.x, way.x)).min(share(mean.y, way.y)).min(share(mean.z, way.z));
    mean + share * way
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectors::levels;

    /// Three planes through a point near the corner of a cell, and beyond it; a plane; and nothing.
    fn lanes() -> Lanes {
        let mut all = Lanes([[0.0; AT_ONCE]; LANES]);
        for i in 0..AT_ONCE {
            let corner = DVec3::new(0.1, 0.2, 0.3) + 0.02 * i as f64;
            let planes = if i % 3 == 0 { &[DVec3::X][..] } else { &[DVec3::X, DVec3::Y, DVec3::Z] };
            if i % 7 == 6 {
                continue;
            }
            let q = planes.iter().fold(Quadric::default(), |q, n| q + Quadric::plane(*n, -n.dot(corner), 1000.0));
            let [xx, xy, xz, yy, yz, zz] = q.a;
            let mean = q.w * DVec3::new(0.2, 0.0, -0.1);
            let sums = [xx, xy, xz, q.b.x, yy, yz, q.b.y, zz, q.b.z, q.c, q.w, mean.x, mean.y, mean.z];
            all.0.iter_mut().zip(sums).for_each(|(lane, sum)| lane[i] = sum);
        }
        all
    }

    #[inline(always)]
    fn places<V: Simd>(_: V, representative: Representative) -> [[f64; AT_ONCE]; 3] {
        lanes().places(representative, 1e-3)
    }

    #[test]
    fn representatives_lie_where_planes_meet_or_on_the_way_there_by_vectors_of_any_width() {
        let narrowest = levels()[0];
        let expected = dispatch!(narrowest, simd => places(simd, Representative::Quadric));
        for level in levels() {
            assert_eq!(dispatch!(level, simd => places(simd, Representative::Quadric)), expected);
            let [x, ..] = dispatch!(level, simd => places(simd, Representative::Mean));
            assert!((0..AT_ONCE).all(|i| x[i] == if i % 7 == 6 { 0.0 } else { 0.2 }));
        }
        let mean = DVec3::new(0.2, 0.0, -0.1);
        let places = (0..AT_ONCE).map(|i| DVec3::from(expected.map(|along| along[i])));
        for (i, place) in places.enumerate() {
            let corner = DVec3::new(0.1, 0.2, 0.3) + 0.02 * i as f64;
            let off = match (i % 7 == 6, i % 3 == 0) {
                (true, _) => place.length(),
                // Along the plane, the mean decides.
                (_, true) => (place - DVec3::new(corner.x.min(0.5), 0.0, -0.1)).length(),
                _ if corner.max_element() < 0.5 => (place - corner).length(),
                _ => {
                    (place - mean).normalize().distance((corner - mean).normalize()) + (place.max_element() - 0.5).abs()
                }
            };
            assert!(off < 2e-3, "{i}: {place} for planes through {corner}");
        }
    }
}
