//! What vertices carry reaches the result.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, field, torus};
use serde_json::Value;

/// What a place is coloured.
fn colour([x, y, z]: [f64; 3]) -> [f64; 3] {
    [127.5 + 80.0 * x, 127.5 + 80.0 * y, 127.5 + 200.0 * z]
}

/// A mesh whose vertices have colours, as ASCII PLY.
fn coloured(mesh: &Mesh) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nelement face {}\n\
         property list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.faces.len()
    );
    for p in &mesh.positions {
        let [r, g, b] = colour(*p).map(f64::round);
        text += &format!("{} {} {} {r} {g} {b}\n", p[0], p[1], p[2]);
    }
    mesh.faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    text
}

#[test]
fn colours_survive_in_core_and_out_of_core() {
    let folder = Folder::new();
    folder.file("scan.ply", coloured(&torus(320, 200)));
    for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
        let args = ["--faces", "2000", "--memory", memory];
        let (report, text) = folder.reduce_to_text("scan.ply", &args);
        assert_eq!((&report["mode"], &report["warnings"]), (&mode.into(), &Value::Array(Vec::new())));
        assert!(report["peak_rss_bytes"].as_u64() <= report["memory_budget_bytes"].as_u64(), "{report}");
        let (header, body) = text.split_once("end_header\n").unwrap();
        assert!(header.contains("property uchar red\nproperty uchar green\nproperty uchar blue\nelement face"));
        let vertices = report["output"]["vertices"].as_u64().unwrap() as usize;
        for line in body.lines().take(vertices) {
            let numbers: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
            let expected = colour([numbers[0], numbers[1], numbers[2]]);
            let off = numbers[3..].iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 12.0, "{mode}: {line}, expected {expected:?}");
        }
        for threads in ["1", "3"] {
            assert_eq!(folder.reduce_to_text("scan.ply", &[&args[..], &["--threads", threads]].concat()).1, text);
        }
    }
}

#[test]
fn what_vertices_of_an_off_carry_comes_through() {
    let folder = Folder::new();
    let mesh = torus(160, 100);
    let mut text = format!("CNOFF\n{} {} 0\n", mesh.positions.len(), mesh.faces.len());
    let mut shares = text.clone();
    for p in &mesh.positions {
        let [x, y, z] = p;
        let [r, g, b] = colour(*p).map(f64::round);
        text += &format!("{x} {y} {z} 0 0.6 0.8 {r} {g} {b}\n");
        shares += &format!("{x} {y} {z} 0 0.6 0.8 {:.9} {:.9} {:.9} 1\n", r / 255.0, g / 255.0, b / 255.0);
    }
    for [a, b, c] in &mesh.faces {
        text += &format!("3 {a} {b} {c}\n");
        shares += &format!("3 {a} {b} {c}\n");
    }
    folder.file("bytes.off", text);
    folder.file("shares.off", shares);
    for (scan, colours) in [("bytes.off", 3), ("shares.off", 4)] {
        let (report, text) = folder.reduce_to_text(scan, &["--faces", "2000"]);
        assert_eq!(report["warnings"], Value::Array(Vec::new()), "{scan}");
        let (header, body) = text.split_once("end_header\n").unwrap();
        let properties = "property float nx\nproperty float ny\nproperty float nz\nproperty uchar red\n";
        assert!(header.contains(properties), "{header}");
        let vertices = report["output"]["vertices"].as_u64().unwrap() as usize;
        for line in body.lines().take(vertices) {
            let numbers: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
            assert_eq!(numbers.len(), 6 + colours, "{scan}: {line}");
            let expected = colour([numbers[0], numbers[1], numbers[2]]);
            let off = numbers[6..].iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(off < 12.0 && (numbers[4] - 0.6).abs() < 1e-6, "{scan}: {line}, expected {expected:?}");
        }
    }
}

