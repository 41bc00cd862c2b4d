//! A whole scan in memory, scaled into its frame and welded: for scans that fit the budget.
//!
//! Peak memory ([`load_peak_bytes`] computes it): with s = 12 bytes a position in single precision and 24 in double, an
//! indexed scan takes s + 4 bytes a vertex, a hash table of 6 to 12 bytes a vertex (4 bytes a slot, a power of two of
//! slots) and 12 bytes a triangle. A soup's corners are welded while they are read: 12 bytes a triangle, and s bytes and a
//! hash table of 6 to 12 bytes a distinct vertex. Beside that, what streaming takes ([`Crew::stream_bytes`]).
//!
//! One worker consumes the chunks, in the order of the file: decoding is bound by memory, and the result needs no merging.

use super::{Crew, Layout, Scalar, Scan};
use crate::error::{Error, Result};
use crate::mesh::{Coordinate, Extent, Frame, IndexedMesh, hash_position, narrow, weld, widen};
use glam::DVec3;

/// What a loaded scan was before it was welded.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LoadReport {
    /// Vertices at a position that an earlier vertex already had; 0 for a soup, where every vertex is repeated.
    pub duplicate_vertices: u64,
    /// Vertices that no face uses, or only faces that were dropped.
    pub unreferenced_vertices: u64,
    /// Triangles dropped because they repeat a corner, before or after welding.
    pub repeated_corner_faces: u64,
    /// The box of all vertices that a face of the file uses, in the file's units.
    pub extent: Extent,
}

/// An upper bound on what [`load`] holds at its peak, in the type that [`Scan::scalar`] names. A soup is taken to share no
/// vertex.
pub fn load_peak_bytes(scan: &Scan) -> u64 {
    let position = match scan.scalar() {
        Scalar::F32 => 12,
        Scalar::F64 => 24,
    };
    let vertices = scan.vertex_count();
    let renumbering = if scan.layout() == Layout::Indexed { 4 } else { 0 };
    let table = 4u64.saturating_mul((vertices.saturating_mul(3) / 2 + 1).next_power_of_two());
    let vertices = vertices.saturating_mul(position + renumbering).saturating_add(table);
    vertices.saturating_add(scan.triangle_count().saturating_mul(12)).saturating_add(Crew::stream_bytes(1))
}

/// A loaded scan, the frame it is in, and what it was before.
pub type Loaded<S> = (IndexedMesh<S>, Frame, LoadReport);

/// Loads a scan: narrowed to `S`, welded, without faces that repeat a corner and vertices that no face uses, and scaled by
/// the power of two of its frame. `None` for a soup that turns out to have more than `most_vertices` distinct vertices.
pub fn load<S: Coordinate>(scan: &Scan, crew: &Crew<'_>, most_vertices: u64) -> Result<Option<Loaded<S>>> {
    let crew = Crew { workers: 1, ..*crew };
    let loaded = match scan.layout() {
        Layout::Indexed => Some(load_indexed(scan, &crew)?),
        Layout::Soup => load_soup(scan, &crew, most_vertices)?,
    };
    let Some((mesh, frame, report)) = loaded else { return Ok(None) };
    if mesh.faces.is_empty() {
        return Err(Error::input(scan.path(), "has no usable face: none has three distinct corners"));
    }
    Ok(Some((mesh, frame, report)))
}

