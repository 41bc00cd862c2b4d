//! The stage as a whole, on scans made here.

use super::grid::{Corner, LOCAL_BITS, STEPS, coordinates};
use super::*;
use crate::progress::Progress;
use crate::quadric::Quadric;
use glam::DVec3;
use std::collections::HashMap;
use std::path::PathBuf;

/// A scan in a folder of its own.
struct Made {
    folder: tempfile::TempDir,
    path: PathBuf,
}

fn ply(positions: &[[f32; 3]], faces: &[[u32; 3]]) -> Made {
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\n\
         element vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        positions.len(),
        faces.len()
    )
    .into_bytes();
    bytes.extend_from_slice(bytemuck::cast_slice(positions));
    for face in faces {
        bytes.push(3);
        bytes.extend_from_slice(bytemuck::cast_slice(face));
    }
    made("scan.ply", &bytes)
}

fn stl(positions: &[[f32; 3]], faces: &[[u32; 3]]) -> Made {
    let mut bytes = vec![0u8; 80];
    bytes.extend_from_slice(&(faces.len() as u32).to_le_bytes());
    for face in faces {
        bytes.extend_from_slice(&[0; 12]);
        face.iter().for_each(|v| bytes.extend_from_slice(bytemuck::cast_slice(&positions[*v as usize])));
        bytes.extend_from_slice(&[0; 2]);
    }
    made("scan.stl", &bytes)
}

fn made(name: &str, bytes: &[u8]) -> Made {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    Made { folder, path }
}

const OPTIONS: ClusterOptions = ClusterOptions {
    representative: Representative::Quadric,
    cells: 3000,
    enough_cells: 3000,
    raw_faces: 12_000,
    spill_resident_bytes: 1 << 30,
    samples: 0,
    boundary_weight: 1.0,
    limit: MeshLimit { face_bytes: 1, vertex_bytes: 1, bytes: 1 << 30 },
};

/// Whether two clusterings are the same but for samples.
fn same(a: &Clustered<f32>, b: &Clustered<f32>) -> bool {
    a.mesh == b.mesh && a.quadrics == b.quadrics && a.frame == b.frame && a.stats == b.stats
}

impl Made {
    fn cluster(&self, workers: usize, options: &ClusterOptions) -> Result<Clustered<f32>> {
        self.cluster_in(&Scratch::in_folder(self.folder.path()), workers, options)
    }

    fn cluster_in(&self, scratch: &Scratch, workers: usize, options: &ClusterOptions) -> Result<Clustered<f32>> {
        let progress = Progress::default();
        let scan = Scan::open(&self.path, &progress)?;
        cluster(&scan, &Crew { workers, progress: &progress }, scratch, options)
    }
}

struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.0 >> 33
    }

    fn unit(&mut self) -> f32 {
        self.next() as f32 / (1u64 << 31) as f32
    }

    fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.next() as usize % (i + 1));
        }
    }
}

/// `around × along` vertices on a closed torus, a little noisy.
fn torus(around: u32, along: u32) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let mut random = Random(1);
    let at = |i: u32, j: u32| (j % along) * around + i % around;
    let mut positions = Vec::new();
    let mut faces = Vec::new();
    for j in 0..along {
        for i in 0..around {
            let (s, t) = (i as f32 / around as f32 * 6.283_185_5, j as f32 / along as f32 * 6.283_185_5);
            let r = 0.3 + 0.001 * random.unit();
            positions.push([(1.0 + r * s.cos()) * t.cos(), (1.0 + r * s.cos()) * t.sin(), r * s.sin()]);
            faces.push([at(i, j), at(i, j + 1), at(i + 1, j)]);
            faces.push([at(i + 1, j), at(i, j + 1), at(i + 1, j + 1)]);
        }
    }
    (positions, faces)
}

fn odd_edges(faces: &[[u32; 3]]) -> usize {
    let mut counts: HashMap<(u32, u32), u32> = HashMap::new();
    for [a, b, c] in faces {
        for (u, v) in [(a, b), (b, c), (c, a)] {
            *counts.entry((*u.min(v), *u.max(v))).or_default() += 1;
        }
    }
    counts.values().filter(|n| **n % 2 == 1).count()
}

