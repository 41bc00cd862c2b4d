//! Bytes of every format: headers, and records of binary PLY and STL; `text` and `glb` have the others.

use super::{Clothes, Format, Sink, glb, text};
use crate::error::{Error, Result};
use crate::mesh::coat::{Coat, Dress, is_spare};
use crate::mesh::columns::{Column, Columns};
use crate::mesh::{Coordinate, Frame, IndexedMesh, widen};
use glam::DVec3;
use std::io::Write;
use std::path::Path;

/// What a file says of itself before the first element.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Header {
    /// How the elements are laid out.
    pub format: Format,
    /// Coordinates are doubles (PLY only).
    pub double: bool,
    /// Number of vertices (PLY only).
    pub vertices: u64,
    /// Number of triangles.
    pub faces: u64,
}

/// What is written.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Contents<'a, S> {
    pub mesh: &'a IndexedMesh<S>,
    pub frame: Frame,
    /// What vertices carry: of no columns, or for every vertex.
    pub carried: &'a Columns,
    /// What faces carry beside it: of no columns, or for every face.
    pub of_faces: &'a Columns,
    /// What corners and faces carry, if they do.
    pub clothes: Option<Clothes<'a>>,
    /// What an OBJ is to call its library.
    pub library: Option<&'a str>,
    /// What a PLY is to call its textures.
    pub textures: &'a [String],
}

impl<'a, S> Contents<'a, S> {
    /// What says which labels faces have, if they have any.
    fn labels(&self) -> Option<(&'a Dress, &'a Coat)> {
        self.clothes.map(|c| (c.dress, c.coat)).filter(|(_, coat)| !coat.face_columns.is_empty())
    }

    /// The numbers that faces have.
    pub(super) fn face_columns(&self) -> Vec<Column> {
        let labels = self.labels().map_or(&[][..], |(_, coat)| &coat.face_columns);
        labels.iter().chain(&self.of_faces.columns).cloned().collect()
    }

    /// Those of one face.
    pub(super) fn face_values(&self, face: usize, values: &mut Vec<f64>) {
        values.clear();
        if let Some((dress, coat)) = self.labels() {
            let labels = &coat.patches[dress.patches[face] as usize].labels;
            values.extend(labels.iter().map(|bits| f64::from_bits(*bits)));
        }
        if !self.of_faces.columns.is_empty() {
            values.extend(self.of_faces.of(face));
        }
    }
}

impl Header {
    /// The header's bytes; refuses counts that the format cannot hold.
    pub(crate) fn bytes(&self, path: &Path) -> Result<Vec<u8>> {
        self.bytes_with(path, &[], &[], &[])
    }

    /// The same where vertices carry numbers.
    pub(super) fn bytes_with(
        &self,
        path: &Path,
        carried: &[Column],
        of_faces: &[Column],
        textures: &[String],
    ) -> Result<Vec<u8>> {
        let largest = u64::from(u32::MAX);
        let (what, count, remedy) = match self.format {
            Format::Ply | Format::PlyAscii => ("vertices", self.vertices, ""),
            Format::Stl => ("faces", self.faces, "; PLY holds more"),
            // They have no counts, or are refused for their length before these are reached.
            Format::Obj | Format::Glb | Format::GlbQuantised => ("vertices", 0, ""),
        };
        if count > largest {
            let what = format!("{}: {count} {what} are asked, but its format holds {largest}{remedy}", path.display());
            return Err(Error::usage(what));
        }
        Ok(match self.format {
            Format::Ply | Format::PlyAscii => self.ply(carried, of_faces, textures).into_bytes(),
            Format::Stl => self.stl(count as u32),
            Format::Obj => format!("# meshmill {}\n", env!("CARGO_PKG_VERSION")).into_bytes(),
            Format::Glb | Format::GlbQuantised => Vec::new(),
        })
    }

    fn ply(&self, carried: &[Column], of_faces: &[Column], textures: &[String]) -> String {
        let scalar = if self.double { "double" } else { "float" };
        // Readers that know `int` alone are many; `uint` only where it must be.
        let index = if self.vertices > 1 << 31 { "uint" } else { "int" };
        let list = |columns: &[Column]| -> String {
            columns.iter().map(|c| format!("property {} {}\n", c.number.word(), c.name)).collect()
        };
        let (carried, of_faces) = (list(carried), list(of_faces));
        let textures: String = textures.iter().map(|name| format!("comment TextureFile {name}\n")).collect();
        let encoding = if self.format == Format::PlyAscii { "ascii" } else { "binary_little_endian" };
        format!(
            "ply\nformat {encoding} 1.0\ncomment meshmill {}\n{textures}\
             element vertex {}\nproperty {scalar} x\nproperty {scalar} y\nproperty {scalar} z\n{carried}\
             element face {}\nproperty list uchar {index} vertex_indices\n{of_faces}end_header\n",
            env!("CARGO_PKG_VERSION"),
            self.vertices,
            self.faces
        )
    }

