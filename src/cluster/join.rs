//! Faces joined to their vertices when neither fits memory and their orders have nothing to do with each other.
//!
//! Vertices are cut into *ranges* that fit memory, ranges into *buckets*. First every face goes to the bucket of its
//! least vertex. Then one sweep over the ranges, upwards: a range's corners are loaded once, and each face that waits
//! there has the corners resolved that lie in it. A face with corners left waits at the least range that has one of
//! them, which is always further up; so one sweep resolves everything, and a file is freed as soon as the sweep has
//! passed. Buckets finer than ranges cost nothing and keep faces that are close together, whose cells then stay in the
//! caches.

use super::corners::{Feed, Sink};
use super::grid::Corner;
use super::spill::SpillFile;
use super::used::Used;
use crate::cores;
use crate::error::Result;
use crate::read::{Crew, Scan};
use crate::scratch::{Scratch, ScratchFile};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Buckets at most: each is an open file, and a buffer a worker.
const BUCKETS: u64 = 256;
/// Words of a buffer: 8 KiB.
const BUFFER: usize = 2048;
/// Records that a worker reads at a time.
const RUN: usize = 8192;

/// Bytes that a worker of a join holds: buffers while faces are partitioned; then a run of records, and buffers for
/// those that wait at ranges further up, of which there are fewer.
pub(super) const WORKER_BYTES: usize = BUCKETS as usize * BUFFER * 4 + RUN * WORDS[2] * 4;

/// How vertices are cut up.
#[derive(Debug, Clone, Copy)]
struct Cut {
    vertices: u64,
    /// A bucket is `1 << bucket_bits` vertices.
    bucket_bits: u32,
    /// A range is this many buckets.
    buckets_a_range: u64,
}

impl Cut {
    fn new(vertices: u64, resident_bytes: u64) -> Self {
        let bucket_bits = vertices.div_ceil(BUCKETS).next_power_of_two().trailing_zeros();
        let buckets_a_range = ((resident_bytes / 8) >> bucket_bits).max(1);
        Cut { vertices, bucket_bits, buckets_a_range }
    }

    fn buckets(&self) -> usize {
        self.vertices.div_ceil(1 << self.bucket_bits) as usize
    }

    fn ranges(&self) -> usize {
        (self.buckets() as u64).div_ceil(self.buckets_a_range) as usize
    }

    fn bucket(&self, vertex: u32) -> usize {
        (vertex >> self.bucket_bits) as usize
    }

    fn range(&self, vertex: u32) -> usize {
        (u64::from(vertex >> self.bucket_bits) / self.buckets_a_range) as usize
    }

    /// The first vertex of a range and the number of its vertices.
    fn span(&self, range: usize) -> (u64, usize) {
        let width = self.buckets_a_range << self.bucket_bits;
        let first = range as u64 * width;
        (first, (self.vertices - first).min(width) as usize)
    }
}

/// Words of a record of a face with 0, 1 or 2 corners resolved: those come first, two words each, then the vertices of
/// the others. Turning a face so keeps its orientation.
const WORDS: [usize; 3] = [3, 4, 5];

/// Records of one kind on scratch; the file is made when the first come.
#[derive(Default)]
struct Run(Mutex<Option<ScratchFile>>);

impl Run {
    fn append(&self, words: &[u32], scratch: &Scratch) -> Result<()> {
        let mut file = self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let file = match &mut *file {
            Some(file) => file,
            none => none.insert(scratch.file()?),
        };
        file.write_all_at(bytemuck::cast_slice(words), file.length())
    }

    /// The file, if there is one. Its space is free once it is dropped.
    fn take(&self) -> Option<ScratchFile> {
        self.0.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).take()
    }
}

/// A worker's buffers in front of runs.
struct Buffers<'a> {
    runs: &'a [Run],
    scratch: &'a Scratch,
    buffers: Vec<Vec<u32>>,
}

impl<'a> Buffers<'a> {
    fn new(runs: &'a [Run], scratch: &'a Scratch) -> Self {
        Buffers { runs, scratch, buffers: vec![Vec::new(); runs.len()] }
    }

