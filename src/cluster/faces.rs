//! The face pass: every face adds its plane to the cells of its corners, and survives if they are three.
//!
//! Faces come in batches and go through in stages, each a short loop over the batch: apart by kind, edges, cross
//! products, normals, samples (all of these without a branch, several faces at a time), sums. One face at a time would
//! wait for its own square root and division.

use super::corners::{BATCH, Sink};
use super::grid::{Corner, LOCAL_BITS, STEPS, absolute, coordinates, is_far};
use super::sampling::{SampleWorker, draw};
use super::sums::{Gatherer, Share, Sums};
use super::survivors::{Appender, Survivors};
use super::table::CellTable;
use glam::{Vec3, Vec3A};

/// One worker of the face pass.
pub(super) struct FaceWorker<'a> {
    table: &'a CellTable,
    gatherer: Gatherer<'a>,
    appender: Appender<'a>,
    samples: Option<SampleWorker<'a>>,
    batch: Box<Batch>,
    /// Quanta of weight for a cross product of length one.
    quanta: f32,
    /// Faces without area.
    pub(super) flat_faces: u64,
    /// Whether faces that follow one another are expected in the same cells.
    coherent: bool,
}

/// Bytes of a worker's batch.
pub(super) const BATCH_BYTES: usize = size_of::<Batch>();

/// Faces between two stages: those within a cell first, those across cells behind them.
struct Batch {
    faces: [[Corner; 3]; BATCH],
    /// The edges from the first corner to the others, in steps; of [`Batch::long`] ones anything.
    edges: [[[i32; BATCH]; 3]; 2],
    /// What chance draws of a face.
    lots: [u32; BATCH],
    /// Faces with an edge too long for products of 32 bits, and how many these are.
    long: [u16; BATCH],
    longs: usize,
    /// Faces that ask for samples, and how many of them each.
    sampled: [u16; BATCH],
    samples: [u32; BATCH],
    /// Cross product of two edges, later the unit normal.
    x: [f32; BATCH],
    y: [f32; BATCH],
    z: [f32; BATCH],
    /// Weight in quanta.
    w: [f32; BATCH],
}

/// Faces from anywhere whose cells' lines are fetched together: few enough for the first-level cache.
const AT_ONCE: usize = 64;

/// Edges whose products, and differences of two of them, are exact in 32 bits.
const SHORT: i64 = (1 << 15) - 1;

/// What cross products are scaled by, so that no square of one can overflow or vanish: they are 1 to 2⁶⁹ steps².
const CROSS_SCALE: f32 = 1.0 / (1u64 << 32) as f32;

impl<'a> FaceWorker<'a> {
    /// A worker that adds to `sums` and `survivors`, and takes `samples`; `quantum` is the unit of weight, in cells².
    pub(super) fn new(
        table: &'a CellTable,
        sums: &'a Sums,
        survivors: &'a Survivors,
        samples: Option<SampleWorker<'a>>,
        quantum: f64,
        coherent: bool,
    ) -> Self {
        let lanes = [0.0; BATCH];
        let batch = Batch {
            faces: [[Corner::default(); 3]; BATCH],
            edges: [[[0; BATCH]; 3]; 2],
            lots: [0; BATCH],
            long: [0; BATCH],
            longs: 0,
            sampled: [0; BATCH],
            samples: [0; BATCH],
            x: lanes,
            y: lanes,
            z: lanes,
            w: lanes,
        };
        FaceWorker {
            table,
            gatherer: Gatherer::new(sums),
            appender: Appender::new(survivors),
            samples,
            batch: Box::new(batch),
            quanta: (0.5 / (STEPS * STEPS * quantum) / f64::from(CROSS_SCALE)) as f32,
            flat_faces: 0,
            coherent,
        }
    }

    /// Hands over what is still held back.
    pub(super) fn flush(&mut self) {
        self.gatherer.flush();
        self.appender.flush();
        self.samples.iter_mut().for_each(SampleWorker::flush);
    }

    /// Adds the plane of a face within one cell to it.
    #[inline(always)]
    fn add_inside<const COHERENT: bool>(&mut self, i: usize) {
        let batch = &*self.batch;
        let (n, w) = (Vec3A::new(batch.x[i], batch.y[i], batch.z[i]), batch.w[i]);
        let [p, q, r] = batch.faces[i].map(Corner::local);
        let sum = |axis: usize| (p[axis] + q[axis] + r[axis]) as f32;
        let share = Share::new(n, place(Vec3A::new(sum(0), sum(1), sum(2)), 3.0), w);
        let cell = batch.faces[i][0].cell();
        if COHERENT { self.gatherer.add(cell, &share) } else { self.gatherer.add_now(cell, &share) }
    }

