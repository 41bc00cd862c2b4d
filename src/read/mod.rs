//! Reading: a scan is opened, checked against its own size, and then streamed in chunks as often as a stage wants to.
//!
//! Promises: [`Scan::open`] allocates nothing on the file's word; counts are exact afterwards; an index that is handed out
//! names a vertex; a soup's corners are finite; chunks depend on the file alone, not on the crew; what is resident is a
//! few windows of a mebibyte and the workers' buffers, whatever the size of the file. Not promised: that vertices of an
//! indexed scan are finite (one that no face uses may be anything), the order in which chunks reach a crew of more than
//! one worker, and sense from a file that another process changes meanwhile.
//!
//! `map` makes bytes visible, `stream` hands them to workers, `cursor` walks what must be read in order; `ply*`, `stl*`
//! and `ascii` know the formats; [`load`] and [`Scan::sample`] are built on the passes.

mod ascii;
mod cursor;
mod load;
mod map;
mod ply;
mod ply_binary;
mod ply_header;
mod ply_records;
mod sample;
mod stl;
mod stl_ascii;
mod stream;

pub use load::{LoadReport, load, load_peak_bytes};
pub use sample::Sample;
pub use stream::Crew;

use crate::error::{Error, Item, Result};
use crate::progress::Progress;
use map::Input;
use ply::Ply;
use std::fmt;
use std::path::Path;
use stl::Stl;

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
    /// By the number of a vertex (PLY).
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
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Format::PlyLittleEndian => "PLY, binary little-endian",
            Format::PlyBigEndian => "PLY, binary big-endian",
            Format::PlyAscii => "PLY, ASCII",
            Format::StlBinary => "STL, binary",
            Format::StlAscii => "STL, ASCII",
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

/// An open scan.
#[derive(Debug)]
pub struct Scan {
    input: Input,
    body: Body,
}

#[derive(Debug)]
enum Body {
    Ply(Box<Ply>),
    Stl(Stl),
}

impl Scan {
    /// Opens a scan: tells its format by its content, reads the header, checks it against the size of the file and counts
    /// what the header does not say. That takes a pass over the faces when they are text or not all triangles.
    pub fn open(path: &Path, progress: &Progress) -> Result<Scan> {
        let input = Input::open(path)?;
        let mut head = vec![0; input.len().min(stl::HEAD_BYTES) as usize];
        input.read_at(&mut head, 0)?;
        let body = if ply_header::is_ply(&head) {
            Body::Ply(Ply::open(&input, progress)?.into())
        } else {
            Body::Stl(Stl::open(&input, progress, &head)?)
        };
        Ok(Scan { input, body })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        self.input.path()
    }

    /// Its format.
    pub fn format(&self) -> Format {
        match &self.body {
            Body::Ply(ply) => ply.format(),
            Body::Stl(stl) => stl.format(),
        }
    }

    /// Whether faces index vertices.
    pub fn layout(&self) -> Layout {
        match &self.body {
            Body::Ply(_) => Layout::Indexed,
            Body::Stl(_) => Layout::Soup,
        }
    }

    /// What its coordinates must be stored in.
    pub fn scalar(&self) -> Scalar {
        match &self.body {
            Body::Ply(ply) if !ply.fits_f32() => Scalar::F64,
            _ => Scalar::F32,
        }
    }

    /// The size of the file.
    pub fn bytes(&self) -> u64 {
        self.input.len()
    }

    /// Vertices of the file; three a face where faces do not share them.
    pub fn vertex_count(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) => ply.vertex_count(),
            Body::Stl(stl) => 3 * stl.faces,
        }
    }

    /// Faces as the file counts them: polygons.
    pub fn face_count(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) => ply.face_count(),
            Body::Stl(stl) => stl.faces,
        }
    }

    /// Triangles, when polygons are cut into fans; those of fewer than three corners make none.
    pub fn triangle_count(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) => ply.triangles,
            Body::Stl(stl) => stl.faces,
        }
    }

    /// Polygons of fewer than three corners, which make no triangle.
    pub fn short_polygons(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) => ply.short_polygons,
            Body::Stl(_) => 0,
        }
    }

    /// Bytes behind the last element, which nobody asked for.
    pub fn trailing_bytes(&self) -> u64 {
        match &self.body {
            Body::Ply(ply) => ply.trailing,
            Body::Stl(stl) => stl.trailing,
        }
    }

    /// Streams the vertices (of a soup: the corners of its faces). Each worker's `W` sees some of the chunks.
    pub fn vertices<W: Send>(
        &self,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, VertexChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        match &self.body {
            Body::Ply(ply) => ply.vertices(&self.input, crew, worker, step),
            Body::Stl(stl) => stl.soup(&self.input, crew, worker, |mine, chunk| {
                let corners = chunk.triangles.as_flattened();
                for (i, positions) in corners.chunks(stream::CHUNK).enumerate() {
                    step(mine, VertexChunk { first: 3 * chunk.first + (i * stream::CHUNK) as u64, positions })?;
                }
                Ok(())
            }),
        }
    }

    /// Streams the triangles of an indexed scan.
    pub fn triangles<W: Send>(
        &self,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, TriangleChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        match &self.body {
            Body::Ply(ply) => ply.triangles(&self.input, crew, worker, step),
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
            Body::Ply(_) => Err(Error::input(self.path(), "its faces index vertices")),
            Body::Stl(stl) => stl.soup(&self.input, crew, worker, step),
        }
    }

    /// An error about a vertex (of a soup: about the face whose corner it is), with its byte where records of one length
    /// give it.
    pub fn vertex_error(&self, vertex: u64, what: String) -> Error {
        let (item, byte) = match &self.body {
            Body::Ply(ply) => {
                let item = Item { kind: "vertex", ordinal: vertex };
                (item, ply.vertex_run.map(|(run, _)| run.byte(vertex)))
            }
            Body::Stl(stl) => {
                let item = Item { kind: "face", ordinal: vertex / 3 };
                (item, stl.corner_byte(vertex))
            }
        };
        Error::Input { file: self.path().into(), item: Some(item), byte, what }
    }
}
