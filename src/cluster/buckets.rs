//! Faces in buckets on scratch, by their least vertex.
//!
//! Faces in no order have corners all over the binned vertices and cells all over the table, and wait for memory at each
//! of them. Where vertices are in a sensible order, a bucket's faces have theirs close together, in the caches. Putting
//! faces into buckets costs writing and reading 6 bytes for each, 12 where its vertices are far apart in number: less than
//! half of what they would wait.

use crate::cores;
use crate::error::Result;
use crate::read::{Crew, Scan};
use crate::scratch::{Scratch, ScratchFile};
use std::borrow::Borrow;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};

/// Buckets at most: each is a buffer or two a worker.
pub(super) const BUCKETS: u64 = 256;
/// Halves of words of the buffers in front of a run, or of one in each of two sets of runs: 8 KiB.
pub(super) const BUFFER: usize = 4096;

/// Bytes of scratch that a face takes, at most.
pub(super) const FACE_BYTES: u64 = 12;
/// Bytes that a worker holds while faces are put into buckets.
pub(super) const WRITER_BYTES: usize = BUCKETS as usize * BUFFER * 2;

/// Vertices of a bucket, as a power of two.
pub(super) fn bucket_bits(vertices: u64) -> u32 {
    vertices.div_ceil(BUCKETS).next_power_of_two().trailing_zeros()
}

/// All faces of a scan but those that repeat a vertex.
pub(super) struct Buckets {
    /// What each bucket has.
    pub(super) all: Vec<Bucket>,
    /// Faces that repeat a vertex.
    pub(super) repeated: u64,
}

/// The faces of a bucket, each turned so that its least vertex leads.
pub(super) struct Bucket {
    first: u32,
    near: Option<Records>,
    pub(super) wide: Option<Records>,
}

/// How faces are put down.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// How far the least vertex is from the bucket's first one, and how far the others are from that: half a word each.
    Near { first: u32 },
    /// Their vertices, a word each.
    Wide,
}

impl Form {
    const fn halves(self) -> usize {
        match self {
            Form::Near { .. } => 3,
            Form::Wide => 6,
        }
    }

    /// The faces of records, one after the other.
    #[inline(always)]
    pub(super) fn each(self, records: &[u16], mut take: impl FnMut([u32; 3]) -> Result<()>) -> Result<()> {
        match self {
            Form::Near { first } => records.as_chunks::<3>().0.iter().try_for_each(|record| {
                let [a, b, c] = record.map(u32::from);
                take([first + a, first + a + b, first + a + c])
            }),
            Form::Wide => records.as_chunks::<6>().0.iter().try_for_each(|record| take(bytemuck::cast(*record))),
        }
    }
}

impl Bucket {
    fn records(&self) -> impl Iterator<Item = (Form, &Records)> {
        let near = self.near.iter().map(|records| (Form::Near { first: self.first }, records));
        near.chain(self.wide.iter().map(|records| (Form::Wide, records)))
    }
}

impl Buckets {
    /// Puts an indexed scan's faces into buckets, each in a form as short as it allows, or all of them wide and each bucket in
    /// a file that is freed with it.
    pub(super) fn fill(scan: &Scan, crew: &Crew, scratch: &Scratch, all_wide: bool) -> Result<Buckets> {
        let bits = bucket_bits(scan.vertex_count());
        let count = scan.vertex_count().div_ceil(1 << bits) as usize;
        let runs = || if all_wide { Ok(Run::apart(count)) } else { Run::side_by_side(count, scratch) };
        let runs = [runs()?, runs()?];
        let buffer = if all_wide { BUFFER } else { BUFFER / 2 };
        let workers = scan.triangles(
            crew,
            || (runs.each_ref().map(|runs| Writer::new(runs, scratch, buffer)), 0),
            |([near, wide], repeated), chunk| {
                for &[a, b, c] in chunk.triangles {
                    if a == b || b == c || c == a {
                        *repeated += 1;
                        continue;
                    }
                    let least = a.min(b).min(c);
                    let face @ [a, b, c] = match least {
                        least if least == a => [a, b, c],
                        least if least == b => [b, c, a],
                        _ => [c, a, b],
                    };
                    let bucket = (a >> bits) as usize;
                    let [from, to_b, to_c] = [a & ((1 << bits) - 1), b - a, c - a];
                    if !all_wide && (from | to_b | to_c) >> 16 == 0 {
                        near.push(bucket, &[from as u16, to_b as u16, to_c as u16])?;
                    } else {
                        wide.push(bucket, &bytemuck::cast::<_, [u16; 6]>(face))?;
                    }
                }
                Ok(())
            },
        )?;
        let mut repeated = 0;
        for (writers, r) in workers {
            writers.into_iter().try_for_each(Writer::finish)?;
            repeated += r;
        }
        let bucket = |(i, (near, wide)): (usize, (&Run, &Run))| Bucket {
            first: (i << bits) as u32,
            near: near.take(),
            wide: wide.take(),
        };
        let all = runs[0].iter().zip(&runs[1]).enumerate().map(bucket).collect();
        Ok(Buckets { all, repeated })
    }

