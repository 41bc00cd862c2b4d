//! Whole collapses of literal and generated meshes.

use super::*;
use crate::mesh::{Extent, Frame, widen};
use glam::DVec3;
use std::collections::HashMap;

fn options(target: usize) -> Options<'static> {
    Options::to(target)
}

fn reduce(mesh: &IndexedMesh<f32>, target: usize) -> Collapsed<f32> {
    collapse(mesh.clone(), None, &options(target), &Progress::default()).unwrap()
}

/// A sphere of `6·side²·2` faces: a cube's faces, pushed out, with `noise` times a hash added to the radius.
fn sphere(side: u32, noise: f32) -> IndexedMesh<f32> {
    let mut mesh = IndexedMesh::default();
    let mut numbers: HashMap<[i32; 3], u32> = HashMap::new();
    let n = side as i32;
    for axis in 0..3 {
        for sign in [-1, 1] {
            let mut at = |i: i32, j: i32| {
                let mut key = [0; 3];
                (key[axis], key[(axis + 1) % 3], key[(axis + 2) % 3]) = (sign * n, 2 * i - n, 2 * j - n);
                *numbers.entry(key).or_insert_with(|| {
                    let p = DVec3::from(key.map(f64::from)).normalize();
                    let h = (key[0] * 73 + key[1] * 179 + key[2] * 283).rem_euclid(101) as f64 / 101.0 - 0.5;
                    mesh.positions.push(narrow(p * (0.4 + f64::from(noise) * h)));
                    mesh.positions.len() as u32 - 1
                })
            };
            let mut quads = Vec::new();
            for i in 0..n {
                for j in 0..n {
                    let q = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    quads.push(if sign > 0 { q } else { [q[0], q[3], q[2], q[1]] });
                }
            }
            for [a, b, c, d] in quads {
                mesh.faces.extend([[a, b, c], [a, c, d]]);
            }
        }
    }
    mesh
}

fn narrow(p: DVec3) -> [f32; 3] {
    crate::mesh::narrow(p)
}

