//! What Garland's thesis shows, shown again: its own quadrics, no refit. On real scans, where `MESHMILL_MODELS` names a folder of
//! them.

use crate::models::model;
use crate::support::{Done, Folder, Mesh};
use glam::DVec3;
use meshmill::mesh::IndexedMesh;
use meshmill::mesh::tree::Tree;
use std::path::Path;

const PLAIN: [&str; 4] = ["--quadrics", "accumulated", "--refit", "0"];

fn plain(folder: &Folder, scan: &Path, faces: u32, more: &[&str]) -> Done {
    let faces = faces.to_string();
    folder.reduce(scan, &[&["--faces", &faces], &PLAIN[..], more].concat()).done("in-core")
}

fn indexed(mesh: &Mesh) -> IndexedMesh<f64> {
    IndexedMesh { positions: mesh.positions.clone(), faces: mesh.faces.clone() }
}

/// Mean squared distance (eq. 2.8) as the thesis samples it (§6.2.1): from the vertices of both and the same number of points
/// on every face, however small; as a share of the squared diagonal.
fn e_avg(scan: &Mesh, result: &Mesh) -> f64 {
    const SIDE: u32 = 6;
    let one_way = |from: &Mesh, to: &Mesh| {
        let to = indexed(to);
        let tree = Tree::build(&to);
        let mut points: Vec<DVec3> = from.positions.iter().map(|p| DVec3::from(*p)).collect();
        for face in &from.faces {
            let [a, b, c] = face.map(|v| DVec3::from(from.positions[v as usize]));
            let inside = (0..SIDE).flat_map(|i| (0..SIDE - i).map(move |j| [i, j]));
            points.extend(inside.map(|at| {
                let [u, v] = at.map(|k| (f64::from(k) + 1.0 / 3.0) / f64::from(SIDE));
                a + (b - a) * u + (c - a) * v
            }));
        }
        let mut near = 0;
        let mut sum = 0.0;
        for p in &points {
            let (face, distance_sq) = tree.search(*p, near);
            near = face;
            sum += distance_sq;
        }
        (sum, points.len() as f64)
    };
    let ((a, n), (b, m)) = (one_way(scan, result), one_way(result, scan));
    (a + b) / (n + m) / scan.diagonal().powi(2)
}

/// Table 6.4: at every size optimal placement is closer than subset placement and than face contraction. None is further off than
/// in the thesis by more than the few faces of one approximation make (a quarter); optimal placement is up to twice as close as
/// there, where the determinant of a fine mesh's quadrics was taken for zero, so that the others' losses look larger here.
#[test]
fn optimal_placement_is_the_closest() {
    const TABLE_6_4: [(u32, [f64; 3]); 4] = [
        (100, [2.596e-4, 3.528e-4, 2.968e-4]),
        (500, [1.274e-5, 2.031e-5, 1.734e-5]),
        (1000, [3.434e-6, 5.181e-6, 5.033e-6]),
        (3000, [2.579e-7, 3.390e-7, 4.173e-7]),
    ];
    let Some(cow) = model("table63/cow.ply") else { return };
    let folder = Folder::new();
    let scan = plain(&folder, &cow, 1_000_000, &[]).mesh;
    for (faces, theirs) in TABLE_6_4 {
        let policies: [&[&str]; 3] = [&[], &["--placement", "endpoint"], &["--primitive", "face"]];
        let ours = policies.map(|policy| e_avg(&scan, &plain(&folder, &cow, faces, policy).mesh));
        assert!(ours[0] < ours[1] && ours[0] < ours[2], "{faces}: {ours:?}");
        for (ours, theirs) in ours.iter().zip(theirs) {
            assert!(*ours < 1.25 * theirs, "{faces}: {ours:e}, the thesis {theirs:e}");
        }
    }
}

/// §6.2.1: E_avg falls with a power of the number of faces, about its square.
#[test]
fn error_falls_with_a_power_of_the_faces() {
    let Some(bunny) = model("table63/bunny.ply") else { return };
    let folder = Folder::new();
    let point = |faces: u32| {
        let report = plain(&folder, &bunny, faces, &["--verify"]).report;
        (f64::from(faces).ln(), report["deviation"]["shares"]["e_avg"].as_f64().unwrap().ln())
    };
    let points = [100, 200, 400, 800, 1600, 3200].map(point);
    let mean = |f: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / points.len() as f64;
    let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
    let slope = mean(&|p| (p.0 - x) * (p.1 - y)) / mean(&|p| (p.0 - x).powi(2));
    assert!((-2.0..=-1.6).contains(&slope), "E_avg falls with the power {slope}");
}

/// Fig. 6.31: where pieces lie close by, a range of thresholds for pairs without an edge is closer than edges alone.
#[test]
fn pairs_across_gaps_bring_bones_closer() {
    let Some(bones) = model("table63/footbones.ply") else { return };
    let folder = Folder::new();
    let scan = plain(&folder, &bones, 1_000_000, &[]).mesh;
    let at = |more: &[&str]| e_avg(&scan, &plain(&folder, &bones, 250, more).mesh);
    let edges = at(&[]);
    for distance in ["0.06", "0.08", "0.1"] {
        let pairs = at(&["--pair-distance", distance]);
        assert!(pairs < edges, "{distance}: {pairs:e}, edges alone {edges:e}");
    }
}

/// Fig. 3.12: with constraint planes at the thesis's weight a terrain's border stays, without them it recedes.
#[test]
fn a_terrain_keeps_its_border() {
    let Some(crater) = model("dev/crater_sthelens.ply") else { return };
    let folder = Folder::new();
    let scan = plain(&folder, &crater, 1_000_000, &[]).mesh;
    let receded = |weight: &str| {
        let result = plain(&folder, &crater, 1000, &["--boundary-weight", weight]).mesh;
        let sides: Vec<[DVec3; 2]> =
            result.border().iter().map(|side| side.map(|v| DVec3::from(result.positions[v as usize]))).collect();
        let distance = |v: u32| {
            let p = DVec3::from(scan.positions[v as usize]);
            let to = |[a, b]: &[DVec3; 2]| {
                let along = ((p - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
                (a + (b - a) * along).distance(p)
            };
            sides.iter().map(to).fold(f64::INFINITY, f64::min)
        };
        let border = scan.border();
        border.iter().map(|[v, _]| distance(*v).powi(2)).sum::<f64>().sqrt()
            / (border.len() as f64).sqrt()
            / scan.diagonal()
    };
    let (held, free) = (receded("1000"), receded("0"));
    assert!(held < 5e-4 && free > 5e-3, "the border is {held} of the diagonal off, {free} without constraints");
}
