//! What faces carry where it has no borders that could be held: colours that differ from face to face, measured numbers,
//! and labels of a scan that does not fit the budget.
//!
//! Every face of the scan votes with its area for its numbers, at the face of the result that its middle is nearest to
//! and that does not look the other way. Whole numbers are elected: the one that most of the area has, if any has most
//! of it. Where elections have no winners, over the whole surface, colours are averaged instead, as fractions are
//! anyway. A face that nobody votes for takes what a neighbour has.
//!
//! Numbers wait on scratch while faces are brought their corners; at most [`VOTES`] faces of the scan for each of the
//! result's are asked. One worker, so that the order of votes is the file's.
//!
//! **Memory** ([`votes_bytes`]): a tree over the result, and 16 bytes a face for each number and one more.

use super::Pick;
use crate::error::Result;
use crate::facets::{self, Facet, NUMBER_BITS, Sink, Stream, Stride};
use crate::mesh::adjacency::{Stars, parts};
use crate::mesh::columns::{Column, Columns, Meaning};
use crate::mesh::{Coordinate, Frame, IndexedMesh, Tree};
use crate::progress::Stage;
use crate::read::{Crew, Layout, MOST_COLUMNS, Scalar, Scan};
use crate::scratch::{Scratch, ScratchFile};
use glam::DVec3;
use std::collections::VecDeque;

/// Faces of the scan for each of the result's, at most about.
const VOTES: u64 = 40;

/// Elections have winners where, over the whole surface, the leads of the leaders come to this share of all votes: what a
/// bare majority that is elected everywhere would lead by is none, one that is unopposed all.
const LEAD: f64 = 0.5;

/// Bytes that are written and read at a time.
const PIECE_BYTES: usize = 1 << 16;
const PAGE_BYTES: usize = 1 << 12;

/// Bytes beside the result of so many faces, positions of the scan that are kept in memory not counted.
pub const fn votes_bytes(faces: u64, columns: u64) -> u64 {
    Tree::<f32>::build_bytes(faces) + faces * 16 * (columns + 1) + PIECE_BYTES as u64
}

/// The fewest bytes for the positions of a scan while its faces vote; `None` if it has too many faces to tell them apart.
pub fn least_position_bytes(scan: &Scan) -> Option<u64> {
    let position = if scan.scalar() == Scalar::F64 { 24 } else { 12 };
    let bytes = match scan.layout() {
        Layout::Soup => 0,
        Layout::Indexed => facets::least_bytes(scan.vertex_count(), position),
    };
    (scan.triangle_count() < 1 << NUMBER_BITS).then_some(bytes)
}

/// The scan's face columns of these numbers, for every face of `mesh`. Positions may take so many bytes of memory.
pub fn vote<S: Coordinate>(
    scan: &Scan,
    wanted: &[usize],
    mesh: &IndexedMesh<S>,
    frame: Frame,
    crew: &Crew<'_>,
    (scratch, position_bytes): (&Scratch, u64),
) -> Result<Columns> {
    let all = scan.face_columns();
    let columns: Vec<Column> = wanted.iter().map(|c| all[*c].clone()).collect();
    crew.progress.begin(Stage::Carry, 3 * scan.bytes());
    let numbers = Numbers::spill(scan, wanted, &columns, crew, scratch)?;
    let crew = Crew { workers: 1, ..*crew };
    let stride = Stride::new(scan.vertex_count(), 1);
    let stream = Stream::<S>::open(scan, &crew, scratch, frame, stride, position_bytes)?;
    let tree = Tree::build(mesh);
    let (faces, n) = (mesh.faces.len(), columns.len());
    let pick = Pick { stride: scan.triangle_count().div_ceil(VOTES * (faces as u64).max(1)).max(1) };
    let poll = || Poll {
        tree: &tree,
        pick,
        numbers: &numbers,
        page: Vec::new(),
        page_at: 0,
        near: 0,
        failed: Ok(()),
        means: vec![0.0; faces * (n + 1)],
        leaders: vec![0.0; faces * (n + 1)],
    };
    let polls = stream.faces(&crew, false, poll)?;
    let mut values = Vec::with_capacity(faces * n);
    for poll in polls {
        poll.failed?;
        crew.progress.check()?;
        elect(&columns, &poll.means, &poll.leaders, &mut values);
        spread(mesh, n, &poll.means, &mut values);
    }
    Ok(Columns { columns, values })
}

