//! The face pass: every face adds its plane to the cells of its corners, and survives if they are three.
//!
//! Faces come in batches, those within a cell apart from those across cells, and go through in stages, each a short loop
//! over the batch: how far cells are apart, edges, shares in cells, cross products, normals, samples (all of these without
//! a branch), sums. One face at a time would wait for its own square root and division. Places are quantised, so that
//! edges and sums of corners are worked out for all three axes in one word. Loops are as wide as the processor's vectors.

use super::corners::{BATCH, Faces, Sink};
use super::grid::{COORDINATE_BITS, Corner, FIELD_BITS, LOCAL_BITS, STEPS, absolute, is_far};
use super::sampling::{SampleWorker, scramble, seed};
use super::shares::{ONE_CORNER, Plane, Shares, TOGETHER};
use super::sums::{Gatherer, Sums};
use super::survivors::{Appender, Survivors};
use super::table::CellTable;
use fearless_simd::{Level, Simd, dispatch, f32x4, f32x16, i32x16, prelude::*, u32x16};

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
    /// How many cells the second and the third corner are further than the first, as keys, plus [`NEAR`] along each axis.
    apart: [[u64; BATCH]; 2],
    /// The edges from the first corner to the others, in steps, plus [`MIDDLE`]; of [`Batch::long`] ones anything.
    edges: [[[u16; BATCH]; 3]; 2],
    /// The corners' places in their cells, as fields, each plus [`ONE_CORNER`].
    places: [[u64; BATCH]; 3],
    /// What chance draws of a face, yet to be scrambled; then how many samples it asks for.
    lots: [u32; BATCH],
    /// Faces that ask for samples.
    asking: [u16; BATCH],
    /// Faces with an edge too long for 16 bits, and how many these are.
    long: [u16; BATCH],
    longs: usize,
    /// Cross products of the two edges.
    crosses: [[f32; BATCH]; 3],
    /// Unit normals, and weights in quanta.
    planes: [Plane; BATCH],
    /// Weights again, one after the other; and rounded, as far as 32 bits go.
    weights: [f32; BATCH],
    weights_rounded: [i32; BATCH],
    /// What each face adds to each of its cells.
    shares: Shares<MOST_SHARES>,
}

/// Shares of a batch, and room behind them.
const MOST_SHARES: usize = 3 * BATCH + TOGETHER;

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
        sums: &'a Sums<'a>,
        survivors: &'a Survivors,
        samples: Option<SampleWorker<'a>>,
        quantum: f64,
        coherent: bool,
    ) -> Self {
        let batch = Batch {
            apart: [[0; BATCH]; 2],
            edges: [[[0; BATCH]; 3]; 2],
            places: [[0; BATCH]; 3],
            lots: [0; BATCH],
            asking: [0; BATCH],
            long: [0; BATCH],
            longs: 0,
            crosses: [[0.0; BATCH]; 3],
            planes: [Plane::default(); BATCH],
            weights: [0.0; BATCH],
            weights_rounded: [0; BATCH],
            shares: Shares::new(),
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
    fn take(&mut self, faces: Faces, inside: usize) {
        let end = faces[0].len().min(BATCH);
        let faces = faces.map(|corners| &corners[..end]);
        if !self.coherent {
            faces.iter().for_each(|corners| self.table.fetch(corners[inside..].iter().map(|corner| corner.cell())));
        }
        dispatch!(Level::new(), simd => self.work(simd, faces, inside.min(end)));
    }
}

impl FaceWorker<'_> {
    #[inline(always)]
    fn work<V: Simd>(&mut self, simd: V, faces: Faces, inside: usize) {
        let end = faces[0].len();
        self.batch.apart(faces, inside, self.table);
        self.batch.edges(faces);
        self.batch.shares_inside(faces, inside);
        self.batch.shares_across(faces, inside, &mut self.appender);
        self.batch.cross(end);
        self.batch.cross_long(faces, self.table);
        self.flat_faces += u64::from(self.batch.normalise(simd, end, self.quanta));
        if let Some(samples) = &mut self.samples {
            self.batch.sample(simd, faces, samples);
        }
        let Batch { planes, weights_rounded, shares, .. } = &*self.batch;
        if self.coherent {
            self.gatherer.add(simd, (planes, weights_rounded), shares);
        } else {
            self.gatherer.add_apart(simd, (planes, weights_rounded), shares);
        }
    }
}