fn load_indexed<S: Coordinate>(scan: &Scan, crew: &Crew<'_>) -> Result<Loaded<S>> {
    check_countable(scan, scan.vertex_count())?;
    let positions = scan.vertices(
        crew,
        || Vec::<[S; 3]>::with_capacity(scan.vertex_count() as usize),
        |positions, chunk| {
            positions.extend(chunk.positions.iter().map(|p| p.map(S::narrow)));
            Ok(())
        },
    )?;
    let faces = scan.triangles(
        crew,
        || Vec::with_capacity(scan.triangle_count() as usize),
        |faces, chunk| {
            faces.extend_from_slice(chunk.triangles);
            Ok(())
        },
    )?;
    let mut mesh = IndexedMesh { positions: only(positions), faces: only(faces) };
    let referenced = Bits::of_corners(&mesh);
    let extent = extent_of(scan, &mesh, &referenced)?;
    let unreferenced = drop_unreferenced(&mut mesh, &referenced);
    drop(referenced);
    let frame = Frame::of(&extent);
    scale(&mut mesh, frame);
    let welded = weld(&mut mesh);
    let report = LoadReport {
        duplicate_vertices: welded.duplicate_vertices,
        unreferenced_vertices: unreferenced + welded.unreferenced_vertices,
        repeated_corner_faces: welded.repeated_corner_faces,
        extent,
    };
    Ok((mesh, frame, report))
}

fn load_soup<S: Coordinate>(scan: &Scan, crew: &Crew<'_>, most_vertices: u64) -> Result<Option<Loaded<S>>> {
    let welders = scan.soup(
        crew,
        || Welder::<S>::new(scan.triangle_count()),
        |welder, chunk| {
            if welder.mesh.positions.len() + 3 * chunk.triangles.len() >= u32::MAX as usize {
                check_countable(scan, u64::MAX)?;
            }
            // What is beyond the limit is read to its end but not kept: stopping early would take an error.
            if welder.mesh.positions.len() as u64 <= most_vertices {
                chunk.triangles.iter().for_each(|corners| welder.add(corners));
            }
            Ok(())
        },
    )?;
    let welder = welders.into_iter().next().unwrap_or_else(|| Welder::new(0));
    if welder.mesh.positions.len() as u64 > most_vertices {
        return Ok(None);
    }
    let Welder { mut mesh, repeated_corner_faces, extent, .. } = welder;
    let referenced = Bits::of_corners(&mesh);
    let unreferenced_vertices = drop_unreferenced(&mut mesh, &referenced);
    let frame = Frame::of(&extent);
    scale(&mut mesh, frame);
    let report = LoadReport { duplicate_vertices: 0, unreferenced_vertices, repeated_corner_faces, extent };
    Ok(Some((mesh, frame, report)))
}

fn check_countable(scan: &Scan, vertices: u64) -> Result<()> {
    if vertices < u64::from(u32::MAX) {
        return Ok(());
    }
    Err(Error::input(scan.path(), "has more than 4294967294 vertices, too many to hold in memory"))
}

/// The result of the one worker.
fn only<T>(workers: Vec<Vec<T>>) -> Vec<T> {
    workers.into_iter().next().unwrap_or_default()
}

/// The box of the vertices that faces use, which must be finite.
fn extent_of<S: Coordinate>(scan: &Scan, mesh: &IndexedMesh<S>, referenced: &Bits) -> Result<Extent> {
    let mut extent = Extent::default();
    for (v, p) in mesh.positions.iter().enumerate() {
        if !referenced.has(v) {
            continue;
        }
        let p = widen(*p);
        if !p.is_finite() {
            return Err(not_finite(scan, mesh, v as u32, p));
        }
        extent.include(p);
    }
    Ok(extent)
}

#[cold]
fn not_finite<S>(scan: &Scan, mesh: &IndexedMesh<S>, v: u32, p: DVec3) -> Error {
    let mut what = format!("coordinates ({}, {}, {}), expected finite numbers", p.x, p.y, p.z);
    let user = mesh.faces.iter().position(|f| f.contains(&v));
    if let (Some(face), true) = (user, scan.triangle_count() == scan.face_count()) {
        what += &format!(", since face {face} uses them");
    }
    scan.vertex_error(v.into(), what)
}

fn scale<S: Coordinate>(mesh: &mut IndexedMesh<S>, frame: Frame) {
    for p in &mut mesh.positions {
        let q = widen(*p);
        *p = narrow(DVec3::new(frame.to_frame(q.x), frame.to_frame(q.y), frame.to_frame(q.z)));
    }
}

