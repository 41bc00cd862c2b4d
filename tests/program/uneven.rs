//! Scans on which some places are unlike the others: density, stars, copies.

use crate::TIGHT;
use crate::support::{Dice, Folder, Kind, Mesh, torus};

/// A torus whose first half around has a thirtieth of the faces.
fn uneven(around: u32, across: u32) -> Mesh {
    let mut mesh = torus(around, across);
    let coarse = around / 30;
    for i in 0..around {
        let turns = if i < coarse {
            0.5 * f64::from(i) / f64::from(coarse)
        } else {
            0.5 + 0.5 * f64::from(i - coarse) / f64::from(around - coarse)
        };
        let (u, ring) = (turns * std::f64::consts::TAU, i * across);
        for p in &mut mesh.positions[ring as usize..(ring + across) as usize] {
            let r = p[0].hypot(p[1]);
            *p = [r * u.cos(), r * u.sin(), p[2]];
        }
    }
    mesh
}

#[test]
fn a_coarse_part_is_kept_beside_a_fine_one() {
    for (memory, mode, around) in [("512MiB", "in-core", 600), (TIGHT, "out-of-core", 1800)] {
        let folder = Folder::new();
        let scan = folder.scan("scan", &uneven(around, 120), Kind::Floats);
        let done = folder.reduce(&scan, &["--faces", "2000", "--memory", memory, "--verify"]).done(mode);
        assert!((1999..=2000).contains(&done.faces()), "{}", done.faces());
        let rms = done.report["deviation"]["rms"].as_f64().unwrap() / done.mesh.diagonal();
        assert!(rms < 2e-3, "{mode}: {rms} of the diagonal");
        // What each half has of the surface it has of the result, nearly.
        let low = done.mesh.faces.iter().filter(|f| done.mesh.positions[f[0] as usize][1] > 0.0).count();
        assert!((500..1500).contains(&low), "{mode}: {low} faces of {} in the coarse half", done.faces());
    }
}

#[test]
fn a_vertex_of_twenty_thousand_faces() {
    let mut mesh = Mesh { positions: vec![[0.0, 0.0, 1.0], [0.0, 0.0, -0.2]], faces: Vec::new() };
    let rim = 20_000;
    for i in 0..rim {
        let t = f64::from(i) / f64::from(rim) * std::f64::consts::TAU;
        mesh.positions.push([t.cos(), t.sin(), 0.01 * (40.0 * t).sin()]);
        let (a, b) = (2 + i, 2 + (i + 1) % rim);
        mesh.faces.extend([[0, a, b], [1, b, a]]);
    }
    let folder = Folder::new();
    for (memory, kind) in [("512MiB", Kind::Floats), ("512MiB", Kind::Stl)] {
        let done = folder.reduce(&folder.scan("scan", &mesh, kind), &["--faces", "1000", "--memory", memory]);
        let done = done.done("in-core");
        assert!((999..=1000).contains(&done.faces()), "{}", done.faces());
        assert!(done.mesh.border().is_empty());
        let [low, high] = done.mesh.extent();
        assert!(high[2] > 0.97 && low[2] < -0.18, "the tips are at {} and {}", low[2], high[2]);
    }
}

#[test]
fn every_face_three_times() {
    for (memory, mode, size) in [("512MiB", "in-core", 2), (TIGHT, "out-of-core", 8)] {
        let mut mesh = torus(40 * size, 25 * size);
        let once = mesh.faces.len();
        mesh.faces.extend_from_within(..);
        mesh.faces.extend_from_within(..once);
        Dice::new(4).shuffle(&mut mesh.faces);
        let folder = Folder::new();
        let scan = folder.scan("scan", &mesh, Kind::Floats);
        let done = folder.reduce(&scan, &["--faces", "3000", "--memory", memory, "--verify"]).done(mode);
        assert!((2997..=3000).contains(&done.faces()), "{mode}: {}", done.faces());
        let rms = done.report["deviation"]["rms"].as_f64().unwrap() / done.mesh.diagonal();
        assert!(rms < 3e-3, "{mode}: {rms} of the diagonal");
        if mode == "in-core" {
            assert!(done.warning("non-manifold-edges").is_some(), "{:?}", done.warnings());
        }
    }
}
