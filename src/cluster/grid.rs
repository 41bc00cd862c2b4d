//! The grid: positions to cells and back.
//!
//! A position is first quantised to steps of 1/8192 of a cell and only then split into cell and place within the cell,
//! so that everything after this file is exact integer arithmetic: two faces that share a vertex see the same bits.

use super::sizing::Sizing;
use super::survey::STRAY;
use crate::mesh::samples::Lattice;
use crate::mesh::{Extent, Frame};
use glam::DVec3;
use rayon::prelude::*;

/// Bits of a place within a cell, an axis.
pub(super) const LOCAL_BITS: u32 = 13;
/// Steps a cell is wide.
pub(super) const STEPS: f64 = (1u32 << LOCAL_BITS) as f64;
/// Bits of a cell's coordinate, an axis: three make one key.
pub(super) const COORDINATE_BITS: u32 = 21;
/// Bits of a position in steps, an axis.
const STEP_BITS: u32 = COORDINATE_BITS + LOCAL_BITS;
/// Cells along the scan's longest side, at most: one in 32 is left for the margin of the origin and for rounding.
const MAX_CELLS_A_SIDE: f64 = ((1u32 << COORDINATE_BITS) - (1 << 16)) as f64;

/// The same where most of the scan is only known to be about a place: what is in sixteen times its length is not far.
const STRAY_CELLS_A_SIDE: f64 = (1u32 << (COORDINATE_BITS - 4)) as f64;

/// 2^52 + 2^51: adding it leaves a double's nearest integer in the low bits of its mantissa.
const ROUNDER: f64 = 6_755_399_441_055_744.0;

/// A position in steps of 1/8192 cell from the grid's origin, an axis below 2³⁴.
pub(super) type Steps = [u64; 3];

/// Far cells are `1 << FAR_BITS` times as wide as the others, so that one is as wide as all of those together.
const FAR_BITS: u32 = COORDINATE_BITS;
/// Set in the third step of a position in a far cell, just above the bits of near ones: it ends up on top of keys.
const FAR: u64 = 1 << STEP_BITS;
/// The far cell in which all others are, an axis.
const MIDDLE: i64 = 1 << (COORDINATE_BITS - 1);

/// Where the scan is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Place {
    frame: Frame,
    /// In the frame.
    min: DVec3,
    max: DVec3,
    /// Where cells are counted from, a quarter of one below.
    low: DVec3,
    /// Whether something may be far outside.
    stray: bool,
}

impl Place {
    /// All of the scan is in `extent`, which is in the file's units.
    pub(super) fn within(frame: Frame, extent: &Extent) -> Self {
        let min = frame.place(extent.min);
        Place { frame, min, max: frame.place(extent.max), low: min, stray: false }
    }

    /// Most of it is, and lowest of that is `low`.
    pub(super) fn about(frame: Frame, extent: &Extent, low: DVec3) -> Self {
        Place { low: frame.place(low), stray: true, ..Self::within(frame, extent) }
    }

    /// Between the file's units and the grid's.
    pub(super) fn frame(&self) -> Frame {
        self.frame
    }

    /// Where samples of the scan can lie; these are its cells, if they are known by now (of an indexed scan, not of a soup).
    pub(super) fn lattice(&self, grid: &Grid, cells: impl ParallelIterator<Item = u64>) -> Lattice {
        let unit = |key| DVec3::from(coordinates(key).map(|x| x as f64));
        let near = cells.filter(|key| self.stray && !is_far(*key)).map(|key| (unit(key), unit(key)));
        let both = |a: (DVec3, DVec3), b: (DVec3, DVec3)| (a.0.min(b.0), a.1.max(b.1));
        let (min, max) = match near.reduce_with(both) {
            Some((least, most)) => (grid.origin + least * grid.cell, grid.origin + (most + 1.0) * grid.cell),
            None => (self.min, self.max),
        };
        let is_stray = (max - min).max_element() > STRAY * self.longest();
        if is_stray { Lattice::over(self.min, self.max) } else { Lattice::over(min, max) }
    }

    fn longest(&self) -> f64 {
        (self.max - self.min).max_element()
    }