/// A grid of `2·side²` faces over the unit square.
fn grid(side: u32, height: impl Fn(f64, f64) -> f64) -> IndexedMesh<f32> {
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

/// Signed counts of every undirected edge: (faces along it, faces against it).
fn edges(mesh: &IndexedMesh<f32>) -> HashMap<(u32, u32), (u32, u32)> {
    let mut edges = HashMap::new();
    for f in &mesh.faces {
        for i in 0..3 {
            let (a, b) = (f[i], f[(i + 1) % 3]);
            assert_ne!(a, b, "a face repeats a vertex");
            let counts: &mut (u32, u32) = edges.entry((a.min(b), a.max(b))).or_default();
            if a < b { counts.0 += 1 } else { counts.1 += 1 }
        }
    }
    edges
}

fn volume(mesh: &IndexedMesh<f32>) -> f64 {
    mesh.faces.iter().map(|f| mesh.at(f[0]).dot(mesh.at(f[1]).cross(mesh.at(f[2]))) / 6.0).sum()
}

#[test]
fn a_sphere_stays_closed_round_and_outside_out() {
    let scan = sphere(40, 0.002);
    for target in [8000, 1501, 300, 60] {
        let result = reduce(&scan, target);
        assert_eq!(result.mesh.faces.len(), target & !1, "a closed manifold has an even count");
        assert!(edges(&result.mesh).values().all(|&e| e == (1, 1)));
        assert!(!result.folded);
        let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.4f64.powi(3);
        let lost = 1.0 - volume(&result.mesh) / exact;
        assert!(lost.abs() < 4.0 / target as f64 + 0.01, "{lost} of the volume lost at {target}");
        for p in &result.mesh.positions {
            assert!((widen(*p).length() - 0.4).abs() < 0.05);
        }
    }
}

#[test]
fn flat_regions_collapse_in_few_rounds_and_keep_their_outline() {
    let scan = grid(120, |_, _| 0.25);
    let result = reduce(&scan, 2000);
    assert!(result.mesh.faces.len() == 2000 || result.mesh.faces.len() == 1999);
    assert!(result.rounds <= 30, "{} rounds", result.rounds);
    let area: f64 = result
        .mesh
        .faces
        .iter()
        .map(|f| {
            (result.mesh.at(f[1]) - result.mesh.at(f[0])).cross(result.mesh.at(f[2]) - result.mesh.at(f[0])).z / 2.0
        })
        .sum();
    assert!((area - 1.0).abs() < 1e-3, "area {area}");
    let mut extent = Extent::default();
    result.mesh.positions.iter().for_each(|p| extent.include(widen(*p)));
    assert!((extent.size() - DVec3::new(1.0, 1.0, 0.0)).length() < 1e-3, "{extent:?}");
}

#[test]
fn an_open_border_stays_a_single_loop_in_place() {
    let scan = grid(60, |x, y| 0.1 * (7.0 * x).sin() * (5.0 * y).cos());
    let result = reduce(&scan, 500);
    assert_eq!(result.irregularities.border_edges, 240);
    for (&(a, b), &counts) in &edges(&result.mesh) {
        if counts.0 + counts.1 == 1 {
            for v in [a, b] {
                let p = result.mesh.at(v);
                let off = [p.x, 1.0 - p.x, p.y, 1.0 - p.y].into_iter().fold(f64::INFINITY, |m, d| m.min(d.abs()));
                assert!(off < 5e-3, "a border vertex {off} away from the border");
            }
        }
    }
}

#[test]
fn everything_can_go() {
    for scan in [sphere(12, 0.01), grid(20, |x, _| x * x)] {
        for target in [3, 2, 1, 0] {
            let result = reduce(&scan, target);
            assert!(result.mesh.faces.len() <= target && result.mesh.faces.len() + 1 >= target);
        }
        assert!(reduce(&scan, 0).mesh.positions.is_empty());
    }
}

/// Three fins on one edge, doubled and flipped faces, a bow-tie vertex, faces without area.
fn messy() -> IndexedMesh<f32> {
    let mut mesh = sphere(16, 0.01);
    let n = mesh.positions.len() as u32;
    mesh.positions.extend([[0.5, 0.5, 0.5], [0.5, 0.1, 0.4], [0.1, 0.5, 0.45], [0.3, 0.3, 0.6]]);
    let f = mesh.faces[100];
    mesh.faces.extend([[f[0], f[1], n], [f[1], f[0], n + 1], [f[0], f[1], n + 2], [f[2], n, n + 3]]);
    mesh.faces.extend([mesh.faces[200], mesh.faces[300], [f[0], f[2], f[1]]]);
    let p = mesh.positions[f[0] as usize];
    mesh.positions.push(p);
    mesh.faces.push([f[0], n + 4, f[1]]);
    mesh
}

#[test]
fn what_is_not_manifold_is_taken_as_it_comes() {
    let scan = messy();
    for target in [1000, 501, 100, 10, 0] {
        let result = reduce(&scan, target);
        let count = result.mesh.faces.len();
        assert!(count <= target && count + 2 >= target, "{count} for {target}");
        assert!(result.mesh.positions.iter().flatten().all(|x| x.is_finite()));
        assert!(result.irregularities.nonmanifold_edges > 0);
    }
}

#[test]
fn irregularities_are_counted() {
    let square = grid(1, |_, _| 0.0);
    assert_eq!(
        reduce(&square, 2).irregularities,
        Irregularities { border_edges: 4, nonmanifold_edges: 0, nonmanifold_vertices: 0 }
    );
    let tetrahedron = |base: u32| {
        [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]].map(|f| f.map(|v: u32| if v == 0 { 0 } else { v + base }))
    };
    let mut bow = IndexedMesh::<f32> { positions: vec![[0.0; 3]; 7], faces: Vec::new() };
    for (v, p) in bow.positions.iter_mut().enumerate().skip(1) {
        *p = [v as f32, (v * v % 5) as f32, (v * 3 % 7) as f32];
    }
    bow.faces.extend(tetrahedron(0).into_iter().chain(tetrahedron(3)));
    assert_eq!(
        reduce(&bow, 8).irregularities,
        Irregularities { border_edges: 0, nonmanifold_edges: 0, nonmanifold_vertices: 1 }
    );
}

