//! The face pass: every face adds its plane to the cells of its corners, and survives if they are three.
//!
//! Faces come in batches, those within a cell apart from those across cells, and go through in stages, each a short loop
//! over the batch: edges, shares in cells, cross products, normals, samples (all of these without a branch), sums. One
//! face at a time would wait for its own square root and division. Places are quantised, so that edges and sums of
//! corners are worked out for all three axes in one word.

use super::corners::{BATCH, Sink};
use super::grid::{COORDINATE_BITS, Corner, FIELD_BITS, LOCAL_BITS, STEPS, absolute, is_far};
use super::sampling::{SampleWorker, scramble, seed};
use super::sums::{Gatherer, Plane, Share, Sums};
use super::survivors::{Appender, Survivors};
use super::table::CellTable;
use wide::f32x4;

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
    /// The edges from the first corner to the others, in steps, plus [`MIDDLE`]; of [`Batch::long`] ones anything.
    edges: [[[u16; BATCH]; 3]; 2],
    /// What chance draws of a face, yet to be scrambled.
    lots: [u32; BATCH],
    /// Faces with an edge too long for 16 bits, and how many these are.
    long: [u16; BATCH],
    longs: usize,
    /// Faces that ask for samples, and how many of them each.
    sampled: [u16; BATCH],
    samples: [u32; BATCH],
    /// Cross products of the two edges.
    crosses: [[f32; BATCH]; 3],
    /// Unit normals, and weights in quanta.
    planes: [Plane; BATCH],
    /// Weights again, one after the other.
    weights: [f32; BATCH],
    /// What each face adds to each of its cells, and how many of these there are.
    shares: [Share; 3 * BATCH],
    count: usize,
}

/// What stands for an edge of no extent along an axis: where both its ends are at most [`NEAR`] cells apart along each,
/// an edge is in `1..1 << 16` then.
const MIDDLE: u16 = 1 << 15;
const NEAR: u64 = 3;

/// One in each field of three packed places in a cell.
const EACH_FIELD: u64 = 1 | 1 << FIELD_BITS | 1 << (2 * FIELD_BITS);
/// One in each coordinate of a key.
const EACH_COORDINATE: u64 = 1 | 1 << COORDINATE_BITS | 1 << (2 * COORDINATE_BITS);

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
        let batch = Batch {
            edges: [[[0; BATCH]; 3]; 2],
            lots: [0; BATCH],
            long: [0; BATCH],
            longs: 0,
            sampled: [0; BATCH],
            samples: [0; BATCH],
            crosses: [[0.0; BATCH]; 3],
            planes: [Plane::default(); BATCH],
            weights: [0.0; BATCH],
            shares: [Share::default(); 3 * BATCH],
            count: 0,
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
}

impl Sink for FaceWorker<'_> {
    fn take(&mut self, faces: &[[Corner; 3]], inside: usize) {
        let end = faces.len().min(BATCH);
        let (faces, inside) = (&faces[..end], inside.min(end));
        if !self.coherent {
            self.table.fetch(faces[inside..].as_flattened().iter().map(|corner| corner.cell()));
        }
        self.batch.start_inside(&faces[..inside]);
        self.batch.edges_across(faces, inside, self.table);
        self.batch.shares_across(faces, inside, &mut self.appender);
        self.batch.cross(end);
        self.batch.cross_long(faces, self.table);
        self.flat_faces += u64::from(self.batch.normalise(end, self.quanta));
        if let Some(samples) = &mut self.samples {
            let asking = self.batch.sample(end, samples.rate());
            let batch = &*self.batch;
            for &i in &batch.sampled[..asking] {
                let i = usize::from(i);
                samples.add(faces[i], batch.samples[i], batch.planes[i].normal());
            }
        }
        let (planes, shares) = (&self.batch.planes, &self.batch.shares[..self.batch.count]);
        if self.coherent {
            self.gatherer.add(planes, shares);
        } else {
            self.gatherer.add_now(planes, shares);
        }
    }
}

impl Batch {
    /// Edges and shares of faces within a cell.
    fn start_inside(&mut self, faces: &[[Corner; 3]]) {
        const FROM: u64 = MIDDLE as u64 * EACH_FIELD;
        let faces = &faces[..faces.len().min(BATCH)];
        for (i, face) in faces.iter().enumerate() {
            let [p, q, r] = face.map(Corner::fields);
            self.put_edges(i, q + FROM - p, r + FROM - p);
            self.lots[i] = seed(*face);
            self.shares[i] = Share::new(face[0].cell(), i, p + q + r, 3);
        }
        self.count = faces.len();
    }

