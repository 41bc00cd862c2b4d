//! Reading: a streaming pass over a scan, and loading it.

mod scan;

use criterion::{Criterion, criterion_group, criterion_main};
use glam::DVec3;
use meshmill::mesh::Extent;
use meshmill::progress::Progress;
use meshmill::read::{Crew, Layout, Scan};
use scan::{Files, group, loaded, open};

/// What a pass found, in whatever order the chunks came.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Seen {
    vertices: u64,
    triangles: u64,
    extent: Extent,
    /// Of the indices, each times its place: a chunk that is lost, repeated or misplaced changes it.
    indices: u64,
}

impl Seen {
    fn include(&mut self, positions: &[[f64; 3]]) {
        self.vertices += positions.len() as u64;
        positions.iter().for_each(|p| self.extent.include(DVec3::from(*p)));
    }

    fn and(self, other: Seen) -> Seen {
        Seen {
            vertices: self.vertices + other.vertices,
            triangles: self.triangles + other.triangles,
            extent: self.extent.union(other.extent),
            indices: self.indices.wrapping_add(other.indices),
        }
    }
}

/// Everything that the file has, once.
fn stream(scan: &Scan, workers: usize) -> Seen {
    let crew = Crew { workers, progress: &Progress::default() };
    let parts = match scan.layout() {
        Layout::Soup => scan.soup(&crew, Seen::default, |seen, chunk| {
            seen.triangles += chunk.triangles.len() as u64;
            seen.include(chunk.triangles.as_flattened());
            Ok(())
        }),
        Layout::Indexed => scan
            .vertices(&crew, Seen::default, |seen, chunk| {
                seen.include(chunk.positions);
                Ok(())
            })
            .and_then(|mut parts| {
                parts.extend(scan.triangles(&crew, Seen::default, |seen, chunk| {
                    seen.triangles += chunk.triangles.len() as u64;
                    for (place, corner) in (3 * chunk.first..).zip(chunk.triangles.as_flattened()) {
                        seen.indices = seen.indices.wrapping_add(place.wrapping_mul(u64::from(*corner)));
                    }
                    Ok(())
                })?);
                Ok(parts)
            }),
    };
    parts.unwrap().into_iter().fold(Seen::default(), Seen::and)
}

fn reading(criterion: &mut Criterion) {
    let files = Files::new(1_000_000, 100_000);
    let (ply, stl) = (open(&files.ply), open(&files.stl));

    let (indexed, soup) = (stream(&ply, 1), stream(&stl, 1));
    assert_eq!((indexed.vertices, indexed.triangles), (files.vertices, files.faces));
    assert_eq!((soup.vertices, soup.triangles), (3 * files.faces, files.faces));
    assert_eq!(indexed.extent, soup.extent);
    assert_eq!((stream(&ply, 2), stream(&stl, 2)), (indexed, soup));

    // A soup is welded to the vertices that an indexed scan has, numbered as its faces come to them.
    let ((of_ply, frame), (of_stl, same_frame)) = (loaded(&ply), loaded(&stl));
    assert_eq!((of_ply.faces.len() as u64, of_ply.positions.len() as u64), (files.faces, files.vertices));
    assert_eq!((of_stl.faces.len(), of_stl.positions.len()), (of_ply.faces.len(), of_ply.positions.len()));
    assert_eq!(frame, same_frame);
    let corners = |mesh: &meshmill::mesh::IndexedMesh<f32>| -> Vec<_> {
        mesh.faces.iter().flatten().map(|&v| mesh.positions[v as usize]).collect()
    };
    assert!(corners(&of_ply) == corners(&of_stl), "the same faces in the same order");

    let mut group = group(criterion, "reading", files.faces);
    for (format, scan) in [("PLY", &ply), ("STL", &stl)] {
        for workers in [1, 2] {
            group.bench_function(format!("{format}, a pass, workers: {workers}"), |b| b.iter(|| stream(scan, workers)));
        }
        group.bench_function(format!("{format}, loading"), |b| b.iter_with_large_drop(|| loaded(scan)));
    }
    group.finish();
}

criterion_group!(benches, reading);
criterion_main!(benches);
