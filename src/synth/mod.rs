//! Realistic scans of any size, out of nothing: for a first run, for tests and for benches.
//!
//! A bust of about 0.6 m, in millimetres, with folds, curls, weather and the grain of a scanner (a tenth of an edge along
//! the normal), swept level by level as a scanner on a turntable would. One closed surface, every edge of two faces;
//! vertices are numbered along the sweep.
//!
//! Promises: the same bytes for the same count and seed on every machine, at any thread count; memory of a few mebibytes
//! whatever the size (every vertex is a formula of its number, so nothing is kept). Counts are exact: a closed surface of
//! triangles has an even number of them, so an odd count gets one less.

mod figure;
mod noise;
mod rings;

use crate::error::{Error, Result};
use crate::mesh::mix;
use crate::progress::{Progress, Stage};
use crate::write::{Format, Header, Sink, Target, ply_face, ply_vertex, stl_facet};
use figure::Figure;
use glam::{DVec3, Vec3};
use noise::signed_unit;
use rayon::prelude::*;
use rings::{Ring, Rings};
use std::io::Write;
use std::path::Path;

/// The fewest faces that still make the figure.
pub const MIN_FACES: u64 = 100;

/// Vertices or triangles that a thread makes at a time.
const PIECE: u64 = 8192;
/// Pieces that are made before they are written, in order.
const WINDOW: usize = 16;
/// The scanner's grain: the largest, as a share of an edge.
const GRAIN: f64 = 0.1;

/// What [`synth`] wrote.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SynthReport {
    /// Triangles: as many as asked, or one less where the ask was odd.
    pub faces: u64,
    /// Vertices: half the faces and two. An STL repeats each about six times.
    pub vertices: u64,
    /// Size of the file.
    pub bytes: u64,
}

/// Writes a scan of `faces` triangles, PLY or STL by the extension of `out`.
pub fn synth(out: &Path, faces: u64, seed: u64, progress: &Progress) -> Result<SynthReport> {
    if faces < MIN_FACES {
        return Err(Error::usage(format!("--faces {faces}: a scan is made of {MIN_FACES} faces or more")));
    }
    let faces = faces & !1;
    let vertices = faces / 2 + 2;
    let format = Format::of(out)?;
    if !matches!(format, Format::Ply | Format::Stl) {
        return Err(Error::usage(format!("{}: a scan is made as .ply or .stl", out.display())));
    }
    let header = Header { format, double: false, vertices, faces };
    let head = header.bytes(out)?;
    let target = Target::prepare(out, None)?;
    progress.begin(Stage::Write, header.element_bytes());

    let scan = Scan::new(faces, seed);
    debug_assert_eq!(scan.rings.vertices(), vertices);
    let bytes = target.write_by(progress, |sink| {
        sink.put(&head)?;
        match header.format {
            Format::Ply => {
                scan.in_order(scan.vertex_pieces(), sink, Scan::ply_vertices)?;
                scan.in_order(scan.face_pieces(), sink, Scan::ply_faces)
            }
            _ => scan.in_order(scan.face_pieces(), sink, Scan::stl_facets),
        }
    })?;
    Ok(SynthReport { faces, vertices, bytes })
}

/// A part of a ring's vertices, or of the triangles between it and the next.
#[derive(Debug, Clone, Copy)]
struct Piece {
    ring: usize,
    from: u64,
    to: u64,
}

struct Scan {
    figure: Figure,
    rings: Rings,
    grain: u64,
}

impl Scan {
    fn new(faces: u64, seed: u64) -> Scan {
        let figure = Figure::new(seed);
        let rings = Rings::new(&figure, faces);
        Scan { figure, rings, grain: mix(!seed) }
    }

    fn vertex_pieces(&self) -> impl Iterator<Item = Piece> {
        (0..self.rings.len()).flat_map(|ring| pieces(ring, self.rings.count(ring)))
    }

    fn face_pieces(&self) -> impl Iterator<Item = Piece> {
        (0..self.rings.len() - 1).flat_map(|ring| pieces(ring, self.rings.strip(ring).len()))
    }

    /// Has all threads make pieces, a window at a time, and writes them in order.
    fn in_order<W: Write>(
        &self,
        pieces: impl Iterator<Item = Piece>,
        sink: &mut Sink<'_, W>,
        make: impl Fn(&Scan, Piece, &mut Vec<u8>) + Sync,
    ) -> Result<()> {
        let mut pieces = pieces.peekable();
        let mut batches: Vec<(Vec<Piece>, Vec<u8>)> = vec![Default::default(); WINDOW];
        while pieces.peek().is_some() {
            for (batch, bytes) in &mut batches {
                batch.clear();
                bytes.clear();
                let mut size = 0;
                while size < PIECE / 2
                    && let Some(piece) = pieces.next()
                {
                    size += piece.to - piece.from;
                    batch.push(piece);
                }
            }
            batches.par_iter_mut().for_each(|(batch, bytes)| batch.iter().for_each(|&p| make(self, p, bytes)));
            batches.iter().try_for_each(|(_, bytes)| sink.put(bytes))?;
        }
        Ok(())
    }

