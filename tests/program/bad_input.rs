//! What cannot be reduced is refused: one clear line, an exit code, in little time and memory, and nothing left behind.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, Outcome, find, program, torus};
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// Tries to reduce `scan`: it must fail with `code`, quickly, in a gigabyte of address space, and leave the folder as it
/// was. The message.
#[track_caller]
fn refused_to(out: &Path, folder: &Folder, scan: &Path, args: &[&str], code: i32) -> String {
    let before = folder.names();
    let begun = Instant::now();
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -v 1000000; exec \"$0\" \"$@\""]).arg(program().get_program());
    command.arg("reduce").arg(scan).arg("-o").arg(out).args(["--threads", "2", "--json"]).args(args);
    let message = Outcome::of(command, out.into()).failed(code);
    assert!(begun.elapsed() < Duration::from_secs(10), "{:?} until: {message}", begun.elapsed());
    assert_eq!(folder.names(), before, "left behind: {message}");
    message
}

#[track_caller]
fn refused(folder: &Folder, scan: &Path, args: &[&str]) -> String {
    let message = refused_to(&folder.path("out.ply"), folder, scan, args, 1);
    let name = scan.file_name().unwrap().to_str().unwrap();
    assert!(message.contains(name), "the file is named: {message}");
    message
}

const ASK: [&str; 2] = ["--faces", "100"];

/// Both ways through the program: a small scan in core, a large one out of core.
fn both_ways(kind: Kind, harm: impl Fn(&mut Mesh), expected: &[&str]) {
    for (mesh, memory) in [(torus(30, 20), "512MiB"), (torus(300, 180), TIGHT)] {
        let folder = Folder::new();
        let mut mesh = mesh;
        harm(&mut mesh);
        let scan = folder.scan("scan", &mesh, kind);
        let message = refused(&folder, &scan, &["--faces", "1000", "--memory", memory]);
        for part in expected {
            assert!(message.contains(part), "{kind:?} {memory}: `{part}` is not in: {message}");
        }
    }
}

#[test]
fn coordinates_that_are_not_finite() {
    for x in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let harm = |mesh: &mut Mesh| mesh.positions[417][1] = x;
        both_ways(Kind::Floats, harm, &["vertex 417", "finite", "byte"]);
        both_ways(Kind::Doubles, harm, &["vertex 417", "finite", "byte"]);
        both_ways(Kind::Text, harm, &["vertex 417", "finite"]);
        both_ways(Kind::Stl, harm, &["face ", "finite", "byte"]);
    }
    // More than a float holds, in words.
    let folder = Folder::new();
    let text = "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1e99 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n";
    refused(&folder, &folder.file("scan.stl", text), &ASK);
}

#[test]
fn indices_of_no_vertex() {
    for kind in [Kind::Floats, Kind::Text] {
        for index in [600, 54_000, 1 << 31, u32::MAX] {
            let harm = |mesh: &mut Mesh| mesh.faces[777][2] = index.max(mesh.positions.len() as u32);
            both_ways(kind, harm, &["face 777", "vert"]);
        }
    }
    let folder = Folder::new();
    let text = String::from_utf8(torus(30, 20).bytes(Kind::Text)).unwrap().replace("uint", "int");
    let scan = folder.file("scan.ply", text.replacen("\n3 0 ", "\n3 -7 ", 1));
    let message = refused(&folder, &scan, &ASK);
    assert!(message.contains("-7") && message.contains("face 0"), "{message}");
    let mut bytes = torus(30, 20).bytes(Kind::Floats);
    let at = find(&bytes, b"uint vertex_indices").unwrap();
    bytes.splice(at..at + 4, *b" int");
    let last = bytes.len() - 4;
    bytes[last..].copy_from_slice(&(-1i32).to_le_bytes());
    let message = refused(&folder, &folder.file("scan.ply", bytes), &ASK);
    assert!(message.contains("-1") && message.contains("face 1199"), "{message}");
}

#[test]
fn bytes_that_are_missing() {
    let folder = Folder::new();
    let mesh = torus(30, 20);
    for kind in [Kind::Floats, Kind::Doubles, Kind::Text, Kind::Stl] {
        let bytes = mesh.bytes(kind);
        let mut cuts: Vec<usize> = (1..40).map(|i| bytes.len() * i / 40).collect();
        cuts.extend([0, 1, 2, 3, 4, 5, 40, 79, 80, 83, 84, 85, bytes.len() - 20]);
        if kind != Kind::Text {
            cuts.extend([bytes.len() - 1, bytes.len() - 4]);
        }
        for cut in cuts {
            let scan = folder.file(&format!("scan.{}", kind.extension()), &bytes[..cut]);
            refused(&folder, &scan, &ASK);
        }
    }
    // In words, out of core, and under a name that says nothing.
    let bytes = torus(300, 180).bytes(Kind::Text);
    let scan = folder.file("scan", &bytes[..bytes.len() - 1000]);
    refused(&folder, &scan, &["--faces", "1000", "--memory", TIGHT]);
}