    /// The least side that a cell may have, in the frame.
    fn finest(&self) -> f64 {
        self.longest() / if self.stray { STRAY_CELLS_A_SIDE } else { MAX_CELLS_A_SIDE }
    }

    /// The side of cells under `sizing`.
    pub(super) fn side(&self, sizing: &Sizing) -> f64 {
        sizing.side(self.finest(), self.longest())
    }
}

/// Where the cells are.
///
/// Cells have 21 bits of coordinate an axis. That is more than any scan needs, but not more than the distance of a stray
/// point can be: what is beyond lies in *far* cells, each as wide as all the others together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    frame: Frame,
    /// In the frame.
    origin: DVec3,
    /// Side of a cell in the frame.
    pub(super) cell: f64,
    steps_per_unit: f64,
    /// The same two in the file's units, from the frame's origin, unless these are beyond all measure.
    in_file: Option<(DVec3, f64)>,
}

/// Within these bounds of its side's exponent a scan is measured in its own units: scaling by a power of two is exact,
/// so that steps come out the same.
const ORDINARY: std::ops::Range<f64> = 1e-150..1e150;

impl Grid {
    /// A grid of cells of side `cell` (frame units; widened if the scan would be too many cells long). Cells begin a
    /// quarter of one below the scan: a flat side of an axis-aligned model then lies inside a layer of cells, not on the
    /// wall between two. About a scan with strays, cells go equally far to all sides.
    pub(super) fn new(place: Place, cell: f64) -> Self {
        let cell = if cell > place.finest() { cell } else { place.finest().max(f64::MIN_POSITIVE) };
        let below = if place.stray { (1u32 << (COORDINATE_BITS - 1)) as f64 } else { 0.0 };
        let origin = place.low - (below + 0.25) * cell;
        let steps_per_unit = STEPS / cell;
        let unit = place.frame.to_file(1.0);
        let in_file = ORDINARY.contains(&unit).then(|| (origin * unit, steps_per_unit / unit));
        Grid { frame: place.frame, origin, cell, steps_per_unit, in_file }
    }

    /// Where steps are counted from, in the frame.
    pub(super) fn origin(&self) -> DVec3 {
        self.origin
    }

    /// The steps of a position in the file's units; `None` when it is not finite, or further off than even far cells are.
    #[inline(always)]
    pub(super) fn steps(&self, p: [f64; 3]) -> Option<Steps> {
        let s = match self.in_file {
            Some((origin, steps_per_unit)) => (DVec3::from(p) - self.frame.origin() - origin) * steps_per_unit,
            None => self.framed_steps(p),
        };
        let steps = [round(s.x), round(s.y), round(s.z)];
        if (steps[0] | steps[1] | steps[2]) >> STEP_BITS == 0 { Some(steps) } else { far_steps(s) }
    }

    /// The steps of some positions, by axis, and whether all are near; if not, they are worth nothing. One after the other
    /// in short loops, as wide as the vectors of the function that this becomes a part of.
    #[inline(always)]
    pub(super) fn near_steps<const N: usize>(&self, positions: &[[f64; 3]; N], steps: &mut [[u64; N]; 3]) -> bool {
        let Some((origin, steps_per_unit)) = self.in_file else { return false };
        let (frame, origin) = (self.frame.origin().to_array(), origin.to_array());
        let mut all = 0;
        for axis in 0..3 {
            for (steps, p) in steps[axis].iter_mut().zip(positions) {
                *steps = round((p[axis] - frame[axis] - origin[axis]) * steps_per_unit);
                all |= *steps;
            }
        }
        all >> STEP_BITS == 0
    }

    #[cold]
    fn framed_steps(&self, p: [f64; 3]) -> DVec3 {
        (self.frame.place(DVec3::from(p)) - self.origin) * self.steps_per_unit
    }

    /// The position in the frame of a place `local` (in the cell's sides, about its centre) in the cell `key`.
    #[inline]
    pub(super) fn position(&self, key: u64, local: DVec3) -> DVec3 {
        let [x, y, z] = least_corner(key);
        self.origin + DVec3::new(x as f64, y as f64, z as f64) * (self.cell / STEPS) + (0.5 + local) * self.side(key)
    }