#[test]
fn threads_change_nothing() {
    let scans = [sphere(40, 0.004), grid(90, |x, y| (x * y).sqrt()), messy()];
    for scan in &scans {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| reduce(scan, scan.faces.len() / 12))
        };
        let one = run(1);
        for threads in [2, 3, 8] {
            assert!(run(threads) == one, "{threads} threads");
        }
    }
}

#[test]
fn an_error_bound_ends_the_collapse() {
    let scan = sphere(40, 0.0);
    let bounded = |max_error: f64| {
        let options = Options { max_error, ..options(0) };
        collapse(scan.clone(), None, &options, &Progress::default()).unwrap()
    };
    let (fine, coarse) = (bounded(1e-4), bounded(1e-2));
    assert!(fine.error_estimate <= 1e-4 && coarse.error_estimate <= 1e-2);
    assert!(fine.mesh.faces.len() > 2 * coarse.mesh.faces.len() && !coarse.mesh.faces.is_empty());
    for p in &fine.mesh.positions {
        assert!((widen(*p).length() - 0.4).abs() < 5e-4);
    }
}

#[test]
fn the_frame_makes_scale_irrelevant() {
    let scan = sphere(30, 0.01);
    let scaled = |factor: f32| {
        let mut mesh = scan.clone();
        let mut extent = Extent::default();
        for p in &mut mesh.positions {
            *p = p.map(|x| x * factor);
            extent.include(widen(*p));
        }
        let frame = Frame::of(&extent);
        for p in &mut mesh.positions {
            *p = p.map(|x| frame.to_frame(f64::from(x)) as f32);
        }
        reduce(&mesh, 500).mesh
    };
    assert!(scaled(2f32.powi(-20)) == scaled(1.0) && scaled(2f32.powi(20)) == scaled(1.0));
}

#[test]
fn carried_quadrics_are_used() {
    let scan = sphere(24, 0.0);
    let plain = reduce(&scan, 400);
    let heavy = vec![PackedQuadric { c: 1e-2, w: 1.0, ..Default::default() }; scan.positions.len()];
    let carried =
        collapse(scan, Some(Carried { quadrics: heavy, ..Default::default() }), &options(400), &Progress::default())
            .unwrap();
    assert!(carried.error_estimate >= 0.1 && plain.error_estimate < 0.1);
}

#[test]
fn numbers_that_steer_are_those_of_the_result() {
    // A level that goes on from here is steered by them.
    let mesh = grid(40, |x, y| 0.1 * (5.0 * x).sin() * y);
    let values = mesh.positions.iter().flat_map(|[x, y, _]| [0.01 * x, 0.02 * y]).collect();
    let carried = Carried { shades: Shades { dims: 2, values }, ..Carried::default() };
    let found = collapse(mesh, Some(carried), &options(200), &Progress::default()).unwrap();
    assert_eq!(found.shades.values.len(), 2 * found.mesh.positions.len());
    for (v, [x, y, _]) in (0u32..).zip(found.mesh.positions) {
        let [s, t] = [found.shades.of(v)[0] / 0.01, found.shades.of(v)[1] / 0.02];
        assert!((s - x).abs() < 0.02 && (t - y).abs() < 0.02, "{s} {t} at {x} {y}");
    }
}

#[test]
fn a_speck_far_away_is_kept_and_one_close_by_goes() {
    let mut scan = sphere(40, 0.002);
    let mut speck = |x: f32| {
        let n = scan.positions.len() as u32;
        let corners = [[x, 0.0, 0.0], [x + 0.01, 0.0, 0.0], [x, 0.01, 0.0], [x, 0.0, 0.01]];
        scan.positions.extend(corners);
        scan.faces.extend([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|f| f.map(|v| v + n)));
    };
    speck(0.95);
    speck(0.405);
    for target in [4000, 400] {
        let mesh = reduce(&scan, target).mesh;
        let beyond = |least: f64| mesh.faces.iter().filter(|f| f.iter().all(|&v| mesh.at(v).x > least)).count();
        assert_eq!((mesh.faces.len(), beyond(0.9)), (target, 4), "at {target}");
    }
    assert!(reduce(&scan, 0).mesh.faces.is_empty());
}

