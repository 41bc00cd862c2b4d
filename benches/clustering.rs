//! Clustering: a scan becomes one vertex a cell.

mod scan;

use criterion::{Criterion, criterion_group, criterion_main};
use meshmill::cluster::{ClusterOptions, Clustered, MeshLimit, Representative, cluster};
use meshmill::progress::Progress;
use meshmill::read::{Crew, Scan};
use meshmill::scratch::Scratch;
use scan::{Files, group, on_threads, open};

/// A scan, and where the vertices wait once they are binned.
struct Row<'a> {
    name: &'static str,
    scan: &'a Scan,
    spill_resident_bytes: u64,
}

/// Faces of the scan for each cell of the table: what a scan of 28 million faces has for 140,000 at ten times as many.
const FACES_A_CELL: u64 = 16;

impl Row<'_> {
    fn cluster(&self, scratch: &Scratch, workers: usize) -> Clustered<f32> {
        let cells = self.cells();
        let options = ClusterOptions {
            representative: Representative::Quadric,
            cells,
            enough_cells: cells,
            raw_faces: 5 * cells,
            spill_resident_bytes: self.spill_resident_bytes,
            samples: 0,
            boundary_weight: 1.0,
            limit: MeshLimit { face_bytes: 1, vertex_bytes: 1, bytes: u64::MAX },
        };
        let crew = Crew { workers, progress: &Progress::default() };
        cluster(self.scan, &crew, scratch, &options).unwrap()
    }

    fn cells(&self) -> usize {
        (self.scan.triangle_count() / FACES_A_CELL) as usize
    }

    /// The cells fill most of the table, faces are two a cell as on any closed surface, and the workers change nothing.
    fn check(&self, scratch: &Scratch) -> Clustered<f32> {
        let clustered = self.cluster(scratch, 1);
        let occupied = clustered.stats.occupied_cells as usize;
        let (faces, cells) = (clustered.mesh.faces.len(), self.cells());
        assert!((cells * 9 / 10..=cells * 11 / 10).contains(&occupied), "{}: {occupied} of {cells} cells", self.name);
        assert!((3 * occupied / 2..=5 * occupied / 2).contains(&faces), "{}: {faces} of {occupied}", self.name);
        assert_eq!(clustered.quadrics.len(), clustered.mesh.positions.len());
        let two = self.cluster(scratch, 2);
        let same = two.mesh == clustered.mesh && two.quadrics == clustered.quadrics;
        assert!(same, "{}: two workers change the result", self.name);
        clustered
    }
}

fn clustering(criterion: &mut Criterion) {
    let files = Files::new(1_000_000, 100_000);
    let scratch = Scratch::in_folder(&files.beside(""));
    let (ply, stl) = (open(&files.ply), open(&files.stl));
    let rows = [
        Row { name: "PLY, vertices kept", scan: &ply, spill_resident_bytes: u64::MAX },
        Row { name: "PLY, vertices spilled", scan: &ply, spill_resident_bytes: 0 },
        Row { name: "STL", scan: &stl, spill_resident_bytes: 0 },
    ];
    let [kept, spilled, _] = rows.each_ref().map(|row| row.check(&scratch));
    assert!(kept.mesh == spilled.mesh && kept.quadrics == spilled.quadrics, "a spill changes the result");
    // 6 bytes a vertex, and its strip's list of cells.
    let packed = 6 * files.vertices..13 * files.vertices / 2;
    assert!(kept.stats.scratch_bytes == 0 && packed.contains(&spilled.stats.scratch_bytes), "{:?}", spilled.stats);

    let mut group = group(criterion, "clustering", files.faces);
    for row in &rows {
        for workers in [1, 2] {
            group.bench_function(format!("{}, workers: {workers}", row.name), |b| {
                on_threads(workers, || b.iter_with_large_drop(|| row.cluster(&scratch, workers)));
            });
        }
    }
    group.finish();
}

criterion_group!(benches, clustering);
criterion_main!(benches);
