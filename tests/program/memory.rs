//! The budget bounds the whole process; one that is too small is refused with one that works.

use crate::support::{Folder, Kind, torus};
use std::path::{Path, PathBuf};
#[cfg(all(target_os = "linux", target_env = "gnu"))]
use {
    crate::support::program,
    std::io::Write,
    std::process::Stdio,
    std::time::{Duration, Instant},
};

/// The same 120,000 faces in every form, and a scan of 600,000.
fn scans(folder: &Folder) -> Vec<PathBuf> {
    let mesh = torus(300, 200);
    let shuffled = mesh.clone().with_shuffled_faces();
    let both = shuffled.clone().with_shuffled_vertices();
    let mut scans: Vec<PathBuf> =
        [Kind::Floats, Kind::Doubles, Kind::Stl].map(|kind| folder.scan(&format!("{kind:?}"), &mesh, kind)).into();
    scans.push(folder.scan("text", &mesh, Kind::Text));
    scans.push(folder.scan("shuffled", &shuffled, Kind::Floats));
    scans.push(folder.scan("vertices too", &both, Kind::Floats));
    scans.push(folder.scan("vertices too, wide", &both, Kind::Doubles));
    scans.push(folder.synth("large.ply", "600k"));
    scans.push(folder.synth("large.stl", "600k"));
    scans
}

#[test]
fn budgets_are_kept_by_every_input_and_number_of_threads() {
    let folder = Folder::new();
    for scan in scans(&folder) {
        for memory in ["24MiB", "32MiB", "64MiB", "128MiB"] {
            for threads in ["1", "8"] {
                within(&folder, &scan, memory, threads);
            }
        }
    }
}

fn within(folder: &Folder, scan: &Path, memory: &str, threads: &str) {
    let outcome = folder.reduce(scan, &["--faces", "2000", "--memory", memory, "--threads", threads]);
    assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
    let bytes = |key: &str| outcome.object[key].as_u64().unwrap();
    let (peak, budget) = (bytes("peak_rss_bytes"), bytes("memory_budget_bytes"));
    assert!(peak <= budget, "{scan:?} within {memory}, {threads} threads: {peak} resident");
    let vertices = outcome.object["input"]["vertices"].as_u64().unwrap();
    if scan.extension().is_some_and(|e| e == "ply") && !scan.to_str().unwrap().contains(['s', 'v']) {
        // Binned vertices, and samples of 16 bytes beside them: 40 for each face that is asked for, more where cells are coarse.
        let coarser = outcome.object["ratio"].as_f64().map_or(1.0, |ratio| (10.0 / ratio).clamp(1.0, 2.0));
        let samples = (16.0 * 40.0 * 1.2 * coarser * coarser * 2000.0) as u64;
        assert!(bytes("scratch_bytes") <= 8 * vertices + samples + (1 << 16), "{scan:?} within {memory}");
    }
}

#[test]
fn a_budget_that_is_too_small_is_refused_with_one_that_works() {
    let folder = Folder::new();
    for scan in scans(&folder) {
        for faces in ["0", "30k", "1M"] {
            for memory in ["1", "16MiB", "32MiB"] {
                refused_or_done(&folder, &scan, faces, memory);
            }
        }
        assert!(!folder.names().iter().any(|name| name.starts_with('.')));
    }
}

fn refused_or_done(folder: &Folder, scan: &Path, faces: &str, memory: &str) -> serde_json::Value {
    let reduce = |memory: &str| folder.reduce(scan, &["--faces", faces, "--memory", memory]);
    let mut outcome = reduce(memory);
    let mut within = memory.to_string();
    if outcome.code != Some(0) {
        let message = outcome.failed(2);
        assert_eq!(outcome.object["error"]["code"], "budget");
        within = message.split("--memory ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap().to_string();
        outcome = reduce(&within);
    }
    assert_eq!(outcome.code, Some(0), "{scan:?} to {faces} within {within}: {}", outcome.stderr);
    let bytes = |key: &str| outcome.object[key].as_u64().unwrap();
    let (peak, budget) = (bytes("peak_rss_bytes"), bytes("memory_budget_bytes"));
    assert!(peak <= budget, "{scan:?} to {faces} within {within}: {peak} resident");
    outcome.object
}

/// Within the least budget that is enough, of a scan that is cut into hundreds of tiles: lists of where their records are
/// are short beside it.
#[test]
fn hundreds_of_tiles_keep_the_least_budget() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "1200k");
    let tiles = refused_or_done(&folder, &scan, "250k", "1")["tiles"].as_u64();
    assert!(tiles.is_some_and(|tiles| tiles > 300), "{tiles:?}");
}

#[test]
fn in_core_a_face_takes_90_bytes_at_most() {
    // The costliest ask: quadrics far from the target, costs and a reference near it.
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "2M");
    let outcome = folder.reduce(&scan, &["--faces", "200k", "--memory", "1GiB"]);
    assert_eq!((outcome.code, &outcome.object["mode"]), (Some(0), &"in-core".into()), "{}", outcome.stderr);
    let peak = outcome.object["peak_rss_bytes"].as_u64().unwrap();
    let program = 15 << 20;
    assert!(peak <= 90 * 2_000_000 + program, "{peak} resident");
}

/// While it waits for its scan it has started once more, with what the allocator may keep set; what else is set stays.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[test]
fn the_heap_is_bound_by_the_budget() {
    const BOUNDS: &str = "glibc.malloc.mmap_threshold=524288:glibc.malloc.trim_threshold=2097152";
    let folder = Folder::new();
    let scan = std::fs::read(folder.scan("torus", &torus(60, 40), Kind::Floats)).unwrap();
    let others = "glibc.malloc.arena_max=3";
    let chosen = "glibc.malloc.mmap_threshold=1048576";
    for (given, then) in [("", BOUNDS.into()), (others, format!("{others}:{BOUNDS}")), (chosen, chosen.to_string())] {
        let mut command = program();
        command.args(["reduce", "-", "--faces", "500", "--memory", "64MiB", "-o"]).arg(folder.path("out.ply"));
        command.env("GLIBC_TUNABLES", given).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut child = command.spawn().unwrap();
        let has_bounds = || {
            let all = std::fs::read(format!("/proc/{}/environ", child.id())).unwrap();
            // glibc ends each setting where it stands.
            let all = String::from_utf8_lossy(&all).replace('\0', ":");
            all.contains(&format!("GLIBC_TUNABLES={then}:"))
        };
        let begun = Instant::now();
        while !has_bounds() {
            assert!(begun.elapsed() < Duration::from_secs(60), "{given}: no {then}");
            std::thread::sleep(Duration::from_millis(5));
        }
        child.stdin.take().unwrap().write_all(&scan).unwrap();
        assert!(child.wait().unwrap().success());
    }
}
