//! Representatives: where each cell's vertex goes, and the quadric it takes along.

use super::Representative;
use super::grid::Grid;
use super::sums::{AT_ONCE, LANES, Totals};
use super::table::CellTable;
use crate::cores::InPieces;
use crate::mesh::{Coordinate, narrow, widen};
use crate::quadric::{PackedQuadric, Quadric};
use glam::DVec3;
use rayon::prelude::*;

/// How hard the mean pulls. At 1e-2 sharp edges round (a turbine blade's squared deviation grows by a fifth), at 1e-4
/// noise decides along directions about which the planes say little, and twice as many faces turn back.
const PULL: f64 = 1e-3;

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
            for (cell, place) in cells.iter().zip(positions.iter_mut().zip(quadrics)) {
                (*place.0, *place.1) = self.of(*cell);
            }
        });
        (positions, quadrics)
    }

    fn of<S: Coordinate>(&self, cell: u32) -> ([S; 3], PackedQuadric) {
        let (quadric, mean) = self.learnt(cell);
        let local = match self.representative {
            Representative::Mean => mean,
            Representative::Quadric => place(&quadric, mean),
        };
        let key = self.table.key(cell);
        let position = narrow::<S>(self.grid.position(key, local));
        // The quadric goes about the position as it is stored. Weights are areas in ordinary cells, lengths in this one.
        let (h, area) = (self.grid.side(key), self.grid.cell * self.grid.cell);
        let stored = (widen(position) - self.grid.position(key, DVec3::ZERO)) / h;
        let q = quadric.shifted(stored);
        let framed = Quadric { a: q.a.map(|x| x * area), b: q.b * (area * h), c: q.c * (area * h * h), w: q.w * area };
        (position, framed.pack())
    }

    /// A cell's quadric and mean about its centre, lengths in cells.
    fn learnt(&self, cell: u32) -> (Quadric, DVec3) {
        let lanes: [f64; LANES] = self.totals.of(cell).map(|x| x as f64);
        let [a0, a1, a2, b0, a3, a4, b1, a5, b2, c, w, x, y, z] = lanes;
        let mean = if w > 0.0 { DVec3::new(x, y, z) / w } else { DVec3::ZERO };
        let a = [a0, a1, a2, a3, a4, a5].map(|x| x * self.quantum);
        let b = DVec3::new(b0, b1, b2) * self.quantum;
        (Quadric { a, b, c: c * self.quantum, w: w * self.quantum }, mean)
    }
}

/// Where the quadric is least, along the way there from the mean as far as the cell goes.
fn place(quadric: &Quadric, mean: DVec3) -> DVec3 {
    let Some(least) = quadric.minimiser(mean, PULL) else { return mean };
    let way = least - mean;
    let mut share = 1.0f64;
    for axis in 0..3 {
        let room = 0.5 - mean[axis].abs().copysign(mean[axis] * way[axis]);
        share = share.min(room.max(0.0) / way[axis].abs().max(f64::MIN_POSITIVE));
    }
    mean + share * way
}
