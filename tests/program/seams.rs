//! Seams of textures and of normals, materials and groups stay what they are.

use crate::TIGHT;
use crate::support::{Folder, program, torus};
use serde_json::Value;
use std::f64::consts::TAU;
use std::fmt::Write;

const AROUND: usize = 48;
const HIGH: usize = 36;

/// A can: a label wound around it, whose ends meet at a seam; two lids of another material; hard edges between.
fn can() -> String {
    let mut text = String::from("mtllib can.mtl\no can\n");
    let angle = |i: usize| TAU * i as f64 / AROUND as f64;
    for j in 0..=HIGH {
        for i in 0..AROUND {
            let (sin, cos) = angle(i).sin_cos();
            let _ = writeln!(text, "v {} {} {}", cos as f32, sin as f32, 3.0 * j as f32 / HIGH as f32);
        }
    }
    text += "v 0 0 0\nv 0 0 3\n";
    for j in 0..=HIGH {
        for i in 0..=AROUND {
            let _ = writeln!(text, "vt {} {}", i as f64 / AROUND as f64, j as f64 / HIGH as f64);
        }
    }
    let lids = (AROUND + 1) * (HIGH + 1);
    for i in 0..AROUND {
        let (sin, cos) = angle(i).sin_cos();
        let _ = writeln!(text, "vt {} {}\nvn {cos} {sin} 0", 0.5 + 0.5 * cos, 0.5 + 0.5 * sin);
    }
    text += "vt 0.5 0.5\nvn 0 0 -1\nvn 0 0 1\ng side\nusemtl label\n";
    for (j, i) in (0..HIGH).flat_map(|j| (0..AROUND).map(move |i| (j, i))) {
        let corner = |i: usize, j: usize| {
            format!("{}/{}/{}", j * AROUND + i % AROUND + 1, j * (AROUND + 1) + i + 1, i % AROUND + 1)
        };
        let _ = writeln!(text, "f {} {} {} {}", corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1));
    }
    text += "g lids\nusemtl tin\n";
    for i in 0..AROUND {
        let k = (i + 1) % AROUND;
        for (row, normal, [a, b]) in [(0, AROUND + 1, [k, i]), (HIGH, AROUND + 2, [i, k])] {
            let rim = |i: usize| format!("{}/{}/{normal}", row * AROUND + i + 1, lids + i + 1);
            let middle = (HIGH + 1) * AROUND + 1 + usize::from(row > 0);
            let _ = writeln!(text, "f {middle}/{}/{normal} {} {}", lids + AROUND + 1, rim(a), rim(b));
        }
    }
    text
}

fn scan(folder: &Folder) {
    folder.file("can.obj", can());
    folder.file("can.mtl", "newmtl label\nKd 1 1 1\nmap_Kd label.png\nnewmtl tin\nKd 0.5 0.5 0.5\n");
    folder.file("label.png", "a picture");
}

