//! Samples of the surface, taken while faces stream past, for the refit of the result.
//!
//! What clustering makes of a scan is not the scan: a cell's vertex lies where its planes agree, and parts thinner than
//! a cell are lost or swollen. The refit measures against points of the scan itself. At 8 times the target that takes 6
//! % off E_avg, at 4 times a quarter, at twice nearly a half.
//!
//! A face gets as many samples as its area asks for, rounded up or down by a hash of where it lies: neither threads nor
//! the order of faces decide. Were there more than was estimated, all go whose level is too low.

use super::grid::{Corner, Grid, LOCAL_BITS, STEPS, coordinates, is_far};
use super::table::{CellTable, mix};
use crate::error::{Error, Result};
use crate::mesh::samples::{LEVELS, Lattice, SAMPLE_BYTES, SampleFile, SurfaceSample, fold, level_for};
use crate::scratch::{Scratch, ScratchFile};
use glam::{DVec3, Vec3};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// Samples that a worker holds back before it writes them.
const HELD_BACK: usize = 3072;
/// Bytes of a worker's [`SampleWorker`].
pub(super) const WORKER_BYTES: usize = HELD_BACK * SAMPLE_BYTES;

/// How many times as many samples as were asked for are kept if the surface turns out to be larger than estimated.
const SLACK: u64 = 2;

/// A corner's place in its cell.
const LOCAL: u64 = (1 << (3 * LOCAL_BITS)) - 1;

/// What chance draws of a face, whichever of its corners comes first.
fn draw(face: [Corner; 3]) -> u32 {
    scramble(seed(face))
}

/// What that is drawn from.
#[inline(always)]
pub(super) fn seed(face: [Corner; 3]) -> u32 {
    let sum = face.iter().fold(0, |sum, corner| sum + (corner.0 & LOCAL));
    (sum ^ sum >> 26) as u32
}

#[inline(always)]
pub(super) fn scramble(hash: u32) -> u32 {
    let hash = (hash ^ hash >> 16).wrapping_mul(0x7feb_352d);
    let hash = (hash ^ hash >> 15).wrapping_mul(0x846c_a68b);
    hash ^ hash >> 16
}

/// Samples of one face, at most.
const MOST_A_FACE: u32 = 1 << 20;

/// Where workers write samples.
pub(super) struct Sampler<'a> {
    table: &'a CellTable,
    lattice: Lattice,
    /// The lattice's steps of the grid's origin, and of a step of the grid.
    origin: DVec3,
    scale: f64,
    /// Samples for each quantum of weight.
    rate: f64,
    /// The area of a quantum in the frame.
    quantum_area: f64,
    most: u64,
    file: ScratchFile,
    written: AtomicU64,
    levels: [AtomicU64; LEVELS],
    /// Samples below are no longer written.
    level: AtomicU32,
    failure: Mutex<Option<Error>>,
}

impl<'a> Sampler<'a> {
    /// For about `wanted` samples of a surface of `area` cells², of which a quantum of weight is `quantum`.
    pub(super) fn new(
        (grid, table): (&'a Grid, &'a CellTable),
        lattice: Lattice,
        (area, quantum): (f64, f64),
        wanted: u64,
        scratch: &Scratch,
    ) -> Result<Self> {
        let rate = wanted as f64 * quantum / area.max(quantum);
        Ok(Sampler {
            table,
            lattice,
            origin: lattice.steps_to(grid.origin()),
            scale: lattice.steps_of(grid.cell / STEPS),
            rate,
            quantum_area: quantum * grid.cell * grid.cell,
            most: SLACK * wanted,
            file: scratch.file()?,
            written: AtomicU64::new(0),
            levels: Default::default(),
            level: AtomicU32::new(0),
            failure: Mutex::new(None),
        })
    }

    fn write(&self, samples: &[SurfaceSample], counts: &mut [u64; LEVELS]) {
        for (level, count) in self.levels.iter().zip(counts.iter_mut()) {
            level.fetch_add(std::mem::take(count), Relaxed);
        }
        self.level.fetch_max(level_for(&self.counts(), self.most), Relaxed);
        let first = self.written.fetch_add(samples.len() as u64, Relaxed);
        if let Err(error) = self.file.write_all_at(bytemuck::cast_slice(samples), first * SAMPLE_BYTES as u64) {
            self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        }
    }

    fn counts(&self) -> [u64; LEVELS] {
        std::array::from_fn(|level| self.levels[level].load(Relaxed))
    }

    /// What was written, once all workers have flushed.
    pub(super) fn finish(self) -> Result<SampleFile> {
        let levels = self.counts();
        match self.failure.into_inner().unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error),
            None => Ok(SampleFile {
                file: self.file,
                written: self.written.into_inner(),
                levels,
                lattice: self.lattice,
                area: self.quantum_area / self.rate,
            }),
        }
    }
}

/// A worker's end of [`Sampler`].
pub(super) struct SampleWorker<'a> {
    sampler: &'a Sampler<'a>,
    held: Vec<SurfaceSample>,
    counts: [u64; LEVELS],
}

impl<'a> SampleWorker<'a> {
    pub(super) fn new(sampler: &'a Sampler<'a>) -> Self {
        let held = Vec::with_capacity(HELD_BACK);
        SampleWorker { sampler, held, counts: [0; LEVELS] }
    }

    /// Samples for each quantum of weight.
    pub(super) fn rate(&self) -> f32 {
        self.sampler.rate as f32
    }

    /// Takes so many samples of a face.
    #[inline(never)]
    pub(super) fn add(&mut self, face: [Corner; 3], count: u32, normal: Vec3) {
        let Sampler { table, lattice, origin, scale, .. } = self.sampler;
        let keys = face.map(|corner| table.key(corner.cell()));
        if is_far(keys[0] | keys[1] | keys[2]) || normal == Vec3::ZERO {
            return;
        }
        // A face may come with any of its corners first.
        let place = |i: usize| (keys[i], face[i].0 & LOCAL);
        let least = if place(0) < place(1) && place(0) < place(2) {
            [0, 1, 2]
        } else if place(1) < place(2) {
            [1, 2, 0]
        } else {
            [2, 0, 1]
        };
        let at = least.map(|i| {
            let (cell, local) = (coordinates(keys[i]), face[i].local());
            let along = |axis: usize| ((cell[axis] << LOCAL_BITS) + i64::from(local[axis])) as f64;
            DVec3::new(along(0), along(1), along(2))
        });
        let (first, u, v) = (at[0], at[1] - at[0], at[2] - at[0]);
        let folded = fold(normal);
        let mut hash = u64::from(draw(face)) ^ (face[least[0]].0 & LOCAL) << 32;
        for _ in 0..count.min(MOST_A_FACE) {
            hash = mix(hash);
            let part = |bits: u64| (bits as u32 & 0xff_ffff) as f32 * (1.0 / (1 << 24) as f32);
            let (s, t) = (f64::from(part(hash >> 8)), f64::from(part(hash >> 36)));
            let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
            let steps = *origin + (first + s * u + t * v) * *scale;
            if let Some(sample) = SurfaceSample::placed(lattice, steps, folded, face[least[0]].cell()) {
                self.hold(sample);
            }
        }
    }

    fn hold(&mut self, sample: SurfaceSample) {
        let level = sample.level();
        self.counts[level as usize] += 1;
        if level >= self.sampler.level.load(Relaxed) {
            self.held.push(sample);
            if self.held.len() == HELD_BACK {
                self.flush();
            }
        }
    }

    pub(super) fn flush(&mut self) {
        self.sampler.write(&self.held, &mut self.counts);
        self.held.clear();
    }
}
