//! The morning's report, as facts: a row a scan. [`crate::report`] words it.

use super::ledger::{Fingerprint, Ledger};
use super::plan::{Plan, Task, quoted};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// What became of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Status {
    /// Reduced as asked.
    Done,
    /// Reduced, but not as far or as closely as was asked.
    Unmet,
    /// Not reduced.
    Failed,
    /// Not begun: the night was over, or was ended.
    NotBegun,
}

impl Status {
    /// As people read it.
    pub fn word(self) -> &'static str {
        match self {
            Status::Done => "done",
            Status::Unmet => "not as asked",
            Status::Failed => "failed",
            Status::NotBegun => "not begun",
        }
    }
}

/// Why a scan was not reduced as asked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trouble {
    /// A stable word: those of a reduction, and `crash`, `memory`, `time`, `changed`.
    pub code: String,
    /// What happened.
    pub message: String,
    /// Whether another try may go better.
    pub may_pass: bool,
}

impl Trouble {
    /// Of that kind.
    pub(super) fn new(code: &str, message: impl Into<String>, may_pass: bool) -> Trouble {
        Trouble { code: code.into(), message: message.into(), may_pass }
    }

    /// Whether the same scan with the same options fails again.
    pub(super) fn is_lasting(&self) -> bool {
        ["bad-input", "unmet", "budget", "usage"].contains(&self.code.as_str())
    }
}

/// A result.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutputFile {
    /// The mesh.
    pub path: PathBuf,
    /// What it was when it was finished; `None` where it was not.
    pub print: Option<Fingerprint>,
}

/// A scan and what became of it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// The scan.
    pub scan: PathBuf,
    /// What became of it.
    pub status: Status,
    /// Its results, the finest first.
    pub outputs: Vec<OutputFile>,
    /// The scan as it was read.
    pub input: Option<Fingerprint>,
    /// Tells options apart.
    pub options: String,
    /// Bound on the peak resident set of its process.
    pub budget: u64,
    /// The peak.
    pub peak_rss_bytes: Option<u64>,
    /// When it began, seconds since 1970.
    pub began: f64,
    /// How long its last try took.
    pub seconds: f64,
    /// Tries.
    pub tries: u32,
    /// The object that a reduction reports.
    pub report: Option<Value>,
    /// Why it was not reduced as asked.
    pub error: Option<Trouble>,
    /// What should be known beside the report's own warnings.
    pub warnings: Vec<String>,
    /// The picture, in the night's folder.
    pub picture: Option<PathBuf>,
    /// The command that does this scan again.
    pub repeat: String,
}

impl Row {
    /// A row of which nothing is known but the task.
    pub(super) fn of(plan: &Plan, task: &Task) -> Row {
        Row {
            scan: task.scan.clone(),
            status: Status::NotBegun,
            outputs: task.outputs.iter().map(|path| OutputFile { path: path.clone(), print: None }).collect(),
            input: Fingerprint::glance(&task.scan).ok(),
            options: task.options.clone(),
            budget: task.budget.0,
            peak_rss_bytes: None,
            began: super::clock::now(),
            seconds: 0.0,
            tries: 0,
            report: None,
            error: None,
            warnings: Vec::new(),
            picture: None,
            repeat: repeat(&plan.job_file, &task.scan),
        }
    }

    /// All warnings, as people read them.
    pub fn all_warnings(&self) -> Vec<String> {
        let reported = self.fact("/warnings").and_then(Value::as_array).into_iter().flatten();
        let texts = reported.filter_map(|warning| warning["text"].as_str().map(String::from));
        texts.chain(self.warnings.iter().cloned()).collect()
    }

    /// A fact of the reduction's report.
    pub fn fact(&self, pointer: &str) -> Option<&Value> {
        self.report.as_ref()?.pointer(pointer).filter(|value| !value.is_null())
    }

    /// A number of the reduction's report.
    pub fn number(&self, pointer: &str) -> Option<f64> {
        self.fact(pointer)?.as_f64()
    }

    /// Size of all results.
    pub fn output_bytes(&self) -> u64 {
        self.outputs.iter().filter_map(|output| Some(output.print.as_ref()?.bytes)).sum()
    }
}

/// A command line as a shell takes it.
fn repeat(job_file: &Path, scan: &Path) -> String {
    let job_file = std::path::absolute(job_file).unwrap_or_else(|_| job_file.into());
    format!("meshmill run {} --only {}", quoted(&job_file), quoted(scan))
}