    /// Edges of faces across cells, which are those from `inside` on.
    fn edges_across(&mut self, faces: &[[Corner; 3]], inside: usize, table: &CellTable) {
        const FROM: u64 = (MIDDLE as u64 - (NEAR << LOCAL_BITS)) * EACH_FIELD;
        let mut longs = 0;
        for (i, face) in (inside..BATCH).zip(&faces[inside..]) {
            let keys = face.map(|corner| table.key(corner.cell()));
            // How many cells further a corner is than the first, plus NEAR: of a corner that is not near, or that
            // leads a coordinate to borrow, a bit above the lowest three is set, or is so one further on.
            let further = |key: u64| key.wrapping_add(NEAR * EACH_COORDINATE).wrapping_sub(keys[0]);
            let (to_q, to_r) = (further(keys[1]), further(keys[2]));
            let beyond = |to: u64| (to | to.wrapping_add(EACH_COORDINATE)) & !(7 * EACH_COORDINATE);
            let is_long = beyond(to_q) | beyond(to_r) != 0 || is_far(keys[0] | keys[1] | keys[2]);
            self.long[longs % BATCH] = i as u16;
            longs += usize::from(is_long);

            let [p, q, r] = face.map(Corner::fields);
            let cells = |to: u64| {
                let along = |axis: u32| (to >> (axis * COORDINATE_BITS) & 7) << (axis * FIELD_BITS + LOCAL_BITS);
                (along(0) | along(1) | along(2)) + FROM
            };
            self.put_edges(i, (q + cells(to_q)).wrapping_sub(p), (r + cells(to_r)).wrapping_sub(p));
            self.lots[i] = seed(*face);
        }
        self.longs = longs;
    }

    /// Shares of faces across cells: one in each of a face's cells, without a branch. Those with three survive.
    fn shares_across(&mut self, faces: &[[Corner; 3]], inside: usize, survivors: &mut Appender) {
        let mut count = self.count;
        for (i, face) in (inside..BATCH).zip(&faces[inside..]) {
            let cells @ [a, b, c] = face.map(Corner::cell);
            let [p, q, r] = face.map(Corner::fields);
            let (ab, bc, ca) = (a == b, b == c, c == a);
            let only_if = |is_so: bool, fields: u64| fields & u64::from(is_so).wrapping_neg();
            let mut add = |is_new: bool, cell: u32, sum: u64, places: u16| {
                self.shares[count] = Share::new(cell, i, sum, places);
                count += usize::from(is_new);
            };
            add(true, a, p + only_if(ab, q) + only_if(ca, r), 1 + u16::from(ab) + u16::from(ca));
            add(!ab, b, q + only_if(bc, r), 1 + u16::from(bc));
            add(!(bc | ca), c, r, 1);
            if !(ab | bc | ca) {
                survivors.push(cells);
            }
        }
        self.count = count;
    }

    #[inline(always)]
    fn put_edges(&mut self, i: usize, u: u64, v: u64) {
        let [us, vs] = &mut self.edges;
        for (axis, (us, vs)) in (0..).zip(us.iter_mut().zip(vs)) {
            us[i] = (u >> (axis * FIELD_BITS)) as u16;
            vs[i] = (v >> (axis * FIELD_BITS)) as u16;
        }
    }

    /// Cross products: exact before they are rounded, so they do not depend on the corner from which the edges start.
    fn cross(&mut self, end: usize) {
        let [u, v] = &self.edges;
        let minor = |to: &mut [f32; BATCH], i: usize, j: usize| {
            let factors = u[i][..end].iter().zip(&v[j]).zip(u[j].iter().zip(&v[i]));
            for (to, ((a, d), (b, c))) in to.iter_mut().zip(factors) {
                let steps = |edge: &u16| i32::from(edge.wrapping_sub(MIDDLE) as i16);
                *to = (steps(a) * steps(d)).wrapping_sub(steps(b) * steps(c)) as f32 * CROSS_SCALE;
            }
        };
        let [x, y, z] = &mut self.crosses;
        minor(x, 1, 2);
        minor(y, 2, 0);
        minor(z, 0, 1);
    }

    /// The same for long edges.
    fn cross_long(&mut self, faces: &[[Corner; 3]], table: &CellTable) {
        for &i in &self.long[..self.longs] {
            let i = usize::from(i);
            let keys = faces[i].map(|corner| table.key(corner.cell()));
            let cross = long_cross(faces[i], keys);
            self.crosses.iter_mut().zip(cross).for_each(|(along, x)| along[i] = x);
        }
    }

    /// How many samples faces ask for: as many as their weight comes to, rounded up or down by what chance has drawn.
    /// Returns how many ask for any.
    fn sample(&mut self, end: usize, rate: f32) -> usize {
        let counts = self.samples[..end].iter_mut().zip(&self.weights).zip(&self.lots);
        for ((count, w), lot) in counts {
            *count = (w * rate + (scramble(*lot) >> 8) as f32 * (1.0 / (1 << 24) as f32)) as u32;
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
        let [x, y, z] = self.crosses.each_ref().map(|along| along.as_chunks::<4>().0);
        let planes = self.planes.as_chunks_mut::<4>().0.iter_mut().zip(self.weights.as_chunks_mut::<4>().0);
        for (first, ((planes, weights), ((x, y), z))) in (0..end).step_by(4).zip(planes.zip(x.iter().zip(y).zip(z))) {
            let (x, y, z) = (f32x4::from(*x), f32x4::from(*y), f32x4::from(*z));
            let length = (x * x + y * y + z * z).sqrt();
            // The least length is CROSS_SCALE: a zero vector stays one.
            let inverse = f32x4::ONE / length.fast_max(f32x4::splat(0.5 * CROSS_SCALE));
            let weight = (length * f32x4::splat(quanta)).fast_max(f32x4::ONE);
            for (plane, of) in planes.iter_mut().zip(f32x4::transpose([x * inverse, y * inverse, z * inverse, weight]))
            {
                *plane = Plane(of.to_array());
            }
            *weights = weight.to_array();
            let there = 0xf >> (first + 4).saturating_sub(end);
            flat += (length.simd_eq(f32x4::ZERO).to_bitmask() & there).count_ones();
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