fn reduce(folder: &Folder, out: &str, args: &[&str]) -> Value {
    let mut command = program();
    command.arg("reduce").arg(folder.path("can.obj")).arg("-o").arg(folder.path(out)).arg("--json");
    let output = command.args(args).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A face of an OBJ: its corners' positions, texture coordinates and normals, and what it belongs to.
struct Face {
    at: [[f64; 3]; 3],
    uv: [[f64; 2]; 3],
    normal: [[f64; 3]; 3],
    material: String,
    group: String,
}

fn faces(text: &str) -> Vec<Face> {
    let (mut v, mut vt, mut vn, mut faces) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let (mut material, mut group) = (String::new(), String::new());
    for line in text.lines() {
        let (word, rest) = line.split_once(' ').unwrap();
        let numbers = || rest.split(' ').map(|x| x.parse::<f64>().unwrap()).collect::<Vec<_>>();
        match word {
            "v" => v.push(<[f64; 3]>::try_from(numbers()).unwrap()),
            "vt" => vt.push(<[f64; 2]>::try_from(numbers()).unwrap()),
            "vn" => vn.push(<[f64; 3]>::try_from(numbers()).unwrap()),
            "usemtl" => material = rest.into(),
            "g" => group = rest.into(),
            "f" => {
                let corners: Vec<Vec<usize>> =
                    rest.split(' ').map(|c| c.split('/').map(|n| n.parse::<usize>().unwrap() - 1).collect()).collect();
                faces.push(Face {
                    at: [0, 1, 2].map(|i| v[corners[i][0]]),
                    uv: [0, 1, 2].map(|i| vt[corners[i][1]]),
                    normal: [0, 1, 2].map(|i| vn[corners[i][2]]),
                    material: material.clone(),
                    group: group.clone(),
                });
            }
            _ => {}
        }
    }
    faces
}

/// Holds every corner of a reduced can against what a can has there. Returns how many faces are on the label.
fn check(found: &[Face], named: bool) -> usize {
    let mut labels = 0;
    for face in found {
        let is_lid = face.at.iter().all(|p| p[2] < 1e-6) || face.at.iter().all(|p| p[2] > 3.0 - 1e-6);
        let expected = if is_lid { ("tin", "lids") } else { ("label", "side") };
        assert!(!named || (face.material.as_str(), face.group.as_str()) == expected);
        labels += usize::from(!is_lid);
        for i in 0..3 {
            let ([x, y, z], [s, t], [nx, ny, nz]) = (face.at[i], face.uv[i], face.normal[i]);
            if is_lid {
                assert!((s - 0.5 - 0.5 * x).abs() < 0.02 && (t - 0.5 - 0.5 * y).abs() < 0.02, "{s} {t} at {x} {y}");
                assert!((nz - (z - 1.5).signum()).abs() < 1e-3, "{nz} at {z}");
            } else {
                let turn = y.atan2(x).rem_euclid(TAU) / TAU;
                // Where the label's ends meet, either may be meant: the rest of its face tells which.
                let middle = face.uv.iter().map(|uv| uv[0]).sum::<f64>() / 3.0;
                let turn = if turn - middle > 0.5 {
                    turn - 1.0
                } else if middle - turn > 0.5 {
                    turn + 1.0
                } else {
                    turn
                };
                assert!((s - turn).abs() < 0.02 && (t - z / 3.0).abs() < 0.02, "{s} {t}, expected {turn} {}", z / 3.0);
                assert!((nx - x).hypot(ny - y) < 0.15 && nz.abs() < 0.05, "{nx} {ny} {nz} at {x} {y}");
            }
            assert!((0.0..=1.0).contains(&s) && (0.0..=1.0).contains(&t));
        }
        let size = |axis: usize| {
            let values = face.uv.map(|uv| uv[axis]);
            values.iter().fold(0.0, |a: f64, b| a.max(*b)) - values.iter().fold(1.0, |a: f64, b| a.min(*b))
        };
        assert!(is_lid || size(0) < 0.5, "no face goes all the way back around");
    }
    labels
}

#[test]
fn nothing_is_smeared_across_a_seam() {
    let folder = Folder::new();
    scan(&folder);
    let report = reduce(&folder, "small.obj", &["--faces", "400"]);
    assert_eq!(report["warnings"], Value::Array(Vec::new()));
    let text = std::fs::read_to_string(folder.path("small.obj")).unwrap();
    assert!(text.contains("mtllib can.mtl\n"), "beside its scan a result names the scan's library");
    let found = faces(&text);
    assert!(found.len() <= 400 && found.len() >= 398, "{}", found.len());
    let labels = check(&found, true);
    assert!(labels > 200);
    for threads in ["1", "3"] {
        reduce(&folder, "again.obj", &["--faces", "400", "--threads", threads]);
        assert_eq!(std::fs::read_to_string(folder.path("again.obj")).unwrap(), text);
    }
}

#[test]
fn other_formats_get_split_vertices_and_other_folders_the_pictures() {
    let folder = Folder::new();
    scan(&folder);
    std::fs::create_dir(folder.path("out")).unwrap();
    reduce(&folder, "out/small.obj", &["--faces", "300"]);
    let library = std::fs::read_to_string(folder.path("out/small.mtl")).unwrap();
    assert!(library.contains("newmtl label\n") && library.contains("map_Kd label.png\n"), "{library}");
    assert_eq!(std::fs::read(folder.path("out/label.png")).unwrap(), b"a picture");

    let report = reduce(&folder, "small.glb", &["--faces", "300"]);
    assert_eq!(report["warnings"][0]["text"], "not carried over to the result: g");
    let bytes = std::fs::read(folder.path("small.glb")).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let document: Value = serde_json::from_slice(&bytes[20..20 + length]).unwrap();
    let primitives = document["meshes"][0]["primitives"].as_array().unwrap();
    assert_eq!(primitives.iter().map(|p| p["material"].as_u64()).collect::<Vec<_>>(), [Some(0), Some(1)]);
    assert!(primitives.iter().all(|p| p["attributes"]["TEXCOORD_0"].is_u64() && p["attributes"]["NORMAL"].is_u64()));
    assert_eq!(document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);
    let view = &document["bufferViews"][document["images"][0]["bufferView"].as_u64().unwrap() as usize];
    let at = 28 + length + view["byteOffset"].as_u64().unwrap() as usize;
    assert_eq!(&bytes[at..at + view["byteLength"].as_u64().unwrap() as usize], b"a picture");

    let report = reduce(&folder, "small.ply", &["--faces", "300"]);
    assert_eq!(report["warnings"][0]["text"], "not carried over to the result: usemtl, g");
    let head = String::from_utf8_lossy(&std::fs::read(folder.path("small.ply")).unwrap()[..600]).into_owned();
    assert!(head.contains("property float s\nproperty float t\nproperty float nx\n"), "{head}");
    let report = reduce(&folder, "small.stl", &["--faces", "300"]);
    assert_eq!(report["warnings"][0]["text"], "not carried over to the result: vn, vt, usemtl, g");
}

#[test]
fn seams_give_way_when_nothing_else_is_left() {
    let folder = Folder::new();
    scan(&folder);
    let report = reduce(&folder, "small.obj", &["--faces", "4"]);
    assert!(report["output"]["faces"].as_u64().unwrap() <= 4);
    assert_eq!(report["warnings"][0]["code"], "seams-gave-way");
}

#[test]
fn a_glb_is_read_back_with_its_seams() {
    let folder = Folder::new();
    scan(&folder);
    reduce(&folder, "whole.glb", &["--faces", "1M"]);
    let mut command = program();
    command.arg("reduce").arg(folder.path("whole.glb")).arg("-o").arg(folder.path("small.obj"));
    let output = command.args(["--faces", "400", "--json"]).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["warnings"], Value::Array(Vec::new()));
    let found = faces(&std::fs::read_to_string(folder.path("small.obj")).unwrap());
    assert!(check(&found, false) > 200 && found.len() >= 398);
    for face in &found {
        let is_lid = face.at.iter().all(|p| p[2] < 1e-6) || face.at.iter().all(|p| p[2] > 3.0 - 1e-6);
        assert_eq!(face.material, if is_lid { "tin" } else { "label" });
    }
    assert!(std::fs::read_to_string(folder.path("small.mtl")).unwrap().contains("map_Kd label.png\n"));
}

