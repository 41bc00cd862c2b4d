//! What a memory budget buys for a scan: in core or out of core, and with how many cells.
//!
//! All sizes of a run follow from the scan, the ask and the budget, never from the threads or the machine, so that
//! neither can change a byte of the result. What lives at the same time, in bytes:
//!
//! | | resident |
//! |---|---|
//! | always | 13 MiB (program, stacks, allocator) |
//! | while streaming | what a pass maps and decodes, and windows on a spill: a quarter, at most what eight workers need |
//! | in core, loading | 12 a face, 16 a vertex and a hash table of 6 to 12 (28 and the table in doubles) |
//! | out of core, summing | 81 a cell (soups: 116), 12 a surviving face, 8 a vertex where these fit in what is left |
//! | out of core, placing | 141 a cell (153), 12 a face; nothing is streaming any more |
//! | threads | 1.5 MiB each (stacks, heaps of their own); a 24th of the budget is set aside, and fewer run if need be |
//! | collapse | 36 a face, 113 a vertex (161), and a fourteenth: about 99 a face on closed scans |
//! | and its reference | 12 a face, 16 a vertex (28) where it begins within twenty times the target; 4 a vertex where samples do |
//! | its last steps | 96 a face that is asked for, where those of the rounds' lists that are gone are not as much |
//! | what steers | 12 a vertex of the collapse for colours; what corners carry: 12 a face, 84 a vertex and 20 a wedge more |
//! | refit | 180 a face that is asked for, 24 a sample, and a fourteenth |
//!
//! Out of core the collapse decides how many cells there are: 240 bytes each, two faces a cell. Scans differ, so the
//! faces of the clustered mesh are counted before it is placed; one that is too large is clustered again, coarser.
//!
//! The intermediate mesh is [`AIM`] times as large as the result where that fits. Below [`LOW_RATIO`] times clustering
//! would do most of the reduction, and the result be little better than clustering's: then the scan is cut into tiles
//! on scratch, each small enough to be collapsed ([`TilePlan`]). What cannot be done in tiles (coarser meshes of the
//! result) is clustered down to [`LEAST_RATIO`].
//!
//! | in tiles | resident |
//! |---|---|
//! | cutting up | what a pass takes, a quarter of the rest for vertices' positions and a quarter for what writers sort |
//! | first sweep | 99 (120) a face of a tile, and 20 a sample of it |
//! | sweeps after it | the same of what is left, 44 a sample |
//! | last step | 180 a face of a tile's result, 44 a sample; 20 a face of the whole for the collapses that are chosen from |
//! | sweeps and last step | the same again for the tile before and the tile after, where that fits |
//! | joining, writing | 18 (24) a face of the result |

use crate::budget::MIB;
use crate::cluster::{self, MeshLimit};
use crate::collapse;
use crate::error::{Error, Result};
use crate::measure;
use crate::mesh::Coordinate;
use crate::mesh::samples::SAMPLE_BYTES;
use crate::read::{Crew, Layout, Scan, load_peak_bytes};
use crate::refit;
use crate::tiles;

/// Resident before any stage has allocated, measured: program, libraries and stacks take 8 MiB as released, and 12 MiB
/// when built with checks and without link-time optimisation; the rest is what allocators keep back.
const BASE_BYTES: u64 = 13 * MIB;

/// Intermediate : target that is aimed at: 12 is 3 % closer to a large and noisy scan, and takes a tenth longer.
pub const AIM: f64 = 10.0;

/// Intermediate : target below which a budget is refused.
pub const LEAST_RATIO: f64 = 2.0;

/// Intermediate : target below which clustering shows: at 3.8 E_avg is 1.37 times that in core, and in tiles 1.01 to
/// 1.05.
pub const LOW_RATIO: f64 = 4.0;

/// Faces of the intermediate mesh for each cell that is aimed at: a closed surface has two a vertex, the count of cells
/// is within 2 %, and some cells hold no face that survives.
const FACES_A_CELL: f64 = 1.95;

/// Faces that may survive clustering for each cell, coincident ones included; more coarsens the grid. Scans have 2.1.
const SURVIVORS_A_CELL: usize = 4;

/// What collapse and refit take beside their arrays, as a share of them: lists of a round, what allocators keep back.
const MARGIN: f64 = 0.07;

/// What of so many bytes is left for arrays.
fn without_margin(bytes: u64) -> u64 {
    (bytes as f64 / (1.0 + MARGIN)) as u64
}

