//! glTF: what is accepted, and what is refused in which words.

use super::gltf_files::{Bin, Gltf, floats, roof, view};
use super::write::*;
use super::{Content, Scratch, complaint, read, stream};
use meshmill::progress::Progress;
use meshmill::read::{Format, Layout, Scalar, Scan};
use serde_json::json;

fn content(gltf: &Gltf) -> (Scan, Content) {
    read(&Scratch::holding("scan.glb", &gltf.glb()).path()).unwrap()
}

fn roof_triangles() -> Vec<[u32; 3]> {
    SIDES.iter().flat_map(|s| fan(s)).collect()
}

#[test]
fn buffers_wherever_they_are() {
    let roof = roof();
    let (scan, found) = content(&roof);
    assert_eq!((scan.format(), scan.layout(), scan.scalar()), (Format::Glb, Layout::Indexed, Scalar::F32));
    assert_eq!((scan.face_count(), scan.vertex_count(), scan.unit()), (4, 5, Some("metre")));
    assert_eq!((&found.positions[..], found.triangles), (&ROOF[..], roof_triangles()));
    assert_eq!(scan.vertex_error(3, String::new()).byte().map(|b| b % 4), Some(0));

    let file = Scratch::holding("scan.gltf", roof.beside("all%20of%20it.bin").as_bytes());
    std::fs::write(file.path().with_file_name("all of it.bin"), &roof.bin).unwrap();
    let (scan, found) = read(&file.path()).unwrap();
    assert_eq!((scan.format(), found.positions.len(), found.triangles), (Format::Gltf, 5, roof_triangles()));
    assert_eq!(scan.vertex_error(1, String::new()).byte(), Some(12));

    let text = roof.embedded();
    for text in [&text, &text.replace('/', "\\/"), &format!("\u{feff} {text}")] {
        let file = Scratch::holding("scan.gltf", text.as_bytes());
        let scan = file.open_in().unwrap();
        let found = stream(&scan, 2).unwrap();
        assert_eq!((&found.positions[..], found.triangles), (&ROOF[..], roof_triangles()));
        assert_eq!(scan.vertex_error(1, String::new()).byte(), None, "a byte of no file that the user has");
        let told = Scan::open(&file.path(), &Progress::default()).unwrap_err().to_string();
        assert!(told.ends_with("needs a folder for scratch to unpack them into"), "{told}");
    }
}

#[test]
fn every_way_to_say_triangles() {
    let plane = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 2.0, 0.0]];
    let indices = |mode: u32, kind: u32, corners: Option<&[u32]>| {
        let mut gltf = roof();
        let mut bin = Bin::default();
        let positions = bin.put(&floats(&plane));
        gltf.json["bufferViews"][0] = view(positions);
        let primitive = &mut gltf.json["meshes"][0]["primitives"][0];
        primitive["mode"] = mode.into();
        match corners {
            None => drop(primitive.as_object_mut().unwrap().remove("indices")),
            Some(corners) => {
                let bytes = corners.iter().flat_map(|v| v.to_le_bytes()[..[1, 2, 4][kind as usize / 2]].to_vec());
                let bytes: Vec<u8> = bytes.collect();
                gltf.json["bufferViews"][1] = view(bin.put(&bytes));
                gltf.json["accessors"][1]["componentType"] = (5121 + kind).into();
                gltf.json["accessors"][1]["count"] = corners.len().into();
            }
        }
        gltf.json["buffers"][0]["byteLength"] = bin.0.len().into();
        gltf.bin = bin.0;
        content(&gltf).1.triangles
    };
    for kind in [0, 2, 4] {
        assert_eq!(indices(4, kind, Some(&[2, 1, 0, 3, 4, 2, 1])), [[2, 1, 0], [3, 4, 2]]);
        assert_eq!(indices(5, kind, Some(&[0, 1, 2, 3, 4])), [[0, 1, 2], [2, 1, 3], [2, 3, 4]]);
        assert_eq!(indices(6, kind, Some(&[4, 0, 1, 3, 2])), [[4, 0, 1], [4, 1, 3], [4, 3, 2]]);
    }
    assert_eq!(indices(4, 0, None), [[0, 1, 2]]);
    assert_eq!(indices(5, 0, None), [[0, 1, 2], [2, 1, 3], [2, 3, 4]]);
    assert_eq!(indices(6, 0, None), [[0, 1, 2], [0, 2, 3], [0, 3, 4]]);
}