/// Drops the vertices that are not referenced, keeping the order of the others; returns how many.
fn drop_unreferenced<S: Coordinate>(mesh: &mut IndexedMesh<S>, referenced: &Bits) -> u64 {
    let ranks = referenced.ranks();
    let kept = referenced.count();
    let dropped = mesh.positions.len() - kept;
    if dropped > 0 {
        let mut v = 0;
        mesh.positions.retain(|_| {
            v += 1;
            referenced.has(v - 1)
        });
        for corner in mesh.faces.as_flattened_mut() {
            *corner = referenced.rank(&ranks, *corner as usize);
        }
    }
    dropped as u64
}

/// One bit a vertex.
struct Bits(Vec<u64>);

impl Bits {
    fn of_corners<S>(mesh: &IndexedMesh<S>) -> Self {
        let mut bits = vec![0u64; mesh.positions.len().div_ceil(64)];
        for &v in mesh.faces.as_flattened() {
            bits[v as usize / 64] |= 1 << (v % 64);
        }
        Bits(bits)
    }

    fn has(&self, v: usize) -> bool {
        self.0[v / 64] >> (v % 64) & 1 != 0
    }

    fn count(&self) -> usize {
        self.0.iter().map(|word| word.count_ones() as usize).sum()
    }

    /// Bits set before each word.
    fn ranks(&self) -> Vec<u32> {
        let mut before = 0;
        let ranks = self.0.iter().map(|word| {
            let rank = before;
            before += word.count_ones();
            rank
        });
        ranks.collect()
    }

    /// Bits set before bit `v`.
    fn rank(&self, ranks: &[u32], v: usize) -> u32 {
        let below = self.0[v / 64] & !(u64::MAX << (v % 64));
        ranks[v / 64] + below.count_ones()
    }
}

/// Makes an indexed mesh of triangles as they come.
struct Welder<S> {
    mesh: IndexedMesh<S>,
    /// Open addressing; at most two thirds full.
    table: Vec<u32>,
    repeated_corner_faces: u64,
    extent: Extent,
}

const NONE: u32 = u32::MAX;

impl<S: Coordinate> Welder<S> {
    fn new(triangles: u64) -> Self {
        // Room for the most that can come: address space, which costs nothing until it is written to, so that nothing is
        // ever copied to grow.
        let triangles = triangles as usize;
        let mesh = IndexedMesh { positions: Vec::with_capacity(3 * triangles), faces: Vec::with_capacity(triangles) };
        Welder { mesh, table: vec![NONE; 1 << 10], repeated_corner_faces: 0, extent: Extent::default() }
    }

    fn add(&mut self, corners: &[[f64; 3]; 3]) {
        let face = corners.map(|p| {
            let p = p.map(S::narrow);
            self.extent.include(widen(p));
            self.vertex(p)
        });
        if face[0] == face[1] || face[1] == face[2] || face[2] == face[0] {
            self.repeated_corner_faces += 1;
        } else {
            self.mesh.faces.push(face);
        }
    }

    fn vertex(&mut self, p: [S; 3]) -> u32 {
        let mask = self.table.len() - 1;
        let mut slot = hash_position(&p) as usize & mask;
        loop {
            match self.table[slot] {
                NONE => break,
                v if self.mesh.positions[v as usize] == p => return v,
                _ => slot = (slot + 1) & mask,
            }
        }
        let v = self.mesh.positions.len() as u32;
        self.table[slot] = v;
        self.mesh.positions.push(p);
        if self.mesh.positions.len() * 3 / 2 >= self.table.len() {
            self.grow();
        }
        v
    }

    /// Doubles the table; the old one goes first, since it can be made again from the positions.
    #[cold]
    fn grow(&mut self) {
        let slots = 2 * self.table.len();
        self.table = Vec::new();
        self.table.resize(slots, NONE);
        for (v, p) in self.mesh.positions.iter().enumerate() {
            let mut slot = hash_position(p) as usize & (slots - 1);
            while self.table[slot] != NONE {
                slot = (slot + 1) & (slots - 1);
            }
            self.table[slot] = v as u32;
        }
    }
}