/// What the lists of the collapse's rounds take, for each vertex that came in; they are gone when the last steps begin.
const ROUND_BYTES: u64 = 24;

/// What samples of the scan may take of scratch, for each of its vertices, and what where these are on scratch, too, so
/// that both together take 8. Eight a face in place of 34 cost a tenth of E_avg.
const SAMPLE_SCRATCH_BYTES: f64 = 7.0;
const SAMPLE_SCRATCH_BESIDE_BYTES: f64 = 1.4;
/// Scratch that no scan is too small for.
const LEAST_SAMPLE_SCRATCH_BYTES: u64 = 64 * MIB;
/// Where cells are coarser than the intermediate mesh that is aimed at asks for, samples make up for some of it: as
/// many more as the square of what is missing, up to this. On a noisy scan at eight times the target 60 in place of 40
/// a face lower E_avg by 0.8 %.
const MOST_COARSER: f64 = 2.0;
/// By how much more surface a scan may have than its sample shows before samples are thinned.
const SAMPLES_MARGIN: f64 = 1.15;

/// What a thread takes: its stack, and what its part of the heap keeps back.
const THREAD_BYTES: u64 = 3 * MIB / 2;
/// The share of the budget that is set aside for threads.
const THREADS_SHARE: u64 = 24;
/// Threads at most: more than any machine that this is for has cores, and few enough for their stacks.
const MOST_THREADS: u64 = 64;

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

impl Cells {
    /// The share of what is wanted that is enough where the budget has room for more.
    const ENOUGH: f64 = 0.85;

    /// How many are enough: where there is room for more, a tenth more or less is not worth a pass over the scan (E_avg of
    /// twenty results is 0.73 to 1.25 times what it was with a count first, in the mean the same).
    pub fn enough(&self) -> usize {
        if self.wanted < self.most { (Self::ENOUGH * self.wanted as f64) as usize } else { self.wanted }
    }
}

/// The way a scan that does not fit goes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Way {
    /// Through cells, to a mesh that fits.
    Clustered(Cells),
    /// In tiles on scratch: the result is too large for cells.
    Tiled(TilePlan),
}

/// Sizes of tiles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TilePlan {
    /// Faces of the scan in a tile, at most.
    pub faces: u64,
    /// Bytes for tiles that are in memory together.
    pub bytes: u64,
    /// Bytes that a tile of the scan takes for each of its faces, while it is loaded and collapsed.
    pub first_face_bytes: u64,
    /// The same of a tile of what is left of it, until it is part of the result.
    pub later_face_bytes: u64,
    /// Samples of the scan, 0 for none.
    pub samples: u64,
    /// Bytes that each of those who cut may hold back.
    pub writer_bytes: u64,
    /// Bytes for positions of vertices while faces stream past.
    pub position_bytes: u64,
}

impl TilePlan {
    /// What scratch holds at most, for a scan of so many faces and a result of so many, about: the scan cut up and what
    /// the first sweep has left of it, with its samples, or those before and after another sweep.
    pub fn scratch_bytes<S: Coordinate>(&self, faces: u64, target: u64) -> u64 {
        let face = 3 * size_of::<[S; 3]>() as u64;
        let samples = tiles::sample_bytes::<S>() as u64 * self.samples;
        let scan = face.saturating_mul(faces);
        scan.max(samples).saturating_add(samples).saturating_add(face.saturating_mul(3).saturating_mul(target))
    }
}

/// Samples of the scan for each face of a result that is made in tiles: scratch has to hold them twice.
const TILE_SAMPLES: f64 = 16.0;
/// The most samples for each face of the scan, and the fewest for one of the result that are worth it.
const TILE_SAMPLES_A_FACE: f64 = 1.5;
const LEAST_TILE_SAMPLES: f64 = 6.0;
/// How many times as many faces as its share a tile may have once it has been collapsed: where a scan is rough, and until
/// the last collapses are chosen.
const TILE_SLACK: f64 = 1.6;
/// What lists of where records are take, counts of blocks, and buffers; budgets that leave less than four times as much
/// are too small for tiles.
const TILE_LISTS_BYTES: f64 = 2.0 * MIB as f64;
/// The share of a scan's faces that tiles are good for: the first sweep leaves a fifth more than is asked.
const MOST_TILE_SHARE: f64 = 0.75;
/// What is known of the last collapses, for each face of the result.
const PROPOSAL_BYTES: f64 = 20.0;
/// The fewest faces of the result in a tile, since vertices at its cuts stay: E_avg is 1.34 times that in core with 170
/// of them, 1.03 with 4,800, 1.006 with 17,000.
const LEAST_TILE_FACES: f64 = 2000.0;

