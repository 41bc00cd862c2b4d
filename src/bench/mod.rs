//! Benchmarks of one shot each: how long stages take beside what is printed of others, and what is resident meanwhile.
//!
//! [`table_6_3`] is Table 6.3 of Garland's thesis: twelve models *decimated completely to 0 faces*, seconds without input
//! and output, initialisation and simplification apart; and beside it what Figures 6.2 to 6.6 and Table 6.2 show. As in the
//! thesis, *initialisation* is what it takes to reduce a model to as many faces as it has, and *simplification* the rest.
//! Models that are not at hand are made by [`synth`](crate::synth) with as many faces. [`Table63Options::continued`] goes
//! on where the thesis stops, within one budget for all sizes.
//!
//! **What is not alike.** The thesis's machine had one core of 200 MHz: the first of our columns is of one thread. On the way
//! to 0 faces the collapse is far from its target all the time and takes its largest strides; curves of time against output
//! size have the steps near the target, and the refit. Out of core reading cannot be told apart from clustering, and counts as
//! initialisation; writing does not count.

mod chart;
mod lines;
mod thesis;
mod timing;

pub use thesis::{BYTES_A_VERTEX, Group, TABLE, ThesisRow};
pub use timing::Seconds;

use crate::budget::Size;
use crate::collapse::{Placement, Policies, Primitive};
use crate::error::{Error, Result};
use crate::mesh::IndexedMesh;
use crate::progress::{Progress, Stage};
use crate::read::{Crew, Scan};
use crate::report::{Mode, Timeline};
use crate::synth::synth;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;
use timing::{Ask, Model, median};

/// Output sizes of the curves, as shares of the model.
const SHARES: [f64; 7] = [0.75, 0.5, 0.25, 0.1, 0.05, 0.01, 0.0];

/// Faces of a continued scan for each that is asked for.
const CONTINUED_RATIO: u64 = 500;

/// What is measured.
#[derive(Debug, Clone, PartialEq)]
pub struct Table63Options {
    /// A folder with `bunny.ply` and the others; what is not there is made.
    pub models: Option<PathBuf>,
    /// Larger scans, by their faces.
    pub continued: Vec<u64>,
    /// The program that reduces those, each in a process of its own.
    pub program: PathBuf,
    /// Bound on resident memory for those.
    pub memory: Size,
    /// Threads of the second column, and of larger scans.
    pub threads: usize,
    /// Runs that medians are of, at least.
    pub runs: usize,
    /// Where models are made, in a folder that is removed.
    pub scratch: PathBuf,
    /// Faces of a model at most, for a try.
    pub most_faces: u64,
}

/// All that is measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table63 {
    /// Threads of the second column.
    pub threads: usize,
    /// Runs that medians are of, at least.
    pub runs: usize,
    /// The twelve models.
    pub models: Vec<ModelRow>,
    /// How times grow with faces: the exponents of Figure 6.5.
    pub exponents: Exponents,
    /// Placement policies on the bunny (Figure 6.6): seconds of one thread.
    pub policies: Vec<PolicyCurve>,
    /// Bytes a vertex at the peak, of the largest model; the thesis's are 268.
    pub bytes_a_vertex: f64,
    /// A pass over the faces of the largest model that does nothing but add up areas.
    pub floor: Floor,
    /// Larger scans.
    pub continued: Vec<ContinuedRow>,
}

/// A model of the thesis, there and here.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelRow {
    /// What the thesis reports.
    pub thesis: ThesisRow,
    /// The file that was read; `None` where the model was made.
    pub file: Option<PathBuf>,
    /// Its vertices.
    pub vertices: u64,
    /// Its faces.
    pub faces: u64,
    /// Complete decimation, on one thread and on all.
    pub complete: [Seconds; 2],
    /// The figure that the curve is in.
    pub group: Group,
    /// One thread's time against output size (Figures 6.2 to 6.4), refitted as by default.
    pub curve: Vec<Seconds>,
}