#[test]
fn counts_that_lie() {
    let folder = Folder::new();
    let [vertices, faces] = ["element vertex 200\n", "element face 400\n"];
    for kind in [Kind::Floats, Kind::Doubles, Kind::Text] {
        let bytes = torus(20, 10).bytes(kind);
        for count in ["2147483648", "1099511627776", "18446744073709551615", "18446744073709551616", "-1", "4e2", "401"]
        {
            for line in [vertices, faces] {
                let at = find(&bytes, line.as_bytes()).unwrap();
                let lie = format!("{} {count}\n", line.rsplit_once(' ').unwrap().0);
                let mut bytes = bytes.clone();
                bytes.splice(at..at + line.len(), lie.bytes());
                refused(&folder, &folder.file("scan.ply", bytes), &ASK);
            }
        }
    }
    let mut stl = torus(20, 10).bytes(Kind::Stl);
    for count in [401, 1 << 31, u32::MAX] {
        stl[80..84].copy_from_slice(&u32::to_le_bytes(count));
        refused(&folder, &folder.file("scan.stl", &stl), &ASK);
    }
    // A polygon of four billion corners.
    for list in ["uint", "int", "ushort"] {
        let mut bytes = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\nelement face 2\nproperty list {list} uint vertex_indices\nend_header\n"
        )
        .into_bytes();
        bytes.extend([0; 36]);
        bytes.extend([0xff; 4]);
        bytes.resize(6000, 0);
        refused(&folder, &folder.file("scan.ply", bytes), &ASK);
    }
}

#[test]
fn nothing_to_reduce() {
    let folder = Folder::new();
    let mut mesh = torus(20, 10);
    mesh.faces.clear();
    for kind in [Kind::Floats, Kind::Text, Kind::Stl] {
        refused(&folder, &folder.scan("faceless", &mesh, kind), &ASK);
        refused(&folder, &folder.scan("void", &Mesh::default(), kind), &ASK);
    }
    mesh.faces = vec![[0, 0, 1], [4, 5, 4], [7, 7, 7]];
    let coincident =
        Mesh { positions: vec![[1.0, 2.0, 3.0]; 90], faces: (0..30).map(|i| [i, i + 30, i + 60]).collect() };
    for kind in [Kind::Floats, Kind::Doubles, Kind::Text, Kind::Stl] {
        for (name, mesh) in [("repeated", &mesh), ("coincident", &coincident)] {
            for faces in ["0", "2", "100"] {
                let message = refused(&folder, &folder.scan(name, mesh, kind), &["--faces", faces]);
                assert!(message.contains("no usable face"), "{message}");
            }
        }
    }
    // Vertices alone, and faces of vertices that are not there.
    let head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
    refused(&folder, &folder.file("cloud.ply", format!("{head}end_header\n0 0 0\n1 0 0\n0 1 0\n")), &ASK);
    let text = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n3 0 1 2\n";
    refused(&folder, &folder.file("faces.ply", text), &ASK);
}

#[test]
fn nothing_to_reduce_out_of_core() {
    let folder = Folder::new();
    let mut mesh = torus(300, 180);
    mesh.faces.iter_mut().for_each(|face| face[2] = face[0]);
    for kind in [Kind::Floats, Kind::Stl] {
        for faces in ["0", "1000"] {
            let scan = folder.scan("repeated", &mesh, kind);
            let message = refused(&folder, &scan, &["--faces", faces, "--memory", TIGHT]);
            assert!(message.contains("no usable face"), "{kind:?}: {message}");
        }
    }
}

