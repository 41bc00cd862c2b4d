//! What the scan's vertices carry, carried over to the result: colours, normals, and every other number.
//!
//! Each vertex of the scan names a value at the place of the result that it is nearest to. The result's vertices get
//! the values whose interpolation over its faces comes closest to all of those, in the sense of least squares: closer
//! than any value that a vertex could pick up where it is, and whatever the collapse and the refit did to positions. A
//! little smoothing settles what no vertex of the scan lies on. Colours and all else stay within what the scan has;
//! integers are rounded, normals made unit.
//!
//! The scan is streamed, at most [`SAMPLES`] of its vertices for each of the result's, so this works for a scan of any
//! size and on the result of clustering too. [`shades`] gives the collapse the colours and normals of a scan that fits
//! the budget, to steer by, [`mean_shades`] those of a clustered one; every other number is carried as well as the mesh
//! that shape asks for can show it. What corners and faces carry is in `coat`, and in `votes` where it has no borders
//! to hold.
//!
//! **Memory** ([`bytes`]): beside the result, its tree, 36 bytes a face and 8 a vertex and column in hand; columns are
//! taken [`BATCH`] at a time. Sums are of integers, so threads change nothing.

mod coat;
mod solve;
mod steer;
mod votes;

pub use coat::{Worn, bytes as coat_bytes, put_on};
pub use steer::{Steer, mean_shades, range_length, shades};
pub use votes::{least_position_bytes, vote, votes_bytes};

use crate::error::Result;
use crate::mesh::columns::{Column, Columns, Meaning};
use crate::mesh::{BATCH as BATCH_OF_PLACES, Coordinate, Frame, IndexedMesh, PositionTable, Tree, narrow, widen};
use crate::progress::Stage;
use crate::read::{Crew, Scan};
use glam::DVec3;
use solve::System;

/// Vertices of the scan for each of the result's, at most about: more hardly change a value.
pub const SAMPLES: u64 = 40;

/// Columns that are solved for after one pass over the scan.
pub const BATCH: usize = 4;

/// Bytes beside the result while so many columns are carried.
pub const fn bytes(faces: u64, vertices: u64, columns: u64) -> u64 {
    let batch = if columns < BATCH as u64 { columns } else { BATCH as u64 };
    Tree::<f32>::build_bytes(faces) + 24 * faces + vertices * (8 + 8 * batch + 8 * columns)
}

/// The scan's columns of these numbers, for every vertex of `mesh`.
pub fn carry<S: Coordinate>(
    scan: &Scan,
    wanted: &[usize],
    mesh: &IndexedMesh<S>,
    frame: Frame,
    crew: &Crew<'_>,
) -> Result<Columns> {
    let columns: Vec<Column> = wanted.iter().map(|c| scan.columns()[*c].clone()).collect();
    let mut carried = Columns { values: vec![0.0; mesh.positions.len() * columns.len()], columns };
    crew.progress.begin(Stage::Carry, 2 * scan.bytes() * wanted.len().div_ceil(BATCH) as u64);
    let pick = Pick { stride: scan.vertex_count().div_ceil(SAMPLES * (mesh.positions.len() as u64).max(1)).max(1) };
    for (batch, wanted) in wanted.chunks(BATCH).enumerate() {
        let ranges = ranges(scan, wanted, crew)?;
        let system = gather(scan, wanted, &ranges, mesh, frame, pick, crew)?;
        for (i, range) in ranges.iter().enumerate() {
            crew.progress.check()?;
            let column = batch * BATCH + i;
            let solved = system.solve(i);
            let n = carried.columns.len();
            for (vertex, x) in solved.into_iter().enumerate() {
                let value = range.value(x);
                let is_integer = carried.columns[column].number.is_integer();
                carried.values[vertex * n + column] = if is_integer { value.round() } else { value };
            }
        }
    }
    make_unit(&mut carried);
    Ok(carried)
}

/// Where the vertices of a loaded scan are, by their positions.
struct Places<'m, S> {
    mesh: &'m IndexedMesh<S>,
    frame: Frame,
    table: PositionTable,
}

impl<'m, S: Coordinate> Places<'m, S> {
    fn of(mesh: &'m IndexedMesh<S>, frame: Frame) -> Self {
        let mut table = PositionTable::with_room_for(mesh.positions.len());
        for (batch, positions) in mesh.positions.chunks(BATCH_OF_PLACES).enumerate() {
            let looked_up = table.look_up(positions, &mesh.positions);
            for (i, (p, at)) in positions.iter().zip(looked_up).enumerate() {
                table.find_or_insert(p, at, &mesh.positions, (batch * BATCH_OF_PLACES + i) as u32);
            }
        }
        Places { mesh, frame, table }
    }

    /// The vertex at a position of the file, if there is one.
    fn find(&self, p: [f64; 3]) -> Option<u32> {
        let p = narrow::<S>(self.frame.place(widen(p.map(S::narrow))));
        let at = self.table.look_up(std::slice::from_ref(&p), &self.mesh.positions)[0];
        self.table.find(&p, at, &self.mesh.positions)
    }
}

/// Which vertices of the scan are asked: a share that no regularity of the scan can fall into step with.
#[derive(Clone, Copy)]
struct Pick {
    stride: u64,
}