    /// Adds a face's plane to each of its cells, once.
    #[inline(always)]
    fn add_across<const COHERENT: bool>(&mut self, i: usize) {
        let batch = &*self.batch;
        let face = batch.faces[i];
        let (n, w) = (Vec3A::new(batch.x[i], batch.y[i], batch.z[i]), batch.w[i]);
        let [p, q, r] = face.map(|corner| Vec3A::from(corner.local().map(|x| x as f32)));
        let cells @ [a, b, c] = face.map(Corner::cell);
        let mut add = |cell, sum, corners| {
            let share = Share::new(n, place(sum, corners), w);
            if COHERENT { self.gatherer.add(cell, &share) } else { self.gatherer.add_now(cell, &share) }
        };
        if a == b {
            add(a, p + q, 2.0);
            add(c, r, 1.0);
        } else if b == c {
            add(b, q + r, 2.0);
            add(a, p, 1.0);
        } else if c == a {
            add(c, r + p, 2.0);
            add(b, q, 1.0);
        } else {
            add(a, p, 1.0);
            add(b, q, 1.0);
            add(c, r, 1.0);
            self.appender.push(cells);
        }
    }
}

impl Sink for FaceWorker<'_> {
    fn take(&mut self, faces: &[[Corner; 3]]) {
        let (inside, end) = (self.batch.sort_apart(faces), faces.len().min(BATCH));
        if !self.coherent {
            self.table.fetch(self.batch.faces[inside..end].as_flattened().iter().map(|corner| corner.cell()));
        }
        self.batch.edges_inside(inside);
        self.batch.edges_across(inside, end, self.table);
        self.batch.cross(end);
        self.batch.cross_long(self.table);
        self.flat_faces += u64::from(self.batch.normalise(end, self.quanta));
        if let Some(samples) = &mut self.samples {
            let asking = self.batch.sample(end, samples.rate());
            let batch = &*self.batch;
            for &i in &batch.sampled[..asking] {
                let i = usize::from(i);
                samples.add(batch.faces[i], batch.samples[i], Vec3::new(batch.x[i], batch.y[i], batch.z[i]));
            }
        }
        if self.coherent {
            (0..inside).for_each(|i| self.add_inside::<true>(i));
            (inside..end).for_each(|i| self.add_across::<true>(i));
            return;
        }
        for first in (0..end).step_by(AT_ONCE) {
            let last = (first + AT_ONCE).min(end);
            let cells = self.batch.faces[first..last].as_flattened().iter().map(|corner| corner.cell());
            self.gatherer.fetch(cells);
            (first..last.min(inside)).for_each(|i| self.add_inside::<false>(i));
            (first.max(inside)..last).for_each(|i| self.add_across::<false>(i));
        }
    }
}

impl Batch {
    /// Takes faces in, those with all corners in one cell first; returns how many these are. Which is which is as good
    /// as random, so this is done without a branch.
    fn sort_apart(&mut self, faces: &[[Corner; 3]]) -> usize {
        let (mut inside, mut across) = (0, faces.len().min(BATCH));
        for face in faces.iter().take(BATCH) {
            let [a, b, c] = face.map(|corner| corner.0);
            let same = ((a ^ b) | (a ^ c)) >> (3 * LOCAL_BITS) == 0;
            let place = if same { inside } else { across - 1 };
            self.faces[place] = *face;
            inside += usize::from(same);
            across -= usize::from(!same);
        }
        inside
    }

    /// Edges of faces within a cell.
    fn edges_inside(&mut self, inside: usize) {
        let [us, vs] = &mut self.edges;
        for (i, (face, lot)) in self.faces[..inside].iter().zip(&mut self.lots).enumerate() {
            let [p, q, r] = face.map(Corner::local);
            for (k, (u, v)) in us.iter_mut().zip(vs.iter_mut()).enumerate() {
                u[i] = q[k] - p[k];
                v[i] = r[k] - p[k];
            }
            *lot = draw(*face);
        }
        self.longs = 0;
    }

    /// Edges of faces across cells.
    fn edges_across(&mut self, inside: usize, end: usize, table: &CellTable) {
        let [us, vs] = &mut self.edges;
        for i in inside..end {
            let face = self.faces[i];
            let keys = face.map(|corner| table.key(corner.cell()));
            let (at, local) = (keys.map(coordinates), face.map(Corner::local));
            let mut beyond = 0u64;
            for (k, (us, vs)) in us.iter_mut().zip(vs.iter_mut()).enumerate() {
                let place = |corner: usize| (at[corner][k] << LOCAL_BITS) + i64::from(local[corner][k]);
                let (u, v) = (place(1) - place(0), place(2) - place(0));
                beyond |= (u + SHORT) as u64 | (v + SHORT) as u64;
                us[i] = u as i32;
                vs[i] = v as i32;
            }
            self.lots[i] = draw(face);
            // What is at most SHORT either way has no bit above those of its double now.
            let is_long = beyond > 2 * SHORT as u64 + 1 || is_far(keys[0] | keys[1] | keys[2]);
            self.long[self.longs] = i as u16;
            self.longs += usize::from(is_long);
        }
    }

