//! Faces joined to the positions of their vertices when neither fits memory and their orders have nothing to do with each
//! other.
//!
//! Vertices are cut into ranges that fit memory. Faces are sorted to the range of their first corner, then, with that
//! corner's position, to the range of the second, and with two to that of the third; there they stay, and each time they
//! are asked for, a sweep over the ranges brings the last position. 16, then 24, then 32 bytes a face of scratch (36 and 56
//! in doubles), the second freed behind the third, beside 12 (24) bytes a vertex.

use super::{Choice, Facet, Feed, Idle, Place, Spill, Stride, tag};
use crate::cores;
use crate::error::Result;
use crate::mesh::{Coordinate, widen};
use crate::read::{Crew, Scan};
use crate::scratch::{Scratch, ScratchFile};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering::Relaxed};

/// Ranges at most: each is an open file, and a buffer a worker.
const RANGES: u64 = 256;
/// Bytes of a buffer.
const BUFFER: usize = 8 << 10;
/// Records that a worker reads at a time.
const TURN: usize = 4096;

/// Bytes of a worker: buffers, and a run of the longest records.
pub(super) const WORKER_BYTES: usize = RANGES as usize * BUFFER + TURN * (2 * 24 + 8);

/// The fewest bytes of positions that a join is content with.
pub(super) fn least_bytes(vertices: u64, position_bytes: u64) -> u64 {
    vertices.div_ceil(RANGES) * position_bytes
}

/// Faces that wait for their last corner, by its range.
pub(super) struct Join<T> {
    spill: Spill<T>,
    cut: Cut,
    waiting: Vec<Run>,
    /// The first vertex that was found not to be finite; one that no file has for none.
    wild: AtomicU32,
}

/// How vertices are cut up: a range is so many of them.
#[derive(Debug, Clone, Copy)]
struct Cut {
    vertices: u64,
    width: u64,
}

impl Cut {
    fn new<T>(vertices: u64, resident_bytes: u64) -> Self {
        let width = resident_bytes / size_of::<[T; 3]>() as u64;
        Cut { vertices, width: width.max(vertices.div_ceil(RANGES)).max(1) }
    }

    fn ranges(&self) -> usize {
        self.vertices.div_ceil(self.width) as usize
    }

    fn range(&self, vertex: u32) -> usize {
        (u64::from(vertex) / self.width) as usize
    }

    /// The first vertex of a range and the number of its vertices.
    fn span(&self, range: usize) -> (u64, usize) {
        let first = range as u64 * self.width;
        (first, (self.vertices - first).min(self.width) as usize)
    }
}

/// Records of one kind on scratch; the file is made when the first come.
#[derive(Default)]
struct Run(Mutex<Option<ScratchFile>>);

impl Run {
    fn append(&self, bytes: &[u8], scratch: &Scratch) -> Result<()> {
        let mut file = self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let file = match &mut *file {
            Some(file) => file,
            none => none.insert(scratch.file()?),
        };
        file.append(bytes).map(|_| ())
    }

    /// The file, if there is one.
    fn into_file(self) -> Option<ScratchFile> {
        self.0.into_inner().unwrap_or_else(|poisoned| poisoned.into_inner())
    }
}

fn runs(count: usize) -> Vec<Run> {
    (0..count).map(|_| Run::default()).collect()
}

/// A worker's buffers in front of runs.
struct Buffers<'a> {
    runs: &'a [Run],
    scratch: &'a Scratch,
    buffers: Vec<Vec<u8>>,
}

impl<'a> Buffers<'a> {
    fn new(runs: &'a [Run], scratch: &'a Scratch) -> Self {
        Buffers { runs, scratch, buffers: vec![Vec::new(); runs.len()] }
    }

    #[inline(always)]
    fn push(&mut self, run: usize, parts: &[&[u8]]) -> Result<()> {
        let length: usize = parts.iter().map(|part| part.len()).sum();
        if self.buffers[run].len() + length > self.buffers[run].capacity() {
            self.flush(run)?;
        }
        parts.iter().for_each(|part| self.buffers[run].extend_from_slice(part));
        Ok(())
    }

    fn flush(&mut self, run: usize) -> Result<()> {
        if !self.buffers[run].is_empty() {
            self.runs[run].append(&self.buffers[run], self.scratch)?;
            self.buffers[run].clear();
        }
        self.buffers[run].reserve_exact(BUFFER);
        Ok(())
    }

    fn finish(self) -> Result<()> {
        for (run, buffer) in self.runs.iter().zip(&self.buffers) {
            if !buffer.is_empty() {
                run.append(buffer, self.scratch)?;
            }
        }
        Ok(())
    }
}

impl<T: Coordinate> Join<T> {
    /// Sorts all faces of `scan` to where their last corner is, with at most `resident_bytes` of positions in memory (or a
    /// 256th of them, if that is more). Vertices that `stride` takes are chosen at one corner.
    pub(super) fn new(
        scan: &Scan,
        crew: &Crew,
        spill: Spill<T>,
        scratch: &Scratch,
        stride: Stride,
        resident_bytes: u64,
    ) -> Result<Self> {
        let cut = Cut::new::<T>(spill.vertices, resident_bytes);
        let first = runs(cut.ranges());
        let choice = Choice::new(spill.vertices, stride);
        let workers = scan.triangles(
            crew,
            || Buffers::new(&first, scratch),
            |buffers, chunk| {
                for (number, face) in (chunk.first..).zip(chunk.triangles) {
                    let &[a, b, c] = face;
                    if a != b && b != c && c != a {
                        let tag = tag(number, |corner| choice.meets(face[corner]));
                        buffers.push(cut.range(a), &[bytemuck::bytes_of(&[tag, a, b, c])])?;
                    }
                }
                Ok(())
            },
        )?;
        workers.into_iter().try_for_each(Buffers::finish)?;
        drop(choice);
        let mut join = Join { spill, cut, waiting: first, wild: AtomicU32::new(u32::MAX) };
        join.resolve(crew, scratch, 0)?;
        join.resolve(crew, scratch, 1)?;
        Ok(join)
    }

