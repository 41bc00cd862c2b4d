//! Targets and made scans, through the public interface and on a real file system.

use meshmill::mesh::{Frame, IndexedMesh};
use meshmill::progress::Progress;
use meshmill::synth::synth;
use meshmill::write::Target;
use meshmill::{Error, Result};
use std::collections::HashMap;
use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use tempfile::TempDir;

fn triangle() -> IndexedMesh<f32> {
    IndexedMesh { positions: vec![[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0]], faces: vec![[0, 1, 2]] }
}

fn write(out: &Path) -> Result<u64> {
    Target::prepare(out, None)?.write_mesh(&triangle(), Frame::default(), &Progress::default())
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn folder() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_path_buf();
    (folder, path)
}

#[test]
fn a_target_appears_whole_with_the_mode_of_any_new_file() {
    let (_guard, folder) = folder();
    let out = folder.join("out.ply");
    let target = Target::prepare(&out, None).unwrap();
    assert!(!out.exists() && names(&folder).len() == 1, "only a temporary file before the end");
    let bytes = target.write_mesh(&triangle(), Frame::default(), &Progress::default()).unwrap();
    assert_eq!(fs::metadata(&out).unwrap().len(), bytes);
    File::create(folder.join("ordinary")).unwrap();
    let mode = |name: &str| fs::metadata(folder.join(name)).unwrap().permissions().mode();
    assert_eq!(mode("out.ply"), mode("ordinary"));
    assert_eq!(names(&folder), ["ordinary", "out.ply"]);
}

#[test]
fn replacing_never_shows_half_a_file() {
    let (_guard, folder) = folder();
    let out = folder.join("out.stl");
    fs::write(&out, "yesterday").unwrap();
    let reader = File::open(&out).unwrap();
    let target = Target::prepare(&out, None).unwrap();
    assert_eq!(fs::read(&out).unwrap(), b"yesterday");
    assert!(target.loses_doubles());
    target.write_mesh(&triangle(), Frame::default(), &Progress::default()).unwrap();
    assert_eq!(fs::metadata(&out).unwrap().len(), 84 + 50);
    assert_eq!(std::io::read_to_string(reader).unwrap(), "yesterday", "an open reader keeps what it had");
}

#[test]
fn a_run_that_fails_or_is_interrupted_leaves_nothing() {
    let (_guard, folder) = folder();
    let out = folder.join("out.ply");
    drop(Target::prepare(&out, None).unwrap());
    assert!(names(&folder).is_empty());

    fs::write(&out, "yesterday").unwrap();
    let target = Target::prepare(&out, None).unwrap();
    let interrupted = Progress::cancelled_by(Arc::new(AtomicUsize::new(15)));
    let error = target.write_mesh(&triangle(), Frame::default(), &interrupted).unwrap_err();
    assert!(matches!(error, Error::Interrupted { signal: 15, .. }));
    assert_eq!((names(&folder), fs::read(&out).unwrap()), (vec!["out.ply".to_string()], b"yesterday".to_vec()));
}

#[test]
fn leftovers_of_killed_runs_are_swept_and_live_ones_left() {
    let (_guard, folder) = folder();
    let [stale, live, other] =
        [".meshmill-stale.tmp", ".meshmill-live.tmp", ".meshmill-notes.txt"].map(|name| folder.join(name));
    for path in [&stale, &live, &other] {
        fs::write(path, "half a file").unwrap();
    }
    let lock = OpenOptions::new().write(true).open(&live).unwrap();
    lock.try_lock().unwrap();
    let running = Target::prepare(&folder.join("night.ply"), None).unwrap();

    write(&folder.join("out.ply")).unwrap();
    assert!(!stale.exists() && live.exists() && other.exists());
    running.write_mesh(&triangle(), Frame::default(), &Progress::default()).unwrap();

    drop(lock);
    write(&folder.join("out.ply")).unwrap();
    assert_eq!(names(&folder), [".meshmill-notes.txt", "night.ply", "out.ply"]);
}

#[test]
fn many_runs_into_one_folder_do_not_sweep_one_another() {
    let (_guard, folder) = folder();
    std::thread::scope(|threads| {
        for worker in 0..4 {
            let folder = &folder;
            threads.spawn(move || {
                for run in 0..25 {
                    write(&folder.join(format!("{worker}-{run}.ply"))).unwrap();
                }
            });
        }
    });
    assert_eq!(names(&folder).len(), 100);
}