/// What is to be paid for.
#[derive(Debug, Clone, Copy, Default)]
pub struct Ask {
    /// Faces that are asked for; 0 for as few as an error bound allows.
    pub target: u64,
    /// Rounds of refit.
    pub refit_rounds: u32,
    /// What the last steps of the collapse take.
    pub tail_bytes: u64,
    /// What steers, beside a vertex's position.
    pub shade_bytes: u64,
    /// What corners and faces carry into the collapse of the scan itself, for each of its vertices.
    pub coat_bytes: u64,
    /// What carrying over takes, beside the result.
    pub carry_bytes: u64,
    /// Whether coarser meshes are made of the result, which then has to fit a collapse.
    pub is_chain: bool,
}

/// A budget and the hands that share it.
#[derive(Debug, Clone, Copy)]
pub struct Purse {
    bytes: u64,
    ask: Ask,
    /// Threads that streaming passes may use: windows and caches are paid for each.
    pub workers: usize,
}

impl Purse {
    /// Of `bytes`, at most a quarter for what `threads` workers of a streaming pass need: fewer of them work if need be.
    pub fn new(bytes: u64, threads: usize, ask: Ask) -> Self {
        let fits = |n: &usize| streaming_bytes(*n) <= aside(bytes);
        let workers = (1..=threads).rev().find(fits).unwrap_or(1);
        Purse { bytes, ask, workers }
    }

    /// The same with nothing in it: whatever is asked of it is refused, with a budget that would do.
    pub fn poorest(&self) -> Self {
        Purse { bytes: 0, ..*self }
    }

    /// What is left for arrays while nothing streams.
    fn for_arrays(&self) -> u64 {
        self.bytes.saturating_sub(BASE_BYTES + most_threads(self.bytes) as u64 * THREAD_BYTES)
    }

    /// What is left for arrays while a scan streams past. It does not depend on the workers: their share is set aside
    /// as a whole.
    pub fn while_streaming(&self) -> u64 {
        self.for_arrays().saturating_sub(aside(self.bytes))
    }

    /// What the collapse's own arrays may take if it begins with so many vertices.
    fn for_collapse(&self, vertices: u64) -> u64 {
        let tail = self.ask.tail_bytes.saturating_sub(ROUND_BYTES.saturating_mul(vertices));
        without_margin(self.for_arrays().saturating_sub(tail))
    }

    /// What a collapse takes that begins within twenty times the target, with or without samples of the scan. The refit,
    /// after it, takes less, or has fewer samples.
    fn near_bytes<S: Coordinate>(&self, faces: u64, vertices: u64, sampled: bool) -> u64 {
        let kept = if self.keeps_reference(sampled) { collapse::reference_bytes::<S>(faces, vertices) } else { 0 };
        let shades = self.ask.shade_bytes * vertices;
        collapse::bytes::<S>(faces, vertices) + kept + shades + if sampled { 4 * vertices } else { 0 }
    }

    /// Whether the collapse is to keep a reference: samples of the scan make do without in the first round.
    pub fn keeps_reference(&self, sampled: bool) -> bool {
        self.ask.refit_rounds > u32::from(sampled)
    }

    /// Whether samples of a scan that is clustered are worth taking.
    fn is_sampled(&self, scan: &Scan) -> bool {
        self.samples(scan, AIM) > 0
    }

    /// Samples that are worth the trouble: a few more than refit asks for, since a scan may have less surface than it
    /// seems.
    fn least_samples(&self) -> u64 {
        (refit::LEAST_SAMPLES as u64 + 1).saturating_mul(self.ask.target)
    }

    /// How many samples are worth taking of a scan whose intermediate mesh is `ratio` times as large as the result.
    fn samples(&self, scan: &Scan, ratio: f64) -> u64 {
        let target = self.ask.target;
        if self.ask.refit_rounds == 0 || target == 0 {
            return 0;
        }
        let vertices = scan.vertex_count().min(scan.triangle_count());
        let on_scratch = scratch_samples(SAMPLE_SCRATCH_BYTES, vertices);
        let most = (self.samples_at_once(target) as f64 / SAMPLES_MARGIN) as u64;
        let coarser = (AIM / ratio).clamp(1.0, MOST_COARSER);
        let samples = (refit::SAMPLES as f64 * coarser * coarser * target as f64) as u64;
        let samples = samples.min(on_scratch).min(most);
        if samples < self.least_samples() { 0 } else { samples }
    }

