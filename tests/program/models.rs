//! Real scans, where `MESHMILL_MODELS` names a folder of them.

use crate::support::{Done, Folder, Mesh};
use glam::DVec3;
use meshmill::mesh::IndexedMesh;
use meshmill::mesh::audit::Audit;
use meshmill::mesh::tree::Tree;
use meshmill::mesh::triangle::distance_sq;
use std::path::{Path, PathBuf};

fn models() -> Vec<PathBuf> {
    let Some(folder) = std::env::var_os("MESHMILL_MODELS").map(PathBuf::from) else {
        eprintln!("MESHMILL_MODELS is not set: no real scan is tried");
        return Vec::new();
    };
    let mut models: Vec<PathBuf> = ["table63", "dev"]
        .iter()
        .filter_map(|sub| std::fs::read_dir(folder.join(sub)).ok())
        .flat_map(|entries| entries.map(|e| e.unwrap().path()))
        .filter(|path| path.extension().is_some_and(|e| e == "ply"))
        .collect();
    models.sort();
    assert!(!models.is_empty(), "{} has no table63/*.ply and no dev/*.ply", folder.display());
    models
}

/// One of them.
pub fn model(name: &str) -> Option<PathBuf> {
    let models = models();
    let found = models.iter().find(|path| path.ends_with(name)).cloned();
    assert!(models.is_empty() || found.is_some(), "the folder of models has no {name}");
    found
}

/// The scan itself, welded.
fn whole(folder: &Folder, model: &Path) -> Done {
    folder.reduce(model, &["--faces", "1G", "--no-carry"]).done("in-core")
}

#[test]
fn every_model_gives_the_count_and_keeps_its_extent() {
    let folder = Folder::new();
    for model in models() {
        let scan = whole(&folder, &model);
        let irregular = scan.warnings().iter().any(|code| code.starts_with("non-manifold"));
        for (ratio, share) in [("10%", 10), ("1%", 100)] {
            let done = folder.reduce(&model, &["--ratio", ratio, "--no-carry"]).done("in-core");
            let asked = scan.report["input"]["faces"].as_u64().unwrap() as usize / share;
            let least = asked - if irregular { 2 } else { 1 };
            assert!((least..=asked).contains(&done.faces()), "{model:?} {ratio}: {} of {asked}", done.faces());
            let growth = done.mesh.diagonal() / scan.mesh.diagonal();
            // Fewer cannot hold the 26 bones of a foot, nor the noise of a noisy cube.
            if done.faces() >= 200 {
                assert!((growth - 1.0).abs() < 0.05, "{model:?} {ratio}: the diagonal is {growth} times as long");
            }
        }
    }
}

#[test]
fn large_models_go_out_of_core_as_well() {
    let folder = Folder::new();
    for model in models() {
        let scan = whole(&folder, &model);
        if scan.faces() < 500_000 {
            continue;
        }
        let asked = scan.faces() / 100;
        let done = folder
            .reduce(&model, &["--faces", &asked.to_string(), "--memory", "64MiB", "--no-carry"])
            .done("out-of-core");
        assert!((asked - 2..=asked).contains(&done.faces()), "{model:?}: {} of {asked}", done.faces());
        let growth = done.mesh.diagonal() / scan.mesh.diagonal();
        assert!((growth - 1.0).abs() < 0.05, "{model:?}: the diagonal is {growth} times as long");
    }
}

/// Faces that look against the scan: the nearest face of the scan looks the other way, and so does all of it within the face's own
/// size, so that it is not the other side of something thin.
fn turned_over(scan: &Mesh, result: &Mesh) -> usize {
    let corners = |mesh: &Mesh, face: &[u32; 3]| face.map(|v| DVec3::from(mesh.positions[v as usize]));
    let normal = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
    let whole = IndexedMesh { positions: scan.positions.clone(), faces: scan.faces.clone() };
    let tree = Tree::build(&whole);
    let over = |face: &&[u32; 3]| {
        let [a, b, c] = corners(result, face);
        let (center, size) = ((a + b + c) / 3.0, (a.distance(b) + b.distance(c) + c.distance(a)) / 3.0);
        let agrees = |other: &[u32; 3]| normal(corners(scan, other)).dot(normal([a, b, c])) > 0.0;
        !agrees(&scan.faces[tree.search(center, 0).0 as usize])
            && !scan.faces.iter().any(|f| agrees(f) && distance_sq(center, corners(scan, f)) < size * size)
    };
    result.faces.iter().filter(over).count()
}

#[test]
fn no_face_turns_over_no_border_opens_and_topology_is_kept_on_request() {
    let folder = Folder::new();
    for (name, faces) in
        [("cow", "300"), ("bunny", "1600"), ("femur", "1531"), ("exchanger", "1103"), ("teeth", "4242")]
    {
        let Some(path) = model(&format!("table63/{name}.ply")) else { return };
        let scan = whole(&folder, &path);
        let audit = |done: &Done| Audit::of(&done.mesh.faces, done.mesh.positions.len());
        let handles = |done: &Done| {
            let (found, mesh) = (audit(done), &done.mesh);
            let edges = (3 * mesh.faces.len() as u64 + found.irregularities.border_edges) / 2;
            (found.components, found.borders, (mesh.positions.len() + mesh.faces.len()) as i64 - edges as i64)
        };
        let was = audit(&scan);
        for more in [&[][..], &["--refit", "0"], &["--topology", "preserve"]] {
            let done = folder.reduce(&path, &[&["--faces", faces, "--no-carry"], more].concat()).done("in-core");
            let found = audit(&done);
            assert!(found.borders <= was.borders, "{name} {more:?}: {found:?}");
            assert!(found.irregularities.border_edges <= was.irregularities.border_edges, "{name} {more:?}: {found:?}");
            let turned = turned_over(&scan.mesh, &done.mesh);
            assert_eq!(turned, 0, "{name} {more:?}");
            if more.contains(&"preserve") {
                assert_eq!(handles(&done), handles(&scan), "{name}: components, borders, Euler's number");
            }
        }
    }
}
