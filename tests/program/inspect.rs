//! `inspect`: what it says is what there is, whatever the memory.

use crate::support::{Folder, Kind, Mesh, field, program, torus};
use serde_json::{Value, json};
use std::path::Path;

fn inspect(scan: &Path, args: &[&str]) -> Value {
    let mut command = program();
    command.arg("inspect").arg(scan).args(args).arg("--json").current_dir(scan.parent().unwrap());
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let (peak, budget) = (report["peak_rss_bytes"].as_u64().unwrap(), report["memory_budget_bytes"].as_u64().unwrap());
    assert!(peak <= budget, "{peak} bytes resident, {budget} allowed");
    report
}

/// Two closed surfaces and an open one.
fn three() -> Mesh {
    torus(300, 200).and(torus(200, 100).map(|[x, y, z]| [x, y, z + 5.0])).and(field(100, 50))
}

#[test]
fn what_is_there_is_said() {
    let folder = Folder::new();
    let mut mesh = three();
    mesh.faces.push([0, 1, 77]);
    mesh.faces.push([5, 6, 5]);
    mesh.positions.push([1e3; 3]);
    for kind in [Kind::Floats, Kind::Doubles] {
        let report = inspect(&folder.scan("scan", &mesh, kind), &[]);
        for (key, value) in [
            ("faces", json!(mesh.faces.len())),
            ("vertices", json!(mesh.positions.len())),
            ("coordinates", json!(if kind == Kind::Doubles { "double" } else { "float" })),
            ("components", json!(3)),
            ("borders", json!(2)),
            ("border_edges", json!(302)),
            ("nonmanifold_edges", json!(1)),
            ("repeated_corner_faces", json!(1)),
            ("unreferenced_vertices", json!(1)),
            ("duplicate_vertices", json!(0)),
            ("welded", json!(true)),
            ("unsaid", json!([])),
            ("unit", json!(null)),
            ("scratch_bytes", json!(0)),
        ] {
            assert_eq!(report[key], value, "{key}: {report}");
        }
        assert_eq!(report["extent"]["max"][0], 100.0);
    }
}

#[test]
fn little_memory_says_less_and_nothing_else() {
    let folder = Folder::new();
    let mesh = three().and(torus(600, 300).map(|[x, y, z]| [x, y, z - 5.0]));
    for kind in [Kind::Floats, Kind::Stl] {
        let scan = folder.scan("scan", &mesh, kind);
        let (much, little) = (inspect(&scan, &[]), inspect(&scan, &["--memory", "25MiB"]));
        for key in ["faces", "extent", "border_edges", "nonmanifold_edges", "repeated_corner_faces"] {
            assert_eq!(little[key], much[key], "{key}: {little}");
        }
        assert!(little["scratch_bytes"].as_u64().unwrap() > 0 && little["borders"].is_null());
        let unsaid = little["unsaid"].as_array().unwrap();
        assert!(
            unsaid.iter().any(|u| u["what"] == "borders" && u["memory_bytes"].as_u64() > Some(25 << 20)),
            "{little}"
        );
        // The budget that would do does.
        let enough = unsaid.iter().map(|u| u["memory_bytes"].as_u64().unwrap()).max().unwrap();
        assert_eq!(inspect(&scan, &["--memory", &enough.to_string()])["unsaid"], json!([]));
        if kind == Kind::Floats {
            assert_eq!(little["components"], much["components"]);
        }
        for threads in ["1", "3"] {
            let mut other = inspect(&scan, &["--memory", "25MiB", "--threads", threads]);
            for key in ["threads", "peak_rss_bytes", "seconds"] {
                other[key] = little[key].clone();
            }
            assert_eq!(other, little);
        }
        assert_eq!(folder.names().len(), 1 + usize::from(kind == Kind::Stl));
    }
}

#[test]
fn what_a_reduction_takes_is_what_it_takes() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &torus(400, 250), Kind::Floats);
    let report = inspect(&scan, &["--faces", "1000", "--memory", "24MiB"]);
    let planned = &report["reduction"];
    assert_eq!((&planned["mode"], &planned["faces"]), (&json!("out-of-core"), &json!(1000)));
    folder.reduce(&scan, &["--faces", "1000", "--memory", "24MiB"]).done("out-of-core");
    let in_core = planned["in_core_bytes"].as_u64().unwrap();
    folder.reduce(&scan, &["--faces", "1000", "--memory", &in_core.to_string()]).done("in-core");
    let least = planned["least_bytes"].as_u64().unwrap();
    assert!(least < in_core);
    folder.reduce(&scan, &["--faces", "1000", "--memory", &least.to_string()]).done("out-of-core");
    folder.reduce(&scan, &["--faces", "1000", "--memory", &(least - (1 << 20)).to_string()]).failed(2);
}

#[test]
fn what_is_carried_is_named() {
    let folder = Folder::new();
    let text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                property uchar red\nproperty float quality\nelement face 1\nproperty list uchar int vertex_indices\n\
                property list uchar float texcoord\nend_header\n0 0 0 1 0.5\n1 0 0 2 0.5\n0 1 0 3 0.5\n3 0 1 2 2 0 1\n";
    let scan = folder.file("scan", text);
    let report = inspect(&scan, &[]);
    let named = json!([
        { "carrier": "vertex", "name": "red", "kind": "uchar" },
        { "carrier": "vertex", "name": "quality", "kind": "float" },
        { "carrier": "face", "name": "texcoord", "kind": "list uchar float" },
    ]);
    assert_eq!((&report["attributes"], &report["format"]), (&named, &json!("PLY, ASCII")));
    let output = program().arg("inspect").arg(&scan).output().unwrap();
    let words = String::from_utf8(output.stdout).unwrap();
    for line in [
        "counts     1 face, 3 vertices, coordinates in floats",
        "carried    by vertices: red (uchar), quality (float)",
        "carried    by faces: texcoord (list uchar float)",
        "surface    1 component, 1 border, 3 border edges, 0 non-manifold edges, 0 non-manifold vertices",
    ] {
        assert!(words.lines().any(|found| found == line), "{line}\n{words}");
    }
}
