//! `meshmill compare` and `reduce --verify`: figures, memory, bytes, and what they do with what cannot be measured.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, Outcome, field, find, program, torus};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Stdio;

fn compare(folder: &Folder, a: &Path, b: &Path, args: &[&str]) -> Outcome {
    let mut command = program();
    command.arg("compare").arg(a).arg(b).args(["--scratch", folder.path("").to_str().unwrap(), "--json"]).args(args);
    Outcome::of(command, PathBuf::new())
}

/// The object of a comparison that succeeds and keeps its budget.
#[track_caller]
fn compared(folder: &Folder, a: &Path, b: &Path, args: &[&str]) -> Value {
    let outcome = compare(folder, a, b, args);
    assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
    let object = outcome.object;
    let (peak, budget) = (object["peak_rss_bytes"].as_u64(), object["memory_budget_bytes"].as_u64());
    assert!(peak.is_none_or(|peak| peak <= budget.unwrap()), "{object}");
    object
}

/// What does not depend on the machine.
fn figures(object: &Value) -> String {
    let of = |key: &&str| object[key].to_string();
    ["e_avg", "e_max", "mean", "rms", "max", "diagonal", "samples", "a_to_b", "b_to_a", "shares"]
        .iter()
        .map(of)
        .collect::<Vec<_>>()
        .join(" ")
}

fn number(object: &Value, path: &str) -> f64 {
    object.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} in {object}"))
}

/// A torus, and one of a tenth of the faces: `2 · 120 · 60` and `2 · 40 · 18`.
fn pair() -> (Mesh, Mesh) {
    (torus(120, 60), torus(40, 18))
}

#[test]
fn parallel_fields_are_their_distance_apart() {
    let folder = Folder::new();
    let flat = |z: f64| field(20, 10).map(|[x, y, _]| [x, y, z]);
    let (a, b) = (folder.scan("a", &flat(0.0), Kind::Text), folder.scan("b", &flat(0.5), Kind::Doubles));
    let object = compared(&folder, &a, &b, &["--samples", "2k"]);
    let diagonal = 500f64.sqrt();
    for (path, expected) in [
        ("/e_avg", 0.25),
        ("/e_max", 0.5),
        ("/mean", 0.5),
        ("/rms", 0.5),
        ("/max", 0.5),
        ("/diagonal", diagonal),
        ("/a_to_b/mean", 0.5),
        ("/b_to_a/max", 0.5),
        ("/shares/e_avg", 0.25 / 500.0),
        ("/shares/e_max", 0.5 / diagonal),
        ("/shares/a_to_b/rms", 0.5 / diagonal),
    ] {
        let found = number(&object, path);
        assert!((found / expected - 1.0).abs() < 1e-12, "{path}: {found}, not {expected}");
    }
    assert_eq!(object["schema"], 1);
    assert_eq!((&object["a"]["faces"], &object["b"]["vertices"]), (&400.into(), &231.into()));
    assert_eq!((&object["a_to_b"]["vertices"], &object["seed"]), (&231.into(), &0.into()));
    assert!(object["a_to_b"]["max_at"].as_array().unwrap().len() == 3 && object["heatmap"].is_null());
    assert!(number(&object, "/seconds/total") > 0.0);

    let mut command = program();
    let words = command.arg("compare").args([&a, &b]).args(["--samples", "2k"]).output().unwrap();
    let words = String::from_utf8(words.stdout).unwrap();
    for part in ["A to B: mean 0.500, RMS 0.500, largest 0.500", "B to A:", "E_avg 0.250", "of 512MiB"] {
        assert!(words.contains(part), "{part}: {words}");
    }
}