#[test]
fn files_of_another_kind() {
    let folder = Folder::new();
    let long = vec![b'#'; 300_000];
    for (name, bytes) in [
        ("empty.ply", b"" as &[u8]),
        ("empty.stl", b""),
        ("picture.ply", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x10\0\0\0\x10\0\x08\x06\0\0\0"),
        ("packed.ply", b"\x1f\x8b\x08\0\0\0\0\0\0\x03\x2b\xc8\xa9\xe4\x02\0\xd3\x9c\x3f\x5b\x04\0\0\0"),
        ("prose.stl", b"solid ground is what one wants beneath a scanner\n"),
        ("words.ply", b"plywood\n"),
        ("zeros.stl", &[0; 5000]),
        ("numbers.ply", b"0 0 0\n1 0 0\n0 1 0\n1 2 3\n"),
        ("header.ply", b"ply\nformat ascii 1.0\nelement vertex 1\n"),
        ("long.ply", &long),
        ("version.ply", b"ply\nformat ascii 2.0\nend_header\n"),
        ("type.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n0\n"),
    ] {
        refused(&folder, &folder.file(name, bytes), &ASK);
    }
    let endless: Vec<u8> =
        b"ply\nformat ascii 1.0\n".iter().chain(long.iter().cycle().take(3 << 20)).copied().collect();
    refused(&folder, &folder.file("endless.ply", endless), &ASK);
}

#[test]
fn what_is_no_file() {
    let folder = Folder::new();
    fs::create_dir(folder.path("folder.ply")).unwrap();
    refused(&folder, &folder.path("folder.ply"), &ASK);
    let missing = refused(&folder, &folder.path("missing.ply"), &ASK);
    assert!(missing.contains("No such file"), "{missing}");
    let fifo = folder.path("fifo.ply");
    assert!(Command::new("mkfifo").arg(&fifo).status().unwrap().success());
    refused(&folder, &fifo, &ASK);
    refused(&folder, Path::new("/dev/null"), &ASK);
    std::os::unix::fs::symlink("nowhere.ply", folder.path("link.ply")).unwrap();
    refused(&folder, &folder.path("link.ply"), &ASK);
}

#[test]
fn targets_that_cannot_be() {
    let folder = Folder::new();
    let mesh = torus(20, 10);
    let scan = folder.scan("scan", &mesh, Kind::Floats);
    folder.file("file", "not a folder");
    fs::create_dir(folder.path("dir.ply")).unwrap();
    for (out, code) in [
        ("missing/out.ply", 1),
        ("file/out.ply", 1),
        ("dir.ply", 2),
        ("dir.ply/", 2),
        ("out.xyz", 2),
        ("out", 2),
        ("scan.ply", 2),
        ("dir.ply/../scan.ply", 2),
    ] {
        let message = refused_to(&folder.path(out), &folder, &scan, &ASK, code);
        assert!(message.contains(out.trim_end_matches('/').split('/').next().unwrap()), "{message}");
    }
    assert!(fs::read(&scan).unwrap() == mesh.bytes(Kind::Floats), "the scan is as it was");
    let large = folder.scan("large", &torus(1000, 400), Kind::Floats);
    let args = ["--faces", "1000", "--memory", TIGHT, "--scratch", "/nonexistent/scratch"];
    let message = refused_to(&folder.path("out.ply"), &folder, &large, &args, 1);
    assert!(message.contains("/nonexistent/scratch"), "{message}");
}

/// A run that fails leaves the old result in place.
#[test]
fn an_old_result_outlives_a_run_that_fails() {
    let folder = Folder::new();
    folder.file("out.ply", "yesterday's");
    let bytes = torus(300, 180).bytes(Kind::Floats);
    for (name, cut, memory) in [("a.ply", 100, "512MiB"), ("b.ply", 50_000, "512MiB"), ("c.ply", 900_000, TIGHT)] {
        let scan = folder.file(name, &bytes[..bytes.len() - cut]);
        refused(&folder, &scan, &["--faces", "1000", "--memory", memory]);
        assert_eq!(fs::read(folder.path("out.ply")).unwrap(), b"yesterday's");
    }
}

#[test]
fn a_full_disk() {
    let folder = Folder::new();
    let disk = folder.path("disk");
    fs::create_dir(&disk).unwrap();
    let mount = Command::new("mount").args(["-t", "tmpfs", "-o", "size=200k", "tmpfs"]).arg(&disk).output();
    if !mount.is_ok_and(|output| output.status.success()) {
        eprintln!("no small file system can be mounted here: a full disk is not tried");
        return;
    }
    let unmount = || assert!(Command::new("umount").arg(&disk).status().unwrap().success());
    let scan = folder.scan("scan", &torus(1000, 400), Kind::Floats);
    let outcomes = [("50k", "512MiB"), ("1000", TIGHT)].map(|(faces, memory)| {
        let outcome = folder.reduce_to("disk/out.ply", &scan, &["--faces", faces, "--memory", memory]);
        (outcome, fs::read_dir(&disk).unwrap().count())
    });
    unmount();
    for (outcome, left) in outcomes {
        assert!(outcome.failed(1).contains("No space left"), "{}", outcome.stderr);
        assert_eq!(left, 0, "left behind");
    }
}

/// More bytes than a 32-bit offset reaches, nearly all of them a hole.
#[test]
fn a_hole_of_five_gigabytes() {
    let folder = Folder::new();
    let bytes = torus(20, 10).bytes(Kind::Floats);
    let scan = folder.file("scan.ply", &bytes);
    fs::File::options().write(true).open(&scan).unwrap().set_len(5 << 30).unwrap();
    let done = folder.reduce(&scan, &ASK).done("in-core");
    let text = done.warning("trailing-bytes").unwrap();
    assert!(text.contains("bytes") && done.faces() == 100, "{text}");
}
