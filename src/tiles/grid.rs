//! The blocks that a scan is cut into, and the tiles that they make up.

use crate::error::Result;
use crate::mesh::{Coordinate, Extent, Frame};
use crate::read::{Crew, Scan};
use glam::DVec3;
use rustc_hash::{FxHashMap, FxHashSet};

/// Blocks along a side of a tile, and by how many of them the tiles of every other sweep are shifted.
const BLOCKS_A_TILE: u32 = 8;
const SHIFT: u32 = BLOCKS_A_TILE / 2;

/// Bits of a block's number along an axis.
const BITS: u32 = 20;
const MASK: u64 = (1 << BITS) - 1;
/// One along each axis.
const EACH: u64 = 1 | 1 << BITS | 1 << (2 * BITS);

/// Blocks of fewer faces than that, on average, are not told apart as faces are put away: lists of where each block's are
/// would take more than some small budgets hold, 260 MiB for 28 million faces in blocks of 28.
pub const FEW_FACES: u64 = 500;

/// Steps within a block, along an axis, that the order of faces tells apart, as a power of two.
const CURVE_BITS: u32 = 13;

/// The lowest 21 bits, two zeros behind each.
#[inline]
fn spread(x: u64) -> u64 {
    let x = x & 0x1f_ffff;
    let x = (x | x << 32) & 0x001f_0000_0000_ffff;
    let x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    let x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    let x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

/// Blocks along the longest side of the scan at first: few enough to be counted one by one.
const FIRST: u32 = 128;
/// How much smaller blocks become where a tile would hold too much, and how often.
const FINER: f64 = 4.0;
const TURNS: u32 = 5;

/// How many times as many faces as were estimated a tile may turn out to have.
const MARGIN: f64 = 1.15;

/// How the tiles of a sweep lie: every other sweep has those that were cut in the middle of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lie {
    /// A tile begins where the blocks do.
    Straight,
    /// Half a tile further.
    Shifted,
}

impl Lie {
    /// That of the next sweep.
    pub fn other(self) -> Lie {
        match self {
            Lie::Straight => Lie::Shifted,
            Lie::Shifted => Lie::Straight,
        }
    }

    /// The tile that a block is in.
    #[inline]
    pub fn tile(self, block: u64) -> u64 {
        let shift = if self == Lie::Shifted { SHIFT } else { 0 };
        let along = |axis: u32| u64::from(((block >> (axis * BITS) & MASK) as u32 + shift) / BLOCKS_A_TILE);
        along(0) | along(1) << BITS | along(2) << (2 * BITS)
    }
}

/// The first block of the cube that a block is in and that no tile cuts, whichever way tiles lie.
#[inline]
pub(super) fn uncut(block: u64) -> u64 {
    block & !(u64::from(SHIFT - 1) * EACH)
}

/// Cubes of one size, numbered along each axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blocks {
    least: DVec3,
    side: f64,
    per_side: f64,
    are_small: bool,
}

impl Blocks {
    fn new(least: DVec3, side: f64) -> Self {
        Blocks { least, side, per_side: 1.0 / side, are_small: false }
    }

    /// The same, where so many of them hold so many faces.
    pub(super) fn of_faces(self, faces: u64, blocks: usize) -> Self {
        Blocks { are_small: faces / (blocks as u64).max(1) < FEW_FACES, ..self }
    }

    /// Whether they hold so few faces that cubes of 4³ of them are the least that faces are put away by.
    pub fn are_small(&self) -> bool {
        self.are_small
    }

    /// Where faces of a block are put away: there, or where those of others are, too.
    #[inline]
    pub(super) fn put_away(&self, block: u64) -> u64 {
        if self.are_small { uncut(block) } else { block }
    }

    /// The block that a point is in, or is nearest to.
    #[inline]
    pub fn of(&self, p: DVec3) -> u64 {
        let steps = ((p - self.least) * self.per_side).clamp(DVec3::ZERO, DVec3::splat(MASK as f64));
        steps.x as u64 | (steps.y as u64) << BITS | (steps.z as u64) << (2 * BITS)
    }

