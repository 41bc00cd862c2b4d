//! Real scans, where `MESHMILL_MODELS` names a folder of them.

use crate::support::{Folder, Mesh};
use std::path::PathBuf;

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

#[test]
fn every_model_gives_the_count_and_keeps_its_extent() {
    let folder = Folder::new();
    for model in models() {
        for ratio in ["10%", "1%"] {
            let done = folder.reduce(&model, &["--ratio", ratio]).done("in-core");
            let input = done.report["input"]["faces"].as_u64().unwrap() as usize;
            let asked = input / if ratio == "1%" { 100 } else { 10 };
            let irregular = done.warnings().iter().any(|code| code.starts_with("non-manifold"));
            let least = asked - if irregular { 2 } else { 1 };
            assert!((least..=asked).contains(&done.faces()), "{model:?} {ratio}: {} of {asked}", done.faces());
            let (before, after) = (Mesh::read_any(&model).diagonal(), done.mesh.diagonal());
            assert!((after / before - 1.0).abs() < 0.05, "{model:?} {ratio}: diagonal {before} became {after}");
        }
    }
}

#[test]
fn large_models_go_out_of_core_as_well() {
    let folder = Folder::new();
    for model in models() {
        let scan = Mesh::read_any(&model);
        if scan.faces.len() < 400_000 {
            continue;
        }
        let asked = scan.faces.len() / 100;
        let done = folder.reduce(&model, &["--faces", &asked.to_string(), "--memory", "48MiB"]).done("out-of-core");
        assert!((asked - 2..=asked).contains(&done.faces()), "{model:?}: {} of {asked}", done.faces());
        let growth = done.mesh.diagonal() / scan.diagonal();
        assert!((growth - 1.0).abs() < 0.05, "{model:?}: the diagonal became {growth} times as long");
    }
}
