//! Collapse alone: a loaded mesh becomes a small one.

mod scan;

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use meshmill::collapse::{Collapsed, Options, collapse};
use meshmill::mesh::IndexedMesh;
use meshmill::progress::Progress;
use scan::{Files, group, loaded, on_threads, open};

fn to(mesh: IndexedMesh<f32>, target: usize) -> Collapsed<f32> {
    collapse(mesh, None, &Options::to(target), &Progress::default()).unwrap()
}

fn collapsing(criterion: &mut Criterion) {
    let files = Files::new(1_000_000, 60_000);
    let (mesh, _) = loaded(&open(&files.ply));
    let faces = mesh.faces.len();
    let targets = [(1, faces / 100), (10, faces / 10)];

    for (_, target) in targets {
        let [one, two] = [1, 2].map(|threads| on_threads(threads, || to(mesh.clone(), target)));
        assert!((target - 1..=target).contains(&one.mesh.faces.len()), "{} for {target}", one.mesh.faces.len());
        assert!(one.error_estimate > 0.0 && one.error_estimate < 0.02, "{}", one.error_estimate);
        assert!(!one.folded && one == two, "two threads change the result");
    }

    let mut group = group(criterion, "collapsing", files.faces);
    for (percent, target) in targets {
        for threads in [1, 2] {
            group.bench_function(format!("to {percent} %, threads: {threads}"), |b| {
                on_threads(threads, || b.iter_batched(|| mesh.clone(), |m| to(m, target), BatchSize::PerIteration));
            });
        }
    }
    group.finish();
}

criterion_group!(benches, collapsing);
criterion_main!(benches);
