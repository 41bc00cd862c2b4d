//! What a reduction would take, from the scan's header and its size: nothing is reduced.

use super::Effort;
use crate::error::Result;
use crate::job::Job;
use crate::mesh::Coordinate;
use crate::mesh::columns::{self, Meaning};
use crate::plan::{Purse, Way};
use crate::progress::Progress;
use crate::read::{Layout, Scalar, Scan};
use crate::report::Mode;

/// What is expected of a reduction.
#[derive(Debug, Clone, PartialEq)]
pub struct Forecast {
    /// Faces of the scan.
    pub faces: u64,
    /// Vertices of the scan.
    pub vertices: u64,
    /// Whether it has to be clustered first.
    pub mode: Mode,
    /// What decides how long it takes.
    pub effort: Effort,
    /// Size of the meshes, about.
    pub output_bytes: u64,
    /// What spills take, about, where faces come in a sensible order.
    pub scratch_bytes: u64,
}

/// Opens the scan and tells what would be done, with or without pictures. A budget that cannot do it is refused.
pub fn forecast(job: &Job, pictures: bool, progress: &Progress) -> Result<Forecast> {
    let scan = Scan::open_in(&job.input, &job.scratch(), progress)?;
    match scan.scalar() {
        Scalar::F32 => through::<f32>(job, pictures, &scan),
        Scalar::F64 => through::<f64>(job, pictures, &scan),
    }
}

fn through<S: Coordinate>(job: &Job, pictures: bool, scan: &Scan) -> Result<Forecast> {
    let faces = scan.triangle_count();
    let asked = job.target.faces(faces);
    let purse = Purse::new(job.memory.0, job.threads, super::ask(job, scan, asked));
    let way = match purse.in_core::<S>(scan) {
        Some(_) => None,
        None => Some(purse.way::<S>(scan, asked)?),
    };
    let mode = if way.is_some() { Mode::OutOfCore } else { Mode::InCore };
    let target = asked.map_or(faces, |n| n.min(faces));
    let position = 3 * size_of::<S>() as u64;
    let coarser = job.coarser.iter().filter_map(|level| level.target.faces(faces));
    let written: u64 = std::iter::once(target).chain(coarser).map(|n| n.min(faces)).sum();
    // A face of STL takes 50; one of PLY 13, and half a vertex.
    let output_bytes =
        written.saturating_mul(if job.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("stl")) {
            50
        } else {
            13 + position / 2
        });
    let spilled = match (scan.layout(), &way) {
        (_, Some(Way::Tiled(plan))) => plan.scratch_bytes::<S>(faces, target),
        (Layout::Indexed, Some(Way::Clustered(_))) => scan.vertex_count().saturating_mul(15),
        _ => 0,
    };
    let measured = if job.verify && scan.layout() == Layout::Indexed && mode == Mode::OutOfCore { position } else { 0 };
    let scratch_bytes = spilled.max(scan.vertex_count().saturating_mul(measured));
    let coloured = columns::find::<3>(scan.columns(), Meaning::Colour).is_some();
    // In tiles all faces go through the collapse, as in core.
    let like = if matches!(way, Some(Way::Tiled(_))) { Mode::InCore } else { mode };
    let effort = Effort::of(job, faces, like, coloured, pictures);
    Ok(Forecast { faces, vertices: scan.vertex_count(), mode, effort, output_bytes, scratch_bytes })
}