    #[inline(always)]
    fn push(&mut self, run: usize, record: &[u32]) -> Result<()> {
        if self.buffers[run].len() + record.len() > BUFFER {
            self.flush_one(run)?;
        }
        self.buffers[run].extend_from_slice(record);
        Ok(())
    }

    fn flush_one(&mut self, run: usize) -> Result<()> {
        self.runs[run].append(&self.buffers[run], self.scratch)?;
        self.buffers[run].clear();
        self.buffers[run].reserve_exact(BUFFER);
        Ok(())
    }

    fn flush(&mut self) -> Result<()> {
        for run in 0..self.runs.len() {
            if !self.buffers[run].is_empty() {
                self.flush_one(run)?;
            }
        }
        Ok(())
    }
}

/// Streams every face of an indexed scan to sinks, with at most `resident_bytes` of the spill in memory (or a 256th of
/// it, if that is more).
pub(super) fn stream<'u, K: Sink>(
    scan: &Scan,
    crew: &Crew,
    (spill, used): (&SpillFile, &'u Used),
    scratch: &Scratch,
    resident_bytes: u64,
    sink: impl Fn() -> K + Sync,
) -> Result<Vec<Feed<'u, K>>> {
    let cut = Cut::new(spill.vertices(), resident_bytes);
    let waiting = partition(scan, crew, cut, scratch)?;
    let mut feeds: Vec<Feed<K>> = (0..crew.workers.max(1)).map(|_| Feed::new(sink(), used)).collect();
    feeds[0].repeated = waiting.repeated;
    let partial: [Vec<Run>; 2] = std::array::from_fn(|_| (0..cut.ranges()).map(|_| Run::default()).collect());
    let mut corners = vec![Corner::default(); cut.span(0).1];
    for range in 0..cut.ranges() {
        crew.progress.check()?;
        let (first, count) = cut.span(range);
        load(spill, first, &mut corners[..count], crew.workers)?;
        let buckets = range as u64 * cut.buckets_a_range..(range as u64 + 1) * cut.buckets_a_range;
        let mut files = Vec::new();
        for run in (waiting.buckets.iter()).take(buckets.end as usize).skip(buckets.start as usize) {
            files.extend(run.take().map(|file| (0, file)));
        }
        for known in 1..3 {
            files.extend(partial[known - 1][range].take().map(|file| (known, file)));
        }
        let sweep =
            Sweep { cut, range, first: first as u32, corners: &corners[..count], files, partial: &partial, scratch };
        sweep.run(crew, &mut feeds)?;
    }
    Ok(feeds)
}

/// Faces by the bucket of their least vertex.
struct Partition {
    buckets: Vec<Run>,
    repeated: u64,
}

fn partition(scan: &Scan, crew: &Crew, cut: Cut, scratch: &Scratch) -> Result<Partition> {
    let buckets: Vec<Run> = (0..cut.buckets()).map(|_| Run::default()).collect();
    let workers = scan.triangles(
        crew,
        || (Buffers::new(&buckets, scratch), 0),
        |(buffers, repeated), chunk| {
            for &[a, b, c] in chunk.triangles {
                if a == b || b == c || c == a {
                    *repeated += 1;
                } else {
                    buffers.push(cut.bucket(a.min(b).min(c)), &[a, b, c])?;
                }
            }
            Ok(())
        },
    )?;
    let mut repeated = 0;
    for (mut buffers, r) in workers {
        buffers.flush()?;
        repeated += r;
    }
    Ok(Partition { buckets, repeated })
}

/// Loads consecutive corners, a share a worker.
fn load(spill: &SpillFile, first: u64, corners: &mut [Corner], workers: usize) -> Result<()> {
    let share = corners.len().div_ceil(workers.max(1)).max(1);
    std::thread::scope(|scope| {
        let parts: Vec<_> = (corners.chunks_mut(share).enumerate())
            .map(|(i, part)| {
                scope.spawn(move || {
                    cores::keep(i, workers);
                    spill.read(first + (i * share) as u64, part)
                })
            })
            .collect();
        parts.into_iter().try_for_each(|part| part.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    })
}

/// One range's turn.
struct Sweep<'a> {
    cut: Cut,
    range: usize,
    first: u32,
    corners: &'a [Corner],
    /// Corners known a record, and where the records are.
    files: Vec<(usize, ScratchFile)>,
    /// Faces with one and with two corners known, by the range where they wait.
    partial: &'a [Vec<Run>; 2],
    scratch: &'a Scratch,
}

