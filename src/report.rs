//! What is said about a run: the report, its warnings, and all their wording. Only `main` prints it.
//!
//! The JSON keys are a contract with scripts: [`SCHEMA`] changes when one of them does.

mod comparison;
mod inspection;
mod warning;

pub use comparison::{
    ComparisonReport, ComparisonTimeline, DeviationFigures, HeatmapFile, Shares, WayFigures, WayShares,
};
pub use inspection::{BoxFigures, InspectionReport, ReductionFigures, SurfaceFigures, UnsaidFigure};
pub use warning::Warning;

use serde::{Deserialize, Serialize, Serializer};
use std::path::{Path, PathBuf};

use crate::budget::Size;
use crate::error::Error;

/// The version of the JSON objects' layout.
pub const SCHEMA: u32 = 1;

/// What a reduction did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The scan.
    pub input: MeshFile,
    /// The result.
    pub output: MeshFile,
    /// Further results, each coarser than the one before it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub coarser: Vec<LevelReport>,
    /// Whether the scan was clustered first.
    pub mode: Mode,
    /// Cells that clustering filled; `None` in core.
    pub cells: Option<u64>,
    /// Tiles of the last sweep, where the result was made in tiles.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tiles: Option<u64>,
    /// Faces of the intermediate mesh over those of the result; `None` in core.
    pub ratio: Option<f64>,
    /// Worker threads.
    pub threads: usize,
    /// What `--memory` allowed.
    pub memory_budget_bytes: u64,
    /// The process's peak resident set ([`peak_rss_bytes`]); `None` where the system does not say.
    pub peak_rss_bytes: Option<u64>,
    /// Most bytes that spills took on disk.
    pub scratch_bytes: u64,
    /// Where the time went.
    pub seconds: Timeline,
    /// Estimated largest distance between scan and result in the scan's units: √(largest cost ÷ its area). `None` where
    /// nothing supports an estimate.
    pub error_estimate: Option<f64>,
    /// What was measured between scan and result; `None` where nobody asked for it.
    pub deviation: Option<DeviationFigures>,
    /// The picture that was taken.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub portrait: Option<PortraitFile>,
    /// What the user should know.
    pub warnings: Vec<Warning>,
    /// Why the result, which is written, is not what was asked for.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub unmet: Option<Failure>,
}

/// One more result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LevelReport {
    /// The mesh.
    pub output: MeshFile,
    /// As a [`Report`]'s.
    pub error_estimate: Option<f64>,
    /// As a [`Report`]'s.
    pub deviation: Option<DeviationFigures>,
}

/// A picture of a scan and what it became.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PortraitFile {
    /// The JPEG.
    #[serde(serialize_with = "lossy")]
    pub path: PathBuf,
    /// What is to be seen, from left to right; below each, the same closer.
    pub views: Vec<&'static str>,
    /// How much closer.
    pub zoom: f64,
    /// The deviation that has the last colour, in the scan's units.
    pub deviation_top: Option<f64>,
}

/// A mesh file and its counts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct MeshFile {
    /// As it was named.
    #[serde(serialize_with = "lossy")]
    pub path: PathBuf,
    /// Faces, as the file counts them.
    pub faces: u64,
    /// Vertices.
    pub vertices: u64,
}

/// The way a scan went through the mill.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// The scan fitted the budget: welded and collapsed.
    InCore,
    /// Streamed through clustering, then collapsed.
    OutOfCore,
}

/// Wall-clock seconds by stage.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Timeline {
    /// Opening and, in core, loading and welding.
    pub read: f64,
    /// Clustering; 0 in core.
    pub cluster: f64,
    /// Collapse.
    pub collapse: f64,
    /// Refit.
    pub refit: f64,
    /// Carrying over what vertices carry.
    pub carry: f64,
    /// Encoding, syncing, renaming.
    pub write: f64,
    /// Measuring the result; 0 where nobody asked for it.
    pub measure: f64,
    /// Taking pictures; 0 where nobody asked for them.
    pub render: f64,
    /// From the first byte to the report.
    pub total: f64,
}

impl Report {
    /// A few plain lines of what happened.
    pub fn lines(&self) -> Vec<String> {
        let seconds = &self.seconds;
        let mut lines = vec![
            format!("scan     {}", self.input.line()),
            format!("mode     {}", self.mode_line()),
            format!("result   {}", self.output.line()),
        ];
        if let Some(error) = self.error_estimate.filter(|x| x.is_finite()) {
            lines.push(format!("error    about {}, in the scan's units, as estimated", significant(error)));
        }
        if let Some(deviation) = &self.deviation {
            let measured = deviation.lines("scan", "result");
            lines.extend(measured.into_iter().map(|line| format!("measured {line}")));
        }
        let measure =
            if self.deviation.is_some() { format!(", measure {:.2}", seconds.measure) } else { String::new() };
        let carry = if seconds.carry >= 0.005 { format!("carry {:.2}, ", seconds.carry) } else { String::new() };
        lines.push(format!(
            "time     {:.2} s: read {:.2}, cluster {:.2}, collapse {:.2}, refit {:.2}, {carry}write {:.2}{measure}; {}",
            seconds.total,
            seconds.read,
            seconds.cluster,
            seconds.collapse,
            seconds.refit,
            seconds.write,
            count(self.threads as u64, "thread"),
        ));
        let peak = self.peak_rss_bytes.map_or("unknown".into(), |bytes| Size(bytes).to_string());
        let (budget, scratch) = (Size(self.memory_budget_bytes), Size(self.scratch_bytes));
        lines.push(format!("memory   {peak} at the peak, of {budget}; {scratch} of scratch on disk"));
        for level in &self.coarser {
            lines.push(format!("coarser  {}", level.output.line()));
            let measured = level.deviation.iter().flat_map(|deviation| deviation.lines("scan", "result"));
            lines.extend(measured.map(|line| format!("measured {line}")));
        }
        lines.extend(self.warnings.iter().map(|w| format!("warning  {w}")));
        lines
    }