/// Policies other than the default: for each, what holds of all must hold.
fn policies() -> Vec<Policies> {
    let usual = Policies::default();
    vec![
        Policies { quadrics: Quadrics::Accumulated, ..usual },
        Policies { placement: Placement::Line, ..usual },
        Policies { placement: Placement::EndpointOrMidpoint, quadrics: Quadrics::Accumulated, ..usual },
        Policies { placement: Placement::Endpoint, ..usual },
        Policies { weighting: Weighting::Angle, ..usual },
        Policies { weighting: Weighting::Uniform, boundary_weight: 2.0, ..usual },
        Policies { features: Some(Features { angle: 40.0, weight: 1.0 }), lock_border: true, ..usual },
        Policies { fold_check: FoldCheck::Planes, compactness: 0.3, valence_penalty: 1.0, ..usual },
        Policies { fold_check: FoldCheck::Both, min_component: Some(Least::Faces(9)), ..usual },
        Policies { topology: Topology::Preserve, ..usual },
        Policies { pair_distance: Some(PairDistance::Auto), ..usual },
        Policies { primitive: Primitive::Face, ..usual },
        Policies {
            primitive: Primitive::Face,
            quadrics: Quadrics::Accumulated,
            placement: Placement::Endpoint,
            ..usual
        },
    ]
}

fn reduce_by(mesh: &IndexedMesh<f32>, target: usize, policies: Policies) -> Collapsed<f32> {
    collapse(mesh.clone(), None, &Options { policies, ..options(target) }, &Progress::default()).unwrap()
}

#[test]
fn every_policy_is_the_same_by_any_threads_and_at_any_scale() {
    let scan = sphere(30, 0.004);
    for policies in policies() {
        let run = |threads: usize, factor: f32| {
            let mut scan = scan.clone();
            scan.positions.iter_mut().flatten().for_each(|x| *x *= factor);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut result = pool.install(|| reduce_by(&scan, 900, policies));
            result.mesh.positions.iter_mut().flatten().for_each(|x| *x /= factor);
            result.mesh
        };
        let one = run(1, 1.0);
        assert_eq!(one.faces.len(), 900, "{policies:?}");
        assert!(one.positions.iter().all(|p| (widen(*p).length() - 0.4).abs() < 0.02), "{policies:?}");
        assert!(edges(&one).values().all(|&e| e == (1, 1)), "{policies:?}");
        for threads in [2, 5] {
            assert!(run(threads, 1.0) == one, "{threads} threads: {policies:?}");
        }
        assert!(run(1, 0.5) == one, "half the size: {policies:?}");
    }
}

#[test]
fn every_policy_takes_what_is_not_manifold() {
    for policies in policies() {
        let result = reduce_by(&messy(), 200, policies);
        if policies.topology == Topology::Preserve {
            continue;
        }
        assert!((198..=200).contains(&result.mesh.faces.len()), "{}: {policies:?}", result.mesh.faces.len());
    }
}

#[test]
fn endpoints_are_vertices_of_the_scan() {
    let scan = sphere(20, 0.01);
    let result = reduce_by(&scan, 300, Policies { placement: Placement::Endpoint, ..Default::default() });
    assert!(result.mesh.positions.iter().all(|p| scan.positions.contains(p)));
}

#[test]
fn a_locked_border_keeps_every_vertex() {
    let scan = grid(40, |x, y| 0.1 * (7.0 * x).sin() * (5.0 * y).cos());
    let border = |p: &[f32; 3]| p[..2].iter().any(|x| *x == 0.0 || *x == 1.0);
    let result = reduce_by(&scan, 400, Policies { lock_border: true, ..Default::default() });
    assert!((399..=400).contains(&result.mesh.faces.len()));
    let of = |mesh: &IndexedMesh<f32>| {
        let mut bits: Vec<_> = mesh.positions.iter().filter(|p| border(p)).map(|p| p.map(f32::to_bits)).collect();
        bits.sort_unstable();
        bits
    };
    assert!(of(&result.mesh) == of(&scan));
    assert_eq!(result.locked.len(), 160);
}

