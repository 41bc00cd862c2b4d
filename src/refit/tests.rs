//! Refits of generated meshes.

use super::ground::nearest_to_origin;
use super::*;
use glam::DVec3;

fn free(wedges: &mut Wedges) -> Held<'_> {
    Held { locked: &[], wedges }
}

/// A patch of `2·side²` faces over the unit square, `height` above it.
fn patch(side: u32, height: impl Fn(f64, f64) -> f64) -> IndexedMesh<f32> {
    let mut mesh = IndexedMesh::default();
    for j in 0..=side {
        for i in 0..=side {
            let (x, y) = (f64::from(i) / f64::from(side), f64::from(j) / f64::from(side));
            mesh.positions.push(narrow(DVec3::new(x, y, height(x, y))));
        }
    }
    for j in 0..side {
        for i in 0..side {
            let a = j * (side + 1) + i;
            mesh.faces.extend([[a, a + 1, a + side + 2], [a, a + side + 2, a + side + 1]]);
        }
    }
    mesh
}

fn hills(x: f64, y: f64) -> f64 {
    0.1 * (7.0 * x).sin() * (9.0 * y + 2.0 * x).cos()
}

/// A fine patch, and one of a fifth as many squares a side: every vertex's home is the nearest of the coarse ones.
fn pair(height: impl Fn(f64, f64) -> f64 + Copy) -> (IndexedMesh<f32>, Reference<f32>) {
    let (coarse, fine) = (patch(12, height), patch(60, height));
    let home = |v: u32| {
        let (i, j) = (v % 61, v / 61);
        (j + 2) / 5 * 13 + (i + 2) / 5
    };
    let homes = (0..fine.positions.len() as u32).map(home).collect();
    (coarse, Reference { mesh: fine, homes })
}

fn distance_sq(mesh: &IndexedMesh<f32>, face: usize, point: [f32; 3]) -> f32 {
    let corners = mesh.faces[face].map(|v| step(point, mesh.positions[v as usize]));
    let [a, b, c] = nearest_to_origin(corners);
    (corners[0] * a + corners[1] * b + corners[2] * c).length_squared()
}

fn brute(mesh: &IndexedMesh<f32>, point: [f32; 3]) -> f32 {
    (0..mesh.faces.len()).map(|f| distance_sq(mesh, f, point)).fold(f32::INFINITY, f32::min)
}

/// Mean squared distance, both ways, over the faces' centroids and the vertices.
fn deviation(a: &IndexedMesh<f32>, b: &IndexedMesh<f32>) -> f64 {
    let one_way = |from: &IndexedMesh<f32>, to: &IndexedMesh<f32>| {
        let centroids = (0..from.faces.len()).map(|f| Point::on(from, f, [1.0 / 3.0; 3]).at);
        let points: Vec<_> = centroids.chain(from.positions.iter().copied()).collect();
        points.par_iter().map(|p| f64::from(brute(to, *p))).sum::<f64>() / points.len() as f64
    };
    0.5 * (one_way(a, b) + one_way(b, a))
}

fn refitted(coarse: &IndexedMesh<f32>, reference: &Reference<f32>, rounds: u32) -> IndexedMesh<f32> {
    let mut mesh = coarse.clone();
    let aim = Aim { reference: Some(reference), samples: None };
    refit(&mut mesh, &aim, rounds, free(&mut Wedges::default()), &Progress::default()).unwrap();
    mesh
}