/// Every face's plane in every cell, in doubles, about the cell's centre and in cells.
fn naive(positions: &[[f32; 3]], faces: &[[u32; 3]], grid: &Grid) -> HashMap<u64, (Quadric, DVec3)> {
    let mut cells: HashMap<u64, (Quadric, DVec3)> = HashMap::new();
    for face in faces {
        let corners = face.map(|v| positions[v as usize].map(f64::from)).map(|p| grid.steps(p).unwrap());
        let p = corners.map(|s| DVec3::from(s.map(|x| x as f64)) / STEPS);
        let cross = (p[1] - p[0]).cross(p[2] - p[0]);
        let n = cross.normalize_or_zero();
        let keys = corners.map(grid::cell_key);
        for i in 0..3 {
            if keys[..i].contains(&keys[i]) {
                continue;
            }
            let centre = DVec3::from(coordinates(keys[i]).map(|x| x as f64)) + 0.5;
            let here: Vec<DVec3> = (0..3).filter(|j| keys[*j] == keys[i]).map(|j| p[j] - centre).collect();
            let mean = here.iter().sum::<DVec3>() / here.len() as f64;
            let w = 0.5 * cross.length();
            let (quadric, moment) = cells.entry(keys[i]).or_default();
            *quadric += Quadric::plane(n, -n.dot(mean), w);
            *moment += w * mean;
        }
    }
    cells
}

#[test]
fn integer_sums_are_what_a_naive_loop_sums() {
    let (positions, faces) = torus(120, 300);
    let made = ply(&positions, &faces);
    let progress = Progress::default();
    let scan = Scan::open(&made.path, &progress).unwrap();
    let scratch = Scratch::in_folder(made.folder.path());
    let crew = Crew { workers: 2, progress: &progress };
    let sample = scan.sample(&crew, SAMPLE).unwrap();
    let (place, mut sizing) = survey::survey::<f32>(&scan, &crew, &sample, (OPTIONS.cells, OPTIONS.cells)).unwrap();
    let stats = ClusterStats::default();
    let mut run = Run {
        scan: &scan,
        crew: &crew,
        scratch: &scratch,
        options: &OPTIONS,
        place,
        order: Order::Sensible,
        buckets: None,
        coarser_weights: 1.0,
        stats,
    };
    let learnt = std::iter::repeat_with(|| run.attempt(&mut sizing).unwrap()).take(4).flatten().next().unwrap();
    let expected = naive(&positions, &faces, &learnt.grid);
    assert_eq!(expected.len(), learnt.table.len());
    for cell in 0..learnt.table.len() as u32 {
        let [xx, xy, xz, bx, yy, yz, by, zz, bz, c, w, x, y, z] =
            learnt.totals.of(cell).map(|x| x as f64 * learnt.quantum);
        let (quadric, moment) = &expected[&learnt.table.key(cell)];
        let (a, m) = (quadric.a, moment);
        let pairs = [
            (xx, a[0]),
            (xy, a[1]),
            (xz, a[2]),
            (yy, a[3]),
            (yz, a[4]),
            (zz, a[5]),
            (bx, quadric.b.x),
            (by, quadric.b.y),
            (bz, quadric.b.z),
            (c, quadric.c),
            (w, quadric.w),
            (x, m.x),
            (y, m.y),
            (z, m.z),
        ];
        for (lane, (sum, expected)) in pairs.into_iter().enumerate() {
            assert!((sum - expected).abs() < 2e-5 * quadric.w, "cell {cell}, lane {lane}: {sum} against {expected}");
        }
    }
}

