//! Scale and position: what is exact stays exact, and nothing depends on the units.

use crate::TIGHT;
use crate::support::{Done, Folder, Kind, Mesh, as_float, field, torus};

const MODES: [(&str, &str); 2] = [("512MiB", "in-core"), (TIGHT, "out-of-core")];

fn reduced(mesh: &Mesh, kind: Kind, memory: &str, mode: &str) -> Done {
    let folder = Folder::new();
    let scan = folder.scan("scan", mesh, kind);
    folder.reduce(&scan, &["--faces", "1500", "--memory", memory]).done(mode)
}

#[test]
fn a_power_of_two_scales_the_result_exactly() {
    let mesh = torus(300, 180);
    for kind in [Kind::Floats, Kind::Doubles, Kind::Stl] {
        for (memory, mode) in MODES {
            let one = reduced(&mesh, kind, memory, mode);
            for exponent in [-20, 20, -1, 3] {
                let scale = 2f64.powi(exponent);
                let other = reduced(&mesh.clone().scaled(scale), kind, memory, mode);
                assert!(other.mesh == one.mesh.clone().scaled(scale), "{kind:?} {mode} 2^{exponent}");
                let estimate = |done: &Done| done.report["error_estimate"].as_f64().unwrap();
                let ratio = estimate(&other) / (scale * estimate(&one));
                assert!(
                    (ratio - 1.0).abs() < 1e-12,
                    "{kind:?} {mode} 2^{exponent}: estimate is {ratio} times as large"
                );
            }
        }
    }
}

#[test]
fn any_other_scale_gives_the_same_count_and_error() {
    let mesh = torus(300, 180);
    for (memory, mode) in MODES {
        let one = reduced(&mesh, Kind::Floats, memory, mode);
        for scale in [1e-12, 1e-6, 0.25, 1e6] {
            let other = reduced(&mesh.clone().scaled(scale), Kind::Floats, memory, mode);
            assert_eq!(other.faces(), one.faces(), "{mode} {scale}");
            let relative = |done: &Done| done.report["error_estimate"].as_f64().unwrap() / done.mesh.diagonal();
            let ratio = relative(&other) / relative(&one);
            assert!((0.5..2.0).contains(&ratio), "{mode} {scale}: estimate is {ratio} times as large");
            let growth = other.mesh.diagonal() / one.mesh.diagonal() / scale;
            // Scales that are no powers of two round differently, and other ties fall: vertices at the rim end elsewhere.
            assert!((growth - 1.0).abs() < 4e-3, "{mode} {scale}: the result is {growth} times as large");
        }
    }
}

#[test]
fn coordinates_far_from_the_origin_are_reduced_where_they_are() {
    // At 1e7 floats are whole numbers: the field's grid is exact, its heights are steps.
    for (memory, mode) in MODES {
        let mesh = field(300, 180).map(|[x, y, z]| [x + 1e7, y - 1e7, as_float(z)]);
        let done = reduced(&mesh, Kind::Floats, memory, mode);
        let (scan, result) = (mesh.extent(), done.mesh.extent());
        for axis in 0..3 {
            assert!((scan[0][axis] - result[0][axis]).abs() < 3.0, "{mode}: {scan:?} {result:?}");
            assert!((scan[1][axis] - result[1][axis]).abs() < 3.0, "{mode}: {scan:?} {result:?}");
        }
    }
}

/// A survey in metres, in doubles, where surveys lie; its digits are not those of floats.
fn survey(columns: u32, rows: u32) -> Mesh {
    let [east, north, up] = [500_000.123_456_789, 4_500_000.987_654_321, 412.000_000_1];
    field(columns, rows).map(|[x, y, z]| [east + 0.013 * x, north + 0.017 * y, up + 0.011 * z])
}

#[test]
fn doubles_come_out_bit_for_bit() {
    let folder = Folder::new();
    let mesh = survey(40, 30);
    let scan = folder.scan("scan", &mesh, Kind::Doubles);
    let done = folder.reduce(&scan, &["--faces", "1M"]).done("in-core");
    assert!(done.mesh == mesh);
}

