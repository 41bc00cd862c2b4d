//! Streaming vertex clustering with quadric representatives, in fixed memory.
//!
//! A grid is laid over the scan, as fine as the table of cells allows. Every face adds its plane, weighted by area, to
//! the cells of its corners; faces whose corners are in three cells survive. Each cell that they use becomes a vertex,
//! placed where the squared distance to the planes it has learnt is least, and hands those planes on as its quadric.
//! After Lindstrom, *Out-of-core simplification of large polygonal models* (2000), and Garland's thesis, §7.1.3.
//!
//! Passes over the scan: extent and a count of cells (`survey.rs`), unless binning's own count will do
//! ([`ClusterOptions::enough_cells`]); vertices to the spill (`spill.rs`); faces to sums and survivors (`faces.rs`,
//! `sums.rs`, `survivors.rs`); where the scan has open borders, faces once more (`border.rs`). A soup has no vertex pass:
//! corners are binned as they come.
//!
//! **Promises.** The result depends on the scan and the options alone, not on threads, nor on the order of faces or
//! vertices beyond the sample that sizes the cells: sums are integers, cells are numbered in Morton order, survivors
//! are sorted. An edge of the result has an odd number of faces only where the scan has open border. Representatives
//! lie in their cells. Where a table overflows, which the scan alone decides, all is thrown away and begun again with
//! larger cells.
//!
//! **Does not promise** a manifold: sheets that are closer than a cell may touch, and a part smaller than a cell
//! vanishes.
//!
//! **Memory** of arrays, in bytes a cell of the table ([`summing_bytes`], [`placing_bytes`]; [`bytes_per_worker`] beside
//! them):
//!
//! | | binning | faces, borders | placement |
//! |---|--:|--:|--:|
//! | block table, 330 a block for 10 cells (a soup keeps it until placement) | 33 | | |
//! | blocks in order, for the ranks | 2 | | |
//! | key | 8 | 8 | 8 |
//! | rank, later the cell's number | 4 | 4 | 8 |
//! | line of sums; side table | | 69 | 69 |
//! | quadric 44, position 12 or 24 | | | 56, 68 |
//! | **in all** | **47** | **81** | **141, 153** |
//!
//! beside 12 bytes for each of `raw_faces` (of which netting and borders are given what survivors leave) and, until
//! placement, up to `spill_resident_bytes`. A spill that does not fit takes 6.5 bytes a vertex of scratch where vertices
//! are in a sensible order, 8 to 10 where they are shuffled (`spill.rs`); a join takes 12 to 28 more a face, buckets in
//! front of a resident spill 6 or 12 (`buckets.rs`). A scan whose survivors, borders or overflowing sums need more than
//! that is clustered again, coarser, or in more passes.

mod border;
mod buckets;
mod corners;
mod faces;
mod grid;
mod join;
mod pages;
mod represent;
mod resident;
mod sampling;
mod shares;
mod sizing;
mod spill;
mod sums;
mod survey;
mod survivors;
mod table;
mod used;

use crate::cores::InPieces;
use crate::error::{Error, Result};
use crate::mesh::{Coordinate, Frame, IndexedMesh, SampleFile, number_used, renumber};
use crate::quadric::PackedQuadric;
use crate::read::{Crew, Layout, Scan};
use crate::scratch::Scratch;
use border::{BorderWorker, Borders};
use buckets::Buckets;
use corners::{Corners, Feed};
use faces::FaceWorker;
use grid::{Grid, Place};
use rayon::prelude::*;
use represent::Evidence;
use sampling::{SampleWorker, Sampler};
use sizing::Sizing;
use spill::{Opened, Spill};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use sums::{Sums, Totals};
use survivors::Survivors;
use table::CellTable;
use used::Used;

/// Where a cell's representative goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Representative {
    /// The point nearest, in the mean square, to the planes of all faces that touch the cell; kept within the cell.
    #[default]
    Quadric,
    /// The mean of the surface in the cell.
    Mean,
}

