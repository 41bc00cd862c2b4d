//! Real scans through other people's readers, where `MESHMILL_MODELS` names a folder of them.

use super::write::binary_stl;
use super::{Scratch, read};
use meshmill::mesh::coat::NOTHING;
use meshmill::progress::Progress;
use meshmill::read::Scan;
use ply_rs::parser::Parser;
use ply_rs::ply::{DefaultElement, Property};
use std::path::{Path, PathBuf};

/// Element by element is slow: larger ones are left out.
const MOST_BYTES: u64 = 12 << 20;

fn models(extension: &str) -> Vec<PathBuf> {
    let Some(folder) = std::env::var_os("MESHMILL_MODELS").map(PathBuf::from) else {
        eprintln!("MESHMILL_MODELS is not set: no real scan is read");
        return Vec::new();
    };
    let (mut open, mut found) = (vec![folder], Vec::new());
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
            let (path, about) = (entry.path(), entry.metadata().unwrap());
            if about.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == extension) && about.len() <= MOST_BYTES {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

fn number(property: &Property) -> f64 {
    match property {
        Property::Float(x) => f64::from(*x),
        Property::Double(x) => *x,
        other => panic!("{other:?} is no coordinate"),
    }
}

#[test]
fn models_in_ply_agree_with_ply_rs_and_as_stl_with_stl_io() {
    for path in models("ply") {
        let oracle = Parser::<DefaultElement>::new().read_ply(&mut &std::fs::read(&path).unwrap()[..]).unwrap();
        let positions: Vec<[f64; 3]> =
            oracle.payload["vertex"].iter().map(|v| ["x", "y", "z"].map(|axis| number(&v[axis]))).collect();
        let triangles = oracle.payload["face"].iter().map(|f| match f.values().next() {
            Some(Property::ListInt(list)) => <[u32; 3]>::try_from(list.iter().map(|v| *v as u32).collect::<Vec<_>>()),
            Some(Property::ListUInt(list)) => <[u32; 3]>::try_from(list.clone()),
            other => panic!("{other:?} in {path:?}"),
        });
        let triangles: Vec<[u32; 3]> = triangles.map(Result::unwrap).collect();
        let (_, found) = read(&path).unwrap();
        assert!(found.positions == positions && found.triangles == triangles, "{path:?}");

        let soup: Vec<_> =
            triangles.iter().map(|t| t.map(|v| positions[v as usize].map(|x| f64::from(x as f32)))).collect();
        let bytes = binary_stl(b"made", &soup);
        let mut cursor = std::io::Cursor::new(&bytes);
        let oracle = stl_io::create_stl_reader(&mut cursor).unwrap();
        let oracle: Vec<_> = oracle.map(|t| t.unwrap().vertices.map(|v| v.0.map(f64::from))).collect();
        let (_, found) = read(&Scratch::holding("scan.stl", &bytes).path()).unwrap();
        assert!(found.soup == oracle, "{path:?} as STL");
    }
}

/// What one corner has: a position and texture coordinates.
type Corner = ([f32; 3], Option<[f32; 2]>);

fn ours(path: &Path) -> Vec<Corner> {
    let (_, found) = read(path).unwrap();
    let progress = Progress::default();
    let scan = Scan::open(path, &progress).unwrap();
    let coat = scan.coat(&progress).unwrap().unwrap();
    let (mut corners, mut triangles) = (Vec::new(), Vec::new());
    scan.corners(&coat, &progress, &mut |all| {
        triangles.push(all.vertices);
        let uv = |i: usize| (all.uvs[i] != NOTHING).then(|| coat.uvs[all.uvs[i] as usize]);
        corners.extend((0..3).map(|i| (found.positions[all.vertices[i] as usize].map(|x| x as f32), uv(i))));
    })
    .unwrap();
    assert!(triangles == found.triangles, "{path:?}: corners and triangles are the same");
    corners
}

#[test]
fn models_in_obj_agree_with_tobj() {
    for path in models("obj") {
        let options = tobj::LoadOptions { triangulate: true, ..Default::default() };
        let (models, _) = tobj::load_obj(&path, &options).unwrap();
        let mut oracle: Vec<Corner> = Vec::new();
        for mesh in models.iter().map(|model| &model.mesh) {
            for (i, v) in mesh.indices.iter().enumerate() {
                let at = mesh.positions[3 * *v as usize..][..3].try_into().unwrap();
                let uv = mesh.texcoord_indices.get(i);
                oracle.push((at, uv.map(|t| mesh.texcoords[2 * *t as usize..][..2].try_into().unwrap())));
            }
        }
        assert!(ours(&path) == oracle, "{path:?}");
    }
}
