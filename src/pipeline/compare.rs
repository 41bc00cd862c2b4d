//! Two meshes opened, measured, and reported.

use super::{Clock, MOST_THREADS};
use crate::error::{Error, Result};
use crate::job::Comparison;
use crate::measure::{Measured, Options, Pair, measure};
use crate::mesh::Coordinate;
use crate::plan::{Purse, total_for};
use crate::progress::{Progress, Stage};
use crate::read::{Crew, Scalar, Scan};
use crate::report::{ComparisonReport, ComparisonTimeline, MeshFile, Warning, peak_rss_bytes};
use crate::scratch::Scratch;
use std::path::Path;
use std::time::Instant;

/// Measures how far two meshes are from each other, as `comparison` says, and reports.
pub fn compare(comparison: &Comparison, progress: &Progress) -> Result<ComparisonReport> {
    let threads = comparison.threads.min(MOST_THREADS);
    super::on_threads(threads, || {
        let begun = Instant::now();
        let mut clock = Clock::new(begun);
        progress.begin(Stage::Read, 0);
        let a = Scan::open(&comparison.a, progress)?;
        let b = Scan::open(&comparison.b, progress)?;
        let pair = Pair { a: &a, b: &b };
        let options = Options {
            samples: comparison.samples,
            every_vertex: comparison.every_vertex,
            seed: comparison.seed,
            shades: comparison.heatmap.is_some(),
            array_bytes: 0,
        };
        let run = Run { pair, purse: Purse::new(comparison.memory.0, threads), progress, scratch: &comparison.scratch };
        let mut seconds = ComparisonTimeline { read: clock.lap(), ..Default::default() };
        let scratch = Scratch::in_folder(&comparison.scratch);
        let deviation = match pair.held().scalar() {
            Scalar::F32 => run.measure::<f32>(&scratch, options)?.deviation,
            Scalar::F64 => run.measure::<f64>(&scratch, options)?.deviation,
        };
        seconds.measure = clock.lap();
        seconds.total = begun.elapsed().as_secs_f64();
        Ok(ComparisonReport {
            a: mesh_file(&a),
            b: mesh_file(&b),
            deviation: (&deviation).into(),
            seed: comparison.seed,
            heatmap: None,
            threads,
            memory_budget_bytes: comparison.memory.0,
            peak_rss_bytes: peak_rss_bytes(),
            scratch_bytes: scratch.bytes(),
            seconds,
            warnings: [&a, &b].into_iter().filter_map(trailing).collect(),
        })
    })
}

/// A measurement within a budget.
struct Run<'a> {
    pair: Pair<'a>,
    purse: Purse,
    progress: &'a Progress,
    scratch: &'a Path,
}

impl Run<'_> {
    fn measure<S: Coordinate>(&self, scratch: &Scratch, options: Options) -> Result<Measured<S>> {
        let crew = Crew { workers: self.purse.workers, progress: self.progress };
        let options = Options { array_bytes: self.purse.for_arrays(), ..options };
        let _ = self.scratch;
        measure(self.pair, &crew, scratch, &options).map_err(whole_budget)
    }
}

/// A stage knows what its arrays take; the process takes more.
fn whole_budget(error: Error) -> Error {
    match error {
        Error::Budget { what, needed_bytes } => Error::Budget { what, needed_bytes: total_for(needed_bytes) },
        other => other,
    }
}

fn mesh_file(scan: &Scan) -> MeshFile {
    MeshFile { path: scan.path().into(), faces: scan.face_count(), vertices: scan.vertex_count() }
}

fn trailing(scan: &Scan) -> Option<Warning> {
    let bytes = scan.trailing_bytes();
    (bytes > 0).then_some(Warning::TrailingBytes { bytes })
}
