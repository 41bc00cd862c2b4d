//! What has to be known of a scan before its cells can be chosen: where it is, and how many cells of a size it fills.
//!
//! A sample says where the bulk of the faces is. One pass over the vertices (of a soup: the faces) then finds the
//! extent and counts cells of the size that the sample suggests, from a choice of them by hash; the sample's estimate,
//! corrected by that count, is within 2 %. Where the estimate was far off, the count is
//! repeated at the corrected size, so that an attempt with a table seldom fails. Where cells need not be that exact, the
//! sample is all there is.
//!
//! A stray vertex, used or not, must not make the grid useless: where the whole extent is more than [`STRAY`] times
//! that of the bulk, the grid is laid about the bulk (see `grid.rs`).

use super::grid::{Grid, Place, cell_key};
use super::sizing::Sizing;
use super::table::{block_key, mix};
use crate::error::Result;
use crate::mesh::{Coordinate, Extent, Frame};
use crate::read::{Crew, Layout, Sample, Scan};
use glam::DVec3;
use rustc_hash::FxHashSet;

/// One corner in so many of the sample's may be astray at each end of an axis.
const ASTRAY: usize = 64;

/// How many times as long as the bulk the whole must be to count as the bulk with something astray.
pub(super) const STRAY: f64 = 64.0;

/// Cells that are counted one by one: the count of all is then within 1 %. Blocks are fewer, and matter less.
const CELLS: usize = 1 << 14;
const BLOCKS: usize = 1 << 11;

/// Corners of a soup's faces that count: on a surface nearly every vertex is the first corner of a face. Where that has
/// misled, all of them.
const LEADING: usize = 1;
const ALL: usize = 3;

/// A turn of counting ends the survey when it changes the side by less than this factor.
const NEAR_ENOUGH: f64 = 1.08;
/// Turns at most.
const TURNS: usize = 4;

/// What the sample's estimate is divided by where nothing corrects it: on scans it is 1.04 to 1.24 times the count, since noise
/// is area that cells do not see, and a table has room for one cell in 16 more than are aimed at.
const OVER: f64 = 1.08;

/// Where the scan is, and how its cells are sized: for at most so many of them, of which so many are enough.
pub(super) fn survey<S: Coordinate>(
    scan: &Scan,
    crew: &Crew,
    sample: &Sample,
    (cells, enough): (usize, usize),
) -> Result<(Place, Sizing)> {
    let mut bulk = bulk(sample);
    let all_alike = bulk.size().max_element() <= 0.0 || !bulk.size().is_finite();
    if all_alike {
        bulk = pass(scan, crew, None, LEADING)?.extent;
        bulk.check(scan.path())?;
    }
    let frame = Frame::around::<S>(&bulk);
    let mut sizing = Sizing::of(sample, frame, scan, cells);
    let mut place = Place::about(frame, &bulk, lowest(sample, &bulk));
    if !all_alike && enough < cells {
        sizing.expect(1.0 / OVER);
        return Ok((place, sizing));
    }
    let mut side = place.side(&sizing);
    for turn in 0..TURNS {
        let found = pass(scan, crew, Some(&Grid::new(place, side)), LEADING)?;
        if turn == 0 && found.extent.size().max_element() <= STRAY * bulk.size().max_element() {
            place = Place::within(frame, &found.extent);
        }
        sizing.learn(side, found.cells, found.blocks);
        let before = side;
        side = place.side(&sizing);
        if (before / NEAR_ENOUGH..before * NEAR_ENOUGH).contains(&side) {
            break;
        }
    }
    Ok((place, sizing))
}

/// Counts the cells and blocks that hold a vertex, within 1 %.
pub(super) fn count(scan: &Scan, crew: &Crew, grid: &Grid) -> Result<(f64, f64)> {
    pass(scan, crew, Some(grid), ALL).map(|found| (found.cells, found.blocks))
}

/// The box that holds all but strays of the sample's corners, and half as much to each side.
fn bulk(sample: &Sample) -> Extent {
    let corners = sample.triangles.as_flattened();
    let mut extent = Extent::default();
    if corners.is_empty() {
        return extent;
    }
    let (mut min, mut max) = ([0.0; 3], [0.0; 3]);
    for axis in 0..3 {
        let mut along: Vec<f64> = corners.iter().map(|p| p[axis]).collect();
        let astray = along.len() / ASTRAY;
        let last = along.len() - 1 - astray;
        min[axis] = *along.select_nth_unstable_by(astray, f64::total_cmp).1;
        max[axis] = *along.select_nth_unstable_by(last, f64::total_cmp).1;
    }
    let (min, max) = (DVec3::from(min), DVec3::from(max));
    let margin = 0.5 * (max - min);
    extent.include(min - margin);
    extent.include(max + margin);
    extent
}