impl Batch {
    /// How far the cells of faces are apart; those within one, which are the first `inside`, are not.
    #[inline(always)]
    fn apart(&mut self, faces: Faces, inside: usize, table: &CellTable) {
        for apart in &mut self.apart {
            apart[..inside].fill(NEAR * EACH_COORDINATE);
        }
        let mut longs = 0;
        for i in inside..faces[0].len().min(BATCH) {
            let keys = faces.map(|corners| table.key(corners[i].cell()));
            // How many cells further a corner is than the first, plus NEAR: of a corner that is not near, or that
            // leads a coordinate to borrow, a bit above the lowest three is set, or is so one further on.
            let further = |key: u64| key.wrapping_add(NEAR * EACH_COORDINATE).wrapping_sub(keys[0]);
            let (to_q, to_r) = (further(keys[1]), further(keys[2]));
            let beyond = |to: u64| (to | to.wrapping_add(EACH_COORDINATE)) & !(7 * EACH_COORDINATE);
            let is_long = beyond(to_q) | beyond(to_r) != 0 || is_far(keys[0] | keys[1] | keys[2]);
            self.long[longs % BATCH] = i as u16;
            longs += usize::from(is_long);
            (self.apart[0][i], self.apart[1][i]) = (to_q, to_r);
        }
        self.longs = longs;
    }

    /// Corners' places, edges, and what chance draws.
    #[inline(always)]
    fn edges(&mut self, [a, b, c]: Faces) {
        const FROM: u64 = (MIDDLE as u64 - (NEAR << LOCAL_BITS)) * EACH_FIELD;
        let Batch { edges: [[ux, uy, uz], [vx, vy, vz]], apart: [to_q, to_r], places: [ps, qs, rs], lots, .. } = self;
        let end = a.len().min(BATCH);
        let (b, c) = (&b[..end], &c[..end]);
        for i in 0..end {
            let (p, q, r) = (a[i].fields(), b[i].fields(), c[i].fields());
            let cells = |to: u64| {
                let along = |axis: u32| (to >> (axis * COORDINATE_BITS) & 7) << (axis * FIELD_BITS + LOCAL_BITS);
                (along(0) | along(1) | along(2)) + FROM
            };
            let u = (q + cells(to_q[i])).wrapping_sub(p);
            let v = (r + cells(to_r[i])).wrapping_sub(p);
            (ux[i], uy[i], uz[i]) = (u as u16, (u >> FIELD_BITS) as u16, (u >> (2 * FIELD_BITS)) as u16);
            (vx[i], vy[i], vz[i]) = (v as u16, (v >> FIELD_BITS) as u16, (v >> (2 * FIELD_BITS)) as u16);
            (ps[i], qs[i], rs[i]) = (p + ONE_CORNER, q + ONE_CORNER, r + ONE_CORNER);
            lots[i] = seed([a[i], b[i], c[i]]);
        }
    }

    /// Shares of the faces within a cell.
    #[inline(always)]
    fn shares_inside(&mut self, [a, ..]: Faces, inside: usize) {
        let Batch { shares, places: [p, q, r], .. } = self;
        for i in 0..inside.min(BATCH) {
            shares.cells[i] = a[i].cell();
            shares.places[i] = p[i] + q[i] + r[i];
            shares.planes[i] = i as u16;
        }
        shares.count = inside;
    }

    /// Shares of faces across cells: one in each of a face's cells, without a branch. Those with three survive.
    #[inline(always)]
    fn shares_across(&mut self, faces: Faces, inside: usize, survivors: &mut Appender) {
        let Batch { shares, places: [ps, qs, rs], .. } = self;
        for i in inside..faces[0].len().min(BATCH) {
            let cells @ [a, b, c] = faces.map(|corners| corners[i].cell());
            let (p, q, r) = (ps[i], qs[i], rs[i]);
            let (ab, bc, ca) = (a == b, b == c, c == a);
            let only_if = |is_so: bool, place: u64| place & u64::from(is_so).wrapping_neg();
            shares.put_if(true, a, p + only_if(ab, q) + only_if(ca, r), i);
            shares.put_if(!ab, b, q + only_if(bc, r), i);
            shares.put_if(!(bc | ca), c, r, i);
            survivors.push_if(!(ab | bc | ca), cells);
        }
    }

    /// Cross products: exact before they are rounded, so they do not depend on the corner from which the edges start.
    #[inline(always)]
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
    fn cross_long(&mut self, faces: Faces, table: &CellTable) {
        for &i in &self.long[..self.longs] {
            let i = usize::from(i);
            let face = faces.map(|corners| corners[i]);
            let cross = long_cross(face, face.map(|corner| table.key(corner.cell())));
            self.crosses.iter_mut().zip(cross).for_each(|(along, x)| along[i] = x);
        }
    }