#[test]
fn a_closed_scan_stays_closed_and_close() {
    let (positions, faces) = torus(150, 400);
    for made in [ply(&positions, &faces), stl(&positions, &faces)] {
        let clustered = made.cluster(2, &OPTIONS).unwrap();
        let (mesh, stats) = (&clustered.mesh, &clustered.stats);
        assert_eq!(odd_edges(&mesh.faces), 0);
        assert_eq!((stats.border_cells, stats.overflows), (0, 0));
        assert!(stats.occupied_cells.abs_diff(OPTIONS.cells as u64) < 200 && stats.attempts == 1, "{stats:?}");
        assert!(mesh.faces.len() + 50 > 2 * mesh.positions.len(), "{} faces", mesh.faces.len());
        assert!(mesh.faces.iter().all(|[a, b, c]| a < b && a < c) && mesh.faces.is_sorted_by_key(|f| f[0]));
        for (position, quadric) in mesh.positions.iter().zip(&clustered.quadrics) {
            let [x, y, z] = position.map(|x| clustered.frame.to_file(f64::from(x)));
            let off = (x.hypot(y) - 1.0).hypot(z) - 0.3;
            assert!(off.abs() < 0.006, "{off} off the torus");
            assert!(quadric.w > 0.0 && quadric.unpack().value(DVec3::ZERO) >= 0.0);
        }
    }
}

#[test]
fn threads_order_and_memory_do_not_change_a_bit() {
    let (positions, mut faces) = torus(150, 400);
    let tight = ClusterOptions { spill_resident_bytes: 100_000, ..OPTIONS };
    let ordered = ply(&positions, &faces);
    let resident = ordered.cluster(1, &OPTIONS).unwrap();
    assert_eq!(resident.stats.scratch_bytes, 0);
    for workers in [2, 3, 8] {
        assert!(same(&ordered.cluster(workers, &OPTIONS).unwrap(), &resident), "{workers} workers");
    }
    let paged = ordered.cluster(2, &tight).unwrap();
    assert!((6 * 60_000..6 * 60_000 + 30_000).contains(&paged.stats.scratch_bytes), "{}", paged.stats.scratch_bytes);
    assert!((paged.mesh, paged.quadrics) == (resident.mesh, resident.quadrics), "paged");

    // The sample of shuffled faces is another, and so are the cells: it is compared with itself. It has a hole, so that
    // faces are gone through once more.
    faces.drain(50_000..50_400);
    Random(2).shuffle(&mut faces);
    faces.insert(1000, [7, 8, 7]);
    let mut names: Vec<u32> = (0..positions.len() as u32).collect();
    Random(3).shuffle(&mut names);
    let mut moved = positions.clone();
    names.iter().zip(&positions).for_each(|(name, p)| moved[*name as usize] = *p);
    let renamed: Vec<[u32; 3]> = faces.iter().map(|f| f.map(|v| names[v as usize])).collect();
    let shuffled = ply(&positions, &faces);
    let folder = tempfile::tempdir().unwrap();
    let small = Scratch::in_folder(folder.path()).with_quota(1_000_000);
    let resident = shuffled.cluster_in(&small, 1, &OPTIONS).unwrap();
    assert_eq!((resident.stats.scratch_bytes, resident.stats.repeated_corner_faces), (0, 1));
    assert!(resident.stats.border_cells > 0);
    let nowhere = Scratch::in_folder(&folder.path().join("gone"));
    assert!(same(&shuffled.cluster_in(&nowhere, 2, &OPTIONS).unwrap(), &resident), "no room for buckets");
    let renamed = ply(&moved, &renamed);
    let (near_bytes, sorted_bytes) = (6 * 119_600, 12 * 119_600);
    for (made, workers, options, scratch_bytes, how) in [
        (&shuffled, 1, &OPTIONS, near_bytes..near_bytes + 1, "in buckets"),
        (&shuffled, 3, &OPTIONS, near_bytes..near_bytes + 1, "in buckets"),
        (&renamed, 2, &OPTIONS, 0..1, "resident"),
        (&shuffled, 1, &tight, sorted_bytes + 1..u64::MAX, "joined"),
        (&shuffled, 3, &tight, sorted_bytes + 1..u64::MAX, "joined"),
        (&renamed, 2, &tight, sorted_bytes + 1..u64::MAX, "joined"),
    ] {
        let again = made.cluster(workers, options).unwrap();
        assert!(scratch_bytes.contains(&again.stats.scratch_bytes), "{how}: {:?}", again.stats);
        assert_eq!(again.stats.repeated_corner_faces, 1, "{how}");
        assert!((again.mesh, again.quadrics) == (resident.mesh.clone(), resident.quadrics.clone()), "{how}");
    }
}

