//! Results that are larger than what clustering has room for are made in tiles: exact counts, no cracks, the same bytes by any
//! number of threads, within the budget, and about as close as in core.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, Outcome, field, program, torus};
use std::collections::HashMap;
use std::path::Path;

/// 240,000 faces to 60,000.
const FACES: &str = "60000";

fn tiled(folder: &Folder, scan: &Path, more: &[&str]) -> serde_json::Value {
    let outcome = folder.reduce(scan, &[&["--faces", FACES, "--memory", TIGHT], more].concat());
    assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
    assert!(outcome.object["tiles"].as_u64().unwrap() > 1, "{}", outcome.object);
    outcome.object
}

#[test]
fn a_closed_scan_stays_closed_and_has_the_count() {
    let folder = Folder::new();
    let scan = folder.scan("torus", &torus(400, 300), Kind::Floats);
    let report = tiled(&folder, &scan, &[]);
    let (peak, budget) = (report["peak_rss_bytes"].as_u64(), report["memory_budget_bytes"].as_u64());
    assert!(peak <= budget, "{report}");
    let mesh = Mesh::read(&folder.path("out.ply"));
    assert!((59_999..=60_000).contains(&mesh.faces.len()), "{}", mesh.faces.len());
    let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
    for face in &mesh.faces {
        for i in 0..3 {
            let (a, b) = (face[i], face[(i + 1) % 3]);
            *edges.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
        }
    }
    assert!(edges.values().all(|balance| *balance == 0), "an edge is open or turned");
    // A torus has as many vertices and faces as edges.
    assert_eq!(mesh.positions.len() + mesh.faces.len(), edges.len());
}

#[test]
fn threads_change_nothing() {
    let folder = Folder::new();
    let mesh = torus(400, 300);
    let scan = folder.scan("torus", &mesh, Kind::Floats);
    tiled(&folder, &scan, &["--threads", "1"]);
    let bytes = std::fs::read(folder.path("out.ply")).unwrap();
    for threads in ["2", "5"] {
        tiled(&folder, &scan, &["--threads", threads]);
        assert!(std::fs::read(folder.path("out.ply")).unwrap() == bytes, "{threads} threads");
    }
}

#[test]
fn as_close_as_in_core() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "240000");
    let e_avg = || {
        let mut command = program();
        command.arg("compare").arg(&scan).arg(folder.path("out.ply")).args(["--samples", "200k", "--json"]);
        Outcome::of(command, folder.path("out.ply")).object["e_avg"].as_f64().unwrap()
    };
    tiled(&folder, &scan, &[]);
    let there = e_avg();
    folder.reduce(&scan, &["--faces", FACES, "--memory", "512MiB"]).done("in-core");
    let core = e_avg();
    assert!(there <= 1.1 * core, "{there} in tiles, {core} in core");
}

/// Where most collapses cost nothing, cost cannot say where to stop.
#[test]
fn a_flat_scan_has_the_count() {
    let folder = Folder::new();
    let flat = |mesh: Mesh| mesh.map(|p| [p[0], p[1], 0.0]);
    let hills = |rows| field(400, rows).map(|p| [p[0], p[1] + 300.0, p[2]]);
    for (name, mesh) in [
        ("flat", flat(field(400, 300))),
        ("half", flat(field(400, 150)).and(hills(150))),
        // Hills alone are a tenth fewer than are asked for: any cost leaves too little, none far too much.
        ("a quarter", flat(field(400, 232)).and(hills(67))),
    ] {
        tiled(&folder, &folder.scan(name, &mesh, Kind::Floats), &[]);
        let mesh = Mesh::read(&folder.path("out.ply"));
        assert!((59_999..=60_000).contains(&mesh.faces.len()), "{name}: {}", mesh.faces.len());
    }
}