#[test]
fn equal_files_are_nothing_apart_in_any_form() {
    let folder = Folder::new();
    let (mesh, _) = pair();
    let a = folder.scan("a", &mesh, Kind::Floats);
    for (name, mesh) in [("b", mesh.clone()), ("c", mesh.with_shuffled_faces().with_shuffled_vertices())] {
        for kind in [Kind::Floats, Kind::Doubles, Kind::Text, Kind::Stl] {
            let object = compared(&folder, &a, &folder.scan(name, &mesh, kind), &["--samples", "20k"]);
            assert_eq!((number(&object, "/e_avg"), number(&object, "/e_max")), (0.0, 0.0), "{kind:?}");
        }
    }
}

#[test]
fn threads_and_memory_change_nothing_but_a_seed_does() {
    let folder = Folder::new();
    let large = torus(700, 300);
    let small = folder.scan("small", &pair().1, Kind::Floats);
    let shuffled = large.clone().with_shuffled_faces().with_shuffled_vertices();
    for (name, mesh, kind) in [
        ("coherent", &large, Kind::Floats),
        ("shuffled", &shuffled, Kind::Floats),
        ("wide", &shuffled, Kind::Doubles),
        ("soup", &large, Kind::Stl),
    ] {
        let scan = folder.scan(name, mesh, kind);
        let of = |threads, memory, seed| {
            let args = ["--samples", "20k", "--threads", threads, "--memory", memory, "--seed", seed];
            figures(&compared(&folder, &scan, &small, &args))
        };
        let first = of("1", "512MiB", "0");
        assert_eq!(of("3", "512MiB", "0"), first, "{name}");
        for threads in ["2", "8"] {
            assert_eq!(of(threads, TIGHT, "0"), first, "{name} in little memory");
        }
        if name == "coherent" {
            assert_ne!(of("2", "512MiB", "1"), first);
        }
    }
}

#[test]
fn a_budget_is_kept_by_every_input_and_one_that_is_too_small_names_another() {
    let folder = Folder::new();
    let large = torus(300, 150);
    let shuffled = large.clone().with_shuffled_faces().with_shuffled_vertices();
    let small = folder.scan("small", &torus(90, 50), Kind::Floats);
    let soup = folder.scan("small", &torus(90, 50), Kind::Stl);
    for (name, mesh, kind) in [
        ("floats", &large, Kind::Floats),
        ("text", &large, Kind::Text),
        ("soup", &large, Kind::Stl),
        ("shuffled", &shuffled, Kind::Floats),
        ("doubles", &shuffled, Kind::Doubles),
    ] {
        let scan = folder.scan(name, mesh, kind);
        for held in [&small, &soup].into_iter().take(if kind == Kind::Floats { 2 } else { 1 }) {
            let samples = if name == "floats" && held == &small { "1M" } else { "50k" };
            let refusal = compare(&folder, &scan, held, &["--memory", "16MiB", "--samples", samples]);
            let message = refusal.failed(2);
            assert_eq!(refusal.object["error"]["code"], "budget");
            let named = message.split("--memory ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
            for threads in ["1", "8"] {
                compared(&folder, held, &scan, &["--memory", named, "--samples", samples, "--threads", threads]);
            }
        }
    }
    assert!(!folder.names().iter().any(|name| name.starts_with('.')));
}

#[test]
fn every_vertex_means_all_of_them() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "600k");
    let small = folder.scan("small", &pair().1, Kind::Floats);
    let vertices = |args: &[&str]| {
        let object = compared(&folder, &scan, &small, args);
        (object["a_to_b"]["vertices"].as_u64().unwrap(), object["a"]["vertices"].as_u64().unwrap())
    };
    let (some, of) = vertices(&["--samples", "5k"]);
    assert!(some <= 200_000 && some > 100_000 && of > 250_000, "{some} of {of}");
    let (all, of) = vertices(&["--samples", "5k", "--every-vertex"]);
    assert_eq!(all, of);
}