#[test]
fn samples_lie_on_the_scan_evenly_whatever_the_order() {
    let (positions, mut faces) = torus(150, 400);
    let options = ClusterOptions { samples: 20_000, ..OPTIONS };
    let sampled = |made: &Made, workers: usize, most: usize| {
        let clustered = made.cluster(workers, &options).unwrap();
        let file = clustered.samples.as_ref().unwrap();
        (file.load(most, &clustered.homes).unwrap(), clustered)
    };
    let area = 4.0 * std::f64::consts::PI.powi(2) * 0.3;
    for made in [ply(&positions, &faces), stl(&positions, &faces)] {
        let (one, clustered) = sampled(&made, 1, 1 << 20);
        let unit = clustered.frame.to_file(1.0);
        let count = one.samples.len() as f64;
        assert!((count - 20_000.0).abs() < 1000.0, "{count}");
        assert!((one.area * unit * unit * count - area).abs() < 0.03 * area, "{} each", one.area);
        let mut outside = 0;
        for sample in &one.samples {
            let p = DVec3::from(one.lattice.position::<f64>(sample)) * unit;
            let ring = DVec3::new(p.x, p.y, 0.0).normalize();
            let off = p - ring;
            assert!((off.length() - 0.3).abs() < 1e-3, "{p}");
            assert!(sample.direction().as_dvec3().normalize().dot(off / off.length()) > 0.99, "{p}");
            outside += usize::from(p.x.hypot(p.y) > 1.0);
            let vertex = DVec3::from(clustered.mesh.positions[sample.near as usize].map(f64::from)) * unit;
            assert!((vertex - p).length() < 4.0 * clustered.stats.cell_size, "{p} is near {vertex}");
        }
        // The outer half of a torus has half its area and two thirds of the circle's radius over pi more.
        let share = outside as f64 / count;
        assert!((share - (0.5 + 0.3 / std::f64::consts::PI)).abs() < 0.015, "{share}");
        let (three, _) = sampled(&made, 3, 1 << 20);
        assert!(three.samples == one.samples && three.area == one.area);
        let (few, _) = sampled(&made, 2, 6000);
        assert!(few.samples.len() <= 6000 && few.area == 4.0 * one.area, "{}", few.samples.len());
    }
    Random(2).shuffle(&mut faces);
    let shuffled = ply(&positions, &faces);
    let (resident, _) = sampled(&shuffled, 2, 1 << 20);
    Random(9).shuffle(&mut faces);
    let tight = ClusterOptions { spill_resident_bytes: 100_000, ..options };
    let joined = shuffled.cluster(3, &tight).unwrap();
    let again = joined.samples.unwrap().load(1 << 20, &joined.homes).unwrap();
    assert!(again.samples == resident.samples);
}

#[test]
fn what_does_not_fit_begins_again_with_larger_cells() {
    // Specks all over a volume: next to no area, but a cell each.
    let mut random = Random(5);
    let (mut positions, mut faces) = (Vec::new(), Vec::new());
    for i in 0..20_000 {
        let p = [random.unit(), random.unit(), random.unit()];
        positions.extend([p, [p[0] + 1e-4, p[1], p[2]], [p[0], p[1] + 1e-4, p[2]]]);
        faces.push([3 * i, 3 * i + 1, 3 * i + 2]);
    }
    for made in [ply(&positions, &faces), stl(&positions, &faces)] {
        let one = made.cluster(1, &OPTIONS).unwrap();
        assert!((2000..=3200).contains(&one.stats.occupied_cells), "{:?}", one.stats);
        assert!(same(&made.cluster(3, &OPTIONS).unwrap(), &one));
    }
    let (positions, faces) = torus(150, 400);
    let made = ply(&positions, &faces);
    let few = ClusterOptions { raw_faces: 1500, ..OPTIONS };
    let small = ClusterOptions { limit: MeshLimit { face_bytes: 2, vertex_bytes: 4, bytes: 6000 }, ..OPTIONS };
    for options in [few, small] {
        let one = made.cluster(1, &options).unwrap();
        assert!(one.stats.overflows >= 1 && one.mesh.faces.len() <= 1500, "{:?}", one.stats);
        assert!(one.mesh.faces.len() > 1000, "{:?}", one.stats);
        assert!(same(&made.cluster(3, &options).unwrap(), &one));
    }
}

