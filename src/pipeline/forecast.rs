//! What a reduction would take, from the scan's header and its size: nothing is reduced.

use crate::error::Result;
use crate::job::Job;
use crate::mesh::Coordinate;
use crate::plan::Purse;
use crate::progress::Progress;
use crate::read::{Layout, Scalar, Scan};
use crate::report::Mode;

/// What is expected of a reduction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Forecast {
    /// Faces of the scan.
    pub faces: u64,
    /// Vertices of the scan.
    pub vertices: u64,
    /// Whether it has to be clustered first.
    pub mode: Mode,
    /// Faces of the finest mesh, at most; of the scan where a distance is asked for.
    pub target: u64,
    /// Size of the meshes, about.
    pub output_bytes: u64,
    /// What spills take, about, where faces come in a sensible order.
    pub scratch_bytes: u64,
}

/// Opens the scan and tells what would be done. A budget that cannot do it is refused.
pub fn forecast(job: &Job, progress: &Progress) -> Result<Forecast> {
    let scan = Scan::open_in(&job.input, &job.scratch(), progress)?;
    match scan.scalar() {
        Scalar::F32 => through::<f32>(job, &scan),
        Scalar::F64 => through::<f64>(job, &scan),
    }
}

fn through<S: Coordinate>(job: &Job, scan: &Scan) -> Result<Forecast> {
    let faces = scan.triangle_count();
    let asked = job.target.faces(faces);
    let purse = Purse::new(job.memory.0, job.threads, super::ask(job, scan, asked));
    let mode = match purse.in_core::<S>(scan) {
        Some(_) => Mode::InCore,
        None => purse.out_of_core::<S>(scan, asked).map(|_| Mode::OutOfCore)?,
    };
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
    let spilled = match (scan.layout(), mode) {
        (Layout::Indexed, Mode::OutOfCore) => scan.vertex_count().saturating_mul(15),
        _ => 0,
    };
    let measured = if job.verify && scan.layout() == Layout::Indexed && mode == Mode::OutOfCore { position } else { 0 };
    let scratch_bytes = spilled.max(scan.vertex_count().saturating_mul(measured));
    Ok(Forecast { faces, vertices: scan.vertex_count(), mode, target, output_bytes, scratch_bytes })
}