    /// Has `workers` go through all faces, about a bucket at a time.
    pub(super) fn stream<W: Send>(
        &self,
        crew: &Crew,
        workers: &mut [W],
        step: impl Fn(&mut W, Form, &[u16]) -> Result<()> + Sync,
    ) -> Result<()> {
        let records = self.all.iter().flat_map(Bucket::records).map(|(form, records)| (form.halves(), form, records));
        read(&records.collect::<Vec<_>>(), crew, workers, |worker, form, records| step(worker, *form, records))
    }
}

/// Records of one length, while they are put on scratch.
#[derive(Default)]
pub(super) struct Run(Mutex<Option<Records>>);

impl Run {
    /// So many runs, in one file: where 400 were made for a scan, and those of the scans before had just been deleted, looking
    /// for 400 free inodes took a tenth to a third of the time that clustering did (ext4).
    fn side_by_side(count: usize, scratch: &Scratch) -> Result<Vec<Run>> {
        let file = Arc::new(scratch.file()?);
        Ok((0..count).map(|_| Run(Mutex::new(Some(Records::new(file.clone()))))).collect())
    }

    /// So many runs, each in a file that is made when the first records come.
    pub(super) fn apart(count: usize) -> Vec<Run> {
        (0..count).map(|_| Run::default()).collect()
    }

    fn append(&self, halves: &[u16], scratch: &Scratch) -> Result<()> {
        let mut records = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let records = match &mut *records {
            Some(records) => records,
            none => none.insert(Records::new(Arc::new(scratch.file()?))),
        };
        records.append(bytemuck::cast_slice(halves))
    }

    /// The records so far, if there are any; others go to another file.
    pub(super) fn take(&self) -> Option<Records> {
        let records = self.0.lock().unwrap_or_else(PoisonError::into_inner).take();
        records.filter(|records| records.length > 0)
    }
}

/// Records of one length on scratch, one behind the other as far as who reads them can tell. Where runs share a file, their
/// lists take a tenth of a byte a vertex: what an account of used vertices would, which resident ones keep themselves.
pub(super) struct Records {
    file: Arc<ScratchFile>,
    /// In order.
    pieces: Vec<Piece>,
    length: u64,
}

/// Bytes that lie together.
struct Piece {
    /// Where they are among the records' bytes, and in the file.
    start: u64,
    offset: u64,
}

impl Records {
    fn new(file: Arc<ScratchFile>) -> Self {
        Records { file, pieces: Vec::new(), length: 0 }
    }

    fn append(&mut self, bytes: &[u8]) -> Result<()> {
        let offset = self.file.append(bytes)?;
        let is_next = |piece: &Piece| piece.offset + (self.length - piece.start) == offset;
        if !self.pieces.last().is_some_and(is_next) {
            self.pieces.push(Piece { start: self.length, offset });
        }
        self.length += bytes.len() as u64;
        Ok(())
    }

