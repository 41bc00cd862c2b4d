//! Writing: an indexed mesh becomes a PLY, STL, OBJ or GLB, whole or not at all.
//!
//! Promises: a reader never sees half a file, a failed or interrupted run leaves nothing behind, and coordinates go back
//! to the file's units exactly, as far as the format holds them. The bytes pass through one buffer of a mebibyte; nothing
//! else is allocated. Standard output gets its first byte when the mesh is ready; a reader of it that sees the end without
//! the program having exited with 0 has half a file.
//!
//! Does not promise: what a `kill -9` leaves behind is a hidden file beside the target, until the next run into the same
//! folder sweeps it.

mod clothes;
mod encode;
mod glb;
mod shaded;
mod sink;
mod target;
mod text;

pub use clothes::{Clothes, Material, Texture, Wardrobe};
pub(crate) use encode::{Header, ply_face, ply_vertex, stl_facet};
pub use shaded::Shading;
pub(crate) use sink::Sink;
pub use target::{Target, WholeFile, is_stdout, sweep};

use crate::error::{Error, Result};
use crate::mesh::coat::is_spare;
use crate::mesh::columns::{Column, Columns, Meaning};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What a mesh has to carry beside its shape, as far as the format holds it.
#[derive(Debug, Clone, Copy)]
pub struct Load<'a> {
    /// Of vertices: of no columns, or for each.
    pub vertices: &'a Columns,
    /// Of faces, beside what the clothes say: of no columns, or for each.
    pub faces: &'a Columns,
    /// What the mesh wears, and the scan beside which it was found.
    pub clothes: Option<(Clothes<'a>, &'a Path)>,
}

/// What can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// Binary little-endian PLY, in the scan's own scalar.
    Ply,
    /// ASCII PLY, in the scan's own scalar.
    PlyAscii,
    /// Binary STL: floats, every triangle on its own.
    Stl,
    /// OBJ.
    Obj,
    /// glTF 2 in one binary file: floats, and what they cannot hold of a place far away in the node.
    Glb,
    /// The same with positions in 16-bit steps over the extent.
    GlbQuantised,
}

impl Format {
    /// The format that a path's extension asks for. Standard output gets a PLY.
    pub fn of(path: &Path) -> Result<Format> {
        if is_stdout(path) {
            return Ok(Format::Ply);
        }
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match extension.as_deref() {
            Some("ply") => Ok(Format::Ply),
            Some("stl") => Ok(Format::Stl),
            Some("obj") => Ok(Format::Obj),
            Some("glb") => Ok(Format::Glb),
            Some(other) => {
                Err(Error::usage(format!("{}: cannot write .{other}, only .ply, .stl, .obj and .glb", path.display())))
            }
            None => Err(Error::usage(format!(
                "{}: a target's name ends in .ply, .stl, .obj or .glb, this one in none of them",
                path.display()
            ))),
        }
    }
}

impl Format {
    /// Whether it has a place for a column of those that vertices carry.
    pub fn holds(self, meaning: Meaning) -> bool {
        match self {
            Format::Ply | Format::PlyAscii => true,
            Format::Obj => matches!(meaning, Meaning::Colour(0..3)),
            Format::Glb => meaning != Meaning::Other,
            Format::GlbQuantised => matches!(meaning, Meaning::Colour(_) | Meaning::Texture(_)),
            Format::Stl => false,
        }
    }

    /// Whether it has a place for a column of those that corners carry.
    pub fn holds_at_corners(self, meaning: Meaning) -> bool {
        self == Format::Obj && matches!(meaning, Meaning::Texture(_) | Meaning::Normal(_)) || self.holds(meaning)
    }

    /// Whether it is one of PLY's.
    pub fn is_ply(self) -> bool {
        matches!(self, Format::Ply | Format::PlyAscii)
    }

    /// Whether it says what faces are made of.
    pub fn holds_materials(self) -> bool {
        matches!(self, Format::Obj | Format::Glb | Format::GlbQuantised)
    }

    /// Whether it has a place for these numbers of faces.
    pub fn holds_labels(self, of_faces: &[Column]) -> bool {
        match self {
            Format::Ply | Format::PlyAscii => true,
            Format::Stl => is_spare(of_faces),
            Format::Obj | Format::Glb | Format::GlbQuantised => false,
        }
    }

    /// Whether it says what groups faces are in.
    pub fn holds_groups(self) -> bool {
        self == Format::Obj
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Format::Ply => "PLY, binary little-endian",
            Format::PlyAscii => "PLY, ASCII",
            Format::Stl => "STL, binary",
            Format::Obj => "OBJ",
            Format::Glb => "glTF 2, binary",
            Format::GlbQuantised => "glTF 2, binary, quantised",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_extension_decides_whatever_its_case() {
        assert_eq!(Format::of(Path::new("a.b/c.PLY")).unwrap(), Format::Ply);
        assert_eq!(Format::of(Path::new("x.tmp.Stl")).unwrap(), Format::Stl);
        assert_eq!(Format::of(Path::new("x.OBJ")).unwrap(), Format::Obj);
        assert_eq!(Format::of(Path::new("x.y.glb")).unwrap(), Format::Glb);
        assert_eq!(Format::of(Path::new("-")).unwrap(), Format::Ply);
        for name in ["x.off", "x", "ply", "stl.d/x", ".ply"] {
            let error = Format::of(Path::new(name)).unwrap_err();
            assert_eq!(error.exit_code(), 2, "{name}");
            assert!(error.to_string().contains(".ply") && error.to_string().contains(".stl"), "{error}");
        }
    }
}
