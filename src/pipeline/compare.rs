//! Two meshes opened, measured, and reported.

use super::portrait::Portrait;
use super::{Clock, on_threads};
use crate::error::{Error, Result};
use crate::job::Comparison;
use crate::measure::{Deviation, MOST_VERTICES, Measured, Needs, Options, Pair, Scale, measure};
use crate::mesh::Coordinate;
use crate::plan::{Ask, Purse, most_threads, streaming_budget};
use crate::progress::{Progress, Stage};
use crate::read::{Crew, Scalar, Scan};
use crate::report::{ComparisonReport, ComparisonTimeline, HeatmapFile, MeshFile, Warning, peak_rss_bytes};
use crate::scratch::Scratch;
use crate::write::{Shading, Target};
use std::path::Path;
use std::time::Instant;

/// Measures how far two meshes are from each other, as `comparison` says, and reports.
pub fn compare(comparison: &Comparison, progress: &Progress) -> Result<ComparisonReport> {
    let threads = comparison.threads.min(most_threads(comparison.memory.0));
    on_threads(threads, || {
        let begun = Instant::now();
        progress.begin(Stage::Read, 0);
        let out = comparison.heatmap.as_deref().map(|path| target(path, comparison)).transpose()?;
        let scratch = Scratch::in_folder(&comparison.scratch).with_memory(comparison.memory.0);
        let scratch = scratch.with_quota(comparison.scratch_quota.0);
        let a = Scan::open_in(&comparison.a, &scratch, progress)?;
        let b = Scan::open_in(&comparison.b, &scratch, progress)?;
        let pair = Pair { a: &a, b: &b };
        let purse = Purse::new(comparison.memory.0, threads, Ask::default());
        let run = Run { comparison, threads, progress, pair, scratch, purse, begun };
        match pair.held().scalar() {
            Scalar::F32 => run.through::<f32>(out),
            Scalar::F64 => run.through::<f64>(out),
        }
    })
}

fn target(path: &Path, comparison: &Comparison) -> Result<Target> {
    let target = Target::prepare(path, Some(&comparison.a))?;
    target.check_is_not(&comparison.b)?;
    target.check_holds_colours()?;
    Ok(target)
}

/// One comparison under way.
struct Run<'a> {
    comparison: &'a Comparison,
    threads: usize,
    progress: &'a Progress,
    pair: Pair<'a>,
    scratch: Scratch,
    purse: Purse,
    begun: Instant,
}

impl Run<'_> {
    fn through<S: Coordinate>(&self, out: Option<Target>) -> Result<ComparisonReport> {
        let Comparison { samples, most_vertices, seed, .. } = *self.comparison;
        let array_bytes = self.purse.while_streaming();
        let options = Options { samples, most_vertices, seed, shades: out.is_some(), array_bytes };
        let mut clock = Clock::new(self.begun);
        let mut seconds = ComparisonTimeline { read: clock.lap(), ..Default::default() };
        let crew = Crew { workers: self.purse.workers, progress: self.progress };
        let measured = measure::<S>(self.pair, &crew, &self.scratch, &options).map_err(whole_budget)?;
        seconds.measure = clock.lap();
        let heatmap = out.map(|out| self.shade(out, &measured)).transpose()?;
        seconds.write = clock.lap();
        seconds.total = self.begun.elapsed().as_secs_f64();
        Ok(ComparisonReport {
            a: mesh_file(self.pair.a),
            b: mesh_file(self.pair.b),
            deviation: (&measured.deviation).into(),
            seed,
            heatmap,
            threads: self.threads,
            memory_budget_bytes: self.comparison.memory.0,
            peak_rss_bytes: peak_rss_bytes(),
            scratch_bytes: self.scratch.bytes(),
            seconds,
            warnings: [self.pair.a, self.pair.b].into_iter().filter_map(trailing).collect(),
        })
    }

    /// Writes the mesh that was held with its deviation.
    fn shade<S: Coordinate>(&self, out: Target, measured: &Measured<S>) -> Result<HeatmapFile> {
        let scale = Scale::of(&measured.shades);
        let colour = |length| scale.colour(length);
        let shading = Shading { property: "deviation", values: &measured.shades, colour: &colour };
        let path = self.comparison.heatmap.clone().unwrap_or_default();
        out.write_shaded(&measured.mesh, measured.frame, &shading, self.progress)?;
        Ok(HeatmapFile { path, mesh: if self.pair.holds_a() { "a" } else { "b" }, range: [0.0, scale.top()] })
    }
}

/// What a result is measured with: as many points as the budget has room for, up to those that the job says.
fn options(run: &super::Run) -> Options {
    let most_vertices = run.job.samples.min(MOST_VERTICES);
    Options {
        samples: run.job.samples,
        most_vertices,
        seed: 0,
        shades: false,
        array_bytes: run.purse.while_streaming(),
    }
}

/// Refuses a budget in which a result of so many faces could not be measured afterwards.
pub(super) fn check_verifiable<S: Coordinate>(faces: u64, run: &super::Run) -> Result<()> {
    let needs = |options: &Options| Needs::of_result::<S>(faces.min(run.scan.triangle_count()), run.scan, options);
    options(run).fitted(needs).map(|_| ()).map_err(whole_budget)
}

/// Measures a result that was just written against its scan, and shows it on a portrait where there is room for that.
pub(super) fn verify(run: &super::Run, output: &Path, portrait: Option<&mut Portrait>) -> Result<Deviation> {
    let result = Scan::open_in(output, &run.scratch, run.progress)?;
    let pair = Pair { a: run.scan, b: &result };
    match pair.held().scalar() {
        Scalar::F32 => verify_in::<f32>(pair, run, portrait),
        Scalar::F64 => verify_in::<f64>(pair, run, portrait),
    }
    .map_err(whole_budget)
}

fn verify_in<S: Coordinate>(pair: Pair, run: &super::Run, portrait: Option<&mut Portrait>) -> Result<Deviation> {
    let mut options = options(run).fitted(|options| Needs::of::<S>(&pair, options))?;
    if portrait.is_some() {
        let shaded = Options { shades: true, ..options };
        options = shaded.fitted(|options| Needs::of::<S>(&pair, options)).unwrap_or(options);
    }
    let measured = measure::<S>(pair, &super::read_crew(&run.purse, run.progress), &run.scratch, &options)?;
    if let Some(portrait) = portrait.filter(|_| options.shades) {
        portrait.show_deviation(&measured);
    }
    Ok(measured.deviation)
}

/// A stage knows what its arrays take; the process takes more.
fn whole_budget(error: Error) -> Error {
    match error {
        Error::Budget { what, needed_bytes } => Error::Budget { what, needed_bytes: streaming_budget(needed_bytes) },
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
