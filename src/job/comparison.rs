//! A comparison: what was said on the command line, and what will be done.

use std::path::{Path, PathBuf};

use super::{Count, DEFAULT_MEMORY, Threads, cores};
use crate::budget::Size;
use crate::measure::{DEFAULT_SAMPLES, MOST_VERTICES};
use crate::scratch::DEFAULT_QUOTA;

/// A comparison as it was said.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ComparisonSaid {
    /// The mesh that shares are of, such as a scan.
    pub a: PathBuf,
    /// The mesh to hold against it, such as the scan reduced.
    pub b: PathBuf,
    /// Samples over the area of each.
    pub samples: Option<Count>,
    /// Whether all vertices are measured.
    pub every_vertex: bool,
    /// What samples are drawn by.
    pub seed: u64,
    /// Bound on the peak resident set.
    pub memory: Option<Size>,
    /// Worker threads.
    pub threads: Option<Threads>,
    /// Folder for spills.
    pub scratch: Option<PathBuf>,
    /// What may be in that folder at one time.
    pub scratch_quota: Option<Size>,
    /// The mesh to write with the deviation as colours.
    pub heatmap: Option<PathBuf>,
}

/// A comparison with every default filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Comparison {
    /// The mesh that shares are of.
    pub a: PathBuf,
    /// The mesh to hold against it.
    pub b: PathBuf,
    /// Samples over the area of each.
    pub samples: u64,
    /// Vertices of each that are measured at most.
    pub most_vertices: u64,
    /// What samples are drawn by.
    pub seed: u64,
    /// Bound on the whole process's peak resident set.
    pub memory: Size,
    /// Worker threads, at least 1; changes nothing in the result.
    pub threads: usize,
    /// Folder for spills.
    pub scratch: PathBuf,
    /// What may be in it at one time.
    pub scratch_quota: Size,
    /// The mesh to write with the deviation as colours.
    pub heatmap: Option<PathBuf>,
}

impl ComparisonSaid {
    /// Fills in the defaults. Spills go beside the heat map, or to the folder that the program runs in.
    pub fn resolve(self) -> Comparison {
        let beside = self.heatmap.as_deref().and_then(Path::parent).filter(|folder| !folder.as_os_str().is_empty());
        let scratch = self.scratch.unwrap_or_else(|| beside.unwrap_or(Path::new(".")).into());
        Comparison {
            a: self.a,
            b: self.b,
            samples: self.samples.map_or(DEFAULT_SAMPLES, |Count(n)| n),
            most_vertices: if self.every_vertex { u64::MAX } else { MOST_VERTICES },
            seed: self.seed,
            memory: self.memory.unwrap_or(DEFAULT_MEMORY),
            threads: self.threads.map_or_else(cores, |Threads(n)| n),
            scratch,
            scratch_quota: self.scratch_quota.unwrap_or(DEFAULT_QUOTA),
            heatmap: self.heatmap,
        }
    }
}
