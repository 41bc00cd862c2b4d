//! What vertices carry reaches the result.

use crate::TIGHT;
use crate::support::{Folder, Mesh, torus};
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

fn reduce(folder: &Folder, scan: &str, args: &[&str]) -> (Value, String) {
    let out = folder.path("out.ply");
    let mut command = crate::support::program();
    command.arg("reduce").arg(folder.path(scan)).arg("-o").arg(&out).args(["--format", "ply-ascii", "--json"]);
    let output = command.args(args).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    (serde_json::from_slice(&output.stdout).unwrap(), std::fs::read_to_string(out).unwrap())
}

#[test]
fn colours_survive_in_core_and_out_of_core() {
    let folder = Folder::new();
    folder.file("scan.ply", coloured(&torus(320, 200)));
    for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
        let args = ["--faces", "2000", "--memory", memory];
        let (report, text) = reduce(&folder, "scan.ply", &args);
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
            assert_eq!(reduce(&folder, "scan.ply", &[&args[..], &["--threads", threads]].concat()).1, text);
        }
    }
}

#[test]
fn what_is_left_behind_is_told() {
    let folder = Folder::new();
    let mesh = torus(40, 25);
    folder.file("scan.ply", coloured(&mesh));
    let (_, text) = reduce(&folder, "scan.ply", &["--faces", "500", "--no-carry"]);
    assert!(!text.contains("red"));
    let (report, _) = reduce(&folder, "scan.ply", &["--faces", "500"]);
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
    let (_, text) = reduce(&folder, "scan.obj", &["--faces", "200"]);
    assert!(text.contains("property uchar red\n"));
}