/// Sums over the rows.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Totals {
    /// Scans.
    pub scans: u64,
    /// Reduced as asked.
    pub done: u64,
    /// Reduced otherwise.
    pub unmet: u64,
    /// Not reduced.
    pub failed: u64,
    /// Not begun.
    pub not_begun: u64,
    /// Faces of the scans that were reduced.
    pub faces: u64,
    /// Faces of their finest results.
    pub result_faces: u64,
    /// Bytes of the scans that were reduced.
    pub bytes: u64,
    /// Bytes of all results.
    pub result_bytes: u64,
    /// Seconds of all scans together.
    pub seconds: f64,
}

impl Totals {
    fn of(rows: &[Row]) -> Totals {
        let mut totals = Totals { scans: rows.len() as u64, ..Default::default() };
        for row in rows {
            match row.status {
                Status::Done => totals.done += 1,
                Status::Unmet => totals.unmet += 1,
                Status::Failed => totals.failed += 1,
                Status::NotBegun => totals.not_begun += 1,
            }
            totals.faces += row.fact("/input/faces").and_then(Value::as_u64).unwrap_or(0);
            totals.result_faces += row.fact("/output/faces").and_then(Value::as_u64).unwrap_or(0);
            totals.bytes += row.report.as_ref().and(row.input.as_ref()).map_or(0, |input| input.bytes);
            totals.result_bytes += row.output_bytes();
            totals.seconds += row.seconds;
        }
        totals
    }
}

/// A night's report.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NightReport {
    /// The job file.
    pub job: PathBuf,
    /// When it began, seconds since 1970.
    pub began: f64,
    /// When it ended.
    pub ended: f64,
    /// Why it ended before all was done; `None` where it did not.
    pub ended_early: Option<String>,
    /// Bound on the peak resident set of all processes together.
    pub memory: u64,
    /// The peak.
    pub peak_rss_bytes: u64,
    /// Scans side by side.
    pub workers: usize,
    /// Sums.
    pub totals: Totals,
    /// What was resident: seconds since 1970 and bytes, at the peaks of stretches of time.
    pub resident: Vec<(f64, u64)>,
    /// The scans, in the order of their names.
    pub rows: Vec<Row>,
}

impl NightReport {
    /// What the ledger says of a plan's scans.
    pub(super) fn of(plan: &Plan, ledger: &Ledger, resident: Vec<(f64, u64)>, ended_early: Option<String>) -> Self {
        let row = |task: &Task| ledger.standing(task).cloned().unwrap_or_else(|| Row::of(plan, task));
        let rows: Vec<Row> = plan.tasks.iter().map(row).collect();
        let resident: Vec<_> = ledger.memory().iter().copied().chain(resident).collect();
        NightReport {
            job: plan.job_file.clone(),
            began: ledger.began(),
            ended: super::clock::now(),
            ended_early,
            memory: plan.memory.0,
            peak_rss_bytes: resident.iter().map(|(_, bytes)| *bytes).max().unwrap_or(0),
            workers: plan.workers,
            totals: Totals::of(&rows),
            resident,
            rows,
        }
    }

    /// Whether every scan was done as asked; of those alone whose path contains `only`, where that is said.
    pub fn is_complete(&self, only: Option<&str>) -> bool {
        let meant = |row: &&Row| only.is_none_or(|only| row.scan.to_string_lossy().contains(only));
        self.rows.iter().filter(meant).all(|row| row.status == Status::Done)
    }
}

/// Joins the reports of shards. A scan that several have is taken from the one that did the most with it.
pub fn merge(reports: Vec<NightReport>) -> Result<NightReport> {
    let mut reports = reports.into_iter();
    let mut merged = reports.next().ok_or_else(|| Error::usage("no report to merge"))?;
    for report in reports {
        merged.began = merged.began.min(report.began);
        merged.ended = merged.ended.max(report.ended);
        merged.ended_early = merged.ended_early.or(report.ended_early);
        // Shards run on machines of their own.
        merged.memory = merged.memory.max(report.memory);
        merged.peak_rss_bytes = merged.peak_rss_bytes.max(report.peak_rss_bytes);
        merged.workers = merged.workers.max(report.workers);
        merged.resident.extend(report.resident);
        merged.rows.extend(report.rows);
    }
    let done = |row: &Row| match row.status {
        Status::Done => 0,
        Status::Unmet => 1,
        Status::Failed => 2,
        Status::NotBegun => 3,
    };
    merged.rows.sort_by(|a, b| (&a.scan, done(a)).cmp(&(&b.scan, done(b))).then(b.began.total_cmp(&a.began)));
    merged.rows.dedup_by(|next, kept| next.scan == kept.scan);
    merged.resident.sort_by(|a, b| a.0.total_cmp(&b.0));
    merged.totals = Totals::of(&merged.rows);
    Ok(merged)
}
