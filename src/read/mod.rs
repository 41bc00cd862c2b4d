//! Reading: a scan is opened, checked against its own size, and then streamed in chunks as often as a stage wants to.
//!
//! Promises: [`Scan::open`] allocates nothing on the file's word; counts are exact afterwards; an index that is handed out
//! names a vertex; a soup's corners are finite; chunks depend on the file alone, not on the crew; what is resident is a
//! few windows of a mebibyte and the workers' buffers, whatever the size of the file. Not promised: that vertices of an
//! indexed scan are finite (one that no face uses may be anything), the order in which chunks reach a crew of more than
//! one worker, and sense from a file that another process changes meanwhile.
//!
//! `map` makes bytes visible, `spool` unpacks what cannot be mapped, `stream` hands bytes to workers, `cursor` walks what
//! must be read in order, `lines` makes text divisible; `ply*`, `stl*`, `obj`, `off`, `gltf*` and `ascii` know the formats;
//! [`load`] and [`Scan::sample`] are built on the passes; `floor` is what benches hold them against.

mod ascii;
mod attribute;
mod cursor;
mod floor;
mod gltf;
mod gltf_coat;
mod gltf_json;
mod gltf_looks;
mod gltf_scene;
mod lines;
mod load;
mod map;
mod obj;
mod obj_corners;
mod off;
mod off_corners;
mod ply;
mod ply_binary;
mod ply_corners;
mod ply_header;
mod ply_records;
mod sample;
mod spool;
mod stl;
mod stl_ascii;
mod stl_corners;
mod stream;

pub(crate) use ply_header::MOST_COLUMNS;

pub use attribute::{Attribute, Carrier};
pub use load::{LoadReport, Loaded, load, load_peak_bytes};
pub use sample::Sample;
pub use spool::{Compression, STDIN};
pub use stream::Crew;

use crate::error::{Error, Item, Result};
use crate::mesh::Extent;
use crate::mesh::coat::{Coat, Corners};
use crate::mesh::columns::Column;
use crate::progress::Progress;
use crate::scratch::Scratch;
use glam::DVec3;
use gltf::Gltf;
use map::Input;
use obj::ObjText;
use off::OffText;
use ply::Ply;
use std::fmt;
use std::path::Path;
use stl::Stl;
use stream::Slots;

/// What coordinates must be stored in to lose nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scalar {
    /// `f32`: floats and integers of up to 16 bits.
    F32,
    /// `f64`: doubles and integers of 32 bits.
    F64,
}

/// How faces name their corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// By the number of a vertex (all but STL).
    Indexed,
    /// By three positions (STL).
    Soup,
}

/// The format of a file, told by its content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// PLY, `binary_little_endian`.
    PlyLittleEndian,
    /// PLY, `binary_big_endian`.
    PlyBigEndian,
    /// PLY, `ascii`.
    PlyAscii,
    /// STL, 50 bytes a face.
    StlBinary,
    /// STL, in words.
    StlAscii,
    /// Wavefront OBJ.
    Obj,
    /// OFF, in words.
    OffAscii,
    /// OFF, big-endian.
    OffBinary,
    /// glTF 2 in one binary file.
    Glb,
    /// glTF 2 in JSON, its buffers beside or within it.
    Gltf,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Format::PlyLittleEndian => "PLY, binary little-endian",
            Format::PlyBigEndian => "PLY, binary big-endian",
            Format::PlyAscii => "PLY, ASCII",
            Format::StlBinary => "STL, binary",
            Format::StlAscii => "STL, ASCII",
            Format::Obj => "OBJ",
            Format::OffAscii => "OFF, ASCII",
            Format::OffBinary => "OFF, binary",
            Format::Glb => "glTF 2, binary",
            Format::Gltf => "glTF 2, JSON",
        })
    }
}

/// At most 16,384 vertices, in the order of the file.
#[derive(Debug, Clone, Copy)]
pub struct VertexChunk<'a> {
    /// The number of the first.
    pub first: u64,
    /// Their coordinates as the file has them, finite or not.
    pub positions: &'a [[f64; 3]],
}

/// At most 16,384 triangles, in the order of the file.
#[derive(Debug, Clone, Copy)]
pub struct TriangleChunk<'a> {
    /// The number of the first among all triangles.
    pub first: u64,
    /// The vertices of their corners, which exist.
    pub triangles: &'a [[u32; 3]],
}

