//! `meshmill run` of many scans: what is done, what is not done twice, and what becomes of the rest when one goes wrong.

use crate::support::{Folder, Kind, Mesh, field, program, torus};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

pub const JOB: &str = "[[scan]]\ninput = 'scans/**/*.{ply,stl}'\noutput = 'out/{dir}/{stem}.{faces}.ply'\n\
                   faces = [800, 200]\n[run]\nmemory = '64MiB'\n[report]\nsamples = 2000\n";

/// A folder with a few scans of several kinds, in folders of their own.
pub fn archive() -> Folder {
    let folder = Folder::new();
    for name in ["scans", "scans/a", "scans/a/b"] {
        fs::create_dir(folder.path(name)).unwrap();
    }
    folder.scan("scans/torus", &torus(80, 40), Kind::Floats);
    folder.scan("scans/a/wide", &field(60, 50).map(|[x, y, z]| [x + 5e5, y + 4e6, z]), Kind::Doubles);
    folder.scan("scans/a/text", &torus(60, 30), Kind::Text);
    folder.scan("scans/a/b/soup & <b>", &torus(70, 40), Kind::Stl);
    folder.file("night.toml", JOB);
    folder
}

pub fn run(folder: &Folder, args: &[&str]) -> Output {
    program().arg("run").arg(folder.path("night.toml")).args(args).output().unwrap()
}

/// The report of a run with this exit code.
#[track_caller]
pub fn report(output: &Output, code: i32) -> Value {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{stderr}");
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {stderr}"))
}

/// The row of the scan whose path ends so.
#[track_caller]
pub fn row<'a>(report: &'a Value, scan: &str) -> &'a Value {
    let rows = report["rows"].as_array().unwrap();
    rows.iter().find(|row| row["scan"].as_str().unwrap().ends_with(scan)).unwrap_or_else(|| panic!("{scan}: {report}"))
}

/// All files below a folder, by their paths, without those whose name changes from run to run.
pub fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).into_iter().flatten().flatten() {
            if entry.file_type().unwrap().is_dir() {
                folders.push(entry.path());
            } else {
                found.insert(entry.path().strip_prefix(root).unwrap().into(), fs::read(entry.path()).unwrap());
            }
        }
    }
    found
}

/// Results and pictures.
fn results(folder: &Folder) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = files(&folder.path("out"));
    found.retain(|path, _| path.extension().is_some_and(|e| e == "ply" || e == "jpg"));
    found
}

/// Scans that the ledger has this event of, in its order.
pub fn ledger(folder: &Folder, event: &str) -> Vec<String> {
    let text = fs::read_to_string(folder.path("out/ledger.jsonl")).unwrap_or_default();
    let records = text.lines().filter_map(|line| serde_json::from_str::<Value>(line.get(17..)?).ok());
    let of = records.filter(|record| record["event"] == event);
    of.map(|record| record["scan"].as_str().unwrap_or("").to_string()).collect()
}