/// A placement policy's time against output size.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PolicyCurve {
    /// As the thesis calls it.
    pub policy: &'static str,
    /// Of the bunny.
    pub curve: Vec<Seconds>,
}

/// Seconds grow like this power of the faces.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Exponents {
    /// In the thesis.
    pub thesis: f64,
    /// On one thread.
    pub one_thread: f64,
    /// On all.
    pub all_threads: f64,
    /// Of larger scans that are clustered, where there are several.
    pub continued: Option<f64>,
}

/// Seconds of a pass that reads the corners of every face in the mapped file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Floor {
    /// Faces.
    pub faces: u64,
    /// On one thread.
    pub one_thread: f64,
    /// On two.
    pub two_threads: f64,
}

/// A scan larger than the thesis's.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ContinuedRow {
    /// Its faces.
    pub faces: u64,
    /// Faces of the result.
    pub target: u64,
    /// Whether it was clustered first.
    pub mode: Mode,
    /// Bound on resident memory.
    pub memory_budget_bytes: u64,
    /// What was resident at the peak of any run.
    pub peak_rss_bytes: Option<u64>,
    /// What was on scratch at the peak.
    pub scratch_bytes: u64,
    /// Stages.
    pub seconds: Timeline,
    /// The pass beside them; `None` where the file's positions are too much to be resident.
    pub floor: Option<Floor>,
}

impl ContinuedRow {
    /// Reading and clustering.
    pub fn initialisation(&self) -> f64 {
        self.seconds.read + self.seconds.cluster
    }

    /// Collapse and refit.
    pub fn simplification(&self) -> f64 {
        self.seconds.collapse + self.seconds.refit
    }

    /// Both.
    pub fn total(&self) -> f64 {
        self.initialisation() + self.simplification()
    }
}

/// A larger file's positions are not made resident for the floor.
const FLOOR_BYTES: u64 = 4 << 30;

/// Measures.
pub fn table_6_3(options: &Table63Options, progress: &Progress) -> Result<Table63> {
    let folder = tempfile::Builder::new().prefix(".meshmill-bench-").tempdir_in(&options.scratch);
    let folder = folder.map_err(Error::io(&options.scratch, "cannot make a folder"))?;
    let bench = Bench { options, folder, progress };
    // The largest first: what allocators keep of others would hide what it takes.
    let (largest, _) = bench.model(&TABLE[TABLE.len() - 1])?;
    let bytes_a_vertex = Model::bytes_a_vertex(&largest, progress)?;
    let floor = bench.floor(&largest)?.ok_or_else(|| Error::input(&largest, "is not a plain binary PLY"))?;
    let models = TABLE.iter().map(|thesis| bench.row(thesis)).collect::<Result<Vec<_>>>()?;
    let policies = bench.policies()?;
    let continued = options.continued.iter().map(|faces| bench.goes_on(*faces)).collect::<Result<Vec<_>>>()?;
    let of = |seconds: &dyn Fn(&ModelRow) -> f64| {
        exponent(models.iter().map(|row| (row.faces as f64, seconds(row)))).unwrap_or(f64::NAN)
    };
    let exponents = Exponents {
        thesis: exponent(TABLE.iter().map(|row| (row.faces as f64, row.total()))).unwrap_or(f64::NAN),
        one_thread: of(&|row| row.complete[0].total()),
        all_threads: of(&|row| row.complete[1].total()),
        continued: exponent(
            continued.iter().filter(|row| row.mode == Mode::OutOfCore).map(|row| (row.faces as f64, row.total())),
        ),
    };
    let Table63Options { threads, runs, .. } = *options;
    Ok(Table63 { threads, runs, models, exponents, policies, bytes_a_vertex, floor, continued })
}

struct Bench<'a> {
    options: &'a Table63Options,
    folder: TempDir,
    progress: &'a Progress,
}