/// At most 16,384 triangles, in the order of the file.
#[derive(Debug, Clone, Copy)]
pub struct SoupChunk<'a> {
    /// The number of the first among all triangles.
    pub first: u64,
    /// Their corners' positions, which are finite.
    pub triangles: &'a [[[f64; 3]; 3]],
}

/// What becomes of a chunk, given the number of the worker that has it.
type VertexStep<'a> = dyn Fn(usize, VertexChunk<'_>) -> Result<()> + Sync + 'a;
type TriangleStep<'a> = dyn Fn(usize, TriangleChunk<'_>) -> Result<()> + Sync + 'a;
type SoupStep<'a> = dyn Fn(usize, SoupChunk<'_>) -> Result<()> + Sync + 'a;

/// What becomes of a face, given how many triangles it is and its numbers.
pub type FaceStep<'a> = dyn FnMut(usize, &[f64]) + 'a;

type CarriedStep<'a> = dyn Fn(usize, CarriedChunk<'_>) -> Result<()> + Sync + 'a;

/// At most 16,384 vertices with what they carry, in the order of the file.
#[derive(Debug, Clone, Copy)]
pub struct CarriedChunk<'a> {
    /// The number of the first.
    pub first: u64,
    /// Their coordinates as the file has them, finite or not.
    pub positions: &'a [[f64; 3]],
    /// A number of each column a vertex, vertex after vertex; not a number where the file has none.
    pub values: &'a [f64],
    /// How many columns there are.
    pub columns: usize,
}

/// An open scan.
#[derive(Debug)]
pub struct Scan {
    input: Input,
    compression: Option<Compression>,
    body: Body,
    columns: Vec<Column>,
}

#[derive(Debug)]
enum Body {
    Ply(Box<Ply>),
    Stl(Stl),
    Obj(Box<ObjText>),
    Off(Box<OffText>),
    OffBinary(Box<Ply>),
    Gltf(Box<Gltf>),
}

/// How much of a file is looked at to tell its format.
const LOOK_BYTES: u64 = 4096;

impl Scan {
    /// Opens a scan: tells its format by its content, and by its name where that leaves a doubt, reads the header, checks
    /// it against the size of the file and counts what the header does not say. That takes a pass over the faces when they
    /// are text or not all triangles. What would have to be unpacked is refused: see [`open_in`](Self::open_in).
    pub fn open(path: &Path, progress: &Progress) -> Result<Scan> {
        Self::open_with(path, None, progress)
    }

    /// Opens a scan that may be compressed, or be standard input: it is then unpacked into `scratch`.
    pub fn open_in(path: &Path, scratch: &Scratch, progress: &Progress) -> Result<Scan> {
        Self::open_with(path, Some(scratch), progress)
    }

    fn open_with(path: &Path, scratch: Option<&Scratch>, progress: &Progress) -> Result<Scan> {
        let (input, compression) = spool::open(path, scratch, progress)?;
        let mut head = vec![0; input.len().min(LOOK_BYTES) as usize];
        input.read_at(&mut head, 0)?;
        let is_named = |name: &str| has_extension(path, name);
        let body = if ply_header::is_ply(&head) {
            Body::Ply(Ply::open(&input, progress)?.into())
        } else if head.starts_with(gltf::MAGIC) || gltf::is_json(&head) {
            Body::Gltf(Gltf::open(&input, scratch)?.into())
        } else if off::keyword(&head).is_some() {
            match off::open(&input, progress)? {
                off::Opened::Words(text) => Body::Off(text.into()),
                off::Opened::Binary(header) => Body::OffBinary(Ply::with_header(&input, progress, header)?.into()),
            }
        } else if !Stl::fits(&input, &head) && obj::is_obj(&head, head.len() as u64 == input.len(), is_named("obj")) {
            Body::Obj(obj::open(&input, progress)?.into())
        } else {
            head.truncate(stl::HEAD_BYTES as usize);
            Body::Stl(Stl::open(&input, progress, &head)?)
        };
        let columns = match &body {
            Body::Ply(ply) => ply.columns(),
            Body::Obj(text) => text.dialect.columns(),
            Body::Gltf(gltf) => gltf.columns(),
            Body::Off(text) => text.dialect.columns(),
            Body::OffBinary(ply) => ply.columns(),
            Body::Stl(_) => Vec::new(),
        };
        Ok(Scan { input, compression, body, columns })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.input.path()
    }

