//! The same scan in every format, and the same result.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, field, program, torus};
use meshmill::progress::Progress;
use meshmill::read::{Crew, Format, Scan};
use serde_json::Value;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::Mutex;

fn obj(mesh: &Mesh) -> String {
    let mut text = String::from("o scan\n");
    mesh.positions.iter().for_each(|[x, y, z]| text += &format!("v {} {} {}\n", *x as f32, *y as f32, *z as f32));
    mesh.faces.iter().for_each(|[a, b, c]| text += &format!("f {}/1 {}/2 {}/3\n", a + 1, b + 1, c + 1));
    text
}

fn off(mesh: &Mesh) -> String {
    let mut text = format!("OFF\n{} {} 0\n", mesh.positions.len(), mesh.faces.len());
    mesh.positions.iter().for_each(|[x, y, z]| text += &format!("{} {} {}\n", *x as f32, *y as f32, *z as f32));
    mesh.faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    text
}

fn glb(mesh: &Mesh) -> Vec<u8> {
    let mut bin: Vec<u8> = mesh.positions.as_flattened().iter().flat_map(|x| (*x as f32).to_le_bytes()).collect();
    let positions = bin.len();
    bin.extend(mesh.faces.as_flattened().iter().flat_map(|v| v.to_le_bytes()));
    let mut text = format!(
        r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],"meshes":[{{"primitives":
        [{{"attributes":{{"POSITION":0}},"indices":1}}]}}],"buffers":[{{"byteLength":{}}}],"bufferViews":
        [{{"buffer":0,"byteLength":{positions}}},{{"buffer":0,"byteOffset":{positions},"byteLength":{}}}],"accessors":
        [{{"bufferView":0,"componentType":5126,"type":"VEC3","count":{}}},
         {{"bufferView":1,"componentType":5125,"type":"SCALAR","count":{}}}]}}"#,
        bin.len(),
        bin.len() - positions,
        mesh.positions.len(),
        3 * mesh.faces.len()
    );
    while text.len() % 4 != 0 {
        text.push(' ');
    }
    let words = |words: [u32; 2]| words.map(u32::to_le_bytes).concat();
    let mut bytes = [b"glTF".to_vec(), words([2, (28 + text.len() + bin.len()) as u32])].concat();
    bytes.extend([words([text.len() as u32, 0x4e4f_534a]), text.into_bytes()].concat());
    bytes.extend([words([bin.len() as u32, 0x004e_4942]), bin].concat());
    bytes
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packer = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packer.write_all(bytes).unwrap();
    packer.finish().unwrap()
}

#[test]
fn every_format_gives_the_same_bytes() {
    let folder = Folder::new();
    let mesh = torus(320, 200);
    let plain = mesh.bytes(Kind::Floats);
    let files = [
        ("scan.obj", obj(&mesh).into_bytes()),
        ("scan.off", off(&mesh).into_bytes()),
        ("scan.glb", glb(&mesh)),
        ("scan.ply.gz", gzip(&plain)),
        ("scan.obj.zst", zstd::encode_all(obj(&mesh).as_bytes(), 1).unwrap()),
    ];
    for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
        let args = ["--faces", "1000", "--memory", memory];
        let reference = folder.reduce(&folder.scan("reference", &mesh, Kind::Floats), &args).done(mode);
        for (name, bytes) in &files {
            let done = folder.reduce(&folder.file(name, bytes), &args).done(mode);
            assert_eq!(done.bytes, reference.bytes, "{name} {mode}");
            assert_eq!(done.report["input"]["faces"], mesh.faces.len());
            let unpacked = if name.ends_with("gz") || name.ends_with("zst") { plain.len() as u64 / 2 } else { 0 };
            assert!(done.report["scratch_bytes"].as_u64().unwrap() >= unpacked, "{name}: {}", done.report);
        }
        let done = piped(&plain, &folder, &args);
        assert_eq!((done.status.code(), done.stdout), (Some(0), reference.bytes), "{mode}");
        assert!(String::from_utf8(done.stderr).unwrap().starts_with("scan     -: 128,000 faces"));
    }
    let scratch = folder.names();
    assert!(
        scratch.iter().all(|name| name.starts_with("scan") || name.starts_with("re") || name == "out.ply"),
        "{scratch:?}"
    );
}

/// From standard input to standard output.
fn piped(bytes: &[u8], folder: &Folder, args: &[&str]) -> Output {
    let mut command = program();
    command.args(["reduce", "-", "-o", "-"]).args(args).current_dir(folder.path("").as_path());
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut stdin = child.stdin.take().unwrap();
    std::thread::scope(|scope| {
        scope.spawn(move || stdin.write_all(bytes));
        child.wait_with_output().unwrap()
    })
}

