//! Runs that are ended from outside, and runs side by side.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, program, torus};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

fn start(folder: &Folder, scan: &Path, args: &[&str]) -> Child {
    let mut command = program();
    command.arg("reduce").arg(scan).arg("-o").arg(folder.path("out.ply")).args(args).arg("--json");
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Waits until the run has made its temporary file, and a moment more.
fn under_way(folder: &Folder, moment: Duration) {
    let begun = Instant::now();
    while !folder.names().iter().any(|name| name.starts_with(".meshmill-")) {
        assert!(begun.elapsed() < Duration::from_secs(20), "the run does not begin");
        std::thread::sleep(Duration::from_millis(1));
    }
    std::thread::sleep(moment);
}

fn signal(child: &Child, name: &str) {
    let status = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status().unwrap();
    assert!(status.success());
}

#[test]
fn a_signal_ends_a_run_and_nothing_is_left() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "4M");
    let moments = [0, 30, 90, 150].map(Duration::from_millis);
    for (name, code) in [("INT", 130), ("TERM", 143)] {
        for (moment, memory) in moments.into_iter().flat_map(|m| [(m, "512MiB"), (m, "32MiB")]) {
            let child = start(&folder, &scan, &["--faces", "2000", "--memory", memory]);
            under_way(&folder, moment);
            signal(&child, name);
            let sent = Instant::now();
            let output = child.wait_with_output().unwrap();
            if moment > moments[1] && output.status.success() {
                // Faster than the signal: there is nothing to interrupt.
                std::fs::remove_file(folder.path("out.ply")).unwrap();
                continue;
            }
            assert!(sent.elapsed() < Duration::from_secs(10), "{:?} until the run ended", sent.elapsed());
            assert_eq!(output.status.code(), Some(code), "{}", String::from_utf8_lossy(&output.stderr));
            let object: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
            assert_eq!(object["error"]["code"], "interrupted");
            assert_eq!(folder.names(), ["scan.ply"], "after SIG{name} at {moment:?} within {memory}");
        }
    }
}

#[test]
fn what_a_killed_run_leaves_the_next_one_sweeps() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "4M");
    let mut child = start(&folder, &scan, &["--faces", "2000", "--memory", TIGHT]);
    under_way(&folder, Duration::ZERO);
    child.kill().unwrap();
    child.wait().unwrap();
    let names = folder.names();
    let left: Vec<_> = names.iter().filter(|name| *name != "scan.ply").collect();
    assert!(!left.is_empty(), "the run had ended");
    assert!(left.iter().all(|name| name.starts_with(".meshmill-") && name.ends_with(".tmp")), "{left:?}");

    let small = Folder::new();
    let small = small.scan("small", &torus(10, 10), Kind::Floats);
    let args = ["--faces", "100"];
    // The scan is elsewhere, the target's folder is what is swept.
    assert!(!small.exists() || folder.reduce(&small, &args).done("in-core").faces() <= 100);
    assert_eq!(folder.names(), ["out.ply", "scan.ply"]);
}

#[test]
fn runs_into_one_target_do_not_disturb_each_other() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &torus(300, 180), Kind::Floats);
    let runs: Vec<_> = (0..6)
        .map(|i| start(&folder, &scan, &["--faces", "1000", "--memory", if i % 2 == 0 { TIGHT } else { "256MiB" }]))
        .collect();
    for run in runs {
        let output = run.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    }
    assert_eq!(Mesh::read(&folder.path("out.ply")).faces.len(), 1000);
    assert_eq!(folder.names(), ["out.ply", "scan.ply"]);
}
