use super::*;
use crate::progress::Progress;
use std::path::Path;

fn ply(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
        vertices.len(),
        faces.len()
    );
    vertices.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z}\n"));
    faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    text
}

fn stl(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> Vec<u8> {
    let mut bytes = vec![0; 80];
    bytes.extend((faces.len() as u32).to_le_bytes());
    for face in faces {
        bytes.extend([0; 12]);
        face.iter().for_each(|v| vertices[*v as usize].iter().for_each(|x| bytes.extend((*x as f32).to_le_bytes())));
        bytes.extend([0; 2]);
    }
    bytes
}

fn findings(folder: &Path, name: &str, bytes: &[u8], array_bytes: u64) -> Findings {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    let progress = Progress::default();
    let scan = Scan::open(&path, &progress).unwrap();
    let crew = Crew { workers: 3, progress: &progress };
    inspect::<f32>(&scan, &crew, &Scratch::in_folder(folder), array_bytes).unwrap()
}

/// Two sheets of hills, one with a fin and a tear, faces that repeat a corner, on a line, and a vertex of no face.
fn scan() -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    const SIDE: u32 = 60;
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for sheet in 0..2u32 {
        let first = vertices.len() as u32;
        for i in 0..SIDE * SIDE {
            let (x, y) = (f64::from(i % SIDE), f64::from(i / SIDE));
            vertices.push([x, y, f64::from(sheet) * 50.0 + f64::from((x * 0.7 + y).sin() as f32)]);
        }
        for i in (0..SIDE - 1).flat_map(|y| (0..SIDE - 1).map(move |x| first + y * SIDE + x)) {
            faces.extend([[i, i + 1, i + SIDE + 1], [i, i + SIDE + 1, i + SIDE]]);
        }
    }
    vertices.push([7.5, 7.5, 9.0]);
    faces.push([7, 8, vertices.len() as u32 - 1]);
    faces.remove(2000);
    faces.push([3, 3, 4]);
    vertices.extend([[90.0, 0.0, 0.0], [91.0, 0.0, 0.0], [92.0, 0.0, 0.0], [500.0, 0.0, 0.0]]);
    let n = vertices.len() as u32;
    faces.push([n - 4, n - 3, n - 2]);
    (vertices, faces)
}

#[test]
fn streamed_is_held_as_far_as_it_says() {
    let folder = tempfile::tempdir().unwrap();
    let (vertices, faces) = scan();
    let text = ply(&vertices, &faces);
    let whole = findings(folder.path(), "a.ply", text.as_bytes(), u64::MAX);
    assert_eq!((whole.components, whole.borders, whole.unreferenced_vertices), (Some(3), Some(4), Some(1)));
    assert_eq!((whole.repeated_corner_faces, whole.flat_faces, whole.unsaid.len()), (1, Some(1), 0));
    // Two rims of 236 edges, a tear of three, two edges of the fin, three of the face on a line; the fin is on a rim.
    assert_eq!((whole.border_edges, whole.nonmanifold_edges), (Some(2 * 236 + 3 + 2 + 3 - 1), Some(1)));
    for array_bytes in [0, 20_000, 80_000, 300_000] {
        let found = findings(folder.path(), "a.ply", text.as_bytes(), array_bytes);
        assert_eq!(found.repeated_corner_faces, 1);
        assert_eq!((found.border_edges, found.nonmanifold_edges), (whole.border_edges, whole.nonmanifold_edges));
        let unsaid = |what| found.unsaid.iter().any(|unsaid| unsaid.what == what);
        assert_eq!(
            (found.components, unsaid("components")),
            (whole.components.filter(|_| array_bytes > 70_000), array_bytes < 70_000)
        );
        assert_eq!(found.unreferenced_vertices.is_some(), array_bytes > 0);
        assert!(unsaid("borders") && unsaid("faces without area") && !unsaid("border edges"));
        let needed = found.unsaid.iter().find(|u| u.what == "components").and_then(|u| u.needed_bytes);
        if let Some(needed) = needed {
            assert!(findings(folder.path(), "a.ply", text.as_bytes(), needed).components.is_some());
        }
    }
}

#[test]
fn a_soup_is_told_by_places() {
    let folder = tempfile::tempdir().unwrap();
    let (vertices, faces) = scan();
    let bytes = stl(&vertices, &faces);
    let whole = findings(folder.path(), "a.stl", &bytes, u64::MAX);
    for array_bytes in [0, 50_000, 200_000] {
        let found = findings(folder.path(), "a.stl", &bytes, array_bytes);
        assert_eq!((found.border_edges, found.nonmanifold_edges), (whole.border_edges, whole.nonmanifold_edges));
        assert_eq!((found.extent, found.flat_faces), (whole.extent, whole.flat_faces));
        assert_eq!((found.repeated_corner_faces, found.components), (1, None));
    }
}