#[test]
fn an_open_border_stays_where_it_is() {
    const SIDE: u32 = 200;
    let mut random = Random(7);
    let unit = |i: u32| i as f32 / SIDE as f32;
    let mut height = || 0.002 * random.unit();
    let positions: Vec<[f32; 3]> =
        (0..(SIDE + 1).pow(2)).map(|v| [unit(v % (SIDE + 1)), unit(v / (SIDE + 1)), height()]).collect();
    let quad = |v: u32| [[v, v + 1, v + SIDE + 2], [v, v + SIDE + 2, v + SIDE + 1]];
    let faces: Vec<[u32; 3]> = (0..SIDE * SIDE).flat_map(|q| quad(q / SIDE * (SIDE + 1) + q % SIDE)).collect();
    let made = ply(&positions, &faces);
    let options = ClusterOptions { cells: 600, ..OPTIONS };
    let clustered = made.cluster(2, &options).unwrap();
    let cell = clustered.stats.cell_size;
    let border = border::open_cells(&clustered.mesh.faces, clustered.mesh.positions.len());
    let at = |p: &[f32; 3]| p.map(|x| clustered.frame.to_file(f64::from(x)));
    let mut held = 0;
    for (p, _) in clustered.mesh.positions.iter().zip(&border).filter(|(_, open)| **open) {
        let [x, y, _] = at(p);
        let off = [x, 1.0 - x, y, 1.0 - y].map(f64::abs);
        // A cell with a corner of the square holds the chord that cuts it off.
        if off.iter().filter(|d| **d < 2.0 * cell).count() == 1 {
            assert!(off.iter().any(|d| *d < 0.01 * cell), "({x}, {y}) is off the border; a cell is {cell}");
            held += 1;
        }
    }
    assert!(held > 40 && clustered.stats.border_cells > held, "{held} held: {:?}", clustered.stats);
    // Without room for all border sums at once the faces pass by more often, to the same end.
    let tight = made.cluster(2, &ClusterOptions { raw_faces: clustered.stats.surviving_faces as usize, ..options });
    assert!(same(&tight.unwrap(), &clustered));
    let loose = made.cluster(2, &ClusterOptions { boundary_weight: 0.0, ..options }).unwrap();
    let least = |c: &Clustered<f32>| c.mesh.positions.iter().map(|p| at(p)[0]).fold(1.0, f64::min);
    assert!(least(&clustered) < 0.01 * cell && least(&loose) > 0.1 * cell);
}

#[test]
fn a_vertex_that_is_nowhere_matters_only_to_faces_that_use_it() {
    let (mut positions, mut faces) = torus(60, 100);
    positions.push([f32::NAN, 0.0, 0.0]);
    positions.push([0.0, f32::INFINITY, 0.0]);
    let clean = ply(&positions[..6000], &faces).cluster(2, &OPTIONS).unwrap();
    let unused = ply(&positions, &faces).cluster(2, &OPTIONS).unwrap();
    let (without, with) = (clean.mesh.faces.len(), unused.mesh.faces.len());
    assert!(without.abs_diff(with) < without / 20, "{without} and {with}");
    faces.insert(5000, [17, 6001, 6000]);
    for resident in [1 << 30, 1000] {
        let options = ClusterOptions { spill_resident_bytes: resident, ..OPTIONS };
        let error = ply(&positions, &faces).cluster(3, &options).unwrap_err().to_string();
        assert!(error.contains("vertex 6000") && error.contains("not finite"), "{error}");
    }
}

