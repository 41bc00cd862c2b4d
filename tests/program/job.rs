//! Job files that are run.

use crate::support::{Folder, Kind, Mesh, Outcome, field, program, torus};
use std::fs;
use std::path::Path;
use std::process::Command;

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

/// Inputs of the kind that each job file is for.
fn inputs() -> Folder {
    let folder = Folder::new();
    for name in ["configs", "scans", "scans/x", "scans/previews", "parts", "tiles", "ct", "ct/head", "table63"] {
        fs::create_dir(folder.path(name)).unwrap();
    }
    folder.synth("scan.ply", "240k");
    folder.scan("scans/x/a", &torus(60, 30), Kind::Floats);
    folder.scan("scans/x/statue 1", &torus(50, 30), Kind::Stl);
    folder.scan("scans/previews/a", &torus(10, 5), Kind::Floats);
    folder.scan("parts/flange", &torus(120, 60).scaled(60.0), Kind::Stl);
    let tile = |east: f64| field(50, 40).map(move |[x, y, z]| [x + 456_000.0 + east, y + 5_412_000.0, z + 310.0]);
    folder.scan("tiles/east", &tile(50.0), Kind::Doubles);
    folder.scan("tiles/west", &tile(0.0), Kind::Doubles);
    folder.scan("ct/head/bone", &torus(80, 40).and(torus(6, 4).scaled(0.01)), Kind::Stl);
    folder.scan("table63/blobby_v", &torus(62, 31), Kind::Floats);
    folder.scan("table63/cow", &torus(70, 41), Kind::Floats);
    folder
}

#[test]
fn every_night_in_configs_runs() {
    let folder = inputs();
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let mut ran = 0;
    for entry in fs::read_dir(configs).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "toml") || path.ends_with("one-scan.toml") {
            continue;
        }
        let job = folder.path("configs").join(path.file_name().unwrap());
        fs::copy(&path, &job).unwrap();
        let output = program().arg("run").arg(&job).arg("--json").output().unwrap();
        let words = String::from_utf8_lossy(&output.stderr).into_owned();
        // An estimate may be exceeded: then the row and the exit code say so.
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        let unmet = path.ends_with("max-error-mm.toml") && report["totals"]["unmet"] == 1;
        assert_eq!(output.status.code(), Some(i32::from(unmet)), "{}: {words}", path.display());
        ran += 1;
    }
    assert_eq!(ran, 6);
    let faces = |name: &str| Mesh::read(&folder.path(name)).faces.len();
    assert_eq!([200_000, 20_000, 2_000], ["200k", "20k", "2k"].map(|n| faces(&format!("lods/scan.{n}.ply"))));
    assert_eq!(faces("reduced/x/a.200k.ply"), 3600);
    assert!(folder.path("reduced/x/statue 1.1M.stl").exists() && !folder.path("reduced/previews").exists());
    assert!(faces("parts-reduced/flange.ply") < 7200);
    assert_eq!(faces("ct-reduced/head/bone.10pct.ply"), 644);
    // Tiles still meet: what was on the seam is where it was, in both.
    let seam = |name: &str| -> Vec<[f64; 3]> {
        let positions = Mesh::read(&folder.path(name)).positions;
        let mut seam: Vec<_> = positions.into_iter().filter(|p| p[0] == 456_050.0).collect();
        seam.sort_by(|a, b| a[1].total_cmp(&b[1]));
        seam
    };
    assert_eq!(seam("tiles-reduced/west.ply"), seam("tiles-reduced/east.ply"));
    assert_eq!(seam("tiles-reduced/west.ply").len(), 41);
}

#[test]
fn shards_run_by_the_scripts_in_configs() {
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    for (script, args) in [("gnu-parallel.sh", &["4"] as &[&str]), ("slurm-array.sh", &[])] {
        let folder = inputs();
        let job =
            folder.file("night.toml", "[[scan]]\ninput = 'scans'\noutput = 'out/{dir}/{stem}.ply'\nfaces = 100\n");
        let bin = folder.path("bin");
        fs::create_dir(&bin).unwrap();
        // What the machines have and a test need not: each part in turn.
        let parallel = "#!/usr/bin/env bash\nshift 2\nstatus=0\n\
                        while read -r i; do \"${@//\\{\\}/$i}\" </dev/null || status=1; done\nexit $status\n";
        let stand_in = bin.join("parallel");
        fs::write(&stand_in, parallel).unwrap();
        Command::new("chmod").arg("+x").arg(&stand_in).status().unwrap();
        let path = format!("{}:{}", bin.display(), std::env::var("PATH").unwrap());
        let mut command = Command::new("bash");
        command.arg(scripts.join(script)).arg(&job).args(args).env("PATH", path);
        command
            .env("MESHMILL", program().get_program())
            .env("SLURM_ARRAY_TASK_ID", "1")
            .env("SLURM_ARRAY_TASK_COUNT", "4");
        let output = command.output().unwrap();
        let words = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(0), "{script}: {words}");
        assert!(folder.path("out/report.1-of-4.json").exists(), "{script}: {words}");
        assert_eq!(folder.path("out/report.html").exists(), script.starts_with("gnu"), "{script}: {words}");
    }
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
