//! Job files that are run.

use crate::support::{Folder, Mesh, Outcome, program};
use std::fs;
use std::path::Path;

#[test]
fn the_job_file_to_start_from_runs() {
    let folder = Folder::new();
    folder.synth("scan.ply", "240k");
    fs::create_dir(folder.path("configs")).unwrap();
    let job = folder.path("configs/one-scan.toml");
    fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/one-scan.toml"), &job).unwrap();

    let dry = program().arg("run").arg(&job).arg("--dry-run").output().unwrap();
    assert!(dry.status.success());
    assert!(!folder.path("small.ply").exists(), "a dry run does nothing");

    let output = program().arg("run").arg(&job).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let words = String::from_utf8(output.stdout).unwrap();
    assert!(words.contains("scan") && words.contains("result"), "{words}");
    assert_eq!(Mesh::read(&folder.path("small.ply")).faces.len(), 100_000);

    // What the dry run printed says the same, from any folder.
    let elsewhere = Folder::new();
    let printed = elsewhere.file("printed.toml", &dry.stdout);
    let bytes = fs::read(folder.path("small.ply")).unwrap();
    fs::remove_file(folder.path("small.ply")).unwrap();
    let mut command = program();
    command.arg("run").arg(&printed).arg("--json");
    assert!(Outcome::of(command, folder.path("small.ply")).done("in-core").bytes == bytes);
    assert_eq!(elsewhere.names(), ["printed.toml"]);
}

#[test]
fn a_job_of_a_scan_that_is_bad_fails_as_reduce_does() {
    let folder = Folder::new();
    folder.file("scan.ply", "ply\nformat ascii 1.0\n");
    let job = folder.file("job.toml", "[scan]\ninput = 'scan.ply'\noutput = 'out.ply'\nfaces = 10\n");
    let mut command = program();
    command.arg("run").arg(job).arg("--json");
    assert!(Outcome::of(command, folder.path("out.ply")).failed(1).contains("scan.ply"));
    assert_eq!(folder.names(), ["job.toml", "scan.ply"]);
}