#[test]
fn where_cells_may_be_fewer_they_are_counted_on_the_way() {
    let (mut positions, faces) = torus(150, 400);
    let loose = ClusterOptions { enough_cells: 2400, samples: 5000, ..OPTIONS };
    for (noise, attempts) in [(0.0, 1), (0.015, 2)] {
        // Noise is more area than cells see.
        for (i, p) in positions.iter_mut().enumerate() {
            p[2] += noise * ((i * 7919 % 101) as f32 / 50.0 - 1.0);
        }
        // What a soup's cells reach is not known when its samples are taken: as far as the bulk's margin does, then.
        for (made, reach) in [(ply(&positions, &faces), 0.9..1.0), (stl(&positions, &faces), 0.5..1.0)] {
            let clustered = made.cluster(1, &loose).unwrap();
            let stats = &clustered.stats;
            assert!((2400..=3100).contains(&stats.occupied_cells) && stats.attempts == attempts, "{stats:?}");
            assert_eq!((stats.overflows, odd_edges(&clustered.mesh.faces)), (0, 0));
            assert!(same(&made.cluster(3, &loose).unwrap(), &clustered));
            assert_eq!(made.cluster(2, &ClusterOptions { samples: 5000, ..OPTIONS }).unwrap().stats.attempts, 1);

            // The torus is 2.6 wide, and samples lie in 2²¹ steps along it, and hardly more.
            let steps = clustered.samples.unwrap().lattice.steps_of(clustered.frame.to_frame(2.6)) / f64::from(1 << 21);
            assert!(reach.contains(&steps), "{steps}");
        }
    }
}

#[test]
fn what_is_astray_does_not_make_the_grid_useless() {
    let (mut positions, mut faces) = torus(150, 400);
    let clean = ply(&positions, &faces).cluster(2, &OPTIONS).unwrap();
    positions.push([1e9, 0.0, 0.0]);
    positions.push([3e38, -3e38, 3e38]);
    let near = |stats: &ClusterStats| {
        assert!((0.95..1.05).contains(&(stats.cell_size / clean.stats.cell_size)), "{stats:?}");
        assert!(stats.occupied_cells.abs_diff(clean.stats.occupied_cells) < 200, "{stats:?}");
    };
    let unused = ply(&positions, &faces).cluster(2, &OPTIONS).unwrap();
    near(&unused.stats);
    assert_eq!(unused.stats.unreferenced_vertices, Some(2));
    // Three faces that lead far away, two from the surface and one all by itself.
    positions.extend([[-4e6, 7e6, 0.5], [0.0, 9e6, 1e7], [20.0, 2e7, 40.0]]);
    let at = positions.len() as u32;
    faces.extend([[7, 8, at - 1], [9000, 9001, at - 2], [at - 3, at - 2, at - 1]]);
    for made in [ply(&positions, &faces), stl(&positions, &faces)] {
        let strayed = made.cluster(1, &OPTIONS).unwrap();
        near(&strayed.stats);
        assert!(same(&made.cluster(3, &OPTIONS).unwrap(), &strayed));
        let mesh = &strayed.mesh;
        let (mut far, mut off) = (0, 0);
        for position in &mesh.positions {
            let [x, y, z] = position.map(|x| strayed.frame.to_file(f64::from(x)));
            far += usize::from(x.abs() + y.abs() + z.abs() > 1e6);
            off += usize::from(((x.hypot(y) - 1.0).hypot(z) - 0.3).abs() > 0.006);
        }
        assert!((1..=3).contains(&far), "{far} far vertices");
        assert!(off <= far + 4, "{off} off the torus");
    }
    // So far away that no cell is there: named where a face uses it.
    faces.push([0, 1, 60_001]);
    let error = ply(&positions, &faces).cluster(2, &OPTIONS).unwrap_err().to_string();
    assert!(error.contains("vertex 60001") && error.contains("far from the rest"), "{error}");
}