#[test]
fn locked_vertices_stay_where_they_are() {
    let scan = sphere(24, 0.01);
    let points = [DVec3::X, DVec3::new(0.1, -0.9, 0.2)];
    let locked = Options { locked: &points, ..options(60) };
    let result = collapse(scan.clone(), None, &locked, &Progress::default()).unwrap();
    for point in points {
        let distance_sq = |p: &&[f32; 3]| widen(**p).distance_squared(point);
        let nearest = scan.positions.iter().min_by(|a, b| distance_sq(a).total_cmp(&distance_sq(b))).unwrap();
        assert!(result.mesh.positions.contains(nearest));
    }
    assert_eq!((result.mesh.faces.len(), result.locked.len()), (60, 2));
}

/// A ridge like a blade: two slopes that meet at a sharp edge along y.
fn ridge() -> IndexedMesh<f32> {
    grid(40, |x, y| if (x - 0.5).abs() < 0.13 { 0.6 - 4.0 * (x - 0.5).abs() + 0.02 * (30.0 * y).sin() } else { 0.1 })
}

#[test]
fn feature_edges_hold_a_ridge() {
    let scan = ridge();
    let on_crest = |policies: Policies| {
        let mesh = reduce_by(&scan, 300, policies).mesh;
        mesh.positions.iter().filter(|p| (p[0] - 0.5).abs() < 5e-3 && p[2] > 0.5).count()
    };
    let features = Some(Features { angle: 90.0, weight: 10.0 });
    let (plain, held) = (on_crest(Policies::default()), on_crest(Policies { features, ..Default::default() }));
    assert!(held > plain, "{held} vertices on the crest, {plain} without features");
}

#[test]
fn specks_are_dropped_and_counted() {
    let mut scan = sphere(10, 0.0);
    let n = scan.positions.len() as u32;
    scan.positions.extend([[0.9, 0.9, 0.9], [0.91, 0.9, 0.9], [0.9, 0.91, 0.9]]);
    scan.faces.push([n, n + 1, n + 2]);
    let least = Some(Least::Faces(2));
    let result = reduce_by(&scan, 5000, Policies { min_component: least, ..Default::default() });
    assert_eq!(result.dropped, Dropped { pieces: 1, faces: 1 });
    assert_eq!((result.mesh.faces.len(), result.mesh.positions.len()), (1200, n as usize));
}

/// Two rings of `4·side` quads by 8 each around the y axis (genus 1), and a speck of a tetrahedron.
fn rings() -> IndexedMesh<f32> {
    let mut mesh = IndexedMesh::default();
    let (around, across) = (60u32, 8u32);
    for ring in [-0.2f64, 0.2] {
        let first = mesh.positions.len() as u32;
        for i in 0..around {
            for j in 0..across {
                let turn = std::f64::consts::TAU;
                let (a, b) = (turn * f64::from(i) / f64::from(around), turn * f64::from(j) / f64::from(across));
                let r = 0.3 + 0.03 * b.cos();
                mesh.positions.push(narrow(DVec3::new(r * a.cos(), ring + 0.03 * b.sin(), r * a.sin())));
                let at = |i: u32, j: u32| first + (i % around) * across + j % across;
                let [p, q, r, s] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                mesh.faces.extend([[p, q, r], [p, r, s]]);
            }
        }
    }
    let n = mesh.positions.len() as u32;
    mesh.positions.extend([[0.0; 3], [0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]]);
    mesh.faces.extend([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|f| f.map(|v| v + n)));
    mesh
}

/// Vertices − edges + faces.
fn euler(mesh: &IndexedMesh<f32>) -> i64 {
    mesh.positions.len() as i64 - edges(mesh).len() as i64 + mesh.faces.len() as i64
}