    fn mode_line(&self) -> String {
        let cells = self.cells.map_or(String::new(), |n| format!(", {}", count(n, "cell")));
        let ratio = self.ratio.map_or(String::new(), |r| format!(", {r:.1} times the faces of the result"));
        match self.mode {
            Mode::InCore => "in core: the scan fits the budget".into(),
            Mode::OutOfCore => {
                let tiles = self.tiles.map_or(String::new(), |n| format!(", {}", count(n, "tile")));
                format!("out of core{cells}{tiles}{ratio}")
            }
        }
    }
}

impl MeshFile {
    fn line(&self) -> String {
        format!("{}: {}, {}", self.path.display(), count(self.faces, "face"), count(self.vertices, "vertex"))
    }
}

/// What `synth` made.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Synthesis {
    /// The scan that was written.
    pub output: MeshFile,
    /// Size of the file.
    pub bytes: u64,
    /// The seed: the same seed and count give the same bytes.
    pub seed: u64,
    /// Wall-clock seconds.
    pub seconds: f64,
}

impl Synthesis {
    /// One plain line.
    pub fn line(&self) -> String {
        format!("{}, {}, {:.2} s", self.output.line(), count(self.bytes, "byte"), self.seconds)
    }
}

/// What `render` made.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderReport {
    /// The meshes, from left to right.
    pub meshes: Vec<MeshFile>,
    /// The picture that was written.
    #[serde(serialize_with = "lossy")]
    pub picture: PathBuf,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Size of the file.
    pub bytes: u64,
    /// The process's peak resident set.
    pub peak_rss_bytes: Option<u64>,
    /// Wall-clock seconds.
    pub seconds: f64,
}

impl RenderReport {
    /// One plain line.
    pub fn line(&self) -> String {
        let RenderReport { width, height, bytes, seconds, .. } = self;
        format!("{}: {width} × {height} pixels, {}, {seconds:.2} s", self.picture.display(), count(*bytes, "byte"))
    }
}

/// The JSON object of anything that is reported: `schema` and `version`, then its own keys. Numbers that are not finite
/// come out as `null`.
pub fn json(body: &impl Serialize) -> String {
    #[derive(Serialize)]
    struct Object<'a, T> {
        schema: u32,
        version: &'static str,
        #[serde(flatten)]
        body: &'a T,
    }
    let object = Object { schema: SCHEMA, version: env!("CARGO_PKG_VERSION"), body };
    // Only paths that are not Unicode and maps without string keys fail to serialise; what is reported has neither.
    serde_json::to_string(&object).unwrap_or_default()
}

/// A failure as scripts read it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Failure {
    error: FailureFacts,
}

#[derive(Debug, Clone, PartialEq, Serialize)]
struct FailureFacts {
    code: &'static str,
    message: String,
    file: Option<String>,
    byte: Option<u64>,
}

impl Failure {
    /// What went wrong.
    pub fn message(&self) -> &str {
        &self.error.message
    }
}

impl From<&Error> for Failure {
    fn from(error: &Error) -> Self {
        Failure {
            error: FailureFacts {
                code: error.code(),
                message: error.to_string(),
                file: error.file().map(|path| path.to_string_lossy().into_owned()),
                byte: error.byte(),
            },
        }
    }
}

/// The process's peak resident set so far, input pages included; `None` where the system does not say.
pub fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
    kib.checked_mul(1024)
}

/// Paths that are not Unicode are shown as well as they can be rather than failing a finished run.
fn lossy<S: Serializer>(path: &Path, out: S) -> Result<S::Ok, S::Error> {
    out.serialize_str(&path.to_string_lossy())
}

/// `1 face`, `28,060,000 faces`, `2 vertices`.
pub fn count(n: u64, noun: &str) -> String {
    match (n, noun.strip_suffix("ex")) {
        (1, _) => format!("1 {noun}"),
        (_, Some(stem)) => format!("{} {stem}ices", grouped(n)),
        (_, None) => format!("{} {noun}s", grouped(n)),
    }
}

