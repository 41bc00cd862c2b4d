//! Materials and textures of glTF, and textures that a PLY names.

use crate::support::{Folder, field, program};
use serde_json::{Value, json};

/// What textures hold: what is in it is nobody's business here.
const PICTURE: &[u8] = b"a picture";
const PICTURE_IN_BASE64: &str = "YSBwaWN0dXJl";

/// Two sheets side by side that meet in seven vertices: one red and without a texture, one with.
fn sheets() -> (Value, Vec<u8>) {
    let (mut bin, mut views, mut accessors) = (Vec::new(), Vec::new(), Vec::new());
    let mut put = |kind: u32, shape: &str, count: usize, bytes: Vec<u8>| {
        views.push(json!({ "buffer": 0, "byteOffset": bin.len(), "byteLength": bytes.len() }));
        let view = views.len() - 1;
        accessors.push(json!({ "bufferView": view, "componentType": kind, "type": shape, "count": count }));
        bin.extend(bytes);
        view
    };
    let mut primitives = Vec::new();
    for sheet in 0..2 {
        let (n, at) = (40, |i: usize| i as f32 / 39.0);
        let floats = |numbers: Vec<f32>| numbers.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let places = (0..n * n).map(|i| (at(i % n), at(i / n)));
        let bump = |s: f32, t: f32| (6.0 * s).sin() * (5.0 * t).cos() * 0.1 * s * (1.0 - s);
        let positions = places.clone().flat_map(|(s, t)| [s + sheet as f32, t, bump(s, t)]).collect();
        let uvs = places.flat_map(|(s, t)| [0.5 * s, t]).collect();
        let cell = |i: usize| [i, i + 1, i + n + 1, i, i + n + 1, i + n];
        let corners = (0..n * (n - 1)).filter(|i| i % n < n - 1).flat_map(cell);
        let corners: Vec<u8> = corners.flat_map(|v| (v as u32).to_le_bytes()).collect();
        let attributes = json!({
            "POSITION": put(5126, "VEC3", n * n, floats(positions)),
            "TEXCOORD_0": put(5126, "VEC2", n * n, floats(uvs)),
        });
        let indices = put(5125, "SCALAR", corners.len() / 4, corners);
        primitives.push(json!({ "attributes": attributes, "indices": indices, "material": 1 - sheet }));
    }
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": primitives }],
        "materials": [
            { "name": "bark", "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 } } },
            { "name": "paint", "alphaMode": "BLEND",
              "pbrMetallicRoughness": { "baseColorFactor": [1.0, 0.21404114, 0.0, 0.5] } },
        ],
        "textures": [{ "source": 0 }],
        "images": [{ "uri": "bark%20brown.png" }],
        "accessors": accessors, "bufferViews": views, "buffers": [{ "byteLength": bin.len(), "uri": "sheets.bin" }],
    });
    (document, bin)
}