impl Sweep<'_> {
    fn run<K: Sink>(&self, crew: &Crew, feeds: &mut [Feed<'_, K>]) -> Result<()> {
        let next = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            let (next, count) = (&next, feeds.len());
            let workers: Vec<_> = (feeds.iter_mut().enumerate())
                .map(|(worker, feed)| {
                    scope.spawn(move || {
                        cores::keep(worker, count);
                        self.work(crew, feed, next)
                    })
                })
                .collect();
            workers.into_iter().try_for_each(|w| w.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        })
    }

    fn work<K: Sink>(&self, crew: &Crew, feed: &mut Feed<'_, K>, next: &AtomicUsize) -> Result<()> {
        let mut onward = [0, 1].map(|k: usize| Buffers::new(&self.partial[k], self.scratch));
        let mut words = Vec::new();
        let mut turn = next.fetch_add(1, Relaxed);
        let mut before = 0;
        for (known, file) in &self.files {
            let total = (file.length() / 4) as usize;
            let run = RUN * WORDS[*known];
            let runs = total.div_ceil(run);
            while turn < before + runs {
                crew.progress.check()?;
                let start = (turn - before) * run;
                words.resize(run.min(total - start), 0u32);
                file.read_exact_at(bytemuck::cast_slice_mut(&mut words), start as u64 * 4)?;
                for record in words.chunks_exact(WORDS[*known]) {
                    self.resolve(record, *known, feed, &mut onward)?;
                }
                turn = next.fetch_add(1, Relaxed);
            }
            before += runs;
        }
        onward.iter_mut().try_for_each(Buffers::flush)
    }

    #[inline(always)]
    fn resolve<K: Sink>(
        &self,
        record: &[u32],
        known: usize,
        feed: &mut Feed<'_, K>,
        onward: &mut [Buffers; 2],
    ) -> Result<()> {
        let mut face = [Corner::NOWHERE; 3];
        for (i, corner) in face[..known].iter_mut().enumerate() {
            *corner = Corner(u64::from(record[2 * i]) | u64::from(record[2 * i + 1]) << 32);
        }
        let vertices = &record[2 * known..];
        let mut left = 0;
        for (corner, vertex) in face[known..].iter_mut().zip(vertices) {
            match self.corners.get(vertex.wrapping_sub(self.first) as usize) {
                Some(found) if *found == Corner::NOWHERE => {
                    feed.miss(u64::from(*vertex));
                    return Ok(());
                }
                Some(found) => {
                    feed.uses(*vertex);
                    *corner = *found;
                }
                None => left += 1,
            }
        }
        if left == 0 {
            feed.push(face);
            return Ok(());
        }
        let vertex = |i: usize| vertices[i - known];
        let open = |i: usize| face[i] == Corner::NOWHERE;
        let halves = |c: Corner| [c.0 as u32, (c.0 >> 32) as u32];
        if left == 1 {
            let last = (0..3).find(|i| open(*i)).unwrap_or(2);
            let [a, b] = [1, 2].map(|k| halves(face[(last + k) % 3]));
            let to = self.cut.range(vertex(last));
            return onward[1].push(to, &[a[0], a[1], b[0], b[1], vertex(last)]);
        }
        let lead = (0..3).find(|i| !open(*i)).unwrap_or(0);
        let (u, v) = (vertex((lead + 1) % 3), vertex((lead + 2) % 3));
        let a = halves(face[lead]);
        let to = self.cut.range(u.min(v));
        debug_assert!(to > self.range);
        onward[0].push(to, &[a[0], a[1], u, v])
    }
}
