//! What faces carry where it has no borders that could be held.

use crate::TIGHT;
use crate::support::{Folder, Mesh, field, torus};
use serde_json::Value;

/// What a face is coloured by where its middle is: never like its neighbours.
fn colour(face: usize, [x, y, _]: [f64; 3]) -> [f64; 3] {
    let grain = |i: usize| ((face * 7 + i * 13) % 23) as f64 - 11.0;
    [(40.0 + x + grain(0)).round(), (200.0 - y + grain(1)).round(), (100.0 + grain(2)).round()]
}

fn middle(mesh: &Mesh, face: &[u32; 3]) -> [f64; 3] {
    let [a, b, c] = face.map(|v| mesh.positions[v as usize]);
    std::array::from_fn(|i| (a[i] + b[i] + c[i]) / 3.0)
}

/// A mesh whose faces have such numbers, as ASCII PLY.
fn with_faces(mesh: &Mesh, properties: &str, of: impl Fn(usize, [f64; 3]) -> String) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n\
         property list uchar int vertex_indices\n{properties}end_header\n",
        mesh.positions.len(),
        mesh.faces.len()
    );
    mesh.positions.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z}\n"));
    for (f, face) in mesh.faces.iter().enumerate() {
        let [a, b, c] = face;
        text += &format!("3 {a} {b} {c} {}\n", of(f, middle(mesh, face)));
    }
    text
}

/// The middles of the faces of an ASCII PLY with their numbers.
fn faces(report: &Value, text: &str) -> Vec<([f64; 3], Vec<f64>)> {
    let (_, body) = text.split_once("end_header\n").unwrap();
    let vertices = report["output"]["vertices"].as_u64().unwrap() as usize;
    let numbers = |line: &str| line.split(' ').map(|x| x.parse::<f64>().unwrap()).collect::<Vec<_>>();
    let lines: Vec<Vec<f64>> = body.lines().map(numbers).collect();
    let face = |line: &Vec<f64>| {
        let at = |i: usize, k: usize| lines[line[i] as usize][k];
        (std::array::from_fn(|k| (at(1, k) + at(2, k) + at(3, k)) / 3.0), line[4..].to_vec())
    };
    lines[vertices..].iter().map(face).collect()
}

#[test]
fn colours_that_differ_everywhere_are_averaged_and_hold_nothing_up() {
    let folder = Folder::new();
    let mesh = field(120, 90);
    let words = |f: usize, p: [f64; 3]| {
        let [r, g, b] = colour(f, p);
        format!("{r} {g} {b} {}", p[0] / 120.0)
    };
    let properties = "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float share\n";
    folder.file("scan.ply", with_faces(&mesh, properties, words));
    let mut off = format!("OFF\n{} {} 0\n", mesh.positions.len(), mesh.faces.len());
    mesh.positions.iter().for_each(|[x, y, z]| off += &format!("{x} {y} {z}\n"));
    for (f, [a, b, c]) in mesh.faces.iter().enumerate() {
        let [red, green, blue] = colour(f, middle(&mesh, &[*a, *b, *c])).map(|x| x / 255.0);
        off += &format!("3 {a} {b} {c} {red:.9} {green:.9} {blue:.9}\n");
    }
    folder.file("scan.off", off);
    for scan in ["scan.ply", "scan.off"] {
        let (report, text) = folder.reduce_to_text(scan, &["--faces", "1200"]);
        assert_eq!(report["warnings"], Value::Array(Vec::new()), "{scan}");
        let found = faces(&report, &text);
        assert!((1199..=1200).contains(&found.len()), "{}", found.len());
        let mut sum = 0.0;
        for ([x, y, _], values) in &found {
            let expected = [40.0 + x, 200.0 - y, 100.0];
            let off = values.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            // A sliver may have one vote, or a neighbour's.
            assert!(off < 20.0, "{scan}: {values:?} at {x} {y}");
            sum += off;
            assert!(scan == "scan.off" || (values[3] - x / 120.0).abs() < 0.05, "{values:?} at {x}");
        }
        assert!(sum < 4.0 * found.len() as f64, "{sum}");
        for threads in ["1", "3"] {
            assert_eq!(folder.reduce_to_text(scan, &["--faces", "1200", "--threads", threads]).1, text);
        }
    }
}

#[test]
fn labels_are_elected_where_the_scan_does_not_fit() {
    let folder = Folder::new();
    // Between the two labels a third one is sprinkled, which nowhere has a majority.
    let label = |x: f64| if x < 0.1 { 7 } else { 40_000 };
    let words = |f: usize, [x, ..]: [f64; 3]| if f.is_multiple_of(5) { "1".into() } else { label(x).to_string() };
    for (name, mesh) in [("scan.ply", torus(320, 200)), ("shuffled.ply", torus(320, 200).with_shuffled_faces())] {
        folder.file(name, with_faces(&mesh, "property ushort kind\n", words));
        let (report, text) = folder.reduce_to_text(name, &["--faces", "2000", "--memory", TIGHT]);
        assert_eq!((&report["mode"], &report["warnings"]), (&"out-of-core".into(), &Value::Array(Vec::new())));
        assert!(report["peak_rss_bytes"].as_u64() <= report["memory_budget_bytes"].as_u64(), "{report}");
        let found = faces(&report, &text);
        let wrong = found.iter().filter(|([x, ..], values)| (x - 0.1).abs() > 0.1 && values[0] != f64::from(label(*x)));
        // Slivers have few votes.
        assert!(wrong.count() < 8, "{name}");
        let (_, again) = folder.reduce_to_text(name, &["--faces", "2000", "--memory", TIGHT, "--threads", "1"]);
        assert!(again == text, "{name}");
    }
}