    /// The block that a face is in: that of its centroid.
    #[inline]
    pub(super) fn of_face(&self, [a, b, c]: [DVec3; 3]) -> u64 {
        self.of((a + b + c) / 3.0)
    }

    /// Where a point is along a curve through space, as finely as faces differ within a tile.
    #[inline]
    pub(super) fn along_curve(&self, p: DVec3) -> u64 {
        let steps = (p - self.least) * (self.per_side * f64::from(1 << CURVE_BITS));
        let spread = |x: f64| spread(x as i64 as u64);
        spread(steps.x) | spread(steps.y) << 1 | spread(steps.z) << 2
    }

    /// Where a point is in its piece, from 0 to 1: of a block along a side there are so many `pieces`.
    pub fn within(&self, p: DVec3, pieces: f64) -> DVec3 {
        ((p - self.least) * (self.per_side * pieces)).fract()
    }
}

/// A block as a place in file: its numbers fit any coordinate.
pub(super) fn numbers<S: Coordinate>(block: u64) -> [S; 3] {
    std::array::from_fn(|axis| S::narrow((block >> (axis as u32 * BITS) & MASK) as f64))
}

/// The block of such numbers.
pub(super) fn numbered<S: Coordinate>(numbers: [S; 3]) -> u64 {
    numbers.iter().rev().fold(0, |block, x| block << BITS | x.widen() as u64)
}

/// Counts by block.
type Counts = FxHashMap<u64, u32>;

/// Blocks of which tiles of either lie hold at most `most` faces; `None` where there are none.
pub fn blocks(scan: &Scan, crew: &Crew, (frame, extent): (Frame, &Extent), most: u64) -> Result<Option<Blocks>> {
    let place = |p: [f64; 3]| frame.place(DVec3::from(p));
    let (min, max) = (frame.place(extent.min), frame.place(extent.max));
    let size = (max - min).max_element().max(f64::MIN_POSITIVE);
    let each = scan.triangle_count() as f64 / scan.vertex_count().max(1) as f64;
    let mut side = size * (1.0 + 1e-9) / f64::from(FIRST);
    for _ in 0..TURNS {
        let counts = count(scan, crew, &place, &Blocks::new(min, side))?;
        // From tiles that hold all down to those of the finest blocks.
        let mut coarsenings = (0..=FIRST.ilog2()).rev().flat_map(|power| (4..=7).rev().map(move |n| (n << power) / 4));
        let fits = |n: &u32| f64::from(heaviest(&counts, *n)) * each * MARGIN <= most as f64;
        if let Some(coarsening) = coarsenings.find(fits) {
            let blocks = Blocks::new(min, side * f64::from(coarsening));
            return Ok(Some(blocks.of_faces(scan.triangle_count(), occupied(&counts, coarsening))));
        }
        side /= FINER;
        if size / side > MASK as f64 {
            break;
        }
    }
    Ok(None)
}

/// Vertices of a scan by block.
fn count(scan: &Scan, crew: &Crew, place: &(impl Fn([f64; 3]) -> DVec3 + Sync), blocks: &Blocks) -> Result<Counts> {
    let found = scan.vertices(crew, Counts::default, |counts, chunk| {
        for p in chunk.positions.iter().map(|p| place(*p)).filter(|p| p.is_finite()) {
            *counts.entry(blocks.of(p)).or_insert(0) += 1;
        }
        Ok(())
    })?;
    let together = |mut all: Counts, counts: Counts| {
        counts.into_iter().for_each(|(block, n)| *all.entry(block).or_insert(0) += n);
        all
    };
    Ok(found.into_iter().reduce(together).unwrap_or_default())
}

/// The cube of so many blocks along each side that a block is in.
pub(super) fn cube(block: u64, blocks: u32) -> u64 {
    let along = |axis: u32| (block >> (axis * BITS) & MASK) / u64::from(blocks);
    along(0) | along(1) << BITS | along(2) << (2 * BITS)
}