impl Pick {
    #[inline]
    fn takes(self, vertex: u64) -> bool {
        let mixed = (vertex ^ (vertex >> 15)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        self.stride == 1 || (mixed >> 32).is_multiple_of(self.stride)
    }
}

/// The least and the largest value of a column.
#[derive(Debug, Clone, Copy)]
struct Range {
    least: f64,
    most: f64,
}

impl Range {
    const NONE: Range = Range { least: f64::INFINITY, most: f64::NEG_INFINITY };

    fn include(&mut self, x: f64) {
        if x.is_finite() {
            self.least = self.least.min(x);
            self.most = self.most.max(x);
        }
    }

    /// From the range to `0..=1`.
    #[inline]
    fn share(&self, x: f64) -> f64 {
        // Half of it first: the difference of the largest doubles is none.
        let size = 0.5 * self.most - 0.5 * self.least;
        if size > 0.0 { (0.5 * x - 0.5 * self.least) / size } else { 0.0 }
    }

    /// The value of a share, which may be less than none or more than all.
    fn unclamped(&self, share: f64) -> f64 {
        if self.least > self.most { 0.0 } else { self.least * (1.0 - share) + self.most * share }
    }

    fn value(&self, share: f64) -> f64 {
        if self.least > self.most {
            return 0.0;
        }
        let share = share.clamp(0.0, 1.0);
        (self.least * (1.0 - share) + self.most * share).clamp(self.least, self.most)
    }
}

fn ranges(scan: &Scan, wanted: &[usize], crew: &Crew<'_>) -> Result<Vec<Range>> {
    let found = scan.carried(
        crew,
        || [Range::NONE; BATCH],
        |mine, chunk| {
            for values in chunk.values.chunks_exact(chunk.columns) {
                wanted.iter().zip(mine.iter_mut()).for_each(|(c, range)| range.include(values[*c]));
            }
            Ok(())
        },
    )?;
    let both = |a: Range, b: Range| Range { least: a.least.min(b.least), most: a.most.max(b.most) };
    let all = (0..wanted.len()).map(|i| found.iter().map(|mine| mine[i]).fold(Range::NONE, both));
    Ok(all.collect())
}

/// Sums up what the scan's vertices ask of the result's.
fn gather<'m, S: Coordinate>(
    scan: &Scan,
    wanted: &[usize],
    ranges: &[Range],
    mesh: &'m IndexedMesh<S>,
    frame: Frame,
    pick: Pick,
    crew: &Crew<'_>,
) -> Result<System<'m>> {
    let tree = Tree::build(mesh);
    let sums = solve::Sums::of(mesh.faces.len(), mesh.positions.len(), wanted.len());
    scan.carried(
        crew,
        || 0,
        |near, chunk| {
            let mut shares = [0.0; BATCH];
            let vertices = chunk.positions.iter().zip(chunk.values.chunks_exact(chunk.columns));
            for (vertex, (p, values)) in (chunk.first..).zip(vertices) {
                let p = frame.place(DVec3::from_array(*p));
                let is_whole = p.is_finite() && wanted.iter().all(|c| values[*c].is_finite());
                if !pick.takes(vertex) || !is_whole {
                    continue;
                }
                let place = tree.nearest(p, *near);
                *near = place.face;
                let face = mesh.faces[place.face as usize];
                let weights = weights(place.point, face.map(|v| mesh.at(v)));
                for ((share, c), range) in shares.iter_mut().zip(wanted).zip(ranges) {
                    *share = range.share(values[*c]);
                }
                sums.add(place.face as usize, face, weights, &shares[..wanted.len()]);
            }
            Ok(())
        },
    )?;
    drop(tree);
    Ok(sums.into_system(&mesh.faces, solve::SMOOTHING))
}

/// Barycentric coordinates of a point of a triangle; where it has no area, those of the nearest corner.
fn weights(p: DVec3, [a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let normal = (b - a).cross(c - a);
    let square = normal.length_squared();
    let of_b = (p - a).cross(c - a).dot(normal) / square;
    let of_c = (b - a).cross(p - a).dot(normal) / square;
    if of_b.is_finite() && of_c.is_finite() && square > 0.0 {
        let (of_b, of_c) = (of_b.clamp(0.0, 1.0), of_c.clamp(0.0, 1.0));
        let sum = (of_b + of_c).max(1.0);
        return [(1.0 - of_b - of_c).max(0.0), of_b / sum, of_c / sum];
    }
    let nearest = [a, b, c].map(|q| (p - q).length_squared());
    let i = if nearest[0] <= nearest[1].min(nearest[2]) { 0 } else { 1 + usize::from(nearest[2] < nearest[1]) };
    std::array::from_fn(|corner| if corner == i { 1.0 } else { 0.0 })
}

/// Normals are directions: averages of them are too short.
fn make_unit(carried: &mut Columns) {
    let Some(at) = carried.find::<3>(Meaning::Normal) else { return };
    if at.iter().any(|c| carried.columns[*c].number.is_integer()) {
        return;
    }
    let n = carried.columns.len();
    for values in carried.values.chunks_exact_mut(n) {
        let normal = DVec3::from_array(at.map(|c| values[c]));
        let unit = normal.try_normalize().unwrap_or(DVec3::Z);
        at.iter().zip(unit.to_array()).for_each(|(c, x)| values[*c] = x);
    }
}

#[cfg(test)]
mod tests;
