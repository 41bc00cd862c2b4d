//! Faces joined to their vertices when neither fits memory and their orders have nothing to do with each other.
//!
//! Vertices are cut into *ranges* that fit memory, ranges into *buckets*. First every face goes to the bucket of its
//! least vertex. Then one sweep over the ranges, upwards: a range's corners are loaded once, and each face that waits
//! there has the corners resolved that lie in it. A face with corners left waits at the least range that has one of
//! them, which is always further up; so one sweep resolves everything, and a file is freed as soon as the sweep has
//! passed. Buckets finer than ranges cost nothing and keep faces that are close together, whose cells then stay in the
//! caches.

use super::buckets::{self, BUFFER, Buckets, Run, Writer};
use super::corners::{Feed, Sink};
use super::grid::Corner;
use super::spill::{Reader, SpillFile};
use super::used::Used;
use crate::cores;
use crate::error::Result;
use crate::read::{Crew, Scan};
use crate::scratch::Scratch;

/// Bytes that a worker of a join holds: buffers while faces are put into buckets; then a block of records, and buffers for
/// those that wait at ranges further up, of which there are fewer.
pub(super) const WORKER_BYTES: usize = buckets::WRITER_BYTES + buckets::reader_bytes(HALVES[2]);

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
        let bucket_bits = buckets::bucket_bits(vertices);
        let buckets_a_range = ((resident_bytes / 8) >> bucket_bits).max(1);
        Cut { vertices, bucket_bits, buckets_a_range }
    }

    fn buckets(&self) -> usize {
        self.vertices.div_ceil(1 << self.bucket_bits) as usize
    }

    fn ranges(&self) -> usize {
        (self.buckets() as u64).div_ceil(self.buckets_a_range) as usize
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

/// Halves of words of a record of a face with 0, 1 or 2 corners resolved: those come first, two words each, then the vertices
/// of the others. Turning a face so keeps its orientation.
const HALVES: [usize; 3] = [6, 8, 10];

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
    let mut waiting = Buckets::fill(scan, crew, scratch, true)?;
    let mut feeds: Vec<Feed<K>> = (0..crew.workers.max(1)).map(|_| Feed::new(sink(), Some(used))).collect();
    feeds[0].repeated = waiting.repeated;
    let partial: [Vec<Run>; 2] = std::array::from_fn(|_| Run::apart(cut.ranges()));
    let mut corners = vec![Corner::default(); cut.span(0).1];
    for range in 0..cut.ranges() {
        crew.progress.check()?;
        let (first, count) = cut.span(range);
        load(spill, first, &mut corners[..count], crew.workers)?;
        let buckets = waiting.all.iter_mut().skip(range * cut.buckets_a_range as usize);
        let whole = buckets.take(cut.buckets_a_range as usize).filter_map(|bucket| Some((0, bucket.wide.take()?)));
        let begun = (1..3).filter_map(|known| Some((known, partial[known - 1][range].take()?)));
        let all: Vec<_> = whole.chain(begun).map(|(known, records)| (HALVES[known], known, records)).collect();
        let sweep = Sweep { cut, range, first: first as u32, corners: &corners[..count] };
        let onward = || partial.each_ref().map(|runs| Writer::new(runs, scratch, BUFFER));
        let mut workers: Vec<_> = feeds.iter_mut().map(|feed| (feed, onward())).collect();
        buckets::read(&all, crew, &mut workers, |(feed, onward), &known, records| {
            let mut records = bytemuck::cast_slice(records).chunks_exact(HALVES[known] / 2);
            records.try_for_each(|record| sweep.resolve(record, known, feed, onward))
        })?;
        workers.into_iter().flat_map(|(_, onward)| onward).try_for_each(Writer::finish)?;
    }
    Ok(feeds)
}

/// Loads consecutive corners, a share a worker.
fn load(spill: &SpillFile, first: u64, corners: &mut [Corner], workers: usize) -> Result<()> {
    let share = corners.len().div_ceil(workers.max(1)).max(1);
    std::thread::scope(|scope| {
        let parts: Vec<_> = (corners.chunks_mut(share).enumerate())
            .map(|(i, part)| {
                scope.spawn(move || {
                    cores::keep(i, workers);
                    spill.read(first + (i * share) as u64, part, &mut Reader::default())
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
}

impl Sweep<'_> {
    #[inline(always)]
    fn resolve<K: Sink>(
        &self,
        record: &[u32],
        known: usize,
        feed: &mut Feed<'_, K>,
        onward: &mut [Writer; 2],
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
                    feed.uses(&[*vertex]);
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
            let record = [a[0], a[1], b[0], b[1], vertex(last)];
            return onward[1].push(to, bytemuck::cast_slice(&record));
        }
        let lead = (0..3).find(|i| !open(*i)).unwrap_or(0);
        let (u, v) = (vertex((lead + 1) % 3), vertex((lead + 2) % 3));
        let a = halves(face[lead]);
        let to = self.cut.range(u.min(v));
        debug_assert!(to > self.range);
        onward[0].push(to, bytemuck::cast_slice(&[a[0], a[1], u, v]))
    }
}
