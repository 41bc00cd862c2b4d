//! Real scans, where `MESHMILL_MODELS` names a folder of them.

use crate::support::{Done, Folder};
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