    /// How many samples are taken of a scan that goes into so many cells, where so many bytes of binned vertices may be
    /// resident: fewer if scratch has to hold these, too.
    pub fn samples_beside(&self, scan: &Scan, cells: usize, spill_resident_bytes: u64) -> u64 {
        let samples = self.samples(scan, cells as f64 * FACES_A_CELL / self.ask.target.max(1) as f64);
        let vertices = scan.vertex_count();
        if scan.layout() == Layout::Soup || cluster::resident_spill_bytes(vertices) <= spill_resident_bytes {
            return samples;
        }
        let on_scratch = scratch_samples(SAMPLE_SCRATCH_BESIDE_BYTES, vertices);
        samples.min(on_scratch.max(self.least_samples()))
    }

    /// How many samples there is room for when a result of so many faces is refitted.
    pub fn samples_at_once(&self, faces: u64) -> usize {
        // Homes, and where more rounds follow a reference.
        let reference = if self.ask.refit_rounds > 1 { collapse::reference_bytes::<f64>(2, 1) } else { 0 };
        let kept = (AIM / 2.0) as u64 * faces.saturating_mul(4 + reference);
        let taken = refit::BYTES_A_FACE.saturating_mul(faces).saturating_add(kept);
        (without_margin(self.for_arrays()).saturating_sub(taken) / refit::BYTES_A_SAMPLE) as usize
    }

    /// If `scan` fits the budget as a whole: the number of distinct vertices for which it does. Only a soup can turn out
    /// to have more.
    pub fn in_core<S: Coordinate>(&self, scan: &Scan) -> Option<u64> {
        let faces = scan.triangle_count();
        let bytes = |faces: u64, vertices: u64| {
            let shades = self.ask.coat_bytes * vertices;
            if self.ask.target == 0 || scan.triangle_count() / 20 < self.ask.target {
                shades + self.near_bytes::<S>(faces, vertices, false)
            } else {
                shades + self.ask.shade_bytes * vertices + collapse::bytes::<S>(faces, vertices)
            }
        };
        if self.carrying_bytes::<S>(scan) > self.for_arrays() {
            return None;
        }
        let most_vertices = self.for_scan(scan).checked_sub(bytes(faces, 0))? / bytes(0, 1);
        let fits = match scan.layout() {
            Layout::Indexed => scan.vertex_count() <= most_vertices && self.loading_bytes(scan) <= self.for_arrays(),
            // A closed soup has half as many vertices as faces. How many it really has shows while it is welded.
            Layout::Soup => faces / 2 <= most_vertices,
        };
        fits.then_some(most_vertices)
    }

    /// What the collapse of the scan itself may take.
    fn for_scan(&self, scan: &Scan) -> u64 {
        let faces = scan.triangle_count();
        // A scan of no more faces than are asked for is welded, not collapsed.
        let purse = Purse { ask: if self.ask.target < faces { self.ask } else { Ask::default() }, ..*self };
        purse.for_collapse(scan.vertex_count().min(faces / 2))
    }

    /// The cells for a scan that does not fit, of which `target` faces are asked, or as few as an error bound allows.
    pub fn out_of_core<S: Coordinate>(&self, scan: &Scan, target: Option<u64>) -> Result<Cells> {
        let most_cells = self.most_cells::<S>(scan);
        let least_cells = target.map_or(0, |n| cells_for(n, LEAST_RATIO)).max(LEAST_CELLS);
        if most_cells < least_cells {
            let enough = self.least_budget(|purse| purse.most_cells::<S>(scan) >= least_cells);
            let needed_bytes = enough.min(self.in_core_budget::<S>(scan));
            let ask = target.map_or("the error bound".into(), |n| format!("{n} faces"));
            let what = format!("{} cannot be reduced to {ask} within this budget", scan.path().display());
            return Err(Error::Budget { what, needed_bytes });
        }
        let wanted = target.map_or(most_cells, |n| cells_for(n, AIM)).max(LEAST_CELLS);
        Ok(Cells { wanted: wanted.min(most_cells), most: most_cells })
    }

