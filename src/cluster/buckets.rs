//! Faces in buckets on scratch, by their least vertex.
//!
//! Faces in no order have corners all over the binned vertices and cells all over the table, and wait for memory at each
//! of them. Where vertices are in a sensible order, a bucket's faces have theirs close together, in the caches. Putting
//! faces into buckets costs writing and reading 12 bytes for each: less than half of what they would wait.

use crate::cores;
use crate::error::Result;
use crate::read::{Crew, Scan};
use crate::scratch::{Scratch, ScratchFile};
use std::borrow::Borrow;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// Buckets at most: each is an open file, and a buffer a worker.
pub(super) const BUCKETS: u64 = 256;
/// Words of a buffer: 8 KiB.
const BUFFER: usize = 2048;

/// Bytes of scratch that a face takes.
pub(super) const FACE_BYTES: u64 = 12;
/// Bytes that a worker holds while faces are put into buckets.
pub(super) const WRITER_BYTES: usize = BUCKETS as usize * BUFFER * 4;

/// Vertices of a bucket, as a power of two.
pub(super) fn bucket_bits(vertices: u64) -> u32 {
    vertices.div_ceil(BUCKETS).next_power_of_two().trailing_zeros()
}

/// All faces of a scan but those that repeat a vertex.
pub(super) struct Buckets {
    /// Where a bucket has faces: three words each.
    pub(super) files: Vec<Option<ScratchFile>>,
    /// Faces that repeat a vertex.
    pub(super) repeated: u64,
}

impl Buckets {
    /// Puts an indexed scan's faces into buckets.
    pub(super) fn fill(scan: &Scan, crew: &Crew, scratch: &Scratch) -> Result<Buckets> {
        let bits = bucket_bits(scan.vertex_count());
        let runs: Vec<Run> = (0..scan.vertex_count().div_ceil(1 << bits)).map(|_| Run::default()).collect();
        let workers = scan.triangles(
            crew,
            || (Writer::new(&runs, scratch), 0),
            |(writer, repeated), chunk| {
                for &[a, b, c] in chunk.triangles {
                    if a == b || b == c || c == a {
                        *repeated += 1;
                    } else {
                        writer.push((a.min(b).min(c) >> bits) as usize, &[a, b, c])?;
                    }
                }
                Ok(())
            },
        )?;
        let mut repeated = 0;
        for (writer, r) in workers {
            writer.finish()?;
            repeated += r;
        }
        Ok(Buckets { files: runs.iter().map(Run::take).collect(), repeated })
    }

    /// Has `workers` go through all faces, about a bucket at a time.
    pub(super) fn stream<W: Send>(
        &self,
        crew: &Crew,
        workers: &mut [W],
        step: impl Fn(&mut W, &[[u32; 3]]) -> Result<()> + Sync,
    ) -> Result<()> {
        let files: Vec<_> = self.files.iter().flatten().map(|file| (3, file)).collect();
        read(&files, crew, workers, |worker, _, words| step(worker, bytemuck::cast_slice(words)))
    }
}

/// Records of one length on scratch; the file is made when the first come.
#[derive(Default)]
pub(super) struct Run(Mutex<Option<ScratchFile>>);

impl Run {
    fn append(&self, words: &[u32], scratch: &Scratch) -> Result<()> {
        let mut file = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let file = match &mut *file {
            Some(file) => file,
            none => none.insert(scratch.file()?),
        };
        file.write_all_at(bytemuck::cast_slice(words), file.length())
    }

    /// The file so far, if there is one.
    pub(super) fn take(&self) -> Option<ScratchFile> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

/// A worker's buffers in front of runs.
pub(super) struct Writer<'a> {
    runs: &'a [Run],
    scratch: &'a Scratch,
    buffers: Vec<Vec<u32>>,
}

impl<'a> Writer<'a> {
    pub(super) fn new(runs: &'a [Run], scratch: &'a Scratch) -> Self {
        Writer { runs, scratch, buffers: vec![Vec::new(); runs.len()] }
    }

    #[inline(always)]
    pub(super) fn push(&mut self, run: usize, record: &[u32]) -> Result<()> {
        if self.buffers[run].len() + record.len() > BUFFER {
            self.flush(run)?;
        }
        self.buffers[run].extend_from_slice(record);
        Ok(())
    }

    #[cold]
    fn flush(&mut self, run: usize) -> Result<()> {
        self.runs[run].append(&self.buffers[run], self.scratch)?;
        self.buffers[run].clear();
        self.buffers[run].reserve_exact(BUFFER);
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
const PIECE: usize = 1 << 17;
/// Records that a worker reads at a time.
const BLOCK: usize = 2048;

/// Bytes that a worker holds for records of so many words.
pub(super) const fn reader_bytes(words: usize) -> usize {
    BLOCK * words * 4
}

/// Has `workers` go through files of records, so many words each; `step` is told how many.
pub(super) fn read<W: Send>(
    files: &[(usize, impl Borrow<ScratchFile> + Sync)],
    crew: &Crew,
    workers: &mut [W],
    step: impl Fn(&mut W, usize, &[u32]) -> Result<()> + Sync,
) -> Result<()> {
    let pieces = files.iter().flat_map(|(words, file)| {
        let (words, file) = (*words, file.borrow());
        let records = file.length() as usize / (4 * words);
        (0..records).step_by(PIECE).map(move |first| (words, file, first..records.min(first + PIECE)))
    });
    let pieces: Vec<_> = pieces.collect();
    let (next, count) = (AtomicUsize::new(0), workers.len());
    let work = |worker: &mut W| {
        let mut block = Vec::new();
        while let Some((words, file, records)) = pieces.get(next.fetch_add(1, Relaxed)) {
            for first in records.clone().step_by(BLOCK) {
                crew.progress.check()?;
                block.resize(BLOCK.min(records.end - first) * words, 0u32);
                file.read_exact_at(bytemuck::cast_slice_mut(&mut block), (4 * words * first) as u64)?;
                step(worker, *words, &block)?;
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
