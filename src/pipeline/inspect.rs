//! A scan opened, looked through, and reported.

use super::{Effort, on_threads};
use crate::collapse::{self, Policies};
use crate::error::{Error, Result};
use crate::inspect::inspect as look_through;
use crate::job::{DEFAULT_REFIT_ROUNDS, Inspection};
use crate::mesh::columns::{self, Meaning};
use crate::plan::{Ask, Purse, Way, most_threads, streaming_budget};
use crate::progress::{Progress, Stage};
use crate::read::{Crew, Scalar, Scan};
use crate::report::{
    BoxFigures, InspectionReport, Mode, ReductionFigures, SurfaceFigures, UnsaidFigure, peak_rss_bytes,
};
use crate::scratch::Scratch;
use std::time::Instant;

/// Threads that a reduction is told the time of.
const THREADS: usize = 2;

/// Says what is in a scan.
pub fn inspect(inspection: &Inspection, progress: &Progress) -> Result<InspectionReport> {
    let threads = inspection.threads.min(most_threads(inspection.memory.0));
    on_threads(threads, || {
        let begun = Instant::now();
        progress.begin(Stage::Read, 0);
        let scratch = Scratch::in_folder(&inspection.scratch).with_memory(inspection.memory.0);
        let scratch = scratch.with_quota(inspection.scratch_quota.0);
        let scan = Scan::open_in(&inspection.input, &scratch, progress)?;
        let faces = inspection.target.faces(scan.triangle_count()).unwrap_or(0).max(1);
        let policies = Policies::default();
        let ask = Ask {
            target: faces,
            refit_rounds: DEFAULT_REFIT_ROUNDS,
            tail_bytes: collapse::tail_bytes(faces, &policies),
            shade_bytes: super::shade_bytes(&policies, &scan),
            coat_bytes: super::coat_bytes(&scan),
            carry_bytes: super::carry_bytes(&scan, faces),
            is_chain: false,
        };
        let purse = Purse::new(inspection.memory.0, threads, ask);
        let crew = Crew { workers: purse.workers, progress };
        progress.begin(Stage::Read, scan.bytes());
        let room = purse.while_streaming();
        let (found, reduction) = match scan.scalar() {
            Scalar::F32 => (look_through::<f32>(&scan, &crew, &scratch, room), reduction::<f32>(&scan, &purse, faces)),
            Scalar::F64 => (look_through::<f64>(&scan, &crew, &scratch, room), reduction::<f64>(&scan, &purse, faces)),
        };
        let found = found?;
        Ok(InspectionReport {
            path: inspection.input.clone(),
            format: scan.format().to_string(),
            compression: scan.compression(),
            bytes: scan.bytes(),
            faces: scan.face_count(),
            triangles: scan.triangle_count(),
            vertices: scan.vertex_count(),
            coordinates: if scan.scalar() == Scalar::F64 { "double" } else { "float" },
            unit: scan.unit(),
            attributes: scan.attributes(),
            extent: BoxFigures::of(&found.extent),
            surface: SurfaceFigures::of(&found, scan.short_polygons(), scan.trailing_bytes()),
            unsaid: found.unsaid.iter().map(|unsaid| UnsaidFigure::of(unsaid, streaming_budget)).collect(),
            reduction,
            threads,
            memory_budget_bytes: inspection.memory.0,
            peak_rss_bytes: peak_rss_bytes(),
            scratch_bytes: scratch.bytes(),
            seconds: begun.elapsed().as_secs_f64(),
        })
    })
}

/// Whether vertices have colours, which would steer.
fn has_colour(scan: &Scan) -> bool {
    columns::find::<3>(scan.columns(), Meaning::Colour).is_some()
}

/// What a reduction to so many faces would take, asked of the plan that would make it.
fn reduction<S: crate::mesh::Coordinate>(scan: &Scan, purse: &Purse, faces: u64) -> ReductionFigures {
    let in_core_bytes = purse.in_core_budget::<S>(scan);
    let fits = purse.in_core::<S>(scan).is_some();
    let way = purse.way::<S>(scan, Some(faces)).ok();
    let mode = if fits { Some(Mode::InCore) } else { way.map(|_| Mode::OutOfCore) };
    let least_bytes = match purse.poorest().way::<S>(scan, Some(faces)) {
        Err(Error::Budget { needed_bytes, .. }) => needed_bytes,
        _ => in_core_bytes,
    };
    let effort = |mode| Effort {
        faces: scan.triangle_count(),
        mode,
        targets: vec![faces.min(scan.triangle_count())],
        refit_rounds: DEFAULT_REFIT_ROUNDS,
        coloured: has_colour(scan),
        samples: 0,
        pictures: false,
    };
    // In tiles all faces go through the collapse, as in core.
    let like = if matches!(way, Some(Way::Tiled(_))) { Some(Mode::InCore) } else { mode };
    let seconds = like.map(|mode| effort(mode).seconds(THREADS));
    ReductionFigures { faces, mode, seconds, in_core_bytes, least_bytes }
}
