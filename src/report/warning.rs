//! What goes into a report beside its figures: the warnings, and their wording.

use super::{count, grouped};
use crate::budget::Size;
use serde::ser::SerializeStruct;
use serde::{Serialize, Serializer};
use std::fmt;

/// What a user should know about a run that succeeded. Each has a stable code, counts, and a remedy where there is one.
#[derive(Debug, Clone, PartialEq)]
pub enum Warning {
    /// What the scan carries and the result does not.
    NotCarried {
        /// By the scan's names.
        names: Vec<String>,
    },
    /// What breaks off at seams was left out, since the scan does not fit the budget.
    SeamsLeftOut {
        /// A budget that it fits.
        needed_bytes: u64,
    },
    /// Pieces were too small to be kept.
    SmallPieces {
        /// How many.
        pieces: u64,
        /// Their faces.
        faces: u64,
    },
    /// The input goes on behind its last element.
    TrailingBytes {
        /// Bytes ignored.
        bytes: u64,
    },
    /// Faces that name one vertex twice.
    RepeatedCornerFaces {
        /// Faces dropped.
        faces: u64,
    },
    /// Polygons of fewer than three corners.
    ShortPolygons {
        /// Polygons dropped.
        faces: u64,
    },
    /// Faces whose corners differ but lie on a line; out of core, as far as the 8192nd part of a cell shows it.
    FlatFaces {
        /// Faces concerned.
        faces: u64,
    },
    /// Vertices that no face uses. Out of core they are counted where the budget has room for a bit each.
    UnreferencedVertices {
        /// Vertices dropped.
        vertices: u64,
    },
    /// Vertices at a place that another vertex holds already. Not counted out of core, where they merge like all
    /// vertices of a cell.
    DuplicateVertices {
        /// Vertices merged away.
        vertices: u64,
    },
    /// Edges of more than two faces.
    NonManifoldEdges {
        /// Edges concerned.
        edges: u64,
    },
    /// Vertices whose faces form more than one fan.
    NonManifoldVertices {
        /// Vertices concerned.
        vertices: u64,
    },
    /// The scan has no more faces than were asked for.
    TargetAboveScan {
        /// Faces asked for.
        asked: u64,
        /// Faces of the welded scan.
        have: u64,
    },
    /// Coordinates that need 64 bits went into a format of 32.
    StlLosesDoubles {
        /// Vertices written.
        vertices: u64,
    },
    /// The grid overflowed its table and was merged 2 × 2 × 2.
    CoarsenedGrid {
        /// Times that happened.
        times: u32,
        /// Cells left.
        cells: u64,
    },
    /// The intermediate mesh is so close to the target that clustering decides the quality.
    LowRatio {
        /// Intermediate : target.
        ratio: f64,
    },
    /// Seams could not be held down to the count: some of their vertices merged with others.
    SeamsGaveWay,
    /// No picture could be taken.
    NoPicture {
        /// Why.
        why: String,
    },
}

