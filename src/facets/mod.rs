//! Faces with the positions of their corners, as often as they are asked for, of a mesh that memory need not hold.
//!
//! A soup brings its positions along. Of an indexed mesh the positions are read once, in the scalar of the file: into
//! memory where they fit; else to scratch, and faces that come in a sensible order gather them through a few pages for each
//! worker, while faces in any other order are joined to them (`join.rs`).

mod join;
mod stride;

use crate::error::{Error, Result};
use crate::mesh::{Coordinate, Frame, narrow, widen};
use crate::read::{Crew, Layout, Scan};
use crate::scratch::{Scratch, ScratchFile};
use glam::DVec3;
use join::Join;
use std::marker::PhantomData;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, MutexGuard};
pub use stride::Stride;

/// Bits of a face's number that a facet keeps.
pub(crate) const NUMBER_BITS: u32 = 29;

/// A face on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Facet {
    tag: u32,
    /// In the frame of the mesh that is held.
    pub(crate) corners: [DVec3; 3],
}

impl Facet {
    /// A face by its tag.
    pub(crate) fn new(tag: u32, corners: [DVec3; 3]) -> Self {
        Facet { tag, corners }
    }

    /// The face's number, as far as samples are drawn by it.
    #[inline(always)]
    pub(crate) fn number(&self) -> u32 {
        self.tag & ((1 << NUMBER_BITS) - 1)
    }

    /// Whether a corner is a vertex to be measured, here and nowhere else.
    #[inline(always)]
    pub(crate) fn is_chosen(&self, corner: usize) -> bool {
        self.tag >> (NUMBER_BITS + corner as u32) & 1 != 0
    }
}

/// A face's number and which of its corners are chosen.
#[inline(always)]
pub(crate) fn tag(number: u64, mut is_chosen: impl FnMut(usize) -> bool) -> u32 {
    let chosen = (0..3).fold(0, |bits, corner| bits | u32::from(is_chosen(corner)) << corner);
    number as u32 & ((1 << NUMBER_BITS) - 1) | chosen << NUMBER_BITS
}

/// Takes faces; one a worker.
pub(crate) trait Sink: Send {
    /// Some faces that follow one another, at most [`BATCH`].
    fn take(&mut self, faces: &[Facet]);
}

/// Faces in a delivery, at most.
pub(crate) const BATCH: usize = 512;

/// A sink with the faces that are on their way to it, and what was found on the way. Sinks of all kinds are fed by the
/// same code: what that costs once a batch is nothing, and the passes over every format are compiled once.
pub(crate) struct Feed<'a> {
    sink: &'a mut dyn Sink,
    faces: Vec<Facet>,
    /// The first vertex that a face uses and that is not finite.
    wild: Option<u32>,
}

impl<'a> Feed<'a> {
    fn new(sink: &'a mut dyn Sink) -> Self {
        Feed { sink, faces: Vec::with_capacity(BATCH), wild: None }
    }

    #[inline(always)]
    pub(crate) fn push(&mut self, facet: Facet) {
        self.faces.push(facet);
        if self.faces.len() == BATCH {
            self.deliver();
        }
    }

    /// Hands over what has gathered.
    pub(crate) fn deliver(&mut self) {
        self.sink.take(&self.faces);
        self.faces.clear();
    }

    #[cold]
    pub(crate) fn miss(&mut self, vertex: u32) {
        self.wild = Some(self.wild.map_or(vertex, |v| v.min(vertex)));
    }
}

/// Feeds that wait for a worker.
pub(crate) struct Idle<'a>(Mutex<Vec<Feed<'a>>>);

impl<'a> Idle<'a> {
    /// The feed of a worker.
    pub(crate) fn take(&self) -> Feed<'a> {
        self.lock().pop().expect("there is a feed for every worker")
    }

    /// Feeds that their workers no longer need.
    pub(crate) fn put(&self, feeds: Vec<Feed<'a>>) {
        self.lock().extend(feeds);
    }

    /// All feeds, once no worker has one.
    pub(crate) fn take_all(&self) -> Vec<Feed<'a>> {
        std::mem::take(&mut *self.lock())
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Feed<'a>>> {
        self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

/// Which vertices are to be measured, and which of them have been met: an unused one never is.
pub(crate) struct Choice {
    stride: Stride,
    met: Vec<AtomicU64>,
}

impl Choice {
    /// Of `vertices`, those that `stride` takes. An eighth of a byte for each.
    pub(crate) fn new(vertices: u64, stride: Stride) -> Self {
        Choice { stride, met: bytemuck::zeroed_vec(stride.rank(vertices).div_ceil(64) as usize) }
    }

    /// Whether this is the first time that a chosen vertex is met.
    #[inline(always)]
    pub(crate) fn meets(&self, vertex: u32) -> bool {
        self.stride.takes(vertex.into()) && self.meets_first(self.stride.rank(vertex.into()))
    }

    fn meets_first(&self, rank: u64) -> bool {
        let bit = 1 << (rank % 64);
        // Whichever thread sets it: the vertex is the same.
        self.met[rank as usize / 64].fetch_or(bit, Relaxed) & bit == 0
    }
}