/// Positions and faces as the library reads them back.
fn read(path: &Path) -> (Mesh, Format) {
    let progress = Progress::default();
    let scan = Scan::open(path, &progress).unwrap();
    let crew = Crew { workers: 1, progress: &progress };
    let mesh = Mutex::new(Mesh::default());
    if scan.format() == Format::StlBinary {
        let keep = |(): &mut (), chunk: meshmill::read::SoupChunk<'_>| {
            mesh.lock().unwrap().positions.extend_from_slice(chunk.triangles.as_flattened());
            Ok(())
        };
        scan.soup(&crew, || (), keep).unwrap();
    } else {
        let keep = |(): &mut (), chunk: meshmill::read::VertexChunk<'_>| {
            mesh.lock().unwrap().positions.extend_from_slice(chunk.positions);
            Ok(())
        };
        scan.vertices(&crew, || (), keep).unwrap();
        let keep = |(): &mut (), chunk: meshmill::read::TriangleChunk<'_>| {
            mesh.lock().unwrap().faces.extend_from_slice(chunk.triangles);
            Ok(())
        };
        scan.triangles(&crew, || (), keep).unwrap();
    }
    (mesh.into_inner().unwrap(), scan.format())
}

const OUTPUTS: [(&str, &str, Format); 6] = [
    ("out.ply", "ply", Format::PlyLittleEndian),
    ("out.txt", "ply-ascii", Format::PlyAscii),
    ("out.stl", "stl", Format::StlBinary),
    ("out.obj", "obj", Format::Obj),
    ("out.glb", "glb", Format::Glb),
    ("small.glb", "glb-quantised", Format::Glb),
];

#[test]
fn what_is_written_reads_back() {
    let folder = Folder::new();
    let mesh = torus(40, 25);
    for (kind, scale) in [(Kind::Floats, 1.0), (Kind::Doubles, 1.0 / 3.0)] {
        let scan = folder.scan("scan", &mesh.clone().scaled(scale), kind);
        let reduce = |name: &str, format: &str| {
            let out = folder.path(name);
            let mut command = program();
            command.arg("reduce").arg(&scan).arg("-o").arg(&out).args(["--format", format, "--faces", "500"]);
            assert_eq!(command.output().unwrap().status.code(), Some(0), "{name}");
            out
        };
        let whole = Mesh::read(&reduce("out.ply", "ply"));
        for (name, word, format) in OUTPUTS {
            let (found, as_format) = read(&reduce(name, word));
            assert_eq!(as_format, format, "{name}");
            if word == "stl" {
                let corners = whole.faces.as_flattened().iter().map(|v| whole.positions[*v as usize]);
                let rounded = corners.map(|p| p.map(|x| f64::from(x as f32)));
                assert!(rounded.eq(found.positions), "{name}");
                continue;
            }
            assert_eq!(found.faces, whole.faces, "{name}");
            let exact = !word.starts_with("glb") || kind == Kind::Floats;
            let most = match word {
                "glb-quantised" => whole.diagonal() / 65_535.0 / 2.0,
                _ if exact => 0.0,
                _ => whole.diagonal() * 6e-8,
            };
            assert!(farthest(&found, &whole) <= most, "{name} {kind:?}: {} > {most}", farthest(&found, &whole));
        }
        agrees_with_others(&folder, &whole);
    }
}

fn farthest(a: &Mesh, b: &Mesh) -> f64 {
    assert_eq!(a.positions.len(), b.positions.len());
    let distance = |(p, q): (&[f64; 3], &[f64; 3])| (0..3).map(|i| (p[i] - q[i]).powi(2)).sum::<f64>().sqrt();
    a.positions.iter().zip(&b.positions).map(distance).fold(0.0, f64::max)
}

/// Other people's readers see the same mesh.
fn agrees_with_others(folder: &Folder, whole: &Mesh) {
    let floats = |mesh: &Mesh| mesh.positions.iter().map(|p| p.map(|x| x as f32)).collect::<Vec<_>>();
    let text = std::fs::read(folder.path("out.obj")).unwrap();
    let nothing = |_: &Path| Err(tobj::LoadError::OpenFileFailed);
    let (models, _) = tobj::load_obj_buf(&mut &text[..], &tobj::LoadOptions::default(), nothing).unwrap();
    let corner = |i: &u32| [0, 1, 2].map(|axis| models[0].mesh.positions[3 * *i as usize + axis]);
    let at = |v: &u32| floats(whole)[*v as usize];
    let positions = floats(whole);
    assert_eq!(models.len(), 1);
    let found: Vec<[f32; 3]> = models[0].mesh.indices.iter().map(corner).collect();
    assert_eq!(found.len(), 3 * whole.faces.len());
    assert!(found.iter().zip(whole.faces.as_flattened()).all(|(p, v)| *p == positions[*v as usize]), "tobj");
    assert_eq!(found[0], at(&whole.faces[0][0]));

    let mut stl = std::fs::File::open(folder.path("out.stl")).unwrap();
    let stl = stl_io::read_stl(&mut stl).unwrap();
    let found: Vec<[f32; 3]> = stl.faces.iter().flat_map(|f| f.vertices.map(|v| stl.vertices[v].0)).collect();
    assert!(found.iter().zip(whole.faces.as_flattened()).all(|(p, v)| *p == positions[*v as usize]), "stl_io");

    for name in ["out.ply", "out.txt"] {
        use ply_rs::ply::{DefaultElement, Property};
        let bytes = std::fs::read(folder.path(name)).unwrap();
        let ply = ply_rs::parser::Parser::<DefaultElement>::new().read_ply(&mut &bytes[..]).unwrap();
        let number = |property: &Property| match property {
            Property::Float(x) => f64::from(*x),
            Property::Double(x) => *x,
            other => panic!("{other:?}"),
        };
        let found = ply.payload["vertex"].iter().map(|v| ["x", "y", "z"].map(|axis| number(&v[axis])));
        assert!(found.eq(whole.positions.iter().copied()), "{name} by ply-rs");
        assert_eq!(ply.payload["face"].len(), whole.faces.len());
    }
}