    /// Bytes of a record with so many corners known: tag, positions, vertices.
    fn record_bytes(known: usize) -> usize {
        4 + known * size_of::<[T; 3]>() + (3 - known) * 4
    }

    /// Brings the position of the next corner to records that have `known`, and sorts them by the one after.
    fn resolve(&mut self, crew: &Crew, scratch: &Scratch, known: usize) -> Result<()> {
        let next = runs(self.cut.ranges());
        let (head, length) = (4 + known * size_of::<[T; 3]>(), Self::record_bytes(known));
        for (range, run) in std::mem::take(&mut self.waiting).into_iter().enumerate() {
            let Some(file) = run.into_file() else { continue };
            let positions = self.load(range, crew)?;
            let workers = turns(
                &file,
                length,
                crew,
                || Buffers::new(&next, scratch),
                |buffers, record| {
                    let position = self.seen(vertex(record, head), &positions);
                    let to = self.cut.range(vertex(record, head + 4));
                    buffers.push(to, &[&record[..head], bytemuck::bytes_of(&position), &record[head + 4..]])
                },
            )?;
            workers.into_iter().try_for_each(Buffers::finish)?;
        }
        self.waiting = next;
        Ok(())
    }

    /// The position of a vertex that a face uses.
    #[inline(always)]
    fn seen(&self, vertex: u32, positions: &Positions<T>) -> [T; 3] {
        let position = positions.at(vertex);
        if !widen(position).is_finite() {
            self.wild.fetch_min(vertex, Relaxed);
        }
        position
    }

    /// The first vertex that is not finite though a face uses it, of those that have been met.
    pub(super) fn wild(&self) -> Option<u32> {
        Some(self.wild.load(Relaxed)).filter(|vertex| *vertex != u32::MAX)
    }

    /// Streams every face to feeds, one a worker. What they get is worth nothing if a vertex turns out to be wild.
    pub(super) fn faces<'k>(&self, crew: &Crew, place: Place, idle: &Idle<'k>) -> Result<Vec<Feed<'k>>> {
        let size = size_of::<[T; 3]>();
        for (range, run) in self.waiting.iter().enumerate() {
            let waiting = run.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
            let Some(file) = waiting.as_ref() else { continue };
            let positions = self.load(range, crew)?;
            let done = turns(
                file,
                Self::record_bytes(2),
                crew,
                || idle.take(),
                |feed, record| {
                    let last = self.seen(vertex(record, 4 + 2 * size), &positions);
                    let known = |k: usize| bytemuck::pod_read_unaligned::<[T; 3]>(&record[4 + k * size..][..size]);
                    feed.push(Facet::new(vertex(record, 0), [place.of(known(0)), place.of(known(1)), place.of(last)]));
                    Ok(())
                },
            )?;
            idle.put(done);
        }
        Ok(idle.take_all())
    }

    fn load(&self, range: usize, crew: &Crew) -> Result<Positions<T>> {
        crew.progress.check()?;
        let (first, count) = self.cut.span(range);
        let mut positions = vec![[T::narrow(0.0); 3]; count];
        self.spill.read(first, &mut positions)?;
        Ok(Positions { first: first as u32, positions })
    }
}

/// A range's positions.
struct Positions<T> {
    first: u32,
    positions: Vec<[T; 3]>,
}

impl<T: Coordinate> Positions<T> {
    #[inline(always)]
    fn at(&self, vertex: u32) -> [T; 3] {
        self.positions[(vertex - self.first) as usize]
    }
}

#[inline(always)]
fn vertex(record: &[u8], at: usize) -> u32 {
    bytemuck::pod_read_unaligned(&record[at..at + 4])
}

/// Gives every record of a file to one of the workers, which take turns.
fn turns<W: Send>(
    file: &ScratchFile,
    length: usize,
    crew: &Crew,
    worker: impl Fn() -> W + Sync,
    step: impl Fn(&mut W, &[u8]) -> Result<()> + Sync,
) -> Result<Vec<W>> {
    let next = AtomicUsize::new(0);
    let records = file.length() as usize / length;
    let work = || {
        let (mut mine, mut bytes) = (worker(), Vec::new());
        loop {
            crew.progress.check()?;
            let first = next.fetch_add(TURN, Relaxed);
            if first >= records {
                return Ok(mine);
            }
            bytes.resize(TURN.min(records - first) * length, 0);
            file.read_exact_at(&mut bytes, (first * length) as u64)?;
            bytes.chunks_exact(length).try_for_each(|record| step(&mut mine, record))?;
        }
    };
    std::thread::scope(|scope| {
        let count = crew.workers.max(1);
        let kept = move |worker| {
            cores::keep(worker, count);
            work()
        };
        let workers: Vec<_> = (0..count).map(|worker| scope.spawn(move || kept(worker))).collect();
        workers.into_iter().map(|w| w.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}