/// Vertices a page of a [`PageCache`] holds.
const PAGE: usize = 512;
/// Pages that a [`PageCache`] holds, a power of two.
const PAGES: usize = 128;

/// Bytes of a worker: its pages and the batch on its way.
pub(crate) const WORKER_BYTES: usize = PAGES * PAGE * 24 + BATCH * size_of::<Facet>();

/// Positions on scratch, as the file has them.
pub(crate) struct Spill<T> {
    file: ScratchFile,
    pub(crate) vertices: u64,
    scalar: PhantomData<T>,
}

impl<T: Coordinate> Spill<T> {
    fn new(scan: &Scan, crew: &Crew, scratch: &Scratch) -> Result<Self> {
        let file = scratch.file()?;
        scan.vertices(crew, Vec::new, |positions: &mut Vec<[T; 3]>, chunk| {
            positions.clear();
            positions.extend(chunk.positions.iter().map(|p| p.map(T::narrow)));
            file.write_all_at(bytemuck::cast_slice(positions), chunk.first * size_of::<[T; 3]>() as u64)
        })?;
        Ok(Spill { file, vertices: scan.vertex_count(), scalar: PhantomData })
    }

    /// Reads consecutive positions.
    pub(crate) fn read(&self, first: u64, positions: &mut [[T; 3]]) -> Result<()> {
        self.file.read_exact_at(bytemuck::cast_slice_mut(positions), first * size_of::<[T; 3]>() as u64)
    }
}

/// A worker's window on a spill: pages found by the low bits of their number.
struct PageCache<'a, T> {
    spill: &'a Spill<T>,
    pages: Vec<[T; 3]>,
    /// The number of each held page; one that no vertex has for none.
    held: Vec<u32>,
}

impl<'a, T: Coordinate> PageCache<'a, T> {
    fn new(spill: &'a Spill<T>) -> Self {
        PageCache { spill, pages: vec![[T::narrow(0.0); 3]; PAGES * PAGE], held: vec![u32::MAX; PAGES] }
    }

    #[inline(always)]
    fn get(&mut self, vertex: u32) -> Result<[T; 3]> {
        let page = vertex / PAGE as u32;
        let slot = page as usize % PAGES;
        if self.held[slot] != page {
            self.fetch(slot, page)?;
        }
        Ok(self.pages[slot * PAGE + vertex as usize % PAGE])
    }

    #[cold]
    fn fetch(&mut self, slot: usize, page: u32) -> Result<()> {
        self.held[slot] = u32::MAX;
        let first = u64::from(page) * PAGE as u64;
        let count = (self.spill.vertices - first).min(PAGE as u64) as usize;
        self.spill.read(first, &mut self.pages[slot * PAGE..][..count])?;
        self.held[slot] = page;
        Ok(())
    }
}

/// What positions are brought into: the frame of the mesh that is held.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    pub(crate) frame: Frame,
}

impl Place {
    #[inline(always)]
    pub(crate) fn of<T: Coordinate>(&self, p: [T; 3]) -> DVec3 {
        let p = widen(p);
        self.frame.place(p)
    }
}

/// Where a face's corners come from.
enum Corners<T> {
    Soup,
    Resident(Vec<[T; 3]>),
    Paged(Spill<T>),
    Joined(Join<T>),
}

/// The mesh that streams.
pub(crate) struct Stream<'a, T> {
    scan: &'a Scan,
    place: Place,
    stride: Stride,
    corners: Corners<T>,
}

/// Triangles that are looked at to tell the order of a file.
const SAMPLE: usize = 20_000;
/// Blocks of 512 vertices that a face touches in a scan in sensible order, at most.
const COHERENT: f64 = 0.3;

impl<'a, T: Coordinate> Stream<'a, T> {
    /// Makes positions ready, with at most `resident_bytes` of them in memory.
    pub(crate) fn open(
        scan: &'a Scan,
        crew: &Crew,
        scratch: &Scratch,
        frame: Frame,
        stride: Stride,
        resident_bytes: u64,
    ) -> Result<Self> {
        let place = Place { frame };
        let corners = if scan.layout() == Layout::Soup {
            Corners::Soup
        } else if position_bytes::<T>(scan) <= resident_bytes {
            Corners::Resident(load_positions(scan, crew)?)
        } else {
            let coherent = scan.sample(crew, SAMPLE)?.blocks_per_triangle < COHERENT;
            let spill = Spill::new(scan, crew, scratch)?;
            if coherent {
                Corners::Paged(spill)
            } else {
                Corners::Joined(Join::new(scan, crew, spill, scratch, stride, resident_bytes)?)
            }
        };
        Ok(Stream { scan, place, stride, corners })
    }