/// What a clustering may use and how it places.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClusterOptions {
    /// Where representatives go.
    pub representative: Representative,
    /// Cells that are to hold a vertex, at most and nearly.
    pub cells: usize,
    /// So many are enough. Where that is fewer, vertices (of a soup: faces) are passed over once: cells are as large as the
    /// sample suggests, and are counted while vertices are binned.
    pub enough_cells: usize,
    /// Surviving faces that may be held, coincident ones included.
    pub raw_faces: usize,
    /// How much of the binned vertices may be in memory: all of them, if they fit, else a range of a join.
    pub spill_resident_bytes: u64,
    /// Samples of the surface that are to be taken, about; 0 for none.
    pub samples: u64,
    /// Weight of open borders against the surface.
    pub boundary_weight: f64,
    /// What the clustered mesh may be.
    pub limit: MeshLimit,
}

/// How large a mesh may be: what its faces and vertices take together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshLimit {
    /// Bytes a face.
    pub face_bytes: u64,
    /// Bytes a vertex.
    pub vertex_bytes: u64,
    /// Bytes in all.
    pub bytes: u64,
}

impl MeshLimit {
    /// How many times as much as is allowed a mesh takes.
    fn excess(&self, faces: usize, vertices: usize) -> f64 {
        let bytes = faces as f64 * self.face_bytes as f64 + vertices as f64 * self.vertex_bytes as f64;
        bytes / (self.bytes as f64).max(1.0)
    }
}

/// A clustered scan.
#[derive(Debug)]
pub struct Clustered<S> {
    /// A vertex a cell that a surviving face uses, in Morton order; faces sorted.
    pub mesh: IndexedMesh<S>,
    /// Between the file's units and the mesh's.
    pub frame: Frame,
    /// What each vertex's cell has learnt, about the vertex, in the frame.
    pub quadrics: Vec<PackedQuadric>,
    /// Samples of the scan's surface, each near a cell, if they were asked for.
    pub samples: Option<SampleFile>,
    /// The vertex of each such cell; [`u32::MAX`] where it has none. Empty without samples.
    pub homes: Vec<u32>,
    /// What was counted.
    pub stats: ClusterStats,
}

/// What a clustering counted.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ClusterStats {
    /// Cells that hold a vertex.
    pub occupied_cells: u64,
    /// Side of a cell in the file's units.
    pub cell_size: f64,
    /// Passes over the vertices (a soup: over the faces) until the cells were right.
    pub attempts: u32,
    /// How many of them overflowed.
    pub overflows: u32,
    /// Faces that repeat a corner in the scan itself.
    pub repeated_corner_faces: u64,
    /// Faces without area, as far as the 8192nd part of a cell shows it, whose corners differ.
    pub flat_faces: u64,
    /// Vertices that no face uses but such as repeat a corner; `None` where there was no room to count them.
    pub unreferenced_vertices: Option<u64>,
    /// Faces with corners in three cells, coincident ones included.
    pub surviving_faces: u64,
    /// Pairs of coincident faces of opposite orientation that were taken out.
    pub opposite_pairs: u64,
    /// Cells with open border.
    pub border_cells: u64,
    /// Cells whose sums outgrew 32 bits.
    pub outgrown_cells: u64,
    /// The most bytes that scratch held at one time.
    pub scratch_bytes: u64,
}

/// Most cells that a table can have.
pub use grid::MAX_CELLS;

/// Bytes of arrays for `cells` cells while the scan streams past, beside those of `raw_faces` and the spill.
pub const fn summing_bytes(cells: usize, layout: Layout) -> u64 {
    let room = room(cells);
    let ordering = CellTable::block_capacity(room) * 20;
    let binned = CellTable::bytes(room) + ordering + room * 4;
    let sums = sums::bytes_for(room);
    let summed = match layout {
        Layout::Indexed => sums + room * 12,
        Layout::Soup => sums + binned,
    };
    (if summed > binned { summed } else { binned }) as u64
}