#[test]
fn a_georeferenced_scan_keeps_its_precision() {
    // The survey, and the same about the origin: what the offset costs is what a double cannot hold there.
    for (memory, mode) in MODES {
        let mesh = survey(300, 180);
        let origin = mesh.positions[0];
        let local = mesh.clone().map(|p| std::array::from_fn(|axis| p[axis] - origin[axis]));
        let there = reduced(&mesh, Kind::Doubles, memory, mode);
        let here = reduced(&local, Kind::Doubles, memory, mode);
        let estimate = |done: &Done| done.report["error_estimate"].as_f64().unwrap();
        let ratio = estimate(&there) / estimate(&here);
        assert!((0.8..1.25).contains(&ratio), "{mode}: estimate is {ratio} times as large");
        let vertices = there.mesh.positions.len() as f64;
        let finer = there.mesh.positions.iter().filter(|p| p.iter().any(|x| as_float(*x) != *x)).count() as f64;
        assert!(finer > 0.9 * vertices, "{mode}: {finer} of {vertices} vertices need doubles");
        let [low, high] = there.mesh.extent();
        let [least, largest] = mesh.extent();
        for axis in 0..2 {
            assert!((low[axis] - least[axis]).abs() < 0.01 && (high[axis] - largest[axis]).abs() < 0.01, "{mode}");
        }
    }
}

/// Two tori of so many vertices and a scaled one. The first has a thousand edges alike, the second none; the longest side
/// of the third is a power of two: elsewhere a bit less or more.
fn tori(around: u32, across: u32) -> [(&'static str, Mesh); 3] {
    let even = torus(around, across).map(|p| p.map(|x| 50.0 * x));
    let bump = |x: f64, k: f64| 0.03 * (k * x).sin();
    let mut bumped = torus(around, across);
    for (i, p) in (0..).zip(&mut bumped.positions) {
        let angle = |step: u32, steps: u32| f64::from(step) / f64::from(steps) * std::f64::consts::TAU;
        let (u, v) = (angle(i / across, around), angle(i % across, across));
        let (x, y, z) = ((1.0 + 0.4 * v.cos()) * u.cos(), (1.0 + 0.4 * v.cos()) * u.sin(), 0.4 * v.sin());
        let at = [x + bump(y, 7.3), y + bump(z, 11.9), z + bump(x, 5.7) + bump(x * y, 17.0)];
        *p = at.map(|x| 50.0 * x);
    }
    let longest = (0..3).map(|axis| bumped.extent()[1][axis] - bumped.extent()[0][axis]).fold(0.0, f64::max);
    let unit = bumped.clone().scaled(128.0 / longest);
    [("even", even), ("bumped", bumped), ("unit", unit)]
}

/// Where doubles are a millionth of a millimetre apart.
const THERE: [f64; 3] = [500_000.0, 4_500_000.0, 0.0];

fn moved(mesh: &Mesh, sign: f64) -> Mesh {
    mesh.clone().map(|p| std::array::from_fn(|axis| p[axis] + sign * THERE[axis]))
}

/// How far the results of both are from each other, as a share of their size.
fn apart(near: &Mesh, far: &Mesh, (memory, mode): (&str, &str), name: &str) -> f64 {
    let [home, away] = [near, far].map(|mesh| reduced(mesh, Kind::Doubles, memory, mode).mesh);
    assert!(home.faces == away.faces, "{name} {mode}");
    let off =
        |(p, q): (&[f64; 3], &[f64; 3])| (0..3).map(|axis| (q[axis] - THERE[axis] - p[axis]).abs()).fold(0.0, f64::max);
    home.positions.iter().zip(&away.positions).map(off).fold(0.0, f64::max) / near.diagonal()
}

#[test]
fn a_georeferenced_copy_gives_the_same_mesh_there() {
    for (name, mesh) in tori(200, 120) {
        let off = apart(&mesh, &moved(&mesh, 1.0), MODES[0], name);
        assert!(off < 1e-6, "{name}: {off}");
    }
}

#[test]
fn a_georeferenced_copy_that_loses_no_digits_gives_the_very_mesh() {
    for (name, mesh) in tori(300, 180) {
        let there = moved(&mesh, 1.0);
        for mode in MODES {
            let off = apart(&moved(&there, -1.0), &there, mode, name);
            assert!(off < 1e-8, "{name} {mode:?}: {off}");
        }
    }
}

#[test]
fn writing_doubles_as_stl_is_said() {
    let folder = Folder::new();
    let scan = folder.scan("scan", &survey(40, 30), Kind::Doubles);
    let outcome = folder.reduce_to("out.stl", &scan, &["--faces", "100"]);
    assert_eq!(outcome.code, Some(0));
    assert_eq!(outcome.object["warnings"][0]["code"], "stl-loses-doubles");
}