#[test]
fn the_input_is_never_the_target() {
    let (_guard, folder) = folder();
    let scan = folder.join("scan.ply");
    fs::write(&scan, "a scan").unwrap();
    fs::create_dir(folder.join("sub")).unwrap();
    symlink(&scan, folder.join("link.ply")).unwrap();
    fs::hard_link(&scan, folder.join("hard.ply")).unwrap();
    for out in ["scan.ply", "link.ply", "hard.ply", "sub/../scan.ply", "./scan.ply"] {
        let error = Target::prepare(&folder.join(out), Some(&scan)).unwrap_err();
        assert_eq!(error.exit_code(), 2, "{out}");
        assert!(error.to_string().contains("is the input"), "{error}");
    }
    let error = Target::prepare(&scan, Some(&folder.join("link.ply"))).unwrap_err();
    assert!(error.to_string().contains("is the input"), "{error}");
    assert!(Target::prepare(&folder.join("other.ply"), Some(&scan)).is_ok());
    assert_eq!(fs::read(&scan).unwrap(), b"a scan");
}

#[test]
fn a_link_is_written_through() {
    let (_guard, folder) = folder();
    fs::create_dir(folder.join("store")).unwrap();
    fs::write(folder.join("store/real.ply"), "yesterday").unwrap();
    symlink("store/real.ply", folder.join("link.ply")).unwrap();
    let bytes = write(&folder.join("link.ply")).unwrap();
    assert_eq!(fs::metadata(folder.join("store/real.ply")).unwrap().len(), bytes);
    assert!(fs::symlink_metadata(folder.join("link.ply")).unwrap().is_symlink());
    assert_eq!(names(&folder.join("store")), ["real.ply"]);
}

#[test]
fn what_cannot_be_a_target_is_refused_before_the_work() {
    let (_guard, folder) = folder();
    fs::write(folder.join("file"), "").unwrap();
    fs::create_dir(folder.join("dir.ply")).unwrap();
    symlink("nowhere.ply", folder.join("dangling.ply")).unwrap();
    let refused = |out: &str, code: u8| {
        let error = Target::prepare(&folder.join(out), None).unwrap_err();
        assert_eq!(error.exit_code(), code, "{out}: {error}");
        error.to_string()
    };
    refused("dir.ply", 2);
    refused("out.ply/", 2);
    refused("out.off", 2);
    refused("dangling.ply", 1);
    assert!(refused("file/out.ply", 1).contains("/file: cannot write into this folder"));
    assert!(refused("missing/out.ply", 1).contains("/missing: cannot write into this folder"));
    assert_eq!(names(&folder), ["dangling.ply", "dir.ply", "file"]);
}

/// A made PLY: positions and faces.
fn decode(path: &Path) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let bytes = fs::read(path).unwrap();
    let end = b"end_header\n";
    let start = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    let header = String::from_utf8(bytes[..start].to_vec()).unwrap();
    let count = |what: &str| {
        let line = header.lines().find(|l| l.starts_with(what)).unwrap();
        line.rsplit(' ').next().unwrap().parse::<usize>().unwrap()
    };
    let (vertices, faces) = (count("element vertex"), count("element face"));
    let (positions, rest) = bytes[start..].split_at(12 * vertices);
    assert_eq!(rest.len(), 13 * faces);
    let word = |b: &[u8], i: usize| u32::from_le_bytes(b[i..i + 4].try_into().unwrap());
    let positions = positions.chunks(12).map(|b| [0, 4, 8].map(|i| f32::from_bits(word(b, i)))).collect();
    (positions, rest.chunks(13).map(|b| [1, 5, 9].map(|i| word(b, i))).collect())
}

