use super::*;
use crate::mesh::IndexedMesh;
use crate::progress::Progress;
use std::path::Path;

/// A square of `side` by `side` cells, over 0 to 1.
fn square(side: u32) -> IndexedMesh<f32> {
    let n = side + 1;
    let at = |i: u32| [(i % n) as f32 / side as f32, (i / n) as f32 / side as f32, 0.0];
    let cells = (0..side).flat_map(|y| (0..side).map(move |x| y * n + x));
    let faces = cells.flat_map(|i| [[i, i + 1, i + n + 1], [i, i + n + 1, i + n]]).collect();
    IndexedMesh { positions: (0..n * n).map(at).collect(), faces }
}

/// A scan of a square whose vertices carry these numbers.
fn scan(folder: &Path, side: u32, properties: &str, values: impl Fn(f64, f64) -> String) -> Scan {
    let mesh = square(side);
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n{properties}\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.faces.len()
    );
    for [x, y, z] in &mesh.positions {
        text += &format!("{x} {y} {z} {}\n", values(f64::from(*x), f64::from(*y)));
    }
    mesh.faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    std::fs::write(folder.join("scan.ply"), text).unwrap();
    Scan::open(&folder.join("scan.ply"), &Progress::default()).unwrap()
}

fn carried(scan: &Scan, mesh: &IndexedMesh<f32>, workers: usize) -> Columns {
    let progress = Progress::default();
    let all: Vec<usize> = (0..scan.columns().len()).collect();
    carry(scan, &all, mesh, Frame::default(), &Crew { workers, progress: &progress }).unwrap()
}

#[test]
fn what_varies_evenly_is_carried_exactly_and_kinds_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let properties = "property uchar red\nproperty ushort intensity\nproperty float nx\nproperty float ny\n\
                      property float nz\nproperty double time\nproperty float s\n";
    let values = |x: f64, y: f64| {
        let [red, intensity, time] = [255.0 * x, 65_535.0 * y, 1e9 + x + 2.0 * y];
        format!("{} {} {} 0 {} {time} 7", red.round(), intensity.round(), x - 0.5, 0.5 + y)
    };
    let scan = scan(folder.path(), 60, properties, values);
    let named: Vec<&str> = scan.columns().iter().map(|c| c.name.as_str()).collect();
    assert_eq!(named, ["red", "intensity", "nx", "ny", "nz", "time"], "texture coordinates are not averaged");
    let mesh = square(7);
    let found = carried(&scan, &mesh, 2);
    for (v, [x, y, _]) in mesh.positions.iter().enumerate() {
        let (x, y) = (f64::from(*x), f64::from(*y));
        let [red, intensity, nx, ny, nz, time] = found.of(v).try_into().unwrap();
        assert!((red - 255.0 * x).abs() < 2.0 && red.fract() == 0.0, "{red} at {x}");
        assert!((intensity - 65_535.0 * y).abs() < 300.0 && intensity.fract() == 0.0, "{intensity} at {y}");
        let normal = DVec3::new(x - 0.5, 0.0, 0.5 + y).normalize();
        assert!(DVec3::new(nx, ny, nz).distance(normal) < 0.02 && (nx.hypot(nz) - 1.0).abs() < 1e-9);
        assert!((time - 1e9 - x - 2.0 * y).abs() < 0.02, "{time}");
    }
    assert_eq!(carried(&scan, &mesh, 1), found);
    assert_eq!(carried(&scan, &mesh, 5), found);
}

#[test]
fn nothing_leaves_the_range_of_the_scan_and_what_is_no_number_is_passed_over() {
    let folder = tempfile::tempdir().unwrap();
    let step = |x: f64, y: f64| {
        let quality = if y > 0.98 { "nan".into() } else { format!("{}", if x < 0.43 { -3.0 } else { 8.5 }) };
        format!("{quality} {}", if x < 0.43 { 0 } else { 255 })
    };
    let scan = scan(folder.path(), 80, "property float quality\nproperty uchar blue\n", step);
    let mesh = square(9);
    let found = carried(&scan, &mesh, 2);
    for (v, [x, ..]) in mesh.positions.iter().enumerate() {
        let [quality, blue] = found.of(v).try_into().unwrap();
        assert!((-3.0..=8.5).contains(&quality) && (0.0..=255.0).contains(&blue));
        let far = (x - 0.43).abs() > 0.15;
        assert!(!far || (quality - if *x < 0.43 { -3.0 } else { 8.5 }).abs() < 1.5, "{quality} at {x}");
    }
}

#[test]
fn least_squares_is_closer_than_picking_up_what_lies_there() {
    let folder = tempfile::tempdir().unwrap();
    let wave = |x: f64, y: f64| (0.5 + 0.5 * (9.0 * x).sin() * (7.0 * y).cos()).clamp(0.0, 1.0);
    let scan = scan(folder.path(), 100, "property float heat\n", |x, y| wave(x, y).to_string());
    let mesh = square(8);
    let found = carried(&scan, &mesh, 2);
    let tree = Tree::build(&mesh);
    let error = |value: &dyn Fn(u32) -> f64| {
        let mut sum = 0.0;
        for i in 0..10_000u32 {
            let p = DVec3::new(f64::from(i % 100) / 99.0, f64::from(i / 100) / 99.0, 0.0);
            let face = mesh.faces[tree.nearest(p, 0).face as usize];
            let weights = weights(p, face.map(|v| mesh.at(v)));
            let there: f64 = face.iter().zip(weights).map(|(v, w)| w * value(*v)).sum();
            sum += (there - wave(p.x, p.y)).powi(2);
        }
        sum
    };
    let fitted = error(&|v| found.of(v as usize)[0]);
    let picked = error(&|v| {
        let p = mesh.at(v);
        wave(p.x, p.y)
    });
    assert!(fitted < 0.55 * picked, "{fitted} {picked}");
}

#[test]
fn a_piece_without_a_sample_takes_the_average() {
    let folder = tempfile::tempdir().unwrap();
    let scan = scan(folder.path(), 30, "property uchar red\n", |_, _| "200".into());
    let mut mesh = square(4);
    let n = mesh.positions.len() as u32;
    mesh.positions.extend([[50.0, 0.0, 0.0], [51.0, 0.0, 0.0], [50.0, 1.0, 0.0]]);
    mesh.faces.push([n, n + 1, n + 2]);
    let found = carried(&scan, &mesh, 2);
    assert!(found.values.iter().all(|red| *red == 200.0), "{:?}", found.values);
}
