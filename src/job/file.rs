//! The job file: what was *said*, table by table, before defaults and checks across tables.
//!
//! ```toml
//! [scan]
//! input = "scan.ply"        # relative to this file's folder
//! output = "small.ply"
//! faces = "500k"            # or ratio = "10%", or max_error = 0.05
//!
//! # Or many: [[scan]] with patterns, each saying over those before it what of its scans is different.
//!
//! [run]                     # everything from here on may be left out
//! memory = "512MiB"
//! threads = 2
//! scratch = "fast-disk"
//!
//! [night]                   # for many scans: all keys are in `NightTable`
//! stop_at = "06:30"
//!
//! [cluster]
//! representative = "quadric"
//!
//! [collapse]
//! quadrics = "current"      # the policies: all keys are in `CollapseTable`
//! boundary_weight = 1.0
//!
//! [refit]
//! rounds = 1
//!
//! [report]
//! json = false
//! verify = false
//! ```

use serde::{Deserialize, Serialize};
use std::io::Read;
use std::path::{Path, PathBuf};

use super::Layer;
use super::night::NightTable;
use super::quantity::{
    Compactness, Count, Degrees, MinComponent, Pairs, Rounds, Threads, Weight, as_written, write_size,
};
use super::scans::Scans;
use crate::budget::Size;
use crate::cluster::Representative;
use crate::collapse::{FoldCheck, Placement, Primitive, Quadrics, Topology, Weighting};
use crate::error::{Error, Result};

/// A job as it was said, in a file or on the command line.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JobFile {
    /// What to reduce, to what, how far.
    pub scan: Scans,
    /// How a queue of scans is gone through.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub night: Option<NightTable>,
    /// What the run may use.
    #[serde(default)]
    pub run: RunTable,
    /// The clustering stage.
    #[serde(default)]
    pub cluster: ClusterTable,
    /// The collapse stage.
    #[serde(default)]
    pub collapse: CollapseTable,
    /// The refit stage.
    #[serde(default)]
    pub refit: RefitTable,
    /// How the run reports.
    #[serde(default)]
    pub report: ReportTable,
}

/// `[run]`
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunTable {
    /// Bound on the peak resident set.
    #[serde(default, deserialize_with = "as_written", serialize_with = "write_size")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory: Option<Size>,
    /// Worker threads.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub threads: Option<Threads>,
    /// Folder for spills.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scratch: Option<PathBuf>,
    /// What may be in that folder at one time.
    #[serde(default, deserialize_with = "as_written", serialize_with = "write_size")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scratch_quota: Option<Size>,
}

/// `[cluster]`
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClusterTable {
    /// Where a cell's representative goes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub representative: Option<Representative>,
}

/// `[collapse]`
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CollapseTable {
    /// Which quadrics place and price.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub quadrics: Option<Quadrics>,
    /// Where merged vertices go.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub placement: Option<Placement>,
    /// How much each face's plane counts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weighting: Option<Weighting>,
    /// Weight of the constraint that holds open borders in place, as a factor of the squared edge length.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub boundary_weight: Option<Weight>,
    /// Whether vertices on borders stay where they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lock_border: Option<bool>,
    /// A list of points: the vertices nearest to them stay where they are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lock_vertices: Option<PathBuf>,
    /// Angle between the normals of an edge's faces from which on the edge is held.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub feature_angle: Option<Degrees>,
    /// How strongly such edges are held.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub feature_weight: Option<Weight>,
    /// Pieces smaller than this are dropped.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub min_component: Option<MinComponent>,
    /// What tells that a face would fold over.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fold_check: Option<FoldCheck>,
    /// Compactness below which faces are penalised.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub compactness: Option<Compactness>,
    /// Penalty on vertices of many faces.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub valence_penalty: Option<Weight>,
    /// How much colours steer.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub colour_weight: Option<Weight>,
    /// How much texture coordinates steer.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub texture_weight: Option<Weight>,
    /// How much normals steer.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub normal_weight: Option<Weight>,
    /// Whether holes may close, handles vanish, pieces go.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub topology: Option<Topology>,
    /// How close vertices without an edge must be to merge all the same.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub pair_distance: Option<Pairs>,
    /// What collapses at a time.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub primitive: Option<Primitive>,
}

/// `[refit]`
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefitTable {
    /// Rounds in which the result's vertices move to where the scan is.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub rounds: Option<Rounds>,
}

