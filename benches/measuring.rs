//! Measuring: how far a scan is from its reduction, and the nearest point of a mesh.

mod scan;

use criterion::{Criterion, criterion_group, criterion_main};
use glam::DVec3;
use meshmill::budget::{MIB, Size};
use meshmill::cluster::Representative;
use meshmill::job::{Job, Target};
use meshmill::measure::{Deviation, MOST_VERTICES, Needs, Options, Pair, measure};
use meshmill::mesh::Tree;
use meshmill::pipeline::reduce;
use meshmill::progress::Progress;
use meshmill::read::{Crew, Scan};
use meshmill::scratch::Scratch;
use meshmill::write::Format;
use scan::{Files, group, loaded, on_threads, only_tried, open};
use std::path::Path;

/// A scan, and whether its positions stay in memory.
struct Row<'a> {
    name: &'static str,
    scan: &'a Scan,
    resident: bool,
}

fn options(array_bytes: u64) -> Options {
    let samples = if only_tried() { 20_000 } else { 1_000_000 };
    Options { samples, most_vertices: MOST_VERTICES, seed: 0, shades: false, array_bytes }
}

impl Row<'_> {
    fn measure(&self, small: &Scan, folder: &Path, workers: usize) -> (Deviation, u64) {
        let pair = Pair { a: self.scan, b: small };
        let crew = Crew { workers, progress: &Progress::default() };
        let least = Needs::of::<f32>(&pair, &options(0)).bytes();
        let scratch = Scratch::in_folder(folder);
        let array_bytes = if self.resident { 1 << 30 } else { least };
        let found = on_threads(workers, || measure::<f32>(pair, &crew, &scratch, &options(array_bytes)));
        (found.unwrap().deviation, scratch.bytes())
    }

    fn check(&self, small: &Scan, folder: &Path) {
        let (found, scratch) = self.measure(small, folder, 1);
        assert_eq!(self.measure(small, folder, 2), (found, scratch), "{}: two workers change the figures", self.name);
        assert!(self.resident || scratch > 0 || only_tried(), "{}: nothing is spilled", self.name);
        let rms = found.rms() / found.diagonal;
        assert!((1e-6..1e-2).contains(&rms), "{}: {rms} of the diagonal", self.name);
    }
}

/// The scan reduced to a hundredth.
fn reduced(files: &Files) -> Scan {
    let output = files.beside("small.ply");
    let job = Job {
        input: files.ply.clone(),
        output: output.clone(),
        format: Format::Ply,
        target: Target::Faces(files.faces / 100),
        coarser: Vec::new(),
        memory: Size(512 * MIB),
        threads: 2,
        scratch: None,
        scratch_quota: meshmill::scratch::DEFAULT_QUOTA,
        representative: Representative::Quadric,
        policies: Default::default(),
        lock_vertices: None,
        carry: true,
        refit_rounds: 1,
        verify: false,
        samples: 0,
    };
    reduce(&job, &Progress::default()).unwrap();
    open(&output)
}

fn measuring(criterion: &mut Criterion) {
    let files = Files::new(4_000_000, 100_000);
    let (ply, stl, small) = (open(&files.ply), open(&files.stl), reduced(&files));
    let folder = files.beside("");
    let rows = [
        Row { name: "PLY, positions in memory", scan: &ply, resident: true },
        Row { name: "PLY, positions on scratch", scan: &ply, resident: false },
        Row { name: "STL", scan: &stl, resident: true },
    ];
    rows.iter().for_each(|row| row.check(&small, &folder));
    let mut group = group(criterion, "measuring", files.faces);
    for row in &rows {
        for threads in [1, 2] {
            group.bench_function(format!("{}, threads: {threads}", row.name), |b| {
                b.iter(|| row.measure(&small, &folder, threads));
            });
        }
    }
    group.finish();
}

fn nearest(criterion: &mut Criterion) {
    let files = Files::new(1_000_000, 20_000);
    let (mesh, _) = loaded(&open(&files.ply));
    let tree = Tree::build(&mesh);
    // The middle of every few faces, a little off the surface.
    let points: Vec<(u32, DVec3)> = (0..mesh.faces.len() as u32)
        .step_by(16)
        .map(|face| {
            let [a, b, c] = mesh.faces[face as usize].map(|v| mesh.at(v));
            (face, (a + b + c) / 3.0 + 2.0 * (b - a).cross(c - a).normalize_or_zero() * (b - a).length())
        })
        .collect();
    let from_known = |(face, p): &(u32, DVec3)| tree.nearest(*p, *face);
    let from_afar = |(_, p): &(u32, DVec3)| tree.nearest(*p, 0);
    assert!(points.iter().all(|point| from_known(point) == from_afar(point)), "the beginning changes the end");

    let mut group = group(criterion, "nearest", points.len() as u64);
    group.bench_function("from a known face", |b| {
        b.iter(|| points.iter().map(from_known).map(|n| n.distance_sq).sum::<f64>())
    });
    group.bench_function("from afar", |b| b.iter(|| points.iter().map(from_afar).map(|n| n.distance_sq).sum::<f64>()));
    group.finish();
    let mut group = self::group(criterion, "nearest", files.faces);
    group.bench_function("build", |b| b.iter(|| on_threads(1, || Tree::build(&mesh)).mesh().faces.len()));
    group.finish();
}

criterion_group!(benches, measuring, nearest);
criterion_main!(benches);
