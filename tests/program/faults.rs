//! A night in which something goes wrong with a scan: one failed row, and the others unharmed.

use crate::night::{JOB, archive, children, files, ledger, report, row, run, signal, start, until};
use crate::support::Folder;
use serde_json::Value;
use std::fs;
use std::time::Duration;

/// Waits until a scan has begun.
#[track_caller]
fn until_begun(folder: &Folder, scan: &str) {
    until(scan, || ledger(folder, "scan").iter().any(|begun| begun.ends_with(scan)));
}

/// An STL that takes no room on the disk, and a while to read.
fn sparse(folder: &Folder, name: &str, faces: u32) -> fs::File {
    let path = folder.file(name, [[b' '; 80].as_slice(), &faces.to_le_bytes()].concat());
    let file = fs::File::options().write(true).open(path).unwrap();
    file.set_len(84 + 50 * u64::from(faces)).unwrap();
    file
}

#[track_caller]
fn failed<'a>(object: &'a Value, scan: &str, codes: &[&str], why: &str) -> &'a str {
    let row = row(object, scan);
    let (code, message) = (row["error"]["code"].as_str().unwrap(), row["error"]["message"].as_str().unwrap());
    assert!(row["status"] == "failed" && codes.contains(&code) && message.contains(why), "{row}");
    message
}

#[test]
fn what_befalls_one_scan_is_one_failed_row() {
    let folder = archive();
    let cut = sparse(&folder, "scans/cut.stl", 30_000_000);
    fs::copy(folder.synth("scans/killed.ply", "300k"), folder.path("scans/quota.ply")).unwrap();
    fs::copy(folder.path("scans/torus.ply"), folder.path("scans/vanished.ply")).unwrap();
    let (tables, rest) = JOB.split_once("[run]").unwrap();
    let small = "[[scan]]\ninput = 'scans/quota.ply'\nrun = { memory = '24MiB', scratch_quota = '100kB' }\n";
    let night = "[night]\nworkers = 1\norder = 'name'\nretries = 0\n";
    folder.file("night.toml", format!("{tables}{small}[run]{rest}{night}"));

    let child = start(&folder);
    until_begun(&folder, "cut.stl");
    std::thread::sleep(Duration::from_millis(100));
    cut.set_len(500_000_000).unwrap();
    until_begun(&folder, "killed.ply");
    children(child.id()).iter().for_each(|worker| signal(*worker, "KILL"));
    until_begun(&folder, "quota.ply");
    fs::remove_file(folder.path("scans/vanished.ply")).unwrap();
    let object = report(&child.wait_with_output().unwrap(), 1);

    // Between two windows the new size is an error; within one it is a signal.
    let message = failed(&object, "cut.stl", &["bad-input", "io"], "");
    assert!(message.contains("500000000 now") || message.contains("cut short"), "{message}");
    failed(&object, "killed.ply", &["crash"], "SIGKILL");
    failed(&object, "quota.ply", &["io"], "quota");
    failed(&object, "vanished.ply", &["io"], "cannot open");
    assert_eq!((&object["totals"]["done"], &object["totals"]["failed"]), (&4.into(), &4.into()), "{object}");
    let stray = |name: &str| ["cut", "killed", "quota", "vanished", ".tmp"].iter().any(|word| name.contains(word));
    let left: Vec<_> = files(&folder.path("out")).into_keys().filter(|path| stray(&path.to_string_lossy())).collect();
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn what_a_failed_scan_has_written_is_taken_back() {
    let folder = archive();
    // Reduced in no time, and measured for long.
    let samples = JOB.replace("64MiB", "2GiB").replace("2000", "16_000_000");
    folder.file("night.toml", format!("{samples}[night]\nscan_time = '1s'\npictures = false\n"));
    let older = folder.path("out/torus.200.ply");
    fs::create_dir_all(folder.path("out")).unwrap();
    fs::write(&older, "of another night").unwrap();
    let object = report(&run(&folder, &["--json", "--only", "torus.ply"]), 1);
    failed(&object, "torus.ply", &["time"], "longer than the 1 s");
    let warnings = row(&object, "torus.ply")["warnings"].to_string();
    assert!(warnings.contains("removed"), "{object}");
    assert!(files(&folder.path("out")).into_keys().all(|path| path.extension().is_none_or(|e| e != "ply")));
}
