//! Open borders stay where they are.

use crate::TIGHT;
use crate::support::{Folder, Kind, Mesh, field};

/// Distance to the nearest of the four sides of the rectangle that `field` is over, in the plane and in height.
fn off_rim([x, y, z]: [f64; 3], columns: f64, rows: f64) -> f64 {
    let plane = [x.abs(), y.abs(), (columns - x).abs(), (rows - y).abs()].into_iter().fold(f64::INFINITY, f64::min);
    plane.max(z.abs())
}

/// Faces, and how far the border may be off then, in steps of the scan: between 4,000 faces edges are 8 steps long, between
/// 300 they are 30. On sixteen other fields it was 0.35 steps off at 300 faces in the mean, 0.8 at most.
const OFF: [(&str, f64); 3] = [("4000", 0.25), ("1000", 0.4), ("300", 1.0)];

#[test]
fn the_rim_of_a_field_is_the_rim_of_the_result() {
    let folder = Folder::new();
    let (columns, rows) = (360, 200);
    let mesh = field(columns, rows);
    for kind in [Kind::Floats, Kind::Stl] {
        let scan = folder.scan("scan", &mesh, kind);
        for (memory, mode) in [("512MiB", "in-core"), (TIGHT, "out-of-core")] {
            for (faces, most) in OFF {
                let done = folder.reduce(&scan, &["--faces", faces, "--memory", memory]).done(mode);
                let off = furthest(&done.mesh, f64::from(columns), f64::from(rows));
                assert!(off < most, "{kind:?} {mode} {faces}: the border is {off} of a step off");
                let [low, high] = done.mesh.extent();
                let expected = [0.0, 0.0, f64::from(columns), f64::from(rows)];
                for (found, expected) in [low[0], low[1], high[0], high[1]].into_iter().zip(expected) {
                    assert!((found - expected).abs() < most, "{kind:?} {mode} {faces}: {low:?} {high:?}");
                }
            }
        }
    }
}

/// One field's border may be off by chance; that of several, in the mean, is within half a step of the scan.
#[test]
fn rims_of_fields_are_near_in_the_mean() {
    let folder = Folder::new();
    let sizes = [(360, 200), (340, 220), (320, 240), (380, 180), (300, 260), (400, 170)];
    let off = sizes.map(|(columns, rows)| {
        let scan = folder.scan("scan", &field(columns, rows), Kind::Floats);
        let done = folder.reduce(&scan, &["--faces", "300", "--memory", "512MiB"]).done("in-core");
        furthest(&done.mesh, f64::from(columns), f64::from(rows))
    });
    assert!(off.iter().sum::<f64>() < 0.5 * off.len() as f64, "{off:?}");
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
