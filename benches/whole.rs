//! The whole: a scan on disk becomes a small mesh on disk, synced.

mod scan;

use criterion::{Criterion, criterion_group, criterion_main};
use meshmill::budget::{MIB, Size};
use meshmill::cluster::Representative;
use meshmill::job::{Job, Target};
use meshmill::pipeline::reduce;
use meshmill::progress::Progress;
use meshmill::report::{Mode, Report};
use scan::{Files, group, only_tried};
use std::path::Path;

struct Row<'a> {
    name: &'static str,
    input: &'a Path,
    memory: Size,
    mode: Mode,
}

impl Row<'_> {
    fn reduce(&self, output: &Path, faces: u64, threads: usize) -> Report {
        let job = Job {
            input: self.input.into(),
            output: output.into(),
            format: meshmill::write::Format::Ply,
            target: Target::Faces(faces),
            coarser: Vec::new(),
            memory: self.memory,
            threads,
            scratch: None,
            scratch_quota: meshmill::scratch::DEFAULT_QUOTA,
            representative: Representative::Quadric,
            carry: true,
            refit_rounds: meshmill::job::DEFAULT_REFIT_ROUNDS,
            policies: Default::default(),
            lock_vertices: None,
            verify: false,
            samples: 0,
        };
        reduce(&job, &Progress::default()).unwrap()
    }
}

fn whole(criterion: &mut Criterion) {
    let files = Files::new(1_000_000, 100_000);
    // Too small for the scan, enough for a mesh of ten times the target.
    let small = Size(if only_tried() { 24 * MIB } else { 64 * MIB });
    let large = Size(512 * MIB);
    let target = files.faces / 100;
    let rows = [
        Row { name: "PLY, in core", input: &files.ply, memory: large, mode: Mode::InCore },
        Row { name: "PLY, out of core", input: &files.ply, memory: small, mode: Mode::OutOfCore },
        Row { name: "STL, in core", input: &files.stl, memory: large, mode: Mode::InCore },
        Row { name: "STL, out of core", input: &files.stl, memory: small, mode: Mode::OutOfCore },
    ];
    let output = files.beside("small.ply");
    let bytes_at = |row: &Row, threads| {
        let report = row.reduce(&output, target, threads);
        assert_eq!(report.mode, row.mode, "{}", row.name);
        assert_eq!(report.input.faces, files.faces, "{}", row.name);
        assert!((target - 1..=target).contains(&report.output.faces), "{}: {:?}", row.name, report.output);
        assert!(report.ratio.is_none_or(|ratio| ratio > 5.0), "{}: {:?}", row.name, report.ratio);
        std::fs::read(&output).unwrap()
    };
    for row in &rows {
        assert!(bytes_at(row, 1) == bytes_at(row, 2), "{}: two threads change the result", row.name);
    }

    let mut group = group(criterion, "whole", files.faces);
    for row in &rows {
        for threads in [1, 2] {
            group.bench_function(format!("{}, threads: {threads}", row.name), |b| {
                b.iter(|| row.reduce(&output, target, threads));
            });
        }
    }
    group.finish();
}

criterion_group!(benches, whole);
criterion_main!(benches);