/// Bytes of arrays for `cells` cells while representatives are placed, beside the faces.
pub const fn placing_bytes(cells: usize, double: bool) -> u64 {
    let a_cell = 16 + size_of::<PackedQuadric>() + if double { 24 } else { 12 };
    (sums::bytes_for(room(cells)) + room(cells) * a_cell) as u64
}

/// Cells that the table has room for: more than are aimed at, since the count that their size is chosen by is not exact.
const fn room(cells: usize) -> usize {
    let room = cells + cells / 16 + 64;
    if room < MAX_CELLS { room } else { MAX_CELLS }
}

/// Bytes that each of `raw_faces` takes.
pub const BYTES_PER_RAW_FACE: usize = survivors::TRIPLE_BYTES;

/// Bytes that a worker takes, beside what reading does and [`bytes_per_spill_worker`].
pub const fn bytes_per_worker() -> usize {
    let taking = faces::BATCH_BYTES + survivors::APPENDER_BYTES + sampling::WORKER_BYTES + corners::FEED_BYTES;
    let with_faces = taking + sums::CACHE_BYTES;
    if with_faces > corners::BINNING_BYTES { with_faces } else { corners::BINNING_BYTES }
}

/// Bytes that a worker takes for a spill that is not resident.
pub const fn bytes_per_spill_worker() -> usize {
    if spill::PAGE_CACHE_BYTES > join::WORKER_BYTES { spill::PAGE_CACHE_BYTES } else { join::WORKER_BYTES }
}

/// Bytes of the binned vertices of an indexed scan, all of them resident, and of an account of those that faces use, which
/// is kept where cells are too many to note that beside the vertices.
pub fn resident_spill_bytes(vertices: u64) -> u64 {
    vertices.saturating_mul(8).saturating_add(used::bytes_for(vertices))
}

/// Clusters a scan. `S` should be the scalar that loses nothing of the scan's coordinates.
pub fn cluster<S: Coordinate>(
    scan: &Scan,
    crew: &Crew,
    scratch: &Scratch,
    options: &ClusterOptions,
) -> Result<Clustered<S>> {
    let sample = scan.sample(crew, SAMPLE)?;
    let order = match (sample.blocks_per_triangle < COHERENT, sample.wide_triangles < WIDE) {
        (true, _) => Order::Sensible,
        (false, true) => Order::ShuffledFaces,
        (false, false) => Order::Shuffled,
    };
    let (place, mut sizing) = survey::survey::<S>(scan, crew, &sample, (options.cells, options.enough_cells))?;
    drop(sample);
    let stats = ClusterStats::default();
    let mut run = Run { scan, crew, scratch, options, place, order, buckets: None, coarser_weights: 1.0, stats };
    if order == Order::ShuffledFaces && run.has_room_for_buckets() {
        run.buckets =
            Buckets::fill(scan, crew, scratch, false).map(Some).or_else(|error| run.without_buckets(error))?;
    }
    let learnt = loop {
        run.stats.attempts += 1;
        if let Some(learnt) = run.attempt(&mut sizing)? {
            break learnt;
        }
        crew.progress.check()?;
    };
    run.finish(learnt)
}

/// Triangles that are looked at to choose the size of cells.
const SAMPLE: usize = 20_000;
/// Blocks of 512 vertices that a face touches in a scan in sensible order, at most.
const COHERENT: f64 = 0.3;
/// Share of triangles that are wider than a bucket in a scan whose vertices are in sensible order, at most.
const WIDE: f64 = 0.5;
/// Overflows after which cells double.
const PATIENCE: u32 = 3;

/// In what order a scan is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Order {
    /// Neighbours in the file are neighbours in space.
    Sensible,
    /// That holds for vertices, not for faces.
    ShuffledFaces,
    /// Nor for vertices.
    Shuffled,
}