    /// Cross products: exact before they are rounded, so they do not depend on the corner from which the edges start.
    fn cross(&mut self, end: usize) {
        let [u, v] = &self.edges;
        let minor = |to: &mut [f32; BATCH], i: usize, j: usize| {
            let factors = u[i][..end].iter().zip(&v[j]).zip(u[j].iter().zip(&v[i]));
            for (to, ((a, d), (b, c))) in to.iter_mut().zip(factors) {
                *to = a.wrapping_mul(*d).wrapping_sub(b.wrapping_mul(*c)) as f32 * CROSS_SCALE;
            }
        };
        minor(&mut self.x, 1, 2);
        minor(&mut self.y, 2, 0);
        minor(&mut self.z, 0, 1);
    }

    /// The same for long edges.
    fn cross_long(&mut self, table: &CellTable) {
        for &i in &self.long[..self.longs] {
            let i = usize::from(i);
            let keys = self.faces[i].map(|corner| table.key(corner.cell()));
            [self.x[i], self.y[i], self.z[i]] = long_cross(self.faces[i], keys);
        }
    }

    /// How many samples faces ask for: as many as their weight comes to, rounded up or down by what chance has drawn.
    /// Returns how many ask for any.
    fn sample(&mut self, end: usize, rate: f32) -> usize {
        let counts = self.samples[..end].iter_mut().zip(&self.w).zip(&self.lots);
        for ((count, w), lot) in counts {
            *count = (w * rate + (lot >> 8) as f32 * (1.0 / (1 << 24) as f32)) as u32;
        }
        let mut asking = 0;
        for (i, count) in self.samples[..end].iter().enumerate() {
            self.sampled[asking] = i as u16;
            asking += usize::from(*count > 0);
        }
        asking
    }

    /// Cross products to unit normals and weights. A face without area says nothing of a plane, but where it is still
    /// counts a quantum: the mean of a cell with such faces only is defined. Returns how many there are.
    fn normalise(&mut self, end: usize, quanta: f32) -> u32 {
        let mut flat = 0;
        let (x, y, z, w) = (&mut self.x[..end], &mut self.y[..end], &mut self.z[..end], &mut self.w[..end]);
        for (((x, y), z), w) in x.iter_mut().zip(y).zip(z).zip(w) {
            let length = (*x * *x + *y * *y + *z * *z).sqrt();
            // The least length is CROSS_SCALE: a zero vector stays one.
            let inverse = 1.0 / length.max(0.5 * CROSS_SCALE);
            (*x, *y, *z) = (*x * inverse, *y * inverse, *z * inverse);
            *w = (length * quanta).max(1.0);
            flat += u32::from(length == 0.0);
        }
        flat
    }
}

/// The cross product of a face with long edges, made shorter where its square would overflow, as it may with a corner
/// in a far cell: its weight is beyond all bounds anyway.
#[cold]
fn long_cross(face: [Corner; 3], keys: [u64; 3]) -> [f32; 3] {
    let p: [[i64; 3]; 3] = std::array::from_fn(|corner| absolute(face[corner], keys[corner]));
    let edge = |to: usize| -> [i64; 3] { std::array::from_fn(|axis| p[to][axis] - p[0][axis]) };
    let (u, v) = (edge(1), edge(2));
    let cross = glam::Vec3::new(wide(u, v, 1, 2), wide(u, v, 2, 0), wide(u, v, 0, 1)) * CROSS_SCALE;
    let excess = cross.abs().max_element() / (1u64 << 60) as f32;
    if is_far(keys[0] | keys[1] | keys[2]) { (cross / excess.max(1.0)).to_array() } else { cross.to_array() }
}

fn wide(u: [i64; 3], v: [i64; 3], i: usize, j: usize) -> f32 {
    (i128::from(u[i]) * i128::from(v[j]) - i128::from(u[j]) * i128::from(v[i])) as f32
}

/// A place as mean of `corners` in steps from the cell's least corner, as one in cells about its centre.
#[inline(always)]
fn place(sum: Vec3A, corners: f32) -> Vec3A {
    sum * (1.0 / (corners * STEPS as f32)) - 0.5
}
