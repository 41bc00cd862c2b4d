//! A whole scan in memory, scaled into its frame and welded: for scans that fit the budget.
//!
//! Peak memory ([`load_peak_bytes`] computes it): with s = 12 bytes a position in single precision and 24 in double, an
//! indexed scan takes s + 4 bytes a vertex, a hash table of 6 to 12 bytes a vertex (4 bytes a slot, a power of two of
//! slots) and 12 bytes a triangle. A soup's corners are welded while they are read: 12 bytes a triangle, and s bytes and a
//! hash table of 6 to 12 bytes a distinct vertex. Beside that, what streaming takes ([`Crew::stream_bytes`]).
//!
//! One worker consumes the chunks, in the order of the file: decoding is bound by memory, and the result needs no merging.

use super::{Crew, Layout, Scalar, Scan};
use crate::cores::InPieces;
use crate::error::{Error, Result};
use crate::mesh::{BATCH, Coordinate, Extent, Frame, IndexedMesh, PositionTable, narrow, weld, widen};
use glam::DVec3;
use rayon::prelude::*;

/// What a loaded scan was before it was welded.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LoadReport {
    /// Vertices at a position that an earlier vertex already had; 0 for a soup, where every vertex is repeated.
    pub duplicate_vertices: u64,
    /// Vertices that no face uses, or only faces that were dropped.
    pub unreferenced_vertices: u64,
    /// Triangles dropped because they repeat a corner, before or after welding.
    pub repeated_corner_faces: u64,
    /// Triangles without area whose corners differ: they lie on a line.
    pub flat_faces: u64,
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
        || Vec::<[S; 3]>::with_capacity(room(scan, scan.vertex_count())),
        |positions, chunk| {
            positions.extend(chunk.positions.iter().map(|p| p.map(S::narrow)));
            Ok(())
        },
    )?;
    let faces = scan.triangles(
        crew,
        || Vec::with_capacity(room(scan, scan.triangle_count())),
        |faces, chunk| {
            faces.extend_from_slice(chunk.triangles);
            Ok(())
        },
    )?;
    let check = || crew.progress.check();
    let mut mesh = IndexedMesh { positions: only(positions), faces: only(faces) };
    let referenced = Bits::of_corners(&mesh);
    check()?;
    let extent = extent_of(scan, &mesh, &referenced)?;
    check()?;
    let unreferenced = drop_unreferenced(&mut mesh, &referenced);
    drop(referenced);
    check()?;
    let frame = Frame::around::<S>(&extent);
    scale(&mut mesh, frame);
    let welded = weld(&mut mesh, check)?;
    check()?;
    let report = LoadReport {
        duplicate_vertices: welded.duplicate_vertices,
        unreferenced_vertices: unreferenced + welded.unreferenced_vertices,
        repeated_corner_faces: welded.repeated_corner_faces,
        flat_faces: flat_faces(&mesh),
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
                welder.add(chunk.triangles);
            }
            Ok(())
        },
    )?;
    let welder = welders.into_iter().next().unwrap_or_else(|| Welder::new(0));
    if welder.mesh.positions.len() as u64 > most_vertices {
        return Ok(None);
    }
    let Welder { mut mesh, repeated_corner_faces, extent, .. } = welder;
    extent.check(scan.path())?;
    crew.progress.check()?;
    let referenced = Bits::of_corners(&mesh);
    let unreferenced_vertices = drop_unreferenced(&mut mesh, &referenced);
    let frame = Frame::around::<S>(&extent);
    crew.progress.check()?;
    scale(&mut mesh, frame);
    let flat_faces = flat_faces(&mesh);
    let report = LoadReport { duplicate_vertices: 0, unreferenced_vertices, repeated_corner_faces, flat_faces, extent };
    Ok(Some((mesh, frame, report)))
}

/// Room for so many elements, or for as many as the file has bytes: a scene that shows one object many times may have
/// more, and is then grown into.
fn room(scan: &Scan, elements: u64) -> usize {
    elements.min(scan.bytes()) as usize
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
    let used = || mesh.positions.par_iter().enumerate().in_pieces(4096).filter(|(v, _)| referenced.has(*v));
    if let Some((v, p)) = used().find_first(|(_, p)| !widen(**p).is_finite()) {
        return Err(not_finite(scan, mesh, v as u32, widen(*p)));
    }
    let include = |mut extent: Extent, (_, p): (usize, &[S; 3])| {
        extent.include(widen(*p));
        extent
    };
    let extent = used().fold(Extent::default, include).reduce(Extent::default, Extent::union);
    extent.check(scan.path())?;
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

fn flat_faces<S: Coordinate>(mesh: &IndexedMesh<S>) -> u64 {
    let is_flat = |face: &&[u32; 3]| {
        let [a, b, c] = face.map(|v| widen(mesh.positions[v as usize]));
        (b - a).cross(c - a) == DVec3::ZERO
    };
    mesh.faces.par_iter().in_pieces(4096).filter(is_flat).count() as u64
}

fn scale<S: Coordinate>(mesh: &mut IndexedMesh<S>, frame: Frame) {
    mesh.positions.par_iter_mut().in_pieces(4096).for_each(|p| *p = narrow(frame.place(widen(*p))));
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
        let renumber = |face: &mut [u32; 3]| *face = face.map(|v| referenced.rank(&ranks, v as usize));
        mesh.faces.par_iter_mut().in_pieces(4096).for_each(renumber);
    }
    dropped as u64
}

