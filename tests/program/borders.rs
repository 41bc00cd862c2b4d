//! Open borders stay where they are.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, field};

/// Distance to the nearest of the four sides of the rectangle that `field` is over, in the plane and in height.
fn off_rim([x, y, z]: [f64; 3], columns: f64, rows: f64) -> f64 {
    let plane = [x.abs(), y.abs(), (columns - x).abs(), (rows - y).abs()].into_iter().fold(f64::INFINITY, f64::min);
    plane.max(z.abs())
}

#[test]
fn the_rim_of_a_field_is_the_rim_of_the_result() {
    let folder = Folder::new();
    let (columns, rows) = (360, 200);
    let mesh = field(columns, rows);
    for kind in [Kind::Floats, Kind::Stl] {
        let scan = folder.scan("scan", &mesh, kind);
        for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
            for faces in ["4000", "1000", "300"] {
                let done = folder.reduce(&scan, &["--faces", faces, "--memory", memory]).done(mode);
                let off = furthest(&done.mesh, f64::from(columns), f64::from(rows));
                assert!(off < 0.5, "{kind:?} {mode} {faces}: the border is {off} of a step off");
                let [low, high] = done.mesh.extent();
                let expected = [0.0, 0.0, f64::from(columns), f64::from(rows)];
                for (found, expected) in [low[0], low[1], high[0], high[1]].into_iter().zip(expected) {
                    assert!((found - expected).abs() < 0.5, "{kind:?} {mode} {faces}: {low:?} {high:?}");
                }
            }
        }
    }
}

fn furthest(mesh: &Mesh, columns: f64, rows: f64) -> f64 {
    let border = mesh.border();
    assert!(border.len() >= 4, "the result is open where the scan is");
    let ends = border.as_flattened().iter().map(|v| mesh.positions[*v as usize]);
    ends.map(|p| off_rim(p, columns, rows)).fold(0.0, f64::max)
}

#[test]
fn a_closed_scan_stays_closed() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &crate::support::torus(300, 180), Kind::Floats);
    for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
        for faces in ["5000", "500"] {
            let done = folder.reduce(&scan, &["--faces", faces, "--memory", memory]).done(mode);
            assert_eq!(done.mesh.border().len(), 0, "{mode} {faces}");
        }
    }
}