    /// Eighty bytes of text, which must not begin with "solid", and the count.
    fn stl(&self, faces: u32) -> Vec<u8> {
        let mut bytes = format!("binary STL, meshmill {}", env!("CARGO_PKG_VERSION")).into_bytes();
        bytes.resize(80, b' ');
        bytes.extend(faces.to_le_bytes());
        bytes
    }

    /// Size of the elements in bytes; of a text, about.
    pub(crate) fn element_bytes(&self) -> u64 {
        match self.format {
            Format::Ply => self.vertices * if self.double { 24 } else { 12 } + self.faces * 13,
            Format::Stl => self.faces * 50,
            Format::PlyAscii | Format::Obj => self.vertices * text::VERTEX_BYTES + self.faces * text::FACE_BYTES,
            Format::Glb | Format::GlbQuantised => glb::element_bytes(self.format, self.vertices, self.faces),
        }
    }
}

/// A vertex in floats.
#[inline(always)]
pub(crate) fn ply_vertex(p: [f32; 3]) -> [u8; 12] {
    let mut record = [0; 12];
    for (bytes, x) in record.as_chunks_mut::<4>().0.iter_mut().zip(p) {
        *bytes = x.to_le_bytes();
    }
    record
}

/// A vertex in doubles.
#[inline(always)]
pub(crate) fn ply_vertex_double(p: [f64; 3]) -> [u8; 24] {
    let mut record = [0; 24];
    for (bytes, x) in record.as_chunks_mut::<8>().0.iter_mut().zip(p) {
        *bytes = x.to_le_bytes();
    }
    record
}

/// A triangle of three indices.
#[inline(always)]
pub(crate) fn ply_face(face: [u32; 3]) -> [u8; 13] {
    let mut record = [3; 13];
    for (bytes, v) in record[1..].as_chunks_mut::<4>().0.iter_mut().zip(face) {
        *bytes = v.to_le_bytes();
    }
    record
}

/// A triangle with its unit normal; the normal of a triangle without area is zero, as the format has it.
#[inline(always)]
pub(crate) fn stl_facet(normal: DVec3, corners: [[f32; 3]; 3]) -> [u8; 50] {
    let mut record = [0; 50];
    let length = normal.length();
    let unit = if length > 0.0 { normal / length } else { DVec3::ZERO };
    let numbers = [unit.as_vec3().to_array(), corners[0], corners[1], corners[2]];
    for (bytes, x) in record.as_chunks_mut::<4>().0.iter_mut().zip(numbers.as_flattened()) {
        *bytes = x.to_le_bytes();
    }
    record
}

/// Streams contents into `sink`, header and all. `path` names the file in errors.
pub(crate) fn encode<S: Coordinate, W: Write>(
    contents: &Contents<'_, S>,
    header: &Header,
    path: &Path,
    sink: &mut Sink<'_, W>,
) -> Result<()> {
    sink.put(&header.bytes_with(path, &contents.carried.columns, &contents.face_columns(), contents.textures)?)?;
    match header.format {
        Format::Ply => ply(contents, sink),
        Format::Stl => stl(contents, path, sink),
        Format::PlyAscii | Format::Obj => text::elements(contents, header.format, sink),
        Format::Glb | Format::GlbQuantised => glb::encode(contents, header.format, path, sink),
    }
}

fn ply<S: Coordinate, W: Write>(contents: &Contents<'_, S>, sink: &mut Sink<'_, W>) -> Result<()> {
    let Contents { mesh, frame, carried, .. } = *contents;
    let back = |p: &[S; 3]| frame.place_back(widen(*p)).to_array();
    if !carried.columns.is_empty() {
        let mut record = Vec::with_capacity(24 + 8 * carried.columns.len());
        for (vertex, p) in mesh.positions.iter().enumerate() {
            record.clear();
            if S::DOUBLE {
                record.extend(ply_vertex_double(back(p)));
            } else {
                record.extend(ply_vertex(back(p).map(|x| x as f32)));
            }
            let values = carried.columns.iter().zip(carried.of(vertex));
            values.for_each(|(column, value)| column.number.put(*value, &mut record));
            sink.put(&record)?;
        }
    } else if S::DOUBLE {
        sink.put_each(&mesh.positions, |p| Ok(ply_vertex_double(back(p))))?;
    } else {
        sink.put_each(&mesh.positions, |p| Ok(ply_vertex(back(p).map(|x| x as f32))))?;
    }
    let columns = contents.face_columns();
    if columns.is_empty() {
        return sink.put_each(&mesh.faces, |&face| Ok(ply_face(face)));
    }
    let (mut record, mut values) = (Vec::with_capacity(64), Vec::new());
    for (f, face) in mesh.faces.iter().enumerate() {
        record.clear();
        record.extend(ply_face(*face));
        contents.face_values(f, &mut values);
        columns.iter().zip(&values).for_each(|(c, x)| c.number.put(*x, &mut record));
        sink.put(&record)?;
    }
    Ok(())
}