fn cross(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> [f64; 3] {
    let (u, v) = ([0, 1, 2].map(|i| b[i] - a[i]), [0, 1, 2].map(|i| c[i] - a[i]));
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

#[test]
fn made_scans_are_closed_outward_and_of_the_count_asked() {
    let (_guard, folder) = folder();
    for (asked, seed) in [(100, 0), (101, 1), (134, 9), (1_002, 2), (5_000, 3), (50_001, 4), (200_000, u64::MAX)] {
        let out = folder.join("made.ply");
        let report = synth(&out, asked, seed, &Progress::default()).unwrap();
        let (positions, faces) = decode(&out);
        assert_eq!(report.faces, asked & !1);
        assert_eq!((report.faces, report.vertices), (faces.len() as u64, positions.len() as u64));
        assert_eq!(report.bytes, fs::metadata(&out).unwrap().len());

        // Each directed edge once and its opposite too: closed, two faces an edge, consistently turned.
        let mut edges = HashMap::new();
        for f in &faces {
            for i in 0..3 {
                *edges.entry((f[i], f[(i + 1) % 3])).or_insert(0) += 1;
            }
        }
        assert!(edges.iter().all(|(&(a, b), &n)| n == 1 && edges.contains_key(&(b, a))), "{asked} faces");
        let euler = positions.len() as i64 - edges.len() as i64 / 2 + faces.len() as i64;
        assert_eq!(euler, 2, "{asked} faces");

        // No vertex is there for nothing.
        let mut used = vec![false; positions.len()];
        faces.iter().flatten().for_each(|&v| used[v as usize] = true);
        assert!(used.iter().all(|&u| u), "{asked} faces");

        let (mut volume, mut area, mut least) = (0.0, 0.0, f64::INFINITY);
        for f in &faces {
            let [a, b, c] = f.map(|v| positions[v as usize].map(f64::from));
            let n = cross(a, b, c);
            let twice = n.iter().map(|x| x * x).sum::<f64>().sqrt();
            volume += (0..3).map(|i| a[i] * n[i]).sum::<f64>() / 6.0;
            area += twice / 2.0;
            least = least.min(twice / 2.0);
        }
        assert!(volume > 0.0, "{asked} faces: turned inside out");
        assert!(least > 0.05 * area / faces.len() as f64, "{asked} faces: a face of {least} mm²");
    }
}

#[test]
fn a_made_scan_is_its_seed_at_any_thread_count() {
    let (_guard, folder) = folder();
    let make = |name: &str, seed: u64, threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let out = folder.join(name);
        pool.install(|| synth(&out, 30_000, seed, &Progress::default())).unwrap();
        fs::read(&out).unwrap()
    };
    for name in ["a.ply", "a.stl"] {
        let once = make(name, 7, 1);
        assert!(once == make(name, 7, 3), "{name}");
        assert!(once != make(name, 8, 1), "{name}");
    }
}

#[test]
fn a_made_stl_has_the_very_triangles_of_the_ply() {
    let (_guard, folder) = folder();
    let (ply, stl) = (folder.join("a.ply"), folder.join("a.stl"));
    let reports = [&ply, &stl].map(|out| synth(out, 40_000, 5, &Progress::default()).unwrap());
    assert_eq!(reports[0].faces, reports[1].faces);
    let (positions, faces) = decode(&ply);
    let bytes = fs::read(&stl).unwrap();
    assert_eq!(bytes[80..84], 40_000u32.to_le_bytes());
    assert_eq!(bytes.len(), 84 + 50 * faces.len());
    for (facet, face) in bytes[84..].chunks(50).zip(&faces) {
        let corners: Vec<u8> = face.iter().flat_map(|&v| positions[v as usize]).flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(facet[12..48], corners);
        let normal = facet[..12].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap()));
        assert!((normal.map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-5);
    }
}

#[test]
fn counts_out_of_range_are_refused_before_anything_is_written() {
    let (_guard, folder) = folder();
    for (name, faces) in [("a.ply", 99), ("a.ply", 10_000_000_000), ("a.stl", 5_000_000_000), ("a.obj", 5_000)] {
        let error = synth(&folder.join(name), faces, 1, &Progress::default()).unwrap_err();
        assert_eq!(error.exit_code(), 2, "{name} {faces}: {error}");
    }
    let signalled = Progress::cancelled_by(Arc::new(AtomicUsize::new(2)));
    assert!(matches!(synth(&folder.join("a.ply"), 5_000, 1, &signalled), Err(Error::Interrupted { signal: 2, .. })));
    assert!(names(&folder).is_empty());
}

#[test]
fn a_hard_linked_target_is_replaced_not_written_into() {
    let (_guard, folder) = folder();
    let (out, kept) = (folder.join("out.ply"), folder.join("kept.ply"));
    fs::write(&out, "yesterday").unwrap();
    fs::hard_link(&out, &kept).unwrap();
    write(&out).unwrap();
    assert_eq!(fs::read(&kept).unwrap(), b"yesterday");
    assert_ne!(fs::metadata(&out).unwrap().ino(), fs::metadata(&kept).unwrap().ino());
}
