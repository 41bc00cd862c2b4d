//! Real scans through other people's readers, where `MESHMILL_MODELS` names a folder of them.

use crate::support::{Folder, Kind, Mesh};
use meshmill::mesh::coat::NOTHING;
use meshmill::progress::Progress;
use meshmill::read::{Crew, Scan};
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
        assert!(read(&path) == (positions.clone(), triangles.clone()), "{path:?}");

        let mesh = Mesh { positions, faces: triangles };
        let bytes = mesh.bytes(Kind::Stl);
        let mut cursor = std::io::Cursor::new(&bytes);
        let oracle = stl_io::create_stl_reader(&mut cursor).unwrap();
        let oracle: Vec<_> = oracle.map(|t| t.unwrap().vertices.map(|v| v.0.map(f64::from))).collect();
        let folder = Folder::new();
        folder.file("scan.stl", bytes);
        assert!(soup(&folder.path("scan.stl")) == oracle, "{path:?} as STL");
    }
}

fn read(path: &Path) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let progress = Progress::default();
    let (scan, crew) = (Scan::open(path, &progress).unwrap(), Crew { workers: 1, progress: &progress });
    let positions = scan.vertices(&crew, Vec::new, |all, chunk| {
        all.extend_from_slice(chunk.positions);
        Ok(())
    });
    let triangles = scan.triangles(&crew, Vec::new, |all, chunk| {
        all.extend_from_slice(chunk.triangles);
        Ok(())
    });
    (positions.unwrap().concat(), triangles.unwrap().concat())
}

fn soup(path: &Path) -> Vec<[[f64; 3]; 3]> {
    let progress = Progress::default();
    let (scan, crew) = (Scan::open(path, &progress).unwrap(), Crew { workers: 1, progress: &progress });
    let triangles = scan.soup(&crew, Vec::new, |all, chunk| {
        all.extend_from_slice(chunk.triangles);
        Ok(())
    });
    triangles.unwrap().concat()
}

/// What one corner has: a position and texture coordinates.
type Corner = ([f32; 3], Option<[f32; 2]>);

fn ours(path: &Path) -> Vec<Corner> {
    let (positions, faces) = read(path);
    let progress = Progress::default();
    let scan = Scan::open(path, &progress).unwrap();
    let coat = scan.coat(&progress).unwrap().unwrap();
    let (mut corners, mut triangles) = (Vec::new(), Vec::new());
    scan.corners(&coat, &progress, &mut |all| {
        triangles.push(all.vertices);
        let uv = |i: usize| (all.uvs[i] != NOTHING).then(|| coat.uvs[all.uvs[i] as usize]);
        corners.extend((0..3).map(|i| (positions[all.vertices[i] as usize].map(|x| x as f32), uv(i))));
    })
    .unwrap();
    assert!(triangles == faces, "{path:?}: corners and triangles are the same");
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
