//! Writing: an indexed mesh becomes a binary PLY or STL, whole or not at all.
//!
//! Promises: a reader never sees half a file, a failed or interrupted run leaves nothing behind, and coordinates go back
//! to the file's units exactly. The bytes pass through one buffer of a mebibyte; nothing else is allocated.
//!
//! Does not promise: what a `kill -9` leaves behind is a hidden file beside the target, until the next run into the same
//! folder sweeps it.

mod encode;
mod shaded;
mod sink;
mod target;

pub(crate) use encode::{Header, ply_face, ply_vertex, stl_facet};
pub use shaded::Shading;
pub(crate) use sink::Sink;
pub use target::{Target, WholeFile, sweep};

use crate::error::{Error, Result};
use std::path::Path;

/// What can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Binary little-endian PLY, in the scan's own scalar.
    Ply,
    /// Binary STL: floats, every triangle on its own.
    Stl,
}

impl Format {
    /// The format that a path's extension asks for.
    pub fn of(path: &Path) -> Result<Format> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match extension.as_deref() {
            Some("ply") => Ok(Format::Ply),
            Some("stl") => Ok(Format::Stl),
            Some(other) => Err(Error::usage(format!("{}: cannot write .{other}, only .ply and .stl", path.display()))),
            None => Err(Error::usage(format!(
                "{}: a target's name ends in .ply or .stl, this one in neither",
                path.display()
            ))),
        }
    }
}

impl std::fmt::Display for Format {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Format::Ply => "PLY, binary little-endian",
            Format::Stl => "STL, binary",
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
        for name in ["x.obj", "x", "ply", "stl.d/x", ".ply"] {
            let error = Format::of(Path::new(name)).unwrap_err();
            assert_eq!(error.exit_code(), 2, "{name}");
            assert!(error.to_string().contains(".ply") && error.to_string().contains(".stl"), "{error}");
        }
    }
}