/// Positions, deviations and colours, and how many bytes follow.
fn shaded(path: &Path, wide: bool) -> (Vec<f64>, Vec<[u8; 3]>, usize) {
    let bytes = std::fs::read(path).unwrap();
    let end = find(&bytes, b"end_header\n").unwrap() + b"end_header\n".len();
    let head = std::str::from_utf8(&bytes[..end]).unwrap();
    let scalar = if wide { "double" } else { "float" };
    let properties = format!(
        "property {scalar} deviation\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face"
    );
    assert!(head.contains(&properties), "{head}");
    let vertices: usize = head.lines().find_map(|line| line.strip_prefix("element vertex ")).unwrap().parse().unwrap();
    let length = if wide { 35 } else { 19 };
    let (records, faces) = bytes[end..].split_at(vertices * length);
    let deviation = |record: &[u8]| match wide {
        true => f64::from_le_bytes(record[24..32].try_into().unwrap()),
        false => f32::from_le_bytes(record[12..16].try_into().unwrap()).into(),
    };
    let records: Vec<_> = records.chunks_exact(length).collect();
    let colours = records.iter().map(|r| r[length - 3..].try_into().unwrap()).collect();
    (records.into_iter().map(deviation).collect(), colours, faces.len())
}

#[test]
fn a_heat_map_shows_the_deviation_of_each_vertex() {
    let folder = Folder::new();
    let large = field(60, 60).map(|[x, y, _]| [x, y, 0.0]);
    // A ramp: each vertex is as high as it is far to the right.
    let ramp = field(20, 20).map(|[x, y, _]| [3.0 * x, 3.0 * y, 0.01 * x]);
    for (kind, wide) in [(Kind::Floats, false), (Kind::Doubles, true)] {
        let (a, b) = (folder.scan("a", &large, Kind::Floats), folder.scan("b", &ramp, kind));
        let plain = figures(&compared(&folder, &a, &b, &["--samples", "5k"]));
        let map = folder.path("map.ply");
        let object = compared(&folder, &a, &b, &["--samples", "5k", "--heatmap", map.to_str().unwrap()]);
        assert_eq!(figures(&object), plain, "the heat map changes the figures");
        assert_eq!((&object["heatmap"]["mesh"], &object["heatmap"]["range"][0]), (&"b".into(), &0.0.into()));
        let top = object["heatmap"]["range"][1].as_f64().unwrap();
        assert!((0.19..=0.2 + 1e-6).contains(&top), "{object}");

        let (deviations, colours, rest) = shaded(&map, wide);
        assert_eq!((deviations.len(), rest), (441, 800 * 13));
        for (i, (deviation, colour)) in deviations.iter().zip(&colours).enumerate() {
            assert!((deviation - 0.01 * (i % 21) as f64).abs() < 1e-6, "vertex {i}: {deviation}");
            assert_eq!(*colour, colours[i % 21]);
        }
        assert!(colours[0][0] < 60 && colours[20][0] > 200, "{:?} to {:?}", colours[0], colours[20]);
    }
    let scans = folder.names();
    for (out, why) in [("map.stl", "only a binary .ply"), ("a.ply", "is the input"), ("b.ply", "is the input")] {
        let out = folder.path(out);
        let args = ["--heatmap", out.to_str().unwrap()];
        let (a, b) = (folder.path("a.ply"), folder.path("b.ply"));
        assert!(compare(&folder, &a, &b, &args).failed(2).contains(why));
    }
    assert_eq!(folder.names(), scans);
}

#[test]
fn what_cannot_be_measured_is_told_like_any_other_bad_input() {
    let folder = Folder::new();
    let good = folder.scan("good", &pair().1, Kind::Floats);
    let mut mesh = pair().0;
    mesh.positions[7][2] = f64::NAN;
    let wild = folder.scan("wild", &mesh, Kind::Floats);
    let none = folder.file("none.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n");
    let cut = folder.file("cut.ply", &std::fs::read(&good).unwrap()[..700]);
    for (a, b, code, what) in [
        (&wild, &good, 1, "vertex 7"),
        (&good, &wild, 1, "vertex 7"),
        (&none, &good, 1, "has no"),
        (&good, &none, 1, "has no"),
        (&good, &cut, 1, "the file ends"),
        (&good, &folder.path("missing.ply"), 1, "cannot open"),
    ] {
        let outcome = compare(&folder, a, b, &["--samples", "1k"]);
        let message = outcome.failed(code);
        assert!(message.contains(what), "{message}");
        assert!(outcome.object["error"]["file"].is_string());
    }
}