fn reduce(folder: &Folder, scan: &str, out: &str) -> Value {
    let mut command = program();
    command.arg("reduce").arg(folder.path(scan)).arg("-o").arg(folder.path(out)).args(["--faces", "500", "--json"]);
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The document and the binary part of a GLB.
fn parts(bytes: &[u8]) -> (Value, &[u8]) {
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    (serde_json::from_slice(&bytes[20..20 + length]).unwrap(), &bytes[28 + length..])
}

/// Holds a reduced OBJ against the sheets: which material is where, and what is taken from the texture there.
fn check(text: &str) {
    let (mut v, mut vt, mut material, mut counts) = (Vec::new(), Vec::new(), "", [0, 0]);
    for line in text.lines() {
        let (word, rest) = line.split_once(' ').unwrap_or_default();
        let numbers = || rest.split(' ').filter_map(|x| x.parse::<f64>().ok()).collect::<Vec<_>>();
        match word {
            "v" => v.push(numbers()),
            "vt" => vt.push(numbers()),
            "usemtl" => material = rest,
            "f" => {
                let right = material == "bark";
                assert!(right || material == "paint", "{material}");
                counts[usize::from(right)] += 1;
                for corner in rest.split(' ') {
                    let mut of = corner.split('/').map(|n| n.parse::<usize>().unwrap() - 1);
                    let (p, uv) = (&v[of.next().unwrap()], &vt[of.next().unwrap()]);
                    let s = p[0] - f64::from(u8::from(right));
                    assert!((-1e-4..=1.0 + 1e-4).contains(&s), "a face of {material} at {p:?}");
                    let expected = [0.5 * s, 1.0 - p[1]];
                    assert!(
                        (uv[0] - expected[0]).abs() < 0.02 && (uv[1] - expected[1]).abs() < 0.02,
                        "{uv:?} at {p:?}"
                    );
                }
            }
            _ => {}
        }
    }
    assert!(counts[0] > 50 && counts[1] > 50 && counts[0] + counts[1] >= 498, "{counts:?}");
}

#[test]
fn materials_of_gltf_reach_obj_and_glb() {
    let folder = Folder::new();
    let (mut document, bin) = sheets();
    folder.file("sheets.bin", &bin);
    folder.file("bark brown.png", PICTURE);
    folder.file("beside.gltf", document.to_string());
    document["images"] = json!([{ "uri": format!("data:image/png;base64,{PICTURE_IN_BASE64}"), "name": "bark" }]);
    folder.file("embedded.gltf", document.to_string());
    for (scan, file) in [("beside.gltf", "bark brown.png"), ("embedded.gltf", "bark")] {
        let file = if scan == "embedded.gltf" { "bark".to_string() } else { file.to_string() };
        std::fs::create_dir_all(folder.path("out")).unwrap();
        let report = reduce(&folder, scan, "out/small.obj");
        assert_eq!(report["warnings"], Value::Array(Vec::new()), "{scan}");
        check(&std::fs::read_to_string(folder.path("out/small.obj")).unwrap());
        let library = std::fs::read_to_string(folder.path("out/small.mtl")).unwrap();
        let paint = "newmtl paint\nKd 1 0.5 0\nd 0.5\n";
        assert!(library.contains(paint) && library.contains(&format!("map_Kd {file}\n")), "{library}");
        assert_eq!(std::fs::read(folder.path(&format!("out/{file}"))).unwrap(), PICTURE);
    }
    // From within a GLB, and back.
    reduce(&folder, "beside.gltf", "first.glb");
    let report = reduce(&folder, "first.glb", "small.glb");
    let codes: Vec<_> = report["warnings"].as_array().unwrap().iter().map(|w| w["code"].clone()).collect();
    assert!(codes.iter().all(|code| code == "target-above-scan"), "{report}");
    let bytes = std::fs::read(folder.path("small.glb")).unwrap();
    let (document, bin) = parts(&bytes);
    let of = |name: &str| document["materials"].as_array().unwrap().iter().find(|m| m["name"] == name).unwrap().clone();
    assert_eq!(of("bark")["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);
    let factor = of("paint")["pbrMetallicRoughness"]["baseColorFactor"].clone();
    assert!((factor[1].as_f64().unwrap() - 0.21404114).abs() < 1e-6 && factor[3] == 0.5, "{factor}");
    let view = &document["bufferViews"][document["images"][0]["bufferView"].as_u64().unwrap() as usize];
    let at = view["byteOffset"].as_u64().unwrap() as usize;
    assert_eq!(&bin[at..at + view["byteLength"].as_u64().unwrap() as usize], PICTURE);
    reduce(&folder, "small.glb", "again.obj");
    check(&std::fs::read_to_string(folder.path("again.obj")).unwrap());
}

#[test]
fn what_cannot_be_had_of_a_texture_is_told() {
    let folder = Folder::new();
    let (mut document, bin) = sheets();
    folder.file("sheets.bin", &bin);
    folder.file("scan.gltf", document.to_string());
    let lost = |report: Value| report["warnings"][0]["text"].as_str().unwrap_or_default().to_string();
    assert_eq!(lost(reduce(&folder, "scan.gltf", "out.glb")), "not carried over to the result: bark brown.png");
    assert_eq!(lost(reduce(&folder, "scan.gltf", "out.ply")), "not carried over to the result: material");
    for wrong in [json!({}), json!({ "bufferView": 99 }), json!({ "uri": "http://x/y.png" }), json!({ "uri": "" })] {
        document["images"] = json!([wrong]);
        folder.file("scan.gltf", document.to_string());
        assert!(lost(reduce(&folder, "scan.gltf", "out.glb")).starts_with("not carried over"), "{wrong}");
    }
}

#[test]
fn a_ply_names_its_texture() {
    let folder = Folder::new();
    let mesh = field(60, 50);
    let mut text = format!(
        "ply\nformat ascii 1.0\ncomment TextureFile the map.png\nelement vertex {}\nproperty float x\nproperty float y\n\
         property float z\nproperty float s\nproperty float t\nelement face {}\n\
         property list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.faces.len()
    );
    mesh.positions.iter().for_each(|[x, y, z]| text += &format!("{x} {y} {z} {} {}\n", x / 60.0, y / 50.0));
    mesh.faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    folder.file("scan.ply", text);
    folder.file("the map.png", PICTURE);
    std::fs::create_dir(folder.path("out")).unwrap();
    for out in ["out/small.obj", "out/small.glb", "out/small.ply"] {
        let report = reduce(&folder, "scan.ply", out);
        assert_eq!(report["warnings"], Value::Array(Vec::new()), "{out}");
        let bytes = std::fs::read(folder.path(out)).unwrap();
        if out.ends_with("glb") {
            let (document, _) = parts(&bytes);
            assert_eq!(document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"], 0);
            assert_eq!(document["images"].as_array().map(Vec::len), Some(1));
            continue;
        }
        assert_eq!(std::fs::read(folder.path("out/the map.png")).unwrap(), PICTURE);
        std::fs::remove_file(folder.path("out/the map.png")).unwrap();
        let head = String::from_utf8_lossy(&bytes[..400]).into_owned();
        let says = if out.ends_with("ply") { "comment TextureFile the map.png\n" } else { "mtllib small.mtl\n" };
        assert!(head.contains(says), "{head}");
    }
}
