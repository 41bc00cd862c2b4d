//! Job files as the program reads them, and every one in `configs/`.

use assert_cmd::Command;
use std::path::Path;

use meshmill::budget::Size;
use meshmill::cluster::Representative;
use meshmill::job::{JobFile, Target};

fn meshmill(args: &[&str]) -> Command {
    let mut command = Command::cargo_bin("meshmill").expect("the program is built with its tests");
    command.args(args);
    command
}

fn configs() -> Vec<std::path::PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    files.filter(|path| path.extension().is_some_and(|e| e == "toml")).collect()
}

#[test]
fn every_job_file_in_configs_resolves() {
    let files = configs();
    assert!(!files.is_empty());
    for path in files {
        let job = JobFile::read(&path).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(job.is_night(), !path.ends_with("one-scan.toml"), "{}", path.display());
        if !job.is_night() {
            job.resolve().unwrap_or_else(|e| panic!("{e}"));
        }
    }
}

#[test]
fn one_scan_says_what_its_comments_say() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/one-scan.toml");
    let job = JobFile::read(&path).unwrap().resolve().unwrap();
    assert_eq!((job.target, job.memory), (Target::Faces(100_000), Size(256 << 20)));
    assert_eq!((job.representative, job.policies), (Representative::Quadric, Default::default()));
    assert_eq!(job.input, path.parent().unwrap().join("../scan.ply"));
}

#[test]
fn one_scan_and_an_archive_show_every_key() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/one-scan.toml");
    let shown = std::fs::read_to_string(&path).unwrap();
    let archive = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/archive.toml");
    let archive = std::fs::read_to_string(&archive).unwrap();
    for key in JobFile::keys() {
        let line = format!("{key} = ");
        assert!(shown.contains(&line) || archive.contains(&line), "{key} is not shown");
    }
    // What is shown behind a `#` is right as well: every key of the night, uncommented.
    let night = archive.split_once("[night]\n").and_then(|(_, rest)| rest.split_once("[report]")).unwrap().0;
    let night = night.lines().map(|line| line.trim_start_matches("# ")).collect::<Vec<_>>().join("\n");
    let night = JobFile::parse(&format!("[[scan]]\ninput = 'a'\n[night]\n{night}")).unwrap().night.unwrap();
    assert!(night.folder.is_some() && night.memory.is_some() && night.workers.is_some(), "{night:?}");
    // What is shown behind a `#` is right as well: every key of the collapse, uncommented.
    let policies = shown.split_once("[collapse]\n").and_then(|(_, rest)| rest.split_once("[refit]")).unwrap().0;
    let policies = policies.lines().map(|line| line.trim_start_matches("# ")).collect::<Vec<_>>().join("\n");
    JobFile::parse(&format!("[scan]\ninput = 'a'\noutput = 'b'\nfaces = 9\n[collapse]\n{policies}")).unwrap();
}

#[test]
fn a_dry_run_prints_a_job_file_that_says_everything() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("night.toml");
    std::fs::write(&file, "[scan]\ninput = 'in/a.ply'\noutput = 'out/b.ply'\nmax_error = '0.05'\n").unwrap();
    let file = file.to_str().unwrap();

    let printed = meshmill(&["run", file, "--dry-run"]).assert().success().stderr("").get_output().stdout.clone();
    let printed = String::from_utf8(printed).unwrap();
    let job = JobFile::parse(&printed).unwrap().resolve().unwrap();
    assert_eq!(job, JobFile::read(Path::new(file)).unwrap().resolve().map(|job| with_scratch(&job)).unwrap());
    for key in ["memory", "threads", "scratch", "representative", "boundary_weight", "json", "verify"] {
        assert!(printed.contains(&format!("{key} = ")), "{key}: {printed}");
    }

    let object = meshmill(&["run", file, "--dry-run", "--json"]).assert().success().get_output().stdout.clone();
    let object: serde_json::Value = serde_json::from_slice(&object).unwrap();
    assert_eq!(object["schema"], 1);
    assert_eq!(object["job"]["scan"]["max_error"], 0.05);
    assert_eq!(object["job"]["run"]["memory"], "512MiB");
    assert_eq!(object["job"]["report"]["json"], true);
}

fn with_scratch(job: &meshmill::job::Job) -> meshmill::job::Job {
    meshmill::job::Job { scratch: Some(job.scratch_folder().into()), ..job.clone() }
}

#[test]
fn a_wrong_job_file_is_refused_with_its_line_and_exit_code_2() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("night.toml");
    std::fs::write(&file, "[scan]\ninput = 'a.ply'\noutptu = 'b.ply'\nfaces = 9\n").unwrap();
    let file = file.to_str().unwrap();

    let refused = meshmill(&["run", file]).assert().code(2).stdout("");
    let words = String::from_utf8_lossy(&refused.get_output().stderr).into_owned();
    for part in ["night.toml", "line 3, column 1", "3 | outptu = 'b.ply'", "^^^^^^", "did you mean `output`?"] {
        assert!(words.contains(part), "{part}: {words}");
    }

    let refused = meshmill(&["run", file, "--json"]).assert().code(2);
    let object: serde_json::Value = serde_json::from_slice(&refused.get_output().stdout).unwrap();
    assert_eq!(object["error"]["code"], "usage");
    assert_eq!(object["error"]["file"], file);
    assert!(object["error"]["message"].as_str().unwrap().contains("line 3"));
}

#[test]
fn what_is_no_job_file_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let binary = folder.path().join("scan.ply");
    std::fs::write(&binary, b"ply\nformat \xff\xfe\0").unwrap();
    let long = folder.path().join("long.toml");
    std::fs::write(&long, "#".repeat(2 << 20)).unwrap();
    let missing = folder.path().join("missing.toml");
    for path in [folder.path(), &binary, &long, &missing] {
        let path = path.to_str().unwrap();
        let refused = meshmill(&["run", path]).assert().code(2).stdout("");
        let words = String::from_utf8_lossy(&refused.get_output().stderr).into_owned();
        assert!(words.contains(path), "{words}");
    }
}
