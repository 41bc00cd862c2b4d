//! The command line as scripts see it: exit codes, and what goes to stdout and to stderr.

use assert_cmd::Command;
use serde_json::Value;

fn meshmill(args: &[&str]) -> Command {
    let mut command = Command::cargo_bin("meshmill").expect("the program is built with its tests");
    command.args(args);
    command
}

/// Refused as a wrong command, in words: what stderr says.
fn refused(args: &[&str]) -> String {
    let output = meshmill(args).assert().code(2).stdout("").get_output().clone();
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn help_and_version_go_to_stdout() {
    let version = format!("meshmill {}\n", env!("CARGO_PKG_VERSION"));
    meshmill(&["--version"]).assert().success().stdout(version).stderr("");
    let help = meshmill(&["--help"]).assert().success().stderr("").get_output().stdout.clone();
    let help = String::from_utf8(help).unwrap();
    for word in ["reduce", "run", "compare", "inspect", "synth", "Exit codes"] {
        assert!(help.contains(word), "{help}");
    }
    let help = meshmill(&["reduce", "--help"]).assert().success().get_output().stdout.clone();
    let help = String::from_utf8(help).unwrap();
    for option in [
        "--output",
        "--faces",
        "--ratio",
        "--max-error",
        "--memory",
        "--threads",
        "--scratch",
        "--verify",
        "--format",
        "--scratch-quota",
        "--json",
    ] {
        assert!(help.contains(option), "{option}: {help}");
    }
    let help = meshmill(&["compare", "--help"]).assert().success().get_output().stdout.clone();
    let help = String::from_utf8(help).unwrap();
    for option in ["--samples", "--every-vertex", "--seed", "--memory", "--threads", "--scratch", "--heatmap", "--json"]
    {
        assert!(help.contains(option), "{option}: {help}");
    }
}

#[test]
fn wrong_commands_exit_with_2_and_say_why() {
    for (args, why) in [
        (&[] as &[&str], "Usage"),
        (&["mill"], "unrecognized subcommand"),
        (&["reduce"], "required"),
        (&["reduce", "a.ply", "--faces", "9"], "--output"),
        (&["reduce", "a.ply", "-o", "b.ply"], "--faces"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--ratio", "1"], "cannot be used with"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--faces", "8"], "multiple times"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--colour"], "unexpected argument"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "ten"], "not a count"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "-5"], "not a count"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "10%"], "is a ratio"),
        (&["reduce", "a.ply", "-o", "b.ply", "--ratio", "0"], "not a ratio"),
        (&["reduce", "a.ply", "-o", "b.ply", "--ratio", "150%"], "not a ratio"),
        (&["reduce", "a.ply", "-o", "b.ply", "--max-error", "0"], "not a length"),
        (&["reduce", "a.ply", "-o", "b.ply", "--max-error", "inf"], "not a length"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--threads", "0"], "not a number of threads"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--memory", "-1MiB"], "-1"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--memory", "lots"], "not a size"),
        (&["compare", "a.ply"], "<B>"),
        (&["compare", "a.ply", "b.ply", "--samples", "some"], "not a count"),
        (&["reduce", "a.ply", "-o", "b.off", "--faces", "9"], "only .ply, .stl, .obj and .glb"),
        (&["reduce", "a.ply", "-o", "b", "--faces", "9"], "ends in .ply, .stl, .obj or .glb"),
        (&["reduce", "a.ply", "-o", "b.ply", "--faces", "9", "--format", "off"], "ply-ascii"),
        (&["inspect"], "<IN>"),
        (&["inspect", "a.ply", "--faces", "9", "--ratio", "1%"], "cannot be used with"),
        (&["synth", "a.obj", "--faces", "1k"], "a scan is made as .ply or .stl"),
        (&["run"], "JOB.toml"),
        (&["synth", "a.ply"], "--faces"),
    ] {
        let words = refused(args);
        assert!(words.contains(why), "{args:?}: {words}");
    }
}

#[test]
fn a_wrong_command_in_json_is_one_object_on_stdout() {
    for args in [
        &["reduce", "a.ply", "-o", "b.ply", "--faces", "ten", "--json"] as &[&str],
        &["reduce", "--json"],
        &["synth", "--json", "a.ply"],
        &["synth", "-", "--faces", "1k", "--json"],
        &["--json"],
    ] {
        let output = meshmill(args).assert().code(2).get_output().clone();
        let object: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((&object["schema"], &object["error"]["code"]), (&Value::from(1), &Value::from("usage")), "{args:?}");
        assert_eq!(object["version"], env!("CARGO_PKG_VERSION"));
        assert!(object["error"]["file"].is_null() && object["error"]["byte"].is_null());
        let message = object["error"]["message"].as_str().unwrap();
        assert!(!message.is_empty() && !message.contains("Usage") && !message.starts_with("error"), "{message}");
        assert!(!output.stderr.is_empty());
    }
    // Behind `--`, it is a file's name.
    assert_eq!(meshmill(&["synth", "--", "--json"]).assert().code(2).get_output().stdout, b"");
}

#[cfg(target_os = "linux")]
#[test]
fn a_reader_that_went_away_changes_nothing_and_a_full_stdout_is_told() {
    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("meshmill"));
    command.args(["run", concat!(env!("CARGO_MANIFEST_DIR"), "/configs/one-scan.toml"), "--dry-run"]);
    let output = command.stdout(full).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8(output.stderr).unwrap().contains("cannot write to stdout"));

    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let status = command.stdout(writer).status().unwrap();
    assert_eq!(status.code(), Some(0));
}