    /// Fills `bytes` with those from `start` on.
    fn read_exact_at(&self, mut bytes: &mut [u8], mut start: u64) -> Result<()> {
        let first = self.pieces.partition_point(|piece| piece.start <= start).saturating_sub(1);
        let ends = self.pieces[first..].iter().skip(1).map(|piece| piece.start).chain([self.length]);
        for (piece, end) in self.pieces[first..].iter().zip(ends) {
            let count = bytes.len().min((end - start) as usize);
            if count == 0 {
                break;
            }
            let now;
            (now, bytes) = bytes.split_at_mut(count);
            self.file.read_exact_at(now, piece.offset + (start - piece.start))?;
            start += count as u64;
        }
        debug_assert!(bytes.is_empty());
        Ok(())
    }
}

/// A worker's buffers in front of runs.
pub(super) struct Writer<'a> {
    runs: &'a [Run],
    scratch: &'a Scratch,
    /// Halves of words of each.
    room: usize,
    buffers: Vec<Vec<u16>>,
}

impl<'a> Writer<'a> {
    /// With buffers of so many halves of words.
    pub(super) fn new(runs: &'a [Run], scratch: &'a Scratch, room: usize) -> Self {
        Writer { runs, scratch, room, buffers: vec![Vec::new(); runs.len()] }
    }

    #[inline(always)]
    pub(super) fn push(&mut self, run: usize, record: &[u16]) -> Result<()> {
        if self.buffers[run].len() + record.len() > self.room {
            self.flush(run)?;
        }
        self.buffers[run].extend_from_slice(record);
        Ok(())
    }

    #[cold]
    fn flush(&mut self, run: usize) -> Result<()> {
        self.runs[run].append(&self.buffers[run], self.scratch)?;
        self.buffers[run].clear();
        self.buffers[run].reserve_exact(self.room);
        Ok(())
    }

    /// Nothing is complete before this.
    pub(super) fn finish(self) -> Result<()> {
        let left = self.runs.iter().zip(&self.buffers).filter(|(_, buffer)| !buffer.is_empty());
        left.into_iter().try_for_each(|(run, buffer)| run.append(buffer, self.scratch))
    }
}

/// Records that one worker goes through before another may take over: about a bucket of 28 M faces, so that two workers
/// are seldom in the same cells.
const TURN: usize = 1 << 17;
/// Records that a worker reads at a time.
const BLOCK: usize = 2048;

/// Bytes that a worker holds for records of so many halves of words.
pub(super) const fn reader_bytes(halves: usize) -> usize {
    BLOCK * halves * 2
}

/// Has `workers` go through records, of so many halves of words each; `step` is told of which kind they are.
pub(super) fn read<W: Send, K: Copy + Send + Sync>(
    all: &[(usize, K, impl Borrow<Records> + Sync)],
    crew: &Crew,
    workers: &mut [W],
    step: impl Fn(&mut W, &K, &[u16]) -> Result<()> + Sync,
) -> Result<()> {
    let turns = all.iter().flat_map(|(halves, kind, records)| {
        let (halves, records) = (*halves, records.borrow());
        let count = records.length as usize / (2 * halves);
        (0..count).step_by(TURN).map(move |first| (halves, kind, records, first..count.min(first + TURN)))
    });
    let turns: Vec<_> = turns.collect();
    let (next, count) = (AtomicUsize::new(0), workers.len());
    let work = |worker: &mut W| {
        let mut words = Vec::new();
        while let Some((halves, kind, records, turn)) = turns.get(next.fetch_add(1, Relaxed)) {
            for first in turn.clone().step_by(BLOCK) {
                crew.progress.check()?;
                // Where words are, records of words can be.
                words.resize((BLOCK * halves).div_ceil(2), 0u32);
                let block: &mut [u16] = bytemuck::cast_slice_mut(&mut words);
                let block = &mut block[..BLOCK.min(turn.end - first) * halves];
                records.read_exact_at(bytemuck::cast_slice_mut(block), (2 * halves * first) as u64)?;
                step(worker, kind, block)?;
            }
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let threads = workers.iter_mut().enumerate().map(|(i, worker)| {
            let work = &work;
            scope.spawn(move || {
                cores::keep(i, count);
                work(worker)
            })
        });
        let threads: Vec<_> = threads.collect();
        threads.into_iter().try_for_each(|t| t.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    })
}
