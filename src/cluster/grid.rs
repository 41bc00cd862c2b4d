//! The grid: positions to cells and back.
//!
//! A position is first quantised to steps of 1/8192 of a cell and only then split into cell and place within the cell,
//! so that everything after this file is exact integer arithmetic: two faces that share a vertex see the same bits.

use crate::mesh::Frame;
use glam::DVec3;

/// Bits of a place within a cell, an axis.
pub(super) const LOCAL_BITS: u32 = 13;
/// Steps a cell is wide.
pub(super) const STEPS: f64 = (1u32 << LOCAL_BITS) as f64;
/// Bits of a cell's coordinate, an axis: three make one key.
pub(super) const COORDINATE_BITS: u32 = 21;
/// Cells along the scan's longest side, at most: one in 32 is left for the margin of the origin and for rounding.
const MAX_CELLS_A_SIDE: f64 = ((1u32 << COORDINATE_BITS) - (1 << 16)) as f64;

/// 2^52 + 2^51: adding it leaves a double's nearest integer in the low bits of its mantissa.
const ROUNDER: f64 = 6_755_399_441_055_744.0;

/// A position in steps of 1/8192 cell from the grid's origin, an axis below 2³⁴.
pub(super) type Steps = [u64; 3];

/// Where the cells are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    frame: Frame,
    /// In the frame.
    origin: DVec3,
    /// Side of a cell in the frame.
    pub(super) cell: f64,
    steps_per_unit: f64,
}

impl Grid {
    /// A grid of cells of side `cell` (frame units; widened if the scan would be too many cells long) about a scan
    /// whose least corner is `min` in the file's units. The origin is a quarter cell below it: a flat side of an
    /// axis-aligned model then lies inside a layer of cells, not on the wall between two.
    pub(super) fn new(frame: Frame, min: DVec3, cell: f64) -> Self {
        let cell = cell.max(Self::finest());
        let min = DVec3::new(frame.to_frame(min.x), frame.to_frame(min.y), frame.to_frame(min.z));
        Grid { frame, origin: min - 0.25 * cell, cell, steps_per_unit: STEPS / cell }
    }

    /// The least side that a cell may have, in the frame, whose scans are at most 1 long.
    pub(super) fn finest() -> f64 {
        1.0 / MAX_CELLS_A_SIDE
    }

    /// The steps of a position in the file's units; `None` when it is not finite.
    #[inline(always)]
    pub(super) fn steps(&self, p: [f64; 3]) -> Option<Steps> {
        let f = self.frame;
        let p = DVec3::new(f.to_frame(p[0]), f.to_frame(p[1]), f.to_frame(p[2]));
        let s = (p - self.origin) * self.steps_per_unit;
        // False for whatever is not a number or not within the extent; infinities of opposite sign sum to NaN.
        let sum = s.x + s.y + s.z;
        (0.0..4.0 * MAX_CELLS_A_SIDE * STEPS).contains(&sum).then(|| [round(s.x), round(s.y), round(s.z)])
    }

    /// The position in the frame of a place `local` (in cells, about the cell's centre) in the cell `key`.
    #[inline]
    pub(super) fn position(&self, key: u64, local: DVec3) -> DVec3 {
        let [x, y, z] = coordinates(key);
        self.origin + (DVec3::new(x as f64, y as f64, z as f64) + 0.5 + local) * self.cell
    }
}

/// The nearest integer of a number in `0..2^51`.
#[inline(always)]
fn round(x: f64) -> u64 {
    (x + ROUNDER).to_bits() & ((1 << 51) - 1)
}

/// The key of the cell that holds a position.
#[inline(always)]
pub(super) fn cell_key(s: Steps) -> u64 {
    (s[0] >> LOCAL_BITS) | (s[1] >> LOCAL_BITS) << COORDINATE_BITS | (s[2] >> LOCAL_BITS) << (2 * COORDINATE_BITS)
}

/// A key's cell coordinates.
#[inline(always)]
pub(super) fn coordinates(key: u64) -> [i64; 3] {
    const MASK: u64 = (1 << COORDINATE_BITS) - 1;
    [(key & MASK) as i64, (key >> COORDINATE_BITS & MASK) as i64, (key >> (2 * COORDINATE_BITS) & MASK) as i64]
}

/// A binned corner: 25 bits of cell number and three times 13 bits of place in the cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(super) struct Corner(pub(super) u64);

/// Cells that a table can number.
pub const MAX_CELLS: usize = (1 << 25) - 2;

impl Corner {
    /// A vertex that is nowhere: a coordinate is not finite. Above every usable corner.
    pub(super) const NOWHERE: Corner = Corner(u64::MAX);

    /// Of a position in cell number `cell`.
    #[inline(always)]
    pub(super) fn new(cell: u32, s: Steps) -> Self {
        const MASK: u64 = (1 << LOCAL_BITS) - 1;
        let local = (s[0] & MASK) << (2 * LOCAL_BITS) | (s[1] & MASK) << LOCAL_BITS | (s[2] & MASK);
        Corner(u64::from(cell) << (3 * LOCAL_BITS) | local)
    }

    /// The cell's number.
    #[inline(always)]
    pub(super) fn cell(self) -> u32 {
        (self.0 >> (3 * LOCAL_BITS)) as u32
    }

    /// The place within the cell, in steps from its least corner.
    #[inline(always)]
    pub(super) fn local(self) -> [i32; 3] {
        const MASK: u64 = (1 << LOCAL_BITS) - 1;
        [(self.0 >> (2 * LOCAL_BITS) & MASK) as i32, (self.0 >> LOCAL_BITS & MASK) as i32, (self.0 & MASK) as i32]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Extent;

    #[test]
    fn positions_survive_binning_to_half_a_step() {
        let extent = Extent { min: DVec3::new(-3.0, 5e5, 0.0), max: DVec3::new(4.0, 5e5 + 2.0, 1.5) };
        let grid = Grid::new(Frame::of(&extent), extent.min, 0.01);
        for p in [extent.min, extent.max, DVec3::new(0.1, 5e5 + 0.7, 1.1)] {
            let s = grid.steps(p.to_array()).unwrap();
            let local = Corner::new(7, s).local().map(f64::from);
            let local = DVec3::from(local) / STEPS - 0.5;
            let back = grid.position(cell_key(s), local) - p / 8.0;
            assert!(back.abs().max_element() <= 0.5001 * grid.cell / STEPS, "{p} moved by {back}");
        }
    }

    #[test]
    fn what_is_not_finite_is_nowhere() {
        let grid = Grid::new(Frame::default(), DVec3::ZERO, 0.1);
        for x in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for p in [[x, 0.0, 0.0], [0.5, x, 0.5], [x, 0.2, -x]] {
                assert_eq!(grid.steps(p), None, "{p:?}");
            }
        }
        assert!(grid.steps([1.0; 3]).is_some());
    }

    #[test]
    fn a_corner_keeps_its_cell_and_place() {
        let corner = Corner::new(MAX_CELLS as u32, [8191, 8192 * 5 + 1, 4096]);
        assert_eq!((corner.cell(), corner.local()), (MAX_CELLS as u32, [8191, 1, 4096]));
        assert!(corner < Corner::NOWHERE);
    }
}