#[test]
fn faces_without_area_and_with_repeated_corners_are_taken_as_they_come() {
    let (positions, mut faces) = torus(60, 100);
    faces.extend([[1, 1, 2], [7, 8, 7], [5, 5, 5]]);
    let clustered = ply(&positions, &faces).cluster(2, &OPTIONS).unwrap();
    assert_eq!(clustered.stats.repeated_corner_faces, 3);
    assert_eq!((clustered.stats.flat_faces, clustered.stats.unreferenced_vertices), (0, Some(0)));
    assert_eq!(odd_edges(&clustered.mesh.faces), 0);

    // All on one line: no area, no plane, but faces and finite positions.
    let positions: Vec<[f32; 3]> = (0..500).map(|i| [i as f32, 0.0, 0.0]).collect();
    let faces: Vec<[u32; 3]> = (0..498).map(|i| [i, i + 1, i + 2]).collect();
    let clustered = ply(&positions, &faces).cluster(2, &ClusterOptions { cells: 100, ..OPTIONS }).unwrap();
    assert!(clustered.mesh.positions.as_flattened().iter().all(|x| x.is_finite()));
    assert!(clustered.stats.occupied_cells <= 110 && clustered.stats.flat_faces == 498, "{:?}", clustered.stats);
}

#[test]
fn the_mean_is_a_representative_too() {
    let (positions, faces) = torus(150, 400);
    let made = ply(&positions, &faces);
    let mean = made.cluster(2, &ClusterOptions { representative: Representative::Mean, ..OPTIONS }).unwrap();
    let quadric = made.cluster(2, &OPTIONS).unwrap();
    assert_eq!(mean.mesh.faces, quadric.mesh.faces);
    assert_ne!(mean.mesh.positions, quadric.mesh.positions);
    let cost = |c: &Clustered<f32>| c.quadrics.iter().map(|q| f64::from(q.c)).sum::<f64>();
    assert!(cost(&quadric) < cost(&mean));
}

#[test]
fn corners_and_keys_agree_on_the_cell() {
    let s = [5 << LOCAL_BITS | 17, 9 << LOCAL_BITS, 1 << LOCAL_BITS | 8191];
    assert_eq!(coordinates(grid::cell_key(s)), [5, 9, 1]);
    assert_eq!(Corner::new(3, s).local(), [17, 0, 8191]);
}

#[test]
fn buckets_hold_near_faces_and_wide_ones() {
    let vertices = 200_000;
    let mut random = Random(7);
    let mut faces = Vec::new();
    for _ in 0..30_000 {
        let a = random.next() as u32 % vertices;
        let reach = [9, 65_535, 65_536, vertices][random.next() as usize % 4];
        let [b, c] = [0, 1].map(|_| (a + random.next() as u32 % reach) % vertices);
        faces.push([a, b, c]);
    }
    faces.extend([[0, 65_535, 1], [0, 65_536, 1], [1, 65_535, 0], [199_998, 199_999, 5]]);
    let made = ply(&vec![[0.0; 3]; vertices as usize], &faces);
    let progress = Progress::default();
    let (scan, crew) = (Scan::open(&made.path, &progress).unwrap(), Crew { workers: 3, progress: &progress });
    let led = |[a, b, c]: [u32; 3]| {
        if a < b.min(c) {
            [a, b, c]
        } else if b < c {
            [b, c, a]
        } else {
            [c, a, b]
        }
    };
    let sound = faces.iter().filter(|[a, b, c]| a != b && b != c && c != a);
    let mut expected: Vec<[u32; 3]> = sound.map(|face| led(*face)).collect();
    expected.sort_unstable();
    for all_wide in [false, true] {
        let scratch = Scratch::in_folder(made.folder.path());
        let buckets = Buckets::fill(&scan, &crew, &scratch, all_wide).unwrap();
        let mut found = [const { Vec::new() }; 2];
        let take = |found: &mut Vec<[u32; 3]>, form: buckets::Form, records: &[u16]| {
            form.each(records, |face| {
                found.push(face);
                Ok(())
            })
        };
        buckets.stream(&crew, &mut found, take).unwrap();
        let mut found = found.concat();
        found.sort_unstable();
        assert_eq!(found, expected);
        assert_eq!(buckets.repeated as usize, faces.len() - expected.len());
        let far = |[a, b, c]: &&[u32; 3]| all_wide || b.max(c) - a > 65_535;
        let bytes = 6 * (found.len() + found.iter().filter(far).count());
        assert_eq!(scratch.bytes(), bytes as u64);
    }
}