#[test]
fn an_archive_is_reduced_once_and_the_report_tells_all() {
    let folder = archive();
    fs::create_dir(folder.path("scans/bad")).unwrap();
    let whole = fs::read(folder.path("scans/torus.ply")).unwrap();
    folder.file("scans/bad/cut.ply", &whole[..whole.len() / 2]);
    folder.file("scans/bad/empty.stl", b"");
    let first = report(&run(&folder, &["--json"]), 1);
    assert_eq!((&first["totals"]["done"], &first["totals"]["failed"]), (&4.into(), &2.into()), "{first}");
    assert!(first["peak_rss_bytes"].as_u64() <= first["memory"].as_u64(), "{first}");
    let cut = row(&first, "bad/cut.ply");
    assert_eq!((&cut["status"], &cut["error"]["code"]), (&"failed".into(), &"bad-input".into()));
    assert!(cut["error"]["message"].as_str().unwrap().contains("cut.ply") && cut["tries"] == 1);
    let faces = |name: &str| Mesh::read(&folder.path("out").join(name)).faces.len();
    for (name, asked) in [("torus.800.ply", 800), ("torus.200.ply", 200), ("a/text.800.ply", 800)] {
        assert_eq!(faces(name), asked, "{name}");
    }
    // A face at a border goes alone.
    assert!((199..=200).contains(&faces("a/wide.200.ply")));
    let done = row(&first, "soup & <b>.stl");
    assert!(done["report"]["deviation"]["rms"].as_f64().unwrap() > 0.0, "{done}");
    assert!(done["report"]["coarser"][0]["deviation"]["rms"].as_f64().unwrap() > 0.0, "{done}");
    assert!(fs::read(folder.path("out").join(done["picture"].as_str().unwrap())).unwrap().starts_with(b"\xff\xd8"));

    let page = fs::read_to_string(folder.path("out/report.html")).unwrap();
    assert!(page.contains("soup &amp; &lt;b&gt;.stl") && !page.contains("& <b>"), "a name is markup");
    assert_eq!(page.matches("data:image/jpeg").count(), 4);
    assert!(!page.contains("http://") && !page.contains("https://"), "the page needs a network");
    assert!(page.find("Failed</h2>") < page.find("Scans</h2>"));
    let table = fs::read_to_string(folder.path("out/report.csv")).unwrap();
    assert_eq!(table.lines().count(), 1 + 2 * 6);

    // What is finished is not begun again, and what has bad data is not either.
    let before = (results(&folder), ledger(&folder, "scan").len());
    let second = report(&run(&folder, &["--json"]), 1);
    assert_eq!((results(&folder), ledger(&folder, "scan").len()), before);
    assert_eq!(second["totals"]["done"], 4);

    // A changed scan is, and one whose result is gone, and one with other options.
    folder.scan("scans/torus", &torus(90, 40), Kind::Floats);
    fs::remove_file(folder.path("out/a/text.200.ply")).unwrap();
    let again: Vec<String> = {
        run(&folder, &[]);
        ledger(&folder, "scan").split_off(before.1)
    };
    assert_eq!(again.len(), 2, "{again:?}");
    folder.file("night.toml", JOB.replace("64MiB", "65MiB"));
    run(&folder, &[]);
    assert_eq!(ledger(&folder, "scan").len(), before.1 + 2 + 6);
    run(&folder, &["--only", "cut.ply"]);
    assert!(ledger(&folder, "scan").last().unwrap().ends_with("cut.ply"));
}