    /// The way of a scan that does not fit, of which `target` faces are asked, or as few as an error bound allows.
    pub fn way<S: Coordinate>(&self, scan: &Scan, target: Option<u64>) -> Result<Way> {
        let clustered = self.out_of_core::<S>(scan, target);
        let Some(target) = target.filter(|_| !self.ask.is_chain) else { return clustered.map(Way::Clustered) };
        let is_coarse = |cells: &Cells| cells_for(target, LOW_RATIO) > cells.most;
        match (clustered, self.tiled::<S>(scan, target)) {
            (Ok(cells), None) => Ok(Way::Clustered(cells)),
            (Ok(cells), Some(_)) if !is_coarse(&cells) => Ok(Way::Clustered(cells)),
            (_, Some(plan)) => Ok(Way::Tiled(plan)),
            (Err(Error::Budget { what, needed_bytes }), None) => {
                let enough = self.least_budget(|purse| purse.tiled::<S>(scan, target).is_some());
                Err(Error::Budget { what, needed_bytes: needed_bytes.min(enough) })
            }
            (Err(error), None) => Err(error),
        }
    }

    /// Tiles for `target` faces of a scan, if there is room for them.
    fn tiled<S: Coordinate>(&self, scan: &Scan, target: u64) -> Option<TilePlan> {
        let faces = scan.triangle_count().max(1) as f64;
        let share = (target as f64 / faces).min(1.0);
        let samples = TILE_SAMPLES.min(TILE_SAMPLES_A_FACE / share);
        let samples = if self.ask.refit_rounds > 0 && samples >= LEAST_TILE_SAMPLES { samples } else { 0.0 };
        let collapse = (collapse::bytes::<S>(2, 1) as f64 / 2.0) * (1.0 + MARGIN);
        // In the first sweep a tile has faces of the scan; in those after it its share of the result, and all samples.
        let first = (collapse + 20.0 * samples * share).max(tiles::loading_bytes::<S>() as f64);
        let later = collapse.max(tiles::loading_bytes::<S>() as f64) + 44.0 * samples;
        let last = refit::BYTES_A_FACE as f64 + (SAMPLE_BYTES + 4 + refit::BYTES_A_SAMPLE as usize) as f64 * samples;
        let later = later.max(last);
        let a_face = first.max(TILE_SLACK * share * later);
        let whole = (12.0 + 1.5 * size_of::<S>() as f64) * target as f64;
        let arrays = self.for_arrays() as f64;
        let left = arrays - TILE_LISTS_BYTES - PROPOSAL_BYTES * target as f64;
        let faces = (left / a_face).max(0.0) as u64;
        let streaming = self.while_streaming();
        let workers = most_threads(self.bytes) as u64;
        let fits = arrays >= 4.0 * TILE_LISTS_BYTES
            && share <= MOST_TILE_SHARE
            && whole <= arrays
            && self.carrying_bytes::<S>(scan) <= self.for_arrays()
            && share * faces as f64 >= LEAST_TILE_FACES;
        fits.then(|| TilePlan {
            faces,
            bytes: left as u64,
            first_face_bytes: first.ceil() as u64,
            later_face_bytes: later.ceil() as u64,
            samples: (samples * target as f64) as u64,
            writer_bytes: streaming / 4 / workers,
            position_bytes: streaming / 4,
        })
    }

    /// The most cells that clustering, and the collapse of what comes of it, have room for.
    fn most_cells<S: Coordinate>(&self, scan: &Scan) -> usize {
        let (layout, sampled) = (scan.layout(), self.is_sampled(scan));
        let fits = |cells: usize| {
            let n = cells as u64;
            let faces = 2 * n + n / 64;
            let survivors = (SURVIVORS_A_CELL * cluster::BYTES_PER_RAW_FACE) as u64 * n;
            cluster::summing_bytes(cells, layout) + survivors <= self.while_streaming()
                && cluster::placing_bytes(cells, S::DOUBLE) + 12 * faces <= self.for_arrays()
                && self.near_bytes::<S>(faces, n, sampled) <= self.for_collapse(n)
        };
        let (mut low, mut high) = (0, cluster::MAX_CELLS + 1);
        while high - low > 1 {
            let middle = low.midpoint(high);
            if fits(middle) { low = middle } else { high = middle }
        }
        low
    }

