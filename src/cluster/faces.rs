//! The face pass: every face adds its plane to the cells of its corners, and survives if they are three.

use super::corners::{BATCH, Sink};
use super::grid::{Corner, LOCAL_BITS, STEPS, coordinates};
use super::sums::{Gatherer, Share, Sums};
use super::survivors::{Appender, Survivors};
use super::table::CellTable;
use glam::{DVec3, Vec3A};

/// One worker of the face pass.
pub(super) struct FaceWorker<'a> {
    table: &'a CellTable,
    gatherer: Gatherer<'a>,
    appender: Appender<'a>,
    /// Quanta of weight a step² of doubled area.
    quanta: f32,
}

impl<'a> FaceWorker<'a> {
    /// A worker that adds to `sums` and `survivors`; `quantum` is the unit of weight, in cells².
    pub(super) fn new(table: &'a CellTable, sums: &'a Sums, survivors: &'a Survivors, quantum: f64) -> Self {
        FaceWorker {
            table,
            gatherer: Gatherer::new(sums),
            appender: Appender::new(survivors),
            quanta: (0.5 / (STEPS * STEPS * quantum)) as f32,
        }
    }

    /// Hands over what is still held back.
    pub(super) fn flush(&mut self) {
        self.gatherer.flush();
        self.appender.flush();
    }

    /// A face with all corners in one cell.
    #[inline(always)]
    fn inside(&mut self, [a, b, c]: [Corner; 3]) {
        let (p, q, r) = (a.local(), b.local(), c.local());
        let (n, w) = self.plane(cross(minus(q, p), minus(r, p)));
        let sum = |axis: usize| (p[axis] + q[axis] + r[axis]) as f32;
        self.gatherer.add(a.cell(), &Share::new(n, place(Vec3A::new(sum(0), sum(1), sum(2)), 3.0), w));
    }

    /// A face across cells: its plane goes to each of them once.
    #[inline(always)]
    fn across(&mut self, face: [Corner; 3]) {
        let cells @ [a, b, c] = face.map(Corner::cell);
        let local = face.map(Corner::local);
        let at = cells.map(|cell| coordinates(self.table.key(cell)));
        let edge = |to: usize| -> [i64; 3] {
            std::array::from_fn(|k| ((at[to][k] - at[0][k]) << LOCAL_BITS) + i64::from(local[to][k] - local[0][k]))
        };
        let (u, v) = (edge(1), edge(2));
        let near = u.iter().chain(&v).all(|x| x.unsigned_abs() < 1 << 30);
        let cross = if near { cross(u.map(|x| x as i32), v.map(|x| x as i32)) } else { wide_cross(u, v) };
        let (n, w) = self.plane(cross);
        let [p, q, r] = local.map(|p| Vec3A::new(p[0] as f32, p[1] as f32, p[2] as f32));
        let mut add = |cell, sum, corners| self.gatherer.add(cell, &Share::new(n, place(sum, corners), w));
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

    /// The unit normal and the weight of a face whose edges have this cross product, in steps². A face without area says
    /// nothing of a plane, but where it is still counts a quantum: the mean of a cell with such faces only is defined.
    #[inline(always)]
    fn plane(&self, cross: Cross) -> (Vec3A, f32) {
        match cross {
            Cross::Short(cross) => {
                let length = cross.length();
                let n = if length > 0.0 { cross / length } else { Vec3A::ZERO };
                (n, (length * self.quanta).max(1.0))
            }
            Cross::Long(cross) => {
                let length = cross.length();
                ((cross / length).as_vec3a(), (length * f64::from(self.quanta)).max(1.0) as f32)
            }
        }
    }
}

impl Sink for FaceWorker<'_> {
    fn take(&mut self, faces: &[[Corner; 3]]) {
        // Which faces cross a wall is as good as random: sorted apart first, they cost no mispredicted branch each.
        let mut order = [0u16; BATCH];
        let (mut inside, mut across) = (0, faces.len());
        for (i, [a, b, c]) in faces.iter().enumerate() {
            let same = ((a.0 ^ b.0) | (a.0 ^ c.0)) >> (3 * LOCAL_BITS) == 0;
            let place = if same { inside } else { across - 1 };
            order[place] = i as u16;
            inside += usize::from(same);
            across -= usize::from(!same);
        }
        for i in &order[..inside] {
            self.inside(faces[usize::from(*i)]);
        }
        for i in order[inside..faces.len()].iter().rev() {
            self.across(faces[usize::from(*i)]);
        }
    }
}

/// A place as mean of `corners` in steps from the cell's least corner, as one in cells about its centre.
#[inline(always)]
fn place(sum: Vec3A, corners: f32) -> Vec3A {
    sum * (1.0 / (corners * STEPS as f32)) - 0.5
}

/// A cross product of edges in steps: exact, so it does not depend on the corner that the edges start from, up to one last
/// rounding.
enum Cross {
    Short(Vec3A),
    /// Its square would overflow single precision.
    Long(DVec3),
}

#[inline(always)]
fn minus(a: [i32; 3], b: [i32; 3]) -> [i32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Of edges below 2³⁰.
#[inline(always)]
fn cross(u: [i32; 3], v: [i32; 3]) -> Cross {
    // A difference of two products below 2²³ is exact in single precision: most scans' faces are that small.
    let small = |e: [i32; 3]| e.iter().all(|x| x.unsigned_abs() <= 2896);
    if small(u) && small(v) {
        let real = |e: [i32; 3]| Vec3A::new(e[0] as f32, e[1] as f32, e[2] as f32);
        return Cross::Short(real(u).cross(real(v)));
    }
    let minor = |i: usize, j: usize| (i64::from(u[i]) * i64::from(v[j]) - i64::from(u[j]) * i64::from(v[i])) as f32;
    Cross::Short(Vec3A::new(minor(1, 2), minor(2, 0), minor(0, 1)))
}

#[cold]
fn wide_cross(u: [i64; 3], v: [i64; 3]) -> Cross {
    let minor = |i: usize, j: usize| i128::from(u[i]) * i128::from(v[j]) - i128::from(u[j]) * i128::from(v[i]);
    let minors = [minor(1, 2), minor(2, 0), minor(0, 1)];
    // The choice depends on the product alone, and so does not on the corner either.
    if minors.iter().all(|x| x.unsigned_abs() < 1 << 61) {
        return Cross::Short(Vec3A::from(minors.map(|x| x as f32)));
    }
    Cross::Long(DVec3::from(minors.map(|x| x as f64)))
}