#[test]
fn a_place_far_away_survives_in_every_format_that_can_hold_it() {
    let folder = Folder::new();
    let near = field(60, 40);
    let far = near.clone().map(|[x, y, z]| [x + 500_000.0, y + 4_500_000.0, z]);
    // Without refit, which assigns samples to faces: ties fall differently there for the last bit of a double.
    let args = ["--faces", "800", "--refit", "0"];
    let local = folder.reduce_to("near.ply", &folder.scan("scan", &near, Kind::Doubles), &args);
    let local = local.done("in-core").mesh;
    for name in ["far.ply", "far.obj", "far.glb"] {
        let out = folder.path(name);
        let mut command = program();
        command.arg("reduce").arg(folder.scan("scan", &far, Kind::Doubles)).arg("-o").arg(&out);
        assert_eq!(command.args(args).output().unwrap().status.code(), Some(0));
        let (found, _) = read(&out);
        let found = found.map(|[x, y, z]| [x - 500_000.0, y - 4_500_000.0, z]);
        assert_eq!(found.faces, local.faces, "{name}");
        let off = farthest(&found, &local) / local.diagonal();
        assert!(off < 1e-6, "{name}: {off}");
    }
}

#[test]
fn standard_output_is_for_one_thing() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &torus(40, 25), Kind::Floats);
    for more in ["--json", "--verify"] {
        let mut command = program();
        command.arg("reduce").arg(&scan).args(["-o", "-", "--faces", "100", more]);
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(2));
        assert!(String::from_utf8(output.stderr).unwrap().contains("standard output: name a file"));
    }
    let made = program().args(["synth", "-", "--faces", "2000"]).output().unwrap();
    let path = folder.file("made.ply", &made.stdout);
    assert_eq!(Mesh::read(&path).faces.len(), 2000);
    assert!(String::from_utf8(made.stderr).unwrap().starts_with("-: 2,000 faces"));
    // A file that is redirected needs no scratch.
    let mut command = program();
    command.args(["reduce", "-", "--faces", "500", "--json", "-o"]).arg(folder.path("out.ply"));
    let output = command.stdin(std::fs::File::open(&path).unwrap()).output().unwrap();
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&report["scratch_bytes"], &report["output"]["faces"]), (&Value::from(0), &Value::from(500)));
}

#[test]
fn a_quota_bounds_what_is_unpacked() {
    let folder = Folder::new();
    let scan = folder.file("bomb.ply.gz", gzip(&vec![b' '; 8 << 20]));
    let message = folder.reduce(&scan, &["--faces", "9", "--scratch-quota", "1MiB"]).failed(1);
    assert!(message.ends_with("more than the quota of 1MiB is needed"), "{message}");
    assert_eq!(folder.names(), ["bomb.ply.gz"]);
}

/// Where the validator of the format's makers is at hand, it finds nothing to say.
#[test]
fn the_gltf_validator_finds_no_fault() {
    let Some(validator) = std::env::var_os("GLTF_VALIDATOR") else {
        eprintln!("GLTF_VALIDATOR names no program that takes a file: GLB is not validated");
        return;
    };
    let folder = Folder::new();
    let far = torus(40, 25).map(|[x, y, z]| [x + 500_000.0, y, z]);
    for (name, format, mesh) in
        [("a.glb", "glb", &torus(300, 200)), ("b.glb", "glb-quantised", &far), ("c.glb", "glb", &far)]
    {
        let out = folder.path(name);
        let mut command = program();
        command.arg("reduce").arg(folder.scan("scan", mesh, Kind::Doubles)).arg("-o").arg(&out);
        command.args(["--format", format, "--ratio", "1"]);
        assert!(command.output().unwrap().status.success());
        let output = Command::new(&validator).arg(&out).output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stdout));
    }
}