#[test]
fn the_nearest_point_of_a_triangle_is_found_in_every_region() {
    let corners = [Vec3::new(1.0, 0.2, 0.3), Vec3::new(-0.5, 1.1, 0.4), Vec3::new(-0.4, -0.9, 0.8)];
    for k in 0..4000u32 {
        let h = |s: u32| (k.wrapping_mul(s) >> 8) as f32 / (1u32 << 24) as f32 * 6.0 - 3.0;
        let p = Vec3::new(h(2_654_435_761), h(2_246_822_519), h(3_266_489_917));
        let t = corners.map(|c| c - p);
        let at = |l: [f32; 3]| (t[0] * l[0] + t[1] * l[1] + t[2] * l[2]).length();
        let found = nearest_to_origin(t);
        assert!(found.iter().all(|&l| l >= -1e-6) && (found.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        let grid = (0..=40).flat_map(|i| (0..=40 - i).map(move |j| [i, j, 40 - i - j].map(|n| n as f32 / 40.0)));
        let least = grid.map(at).fold(f32::INFINITY, f32::min);
        assert!(at(found) <= least + 1e-5, "{p}: {} above {least}", at(found));
    }
}

#[test]
fn a_walk_finds_what_a_search_finds() {
    let (coarse, reference) = pair(hills);
    let mut stars = Stars::default();
    stars.rebuild(&coarse.faces, coarse.positions.len());
    let mut samples = Samples::default();
    samples.assign(Ground { mesh: &coarse, stars: &stars }, &reference);
    let mut seen = 0;
    for f in 0..coarse.faces.len() {
        for &k in samples.of(f) {
            let point = reference.point(k);
            assert!(distance_sq(&coarse, f, point.at) <= brute(&coarse, point.at) + 1e-9, "sample {k}");
            seen += 1;
        }
    }
    assert_eq!(seen, 3 * reference.mesh.faces.len());
}

#[test]
fn each_round_brings_the_result_closer() {
    let (coarse, reference) = pair(hills);
    let after = |rounds| deviation(&refitted(&coarse, &reference, rounds), &reference.mesh);
    let (none, one, five) = (after(0), after(1), after(5));
    assert!(one < 0.5 * none && five < 0.85 * one, "{none:e}, {one:e}, {five:e}");
}

#[test]
fn borders_stay_and_no_face_turns_over() {
    let (coarse, reference) = pair(hills);
    let mesh = refitted(&coarse, &reference, 6);
    assert_eq!(mesh.faces.len(), coarse.faces.len());
    for (was, is) in coarse.positions.iter().zip(&mesh.positions) {
        let on_border = was[0] == 0.0 || was[0] == 1.0 || was[1] == 0.0 || was[1] == 1.0;
        assert!(!on_border || was == is);
    }
    for f in 0..mesh.faces.len() {
        assert!(Point::on(&mesh, f, [1.0, 0.0, 0.0]).normal.z > 0.0);
    }
    // A manifold patch with the same border: every edge inside has two faces.
    let mut edges: Vec<(u32, u32)> = mesh.faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
    edges.sort_unstable();
    assert!(edges.windows(2).all(|w| w[0] != w[1]), "an edge has two faces on one side");
    let alone = edges.iter().filter(|(a, b)| edges.binary_search(&(*b, *a)).is_err()).count();
    assert_eq!(alone, 4 * 12);
}

#[test]
fn a_ridge_that_the_edges_cross_is_found_by_flips() {
    // The coarse diagonals run across the valley: no vertex can lie better, only edges can.
    let valley = |x: f64, y: f64| 0.3 * (x + y - 1.0).abs();
    let (coarse, reference) = pair(valley);
    let none = deviation(&coarse, &reference.mesh);
    let flipped = refitted(&coarse, &reference, 4);
    assert!(deviation(&flipped, &reference.mesh) < 0.2 * none);
    assert!(flipped.faces != coarse.faces);
}

#[test]
fn a_plane_and_a_mesh_that_is_hardly_reduced_stay_as_they_are() {
    let (coarse, reference) = pair(|_, _| 0.25);
    let mesh = refitted(&coarse, &reference, 3);
    assert_eq!(mesh.faces, coarse.faces);
    for (was, is) in coarse.positions.iter().zip(&mesh.positions) {
        assert!(step(*was, *is).length() < 1e-5);
    }
    let (_, reference) = pair(hills);
    let mut same = reference.mesh.clone();
    let aim = Aim { reference: Some(&reference), samples: None };
    refit(&mut same, &aim, 2, free(&mut Wedges::default()), &Progress::default()).unwrap();
    assert_eq!(same, reference.mesh);
}

#[test]
fn vanished_homes_and_faces_without_area_are_borne() {
    let (mut coarse, mut reference) = pair(hills);
    reference.homes.iter_mut().step_by(3).for_each(|home| *home = NONE);
    reference.mesh.faces.push([5, 6, 5 + 61]);
    reference.mesh.positions[5] = reference.mesh.positions[6];
    coarse.positions[30] = coarse.positions[31];
    let mesh = refitted(&coarse, &reference, 3);
    assert!(mesh.positions.iter().flatten().all(|x| x.is_finite()));
}

#[test]
fn threads_change_nothing() {
    let (coarse, reference) = pair(hills);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| refitted(&coarse, &reference, 3))
    };
    let one = run(1);
    for threads in [2, 3, 8] {
        assert!(run(threads) == one, "{threads} threads");
    }
}