/// One bit a vertex.
struct Bits(Vec<u64>);

impl Bits {
    fn of_corners<S>(mesh: &IndexedMesh<S>) -> Self {
        let words = mesh.positions.len().div_ceil(64);
        let of = |faces: &[[u32; 3]]| {
            let mut bits = vec![0u64; words];
            for &v in faces.as_flattened() {
                bits[v as usize / 64] |= 1 << (v % 64);
            }
            bits
        };
        let both = |mut bits: Vec<u64>, others: Vec<u64>| {
            bits.iter_mut().zip(others).for_each(|(word, other)| *word |= other);
            bits
        };
        // A part of the faces a thread, as long as its bits are less work than they.
        let part = (mesh.faces.len() / rayon::current_num_threads()).max(words).max(1);
        Bits(mesh.faces.par_chunks(part).map(of).reduce(|| vec![0; words], both))
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
    table: PositionTable,
    repeated_corner_faces: u64,
    extent: Extent,
}

impl<S: Coordinate> Welder<S> {
    fn new(triangles: u64) -> Self {
        // Room for the most that can come: address space, which costs nothing until it is written to, so that nothing is
        // ever copied to grow.
        let triangles = triangles as usize;
        let mesh = IndexedMesh { positions: Vec::with_capacity(3 * triangles), faces: Vec::with_capacity(triangles) };
        let table = PositionTable::with_room_for(1 << 10);
        Welder { mesh, table, repeated_corner_faces: 0, extent: Extent::default() }
    }

    fn add(&mut self, triangles: &[[[f64; 3]; 3]]) {
        for triangles in triangles.chunks(BATCH / 3) {
            let mut batch = [[S::narrow(0.0); 3]; BATCH];
            let batch = &mut batch[..3 * triangles.len()];
            for (narrowed, p) in batch.iter_mut().zip(triangles.as_flattened()) {
                *narrowed = p.map(S::narrow);
                self.extent.include(widen(*narrowed));
            }
            self.add_batch(batch);
        }
    }