/// The lowest corner of the sample within a box, along each axis: where a flat side is.
fn lowest(sample: &Sample, within: &Extent) -> DVec3 {
    let corners = sample.triangles.as_flattened().iter().map(|p| DVec3::from(*p));
    let inside = corners.filter(|p| p.cmpge(within.min).all() && p.cmple(within.max).all());
    inside.reduce(DVec3::min).unwrap_or(within.min)
}

/// What a pass has found.
struct Found {
    extent: Extent,
    cells: f64,
    blocks: f64,
}

/// The extent of all finite vertices, and with a grid the number of its cells and blocks that hold one.
/// The vertices of a soup are counted from the first `corners` corners of its faces.
fn pass(scan: &Scan, crew: &Crew, grid: Option<&Grid>, corners: usize) -> Result<Found> {
    let seen = match scan.layout() {
        Layout::Indexed => scan.vertices(crew, Seen::default, |seen, chunk| {
            for p in chunk.positions {
                seen.extent.include(DVec3::from(*p));
                seen.see(grid, *p);
            }
            Ok(())
        })?,
        Layout::Soup => scan.soup(crew, Seen::default, |seen, chunk| {
            for face in chunk.triangles {
                face.iter().for_each(|p| seen.extent.include(DVec3::from(*p)));
                face.iter().take(corners).for_each(|p| seen.see(grid, *p));
            }
            Ok(())
        })?,
    };
    let mut all = Seen::default();
    for seen in seen {
        all.extent = all.extent.union(seen.extent);
        all.cells.merge(seen.cells);
        all.blocks.merge(seen.blocks);
    }
    Ok(Found { extent: all.extent, cells: all.cells.total(), blocks: all.blocks.total() })
}

#[derive(Default)]
struct Seen {
    extent: Extent,
    cells: Counted<CELLS>,
    blocks: Counted<BLOCKS>,
    /// The key, plus one, of the cell of the vertex before, in which the next is likely to be, too.
    last: u64,
}

impl Seen {
    /// A vertex is here.
    #[inline(always)]
    fn see(&mut self, grid: Option<&Grid>, p: [f64; 3]) {
        let Some(steps) = grid.and_then(|grid| grid.steps(p)) else { return };
        let cell = cell_key(steps);
        if self.last != cell.wrapping_add(1) {
            self.last = cell.wrapping_add(1);
            self.cells.add(cell);
            self.blocks.add(block_key(steps));
        }
    }
}

/// Distinct keys, one in `1 << halvings` of them, chosen by hash. There are as few halvings as keep the set small: no
/// worker that sees only a part needs more than the whole does, so what is left in the end does not depend on who saw
/// what.
#[derive(Default)]
struct Counted<const MOST: usize> {
    halvings: u32,
    keys: FxHashSet<u64>,
}

impl<const MOST: usize> Counted<MOST> {
    #[inline(always)]
    fn add(&mut self, key: u64) {
        if is_chosen(key, self.halvings) && self.keys.insert(key) {
            self.bound();
        }
    }

    fn bound(&mut self) {
        while self.keys.len() > MOST {
            self.halvings += 1;
            self.keys.retain(|key| is_chosen(*key, self.halvings));
        }
    }

    fn merge(&mut self, other: Self) {
        self.halvings = self.halvings.max(other.halvings);
        self.keys.retain(|key| is_chosen(*key, self.halvings));
        for key in other.keys {
            self.add(key);
        }
    }

    fn total(&self) -> f64 {
        self.keys.len() as f64 * (1u64 << self.halvings) as f64
    }
}

#[inline(always)]
fn is_chosen(key: u64, halvings: u32) -> bool {
    mix(key) >> 20 & ((1 << halvings) - 1) == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_count_is_near_and_the_same_whoever_counts() {
        let keys: Vec<u64> = (0..400_000u64).map(|i| (i % 800) | ((i / 800) << 21) | ((i % 7) << 42)).collect();
        let count = |workers: usize| {
            let mut all = Counted::<CELLS>::default();
            for part in keys.chunks(keys.len().div_ceil(workers)) {
                let mut counted = Counted::<CELLS>::default();
                part.iter().for_each(|key| counted.add(*key));
                all.merge(counted);
            }
            all.total()
        };
        let one = count(1);
        assert_eq!(one, count(3));
        assert_eq!(one, count(50));
        assert!((one / 400_000.0 - 1.0).abs() < 0.03, "{one:?}");
    }

    #[test]
    fn what_is_astray_is_not_the_bulk() {
        let mut triangles = vec![[[0.0, 0.0, 0.0], [1.0, 0.0, 2.0], [0.0, 1.0, 1.0]]; 1000];
        triangles.extend([[[1e9, -1e9, 0.0]; 3]; 10]);
        let bulk = bulk(&Sample { triangles, ..Sample::default() });
        assert_eq!((bulk.min.x, bulk.max.z), (-0.5, 3.0));
    }
}
