//! What a memory budget buys for a scan: in core or out of core, and with how many cells.
//!
//! All sizes of a run follow from the scan, the ask and the budget, never from the threads or the machine, so that neither
//! can change a byte of the result. The arithmetic, in bytes:
//!
//! | | resident |
//! |---|---|
//! | always | 12 MiB (program, stacks, allocator) and what a streaming pass maps and decodes |
//! | in core, loading | 12 a face, 16 a vertex and a hash table of 6 to 12 (28 and the table in doubles) |
//! | in core, collapse | 36 a face, 109 a vertex (133): about 91 a face on closed scans |
//! | out of core, binning | the cell table (27 + 8 a cell), and the binned vertices, 8 each, where they fit |
//! | out of core, summing | the same, 64 a cell for its sums and 12 a surviving face |
//! | out of core, collapse | as in core, for the intermediate mesh: about two faces a cell |
//!
//! Out of core the intermediate mesh is [`AIM`] times as large as the result where that fits, and at least [`LEAST_RATIO`]
//! times: below that clustering does most of the reduction and the result is no better than clustering's.

use crate::budget::MIB;
use crate::cluster;
use crate::collapse;
use crate::error::{Error, Result};
use crate::measure;
use crate::mesh::Coordinate;
use crate::read::{Crew, Layout, Scan, load_peak_bytes};

/// Resident before any stage has allocated: 6 MiB of program, libraries and stacks, measured, and as much again for what
/// allocators keep back.
const BASE_BYTES: u64 = 12 * MIB;

/// Intermediate : target that is aimed at.
pub const AIM: f64 = 10.0;

/// Intermediate : target below which a budget is refused.
pub const LEAST_RATIO: f64 = 2.0;

/// Faces of the intermediate mesh for each cell that the table has room for, when as full as it should be.
const FACES_A_CELL: f64 = 1.6;

/// Faces that may survive clustering for each cell, coincident ones included; more coarsens the grid.
const SURVIVORS_A_CELL: usize = 5;

/// The fewest cells that are worth clustering into.
const LEAST_CELLS: usize = 4096;

/// Sizes of the cell table, for a scan that does not fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cells {
    /// Cells that the table is to have room for.
    pub wanted: usize,
    /// The most that the budget has room for.
    pub most: usize,
}

/// A budget and the hands that share it.
#[derive(Debug, Clone, Copy)]
pub struct Purse {
    bytes: u64,
    /// Threads that streaming passes may use: windows and caches are paid for each.
    pub workers: usize,
}

impl Purse {
    /// Of `bytes`, at most a quarter for what `threads` workers of a streaming pass need: fewer of them work if need be.
    pub fn new(bytes: u64, threads: usize) -> Self {
        let fits = |n: &usize| streaming_bytes(*n) <= bytes / 4;
        let workers = (1..=threads).rev().find(fits).unwrap_or(1);
        Purse { bytes, workers }
    }

    /// What is left for a stage's arrays. It does not depend on the workers: their share is set aside as a whole.
    pub fn for_arrays(&self) -> u64 {
        self.bytes.saturating_sub(BASE_BYTES + aside(self.bytes))
    }

    /// If `scan` fits the budget as a whole: the number of distinct vertices for which it does. Only a soup can turn out
    /// to have more.
    pub fn in_core<S: Coordinate>(&self, scan: &Scan) -> Option<u64> {
        let faces = scan.triangle_count();
        let arrays = self.for_arrays();
        let a_vertex = collapse::bytes::<S>(0, 1);
        let most_vertices = arrays.checked_sub(collapse::bytes::<S>(faces, 0))? / a_vertex;
        let fits = match scan.layout() {
            Layout::Indexed => scan.vertex_count() <= most_vertices && load_peak_bytes(scan) <= arrays,
            // A closed soup has half as many vertices as faces. How many it really has shows while it is welded.
            Layout::Soup => faces / 2 <= most_vertices,
        };
        fits.then_some(most_vertices)
    }

    /// The cells for a scan that does not fit, of which `target` faces are asked, or as few as an error bound allows.
    pub fn out_of_core<S: Coordinate>(&self, scan: &Scan, target: Option<u64>) -> Result<Cells> {
        let most_cells = self.most_cells::<S>();
        let least_cells = target.map_or(0, |n| cells_for(n, LEAST_RATIO)).max(LEAST_CELLS);
        if most_cells < least_cells {
            let out_of_core = bytes_for::<S>(least_cells);
            let needed_bytes = total_for(out_of_core).min(in_core_budget::<S>(scan));
            let ask = target.map_or("the error bound".into(), |n| format!("{n} faces"));
            let what = format!("{} cannot be reduced to {ask} within this budget", scan.path().display());
            return Err(Error::Budget { what, needed_bytes });
        }
        let wanted = target.map_or(most_cells, |n| cells_for(n, AIM)).max(LEAST_CELLS);
        Ok(Cells { wanted: wanted.min(most_cells), most: most_cells })
    }

    fn most_cells<S: Coordinate>(&self) -> usize {
        let a_cell = bytes_for::<S>(1 << 20) as f64 / f64::from(1 << 20);
        ((self.for_arrays() as f64 / a_cell) as usize).min(cluster::MAX_CELLS)
    }

    /// Clustering's options for a table of `cells`.
    pub fn cluster_options<S: Coordinate>(&self, cells: usize) -> (usize, u64) {
        let raw_faces = SURVIVORS_A_CELL * cells;
        let taken = cluster_bytes::<S>(cells);
        (raw_faces, self.for_arrays().saturating_sub(taken))
    }
}

// A pass of measuring is paid for like one of clustering.
const _: () = assert!(measure::bytes_per_worker() <= cluster::bytes_per_worker());

/// What so many workers of a streaming pass take.
fn streaming_bytes(workers: usize) -> u64 {
    Crew::stream_bytes(workers) + (workers * cluster::bytes_per_worker()) as u64
}

/// What clustering takes for a table of `cells`, the binned vertices aside.
fn cluster_bytes<S: Coordinate>(cells: usize) -> u64 {
    let a_cell = cluster::bytes_per_cell(S::DOUBLE) + SURVIVORS_A_CELL * cluster::BYTES_PER_RAW_FACE;
    cells as u64 * a_cell as u64
}

/// What is set aside for streaming.
fn aside(bytes: u64) -> u64 {
    (bytes / 4).min(streaming_bytes(8))
}

/// Cells for an intermediate mesh of `ratio` times `target` faces.
fn cells_for(target: u64, ratio: f64) -> usize {
    (target as f64 * ratio / FACES_A_CELL).ceil() as usize
}

/// Bytes of arrays at the peak, out of core, for a table of `cells`.
fn bytes_for<S: Coordinate>(cells: usize) -> u64 {
    let collapse = collapse::bytes::<S>(2 * cells as u64 + cells as u64 / 8, cells as u64);
    let sums = cluster_bytes::<S>(cells);
    collapse.max(sums)
}

/// A budget in which `scan` fits as a whole, whatever it holds. A soup is taken to share no vertex.
pub fn in_core_budget<S: Coordinate>(scan: &Scan) -> u64 {
    total_for(load_peak_bytes(scan).max(collapse::bytes::<S>(scan.triangle_count(), scan.vertex_count())))
}

/// The least budget whose arrays have that many bytes, in whole mebibytes.
pub fn total_for(arrays: u64) -> u64 {
    let small = (arrays.saturating_add(BASE_BYTES)) / 3 * 4 + MIB;
    let large = arrays.saturating_add(BASE_BYTES + streaming_bytes(8)) + MIB;
    if aside(small) == small / 4 { small } else { large }
}