    /// The side of the cell `key` in the frame.
    #[inline]
    pub(super) fn side(&self, key: u64) -> f64 {
        if is_far(key) { self.cell * (1u64 << FAR_BITS) as f64 } else { self.cell }
    }
}

/// The steps of a position in a far cell, from its steps from the origin.
#[cold]
fn far_steps(s: DVec3) -> Option<Steps> {
    let far = s / (1u64 << FAR_BITS) as f64 + (MIDDLE << LOCAL_BITS) as f64;
    let [x, y, z] = [round(far.x), round(far.y), round(far.z)];
    ((x | y | z) >> STEP_BITS == 0).then_some([x, y, z | FAR])
}

/// The nearest integer of a number in `0..2^51`; more than that of any other, and of what is none.
#[inline(always)]
fn round(x: f64) -> u64 {
    (x + ROUNDER).to_bits().wrapping_sub(ROUNDER.to_bits())
}

/// The key of the cell that holds a position.
#[inline(always)]
pub(super) fn cell_key(s: Steps) -> u64 {
    (s[0] >> LOCAL_BITS) | (s[1] >> LOCAL_BITS) << COORDINATE_BITS | (s[2] >> LOCAL_BITS) << (2 * COORDINATE_BITS)
}

/// The place of a position within its cell, [`LOCAL_BITS`] an axis.
#[inline(always)]
pub(super) fn place_in_cell(s: Steps) -> u64 {
    const MASK: u64 = (1 << LOCAL_BITS) - 1;
    (s[0] & MASK) << (2 * LOCAL_BITS) | (s[1] & MASK) << LOCAL_BITS | (s[2] & MASK)
}

/// A key's cell coordinates, for what is not far.
#[inline(always)]
pub(super) fn coordinates(key: u64) -> [i64; 3] {
    const MASK: u64 = (1 << COORDINATE_BITS) - 1;
    [(key & MASK) as i64, (key >> COORDINATE_BITS & MASK) as i64, (key >> (2 * COORDINATE_BITS) & MASK) as i64]
}

/// Whether a key is of a far cell.
#[inline(always)]
pub(super) fn is_far(key: u64) -> bool {
    key >> (3 * COORDINATE_BITS) != 0
}

/// The least corner of the cell `key` in steps from the origin: below 2⁵⁵ either way.
#[inline]
pub(super) fn least_corner(key: u64) -> [i64; 3] {
    let at = coordinates(key);
    if is_far(key) { at.map(|x| (x - MIDDLE) << (FAR_BITS + LOCAL_BITS)) } else { at.map(|x| x << LOCAL_BITS) }
}

/// A corner in steps from the origin.
pub(super) fn absolute(corner: Corner, key: u64) -> [i64; 3] {
    if !is_far(key) {
        return absolute_near(corner, key);
    }
    let (least, local) = (least_corner(key), corner.local());
    std::array::from_fn(|axis| least[axis] + (i64::from(local[axis]) << FAR_BITS))
}

/// The same of one that is not far.
#[inline(always)]
pub(super) fn absolute_near(corner: Corner, key: u64) -> [i64; 3] {
    [0, 1, 2].map(|axis| along(corner, key, axis) as i64)
}

/// The same along one axis.
#[inline(always)]
pub(super) fn along(corner: Corner, key: u64, axis: u32) -> u64 {
    let cell = key >> (axis * COORDINATE_BITS) & ((1 << COORDINATE_BITS) - 1);
    (cell << LOCAL_BITS) + (corner.0 >> ((2 - axis) * LOCAL_BITS) & ((1 << LOCAL_BITS) - 1))
}

/// A binned corner: 25 bits of cell number and three times 13 bits of place in the cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(transparent)]
pub(super) struct Corner(pub(super) u64);

/// Bits of a field of [`Corner::fields`].
pub(super) const FIELD_BITS: u32 = 16;

/// Cells that a table can number.
pub const MAX_CELLS: usize = (1 << 25) - 2;

impl Corner {
    /// A vertex that is nowhere: a coordinate is not finite. Above every usable corner.
    pub(super) const NOWHERE: Corner = Corner(u64::MAX);