#[test]
fn seams_of_a_scan_that_does_not_fit_are_left_out_and_said() {
    let folder = Folder::new();
    let (around, across) = (320, 200);
    let mesh = torus(around, across);
    let mut text = String::new();
    for [x, y, z] in &mesh.positions {
        let _ = writeln!(text, "v {} {} {}", *x as f32, *y as f32, *z as f32);
    }
    for (i, j) in (0..=around).flat_map(|i| (0..=across).map(move |j| (i, j))) {
        let _ = writeln!(text, "vt {} {}", f64::from(i) / f64::from(around), f64::from(j) / f64::from(across));
    }
    for face in &mesh.faces {
        let corners = face.map(|v| [v / across, v % across]);
        // Where a face goes around, 0 is the end.
        let unwound = |axis: usize, end: u32| {
            let at = corners.map(|corner| corner[axis]);
            let goes_around = at.contains(&0) && at.contains(&(end - 1));
            at.map(|x| if goes_around && x == 0 { end } else { x })
        };
        let (i, j) = (unwound(0, around), unwound(1, across));
        let corner = |c: usize| format!("{}/{}", face[c] + 1, i[c] * (across + 1) + j[c] + 1);
        let _ = writeln!(text, "f {} {} {}", corner(0), corner(1), corner(2));
    }
    folder.file("scan.obj", text);
    let reduce = |memory: &str| {
        let outcome = folder.reduce_to("small.obj", &folder.path("scan.obj"), &["--faces", "2000", "--memory", memory]);
        assert_eq!(outcome.code, Some(0), "{}", outcome.stderr);
        let text = std::fs::read_to_string(folder.path("small.obj")).unwrap();
        (outcome.object, text.lines().filter(|line| line.starts_with("vt ")).count())
    };
    let (report, textured) = reduce(TIGHT);
    assert_eq!((&report["mode"], textured), (&"out-of-core".into(), 0));
    assert_eq!(report["warnings"][0]["code"], "seams-left-out");
    let said = report["warnings"][0]["text"].as_str().unwrap();
    let enough = said.split("--memory ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
    let (report, textured) = reduce(enough);
    assert_eq!((&report["mode"], &report["warnings"]), (&"in-core".into(), &Value::Array(Vec::new())));
    // Vertices at the two seams have two.
    assert!(textured as u64 > report["output"]["vertices"].as_u64().unwrap() + 20, "{textured}: {report}");
}