/// A clustering under way.
struct Run<'a> {
    scan: &'a Scan,
    crew: &'a Crew<'a>,
    scratch: &'a Scratch,
    options: &'a ClusterOptions,
    place: Place,
    order: Order,
    /// For a spill that is resident, if that is worth while.
    buckets: Option<Buckets>,
    /// What the unit of weight is to be multiplied by.
    coarser_weights: f64,
    stats: ClusterStats,
}

/// What an attempt that did not overflow leaves.
struct Learnt {
    grid: Grid,
    table: CellTable,
    spill: Option<Spill>,
    quantum: f64,
    totals: Totals,
    ranks: Vec<u32>,
    samples: Option<SampleFile>,
    /// Netted.
    triples: Vec<[u32; 3]>,
}

impl Run<'_> {
    /// One turn with cells of the size that `sizing` now says; `None` if another size is to be tried.
    fn attempt(&mut self, sizing: &mut Sizing) -> Result<Option<Learnt>> {
        let overflows = self.stats.overflows;
        let doubled = f64::from(1u32 << overflows.saturating_sub(PATIENCE).min(24));
        let grid = Grid::new(self.place, self.place.side(sizing) * doubled);
        let room = room(self.options.cells);
        let mut table = CellTable::new(room);
        let resident_bytes = self.spill_resident_bytes();
        // Faces from buckets do, as far as a worker's cache goes.
        let faces_cohere = self.order == Order::Sensible || self.buckets.is_some();
        let (mut spill, mut ranks) = (None, Vec::new());
        let mut cells = sizing.occupied(grid.cell).max(1.0);
        if self.scan.layout() == Layout::Indexed {
            let mut s = Spill::new(self.scan.vertex_count(), resident_bytes, self.scratch, faces_cohere)?;
            corners::bin_vertices(self.scan, self.crew, (&grid, &table), self.order != Order::Shuffled, &mut s)?;
            if table.is_full() {
                drop((table, s));
                return self.overflowed(&grid, sizing);
            }
            if !sizing.has_learnt() && table.len() < self.options.enough_cells {
                sizing.learn(grid.cell, table.len() as f64, table.blocks() as f64);
                return Ok(None);
            }
            cells = (table.len() as f64).max(1.0);
            ranks = table.ranks();
            table.keep_keys();
            spill = Some(s);
        }
        let used = match spill.as_ref().is_some_and(Spill::notes_used) {
            true => Used::nothing(),
            false => Used::within(self.scan, self.options.spill_resident_bytes),
        };
        let quantum = self.coarser_weights * quantum(sizing.area(grid.cell) / cells);
        let mut totals = Totals::new(if spill.is_some() { table.len() } else { room }, faces_cohere)
            .map_err(Error::io(self.scan.path(), "there is no memory for what its cells learn"))?;
        let sums = Sums::of(&mut totals);
        let survivors = Survivors::new(self.options.raw_faces);
        let sampler = match self.options.samples {
            0 => None,
            wanted => {
                let area = (sizing.area(grid.cell), quantum);
                let lattice = self.place.lattice(&grid, table.cells());
                Some(Sampler::new((&grid, &table), lattice, area, wanted, self.scratch)?)
            }
        };
        let worker = || {
            let samples = sampler.as_ref().map(SampleWorker::new);
            FaceWorker::new(&table, &sums, &survivors, samples, quantum, faces_cohere)
        };
        let feeds = corners::stream(self.scan, self.crew, &self.corners(spill.as_mut(), &grid, &table), &used, worker)?;
        self.check(&feeds)?;
        self.stats.repeated_corner_faces = feeds.iter().map(|feed| feed.repeated).sum();
        self.stats.flat_faces = feeds.iter().map(|feed| feed.sink.flat_faces).sum();
        self.stats.unreferenced_vertices =
            spill.as_ref().and_then(Spill::unused).or_else(|| used.unused(self.scan.vertex_count()));
        for mut feed in feeds {
            feed.sink.flush();
        }
        let too_heavy = sums.overflowed();
        drop(used);
        let samples = sampler.map(Sampler::finish).transpose()?;
        if table.is_full() {
            drop((table, totals, survivors));
            return self.overflowed(&grid, sizing);
        }
        if spill.is_none() && !sizing.has_learnt() && table.len() < self.options.enough_cells {
            sizing.learn(grid.cell, table.len() as f64, table.blocks() as f64);
            return Ok(None);
        }
        if survivors.overflowed() {
            return Ok(self.coarsen(sizing, survivors.count() as f64 / (self.options.raw_faces as f64).max(1.0)));
        }
        if too_heavy {
            self.coarser_weights *= 64.0;
            return Ok(None);
        }
        let mut triples = survivors.into_triples();
        if spill.is_none() {
            ranks = table.ranks();
        }
        self.stats.surviving_faces = triples.len() as u64;
        let left = (self.options.raw_faces - triples.len()) * BYTES_PER_RAW_FACE;
        self.stats.opposite_pairs = survivors::net(&mut triples, &ranks, left, self.crew.progress)?;
        let excess = self.options.limit.excess(triples.len(), ranks.len());
        if excess > 1.0 {
            return Ok(self.coarsen(sizing, excess));
        }
        triples.shrink_to_fit();
        Ok(Some(Learnt { grid, table, spill, quantum, totals, ranks, samples, triples }))
    }

    /// Learns from a table that had no room.
    fn overflowed<T>(&mut self, grid: &Grid, sizing: &mut Sizing) -> Result<Option<T>> {
        self.stats.overflows += 1;
        let (cells, blocks) = survey::count(self.scan, self.crew, grid)?;
        sizing.learn(grid.cell, cells, blocks);
        Ok(None)
    }

    /// Has the next attempt make do with less.
    fn coarsen<T>(&mut self, sizing: &mut Sizing, excess: f64) -> Option<T> {
        self.stats.overflows += 1;
        sizing.expect(1.05 * excess);
        None
    }

    /// What the account of used vertices leaves for binned ones.
    fn spill_resident_bytes(&self) -> u64 {
        let bytes = self.options.spill_resident_bytes;
        bytes - Used::bytes_within(self.scan, bytes)
    }

    /// Whether binned vertices are resident and faces in buckets leave half of scratch to others.
    fn has_room_for_buckets(&self) -> bool {
        Spill::is_resident(self.scan.vertex_count(), self.spill_resident_bytes())
            && self.scan.triangle_count().saturating_mul(buckets::FACE_BYTES) <= self.scratch.left() / 2
    }

    /// A disk that is full is no reason to give up what can be done without buckets; any other error is.
    fn without_buckets(&self, error: Error) -> Result<Option<Buckets>> {
        if error.file() == Some(self.scratch.folder()) { Ok(None) } else { Err(error) }
    }

    fn corners<'b>(&'b self, spill: Option<&'b mut Spill>, grid: &'b Grid, table: &'b CellTable) -> Corners<'b> {
        let coherent = self.order == Order::Sensible;
        match (spill.map(Spill::open), &self.buckets) {
            (None, _) => Corners::Soup(grid, table),
            (Some(Opened::Resident(all)), Some(buckets)) => Corners::Sorted(all, buckets),
            (Some(Opened::Resident(all)), None) => Corners::Resident { all, coherent },
            (Some(Opened::Filed(spill)), _) if coherent => Corners::Paged(spill),
            (Some(Opened::Filed(spill)), _) => {
                let resident_bytes = self.options.spill_resident_bytes;
                Corners::Joined { spill, scratch: self.scratch, resident_bytes }
            }
        }
    }

    fn check<K>(&self, feeds: &[Feed<K>]) -> Result<()> {
        match feeds.iter().filter_map(|feed| feed.nowhere).min() {
            None => Ok(()),
            Some(vertex) => Err(self.nowhere(vertex)),
        }
    }

    fn nowhere(&self, vertex: u64) -> Error {
        let what = "a coordinate is not finite, or beyond all measure far from the rest, but a face uses it".into();
        self.scan.vertex_error(vertex, what)
    }

    /// Cells whose borders can be summed at one time: in what survivors have left of their room.
    fn open_at_once(&self, triples: usize, cells: usize) -> usize {
        let room = BYTES_PER_RAW_FACE * self.options.raw_faces;
        let taken = BYTES_PER_RAW_FACE * triples + border::BYTES_A_CELL * cells;
        (room.saturating_sub(taken) / border::BYTES_AN_OPEN_CELL).max(cells / 16).max(1)
    }

    /// Holds borders, places representatives.
    fn finish<S: Coordinate>(mut self, learnt: Learnt) -> Result<Clustered<S>> {
        let Learnt { grid, mut table, mut spill, quantum, mut totals, ranks, samples, mut triples } = learnt;
        let frame = self.place.frame();
        self.stats.occupied_cells = ranks.len() as u64;
        self.stats.outgrown_cells = totals.outgrown() as u64;
        self.stats.cell_size = frame.to_file(grid.cell);
        let open = border::open_cells(&triples, ranks.len());
        self.stats.border_cells = open.iter().filter(|open| **open).count() as u64;
        for ranks_together in border::shares(&open, self.open_at_once(triples.len(), ranks.len())) {
            let borders = Borders::new(&open, &ranks, ranks_together);
            let worker = || BorderWorker { table: &table, borders: &borders };
            let corners = self.corners(spill.as_mut(), &grid, &table);
            corners::stream(self.scan, self.crew, &corners, &Used::nothing(), worker)?;
            borders.add_to(&mut totals, self.options.boundary_weight, quantum);
        }
        drop((spill, self.buckets.take()));
        self.stats.scratch_bytes = self.scratch.bytes();
        table.keep_keys();
        let cells = compact(&mut triples, ranks);
        let evidence = Evidence {
            representative: self.options.representative,
            grid: &grid,
            table: &table,
            totals: &totals,
            quantum,
        };
        let (positions, quadrics) = evidence.represent(&cells);
        let all_cells = table.len();
        let homes = || {
            let mut homes = vec![u32::MAX; all_cells];
            cells.iter().zip(0..).for_each(|(cell, vertex)| homes[*cell as usize] = vertex);
            homes
        };
        let homes = || if samples.is_some() { homes() } else { Vec::new() };
        let ((), homes) = rayon::join(|| drop((totals, table)), homes);
        let mesh = IndexedMesh { positions, faces: triples };
        Ok(Clustered { mesh, frame, quadrics, samples, homes, stats: self.stats })
    }
}

