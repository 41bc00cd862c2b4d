//! What is in a scan, without changing it.
//!
//! Promises: a scan that fits the budget with [`held_bytes`] is welded, and everything is counted. A larger one is
//! streamed: what needs no memory is counted, what needs some is where the budget has it, and the rest is named in
//! [`Findings::unsaid`] with a budget that would do. Nothing is guessed.
//!
//! Streamed, vertices at one place count as apart in an indexed scan (its faces' numbers are all that is looked at), and as
//! one in a soup (by a hash of 64 bits of their coordinates). Edges go through scratch: 24 bytes a face of an indexed scan,
//! 48 of a soup, sorted a part at a time.

mod edges;
mod streamed;

use crate::error::Result;
use crate::mesh::audit::Audit;
use crate::mesh::{Coordinate, Extent};
use crate::read::{Crew, Scalar, Scan, load, load_peak_bytes};
use crate::scratch::Scratch;

/// What was found. `None` is what could not be said.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Findings {
    /// Whether vertices at one place count as one.
    pub welded: bool,
    /// The box of all vertices that faces use; of all finite ones where that is not known.
    pub extent: Extent,
    /// Vertices at a place that an earlier one has.
    pub duplicate_vertices: Option<u64>,
    /// Vertices that no face uses.
    pub unreferenced_vertices: Option<u64>,
    /// Triangles that name a vertex twice.
    pub repeated_corner_faces: u64,
    /// Triangles whose corners differ but lie on a line.
    pub flat_faces: Option<u64>,
    /// Pieces that share no vertex.
    pub components: Option<u64>,
    /// Edges of a single face.
    pub border_edges: Option<u64>,
    /// Runs of those that share no vertex.
    pub borders: Option<u64>,
    /// Edges of three and more faces, or of two that run along it the same way.
    pub nonmanifold_edges: Option<u64>,
    /// Vertices whose faces form more than one fan.
    pub nonmanifold_vertices: Option<u64>,
    /// What could not be said within the budget.
    pub unsaid: Vec<Unsaid>,
}

/// What a budget has no room for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unsaid {
    /// What it is.
    pub what: &'static str,
    /// Bytes of arrays that would do, where the scan need not be held as a whole; else as many as that takes.
    pub needed_bytes: Option<u64>,
}

/// What holding a scan and counting all of it takes, in bytes of arrays.
pub fn held_bytes(scan: &Scan) -> u64 {
    let position = if scan.scalar() == Scalar::F64 { 24 } else { 12 };
    let (faces, vertices) = (scan.triangle_count(), scan.vertex_count());
    let mesh = faces.saturating_mul(12).saturating_add(vertices.saturating_mul(position));
    let audit = faces.saturating_mul(12).saturating_add(vertices.saturating_mul(8));
    load_peak_bytes(scan).max(mesh.saturating_add(audit))
}

/// Counts what is in a scan with `array_bytes` of memory for it, beside what streaming takes.
pub fn inspect<S: Coordinate>(scan: &Scan, crew: &Crew<'_>, scratch: &Scratch, array_bytes: u64) -> Result<Findings> {
    if held_bytes(scan) <= array_bytes {
        held::<S>(scan, crew)
    } else {
        streamed::findings(scan, crew, scratch, array_bytes)
    }
}

fn held<S: Coordinate>(scan: &Scan, crew: &Crew<'_>) -> Result<Findings> {
    let Some((mesh, _, report)) = load::<S>(scan, crew, u64::MAX)? else { return Ok(Findings::default()) };
    let (faces, vertices) = (mesh.faces, mesh.positions.len());
    drop(mesh.positions);
    let Audit { irregularities, components, borders } = Audit::of(&faces, vertices);
    Ok(Findings {
        welded: true,
        extent: report.extent,
        duplicate_vertices: Some(report.duplicate_vertices),
        unreferenced_vertices: Some(report.unreferenced_vertices),
        repeated_corner_faces: report.repeated_corner_faces,
        flat_faces: Some(report.flat_faces),
        components: Some(components),
        border_edges: Some(irregularities.border_edges),
        borders: Some(borders),
        nonmanifold_edges: Some(irregularities.nonmanifold_edges),
        nonmanifold_vertices: Some(irregularities.nonmanifold_vertices),
        unsaid: Vec::new(),
    })
}

#[cfg(test)]
mod tests;