impl Bench<'_> {
    /// The model's file, and whether it is a real one.
    fn model(&self, thesis: &ThesisRow) -> Result<(PathBuf, bool)> {
        let name = format!("{}.ply", thesis.file);
        let real = self.options.models.as_ref().map(|folder| folder.join(&name)).filter(|path| path.is_file());
        if let Some(real) = real.filter(|_| thesis.faces <= self.options.most_faces) {
            return Ok((real, true));
        }
        let path = self.folder.path().join(&name);
        if !path.is_file() {
            synth(&path, thesis.faces.min(self.options.most_faces), 0, self.progress)?;
        }
        Ok((path, false))
    }

    fn row(&self, thesis: &ThesisRow) -> Result<ModelRow> {
        let (path, real) = self.model(thesis)?;
        let model = Model::load(&path, self.progress)?;
        let complete = |threads| Ok(self.timed(&model, &[0], threads, Policies::default())?[0]);
        let IndexedMesh { positions, faces } = &model.mesh;
        Ok(ModelRow {
            thesis: *thesis,
            file: real.then_some(path),
            vertices: positions.len() as u64,
            faces: faces.len() as u64,
            complete: [complete(1)?, complete(self.options.threads)?],
            group: thesis.group(),
            curve: self.curve(&model, Policies::default())?,
        })
    }

    fn timed(&self, model: &Model, counts: &[usize], threads: usize, policies: Policies) -> Result<Vec<Seconds>> {
        model.timed(counts, Ask { threads, policies, runs: self.options.runs }, self.progress)
    }

    fn curve(&self, model: &Model, policies: Policies) -> Result<Vec<Seconds>> {
        let faces = model.mesh.faces.len() as f64;
        self.timed(model, &SHARES.map(|share| (faces * share) as usize), 1, policies)
    }

    fn policies(&self) -> Result<Vec<PolicyCurve>> {
        let bunny = TABLE.iter().find(|row| row.file == "bunny").unwrap_or(&TABLE[0]);
        let model = Model::load(&self.model(bunny)?.0, self.progress)?;
        let placed = |placement| Policies { placement, ..Policies::default() };
        let faces = Policies { primitive: Primitive::Face, ..Policies::default() };
        [
            ("optimal placement", placed(Placement::Optimal)),
            ("on the edge", placed(Placement::Line)),
            ("ends or middle", placed(Placement::EndpointOrMidpoint)),
            ("ends (subset)", placed(Placement::Endpoint)),
            ("faces, optimal", faces),
        ]
        .into_iter()
        .map(|(policy, policies)| Ok(PolicyCurve { policy, curve: self.curve(&model, policies)? }))
        .collect()
    }

    fn floor(&self, path: &Path) -> Result<Option<Floor>> {
        let scan = Scan::open(path, self.progress)?;
        if scan.vertex_count() * 12 > FLOOR_BYTES {
            return Ok(None);
        }
        let faces = scan.triangle_count();
        let mut plain = true;
        let mut pass = |workers| {
            median(self.options.runs, || {
                let begun = Instant::now();
                let area = scan.mapped_area(&Crew { workers, progress: self.progress })?;
                plain &= area.is_some_and(|area| area > 0.0);
                Ok(begun.elapsed().as_secs_f64())
            })
        };
        let (one_thread, two_threads) = (pass(1)?, pass(2)?);
        Ok(plain.then_some(Floor { faces, one_thread, two_threads }))
    }

    /// A scan of so many faces, made, reduced and removed: the run of median time, and the largest peak.
    fn goes_on(&self, faces: u64) -> Result<ContinuedRow> {
        let [scan, small] = ["scan.ply", "small.ply"].map(|name| self.folder.path().join(name));
        synth(&scan, faces, 0, self.progress)?;
        let floor = self.floor(&scan)?;
        let target = (faces / CONTINUED_RATIO).max(1000).min(faces / 4);
        let runs = (0..self.options.runs.max(1)).map(|_| Ok(self.reduced(&scan, &small, target)?.row(floor)));
        let mut runs: Vec<ContinuedRow> = runs.collect::<Result<_>>()?;
        // Large ones one after another need no more room than the largest.
        std::fs::remove_file(&scan).map_err(Error::io(&scan, "cannot remove"))?;
        let peak_rss_bytes = runs.iter().map(|row| row.peak_rss_bytes).max().flatten();
        runs.sort_by(|a, b| a.total().total_cmp(&b.total()));
        Ok(ContinuedRow { peak_rss_bytes, ..runs[runs.len() / 2] })
    }

    /// Reduces in a process of its own: what allocators keep of rows before would count as resident.
    fn reduced(&self, scan: &Path, small: &Path, target: u64) -> Result<Reduced> {
        let Table63Options { program, memory, threads, .. } = self.options;
        let mut command = Command::new(program);
        command.arg("reduce").arg(scan).arg("-o").arg(small).args(["--json", "--faces", &target.to_string()]);
        command.args(["--memory", &memory.to_string(), "--threads", &threads.to_string()]);
        let started = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn();
        let mut child = started.map_err(Error::io(program, "cannot be started"))?;
        self.progress.begin(Stage::Collapse, 0);
        while child.try_wait().map_err(Error::io(program, "cannot be waited for"))?.is_none() {
            if let Err(stopped) = self.progress.check() {
                // It may have ended by itself.
                let _ = child.kill().and_then(|()| child.wait());
                return Err(stopped);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        // A report is smaller than what a pipe holds.
        let said = child.wait_with_output().map_err(Error::io(program, "cannot be heard"))?.stdout;
        serde_json::from_slice(&said).map_err(|_| {
            Error::input(scan, format!("could not be reduced: {}", String::from_utf8_lossy(&said).trim_end()))
        })
    }
}

/// What is read of a report.
#[derive(Deserialize)]
struct Reduced {
    input: Counted,
    output: Counted,
    mode: Mode,
    memory_budget_bytes: u64,
    peak_rss_bytes: Option<u64>,
    scratch_bytes: u64,
    seconds: Timeline,
}

impl Reduced {
    fn row(&self, floor: Option<Floor>) -> ContinuedRow {
        ContinuedRow {
            faces: self.input.faces,
            target: self.output.faces,
            mode: self.mode,
            memory_budget_bytes: self.memory_budget_bytes,
            peak_rss_bytes: self.peak_rss_bytes,
            scratch_bytes: self.scratch_bytes,
            seconds: self.seconds,
            floor,
        }
    }
}

#[derive(Deserialize)]
struct Counted {
    faces: u64,
}

/// The slope of the line through the logarithms that is closest in the sense of least squares; `None` for fewer than two
/// sizes.
fn exponent(points: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let logs: Vec<(f64, f64)> = points.filter(|(n, t)| *n > 0.0 && *t > 0.0).map(|(n, t)| (n.ln(), t.ln())).collect();
    let count = logs.len() as f64;
    let [x, y] = [logs.iter().map(|p| p.0).sum::<f64>() / count, logs.iter().map(|p| p.1).sum::<f64>() / count];
    let spread: f64 = logs.iter().map(|p| (p.0 - x).powi(2)).sum();
    (spread > 0.0).then(|| logs.iter().map(|p| (p.0 - x) * (p.1 - y)).sum::<f64>() / spread)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponents_are_those_of_powers() {
        let power = |p: f64| exponent((1..9).map(|n| (f64::from(n), 3.0 * f64::from(n).powf(p)))).unwrap();
        assert!((power(1.0) - 1.0).abs() < 1e-12 && (power(1.25) - 1.25).abs() < 1e-12);
        assert_eq!(exponent([(5.0, 1.0)].into_iter()), None);
    }

    #[test]
    fn the_thesis_is_nearly_linear() {
        let slope = exponent(TABLE.iter().map(|row| (row.faces as f64, row.total()))).unwrap();
        assert!((1.0..1.2).contains(&slope), "{slope}");
    }
}
