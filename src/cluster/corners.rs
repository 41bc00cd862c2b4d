//! Binning vertices, and faces as triples of binned corners, whatever layout and order the scan has.
//!
//! An indexed scan's vertices are binned once, into the [`Spill`]; a face then gathers its corners there: from memory
//! when the spill is resident, through a page cache when faces come in an order that keeps to a few pages, and by a
//! join through buckets on scratch when they do not. Faces out of order are put into buckets for a resident spill, too,
//! if that brings their corners together. A soup's corners are binned as they come.

use super::buckets::{self, Buckets};
use super::grid::{Corner, Grid, cell_key, place_in_cell};
use super::join;
use super::resident::Binned;
use super::spill::{Packer, PageCache, Spill, SpillFile};
use super::table::{CellTable, LastBlock, block_key, place_in_block};
use super::used::Used;
use crate::error::Result;
use crate::read::{Crew, Scan};
use crate::scratch::Scratch;
use fearless_simd::{Level, Simd, dispatch};

/// Faces that are gathered before they are worked on, so that their cache misses overlap; at most so many a delivery.
pub(super) const BATCH: usize = 512;

/// Faces or vertices from anywhere that are looked up together, so that the waits for memory overlap.
const AT_ONCE: usize = 64;

/// Bytes of a worker's [`Feed`], and of records from buckets.
pub(super) const FEED_BYTES: usize = BATCH * size_of::<[Corner; 3]>() + buckets::reader_bytes(6);
/// Bytes of the corners of one chunk of vertices.
pub(super) const BINNING_BYTES: usize = (16 << 10) * size_of::<Corner>();

/// Takes faces with binned corners; one a worker.
pub(super) trait Sink: Send {
    /// At most [`BATCH`] faces that repeat no vertex and whose corners are all somewhere; those with all corners in one
    /// cell come first, so many.
    fn take(&mut self, faces: Faces, inside: usize);
}

/// Some faces: the first, the second and the third corner of each.
pub(super) type Faces<'a> = [&'a [Corner]; 3];

/// Where a face's corners come from.
pub(super) enum Corners<'a> {
    /// From memory.
    Resident { all: Binned<'a>, coherent: bool },
    /// From memory, for faces from buckets.
    Sorted(Binned<'a>, &'a Buckets),
    /// From a spill file through a page cache a worker.
    Paged(&'a SpillFile),
    /// From a spill file by a join that may hold `resident_bytes` of it.
    Joined { spill: &'a SpillFile, scratch: &'a Scratch, resident_bytes: u64 },
    /// Binned as they come.
    Soup(&'a Grid, &'a CellTable),
}

/// A sink with the faces that are on their way to it, and what was found on the way.
pub(super) struct Feed<'a, K> {
    pub(super) sink: K,
    /// Where there is an account of vertices.
    used: Option<&'a Used>,
    /// Faces within a cell from the beginning, those across cells from the end.
    faces: Box<[[Corner; BATCH]; 3]>,
    inside: usize,
    across: usize,
    /// Faces that repeat a corner.
    pub(super) repeated: u64,
    /// The first vertex (of a soup: corner) that a face uses and that is nowhere.
    pub(super) nowhere: Option<u64>,
}

impl<'a, K: Sink> Feed<'a, K> {
    /// `used` hears of the vertices that faces have, if it keeps an account.
    pub(super) fn new(sink: K, used: Option<&'a Used>) -> Self {
        let faces = Box::new([[Corner::default(); BATCH]; 3]);
        let used = used.filter(|used| used.is_kept());
        Feed { sink, used, faces, inside: 0, across: 0, repeated: 0, nowhere: None }
    }

    /// A face has these vertices.
    #[inline(always)]
    pub(super) fn uses(&mut self, vertices: &[u32]) {
        if let Some(used) = self.used {
            vertices.iter().for_each(|vertex| used.add(*vertex));
        }
    }

    /// Takes a face along. Whether it is within a cell is as good as random, so this is told without a branch.
    #[inline(always)]
    pub(super) fn push(&mut self, face: [Corner; 3]) {
        let [a, b, c] = face;
        let is_inside = a.same_cell(b) & a.same_cell(c);
        let place = if is_inside { self.inside } else { BATCH - 1 - self.across };
        for (corners, corner) in self.faces.iter_mut().zip(face) {
            corners[place % BATCH] = corner;
        }
        self.inside += usize::from(is_inside);
        self.across += usize::from(!is_inside);
        if self.inside + self.across == BATCH {
            self.deliver();
        }
    }