fn stl<S: Coordinate, W: Write>(contents: &Contents<'_, S>, path: &Path, sink: &mut Sink<'_, W>) -> Result<()> {
    let Contents { mesh, frame, .. } = *contents;
    let facet = |face: &[u32; 3]| {
        // Normals come from the frame, where no product of coordinates leaves the range of doubles.
        let [a, b, c] = face.map(|v| mesh.at(v));
        let corners = [a, b, c].map(|p| frame.place_back(p).to_array().map(|x| x as f32));
        if !corners.as_flattened().iter().all(|x| x.is_finite()) {
            let what = "STL holds floats, which end at 3.4e38, and this mesh goes beyond: write a .ply".to_string();
            return Err(Error::Unmet { file: path.into(), what });
        }
        Ok(stl_facet((b - a).cross(c - a), corners))
    };
    if !is_spare(&contents.face_columns()) {
        return sink.put_each(&mesh.faces, facet);
    }
    let mut values = Vec::new();
    for (f, face) in mesh.faces.iter().enumerate() {
        let mut record = facet(face)?;
        contents.face_values(f, &mut values);
        record[48..].copy_from_slice(&(values[0] as u16).to_le_bytes());
        sink.put(&record)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::Extent;
    use crate::progress::Progress;

    fn quad() -> IndexedMesh<f64> {
        IndexedMesh {
            positions: vec![[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.5, 0.0], [0.25, 0.25, 0.0]],
            faces: vec![[0, 1, 2], [0, 2, 3]],
        }
    }

    fn bytes_of<S: Coordinate>(mesh: &IndexedMesh<S>, frame: Frame, format: Format) -> Result<Vec<u8>> {
        let (progress, mut out) = (Progress::default(), Vec::new());
        let header =
            Header { format, double: S::DOUBLE, vertices: mesh.positions.len() as u64, faces: mesh.faces.len() as u64 };
        let mut sink = Sink::new(&mut out, Path::new("x"), &progress);
        let none = Columns::default();
        let contents =
            Contents { mesh, frame, carried: &none, of_faces: &none, clothes: None, library: None, textures: &[] };
        encode(&contents, &header, Path::new("x"), &mut sink)?;
        sink.finish()?;
        assert_eq!(out.len() as u64, header.bytes(Path::new("x"))?.len() as u64 + header.element_bytes());
        Ok(out)
    }

    /// The frame of a scan whose longest side is `side`.
    fn frame_of(side: f64) -> Frame {
        Frame::of(&Extent { min: DVec3::ZERO, max: DVec3::splat(side) })
    }

    #[test]
    fn ply_in_doubles_goes_back_to_the_last_bit() {
        let file = [4_512_345.123_456_789, 5_400_000.000_000_001, -0.1];
        let frame = frame_of(6e6);
        let mesh = IndexedMesh { positions: vec![file.map(|x| frame.to_frame(x)); 3], faces: vec![[0, 1, 2]] };
        let bytes = bytes_of(&mesh, frame, Format::Ply).unwrap();
        let elements = &bytes[bytes.len() - 3 * 24 - 13..];
        let expected: Vec<u8> = file.iter().flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(elements[..24], expected);
        assert_eq!(elements[72..], [3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
        let text = String::from_utf8_lossy(&bytes);
        assert!(text.starts_with("ply\nformat binary_little_endian 1.0\ncomment meshmill "), "{text}");
        assert!(text.contains("element vertex 3\nproperty double x\n"), "{text}");
        assert!(text.contains("element face 1\nproperty list uchar int vertex_indices\nend_header\n"), "{text}");
    }

    #[test]
    fn stl_normals_are_unit_or_zero_at_any_scale() {
        for side in [1e-36, 1e-12, 1.0, 1e7] {
            let bytes = bytes_of(&quad(), frame_of(side), Format::Stl).unwrap();
            assert_eq!(bytes.len(), 84 + 2 * 50);
            assert!(!bytes.starts_with(b"solid"));
            assert_eq!(bytes[80..84], [2, 0, 0, 0]);
            let normal =
                |face: usize| bytes[84 + 50 * face..][..12].as_chunks().0.iter().map(|b| f32::from_le_bytes(*b));
            assert!(normal(0).eq([0.0, 0.0, 1.0]), "side {side}");
            assert!(normal(1).eq([0.0; 3]), "side {side}: a triangle without area has no normal");
        }
    }

    #[test]
    fn stl_refuses_what_floats_cannot_hold() {
        let error = bytes_of(&quad(), frame_of(1e60), Format::Stl).unwrap_err();
        assert_eq!(error.code(), "unmet");
        assert!(bytes_of(&quad(), frame_of(1e60), Format::Ply).is_ok());
    }

    #[test]
    fn counts_beyond_a_format_are_refused() {
        let path = Path::new("x");
        let header = |format, vertices, faces| Header { format, double: false, vertices, faces };
        assert!(header(Format::Ply, u64::from(u32::MAX) + 1, 8).bytes(path).is_err());
        assert!(header(Format::Stl, 8, u64::from(u32::MAX) + 1).bytes(path).is_err());
        let large = header(Format::Ply, (1 << 31) + 1, 1 << 33).bytes(path).unwrap();
        assert!(String::from_utf8(large).unwrap().contains("list uchar uint vertex_indices"));
    }
}