    /// Has samples taken of the faces that ask for any: as many as a face's weight comes to, rounded up or down by what
    /// chance has drawn.
    #[inline(always)]
    fn sample<V: Simd>(&mut self, simd: V, faces: Faces, samples: &mut SampleWorker) {
        let end = faces[0].len();
        let of = |x: f32| f32x16::splat(simd, x);
        let rate = of(samples.rate());
        for lot in &mut self.lots[..end] {
            *lot = scramble(*lot) >> 8;
        }
        let mut asking = 0;
        for first in (0..end).step_by(WIDTH) {
            let some = first..first + WIDTH;
            let lots = u32x16::from_slice(simd, &self.lots[some.clone()]).bitcast::<i32x16<V>>();
            let chance = lots.to_float::<f32x16<V>>() * of(1.0 / (1 << 24) as f32);
            let wanted = f32x16::from_slice(simd, &self.weights[some.clone()]) * rate + chance;
            let counts = wanted.min(of(MOST_ROUNDED)).to_int::<i32x16<V>>();
            counts.bitcast::<u32x16<V>>().store_slice(&mut self.lots[some]);
            let mut those = counts.simd_gt(i32x16::splat(simd, 0)).to_bitmask() & there(first, end);
            while those != 0 {
                self.asking[asking % BATCH] = (first + those.trailing_zeros() as usize) as u16;
                asking += 1;
                those &= those - 1;
            }
        }
        samples.take(simd, faces, &self.asking[..asking], (&self.lots, &self.planes));
    }

    /// Cross products to unit normals and weights. A face without area says nothing of a plane, but where it is still
    /// counts a quantum: the mean of a cell with such faces only is defined. Returns how many there are.
    #[inline(always)]
    fn normalise<V: Simd>(&mut self, simd: V, end: usize, quanta: f32) -> u32 {
        let mut flat = 0;
        let of = |x: f32| f32x16::splat(simd, x);
        for first in (0..end).step_by(WIDTH) {
            let some = first..first + WIDTH;
            let along = |axis: usize| f32x16::from_slice(simd, &self.crosses[axis][some.clone()]);
            let (x, y, z) = (along(0), along(1), along(2));
            let length = (x * x + y * y + z * z).sqrt();
            // The least length is CROSS_SCALE: a zero vector stays one.
            let inverse = of(1.0) / length.max(of(0.5 * CROSS_SCALE));
            let weight = (length * of(quanta)).max(of(1.0));
            store_planes([x * inverse, y * inverse, z * inverse, weight], &mut self.planes[some.clone()]);
            weight.store_slice(&mut self.weights[some.clone()]);
            let rounded = weight.min(of(MOST_ROUNDED)).round_ties_even();
            rounded.to_int::<i32x16<V>>().store_slice(&mut self.weights_rounded[some]);
            flat += (length.simd_eq(of(0.0)).to_bitmask() & there(first, end)).count_ones();
        }
        flat
    }
}

/// Faces that are worked on together, of a batch.
const WIDTH: usize = 16;
const _: () = assert!(BATCH.is_multiple_of(WIDTH));

/// The largest single that an integer of 32 bits holds; as a weight, more than fits a line.
const MOST_ROUNDED: f32 = ((1u32 << 31) - (1 << 7)) as f32;

/// Which of the faces from `first` on are before `end`.
#[inline(always)]
fn there(first: usize, end: usize) -> u64 {
    0xffff >> (first + WIDTH).saturating_sub(end)
}

/// Numbers of planes that are side by side, each plane's together.
#[inline(always)]
fn store_planes<V: Simd>([x, y, z, w]: [f32x16<V>; 4], planes: &mut [Plane]) {
    let ((xl, xh), (yl, yh), (zl, zh), (wl, wh)) = (x.split(), y.split(), z.split(), w.split());
    let (low, high) = bytemuck::cast_slice_mut(planes).split_at_mut(2 * WIDTH);
    for (planes, [x, y, z, w]) in [(low, [xl, yl, zl, wl]), (high, [xh, yh, zh, wh])] {
        let ((xl, xh), (yl, yh), (zl, zh), (wl, wh)) = (x.split(), y.split(), z.split(), w.split());
        let (low, high) = planes.split_at_mut(WIDTH);
        f32x4::store_four_interleaved([xl, yl, zl, wl], low);
        f32x4::store_four_interleaved([xh, yh, zh, wh], high);
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