/// `[report]`
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReportTable {
    /// One JSON object on stdout instead of words.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub json: Option<bool>,
    /// Measure the result against the scan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verify: Option<bool>,
    /// Samples over the area of each that it is measured with.
    #[serde(default, deserialize_with = "as_written", skip_serializing_if = "Option::is_none")]
    pub samples: Option<Count>,
}

/// Every key and the table it belongs under, to tell where a misplaced one should go.
const KEYS: [(&str, &[&str]); 7] = [
    ("scan", &["input", "exclude", "output", "format", "carry", "faces", "ratio", "max_error"]),
    ("run", &["memory", "threads", "scratch", "scratch_quota"]),
    ("night", &["folder", "workers", "order", "scan_time", "stop_at", "retries", "retry_with_less", "pictures"]),
    ("cluster", &["representative"]),
    (
        "collapse",
        &[
            "quadrics",
            "placement",
            "weighting",
            "boundary_weight",
            "lock_border",
            "lock_vertices",
            "feature_angle",
            "feature_weight",
            "min_component",
            "fold_check",
            "compactness",
            "valence_penalty",
            "colour_weight",
            "texture_weight",
            "normal_weight",
            "topology",
            "pair_distance",
            "primitive",
        ],
    ),
    ("refit", &["rounds"]),
    ("report", &["json", "verify", "samples"]),
];

/// No job is longer; whatever is, is not a job file.
const LONGEST_BYTES: u64 = 1 << 20;

impl JobFile {
    /// Reads a job file; the paths it names become relative to its folder.
    pub fn read(path: &Path) -> Result<JobFile> {
        let wrong = |what: String| Error::Usage { what, file: Some(path.into()) };
        let mut text = String::new();
        std::fs::File::open(path)
            .and_then(|file| file.take(LONGEST_BYTES + 1).read_to_string(&mut text))
            .map_err(|e| wrong(format!("{}: cannot read the job file: {e}", path.display())))?;
        if text.len() as u64 > LONGEST_BYTES {
            return Err(wrong(format!("{}: not a job file: it is longer than {LONGEST_BYTES} bytes", path.display())));
        }
        let mut said = Self::parse(&text).map_err(|what| wrong(format!("{}: {what}", path.display())))?;
        if let Some(folder) = path.parent() {
            said.move_paths(|p| folder.join(p));
        }
        Ok(said)
    }

    /// Reads the text of a job file. A failure shows the line and, where a word is wrong, what was likely meant.
    pub fn parse(text: &str) -> std::result::Result<JobFile, String> {
        toml::from_str(text).map_err(|e| {
            let mut what = e.to_string().trim_end().to_string();
            if let Some(hint) = hint(e.message()) {
                what.push_str("; ");
                what.push_str(&hint);
            }
            what
        })
    }

    /// Every key, whatever its table.
    pub fn keys() -> impl Iterator<Item = &'static str> {
        KEYS.iter().flat_map(|(_, keys)| keys.iter().copied())
    }

    /// Rewrites every path, but not standard input and output.
    pub fn move_paths(&mut self, to: impl Fn(&Path) -> PathBuf) {
        self.scan.tables_mut().iter_mut().for_each(|table| table.move_paths(&to));
        let folder = self.night.as_mut().and_then(|night| night.folder.as_mut());
        for path in folder.into_iter().chain(&mut self.run.scratch).chain(&mut self.collapse.lock_vertices) {
            *path = to(path);
        }
    }
}

/// Every key on its own: what is said above, otherwise what is said below.
macro_rules! layered {
    ($table:ident: $($key:ident),*) => {
        impl Layer for $table {
            fn over(self, below: Self) -> Self {
                $table { $($key: self.$key.or(below.$key)),* }
            }
        }
    };
}
layered!(RunTable: memory, threads, scratch, scratch_quota);
layered!(ClusterTable: representative);
layered!(RefitTable: rounds);
layered!(ReportTable: json, verify, samples);
layered!(CollapseTable: quadrics, placement, weighting, boundary_weight, lock_border, lock_vertices, feature_angle,
    feature_weight, min_component, fold_check, compactness, valence_penalty, topology, pair_distance,
    primitive, colour_weight, texture_weight, normal_weight);