/// Thousands apart.
fn grouped(n: u64) -> String {
    let digits = n.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Three significant digits, without an exponent where people can read it without.
fn significant(x: f64) -> String {
    match x.abs() {
        0.0 => "0".into(),
        size if (1e-4..1e6).contains(&size) => {
            let decimals = (2 - size.log10().floor() as i32).max(0) as usize;
            format!("{x:.decimals$}")
        }
        _ => format!("{x:.2e}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report() -> Report {
        Report {
            input: MeshFile { path: "scan.ply".into(), faces: 28_060_000, vertices: 14_030_002 },
            output: MeshFile { path: "small.ply".into(), faces: 140_000, vertices: 70_002 },
            coarser: Vec::new(),
            mode: Mode::OutOfCore,
            cells: Some(812_345),
            tiles: None,
            ratio: Some(11.6),
            threads: 2,
            memory_budget_bytes: 256 << 20,
            peak_rss_bytes: Some(201 << 20),
            scratch_bytes: 112_240_016,
            seconds: Timeline {
                read: 0.1,
                cluster: 0.5,
                collapse: 0.5,
                refit: 0.25,
                carry: 0.0,
                write: 0.05,
                measure: 0.0,
                render: 0.0,
                total: 1.4,
            },
            error_estimate: Some(0.012_345),
            deviation: None,
            portrait: None,
            warnings: vec![Warning::TrailingBytes { bytes: 1 }],
            unmet: None,
        }
    }

    #[test]
    fn json_has_the_keys_that_scripts_rely_on() {
        let version = env!("CARGO_PKG_VERSION");
        let expected = format!(
            r#"{{"schema":1,"version":"{version}","input":{{"path":"scan.ply","faces":28060000,"vertices":14030002}},"#
        ) + r#""output":{"path":"small.ply","faces":140000,"vertices":70002},"mode":"out-of-core","cells":812345,"#
            + r#""ratio":11.6,"threads":2,"memory_budget_bytes":268435456,"peak_rss_bytes":210763776,"#
            + r#""scratch_bytes":112240016,"seconds":{"read":0.1,"cluster":0.5,"collapse":0.5,"refit":0.25,"carry":0.0,"write":0.05,"#
            + r#""measure":0.0,"render":0.0,"total":1.4},"error_estimate":0.012345,"deviation":null,"warnings":[{"code":"trailing-bytes","text":"1 byte after the "#
            + r#"last element ignored: if the scan looks cut short, its header counts too few"}]}"#;
        assert_eq!(json(&report()), expected);
    }

    #[test]
    fn what_is_not_finite_or_not_known_is_null() {
        let in_core = Report {
            mode: Mode::InCore,
            cells: None,
            tiles: None,
            ratio: Some(f64::INFINITY),
            error_estimate: Some(f64::NAN),
            peak_rss_bytes: None,
            ..report()
        };
        let text = json(&in_core);
        assert!(text.contains(r#""mode":"in-core","cells":null,"ratio":null"#), "{text}");
        assert!(text.contains(r#""error_estimate":null"#) && text.contains(r#""peak_rss_bytes":null"#), "{text}");
    }

    #[test]
    fn words_say_the_same() {
        assert_eq!(
            report().lines(),
            [
                "scan     scan.ply: 28,060,000 faces, 14,030,002 vertices",
                "mode     out of core, 812,345 cells, 11.6 times the faces of the result",
                "result   small.ply: 140,000 faces, 70,002 vertices",
                "error    about 0.0123, in the scan's units, as estimated",
                "time     1.40 s: read 0.10, cluster 0.50, collapse 0.50, refit 0.25, write 0.05; 2 threads",
                "memory   201MiB at the peak, of 256MiB; 108MiB of scratch on disk",
                "warning  1 byte after the last element ignored: if the scan looks cut short, its header counts too few",
            ]
        );
    }

    #[test]
    fn a_failure_names_file_and_byte() {
        let item = crate::error::Item { kind: "face", ordinal: 7 };
        let error = Error::input_at(Path::new("a.ply"), item, 99, "index 9, but the file has 9 vertices");
        let text = json(&Failure::from(&error));
        let message = "a.ply: face 7 (byte 99): index 9, but the file has 9 vertices";
        let tail = format!(r#""error":{{"code":"bad-input","message":"{message}","file":"a.ply","byte":99}}}}"#);
        assert!(text.ends_with(&tail), "{text}");
        let text = json(&Failure::from(&Error::usage("no")));
        assert!(text.ends_with(r#""error":{"code":"usage","message":"no","file":null,"byte":null}}"#), "{text}");
    }

    #[test]
    fn numbers_read_well() {
        assert_eq!(count(1, "vertex"), "1 vertex");
        assert_eq!(count(0, "vertex"), "0 vertices");
        assert_eq!(count(1_234_567, "face"), "1,234,567 faces");
        for (x, text) in [(0.0, "0"), (0.012345, "0.0123"), (12.345, "12.3"), (98765.4, "98765"), (1e-9, "1.00e-9")] {
            assert_eq!(significant(x), text);
        }
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn the_peak_is_that_of_this_process() {
        let peak = peak_rss_bytes().unwrap();
        assert!(peak > 1 << 20 && peak < 1 << 40, "{peak}");
    }
}
