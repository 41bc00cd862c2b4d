//! Samples of the surface, taken while faces stream past, for the refit of the result.
//!
//! What clustering makes of a scan is not the scan: a cell's vertex lies where its planes agree, and parts thinner than
//! a cell are lost or swollen. The refit measures against points of the scan itself. At 8 times the target that takes 6
//! % off E_avg, at 4 times a quarter, at twice nearly a half.
//!
//! A face gets as many samples as its area asks for, rounded up or down by a hash of where it lies: neither threads nor
//! the order of faces decide. One alone is the face's middle (E_avg is the same, in half the time); more are scattered.
//! Were there more than was estimated, all go whose level is too low.

use super::corners::Faces;
use super::grid::{Corner, Grid, LOCAL_BITS, STEPS, absolute_near, along, is_far};
use super::shares::Plane;
use super::table::{CellTable, mix};
use crate::error::{Error, Result};
use crate::mesh::samples::{LEVELS, Lattice, SAMPLE_BYTES, SampleFile, SurfaceSample, fold, level_for};
use crate::scratch::{Scratch, ScratchFile};
use fearless_simd::Simd;
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

/// A hash of what was drawn, in all of its bits.
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

    /// Takes so many samples of each of those of `faces` that are `asking`.
    #[inline(always)]
    pub(super) fn take<V: Simd, const N: usize>(
        &mut self,
        simd: V,
        faces: Faces,
        asking: &[u16],
        (counts, planes): (&[u32; N], &[Plane; N]),
    ) {
        let table = self.sampler.table;
        for some in asking.chunks(TOGETHER) {
            let mut middles = Middles::none();
            for &i in some {
                let i = usize::from(i) % N;
                let face = faces.map(|corners| corners[i]);
                let keys = face.map(|corner| table.key(corner.cell()));
                let normal = planes[i].normal();
                if is_far(keys[0] | keys[1] | keys[2]) || normal == Vec3::ZERO {
                    continue;
                }
                match counts[i] {
                    1 => middles.put(face, keys, normal),
                    count => self.scatter(face, keys, count, normal),
                }
            }
            let (places, normals) = middles.placed(simd, self.sampler);
            for i in 0..middles.count.min(TOGETHER) {
                self.hold(places[i], normals[i], middles.near[i]);
            }
        }
    }

    /// Takes samples anywhere on a face.
    #[inline(never)]
    fn scatter(&mut self, face: [Corner; 3], keys: [u64; 3], count: u32, normal: Vec3) {
        let Sampler { lattice, origin, scale, .. } = self.sampler;
        let (normal, near) = (fold(normal), near(face, keys));
        let at: [[i64; 3]; 3] = std::array::from_fn(|i| absolute_near(face[i], keys[i]));
        // A face may come with any of its corners first.
        let least = (0..3).min_by_key(|i| at[*i]).unwrap_or(0);
        let [first, second, third] = [0, 1, 2].map(|i| DVec3::from(at[(least + i) % 3].map(|x| x as f64)));
        let (u, v) = (second - first, third - first);
        let mut hash = u64::from(draw(face)) ^ (face[least].0 & LOCAL) << 32;
        for _ in 0..count.min(MOST_A_FACE) {
            hash = mix(hash);
            let part = |bits: u64| (bits as u32 & 0xff_ffff) as f32 * (1.0 / (1 << 24) as f32);
            let (s, t) = (f64::from(part(hash >> 8)), f64::from(part(hash >> 36)));
            let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
            let steps = *origin + (first + s * u + t * v) * *scale;
            let [place] = lattice.places(&steps.to_array().map(|x| [x]));
            self.hold(place, normal, near);
        }
    }

    /// Takes the sample at a place on the lattice.
    #[inline(always)]
    fn hold(&mut self, place: u64, normal: [i16; 2], near: u32) {
        let Some(sample) = SurfaceSample::placed(place, normal, near) else { return };
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

/// Faces whose middles are worked out together.
const TOGETHER: usize = 16;

/// The middles of some faces, as samples: each stands for its face no worse than any other point of it.
struct Middles {
    corners: [[u64; TOGETHER]; 3],
    keys: [[u64; TOGETHER]; 3],
    normals: [[f32; TOGETHER]; 3],
    near: [u32; TOGETHER],
    count: usize,
}

impl Middles {
    fn none() -> Self {
        let (corners, keys) = ([[0; TOGETHER]; 3], [[0; TOGETHER]; 3]);
        Middles { corners, keys, normals: [[0.0; TOGETHER]; 3], near: [0; TOGETHER], count: 0 }
    }

    #[inline(always)]
    fn put(&mut self, face: [Corner; 3], keys: [u64; 3], normal: Vec3) {
        let i = self.count % TOGETHER;
        for corner in 0..3 {
            (self.corners[corner][i], self.keys[corner][i]) = (face[corner].0, keys[corner]);
            self.normals[corner][i] = normal[corner];
        }
        self.near[i] = near(face, keys);
        self.count += 1;
    }

    /// Their places on the lattice and folded normals.
    #[inline(always)]
    fn placed<V: Simd>(&self, _: V, sampler: &Sampler) -> ([u64; TOGETHER], [[i16; 2]; TOGETHER]) {
        let mut steps = [[0.0; TOGETHER]; 3];
        for (axis, steps) in steps.iter_mut().enumerate() {
            let (origin, third) = (sampler.origin[axis], sampler.scale / 3.0);
            for (i, steps) in steps.iter_mut().enumerate() {
                let at = |corner: usize| along(Corner(self.corners[corner][i]), self.keys[corner][i], axis as u32);
                *steps = origin + (at(0) + at(1) + at(2)) as f64 * third;
            }
        }
        let mut normals = [[0; 2]; TOGETHER];
        let [x, y, z] = &self.normals;
        for i in 0..TOGETHER {
            normals[i] = fold(Vec3::new(x[i], y[i], z[i]));
        }
        (sampler.lattice.places(&steps), normals)
    }
}

/// The cell that a sample of a face counts as near to, whichever of its corners comes first.
#[inline(always)]
fn near(face: [Corner; 3], keys: [u64; 3]) -> u32 {
    let first = (1..3).fold(0, |first, i| if keys[i] < keys[first] { i } else { first });
    face[first].cell()
}