/// Numbers of all triangles, on scratch.
struct Numbers<'a> {
    file: ScratchFile,
    columns: &'a [Column],
    record: usize,
}

impl<'a> Numbers<'a> {
    fn spill(
        scan: &Scan,
        wanted: &[usize],
        columns: &'a [Column],
        crew: &Crew<'_>,
        scratch: &Scratch,
    ) -> Result<Numbers<'a>> {
        let file = scratch.file()?;
        let record = columns.iter().map(|c| c.number.bytes()).sum();
        let (mut bytes, mut at, mut written) = (Vec::with_capacity(PIECE_BYTES), 0, Ok(()));
        scan.face_values(crew.progress, &mut |triangles, values| {
            for _ in 0..triangles {
                columns.iter().zip(wanted).for_each(|(column, c)| column.number.put(values[*c], &mut bytes));
                if bytes.len() >= PIECE_BYTES - 128 && written.is_ok() {
                    written = file.write_all_at(&bytes, at);
                    at += bytes.len() as u64;
                    bytes.clear();
                }
            }
        })?;
        written?;
        file.write_all_at(&bytes, at)?;
        Ok(Numbers { file, columns, record })
    }
}

/// Takes the votes of faces.
struct Poll<'a, S> {
    tree: &'a Tree<'a, S>,
    pick: Pick,
    numbers: &'a Numbers<'a>,
    page: Vec<u8>,
    page_at: u64,
    near: u32,
    failed: Result<()>,
    /// Of each face sums of area times number, and of areas.
    means: Vec<f64>,
    /// Of each face the numbers that lead (J. S. Moore's majority vote, by area), and by how much.
    leaders: Vec<f64>,
}

impl<S: Coordinate> Poll<'_, S> {
    /// Reads what a triangle carries.
    fn read(&mut self, triangle: u64, values: &mut [f64]) -> Result<()> {
        let record = self.numbers.record as u64;
        let in_page = (PAGE_BYTES as u64 / record).max(1);
        let at = triangle / in_page * in_page * record;
        if self.page.is_empty() || self.page_at != at {
            let bytes = (in_page * record).min(self.numbers.file.length().saturating_sub(at));
            self.page.resize(bytes as usize, 0);
            self.page_at = at;
            self.numbers.file.read_exact_at(&mut self.page, at)?;
        }
        let mut bytes = &self.page[(triangle * record - at) as usize..];
        for (value, column) in values.iter_mut().zip(self.numbers.columns) {
            *value = column.number.get(bytes);
            bytes = &bytes[column.number.bytes()..];
        }
        Ok(())
    }

    fn cast(&mut self, facet: &Facet) -> Result<()> {
        let triangle = u64::from(facet.number());
        let [a, b, c] = facet.corners;
        let normal = (b - a).cross(c - a);
        let area = 0.5 * normal.length();
        if !(self.pick.takes(triangle) && area > 0.0 && area.is_finite()) {
            return Ok(());
        }
        (self.near, _) = self.tree.search((a + b + c) / 3.0, self.near);
        let mesh = self.tree.mesh();
        let [p, q, r]: [DVec3; 3] = mesh.faces[self.near as usize].map(|v| mesh.at(v));
        if (q - p).cross(r - p).dot(normal) < 0.0 {
            return Ok(());
        }
        let n = self.numbers.columns.len();
        let mut values = [0.0; MOST_COLUMNS];
        let values = &mut values[..n];
        self.read(triangle, values)?;
        if values.iter().any(|x| !x.is_finite()) {
            return Ok(());
        }
        let at = self.near as usize * (n + 1);
        let (sums, leader) = (&mut self.means[at..][..n + 1], &mut self.leaders[at..][..n + 1]);
        sums.iter_mut().zip(&*values).for_each(|(sum, x)| *sum += area * x);
        sums[n] += area;
        if leader[..n] == *values {
            leader[n] += area;
        } else if leader[n] >= area {
            leader[n] -= area;
        } else {
            leader[n] = area - leader[n];
            leader[..n].copy_from_slice(values);
        }
        Ok(())
    }
}