#[test]
fn what_is_left_behind_is_told() {
    let folder = Folder::new();
    let mesh = torus(40, 25);
    folder.file("scan.ply", coloured(&mesh));
    let (_, text) = folder.reduce_to_text("scan.ply", &["--faces", "500", "--no-carry"]);
    assert!(!text.contains("red"));
    let (report, _) = folder.reduce_to_text("scan.ply", &["--faces", "500"]);
    assert_eq!(report["warnings"], Value::Array(Vec::new()));
    let outcome = folder.reduce_to("out.stl", &folder.path("scan.ply"), &["--faces", "500"]);
    assert_eq!(outcome.object["warnings"][0]["code"], "not-carried");
    assert_eq!(outcome.object["warnings"][0]["text"], "not carried over to the result: red, green, blue");
    let outcome = folder.reduce_to("out.obj", &folder.path("scan.ply"), &["--faces", "500"]);
    assert_eq!((outcome.code, &outcome.object["warnings"]), (Some(0), &Value::Array(Vec::new())));
    let text = std::fs::read_to_string(folder.path("out.obj")).unwrap();
    assert!(text.lines().filter(|line| line.starts_with("v ")).all(|line| line.split(' ').count() == 7));
    // And back in: an OBJ's colours are bytes in a PLY.
    std::fs::rename(folder.path("out.obj"), folder.path("scan.obj")).unwrap();
    let (_, text) = folder.reduce_to_text("scan.obj", &["--faces", "200"]);
    assert!(text.contains("property uchar red\n"));
}

/// A field whose faces are labelled by where they lie: left or right of a wavy line.
fn label([x, y, _]: [f64; 3]) -> u8 {
    if x < 60.0 + 14.0 * (y / 9.0).sin() { 3 } else { 200 }
}

fn labelled(mesh: &Mesh) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n\
         property list uchar int vertex_indices\nproperty uchar kind\nend_header\n",
        mesh.positions.len(),
        mesh.faces.len()
    );
    mesh.positions.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z}\n"));
    for face in &mesh.faces {
        let [a, b, c] = face;
        text += &format!("3 {a} {b} {c} {}\n", label(middle(mesh, face)));
    }
    text
}

fn middle(mesh: &Mesh, face: &[u32; 3]) -> [f64; 3] {
    let [a, b, c] = face.map(|v| mesh.positions[v as usize]);
    std::array::from_fn(|i| (a[i] + b[i] + c[i]) / 3.0)
}

#[test]
fn borders_between_labels_are_held() {
    let folder = Folder::new();
    let mesh = field(120, 90);
    folder.file("scan.ply", labelled(&mesh));
    let (report, text) = folder.reduce_to_text("scan.ply", &["--faces", "1200"]);
    assert_eq!(report["warnings"], Value::Array(Vec::new()));
    let (header, body) = text.split_once("end_header\n").unwrap();
    assert!(header.contains("property list uchar int vertex_indices\nproperty uchar kind"), "{header}");
    let vertices = report["output"]["vertices"].as_u64().unwrap() as usize;
    let numbers = |line: &str| line.split(' ').map(|x| x.parse::<f64>().unwrap()).collect::<Vec<_>>();
    let lines: Vec<Vec<f64>> = body.lines().map(numbers).collect();
    let at = |v: f64| -> [f64; 3] { lines[v as usize][..3].try_into().unwrap() };
    let (mut wrong, mut all) = (0.0, 0.0);
    for face in &lines[vertices..] {
        let [a, b, c] = [at(face[1]), at(face[2]), at(face[3])];
        let area = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
        // Points of the face that lie where another label should be.
        for i in 0..10 {
            for j in 0..10 - i {
                let (s, t) = ((f64::from(i) + 0.33) / 10.0, (f64::from(j) + 0.33) / 10.0);
                let p: [f64; 3] = std::array::from_fn(|k| a[k] + s * (b[k] - a[k]) + t * (c[k] - a[k]));
                all += area / 55.0;
                wrong += if f64::from(label(p)) == face[4] { 0.0 } else { area / 55.0 };
            }
        }
    }
    // The line of the scan's own faces is half a cell off already.
    assert!(wrong < 0.012 * all, "{wrong} of {all}");
}