/// How many blocks hold anything, if so many blocks were one along each side.
fn occupied(counts: &Counts, coarsening: u32) -> usize {
    if coarsening == 1 {
        return counts.len();
    }
    // It grows as it must: there are far fewer than before.
    let mut cubes = FxHashSet::default();
    counts.keys().for_each(|block| _ = cubes.insert(cube(*block, coarsening)));
    cubes.len()
}

/// The most that a tile holds, of either lie, if so many blocks were one along each side.
fn heaviest(counts: &Counts, coarsening: u32) -> u32 {
    let heaviest = |lie: Lie| {
        let mut tiles = Counts::default();
        counts.iter().for_each(|(block, n)| *tiles.entry(lie.tile(cube(*block, coarsening))).or_insert(0) += n);
        tiles.into_values().max().unwrap_or(0)
    };
    heaviest(Lie::Straight).max(heaviest(Lie::Shifted))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(x: u64, y: u64, z: u64) -> u64 {
        x | y << BITS | z << (2 * BITS)
    }

    #[test]
    fn tiles_of_one_lie_are_cut_in_the_middle_of_those_of_the_other() {
        let tiles = |lie: Lie| (0..24).map(move |x| lie.tile(block(x, 0, 5)));
        let changes = |lie: Lie| {
            let tiles: Vec<u64> = tiles(lie).collect();
            (1..24).filter(|x| tiles[*x] != tiles[x - 1]).collect::<Vec<_>>()
        };
        assert_eq!((changes(Lie::Straight), changes(Lie::Shifted)), (vec![8, 16], vec![4, 12, 20]));
        assert_eq!(Lie::Straight.other().other(), Lie::Straight);
        for lie in [Lie::Straight, Lie::Shifted] {
            assert!(tiles(lie).eq((0..24).map(|x| lie.tile(uncut(block(x, 0, 5))))), "{lie:?}");
        }
        assert_eq!(uncut(block(11, 4, 3)), block(8, 4, 0));
    }

    #[test]
    fn faces_of_small_blocks_are_put_away_together() {
        let blocks = Blocks::new(DVec3::ZERO, 1.0);
        let (few, many) = (blocks.of_faces(FEW_FACES * 10 - 1, 10), blocks.of_faces(FEW_FACES * 10, 10));
        assert!(few.are_small() && !many.are_small());
        assert_eq!([few, many].map(|blocks| blocks.put_away(block(1, 6, 3))), [block(0, 4, 0), block(1, 6, 3)]);
    }

    #[test]
    fn a_point_has_one_block_and_its_numbers_fit_any_scalar() {
        let blocks = Blocks::new(DVec3::splat(-1.0), 0.25);
        assert_eq!(blocks.of(DVec3::new(-0.9, 0.1, 0.99)), block(0, 4, 7));
        assert_eq!(blocks.of(DVec3::splat(-7.0)), block(0, 0, 0), "what is outside is in the nearest");
        let far = block(MASK, 7, MASK - 1);
        assert_eq!((numbered(numbers::<f32>(far)), numbered(numbers::<f64>(far))), (far, far));
        assert_eq!(cube(block(9, 4, 3), 4), block(2, 1, 0));
        assert!(blocks.within(DVec3::new(-0.9, 0.1, 0.99), 1.0).distance(DVec3::new(0.4, 0.4, 0.96)) < 1e-9);
    }

    #[test]
    fn the_curve_keeps_neighbours_together() {
        let blocks = Blocks::new(DVec3::ZERO, 1.0);
        let at = |x: f64, y: f64| blocks.along_curve(DVec3::new(x, y, 0.0));
        assert!(at(0.49, 0.49) < at(0.51, 0.1) && at(0.99, 0.99) < at(1.01, 0.0));
        assert_eq!(at(0.3, 0.3), at(0.3, 0.3));
    }
}
