//! What is said about how far two meshes are from each other.

use serde::Serialize;
use std::path::PathBuf;

use super::{MeshFile, Warning, count, lossy, significant};
use crate::budget::Size;
use crate::measure::{Deviation, Way};

/// What a comparison found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ComparisonReport {
    /// The mesh that shares are of.
    pub a: MeshFile,
    /// The other.
    pub b: MeshFile,
    /// How far they are from each other.
    #[serde(flatten)]
    pub deviation: DeviationFigures,
    /// The seed that drew the samples.
    pub seed: u64,
    /// The heat map, if one was written.
    pub heatmap: Option<HeatmapFile>,
    /// Worker threads.
    pub threads: usize,
    /// What `--memory` allowed.
    pub memory_budget_bytes: u64,
    /// The process's peak resident set; `None` where the system does not say.
    pub peak_rss_bytes: Option<u64>,
    /// Most bytes that spills took on disk.
    pub scratch_bytes: u64,
    /// Where the time went.
    pub seconds: ComparisonTimeline,
    /// What the user should know.
    pub warnings: Vec<Warning>,
}

/// Wall-clock seconds of a comparison.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ComparisonTimeline {
    /// Opening both meshes.
    pub read: f64,
    /// Measuring.
    pub measure: f64,
    /// Writing the heat map.
    pub write: f64,
    /// In all.
    pub total: f64,
}

/// A mesh written with its deviation as colours.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HeatmapFile {
    /// As it was named.
    #[serde(serialize_with = "lossy")]
    pub path: PathBuf,
    /// Which mesh it shows: `a` or `b`.
    pub mesh: &'static str,
    /// Deviations of the first colour and of the last, in the file's units.
    pub range: [f64; 2],
}

/// How far two meshes are from each other, in the file's units and as shares of the first one's diagonal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DeviationFigures {
    /// Mean squared distance over all points of both (thesis, equation 2.8), in squared units.
    pub e_avg: f64,
    /// The largest distance of all (equation 2.7).
    pub e_max: f64,
    /// The mean of both ways' means.
    pub mean: f64,
    /// The root of the mean of both ways' mean squares.
    pub rms: f64,
    /// The same as `e_max`.
    pub max: f64,
    /// Length of the diagonal of the first mesh's box.
    pub diagonal: f64,
    /// Points measured.
    pub samples: u64,
    /// From the first to the second.
    pub a_to_b: WayFigures,
    /// From the second to the first.
    pub b_to_a: WayFigures,
    /// The same as shares.
    pub shares: Shares,
}

/// One way.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct WayFigures {
    /// Mean distance, over the area.
    pub mean: f64,
    /// Root mean square, over the area.
    pub rms: f64,
    /// Largest distance of all points.
    pub max: f64,
    /// Where that is.
    pub max_at: [f64; 3],
    /// Points measured.
    pub samples: u64,
    /// Of those, vertices.
    pub vertices: u64,
}

/// Shares of the diagonal; `e_avg`, of its square.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[allow(missing_docs)]
pub struct Shares {
    pub e_avg: f64,
    pub e_max: f64,
    pub mean: f64,
    pub rms: f64,
    pub max: f64,
    pub a_to_b: WayShares,
    pub b_to_a: WayShares,
}

/// One way's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[allow(missing_docs)]
pub struct WayShares {
    pub mean: f64,
    pub rms: f64,
    pub max: f64,
}

impl From<&Way> for WayFigures {
    fn from(way: &Way) -> Self {
        let Way { mean, rms, max, farthest, vertices, .. } = *way;
        WayFigures { mean, rms, max, max_at: farthest, samples: way.samples(), vertices }
    }
}

impl From<&Deviation> for DeviationFigures {
    fn from(found: &Deviation) -> Self {
        let diagonal = found.diagonal;
        let share = |x: f64| x / diagonal;
        let way = |way: &Way| WayShares { mean: share(way.mean), rms: share(way.rms), max: share(way.max) };
        let (e_avg, e_max, mean, rms) = (found.e_avg(), found.e_max(), found.mean(), found.rms());
        DeviationFigures {
            e_avg,
            e_max,
            mean,
            rms,
            max: e_max,
            diagonal,
            samples: found.samples(),
            a_to_b: (&found.a_to_b).into(),
            b_to_a: (&found.b_to_a).into(),
            shares: Shares {
                e_avg: share(share(e_avg)),
                e_max: share(e_max),
                mean: share(mean),
                rms: share(rms),
                max: share(e_max),
                a_to_b: way(&found.a_to_b),
                b_to_a: way(&found.b_to_a),
            },
        }
    }
}

impl DeviationFigures {
    /// A few plain lines; `a` and `b` are what the meshes are called.
    pub fn lines(&self, a: &str, b: &str) -> Vec<String> {
        let shares = &self.shares;
        // Places are told to a hundred-thousandth of the diagonal or better.
        let decimals = (5.0 - self.diagonal.log10().floor()).clamp(0.0, 17.0) as usize;
        let way = |from: &str, to: &str, way: &WayFigures| {
            let [x, y, z] = way.max_at;
            format!(
                "{from} to {to}: mean {}, RMS {}, largest {} at ({x:.decimals$}, {y:.decimals$}, {z:.decimals$}), of {}",
                significant(way.mean),
                significant(way.rms),
                significant(way.max),
                count(way.samples, "point"),
            )
        };
        vec![
            way(a, b, &self.a_to_b),
            way(b, a, &self.b_to_a),
            format!(
                "both: mean {}, RMS {}, largest {}; E_avg {}",
                significant(self.mean),
                significant(self.rms),
                significant(self.max),
                significant(self.e_avg),
            ),
            format!(
                "as shares of {a}'s diagonal, {}: mean {}, RMS {}, largest {}; E_avg {} of its square",
                significant(self.diagonal),
                significant(shares.mean),
                significant(shares.rms),
                significant(shares.max),
                significant(shares.e_avg),
            ),
        ]
    }
}

impl ComparisonReport {
    /// A few plain lines of what was found.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!("A        {}", self.a.line()), format!("B        {}", self.b.line())];
        lines.extend(self.deviation.lines("A", "B").into_iter().map(|line| format!("distance {line}")));
        if let Some(map) = &self.heatmap {
            let (path, mesh, [from, to]) = (map.path.display(), map.mesh.to_uppercase(), map.range);
            let (from, to) = (significant(from), significant(to));
            lines.push(format!("heat map {path}: {mesh}, from dark at {from} to light at {to} and beyond"));
        }
        lines.push(format!("time     {:.2} s; {}", self.seconds.total, count(self.threads as u64, "thread")));
        let peak = self.peak_rss_bytes.map_or("unknown".into(), |bytes| Size(bytes).to_string());
        let (budget, scratch) = (Size(self.memory_budget_bytes), Size(self.scratch_bytes));
        lines.push(format!("memory   {peak} at the peak, of {budget}; {scratch} of scratch on disk"));
        lines.extend(self.warnings.iter().map(|w| format!("warning  {w}")));
        lines
    }
}
