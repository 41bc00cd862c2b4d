//! The face pass: every face adds its plane to the cells of its corners, and survives if they are three.

use super::corners::Sink;
use super::grid::{Corner, LOCAL_BITS, STEPS, coordinates};
use super::sums::{Gatherer, Share, Sums};
use super::survivors::{Appender, Survivors};
use super::table::CellTable;
use glam::DVec3;

/// One worker of the face pass.
pub(super) struct FaceWorker<'a> {
    table: &'a CellTable,
    gatherer: Gatherer<'a>,
    appender: Appender<'a>,
    /// Quanta of weight a step² of doubled area.
    quanta: f64,
}

impl<'a> FaceWorker<'a> {
    /// A worker that adds to `sums` and `survivors`; `quantum` is the unit of weight, in cells².
    pub(super) fn new(table: &'a CellTable, sums: &'a Sums, survivors: &'a Survivors, quantum: f64) -> Self {
        FaceWorker {
            table,
            gatherer: Gatherer::new(sums),
            appender: Appender::new(survivors),
            quanta: 0.5 / (STEPS * STEPS * quantum),
        }
    }

    /// Hands over what is still held back.
    pub(super) fn flush(&mut self) {
        self.gatherer.flush();
        self.appender.flush();
    }

    /// A face with all corners in one cell.
    #[inline(always)]
    fn inside(&mut self, cell: u32, p: [[i32; 3]; 3]) {
        let edge = |to: [i32; 3]| DVec3::new(f(to[0] - p[0][0]), f(to[1] - p[0][1]), f(to[2] - p[0][2]));
        let (n, w) = self.plane(edge(p[1]).cross(edge(p[2])));
        let sum = |axis: usize| f(p[0][axis] + p[1][axis] + p[2][axis]);
        self.gatherer.add(cell, &Share::new(n, place(DVec3::new(sum(0), sum(1), sum(2)) * (1.0 / 3.0)), w));
    }

    /// A face across cells: its plane goes to each of them once.
    #[inline(always)]
    fn across(&mut self, face: [Corner; 3]) {
        let cells = face.map(Corner::cell);
        let p = face.map(Corner::local);
        let at = cells.map(|cell| coordinates(self.table.key(cell)));
        let edge = |to: usize| -> [i64; 3] {
            std::array::from_fn(|k| ((at[to][k] - at[0][k]) << LOCAL_BITS) + i64::from(p[to][k] - p[0][k]))
        };
        let (n, w) = self.plane(cross(edge(1), edge(2)));
        let here = p.map(|p| DVec3::new(f(p[0]), f(p[1]), f(p[2])));
        let [a, b, c] = cells;
        let mut add = |cell, p| self.gatherer.add(cell, &Share::new(n, place(p), w));
        if a == b {
            add(a, (here[0] + here[1]) * 0.5);
            add(c, here[2]);
        } else if b == c {
            add(b, (here[1] + here[2]) * 0.5);
            add(a, here[0]);
        } else if c == a {
            add(c, (here[2] + here[0]) * 0.5);
            add(b, here[1]);
        } else {
            add(a, here[0]);
            add(b, here[1]);
            add(c, here[2]);
            self.appender.push(cells);
        }
    }

    /// The unit normal and the weight of a face whose edges have this cross product, in steps². A face without area says
    /// nothing of a plane, but where it is still counts a quantum: the mean of a cell with such faces only is defined.
    #[inline(always)]
    fn plane(&self, cross: DVec3) -> (DVec3, f64) {
        let length = cross.length();
        let n = if length > 0.0 { cross / length } else { DVec3::ZERO };
        (n, (length * self.quanta).max(1.0))
    }
}

impl Sink for FaceWorker<'_> {
    fn take(&mut self, faces: &[[Corner; 3]]) {
        for face in faces {
            let [a, b, c] = face.map(Corner::cell);
            if a == b && b == c {
                self.inside(a, face.map(Corner::local));
            } else {
                self.across(*face);
            }
        }
    }
}

#[inline(always)]
fn f(x: i32) -> f64 {
    f64::from(x)
}

/// A place in steps from the cell's least corner as one in cells about its centre.
#[inline(always)]
fn place(steps: DVec3) -> DVec3 {
    steps * (1.0 / STEPS) - 0.5
}

/// The cross product, independent of which corner the edges start from: exact where doubles could round.
#[inline(always)]
fn cross(u: [i64; 3], v: [i64; 3]) -> DVec3 {
    let long = |e: [i64; 3]| e.iter().any(|x| x.unsigned_abs() >= 1 << 26);
    if long(u) || long(v) {
        return wide_cross(u, v);
    }
    let real = |e: [i64; 3]| DVec3::new(e[0] as f64, e[1] as f64, e[2] as f64);
    real(u).cross(real(v))
}

#[cold]
fn wide_cross(u: [i64; 3], v: [i64; 3]) -> DVec3 {
    let minor = |i: usize, j: usize| (i128::from(u[i]) * i128::from(v[j]) - i128::from(u[j]) * i128::from(v[i])) as f64;
    DVec3::new(minor(1, 2), minor(2, 0), minor(0, 1))
}