    /// Its format, unpacked.
    pub fn format(&self) -> Format {
        match &self.body {
            Body::Ply(ply) => ply.format(),
            Body::Stl(stl) => stl.format(),
            Body::Obj(_) => Format::Obj,
            Body::Off(_) => Format::OffAscii,
            Body::OffBinary(_) => Format::OffBinary,
            Body::Gltf(gltf) if gltf.is_binary => Format::Glb,
            Body::Gltf(_) => Format::Gltf,
        }
    }

    /// How it was compressed, if it was.
    pub fn compression(&self) -> Option<Compression> {
        self.compression
    }

    /// Whether faces index vertices.
    pub fn layout(&self) -> Layout {
        match &self.body {
            Body::Stl(_) => Layout::Soup,
            _ => Layout::Indexed,
        }
    }

    /// What its coordinates must be stored in.
    pub fn scalar(&self) -> Scalar {
        let fits_f32 = match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.fits_f32(),
            Body::Stl(_) => true,
            Body::Obj(text) => text.fits_f32,
            Body::Off(text) => text.fits_f32,
            Body::Gltf(gltf) => gltf.fits_f32,
        };
        if fits_f32 { Scalar::F32 } else { Scalar::F64 }
    }

    /// What it carries beside positions and faces, which none of the passes here yields.
    pub fn attributes(&self) -> Vec<Attribute> {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => {
                let textures = ply.textures.iter().map(|name| Attribute::of(Carrier::Face, "TextureFile", name));
                ply.attributes().into_iter().chain(textures).collect()
            }
            Body::Stl(_) if self.has_coat() => vec![Attribute::of(Carrier::Face, stl_corners::NAME, "ushort")],
            Body::Stl(_) => Vec::new(),
            Body::Obj(text) => text.dialect.attributes(),
            Body::Off(text) => text.dialect.attributes(),
            Body::Gltf(gltf) => gltf.attributes.clone(),
        }
    }

    /// Numbers of its vertices that [`carried`](Self::carried) yields.
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// What a length of one is, where the format says so.
    pub fn unit(&self) -> Option<&'static str> {
        matches!(self.body, Body::Gltf(_)).then_some("metre")
    }

    /// The size of the file, unpacked, and of those that it refers to.
    pub fn bytes(&self) -> u64 {
        match &self.body {
            Body::Gltf(gltf) => gltf.bytes(&self.input),
            _ => self.input.len(),
        }
    }

    /// Vertices of the file; three a face where faces do not share them.
    pub fn vertex_count(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.vertex_count(),
            Body::Stl(stl) => 3 * stl.faces,
            Body::Obj(text) => text.total.vertices,
            Body::Off(text) => text.total.vertices,
            Body::Gltf(gltf) => gltf.vertices,
        }
    }

    /// Faces as the file counts them: polygons.
    pub fn face_count(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.face_count(),
            Body::Stl(stl) => stl.faces,
            Body::Obj(text) => text.total.faces,
            Body::Off(text) => text.total.faces,
            Body::Gltf(gltf) => gltf.triangles,
        }
    }

    /// Triangles, when polygons are cut into fans; those of fewer than three corners make none.
    pub fn triangle_count(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.triangles,
            Body::Stl(stl) => stl.faces,
            Body::Obj(text) => text.total.triangles,
            Body::Off(text) => text.total.triangles,
            Body::Gltf(gltf) => gltf.triangles,
        }
    }

    /// Polygons of fewer than three corners, which make no triangle.
    pub fn short_polygons(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.short_polygons,
            Body::Obj(text) => text.total.short_polygons,
            Body::Off(text) => text.total.short_polygons,
            Body::Stl(_) | Body::Gltf(_) => 0,
        }
    }

    /// Bytes behind the last element, which nobody asked for.
    pub fn trailing_bytes(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.trailing,
            Body::Stl(stl) => stl.trailing,
            Body::Gltf(gltf) => gltf.trailing,
            Body::Obj(_) | Body::Off(_) => 0,
        }
    }

    /// The box of all finite vertices, in the file's units.
    pub fn extent(&self, crew: &Crew<'_>) -> Result<Extent> {
        let found = self.vertices(crew, Extent::default, |extent, chunk| {
            chunk.positions.iter().for_each(|p| extent.include(DVec3::from(*p)));
            Ok(())
        })?;
        let extent = found.into_iter().fold(Extent::default(), Extent::union);
        extent.check(self.path())?;
        Ok(extent)
    }

    /// Streams the vertices (of a soup: the corners of its faces). Each worker's `W` sees some of the chunks.
    pub fn vertices<W: Send>(
        &self,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, VertexChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        if let Body::Stl(stl) = &self.body {
            return stl.soup(&self.input, crew, worker, |mine, chunk| {
                let corners = chunk.triangles.as_flattened();
                for (i, positions) in corners.chunks(stream::CHUNK).enumerate() {
                    step(mine, VertexChunk { first: 3 * chunk.first + (i * stream::CHUNK) as u64, positions })?;
                }
                Ok(())
            });
        }
        if let Some((ply, run)) = self.ply().and_then(|ply| Some((ply, ply.vertex_run.as_ref()?))) {
            return ply.vertices_in_run(run, &self.input, crew, worker, step);
        }
        let slots = Slots::new(crew, worker);
        self.vertices_in_order(crew, &|worker, chunk| step(&mut slots.of(worker), chunk))?;
        Ok(slots.into_inner())
    }

    /// The PLY records that it consists of, if it does.
    fn ply(&self) -> Option<&Ply> {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => Some(ply),
            _ => None,
        }
    }

    fn vertices_in_order(&self, crew: &Crew<'_>, step: &VertexStep<'_>) -> Result<()> {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.vertices_in_order(&self.input, crew, step),
            Body::Obj(text) => text.vertices(&self.input, crew, step),
            Body::Off(text) => text.vertices(&self.input, crew, step),
            Body::Gltf(gltf) => gltf.vertices(&self.input, crew, step),
            Body::Stl(_) => Err(Error::input(self.path(), "its faces index no vertices")),
        }
    }

    /// Streams the vertices with what they carry.
    pub fn carried<W: Send>(
        &self,
        crew: &Crew<'_>,
        worker: impl Fn() -> W,
        step: impl Fn(&mut W, CarriedChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        let slots = Slots::new(crew, worker);
        let step = |worker: usize, chunk: CarriedChunk<'_>| step(&mut slots.of(worker), chunk);
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.carried(&self.input, crew, &step)?,
            Body::Obj(text) => text.carried(&[255.0; 3][..self.columns.len()], &self.input, crew, &step)?,
            Body::Off(text) => {
                let factors: Vec<f64> = text.dialect.numbers.iter().map(|(_, factor)| *factor).collect();
                let factors = &factors[..self.columns.len()];
                text.carried(factors, &self.input, crew, &step)?;
            }
            Body::Gltf(gltf) => gltf.carried(&self.input, crew, &step)?,
            _ => return Err(Error::input(self.path(), "its vertices carry nothing that is read")),
        }
        Ok(slots.into_inner())
    }

    /// What corners and faces carry, if they carry anything that is read.
    pub fn coat(&self, progress: &Progress) -> Result<Option<Coat>> {
        match &self.body {
            Body::Obj(text) if self.has_coat() => obj_corners::coat(text, &self.input, progress).map(Some),
            Body::Ply(ply) | Body::OffBinary(ply) if self.has_coat() => ply.coat(&self.input, progress).map(Some),
            Body::Stl(stl) if self.has_coat() => stl.coat(&self.input, progress).map(Some),
            Body::Gltf(gltf) if self.has_coat() => gltf.coat(&self.input, progress).map(Some),
            Body::Off(text) if self.has_coat() => off_corners::coat(text, &self.input, progress).map(Some),
            _ => Ok(None),
        }
    }

    /// Whether corners or faces carry anything that is read.
    pub fn has_coat(&self) -> bool {
        match &self.body {
            Body::Obj(text) => text.dialect.is_coated(),
            Body::Ply(ply) | Body::OffBinary(ply) => ply.is_coated(),
            Body::Stl(stl) => stl.is_coated(&self.input),
            Body::Gltf(gltf) => gltf.is_coated(),
            Body::Off(text) => text.dialect.is_coated(),
        }
    }

    /// Values of a coat that its corners and faces refer to, at most: texture coordinates, normals.
    pub fn coat_values(&self) -> u64 {
        match &self.body {
            Body::Obj(text) => text.dialect.coat_values(),
            Body::Ply(ply) | Body::OffBinary(ply) => ply.coat_values(),
            _ => 0,
        }
    }

    /// All triangles in the order of the file, with what their corners carry.
    pub fn corners(&self, coat: &Coat, progress: &Progress, step: &mut (dyn FnMut(Corners) + Send)) -> Result<()> {
        match &self.body {
            Body::Obj(text) => obj_corners::corners(text, coat, &self.input, progress, step),
            Body::Ply(ply) | Body::OffBinary(ply) => ply.corners(coat, &self.input, progress, step),
            Body::Stl(stl) => stl.corners(coat, &self.input, progress, step),
            Body::Gltf(gltf) => gltf.corners(coat, &self.input, progress, step),
            Body::Off(text) => off_corners::corners(text, coat, &self.input, progress, step),
        }
    }

    /// Numbers that its faces carry.
    pub fn face_columns(&self) -> Vec<Column> {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.face.columns().into_iter().map(|(_, column)| column).collect(),
            Body::Stl(_) if self.has_coat() => Stl::face_columns(),
            Body::Off(text) => text.dialect.face_columns(),
            _ => Vec::new(),
        }
    }

    /// Goes through the numbers of all faces, in the order of the file.
    pub fn face_values(&self, progress: &Progress, each: &mut FaceStep<'_>) -> Result<()> {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.face_values(&self.input, progress, each),
            Body::Stl(stl) => stl.face_values(&self.input, progress, each),
            Body::Off(text) => off_corners::face_values(text, &self.input, progress, each),
            Body::Obj(_) | Body::Gltf(_) => Ok(()),
        }
    }

    /// Streams the triangles of an indexed scan.
    pub fn triangles<W: Send>(
        &self,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, TriangleChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        if let Some((ply, run)) = self.ply().and_then(|ply| Some((ply, ply.triangle_run.as_ref()?))) {
            return ply.triangles_in_run(run, &self.input, crew, worker, step);
        }
        let slots = Slots::new(crew, worker);
        self.triangles_in_order(crew, &|worker, chunk| step(&mut slots.of(worker), chunk))?;
        Ok(slots.into_inner())
    }

    fn triangles_in_order(&self, crew: &Crew<'_>, step: &TriangleStep<'_>) -> Result<()> {
        match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => ply.triangles_in_order(&self.input, crew, step),
            Body::Obj(text) => text.triangles(&self.input, crew, step),
            Body::Off(text) => text.triangles(&self.input, crew, step),
            Body::Gltf(gltf) => gltf.triangles(&self.input, crew, step),
            Body::Stl(_) => Err(Error::input(self.path(), "its faces index no vertices")),
        }
    }

    /// Streams the triangles of a soup.
    pub fn soup<W: Send>(
        &self,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, SoupChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        match &self.body {
            Body::Stl(stl) => stl.soup(&self.input, crew, worker, step),
            _ => Err(Error::input(self.path(), "its faces index vertices")),
        }
    }

    /// An error about a vertex (of a soup: about the face whose corner it is), with its byte where the layout gives it.
    pub fn vertex_error(&self, vertex: u64, what: String) -> Error {
        let item = match &self.body {
            Body::Stl(_) => Item { kind: "face", ordinal: vertex / 3 },
            _ => Item { kind: "vertex", ordinal: vertex },
        };
        let (file, byte) = match &self.body {
            Body::Ply(ply) | Body::OffBinary(ply) => (self.path(), ply.vertex_run.map(|(run, _)| run.byte(vertex))),
            Body::Stl(stl) => (self.path(), stl.corner_byte(vertex)),
            Body::Obj(text) => (self.path(), text.vertex_byte(&self.input, vertex)),
            Body::Off(text) => (self.path(), text.vertex_byte(&self.input, vertex)),
            Body::Gltf(gltf) => gltf.vertex_place(&self.input, vertex),
        };
        Error::Input { file: file.into(), item: Some(item), byte, what }
    }
}

fn has_extension(path: &Path, extension: &str) -> bool {
    // Of `scan.obj.gz`, what counts is `obj`.
    let stem = path.file_stem().map(Path::new).filter(|_| ["gz", "zst"].iter().any(|e| ends_in(path, e)));
    ends_in(stem.unwrap_or(path), extension)
}

fn ends_in(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension))
}