    /// Vertex `j` of a ring: a formula of the ring and the number alone, so that whoever asks gets the same bits.
    #[inline]
    fn vertex(&self, ring: &Ring, first: u64, j: u64) -> [f32; 3] {
        let footing = ring.footing(&self.figure, j);
        let grain = GRAIN * self.rings.edge * signed_unit(self.grain.wrapping_add(first + j));
        self.figure.point(&footing, self.rings.edge, grain).as_vec3().to_array()
    }

    fn ply_vertices(&self, piece: Piece, bytes: &mut Vec<u8>) {
        let ring = self.rings.ring(&self.figure, piece.ring);
        let first = self.rings.first(piece.ring);
        for j in piece.from..piece.to {
            bytes.extend_from_slice(&ply_vertex(self.vertex(&ring, first, j)));
        }
    }

    fn ply_faces(&self, piece: Piece, bytes: &mut Vec<u8>) {
        let first = [self.rings.first(piece.ring), self.rings.first(piece.ring + 1)];
        self.rings.strip(piece.ring).triangles(piece.from, piece.to, |corners| {
            let face = corners.map(|(above, j)| (first[usize::from(above)] + j) as u32);
            bytes.extend_from_slice(&ply_face(face));
        });
    }

    fn stl_facets(&self, piece: Piece, bytes: &mut Vec<u8>) {
        let rings = [piece.ring, piece.ring + 1].map(|r| (self.rings.ring(&self.figure, r), self.rings.first(r)));
        // The corners of a triangle are those of the one before, save one.
        let mut known: [Option<(u64, [f32; 3])>; 4] = [None; 4];
        self.rings.strip(piece.ring).triangles(piece.from, piece.to, |corners| {
            let corners = corners.map(|(above, j)| {
                let (ring, first) = &rings[usize::from(above)];
                let slot = &mut known[2 * usize::from(above) + (j & 1) as usize];
                match *slot {
                    Some((at, position)) if at == j => position,
                    _ => slot.insert((j, self.vertex(ring, *first, j))).1,
                }
            });
            let [a, b, c] = corners.map(|p| Vec3::from_array(p).as_dvec3());
            let normal: DVec3 = (b - a).cross(c - a);
            bytes.extend_from_slice(&stl_facet(normal, corners));
        });
    }
}

fn pieces(ring: usize, count: u64) -> impl Iterator<Item = Piece> {
    (0..count.div_ceil(PIECE)).map(move |i| Piece { ring, from: i * PIECE, to: count.min((i + 1) * PIECE) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_scan_takes_no_more_memory_than_a_small_one() {
        let faces = 2 * (u64::from(u32::MAX) - 2);
        let scan = Scan::new(faces, 1);
        assert_eq!(scan.rings.vertices(), u64::from(u32::MAX));
        assert!(scan.rings.len() < 200_000, "{} rings", scan.rings.len());
        let strips: u64 = (0..scan.rings.len() - 1).map(|ring| scan.rings.strip(ring).len()).sum();
        assert_eq!(strips, faces);
        let largest = scan.face_pieces().map(|p| p.to - p.from).max();
        assert_eq!(largest, Some(PIECE));

        // A piece from the middle has the faces of a small scan, as far as floats hold them.
        let ring = scan.rings.len() / 2;
        let mut facets = Vec::new();
        scan.stl_facets(Piece { ring, from: 10_000, to: 10_500 }, &mut facets);
        let number = |b: &[u8]| f64::from(f32::from_le_bytes(b.try_into().unwrap()));
        for facet in facets.chunks(50) {
            let corner = |i: usize| DVec3::from_array([0, 4, 8].map(|o| number(&facet[12 * i + o..][..4])));
            let [a, b, c] = [1, 2, 3].map(corner);
            for length in [a.distance(b), b.distance(c), c.distance(a)] {
                assert!((0.3..3.0).contains(&(length / scan.rings.edge)), "{length} of {}", scan.rings.edge);
            }
        }
        let mut indices = Vec::new();
        scan.ply_faces(Piece { ring: scan.rings.len() - 2, from: 0, to: 1 }, &mut indices);
        assert_eq!(indices[9..13], (u32::MAX - 1).to_le_bytes(), "the crown is the last vertex");
    }

    /// Bytes that tests, benches and reports elsewhere may rely on: a change of the figure is a change of this number.
    #[test]
    fn a_seed_means_the_same_scan_everywhere() {
        let scan = Scan::new(1_000, 1);
        let mut bytes = Vec::new();
        scan.vertex_pieces().for_each(|piece| scan.ply_vertices(piece, &mut bytes));
        scan.face_pieces().for_each(|piece| scan.ply_faces(piece, &mut bytes));
        assert_eq!(bytes.len(), 12 * 502 + 13 * 1_000);
        assert_eq!(bytes.iter().fold(0, |sum, &b| mix(sum ^ u64::from(b))), 0x8714_ad23_8708_b223);
    }
}
