//! What scans may be like and are reduced all the same, with counted warnings.

use crate::TIGHT;
use crate::support::{Dice, Done, Folder, Kind, Mesh, field, torus};

const MODES: [(&str, &str, u32); 2] = [("512MiB", "in-core", 1), (TIGHT, "out-of-core", 8)];

#[track_caller]
fn thousand(mesh: &Mesh, kind: Kind, memory: &str, mode: &str) -> Done {
    let folder = Folder::new();
    let done = folder.reduce(&folder.scan("scan", mesh, kind), &["--faces", "1000", "--memory", memory]).done(mode);
    assert!((998..=1000).contains(&done.faces()), "{kind:?} {mode}: {}", done.faces());
    assert_eq!(folder.names().len(), 2);
    done
}

#[track_caller]
fn warns(done: &Done, code: &str, count: &str) {
    let text = done.warning(code).unwrap_or_else(|| panic!("no {code} among {:?}", done.warnings()));
    assert!(text.starts_with(count), "{code}: {text}");
}

#[test]
fn faces_that_repeat_a_corner() {
    for (memory, mode, size) in MODES {
        let mut mesh = torus(40 * size, 25 * size);
        (0..7).for_each(|i| mesh.faces.insert(100 * i as usize, [i, i + 3, i]));
        warns(&thousand(&mesh, Kind::Floats, memory, mode), "repeated-corner-faces", "7 faces");
        warns(&thousand(&mesh, Kind::Stl, memory, mode), "repeated-corner-faces", "7 faces");
    }
}

#[test]
fn vertices_that_no_face_uses() {
    let mut mesh = torus(40, 25);
    for odd in [[5.0, 5.0, 5.0], [f64::NAN, 0.0, 0.0], [f64::INFINITY; 3]] {
        mesh.positions.push(odd);
    }
    warns(&thousand(&mesh, Kind::Floats, "512MiB", "in-core"), "unreferenced-vertices", "3 vertices");
    warns(&thousand(&mesh, Kind::Doubles, "512MiB", "in-core"), "unreferenced-vertices", "3 vertices");
}

#[test]
fn vertices_that_no_face_uses_cost_nothing_out_of_core() {
    let clean = torus(320, 200);
    let reference = thousand(&clean, Kind::Floats, TIGHT, "out-of-core");
    let mut mesh = clean.clone();
    mesh.positions.extend([[f64::NAN, 0.0, 0.0], [f64::NEG_INFINITY, 1.0, f64::INFINITY], [1e9, 0.0, -1e30]]);
    let done = thousand(&mesh, Kind::Floats, TIGHT, "out-of-core");
    warns(&done, "unreferenced-vertices", "3 vertices");
    let growth = done.mesh.diagonal() / reference.mesh.diagonal();
    assert!((growth - 1.0).abs() < 0.01, "the diagonal is {growth} times as long");
    let cells = |done: &Done| done.report["cells"].as_f64().unwrap();
    assert!(cells(&done) > 0.9 * cells(&reference), "{} cells, {} without", cells(&done), cells(&reference));
}

#[test]
fn faces_on_a_line() {
    for (memory, mode, size) in MODES {
        let mut mesh = torus(40 * size, 25 * size);
        let first = mesh.positions.len() as u32;
        mesh.positions.extend([[3.0, 0.0, 0.0], [3.5, 0.0, 0.0], [4.0, 0.0, 0.0]]);
        mesh.faces.insert(700, [first, first + 1, first + 2]);
        for kind in [Kind::Floats, Kind::Stl] {
            warns(&thousand(&mesh, kind, memory, mode), "flat-faces", "1 face");
        }
    }
}

#[test]
fn polygons_of_fewer_than_three_corners() {
    for (memory, mode, size) in MODES {
        let mesh = torus(40 * size, 25 * size);
        let text = String::from_utf8(mesh.bytes(Kind::Text)).unwrap();
        let (faces, more) = (mesh.faces.len(), mesh.faces.len() + 3);
        let text = text.replace(&format!("element face {faces}\n"), &format!("element face {more}\n"));
        let folder = Folder::new();
        let scan = folder.file("scan", (text.trim_end().to_owned() + "\n2 0 1\n1 7\n0\n").into_bytes());
        let done = folder.reduce(&scan, &["--faces", "1000", "--memory", memory]).done(mode);
        warns(&done, "short-polygons", "3 polygons");
    }
}