    /// Streams every face to sinks, one a worker. Faces that repeat a vertex are passed over. With `choose`, chosen
    /// vertices are marked at one of their corners.
    pub(crate) fn faces<K: Sink>(&self, crew: &Crew, choose: bool, sink: impl Fn() -> K) -> Result<Vec<K>> {
        let mut sinks: Vec<K> = (0..crew.workers.max(1)).map(|_| sink()).collect();
        self.feed(crew, choose, sinks.iter_mut().map(|sink| sink as &mut dyn Sink).collect())?;
        Ok(sinks)
    }

    fn feed(&self, crew: &Crew, choose: bool, sinks: Vec<&mut dyn Sink>) -> Result<()> {
        let idle = Idle(Mutex::new(sinks.into_iter().map(Feed::new).collect()));
        let choice = (choose && !matches!(self.corners, Corners::Soup | Corners::Joined(_)))
            .then(|| Choice::new(self.scan.vertex_count(), self.stride));
        let mut feeds = match &self.corners {
            Corners::Soup => self.soup(crew, choose, &idle)?,
            Corners::Joined(join) => join.faces(crew, self.place, &idle)?,
            Corners::Resident(positions) => self.scan.triangles(
                crew,
                || idle.take(),
                |feed, chunk| {
                    for (number, face) in (chunk.first..).zip(chunk.triangles) {
                        self.gather(feed, number, *face, choice.as_ref(), |v| Ok(positions[v as usize]))?;
                    }
                    Ok(())
                },
            )?,
            Corners::Paged(spill) => {
                let worker = || (idle.take(), PageCache::new(spill));
                let feeds = self.scan.triangles(crew, worker, |(feed, pages), chunk| {
                    for (number, face) in (chunk.first..).zip(chunk.triangles) {
                        self.gather(feed, number, *face, choice.as_ref(), |v| pages.get(v))?;
                    }
                    Ok(())
                })?;
                feeds.into_iter().map(|(feed, _)| feed).collect()
            }
        };
        feeds.iter_mut().for_each(Feed::deliver);
        let met_before = if let Corners::Joined(join) = &self.corners { join.wild() } else { None };
        if let Some(vertex) = feeds.iter().filter_map(|feed| feed.wild).chain(met_before).min() {
            return Err(self.wild(vertex));
        }
        Ok(())
    }

    fn wild(&self, vertex: u32) -> Error {
        let what = "a coordinate is not finite, but a face uses the vertex".into();
        self.scan.vertex_error(u64::from(vertex), what)
    }

    #[inline(always)]
    fn gather(
        &self,
        feed: &mut Feed,
        number: u64,
        face: [u32; 3],
        choice: Option<&Choice>,
        mut position: impl FnMut(u32) -> Result<[T; 3]>,
    ) -> Result<()> {
        let [a, b, c] = face;
        if a == b || b == c || c == a {
            return Ok(());
        }
        let corners = [self.place.of(position(a)?), self.place.of(position(b)?), self.place.of(position(c)?)];
        if !(corners[0] + corners[1] + corners[2]).is_finite() {
            let wild = face.iter().zip(&corners).filter(|(_, p)| !p.is_finite());
            wild.for_each(|(vertex, _)| feed.miss(*vertex));
        }
        let tag = tag(number, |corner| choice.is_some_and(|choice| choice.meets(face[corner])));
        feed.push(Facet::new(tag, corners));
        Ok(())
    }

    fn soup<'k>(&self, crew: &Crew, choose: bool, idle: &Idle<'k>) -> Result<Vec<Feed<'k>>> {
        self.scan.soup(
            crew,
            || idle.take(),
            |feed, chunk| {
                for (number, &[a, b, c]) in (chunk.first..).zip(chunk.triangles) {
                    if a != b && b != c && c != a {
                        let tag = tag(number, |corner| choose && self.stride.takes(3 * number + corner as u64));
                        feed.push(Facet::new(tag, [self.place.of(a), self.place.of(b), self.place.of(c)]));
                    }
                }
                Ok(())
            },
        )
    }
}

/// Bytes that a worker takes, beside what reading does.
pub(crate) const fn bytes_per_worker() -> usize {
    if WORKER_BYTES > join::WORKER_BYTES { WORKER_BYTES } else { join::WORKER_BYTES }
}

/// The fewest bytes of positions that an indexed scan needs in memory, whatever the order of its faces.
pub(crate) fn least_bytes(vertices: u64, position_bytes: u64) -> u64 {
    join::least_bytes(vertices, position_bytes)
}

/// What positions take in memory.
fn position_bytes<T>(scan: &Scan) -> u64 {
    scan.vertex_count().saturating_mul(size_of::<[T; 3]>() as u64)
}

fn load_positions<T: Coordinate>(scan: &Scan, crew: &Crew) -> Result<Vec<[T; 3]>> {
    // One worker is given the chunks in the order of the file.
    let positions = scan.vertices(
        &Crew { workers: 1, ..*crew },
        || Vec::with_capacity(scan.vertex_count() as usize),
        |positions, chunk| {
            positions.extend(chunk.positions.iter().map(|p| narrow(DVec3::from(*p))));
            Ok(())
        },
    )?;
    Ok(positions.into_iter().next().unwrap_or_default())
}