/// The unit of weight, in cells², for cells that touch `mean_area` cells² of surface on average. A face counts for up
/// to three cells, so the mean weight is at most three times that, and at most one cell in 85 has more than the 256
/// times that a line holds: the side table stays below 3 bytes a cell. A face of a fiftieth of a cell still weighs 10⁵
/// quanta.
fn quantum(mean_area: f64) -> f64 {
    let line = 256.0 * mean_area;
    if line.is_finite() && line > 0.0 { line / (1u64 << 31) as f64 } else { 1.0 / (1 << 24) as f64 }
}

/// Drops cells that no triple uses and renumbers the rest without gaps. Returns the number each had in the table.
fn compact(triples: &mut [[u32; 3]], ranks: Vec<u32>) -> Vec<u32> {
    let (numbers, used) = number_used(triples, ranks.len());
    renumber(triples, &numbers);
    let cells: Vec<AtomicU32> = bytemuck::zeroed_vec(used);
    ranks.into_par_iter().enumerate().in_pieces(4096).for_each(|(cell, rank)| {
        if let Some(place) = cells.get(numbers[rank as usize] as usize) {
            place.store(cell as u32, Relaxed);
        }
    });
    cells.into_iter().map(AtomicU32::into_inner).collect()
}

#[cfg(test)]
mod tests;