    /// Hands over what has gathered, all of it.
    fn finish(&mut self) {
        self.deliver();
    }

    fn deliver(&mut self) {
        let (inside, across) = (std::mem::take(&mut self.inside), std::mem::take(&mut self.across));
        self.faces.iter_mut().for_each(|corners| corners.copy_within(BATCH - across.., inside));
        self.sink.take(self.faces.each_ref().map(|corners| &corners[..inside + across]), inside);
    }

    #[cold]
    pub(super) fn miss(&mut self, vertex: u64) {
        self.nowhere = Some(self.nowhere.map_or(vertex, |v| v.min(vertex)));
    }

    /// Resolves a triangle's corners and takes it along, unless it repeats a vertex or a corner is nowhere.
    #[inline(always)]
    fn gather(&mut self, [a, b, c]: [u32; 3], mut corner: impl FnMut(u32) -> Result<Corner>) -> Result<()> {
        if a == b || b == c || c == a {
            self.repeated += 1;
            return Ok(());
        }
        self.uses(&[a, b, c]);
        let face = [corner(a)?, corner(b)?, corner(c)?];
        if face.contains(&Corner::NOWHERE) {
            for (vertex, corner) in [a, b, c].into_iter().zip(face) {
                if corner == Corner::NOWHERE {
                    self.miss(vertex.into());
                }
            }
            return Ok(());
        }
        self.push(face);
        Ok(())
    }
}

/// Bins every vertex into the spill. Check the table afterwards: when it is full, the spill is worth nothing.
/// `coherent` vertices follow one another in space.
pub(super) fn bin_vertices(
    scan: &Scan,
    crew: &Crew,
    (grid, table): (&Grid, &CellTable),
    coherent: bool,
    spill: &mut Spill,
) -> Result<()> {
    let open = spill.open();
    let worker = || (Vec::<Corner>::new(), Packer::new());
    scan.vertices(crew, worker, |(corners, packer), chunk| {
        if table.is_full() {
            return Ok(());
        }
        corners.clear();
        let (mut last, mut split) = (LastBlock::default(), Split::<AT_ONCE>::nothing());
        for positions in chunk.positions.chunks(AT_ONCE) {
            let is_split = split.take(grid, positions);
            if is_split && !coherent {
                table.fetch_numbers(&split.blocks, &split.cells);
            }
            match is_split {
                true => corners.extend((0..AT_ONCE).map(|i| split.bin(i, table, &mut last).unwrap_or_default())),
                false => corners.extend(positions.iter().map(|p| bin(grid, table, *p, &mut last).unwrap_or_default())),
            }
        }
        open.write(chunk.first, corners, packer)
    })?;
    spill.close(table.len());
    Ok(())
}

/// Bins a position; `None` if its cell is refused.
fn bin(grid: &Grid, table: &CellTable, p: [f64; 3], last: &mut LastBlock) -> Option<Corner> {
    match grid.steps(p) {
        Some(steps) => table.number(steps, last).map(|cell| Corner::new(cell, steps)),
        None => Some(Corner::NOWHERE),
    }
}

/// Near positions, split into what says where they are.
struct Split<const N: usize> {
    steps: [[u64; N]; 3],
    /// The keys of their blocks.
    blocks: [u64; N],
    /// Their cells' places there.
    cells: [u64; N],
    /// Their places in those.
    places: [u64; N],
}

impl<const N: usize> Split<N> {
    /// Room for them.
    fn nothing() -> Self {
        Split { steps: [[0; N]; 3], blocks: [0; N], cells: [0; N], places: [0; N] }
    }

    /// Splits positions, as wide as the processor's vectors; not if they are fewer, or one is not near.
    fn take(&mut self, grid: &Grid, positions: &[[f64; 3]]) -> bool {
        let Ok(positions) = positions.try_into() else { return false };
        dispatch!(Level::new(), simd => self.in_vectors(simd, grid, positions))
    }