#[test]
fn a_signal_ends_a_comparison() {
    let folder = Folder::new();
    let scan = folder.synth("scan.ply", "2M");
    let small = folder.scan("small", &pair().1, Kind::Floats);
    let mut command = program();
    let map = folder.path("map.ply");
    command.arg("compare").args([&scan, &small]).arg("--heatmap").arg(&map).args(["--samples", "3M", "--json"]);
    let child = command.args(["--memory", "2GiB"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    while !folder.names().iter().any(|name| name.starts_with(".meshmill-")) {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    std::thread::sleep(std::time::Duration::from_millis(50));
    std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8_lossy(&output.stderr));
    let object: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(object["error"]["code"], "interrupted");
    assert_eq!(folder.names(), ["scan.ply", "small.ply"]);
}

#[test]
fn a_result_is_verified_on_request() {
    let folder = Folder::new();
    let mesh = torus(300, 180);
    for kind in [Kind::Floats, Kind::Doubles, Kind::Stl] {
        let scan = folder.scan("scan", &mesh, kind);
        for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
            if memory != TIGHT && kind != Kind::Floats {
                continue;
            }
            let args = ["--faces", "1500", "--memory", memory];
            let plain = folder.reduce(&scan, &args).done(mode);
            assert!(plain.report["deviation"].is_null() && number(&plain.report, "/seconds/measure") == 0.0);
            let verified = folder.reduce(&scan, &[&args[..], &["--verify"]].concat()).done(mode);
            assert!(verified.bytes == plain.bytes, "measuring changes the result");
            let found = &verified.report["deviation"];
            assert!(number(&verified.report, "/seconds/measure") > 0.0);
            if memory == TIGHT {
                assert!(number(found, "/samples") >= 10_000.0, "{found}");
            } else {
                let again = compared(&folder, &scan, &folder.path("out.ply"), &[]);
                assert_eq!(figures(found), figures(&again));
            }
            assert!((1e-5..1e-2).contains(&number(found, "/shares/rms")), "{found}");
        }
    }
}

#[test]
fn a_measured_distance_beyond_the_bound_exits_with_1_and_the_result_stays() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &torus(120, 60), Kind::Floats);
    let reduce = |bound: &str, args: &[&str]| folder.reduce(&scan, &[&["--max-error", bound], args].concat());
    let estimated = reduce("1e-3", &[]).done("in-core");
    let kept = reduce("0.5", &["--verify"]);
    let far = number(&kept.object, "/deviation/max");
    assert_eq!(kept.code, Some(if far > 0.5 { 1 } else { 0 }), "{}", kept.stderr);

    // The estimate is one of planes: a bound this tight is not kept to the last digit.
    let outcome = reduce("1e-6", &["--verify"]);
    let object = &outcome.object;
    if number(object, "/deviation/max") > 1e-6 {
        assert_eq!(outcome.code, Some(1));
        assert_eq!(object["error"]["code"], "unmet");
        let message = object["error"]["message"].as_str().unwrap();
        assert!(
            message.contains("out.ply: is written, but ") && message.contains("0.000001 was asked for"),
            "{message}"
        );
        assert!(outcome.stderr.contains(message), "{}", outcome.stderr);
    }
    let outcome = reduce("1e-3", &["--verify"]);
    assert_eq!(std::fs::read(folder.path("out.ply")).unwrap(), estimated.bytes);
    let exceeded = number(&outcome.object, "/deviation/max") > 1e-3;
    assert_eq!((outcome.code, outcome.object["error"].is_object()), (Some(i32::from(exceeded)), exceeded));
}