#[test]
fn preserved_topology_is_the_scans() {
    let preserve = Policies { topology: Topology::Preserve, ..Default::default() };
    let scan = rings();
    assert_eq!(euler(&scan), 2);
    for target in [600, 100, 0] {
        let mesh = reduce_by(&scan, target, preserve).mesh;
        assert_eq!(euler(&mesh), 2, "at {target}");
        assert!(edges(&mesh).values().all(|&e| e == (1, 1)), "at {target}");
        // A torus needs 14 faces, a tetrahedron 4.
        assert!(mesh.faces.len() >= 32 && mesh.faces.len() <= target.max(60), "{} at {target}", mesh.faces.len());
    }
    let mut holed = grid(30, |x, y| x * y);
    holed.faces.retain(|f| f.iter().all(|v| *v != 300));
    let mesh = reduce_by(&holed, 0, preserve).mesh;
    assert_eq!(euler(&mesh), 0, "one hole in a disc");
    let borders = edges(&mesh).values().filter(|e| e.0 + e.1 == 1).count();
    assert!(mesh.faces.len() >= 6 && borders >= 6, "{} faces, {borders} border edges", mesh.faces.len());
    assert_eq!(reduce_by(&sphere(12, 0.0), 0, preserve).mesh.faces.len(), 4);
}

#[test]
fn penalties_do_what_they_say() {
    let scan = sphere(30, 0.01);
    let worst = |policies: Policies| {
        let mesh = reduce_by(&scan, 500, policies).mesh;
        let slivers = mesh.faces.iter().filter(|f| {
            let [a, b, c] = f.map(|v| mesh.at(v));
            let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
            2.0 * 3f64.sqrt() * (b - a).cross(c - a).length() < 0.5 * squares
        });
        let mut valences = vec![0; mesh.positions.len()];
        mesh.faces.iter().flatten().for_each(|&v| valences[v as usize] += 1);
        (slivers.count(), valences.iter().filter(|n| **n > 8).count())
    };
    let usual = Policies::default();
    let plain = worst(usual);
    let compact = worst(Policies { compactness: 0.5, ..usual });
    let low = worst(Policies { valence_penalty: 1.0, ..usual });
    assert!(plain.0 > 2 * compact.0 && plain.1 > low.1, "{plain:?}, compact {compact:?}, low {low:?}");
}

#[test]
fn a_check_of_planes_lets_no_face_fold() {
    let scan = grid(40, |_, _| 0.25);
    for check in [FoldCheck::Normals, FoldCheck::Planes, FoldCheck::Both] {
        let mesh = reduce_by(&scan, 200, Policies { fold_check: check, ..Default::default() }).mesh;
        let up = |f: &[u32; 3]| (mesh.at(f[1]) - mesh.at(f[0])).cross(mesh.at(f[2]) - mesh.at(f[0])).z >= 0.0;
        assert!(mesh.faces.iter().all(up), "{check:?}");
    }
}

#[test]
fn pieces_that_lie_close_by_join() {
    // Four spheres in a row, nearly touching.
    let one = sphere(10, 0.0);
    let mut scan = IndexedMesh::default();
    for i in 0..4 {
        let n = scan.positions.len() as u32;
        scan.positions.extend(one.positions.iter().map(|p| [0.25 * p[0] + 0.205 * i as f32, 0.25 * p[1], 0.25 * p[2]]));
        scan.faces.extend(one.faces.iter().map(|f| f.map(|v| v + n)));
    }
    let pieces = |pair_distance| {
        let mesh = reduce_by(&scan, 60, Policies { pair_distance, ..Default::default() }).mesh;
        assert!((59..=60).contains(&mesh.faces.len()));
        let mut of: Vec<usize> = (0..mesh.positions.len()).collect();
        for _ in 0..mesh.positions.len() {
            for f in &mesh.faces {
                let least = f.iter().map(|&v| of[v as usize]).min().unwrap();
                f.iter().for_each(|&v| of[v as usize] = least);
            }
        }
        of.iter().enumerate().filter(|(v, root)| v == *root).count()
    };
    assert_eq!(pieces(None), 4);
    assert_eq!((pieces(Some(PairDistance::Within(0.02))), pieces(Some(PairDistance::Auto))), (1, 1));
}