    fn add_batch(&mut self, batch: &[[S; 3]]) {
        let positions = &mut self.mesh.positions;
        if !self.table.has_room_for(positions.len() + batch.len()) {
            self.table.grow(positions);
        }
        let looked_up = self.table.look_up(batch, positions);
        for (corners, looked_up) in batch.as_chunks::<3>().0.iter().zip(looked_up.as_chunks::<3>().0) {
            let mut face = [0; 3];
            for ((v, p), at) in face.iter_mut().zip(corners).zip(looked_up) {
                let new = positions.len() as u32;
                *v = self.table.find_or_insert(p, *at, positions, new);
                if *v == new {
                    positions.push(*p);
                }
            }
            if face[0] == face[1] || face[1] == face[2] || face[2] == face[0] {
                self.repeated_corner_faces += 1;
            } else {
                self.mesh.faces.push(face);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Progress;

    fn load_text<S: Coordinate>(name: &str, text: &str) -> Result<(IndexedMesh<S>, Frame, LoadReport)> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        let progress = Progress::default();
        let crew = Crew { workers: 3, progress: &progress };
        Ok(load(&Scan::open(&path, &progress)?, &crew, u64::MAX)?.unwrap())
    }

    fn ply(scalar: &str, vertices: &[&str], faces: &[&str]) -> String {
        format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty {scalar} x\nproperty {scalar} y\nproperty {scalar} z\n\
             element face {}\nproperty list uchar int vertex_indices\nend_header\n{}\n{}\n",
            vertices.len(),
            faces.len(),
            vertices.join("\n"),
            faces.join("\n")
        )
    }

    #[test]
    fn what_no_face_needs_is_dropped_and_counted() {
        let vertices = ["nan 0 0", "0 0 0", "4 0 0", "inf 0 0", "0 4 0", "4 0 0", "0 0 7", "9 9 9", "inf 0 0"];
        let text = ply("float", &vertices, &["3 1 2 4", "3 6 5 2", "3 4 4 5", "4 1 5 4 6"]);
        let (mesh, frame, report) = load_text::<f32>("scan.ply", &text).unwrap();
        assert_eq!(mesh.positions, [[0.0; 3], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.875]]);
        assert_eq!(mesh.faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]]);
        assert_eq!(frame.to_file(0.875), 7.0);
        let extent = Extent { min: DVec3::ZERO, max: DVec3::new(4.0, 4.0, 7.0) };
        assert_eq!(
            report,
            LoadReport {
                duplicate_vertices: 1,
                unreferenced_vertices: 4,
                repeated_corner_faces: 2,
                flat_faces: 0,
                extent
            }
        );
    }

    #[test]
    fn a_non_finite_coordinate_that_a_face_uses_is_refused() {
        let text = ply("float", &["0 0 0", "1 0 0", "0 nan 0", "1 1 1"], &["3 0 1 3", "3 3 2 1"]);
        let error = load_text::<f32>("scan.ply", &text).unwrap_err().to_string();
        assert!(
            error.ends_with("vertex 2: coordinates (0, NaN, 0), expected finite numbers, since face 1 uses them"),
            "{error}"
        );
    }

    #[test]
    fn a_scan_without_a_whole_face_is_refused() {
        let text = ply("float", &["0 0 0", "1 0 0", "0 0 -0"], &["3 0 1 2", "3 1 1 0"]);
        let error = load_text::<f32>("scan.ply", &text).unwrap_err().to_string();
        assert!(error.ends_with("has no usable face: none has three distinct corners"), "{error}");
        let facet = "facet normal 0 0 0 outer loop vertex 0 0 0 vertex 1 0 0 vertex -0 0 0 endloop endfacet\n";
        let error = load_text::<f32>("scan.stl", &format!("solid\n{facet}endsolid")).unwrap_err().to_string();
        assert!(error.ends_with("has no usable face: none has three distinct corners"), "{error}");
    }

    #[test]
    fn doubles_keep_their_bits_and_the_smallest_floats_scale_exactly() {
        let far = ["500000.1 5400000.3 0.7", "500000.2 5400000.3 0.7", "500000.2 5400000.4 0.7"];
        let (mesh, frame, _) = load_text::<f64>("scan.ply", &ply("double", &far, &["3 0 1 2"])).unwrap();
        let back = mesh.positions.iter().map(|p| frame.place_back(widen(*p)).to_array()).collect::<Vec<_>>();
        assert_eq!(back[1], [500000.2, 5400000.3, 0.7]);

        let tiny = ["0 0 0", "1e-44 0 0", "0 3e-45 0"];
        let (mesh, frame, _) = load_text::<f32>("scan.ply", &ply("float", &tiny, &["3 0 1 2"])).unwrap();
        assert!(mesh.positions[1][0] >= 0.5 && mesh.positions[1][0] < 1.0);
        assert_eq!(frame.to_file(mesh.positions[2][1].into()) as f32, 3e-45);
    }

    #[test]
    fn a_soup_is_welded_like_the_indexed_scan_it_was() {
        // A strip long enough that the table grows several times.
        let n = 20_000u32;
        let position = |v: u32| [(v / 2) as f32 * 0.25, (v % 2) as f32, (v % 5) as f32];
        let mut stl = vec![0; 80];
        stl.extend(n.to_le_bytes());
        for v in 0..n {
            stl.extend([0; 12]);
            let corners = [v, v + 1, v + 2].map(position);
            corners.as_flattened().iter().for_each(|x| stl.extend(x.to_le_bytes()));
            stl.extend([0; 2]);
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("strip.stl");
        std::fs::write(&path, stl).unwrap();
        let progress = Progress::default();
        let scan = Scan::open(&path, &progress).unwrap();
        let (mesh, frame, report) =
            load::<f32>(&scan, &Crew { workers: 2, progress: &progress }, 20_002).unwrap().unwrap();
        let scaled = |v| position(v).map(|x| frame.to_frame(x.into()) as f32);
        assert_eq!(mesh.positions, (0..n + 2).map(scaled).collect::<Vec<_>>());
        assert_eq!(mesh.faces, (0..n).map(|v| [v, v + 1, v + 2]).collect::<Vec<_>>());
        assert_eq!((report.duplicate_vertices, report.unreferenced_vertices, report.repeated_corner_faces), (0, 0, 0));
        let crew = Crew { workers: 2, progress: &progress };
        assert!(load::<f32>(&scan, &crew, 20_001).unwrap().is_none());
    }
}