/// What was likely meant by an unknown word, from the parser's message: the wrong word in backticks, then the right ones.
fn hint(message: &str) -> Option<String> {
    if !message.starts_with("unknown ") {
        return None;
    }
    let mut words = message.split('`').skip(1).step_by(2);
    let wrong = words.next()?;
    let near = |word: &&str| strsim::damerau_levenshtein(wrong, word);
    let table = KEYS.iter().find(|(_, keys)| message.starts_with("unknown field") && keys.contains(&wrong));
    if let Some((table, _)) = table {
        return Some(format!("`{wrong}` belongs under [{table}]"));
    }
    let best = words.min_by_key(near).filter(|word| near(word) <= 1 + word.len() / 4);
    best.map(|word| format!("did you mean `{word}`?"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCAN: &str = "[scan]\ninput = 'a.ply'\noutput = 'b.ply'\n";

    fn with(rest: &str) -> std::result::Result<JobFile, String> {
        JobFile::parse(&format!("{SCAN}{rest}"))
    }

    #[test]
    fn every_key_is_known_under_its_table_and_under_no_other() {
        for (table, keys) in KEYS {
            for key in keys {
                let text = format!("[{table}]\n{key} = []");
                assert!(!JobFile::parse(&text).unwrap_err().contains("unknown field"), "{table}.{key}");
            }
        }
        let error = with("faces = 9\nmemory = '1GiB'").unwrap_err();
        assert!(error.contains("line 5, column 1") && error.ends_with("`memory` belongs under [run]"), "{error}");
    }

    #[test]
    fn a_slip_of_the_keyboard_is_named_with_its_line() {
        for (rest, line, meant) in [
            ("fcaes = 9", "line 4", "faces"),
            ("faces = 9\n[run]\nmemroy = 1", "line 6", "memory"),
            ("faces = 9\n[clutser]", "line 5", "cluster"),
            ("faces = 9\n[cluster]\nrepresentative = 'quadrics'", "line 6", "quadric"),
        ] {
            let error = with(rest).unwrap_err();
            assert!(error.contains(line) && error.contains('^'), "{error}");
            assert!(error.ends_with(&format!("did you mean `{meant}`?")), "{error}");
        }
        let error = with("faces = 9\nzebra = 1").unwrap_err();
        assert!(error.contains("unknown field `zebra`") && !error.contains("did you mean"), "{error}");
    }

    #[test]
    fn wrong_values_are_named_with_their_line() {
        for (rest, line, what) in [
            ("faces = -5", "line 4", "not a count"),
            ("faces = 1.5", "line 4", "not a whole number"),
            ("faces = '10%'", "line 4", "is a ratio"),
            ("ratio = 1.5", "line 4", "not a ratio"),
            ("ratio = 0", "line 4", "not a ratio"),
            ("max_error = inf", "line 4", "not a length"),
            ("max_error = '0'", "line 4", "not a length"),
            ("faces = true", "line 4", "expected a number"),
            ("faces = ['1k', true]", "line 4", "expected a number"),
            ("faces = ['1k', 1000]", "line 1", "said twice"),
            ("faces = 1\n[night]\nstop_at = '6 am'", "line 6", "not a time of day"),
            ("faces = 1\n[night]\nscan_time = 'long'", "line 6", "not a length of time"),
            ("faces = 1\n[run]\nthreads = 0", "line 6", "not a number of threads"),
            ("faces = 1\n[run]\nmemory = '12 parsecs'", "line 6", "not a size"),
            ("faces = 1\n[collapse]\nboundary_weight = -1", "line 6", "not a weight"),
            ("faces = 1\nfaces = 2", "line 5", "duplicate"),
            ("faces = 1\nratio = 0.5", "line 1", "more than one target"),
            ("", "line 1", "no target"),
        ] {
            let error = with(rest).unwrap_err();
            assert!(error.contains(line) && error.contains(what), "{rest}: {error}");
        }
        assert!(JobFile::parse("").unwrap_err().contains("missing field `scan`"));
        assert!(
            JobFile::parse("[scan]\ninput = ''\noutput = 'b'\nfaces = 1").unwrap_err().contains("`input` is empty")
        );
    }

    #[test]
    fn what_is_written_reads_back() {
        let text = "max_error = '1e-12'\n[run]\nmemory = 77\nthreads = 3\nscratch = 's'\n[cluster]\n\
                    representative = 'mean'\n[collapse]\nboundary_weight = 0.1\n[report]\njson = true\nverify = true";
        let said = with(text).unwrap();
        assert_eq!(said.run.memory, Some(Size(77)));
        assert_eq!(JobFile::parse(&toml::to_string(&said).unwrap()).unwrap(), said);
    }
}