/// Mean squared distance of a mesh's faces, at a few points each, from the cube of half side 0.4.
fn off_cube(mesh: &IndexedMesh<f32>) -> f64 {
    let off_sq = |p: DVec3| {
        let q = p.abs() - 0.4;
        if q.max_element() > 0.0 { q.max(DVec3::ZERO).length_squared() } else { q.max_element().powi(2) }
    };
    let (mut sum, mut areas) = (0.0, 0.0);
    for f in &mesh.faces {
        let [a, b, c] = f.map(|v| mesh.at(v));
        let area = (b - a).cross(c - a).length();
        let points = [(4.0, 1.0, 1.0), (1.0, 4.0, 1.0), (1.0, 1.0, 4.0), (2.0, 2.0, 2.0)];
        let mean = points.map(|(i, j, k)| off_sq((a * i + b * j + c * k) / 6.0)).iter().sum::<f64>() / 4.0;
        sum += mean * area;
        areas += area;
    }
    sum / areas
}

/// Thesis Fig. 6.18: by its own quadrics, the distance from a noisy cube's reductions to the cube without noise first falls.
/// To 600 faces it does so whatever the noise; at 200 chance decides.
#[test]
fn noise_goes_before_shape() {
    let accumulated = Policies { quadrics: Quadrics::Accumulated, ..Default::default() };
    for factor in [7919, 6007, 104_729, 611_953] {
        let mut scan = sphere(32, 0.0);
        for (i, p) in scan.positions.iter_mut().enumerate() {
            let on_cube = widen(*p) * (0.4 / widen(*p).abs().max_element());
            let h = (i * factor % 1009) as f64 / 1009.0 - 0.5;
            *p = narrow(on_cube * (1.0 + 0.02 * h));
        }
        let off = |faces| off_cube(&reduce_by(&scan, faces, accumulated).mesh);
        let (all, some, few) = (off_cube(&scan), off(2000), off(600));
        assert!(some < all && few < 0.7 * all, "{all} of the scan, {some} at 2000 faces, {few} at 600");
    }
}

#[test]
fn a_part_ends_at_its_cost_and_keeps_what_is_locked() {
    let part = |most_cost, proposes| Options { part: Some(Part { most_cost, least: 0, proposes }), ..Options::to(20) };
    let collapsed = |mesh: &IndexedMesh<f32>, locked: Vec<u32>, options: &Options| {
        collapse(mesh.clone(), Some(Carried { locked, ..Carried::default() }), options, &Progress::default()).unwrap()
    };
    // A few faces that cost too much: nothing is done, and it ends.
    let tetrahedron = IndexedMesh {
        positions: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        faces: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]],
    };
    assert_eq!(collapsed(&tetrahedron, Vec::new(), &part(1e-9, false)).mesh, tetrahedron);
    // A part whose one side is locked: that stays, and nothing that is proposed moves it.
    let mesh = sphere(20, 0.0);
    let is_locked = |v: &u32| mesh.positions[*v as usize][0] > 0.1;
    let locked: Vec<u32> = (0..mesh.positions.len() as u32).filter(is_locked).collect();
    let positions: Vec<_> = locked.iter().map(|v| mesh.positions[*v as usize]).collect();
    let fine = collapsed(&mesh, locked.clone(), &part(1e-5, true));
    let coarse = collapsed(&mesh, locked, &part(1e-3, true));
    assert!(coarse.mesh.faces.len() < fine.mesh.faces.len() && fine.mesh.faces.len() < mesh.faces.len());
    for done in [&fine, &coarse] {
        let mut kept: Vec<_> = done.locked.iter().map(|v| done.mesh.positions[*v as usize]).collect();
        let mut expected = positions.clone();
        let order = |a: &[f32; 3], b: &[f32; 3]| a.partial_cmp(b).unwrap();
        kept.sort_by(order);
        expected.sort_by(order);
        assert_eq!(kept, expected);
        assert!(!done.proposals.is_empty());
        let mut ends: Vec<u32> = done.proposals.iter().flat_map(|p| [p.keeps, p.goes]).collect();
        ends.sort_unstable();
        assert!(ends.windows(2).all(|pair| pair[0] != pair[1]), "two have a vertex in common");
        for proposal in &done.proposals {
            let held = [proposal.keeps, proposal.goes].into_iter().find(|v| done.locked.contains(v));
            assert!(held.is_none_or(|v| done.mesh.positions[v as usize] == proposal.spot));
        }
    }
}