    #[inline(always)]
    fn in_vectors<V: Simd>(&mut self, _: V, grid: &Grid, positions: &[[f64; 3]; N]) -> bool {
        let Split { steps, blocks, cells, places } = self;
        if !grid.near_steps(positions, steps) {
            return false;
        }
        let [x, y, z] = steps;
        for i in 0..N {
            let s = [x[i], y[i], z[i]];
            blocks[i] = block_key(s);
            cells[i] = place_in_block(s) as u64;
            places[i] = place_in_cell(s);
        }
        true
    }

    /// Bins one of them, as [`bin`] does.
    #[inline(always)]
    fn bin(&self, i: usize, table: &CellTable, last: &mut LastBlock) -> Option<Corner> {
        let cell = || cell_key([self.steps[0][i], self.steps[1][i], self.steps[2][i]]);
        let number = table.number_at(self.blocks[i], self.cells[i] as usize, cell, last)?;
        Some(Corner::at(number, self.places[i]))
    }
}

/// Streams every face of the scan to sinks, one a worker; `used` hears of the vertices.
pub(super) fn stream<'u, K: Sink>(
    scan: &Scan,
    crew: &Crew,
    corners: &Corners,
    used: &'u Used,
    sink: impl Fn() -> K + Sync,
) -> Result<Vec<Feed<'u, K>>> {
    let mut feeds = match corners {
        Corners::Resident { all, coherent } => scan.triangles(
            crew,
            || Feed::new(sink(), Some(used)),
            |feed, chunk| {
                for triangles in chunk.triangles.chunks(AT_ONCE) {
                    if !coherent {
                        all.fetch(triangles);
                    }
                    for triangle in triangles {
                        feed.gather(*triangle, |v| Ok(all.corner(v)))?;
                    }
                }
                Ok(())
            },
        )?,
        Corners::Sorted(all, buckets) => {
            let mut feeds: Vec<_> = (0..crew.workers.max(1)).map(|_| Feed::new(sink(), Some(used))).collect();
            feeds[0].repeated = buckets.repeated;
            buckets.stream(crew, &mut feeds, |feed, form, records| {
                form.each(records, |triangle| feed.gather(triangle, |v| Ok(all.corner(v))))
            })?;
            feeds
        }
        Corners::Paged(spill) => {
            let worker = || (Feed::new(sink(), None), PageCache::new(spill, used));
            let feeds = scan.triangles(crew, worker, |(feed, pages), chunk| {
                for triangle in chunk.triangles {
                    feed.gather(*triangle, |v| pages.get(v))?;
                }
                Ok(())
            })?;
            let finished = |(feed, pages): (_, PageCache)| {
                pages.finish();
                feed
            };
            feeds.into_iter().map(finished).collect()
        }
        Corners::Joined { spill, scratch, resident_bytes } => {
            join::stream(scan, crew, (spill, used), scratch, *resident_bytes, sink)?
        }
        Corners::Soup(grid, table) => soup(scan, crew, (grid, table), sink)?,
    };
    feeds.iter_mut().for_each(Feed::finish);
    Ok(feeds)
}

fn soup<K: Sink>(
    scan: &Scan,
    crew: &Crew,
    (grid, table): (&Grid, &CellTable),
    sink: impl Fn() -> K + Sync,
) -> Result<Vec<Feed<'static, K>>> {
    scan.soup(
        crew,
        || Feed::new(sink(), None),
        |feed, chunk| {
            if table.is_full() {
                return Ok(());
            }
            let (mut last, mut split) = (LastBlock::default(), Split::<{ 3 * AT_ONCE }>::nothing());
            for (triangles, first) in chunk.triangles.chunks(AT_ONCE).zip((chunk.first..).step_by(AT_ONCE)) {
                let is_split = split.take(grid, triangles.as_flattened());
                for (i, &[a, b, c]) in triangles.iter().enumerate() {
                    if a == b || b == c || c == a {
                        feed.repeated += 1;
                        continue;
                    }
                    let mut bin = |corner: usize| match is_split {
                        true => split.bin(3 * i + corner, table, &mut last),
                        false => bin(grid, table, triangles[i][corner], &mut last),
                    };
                    if let (Some(a), Some(b), Some(c)) = (bin(0), bin(1), bin(2)) {
                        let face = [a, b, c];
                        match face.iter().position(|corner| *corner == Corner::NOWHERE) {
                            None => feed.push(face),
                            Some(corner) => feed.miss(3 * (first + i as u64) + corner as u64),
                        }
                    }
                }
            }
            Ok(())
        },
    )
}
