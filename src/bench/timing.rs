//! Stages, timed: what goes in is made ready before, and what comes out is looked at.

use crate::collapse::{self, Collapsed, Placement, Policies, Primitive, collapse};
use crate::cores::on_threads;
use crate::error::{Error, Result};
use crate::job::DEFAULT_REFIT_ROUNDS;
use crate::mesh::{Frame, IndexedMesh};
use crate::progress::Progress;
use crate::queue::{reset_peak, rss_bytes};
use crate::read::{Crew, Scan, load};
use crate::refit::{Aim, Held, LEAST_RATIO, refit};
use crate::report::peak_rss_bytes;
use serde::Serialize;
use std::path::Path;
use std::time::Instant;

/// Runs of what is over in no time go on until they have taken so many seconds, or were so many.
const ENOUGH_SECONDS: f64 = 0.3;
const MOST_RUNS: usize = 15;

/// Seconds of a reduction, files not counted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Seconds {
    /// Threads.
    pub threads: usize,
    /// Faces that are left.
    pub faces: usize,
    /// Until the first collapse.
    pub initialisation: f64,
    /// From there to the count, and the refit.
    pub simplification: f64,
}

impl Seconds {
    /// All.
    pub fn total(&self) -> f64 {
        self.initialisation + self.simplification
    }
}

/// A model in memory.
pub(super) struct Model {
    pub mesh: IndexedMesh<f32>,
    frame: Frame,
}

/// How it is reduced.
#[derive(Clone, Copy)]
pub(super) struct Ask {
    pub threads: usize,
    pub policies: Policies,
    pub runs: usize,
}

impl Model {
    pub fn load(path: &Path, progress: &Progress) -> Result<Model> {
        let scan = Scan::open(path, progress)?;
        let crew = Crew { workers: 1, progress };
        // Only soups can be more than is asked for.
        let (mesh, frame, _) = load(&scan, &crew, u64::MAX)?.ok_or_else(|| Error::input(path, "is too large"))?;
        Ok(Model { mesh, frame })
    }

    /// The medians of several runs to each of these counts. Initialisation is what it takes to reduce to as many faces as
    /// there are, as in the thesis.
    pub fn timed(&self, counts: &[usize], ask: Ask, progress: &Progress) -> Result<Vec<Seconds>> {
        on_threads(ask.threads, || {
            let all = self.mesh.faces.len();
            let initialisation = median(ask.runs, || self.once(all, ask, progress))?;
            let seconds = |&faces: &usize| {
                let total = median(ask.runs, || self.once(faces, ask, progress))?;
                let simplification = (total - initialisation).max(0.0);
                Ok(Seconds { threads: ask.threads, faces, initialisation, simplification })
            };
            counts.iter().map(seconds).collect()
        })
    }

    /// Seconds of one run.
    fn once(&self, faces: usize, ask: Ask, progress: &Progress) -> Result<f64> {
        let mesh = self.mesh.clone();
        let begun = Instant::now();
        let reduced = reduced(mesh, self.frame, faces, ask.policies, progress)?;
        let seconds = begun.elapsed().as_secs_f64();
        // Where faces are contracted, two go at a time, or four.
        let least = if ask.policies.primitive == Primitive::Face { 4 } else { 2 };
        let found = reduced.faces.len();
        if found > faces || found + least < faces.min(self.mesh.faces.len()) {
            return Err(Error::usage(format!("{found} faces are left, and {faces} were asked for")));
        }
        Ok(seconds)
    }

    /// Bytes a vertex that a complete decimation takes, the model itself and all that is resident counted; where the
    /// system does not tell, what the arrays should take.
    pub fn bytes_a_vertex(path: &Path, progress: &Progress) -> Result<f64> {
        let own = || rss_bytes(std::process::id());
        let before = own();
        let Model { mesh, frame } = Model::load(path, progress)?;
        let (faces, vertices) = (mesh.faces.len() as u64, mesh.positions.len() as u64);
        reset_peak();
        on_threads(1, || reduced(mesh, frame, 0, Policies::default(), progress))?;
        let taken = before.zip(peak_rss_bytes()).map(|(before, peak)| peak.saturating_sub(before));
        let bytes = taken.unwrap_or_else(|| collapse::bytes::<f32>(faces, vertices));
        Ok(bytes as f64 / vertices as f64)
    }
}

/// The collapse, and the refit where there is one by default.
fn reduced(
    mesh: IndexedMesh<f32>,
    frame: Frame,
    faces: usize,
    policies: Policies,
    progress: &Progress,
) -> Result<IndexedMesh<f32>> {
    let rounds = if policies.placement == Placement::Endpoint { 0 } else { DEFAULT_REFIT_ROUNDS };
    let keep_reference = rounds > 0 && faces > 0 && faces.saturating_mul(LEAST_RATIO) <= mesh.faces.len();
    let options =
        collapse::Options { policies: policies.in_frame(frame), keep_reference, ..collapse::Options::to(faces) };
    let Collapsed { mut mesh, mut wedges, reference, locked, .. } = collapse(mesh, None, &options, progress)?;
    let aim = Aim { reference: reference.as_ref(), samples: None };
    refit(&mut mesh, &aim, rounds, Held { locked: &locked, wedges: &mut wedges }, progress)?;
    Ok(mesh)
}

/// The median of at least so many runs.
pub(super) fn median(runs: usize, mut run: impl FnMut() -> Result<f64>) -> Result<f64> {
    let mut seconds = Vec::new();
    let begun = Instant::now();
    while seconds.len() < runs
        || runs > 1 && seconds.len() < MOST_RUNS && begun.elapsed().as_secs_f64() < ENOUGH_SECONDS
    {
        seconds.push(run()?);
    }
    seconds.sort_by(f64::total_cmp);
    Ok(seconds.get(seconds.len() / 2).copied().unwrap_or(0.0))
}