#[test]
fn long_strips_and_fans_by_any_crew() {
    const N: u32 = 50_000;
    let positions: Vec<[f64; 3]> = (0..N).map(|i| [f64::from(i), f64::from(i % 2), 0.0]).collect();
    let mut bin = Bin::default();
    let at = bin.put(&floats(&positions));
    let corners = bin.put(&(0..N).rev().flat_map(u32::to_le_bytes).collect::<Vec<u8>>());
    for mode in [4, 5, 6] {
        let mut gltf = roof();
        gltf.json["meshes"][0]["primitives"][0]["mode"] = mode.into();
        gltf.json["bufferViews"] = json!([view(at), view(corners)]);
        gltf.json["accessors"][0]["count"] = N.into();
        gltf.json["accessors"][1]["count"] = N.into();
        gltf.json["accessors"][1]["componentType"] = 5125.into();
        gltf.json["buffers"][0]["byteLength"] = bin.0.len().into();
        gltf.bin = bin.0.clone();
        let file = Scratch::holding("scan.glb", &gltf.glb());
        let scan = Scan::open(&file.path(), &Progress::default()).unwrap();
        let down = |i: u32| N - 1 - i;
        let expected: Vec<[u32; 3]> = match mode {
            4 => (0..N / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2].map(down)).collect(),
            5 => (0..N - 2).map(|i| [i + i % 2, i + 1 - i % 2, i + 2].map(down)).collect(),
            _ => (1..N - 1).map(|i| [0, i, i + 1].map(down)).collect(),
        };
        for workers in [1, 3] {
            let found = stream(&scan, workers).unwrap();
            assert_eq!((found.triangles, &found.positions), (expected.clone(), &positions), "mode {mode}");
        }
    }
}