impl<S: Coordinate> Sink for Poll<'_, S> {
    fn take(&mut self, faces: &[Facet]) {
        for facet in faces {
            if self.failed.is_ok() {
                self.failed = self.cast(facet);
            }
        }
    }
}

/// What each face gets that has votes.
fn elect(columns: &[Column], means: &[f64], leaders: &[f64], values: &mut Vec<f64>) {
    let n = columns.len();
    let total = |of: &[f64]| of.chunks_exact(n + 1).map(|face| face[n]).sum::<f64>();
    let is_elected = total(leaders) >= LEAD * total(means);
    for (sums, leader) in means.chunks_exact(n + 1).zip(leaders.chunks_exact(n + 1)) {
        values.extend(columns.iter().enumerate().map(|(c, column)| {
            let mean = if sums[n] > 0.0 { sums[c] / sums[n] } else { 0.0 };
            match (column.number.is_integer(), column.meaning) {
                (true, Meaning::Colour(_)) if !is_elected => mean.round(),
                (true, _) => leader[c],
                (false, _) => mean,
            }
        }));
    }
}

/// Gives faces without votes what one next to them has.
fn spread<S>(mesh: &IndexedMesh<S>, n: usize, means: &[f64], values: &mut [f64]) {
    let mut known: Vec<bool> = means.chunks_exact(n + 1).map(|sums| sums[n] > 0.0).collect();
    if known.iter().all(|known| *known) {
        return;
    }
    let mut stars = Stars::default();
    stars.rebuild(&mesh.faces, mesh.positions.len());
    let mut open: VecDeque<u32> = (0..known.len() as u32).filter(|f| known[*f as usize]).collect();
    while let Some(f) = open.pop_front() {
        for v in mesh.faces[f as usize] {
            for &corner in stars.of(v) {
                let (other, _) = parts(corner);
                if !std::mem::replace(&mut known[other], true) {
                    values.copy_within(f as usize * n..(f as usize + 1) * n, other * n);
                    open.push_back(other as u32);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::columns::Number;

    fn columns() -> Vec<Column> {
        let column = |name: &str, number| Column { name: name.into(), number, meaning: Meaning::of(name) };
        vec![column("red", Number::U8), column("label", Number::I32), column("quality", Number::F32)]
    }

    #[test]
    fn majorities_are_elected_and_colours_without_one_averaged() {
        // Two faces, of area 4 and 2; the sums of what was voted for, and who leads by how much.
        let means = [4.0 * 100.0, 0.0, 4.0 * 0.5, 4.0, 2.0 * 51.0, 0.0, 2.0 * 0.25, 2.0];
        let (clear, unclear) = ([90.0, 7.0, 9.0, 3.0, 50.0, 8.0, 9.0, 1.0], [90.0, 7.0, 9.0, 1.0, 50.0, 8.0, 9.0, 1.0]);
        let mut values = Vec::new();
        elect(&columns(), &means, &clear, &mut values);
        assert_eq!(values, [90.0, 7.0, 0.5, 50.0, 8.0, 0.25]);
        values.clear();
        elect(&columns(), &means, &unclear, &mut values);
        assert_eq!(values, [100.0, 7.0, 0.5, 51.0, 8.0, 0.25]);
    }

    #[test]
    fn faces_without_votes_take_what_is_next_to_them() {
        let faces = vec![[0, 1, 2], [2, 1, 3], [2, 3, 4], [5, 6, 7]];
        let mesh = IndexedMesh { positions: vec![[0.0f32; 3]; 8], faces };
        let mut values = vec![0.0, 5.0, 0.0, 1.0];
        spread(&mesh, 1, &[0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0, 0.0], &mut values);
        assert_eq!(values, [5.0, 5.0, 5.0, 1.0]);
    }
}