    /// Of a position in cell number `cell`.
    #[inline(always)]
    pub(super) fn new(cell: u32, s: Steps) -> Self {
        Corner::at(cell, place_in_cell(s))
    }

    /// At a [`place_in_cell`] of cell number `cell`.
    #[inline(always)]
    pub(super) fn at(cell: u32, place: u64) -> Self {
        Corner(u64::from(cell) << (3 * LOCAL_BITS) | place)
    }

    /// The cell's number.
    #[inline(always)]
    pub(super) fn cell(self) -> u32 {
        (self.0 >> (3 * LOCAL_BITS)) as u32
    }

    /// Whether another corner is in the same cell.
    #[inline(always)]
    pub(super) fn same_cell(self, other: Corner) -> bool {
        (self.0 ^ other.0) >> (3 * LOCAL_BITS) == 0
    }

    /// The place within the cell in one word, [`FIELD_BITS`] an axis, the first one lowest: sums of up to eight of them do
    /// not carry.
    #[inline(always)]
    pub(super) fn fields(self) -> u64 {
        const MASK: u64 = (1 << LOCAL_BITS) - 1;
        let along = |axis: u32| (self.0 >> ((2 - axis) * LOCAL_BITS) & MASK) << (axis * FIELD_BITS);
        along(0) | along(1) | along(2)
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

    #[test]
    fn positions_survive_binning_to_half_a_step() {
        let extent = Extent { min: DVec3::new(-3.0, 5e5, 0.0), max: DVec3::new(4.0, 5e5 + 2.0, 1.5) };
        for place in [Place::within(Frame::of(&extent), &extent), Place::about(Frame::of(&extent), &extent, extent.min)]
        {
            let grid = Grid::new(place, 0.01);
            for p in [extent.min, extent.max, DVec3::new(0.1, 5e5 + 0.7, 1.1)] {
                let s = grid.steps(p.to_array()).unwrap();
                let corner = Corner::new(7, s);
                let local = DVec3::from(corner.local().map(f64::from)) / STEPS - 0.5;
                let back = grid.position(cell_key(s), local) - p / 8.0;
                assert!(back.abs().max_element() <= 0.5001 * grid.cell / STEPS, "{p} moved by {back}");
                assert_eq!(absolute(corner, cell_key(s)), s.map(|x| x as i64));
                let mut near = [[0; 2]; 3];
                assert!(grid.near_steps(&[p.to_array(); 2], &mut near));
                assert_eq!(near, s.map(|x| [x; 2]));
                assert!(!grid.near_steps(&[p.to_array(), [0.0, f64::NAN, 5e5]], &mut near));
            }
        }
    }

    #[test]
    fn what_is_far_is_binned_too() {
        let extent = Extent { min: DVec3::ZERO, max: DVec3::ONE };
        let grid = Grid::new(Place::about(Frame::default(), &extent, extent.min), 0.01);
        for p in [[1e9, 0.5, 0.5], [-3e5, 2e4, -1.0], [0.0, 0.0, 8e9]] {
            let s = grid.steps(p).unwrap();
            let key = cell_key(s);
            assert!(is_far(key) && !is_far(cell_key(grid.steps([0.5; 3]).unwrap())));
            let corner = Corner::new(7, s);
            let local = DVec3::from(corner.local().map(f64::from)) / STEPS - 0.5;
            let off = (grid.position(key, local) - DVec3::from(p)).abs().max_element();
            assert!(off <= 0.51 * grid.side(key) / STEPS, "{p:?} is off by {off}");
            let steps = DVec3::from(absolute(corner, key).map(|x| x as f64)) * (grid.cell / STEPS);
            assert!((steps + grid.origin - DVec3::from(p)).abs().max_element() <= 0.51 * grid.side(key) / STEPS);
        }
        assert_eq!(grid.steps([1e12, 0.0, 0.0]), None);
    }

    #[test]
    fn what_is_not_finite_is_nowhere() {
        let extent = Extent { min: DVec3::ZERO, max: DVec3::ONE };
        let grid = Grid::new(Place::within(Frame::default(), &extent), 0.1);
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
