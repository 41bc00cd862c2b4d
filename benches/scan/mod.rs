//! What the benches measure on: scans made afresh, and how each is timed.

// Each bench uses its part.
#![allow(dead_code)]

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, SamplingMode, Throughput};
use meshmill::mesh::{Frame, IndexedMesh};
use meshmill::progress::Progress;
use meshmill::read::{Crew, Scan, load};
use meshmill::synth::synth;
use std::path::PathBuf;
use std::time::Duration;
use tempfile::TempDir;

/// One scan as PLY and as STL, in a folder that goes with it.
pub struct Files {
    folder: TempDir,
    pub ply: PathBuf,
    pub stl: PathBuf,
    pub faces: u64,
    pub vertices: u64,
}

impl Files {
    /// A scan of `faces` faces, or of `few` where the benches are only tried.
    pub fn new(faces: u64, few: u64) -> Files {
        let folder = tempfile::tempdir().unwrap();
        let [ply, stl] = ["scan.ply", "scan.stl"].map(|name| folder.path().join(name));
        let faces = if only_tried() { few } else { faces };
        let made = synth(&ply, faces, 1, &Progress::default()).unwrap();
        assert_eq!(synth(&stl, faces, 1, &Progress::default()).unwrap().faces, made.faces);
        Files { ply, stl, faces: made.faces, vertices: made.vertices, folder }
    }

    /// A file beside the scan.
    pub fn beside(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

/// Whether the results are to be asserted, and nothing timed: `cargo bench -- --test`, and `cargo test`.
pub fn only_tried() -> bool {
    let said = |word: &str| std::env::args().any(|arg| arg == word);
    said("--test") || !said("--bench")
}

/// A group whose rows take the same iterations in each of ten samples, and are given in faces a second.
pub fn group<'a>(criterion: &'a mut Criterion, name: &str, faces: u64) -> BenchmarkGroup<'a, WallTime> {
    let mut group = criterion.benchmark_group(name);
    group.sampling_mode(SamplingMode::Flat).sample_size(10);
    group.warm_up_time(Duration::from_secs(1)).measurement_time(Duration::from_secs(5));
    group.throughput(Throughput::Elements(faces));
    group
}

/// Opens a scan.
pub fn open(path: &std::path::Path) -> Scan {
    Scan::open(path, &Progress::default()).unwrap()
}

/// Loads and welds a scan.
pub fn loaded(scan: &Scan) -> (IndexedMesh<f32>, Frame) {
    let crew = Crew { workers: 1, progress: &Progress::default() };
    let (mesh, frame, _) = load(scan, &crew, u64::MAX).unwrap().unwrap();
    (mesh, frame)
}

/// Runs `work` on so many threads.
pub fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}
