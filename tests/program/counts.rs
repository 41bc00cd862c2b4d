//! The count that is asked for is the count that comes out.

use crate::TIGHT;
use crate::support::{Done, Folder, Kind, Mesh, field, torus};
use std::path::Path;

fn to_faces(folder: &Folder, scan: &Path, faces: usize, memory: &str, mode: &str) -> Done {
    folder.reduce(scan, &["--faces", &faces.to_string(), "--memory", memory]).done(mode)
}

#[test]
fn a_closed_manifold_gives_the_count_or_one_less() {
    let folder = Folder::new();
    let mesh = torus(50, 24);
    assert!(mesh.border().is_empty());
    for kind in [Kind::Floats, Kind::Doubles, Kind::Text, Kind::Stl] {
        let scan = folder.scan("scan", &mesh, kind);
        for asked in [2399, 2000, 1001, 1000, 500, 101, 20, 5, 4, 3, 2, 1, 0] {
            let done = to_faces(&folder, &scan, asked, "512MiB", "in-core");
            let got = done.faces();
            assert!(got <= asked && got + 1 >= asked, "{kind:?}: {got} for {asked}");
            assert!(done.warnings().is_empty(), "{:?}", done.warnings());
        }
    }
}

#[test]
fn out_of_core_the_count_is_as_exact() {
    let folder = Folder::new();
    let mesh = torus(300, 180);
    for kind in [Kind::Floats, Kind::Stl] {
        let scan = folder.scan("scan", &mesh, kind);
        for asked in [7000, 2001, 2000, 777, 100, 4, 3, 2, 1, 0] {
            let got = to_faces(&folder, &scan, asked, TIGHT, "out-of-core").faces();
            assert!(got <= asked && got + 2 >= asked, "{kind:?}: {got} for {asked}");
        }
    }
}

#[test]
fn an_open_scan_gives_the_count_or_one_less() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &field(40, 30), Kind::Floats);
    for asked in [2399, 1200, 301, 300, 51, 7, 2, 1, 0] {
        let got = to_faces(&folder, &scan, asked, "512MiB", "in-core").faces();
        assert!(got <= asked && got + 1 >= asked, "{got} for {asked}");
    }
}

/// A torus with fins (edges of three faces), doubled faces, doubled faces turned over, and turned faces.
fn messy(around: u32, across: u32) -> Mesh {
    let mut mesh = torus(around, across);
    let faces = mesh.faces.len();
    for i in (0..faces).step_by(40) {
        let [a, b, c] = mesh.faces[i];
        match i / 40 % 4 {
            0 => {
                let tip = mesh.positions.len() as u32;
                mesh.positions.push(mesh.positions[a as usize].map(|x| 1.03 * x));
                mesh.faces.push([b, a, tip]);
            }
            1 => mesh.faces.push([b, c, a]),
            2 => mesh.faces.push([c, b, a]),
            _ => mesh.faces[i] = [b, a, c],
        }
    }
    mesh
}

#[test]
fn a_non_manifold_scan_gives_at_most_two_fewer() {
    let folder = Folder::new();
    for kind in [Kind::Floats, Kind::Stl] {
        let scan = folder.scan("scan", &messy(60, 30), kind);
        for asked in [3000, 1801, 1800, 500, 101, 12, 3, 2, 1, 0] {
            let done = to_faces(&folder, &scan, asked, "512MiB", "in-core");
            let got = done.faces();
            assert!(got <= asked && got + 2 >= asked, "{kind:?}: {got} for {asked}");
            let text = done.warning("non-manifold-edges").unwrap();
            assert!(text.starts_with(|c: char| c.is_ascii_digit()), "{text}");
        }
        let scan = folder.scan("large", &messy(300, 180), kind);
        for asked in [5000, 1001, 1000, 5, 1, 0] {
            let got = to_faces(&folder, &scan, asked, TIGHT, "out-of-core").faces();
            assert!(got <= asked && got + 2 >= asked, "{kind:?}: {got} for {asked}");
        }
    }
}

#[test]
fn an_ask_above_the_scan_gives_the_welded_scan() {
    let folder = Folder::new();
    let mesh = torus(20, 10);
    for (kind, asked) in [(Kind::Floats, "400"), (Kind::Floats, "401"), (Kind::Stl, "5M"), (Kind::Doubles, "9999G")] {
        let scan = folder.scan("scan", &mesh, kind);
        let done = folder.reduce(&scan, &["--faces", asked]).done("in-core");
        assert_eq!(done.warnings(), ["target-above-scan"]);
        assert_eq!((done.faces(), done.mesh.positions.len()), (400, 200));
        let corners = |m: &Mesh| -> Vec<_> { m.faces.iter().map(|f| f.map(|v| m.positions[v as usize])).collect() };
        assert_eq!(corners(&done.mesh), corners(&mesh), "the scan itself, in its order");
    }
}

#[test]
fn a_ratio_is_of_the_files_faces_and_rounded_down() {
    let folder = Folder::new();
    let mesh = torus(29, 11); // 638 faces
    let scan = folder.scan("scan", &mesh, Kind::Floats);
    for (ratio, most) in [("0.1", 63), ("10%", 63), ("50%", 319), ("0.9", 574), ("0.001", 0), ("1", 638), ("100%", 638)]
    {
        let got = folder.reduce(&scan, &["--ratio", ratio]).done("in-core").faces();
        assert!(got == most || got + 1 == most, "{got} for {ratio}");
    }
}

#[test]
fn an_error_bound_is_kept_and_used() {
    let folder = Folder::new();
    for (scan, memory, mode) in [
        (folder.scan("small", &torus(100, 60), Kind::Floats), "512MiB", "in-core"),
        (folder.scan("large", &torus(300, 180), Kind::Floats), TIGHT, "out-of-core"),
    ] {
        let mut before = usize::MAX;
        for bound in [0.01, 0.03, 0.1] {
            let done = folder.reduce(&scan, &["--max-error", &bound.to_string(), "--memory", memory]).done(mode);
            let estimate = done.report["error_estimate"].as_f64().unwrap();
            assert!(estimate <= bound, "{estimate} beyond {bound}");
            assert!(done.faces() < before, "{} faces within {bound}, {before} within less", done.faces());
            before = done.faces();
        }
    }
}