    /// What clustering into so many cells may use: survivors, bytes of binned vertices, and the mesh that may come of it.
    pub fn cluster_options<S: Coordinate>(&self, scan: &Scan, cells: usize) -> (usize, u64, MeshLimit) {
        let raw_faces = SURVIVORS_A_CELL * cells;
        let taken = cluster::summing_bytes(cells, scan.layout()) + (raw_faces * cluster::BYTES_PER_RAW_FACE) as u64;
        let left = self.while_streaming().saturating_sub(taken);
        // Binned vertices that are all resident need no windows on a spill.
        let resident = left + aside(self.bytes) - aside_without_spill(self.bytes);
        let left = if cluster::resident_spill_bytes(scan.vertex_count()) <= resident { resident } else { left };
        let sampled = self.is_sampled(scan);
        let (face_bytes, vertex_bytes) = (self.near_bytes::<S>(1, 0, sampled), self.near_bytes::<S>(0, 1, sampled));
        (raw_faces, left, MeshLimit { face_bytes, vertex_bytes, bytes: self.for_collapse(cells as u64) })
    }

    /// What the result takes with all that is carried over to it: less than the collapse did, but where nearly all is
    /// kept.
    fn carrying_bytes<S: Coordinate>(&self, scan: &Scan) -> u64 {
        let result = (12 + 3 * size_of::<S>() as u64 / 2).saturating_mul(self.ask.target.min(scan.triangle_count()));
        if self.ask.carry_bytes == 0 { 0 } else { self.ask.carry_bytes.saturating_add(result) }
    }

    fn in_core_shades(&self) -> u64 {
        self.ask.shade_bytes.saturating_add(self.ask.coat_bytes)
    }

    /// What loading takes, colours and all.
    fn loading_bytes(&self, scan: &Scan) -> u64 {
        load_peak_bytes(scan).saturating_add(self.in_core_shades().saturating_mul(scan.vertex_count()))
    }

    /// A budget in which `scan` fits as a whole, whatever it holds. A soup is taken to share no vertex.
    pub fn in_core_budget<S: Coordinate>(&self, scan: &Scan) -> u64 {
        let collapse = self.near_bytes::<S>(scan.triangle_count(), scan.vertex_count(), false);
        let collapse = collapse.saturating_add(self.ask.coat_bytes.saturating_mul(scan.vertex_count()));
        let loading = self.loading_bytes(scan);
        let most = loading.max(self.carrying_bytes::<S>(scan));
        self.least_budget(|purse| collapse <= purse.for_scan(scan) && most <= purse.for_arrays())
    }

    /// The least budget in whole mebibytes that is enough; the largest of all if none is.
    fn least_budget(&self, is_enough: impl Fn(&Purse) -> bool) -> u64 {
        let (mut low, mut high) = (0, u64::MAX / MIB);
        while high - low > 1 {
            let middle = low.midpoint(high);
            if is_enough(&Purse { bytes: middle * MIB, ..*self }) { high = middle } else { low = middle }
        }
        high * MIB
    }
}

// A pass of measuring is paid for like one of clustering.
const _: () = assert!(measure::bytes_per_worker() <= cluster::bytes_per_worker() + cluster::bytes_per_spill_worker());

/// What so many workers of a streaming pass take.
fn streaming_bytes(workers: usize) -> u64 {
    Crew::stream_bytes(workers) + (workers * (cluster::bytes_per_worker() + cluster::bytes_per_spill_worker())) as u64
}

/// Threads that may run within a budget: two are always there.
pub fn most_threads(bytes: u64) -> usize {
    (bytes / THREADS_SHARE / THREAD_BYTES).clamp(2, MOST_THREADS) as usize
}

/// What is set aside for streaming.
fn aside(bytes: u64) -> u64 {
    (bytes / 4).min(streaming_bytes(8))
}

/// The same where no spill is looked into.
fn aside_without_spill(bytes: u64) -> u64 {
    aside(bytes).min(streaming_bytes(8) - 8 * cluster::bytes_per_spill_worker() as u64)
}

/// Samples that scratch has room for.
fn scratch_samples(bytes_a_vertex: f64, vertices: u64) -> u64 {
    LEAST_SAMPLE_SCRATCH_BYTES.max((bytes_a_vertex * vertices as f64) as u64) / SAMPLE_BYTES as u64
}

/// Cells for an intermediate mesh of `ratio` times `target` faces.
fn cells_for(target: u64, ratio: f64) -> usize {
    (target as f64 * ratio / FACES_A_CELL).ceil() as usize
}

/// The least budget that has room for so many bytes of arrays while a scan streams past.
pub fn streaming_budget(arrays: u64) -> u64 {
    Purse::new(0, 1, Ask::default()).least_budget(|purse| arrays <= purse.while_streaming())
}