pub fn start(folder: &Folder) -> Child {
    let mut command = program();
    command.arg("run").arg(folder.path("night.toml")).arg("--json").stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

/// Waits for something.
#[track_caller]
pub fn until(what: &str, mut is: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is() {
        assert!(begun.elapsed() < Duration::from_secs(60), "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_night_that_is_killed_is_resumed_to_the_same_bytes() {
    let undisturbed = archive();
    report(&run(&undisturbed, &["--json"]), 0);
    let wanted = results(&undisturbed);
    let names: Vec<PathBuf> = files(&undisturbed.path("out")).into_keys().collect();

    let folder = archive();
    for kills in 0..6u64 {
        let begun = ledger(&folder, "began").len();
        let mut child = start(&folder);
        let over = |child: &mut Child| child.try_wait().unwrap().is_some();
        until("the night begins", || ledger(&folder, "began").len() > begun || over(&mut child));
        std::thread::sleep(Duration::from_millis(37 * kills));
        let _ = child.kill();
        child.wait().unwrap();
    }
    let last = report(&run(&folder, &["--json"]), 0);
    assert_eq!(last["totals"]["done"], 4);
    let found = results(&folder);
    assert_eq!(found.keys().collect::<Vec<_>>(), wanted.keys().collect::<Vec<_>>());
    assert!(found == wanted, "other bytes");
    let left: Vec<PathBuf> = files(&folder.path("out")).into_keys().collect();
    assert_eq!(left, names, "stray files");
    let mut finished = ledger(&folder, "finished");
    finished.sort();
    assert!(finished.windows(2).all(|two| two[0] != two[1]), "done twice: {finished:?}");
}

/// Children of a process.
pub fn children(parent: u32) -> Vec<u32> {
    let path = format!("/proc/{parent}/task/{parent}/children");
    fs::read_to_string(path).unwrap_or_default().split_whitespace().filter_map(|pid| pid.parse().ok()).collect()
}

pub fn signal(process: u32, name: &str) {
    Command::new("kill").args([format!("-{name}"), process.to_string()]).status().unwrap();
}

#[test]
fn a_worker_that_dies_costs_a_try_and_nothing_else() {
    let folder = archive();
    folder.synth("scans/zz.ply", "300k");
    let child = start(&folder);
    until("the large scan begins", || ledger(&folder, "scan").iter().any(|scan| scan.ends_with("zz.ply")));
    let worker = children(child.id());
    worker.iter().for_each(|pid| signal(*pid, "KILL"));
    let object = report(&child.wait_with_output().unwrap(), 0);
    assert_eq!(object["totals"]["done"], 5, "{object}");
    let tried = row(&object, "zz.ply");
    assert!(tried["tries"] == 2 && tried["warnings"][0].as_str().unwrap().contains("try 2"), "{tried}");
}

#[test]
fn sigint_ends_a_night_and_the_same_command_goes_on() {
    let folder = archive();
    folder.synth("scans/zz.ply", "300k");
    let child = start(&folder);
    until("a scan begins", || !ledger(&folder, "scan").is_empty());
    signal(child.id(), "INT");
    let object = report(&child.wait_with_output().unwrap(), 130);
    assert!(object["totals"]["not_begun"].as_u64().unwrap() > 0 && object["totals"]["failed"] == 0, "{object}");
    assert_eq!(row(&object, "zz.ply")["status"], "not-begun");
    assert!(!files(&folder.path("out")).keys().any(|path| path.to_string_lossy().contains(".tmp")));
    assert_eq!(report(&run(&folder, &["--json"]), 0)["totals"]["done"], 5);
}

#[test]
fn a_second_run_is_refused_while_the_first_lives() {
    let folder = archive();
    folder.synth("scans/zz.ply", "300k");
    let child = start(&folder);
    until("the night begins", || !ledger(&folder, "scan").is_empty());
    let second = run(&folder, &[]);
    assert_eq!(second.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&second.stderr).contains("another run is at work"));
    report(&child.wait_with_output().unwrap(), 0);
}

#[test]
fn what_cannot_work_is_refused_before_anything_starts() {
    let folder = archive();
    let refused = |job: &str, why: &str| {
        folder.file("night.toml", job);
        for args in [&["--dry-run"] as &[&str], &[]] {
            let output = run(&folder, args);
            let words = [output.stdout, output.stderr].concat();
            let words = String::from_utf8_lossy(&words).into_owned();
            assert!(output.status.code() == Some(2) && words.contains(why), "{words}");
        }
        assert_eq!(folder.names(), ["night.toml", "scans"]);
    };
    refused(&JOB.replace("{stem}.{faces}", "same"), "is that of");
    refused(&JOB.replace("{stem}", "{steem}"), "did you mean `{stem}`?");
    let into_scans = "output = 'scans/{dir}/{stem}.ply'\nfaces = 100";
    refused(&format!("[[scan]]\ninput = 'scans/**/*.{{ply,stl}}'\n{into_scans}"), "would overwrite");
    refused(&JOB.replace("out/{dir}", "scans/torus.ply/{dir}"), "cannot write");
    refused(&JOB.replace("scans/**", "nowhere/**"), "does not exist");
    refused(&JOB.replace("*.{ply,stl}", "*.obj"), "no scan is found");
    refused(&format!("{JOB}[night]\nmemory = '90MiB'\n"), "112MiB");
}

#[test]
fn those_that_can_be_done_are_with_keep_going() {
    let folder = archive();
    folder.file("blocked", b"");
    let more = "[[scan]]\ninput = 'scans/a/text.ply'\noutput = 'blocked/x.{faces}.ply'\n\
                [[scan]]\ninput = 'gone.ply'\noutput = 'out/gone.{faces}.ply'\nfaces = 9\n";
    let (tables, rest) = JOB.split_once("[run]").unwrap();
    folder.file("night.toml", format!("{tables}{more}[run]{rest}"));
    assert_eq!(run(&folder, &[]).status.code(), Some(2));
    let object = report(&run(&folder, &["--json", "--keep-going"]), 1);
    assert_eq!((&object["totals"]["done"], &object["totals"]["failed"]), (&3.into(), &2.into()), "{object}");
    assert_eq!(row(&object, "text.ply")["error"]["code"], "refused");
    let gone = row(&object, "gone.ply");
    assert!(gone["error"]["message"].as_str().unwrap().contains("cannot open") && gone["tries"] == 1, "{gone}");
    // What repeats one scan does not stumble over another.
    assert_eq!(report(&run(&folder, &["--json", "--only", "a/wide.ply"]), 0)["totals"]["done"], 3);
    let refused = run(&folder, &["--only", "a/text.ply"]);
    assert!(refused.status.code() == Some(2) && String::from_utf8_lossy(&refused.stderr).contains("cannot write"));
}

#[test]
fn folders_of_one_disk_share_its_room() {
    let folder = archive();
    let df = Command::new("df").args(["--output=avail", "-B1"]).arg(folder.path("")).output().unwrap();
    let free: u64 = String::from_utf8_lossy(&df.stdout).lines().last().unwrap().trim().parse().unwrap();
    // Half of each is two fifths of what is free: two have room, three have not.
    let job = JOB.replace("faces = [800, 200]", "ratio = 0.5");
    for (name, code) in [("x", 0), ("a/y", 0), ("a/b/z", 2)] {
        let path = folder.file(&format!("scans/{name}.stl"), b"");
        fs::File::options().write(true).open(path).unwrap().set_len(free / 5 * 4).unwrap();
        folder.file("night.toml", job.replace("'scans/**/*.{ply,stl}'", "['scans/x.stl', 'scans/a/**/[yz].stl']"));
        let output = run(&folder, &["--dry-run", "--json"]);
        let plan: Value = serde_json::from_slice(&output.stdout).unwrap();
        let problems = plan["plan"]["problems"].to_string();
        assert_eq!(problems.contains("on this disk"), code == 2, "{name}: {problems}");
        assert_eq!(output.status.code(), Some(code), "{problems}");
    }
}

#[test]
fn shards_together_are_the_whole() {
    let whole = archive();
    report(&run(&whole, &["--json"]), 0);
    let folder = archive();
    let shards: Vec<_> = (1..=3)
        .map(|i| {
            let mut command = program();
            command.arg("run").arg(folder.path("night.toml")).arg("--shard").arg(format!("{i}/3"));
            command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
        })
        .collect();
    for shard in shards {
        let output = shard.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    }
    let meshes = |folder: &Folder| {
        let mut found = results(folder);
        found.retain(|path, _| path.extension().unwrap() == "ply");
        found
    };
    assert_eq!(meshes(&folder), meshes(&whole));
    let reports = (1..=3).map(|i| folder.path(&format!("out/report.{i}-of-3.json")));
    let merged = folder.path("merged");
    let output =
        program().args(["report", "merge"]).args(reports).arg("-o").arg(&merged).arg("--json").output().unwrap();
    let object = report(&output, 0);
    assert_eq!((&object["totals"]["scans"], &object["totals"]["done"]), (&4.into(), &4.into()));
    let page = fs::read_to_string(merged.join("report.html")).unwrap();
    assert_eq!(page.matches("data:image/jpeg").count(), 4);
    // The whole finds what shards have done.
    let begun = ledger(&folder, "scan").len();
    assert_eq!(report(&run(&folder, &["--json"]), 0)["totals"]["done"], 4);
    assert_eq!(ledger(&folder, "scan").len(), begun);
}

#[test]
fn a_night_begins_nothing_that_it_cannot_finish() {
    let folder = archive();
    // Of a size that takes hours: it has no bytes on the disk, and is never opened.
    let large = fs::File::create(folder.path("scans/large.stl")).unwrap();
    large.set_len(600_000_000_000).unwrap();
    let time = |minutes: u32| {
        let now = Command::new("date").arg(format!("--date=+{minutes} minutes")).arg("+%H:%M").output().unwrap();
        String::from_utf8(now.stdout).unwrap().trim().to_string()
    };
    folder.file("night.toml", format!("{JOB}[night]\nstop_at = '{}'\n", time(10)));
    let object = report(&run(&folder, &["--json"]), 1);
    assert_eq!((&object["totals"]["done"], &object["totals"]["not_begun"]), (&4.into(), &1.into()), "{object}");
    assert!(object["ended_early"].as_str().unwrap().starts_with("stop_at"), "{object}");
}

#[test]
fn a_scan_that_takes_too_long_is_ended() {
    let folder = archive();
    folder.synth("scans/zz.ply", "1M");
    folder.file("night.toml", format!("{JOB}[night]\nscan_time = '0.05s'\npictures = false\n"));
    let object = report(&run(&folder, &["--json", "--only", "zz.ply"]), 1);
    let late = row(&object, "zz.ply");
    assert_eq!((&late["status"], &late["error"]["code"]), (&"failed".into(), &"time".into()), "{late}");
    assert!(!files(&folder.path("out")).keys().any(|path| path.to_string_lossy().contains("zz")));
}