impl Warning {
    /// A stable word for scripts.
    pub fn code(&self) -> &'static str {
        match self {
            Warning::TrailingBytes { .. } => "trailing-bytes",
            Warning::RepeatedCornerFaces { .. } => "repeated-corner-faces",
            Warning::ShortPolygons { .. } => "short-polygons",
            Warning::FlatFaces { .. } => "flat-faces",
            Warning::UnreferencedVertices { .. } => "unreferenced-vertices",
            Warning::DuplicateVertices { .. } => "duplicate-vertices",
            Warning::NonManifoldEdges { .. } => "non-manifold-edges",
            Warning::NonManifoldVertices { .. } => "non-manifold-vertices",
            Warning::TargetAboveScan { .. } => "target-above-scan",
            Warning::StlLosesDoubles { .. } => "stl-loses-doubles",
            Warning::CoarsenedGrid { .. } => "coarsened-grid",
            Warning::LowRatio { .. } => "low-ratio",
            Warning::SmallPieces { .. } => "small-pieces",
            Warning::NotCarried { .. } => "not-carried",
            Warning::SeamsGaveWay => "seams-gave-way",
            Warning::SeamsLeftOut { .. } => "seams-left-out",
            Warning::NoPicture { .. } => "no-picture",
        }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Warning::SeamsGaveWay => f.write_str(
                "seams of textures, normals or materials could not all be held at so few faces: ask for more",
            ),
            Warning::NotCarried { ref names } => {
                let (shown, more) = (&names[..names.len().min(8)], names.len().saturating_sub(8));
                let more = if more > 0 { format!(" and {more} more") } else { String::new() };
                write!(f, "not carried over to the result: {}{more}", shown.join(", "))
            }
            Warning::SeamsLeftOut { needed_bytes } => write!(
                f,
                "the scan does not fit the budget, so that its seams could not be held: what breaks off at them is left out \
                 rather than smeared across them; --memory {} keeps it",
                Size(needed_bytes)
            ),
            Warning::NoPicture { ref why } => write!(f, "no picture was taken: {why}"),
            Warning::TrailingBytes { bytes } => write!(
                f,
                "{} after the last element ignored: if the scan looks cut short, its header counts too few",
                count(bytes, "byte")
            ),
            Warning::RepeatedCornerFaces { faces } => {
                write!(f, "{} with a repeated corner dropped: no surface is lost", count(faces, "face"))
            }
            Warning::ShortPolygons { faces } => write!(
                f,
                "{} of fewer than three corners dropped: if they are lines or points that matter, mesh them first",
                count(faces, "polygon")
            ),
            Warning::FlatFaces { faces } => write!(
                f,
                "{} without area reduced as they are: repair the scan first if the result must have none",
                count(faces, "face")
            ),
            Warning::UnreferencedVertices { vertices } => write!(
                f,
                "{} that no face uses dropped: if they matter, the scan still needs meshing",
                count(vertices, "vertex")
            ),
            Warning::DuplicateVertices { vertices } => {
                write!(f, "{} merged with another at the same place", count(vertices, "vertex"))
            }
            Warning::NonManifoldEdges { edges } => write!(
                f,
                "{} of more than two faces reduced as they are: repair the scan first if the result must be manifold",
                count(edges, "edge")
            ),
            Warning::NonManifoldVertices { vertices } => write!(
                f,
                "{} where separate surfaces touch reduced as they are: repair the scan first if the result must be \
                 manifold",
                count(vertices, "vertex")
            ),
            Warning::TargetAboveScan { asked, have } => write!(
                f,
                "{} asked for, but the scan has {}: written welded and not reduced; ask for fewer to reduce it",
                count(asked, "face"),
                grouped(have)
            ),
            Warning::StlLosesDoubles { vertices } => write!(
                f,
                "{} rounded to the 32-bit floats of STL, though the scan has more digits: write .ply to keep them",
                count(vertices, "vertex")
            ),
            Warning::CoarsenedGrid { times, cells } => write!(
                f,
                "the grid was coarsened {} to fit the budget, {} are left: more --memory gives a closer result",
                if times == 1 { "once".into() } else { format!("{times} times") },
                count(cells, "cell")
            ),
            Warning::LowRatio { ratio } => write!(
                f,
                "the intermediate mesh has only {ratio:.1} times the faces asked for: more --memory gives a closer result"
            ),
            Warning::SmallPieces { pieces, faces } => write!(
                f,
                "{} of {} dropped: smaller than --min-component",
                count(pieces, "piece"),
                count(faces, "face")
            ),
        }
    }
}

impl Serialize for Warning {
    fn serialize<S: Serializer>(&self, out: S) -> Result<S::Ok, S::Error> {
        let mut object = out.serialize_struct("Warning", 2)?;
        object.serialize_field("code", self.code())?;
        object.serialize_field("text", &self.to_string())?;
        object.end()
    }
}