#[test]
fn objects_are_where_their_nodes_put_them() {
    let mut gltf = roof();
    gltf.json["scenes"] = json!([{ "nodes": [3] }, { "nodes": [0, 2] }]);
    gltf.json["scene"] = 1.into();
    gltf.json["nodes"] = json!([
        { "children": [1], "translation": [10, 0, 0], "scale": [2, 2, 2] },
        { "mesh": 0, "rotation": [0, 0, 1, 1], "translation": [1, 0, 0] },
        { "mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 5, 1] },
        { "mesh": 0 },
    ]);
    let (scan, found) = content(&gltf);
    assert_eq!((scan.vertex_count(), scan.triangle_count()), (10, 8));
    // A quarter turn about z, then moved by (1, 0, 0), doubled, and moved by (10, 0, 0).
    for (p, q) in ROOF.iter().zip(&found.positions) {
        let expected = [12.0 - 2.0 * p[1], 2.0 * p[0], 2.0 * p[2]];
        assert!(expected.iter().zip(q).all(|(a, b)| (a - b).abs() < 1e-12), "{p:?} {q:?}");
    }
    assert_eq!(found.positions[9], [0.5, 0.5, 4.25]);
    assert_eq!(found.triangles[..4], roof_triangles()[..]);
    let mirrored: Vec<[u32; 3]> = roof_triangles().iter().map(|[a, b, c]| [a + 5, c + 5, b + 5]).collect();
    assert_eq!(found.triangles[4..], mirrored[..], "the inside stays inside");

    // Without scenes, nodes that are nobody's children; without nodes, meshes.
    gltf.json.as_object_mut().unwrap().remove("scenes");
    assert_eq!(content(&gltf).0.triangle_count(), 12);
    gltf.json.as_object_mut().unwrap().remove("nodes");
    assert_eq!(content(&gltf).0.triangle_count(), 4);
}

#[test]
fn places_far_away_are_kept_in_doubles() {
    let mut gltf = roof();
    gltf.json["nodes"][0]["translation"] = json!([500_000.125, 4_500_000.5, 0]);
    let (scan, found) = content(&gltf);
    assert_eq!((scan.scalar(), found.positions[4]), (Scalar::F64, [500_000.625, 4_500_001.0, 0.75]));
    gltf.json["nodes"][0]["translation"] = json!([3, 0, 0]);
    assert_eq!(content(&gltf).0.scalar(), Scalar::F32);
}

#[test]
fn quantised_interleaved_and_shared() {
    let mut gltf = roof();
    let mut bin = Bin::default();
    let mut records = Vec::new();
    for p in &ROOF {
        records.extend(p.iter().flat_map(|x| ((x * 32767.0).round() as i16).to_le_bytes()));
        records.extend([9; 6]);
    }
    // The last record ends with its last number.
    records.truncate(records.len() - 6);
    let positions = bin.put(&records);
    let corners = bin.put(&[0u8, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4]);
    gltf.json["bufferViews"] = json!([view(positions), view(corners)]);
    gltf.json["bufferViews"][0]["byteStride"] = 12.into();
    gltf.json["accessors"] = json!([
        { "bufferView": 0, "componentType": 5122, "normalized": true, "type": "VEC3", "count": 5 },
        { "bufferView": 1, "componentType": 5121, "type": "SCALAR", "count": 6 },
        { "bufferView": 1, "componentType": 5121, "type": "SCALAR", "count": 6, "byteOffset": 6 },
    ]);
    gltf.json["meshes"][0]["primitives"] = json!([
        { "attributes": { "POSITION": 0 }, "indices": 1 },
        { "attributes": { "POSITION": 0 }, "indices": 2, "mode": 4 },
        { "attributes": { "POSITION": 0 }, "mode": 1 },
    ]);
    gltf.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    gltf.json["buffers"][0]["byteLength"] = bin.0.len().into();
    gltf.bin = bin.0;
    let (scan, found) = content(&gltf);
    assert_eq!((scan.vertex_count(), found.triangles), (5, roof_triangles()));
    for (p, q) in ROOF.iter().zip(&found.positions) {
        assert!(p.iter().zip(q).all(|(a, b)| (a - b).abs() < 2e-5), "{p:?} {q:?}");
    }
}

#[test]
fn what_it_carries_is_named() {
    let mut gltf = roof();
    gltf.json["accessors"][0]["type"] = "VEC3".into();
    gltf.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 2.into();
    gltf.json["accessors"].as_array_mut().unwrap().push(json!({ "componentType": 5121, "type": "VEC4", "count": 5 }));
    let (scan, _) = content(&gltf);
    let named: Vec<String> = scan.attributes().iter().map(|a| format!("{} {}", a.name, a.kind)).collect();
    assert_eq!(named, ["COLOR_0 VEC4 unsigned byte"]);
}

#[test]
fn what_is_broken() {
    let told = |change: &dyn Fn(&mut serde_json::Value)| {
        let mut gltf = roof();
        change(&mut gltf.json);
        complaint("scan.glb", &gltf.glb())
    };
    assert!(told(&|j| j["accessors"][1]["count"] = 13.into()).ends_with("needs 26 bytes, but its buffer view has 24"));
    assert!(told(&|j| j["accessors"][0]["count"] = 0.into()).ends_with("accessor 0: counts 0"));
    assert!(told(&|j| j["bufferViews"][1]["byteLength"] = 99.into()).contains("its buffer view ends at"));
    assert!(told(&|j| j["buffers"][0]["byteLength"] = 999.into()).contains("999 bytes are promised"));
    assert!(told(&|j| j["accessors"][0]["type"] = "VEC2".into()).contains("expected VEC3"));
    assert!(told(&|j| j["accessors"][0]["sparse"] = json!({})).contains("is sparse"));
    assert!(told(&|j| j["nodes"][0]["children"] = json!([0])).contains("is reached twice, expected a tree"));
    assert!(told(&|j| j["nodes"][0]["mesh"] = 7.into()).contains("mesh 7: is named, but not there"));
    assert!(told(&|j| j["extensionsRequired"] = json!(["KHR_draco_mesh_compression"])).contains("which is not read"));
    assert!(told(&|j| j["meshes"][0]["primitives"][0]["mode"] = 1.into()).ends_with("no triangles in its scene"));
    assert!(told(&|j| j["buffers"][0]["uri"] = "https://x/y.bin".into()).contains("expected the name of a file"));
    assert!(told(&|j| j["accessors"] = "none".into()).contains("its JSON is not that of glTF"));

    let mut lying = roof();
    lying.bin[60 + 2 * 7..][..2].copy_from_slice(&[5, 0]);
    let told = complaint("scan.glb", &lying.glb());
    assert!(told.starts_with("face 2 (byte ") && told.ends_with("index 5, but its primitive has 5 vertices"), "{told}");

    let glb = roof().glb();
    for len in 4..glb.len() {
        complaint("cut.glb", &glb[..len]);
    }
    let old = [b"glTF".to_vec(), 1u32.to_le_bytes().to_vec(), glb[8..].to_vec()].concat();
    assert_eq!(complaint("old.glb", &old), "byte 4: glTF version 1, expected 2");
    assert!(complaint("not.gltf", b"{\"asset\": {}}").contains("no triangles in its scene"));
    assert!(complaint("not.gltf", b"{\"asset\": ").contains("its JSON is not that of glTF"));
}