#[test]
fn vertices_that_coincide() {
    for (memory, mode, size) in MODES {
        let mesh = torus(40 * size, 25 * size);
        // Every face with three vertices of its own, but indexed.
        let positions: Vec<_> = mesh.faces.as_flattened().iter().map(|v| mesh.positions[*v as usize]).collect();
        let faces = (0..mesh.faces.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        let loose = Mesh { positions, faces };
        let done = thousand(&loose, Kind::Floats, memory, mode);
        assert_eq!(done.mesh.border().len(), 0, "{mode}");
        if mode == "in-core" {
            warns(&done, "duplicate-vertices", "5,000 vertices");
        }
    }
}

#[test]
fn bytes_behind_the_end() {
    for (memory, mode, size) in MODES {
        for kind in [Kind::Floats, Kind::Text, Kind::Stl] {
            let folder = Folder::new();
            let mut bytes = torus(40 * size, 25 * size).bytes(kind);
            bytes.extend(b"\0\x01rest of something else");
            let scan = folder.file("scan", bytes);
            let done = folder.reduce(&scan, &["--faces", "1000", "--memory", memory]).done(mode);
            warns(&done, "trailing-bytes", "24 bytes");
        }
    }
}

#[test]
fn edges_and_vertices_where_surfaces_meet() {
    let folder = Folder::new();
    let mut mesh = torus(40, 25);
    mesh.faces.push([0, 1, 500]);
    let done = folder.reduce(&folder.scan("edge", &mesh, Kind::Floats), &["--faces", "1000"]).done("in-core");
    warns(&done, "non-manifold-edges", "1 edge");
    // Two tori that touch in one vertex.
    let mut mesh = torus(40, 25).and(torus(40, 25).map(|[x, y, z]| [x, y, z + 3.0]));
    mesh.faces.iter_mut().flatten().for_each(|v| *v = if *v == 1000 { 0 } else { *v });
    let done = folder.reduce(&folder.scan("vertex", &mesh, Kind::Floats), &["--faces", "1000"]).done("in-core");
    warns(&done, "non-manifold-vertices", "1 vertex");
    warns(&done, "unreferenced-vertices", "1 vertex");
}

/// A clean scan is not called otherwise, whatever clustering makes of it.
#[test]
fn a_clean_scan_has_no_warnings() {
    for (memory, mode, size) in MODES {
        for kind in [Kind::Floats, Kind::Stl] {
            let done = thousand(&torus(40 * size, 25 * size), kind, memory, mode);
            assert_eq!(done.warnings(), [] as [&str; 0], "{kind:?} {mode}");
        }
    }
}

#[test]
fn faces_without_area() {
    for (memory, mode, size) in MODES {
        let mut mesh = torus(40 * size, 25 * size);
        // Slivers on a line, between faces and loose.
        for i in 0..50 {
            let [p, q] = [mesh.positions[10 * i], mesh.positions[10 * i + 1]];
            let n = mesh.positions.len() as u32;
            mesh.positions.push(std::array::from_fn(|axis| 0.5 * (p[axis] + q[axis])));
            mesh.faces.push([10 * i as u32, 10 * i as u32 + 1, n]);
            let line = [[0.0; 3], [0.25; 3], [1.0; 3]].map(|p| p.map(|x| x + i as f64 / 64.0));
            mesh.positions.extend(line);
            mesh.faces.push([n + 1, n + 2, n + 3]);
        }
        thousand(&mesh, Kind::Floats, memory, mode);
        thousand(&mesh, Kind::Stl, memory, mode);
    }
}

#[test]
fn flat_long_and_lined_up() {
    for (memory, mode, size) in MODES {
        let base = field(40 * size, 25 * size);
        let shapes: [fn([f64; 3]) -> [f64; 3]; 5] = [
            |[x, y, _]| [x, y, 0.0],
            |[x, y, _]| [x, 7.0, y],
            |[x, y, _]| [x, y, x + 2.0 * y],
            |[x, y, z]| [100.0 * x, y, z],
            |[x, y, z]| [x, y * 0.01, z * 0.01],
        ];
        for shape in shapes {
            for kind in [Kind::Floats, Kind::Stl] {
                thousand(&base.clone().map(shape), kind, memory, mode);
            }
        }
    }
}

#[test]
fn triangles_without_any_connection() {
    for (memory, mode, size) in MODES {
        let mut dice = Dice::new(11);
        let mut mesh = Mesh::default();
        for i in 0..2000 * size * size {
            let centre: [f64; 3] = std::array::from_fn(|_| dice.unit());
            mesh.positions.extend((0..3).map(|_| centre.map(|x| x + 0.02 * dice.unit())));
            mesh.faces.push([3 * i, 3 * i + 1, 3 * i + 2]);
        }
        thousand(&mesh, Kind::Floats, memory, mode);
        thousand(&mesh, Kind::Stl, memory, mode);
    }
}

#[test]
fn an_outlier_far_away() {
    for (memory, mode, size) in MODES {
        let mut mesh = torus(40 * size, 25 * size);
        mesh.positions[33] = [1e4, 0.0, 0.0];
        let folder = Folder::new();
        for kind in [Kind::Floats, Kind::Stl] {
            let scan = folder.scan("scan", &mesh, kind);
            let done = folder.reduce(&scan, &["--faces", "1000", "--memory", memory]).done(mode);
            assert!((998..=1000).contains(&done.faces()), "{kind:?} {mode}: {}", done.faces());
        }
    }
}

#[test]
fn a_polygon_of_every_size() {
    // A pyramid over a polygon, whose base is one face.
    let folder = Folder::new();
    for corners in [3u32, 4, 5, 255, 3000] {
        let mut text = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             element face {}\nproperty list uint int vertex_indices\nend_header\n0 0 1\n",
            corners + 1,
            corners + 3
        );
        for i in 0..corners {
            let angle = std::f64::consts::TAU * f64::from(i) / f64::from(corners);
            text += &format!("{} {} 0\n", angle.cos(), angle.sin());
        }
        (1..=corners).for_each(|i| text += &format!("3 0 {i} {}\n", i % corners + 1));
        text += &format!("{corners}");
        (1..=corners).rev().for_each(|i| text += &format!(" {i}"));
        text += "\n2 0 1\n0\n";
        let done = folder.reduce(&folder.file("scan.ply", text), &["--faces", "1M"]).done("in-core");
        assert_eq!(done.faces() as u32, 2 * corners - 2);
        assert_eq!(done.report["input"]["faces"], corners + 3);
    }
}

#[test]
fn a_binary_stl_that_says_solid() {
    for (memory, mode, size) in MODES {
        let folder = Folder::new();
        let mut bytes = torus(40 * size, 25 * size).bytes(Kind::Stl);
        bytes[..19].copy_from_slice(b"solid facet normal\n");
        let done = folder.reduce(&folder.file("scan.stl", bytes), &["--faces", "1000", "--memory", memory]).done(mode);
        assert!((999..=1000).contains(&done.faces()));
    }
}
