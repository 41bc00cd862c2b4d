//! Bytes depend on the scan and the options alone.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, field, torus};
use std::path::Path;

/// The bytes that come out, the same at 1, 2, 3, 8 threads and when asked again.
fn bytes(folder: &Folder, scan: &Path, out: &str, memory: &str, mode: &str) -> Vec<u8> {
    let mut first = None;
    for threads in ["1", "2", "3", "8", "8"] {
        let outcome = folder.reduce_to(out, scan, &["--faces", "1500", "--memory", memory, "--threads", threads]);
        assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
        assert_eq!(outcome.object["mode"], mode);
        let bytes = std::fs::read(folder.path(out)).unwrap();
        assert!(bytes == *first.get_or_insert_with(|| bytes.clone()), "{scan:?} to {out} at {threads} threads");
    }
    first.unwrap()
}

fn variants(mesh: Mesh) -> [(&'static str, Mesh); 3] {
    let faces = mesh.clone().with_shuffled_faces();
    let both = faces.clone().with_shuffled_vertices();
    [("coherent", mesh), ("faces", faces), ("both", both)]
}

#[test]
fn threads_change_nothing_in_core() {
    let folder = Folder::new();
    for (name, mesh) in variants(torus(300, 180).and(field(20, 20).scaled(0.05))) {
        for kind in [Kind::Floats, Kind::Stl] {
            bytes(&folder, &folder.scan(name, &mesh, kind), "out.ply", "512MiB", "in-core");
        }
    }
}

#[test]
fn threads_change_nothing_out_of_core() {
    let folder = Folder::new();
    for (name, mesh) in variants(torus(300, 180).and(field(20, 20).scaled(0.05))) {
        for kind in [Kind::Floats, Kind::Doubles, Kind::Text, Kind::Stl] {
            bytes(&folder, &folder.scan(name, &mesh, kind), "out.ply", TIGHT, "out-of-core");
        }
    }
}

/// Scans whose binned vertices do not fit: paged when the order is coherent, joined when it is not.
#[test]
fn threads_change_nothing_with_scratch() {
    let folder = Folder::new();
    for (name, mesh) in variants(torus(1000, 400)) {
        let scan = folder.scan(name, &mesh, Kind::Floats);
        let report = folder.reduce(&scan, &["--faces", "1500", "--memory", TIGHT]).done("out-of-core").report;
        let (scratch, vertices) = (report["scratch_bytes"].as_u64().unwrap(), mesh.positions.len() as u64);
        assert!(scratch > 0, "{report}");
        // Binned vertices, and samples beside them.
        let most = 8 * vertices + 5 * vertices / 2 + (1 << 16);
        assert!(name != "coherent" || scratch <= most, "{scratch} bytes for {vertices} vertices");
        bytes(&folder, &scan, "out.ply", TIGHT, "out-of-core");
    }
}

#[test]
fn out_of_core_text_gives_what_binary_gives() {
    let folder = Folder::new();
    let mesh = torus(300, 180);
    let result = |kind| bytes(&folder, &folder.scan("scan", &mesh, kind), "out.ply", TIGHT, "out-of-core");
    assert!(result(Kind::Floats) == result(Kind::Text));
}

#[test]
fn a_result_in_stl_is_as_reproducible() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &torus(300, 180), Kind::Floats);
    for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
        let bytes = bytes(&folder, &scan, "out.stl", memory, mode);
        let faces = u32::from_le_bytes(bytes[80..84].try_into().unwrap());
        assert_eq!(bytes.len(), 84 + 50 * faces as usize);
        assert!((1498..=1500).contains(&faces) && !bytes.starts_with(b"solid"));
    }
}

#[test]
fn where_files_lie_changes_nothing() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &torus(300, 180), Kind::Floats);
    let there = bytes(&folder, &scan, "out.ply", TIGHT, "out-of-core");
    let scratch = Folder::new();
    let elsewhere = scratch.path("spalier größe");
    std::fs::create_dir(&elsewhere).unwrap();
    let renamed = elsewhere.join("スキャン.dat");
    std::fs::copy(&scan, &renamed).unwrap();
    let args = ["--faces", "1500", "--memory", TIGHT, "--scratch", elsewhere.to_str().unwrap()];
    assert!(folder.reduce(&renamed, &args).done("out-of-core").bytes == there);

    let mut command = crate::support::program();
    command.current_dir(&elsewhere).args(["reduce", "スキャン.dat", "-o", "ergebnis.ply", "--json"]);
    command.args(["--faces", "1500", "--memory", TIGHT]);
    let outcome = crate::support::Outcome::of(command, elsewhere.join("ergebnis.ply"));
    assert!(outcome.done("out-of-core").bytes == there);
}