#[test]
fn the_spare_bytes_of_an_stl_come_through() {
    let folder = Folder::new();
    let mesh = field(40, 30);
    let mut bytes = mesh.bytes(Kind::Stl);
    for (face, record) in mesh.faces.iter().zip(bytes[84..].chunks_exact_mut(50)) {
        let left = middle(&mesh, face)[0] < 20.0;
        record[48..].copy_from_slice(&u16::to_le_bytes(if left { 0x1234 } else { 7 }));
    }
    folder.file("scan.stl", bytes);
    let outcome = folder.reduce_to("out.stl", &folder.path("scan.stl"), &["--faces", "300"]);
    assert_eq!((outcome.code, &outcome.object["warnings"]), (Some(0), &Value::Array(Vec::new())));
    let bytes = std::fs::read(folder.path("out.stl")).unwrap();
    for record in bytes[84..].chunks_exact(50) {
        let number = |i: usize| f64::from(f32::from_le_bytes(record[12 + 4 * i..][..4].try_into().unwrap()));
        let x = (number(0) + number(3) + number(6)) / 3.0;
        let label = u16::from_le_bytes([record[48], record[49]]);
        assert_eq!(label, if x < 20.0 { 0x1234 } else { 7 }, "at {x}");
    }
    let (_, text) = folder.reduce_to_text("scan.stl", &["--faces", "300"]);
    assert!(text.contains("property ushort attribute\n"));
}

/// A normal that says more than the shape: ripples as on a field that was smoothed.
fn rippled([x, y, _]: [f64; 3]) -> [f64; 3] {
    let slope = 0.8 * (x / 7.0).sin() + 0.4 * (y / 23.0).cos();
    let length = slope.hypot(1.0);
    [slope / length, 0.0, 1.0 / length]
}

#[test]
fn normals_steer() {
    let folder = Folder::new();
    let mesh = field(120, 90);
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         property float nx\nproperty float ny\nproperty float nz\nelement face {}\n\
         property list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.faces.len()
    );
    for p in &mesh.positions {
        let [nx, ny, nz] = rippled(*p);
        text += &format!("{} {} {} {nx} {ny} {nz}\n", p[0], p[1], p[2]);
    }
    mesh.faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    folder.file("scan.ply", text);
    // The squared error of normals in the middle of faces, by area.
    let error = |args: &[&str]| {
        let (report, text) = folder.reduce_to_text("scan.ply", &[&["--faces", "1200"], args].concat());
        assert_eq!(report["warnings"], Value::Array(Vec::new()));
        let (_, body) = text.split_once("end_header\n").unwrap();
        let vertices = report["output"]["vertices"].as_u64().unwrap() as usize;
        let numbers = |line: &str| line.split(' ').map(|x| x.parse::<f64>().unwrap()).collect::<Vec<_>>();
        let lines: Vec<Vec<f64>> = body.lines().map(numbers).collect();
        let (mut sum, mut all) = (0.0, 0.0);
        for face in &lines[vertices..] {
            let [a, b, c] = [1, 2, 3].map(|i| &lines[face[i] as usize]);
            let area = 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs();
            let mean: [f64; 6] = std::array::from_fn(|i| (a[i] + b[i] + c[i]) / 3.0);
            let expected = rippled([mean[0], mean[1], 0.0]);
            sum += area * (0..3).map(|i| (mean[3 + i] - expected[i]).powi(2)).sum::<f64>();
            all += area;
        }
        sum / all
    };
    let (without, with) = (error(&["--normal-weight", "0"]), error(&[]));
    assert!(with < 0.7 * without, "{with} {without}");
}
