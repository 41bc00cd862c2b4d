//! Figures that are known, or worked out by looking at every triangle.

use super::*;
use crate::mesh::triangle::distance_sq;
use crate::progress::Progress;
use glam::DVec3;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A mesh as files are made of it.
#[derive(Clone)]
struct Sketch {
    positions: Vec<[f64; 3]>,
    faces: Vec<[u32; 3]>,
    double: bool,
}

impl Sketch {
    /// A square of side 1 over the origin, at a height.
    fn square(z: f64) -> Sketch {
        let positions = [[0.0, 0.0, z], [1.0, 0.0, z], [1.0, 1.0, z], [0.0, 1.0, z]].into();
        Sketch { positions, faces: vec![[0, 1, 2], [0, 2, 3]], double: false }
    }

    /// A cube of side 1, moved along x.
    fn cube(x: f64) -> Sketch {
        let corner = |i: u32| [x + f64::from(i & 1), f64::from(i >> 1 & 1), f64::from(i >> 2)];
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Sketch { positions: (0..8).map(corner).collect(), faces, double: false }
    }

    /// Hills of `2 · side²` faces over the unit square.
    fn hills(side: u32, height: f64) -> Sketch {
        let wide = side + 1;
        let at = |i: u32| {
            let (x, y) = (f64::from(i % wide) / f64::from(side), f64::from(i / wide) / f64::from(side));
            [x, y, height * ((9.0 * x).sin() * (7.0 * y).cos() + 0.1 * (90.0 * x * y).sin())]
                .map(|x| f64::from(x as f32))
        };
        let quad = |i: u32| {
            let a = i / side * wide + i % side;
            [[a, a + 1, a + wide + 1], [a, a + wide + 1, a + wide]]
        };
        let faces = (0..side * side).flat_map(quad).collect();
        Sketch { positions: (0..wide * wide).map(at).collect(), faces, double: false }
    }

    /// In an order that has nothing to do with places.
    fn shuffled(mut self) -> Sketch {
        let n = self.positions.len() as u32;
        // A multiplication that is coprime to the count permutes.
        let by = (n / 2..).find(|by| (2..200).all(|d| !by.is_multiple_of(d) || !n.is_multiple_of(d))).unwrap();
        let to = |v: u32| (u64::from(v) * u64::from(by) % u64::from(n)) as u32;
        let mut positions = vec![[0.0; 3]; n as usize];
        (0..n).for_each(|v| positions[to(v) as usize] = self.positions[v as usize]);
        self.faces.sort_by_key(|face| face[0].wrapping_mul(2_654_435_761));
        Sketch { positions, faces: self.faces.iter().map(|face| face.map(to)).collect(), ..self }
    }

    fn map(mut self, f: impl Fn([f64; 3]) -> [f64; 3]) -> Sketch {
        self.positions.iter_mut().for_each(|p| *p = f(*p));
        self
    }

    fn in_doubles(self) -> Sketch {
        Sketch { double: true, ..self }
    }

    fn ply(&self, path: &Path) {
        let scalar = if self.double { "double" } else { "float" };
        let mut bytes = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty {scalar} x\nproperty {scalar} y\n\
             property {scalar} z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n",
            self.positions.len(),
            self.faces.len()
        )
        .into_bytes();
        for x in self.positions.as_flattened() {
            if self.double { bytes.extend(x.to_le_bytes()) } else { bytes.extend((*x as f32).to_le_bytes()) }
        }
        for face in &self.faces {
            bytes.push(3);
            bytes.extend(face.map(u32::to_le_bytes).as_flattened());
        }
        std::fs::write(path, bytes).unwrap();
    }

    fn stl(&self, path: &Path) {
        let mut bytes = vec![b' '; 80];
        bytes.extend((self.faces.len() as u32).to_le_bytes());
        for face in &self.faces {
            bytes.extend([0; 12]);
            for v in face {
                bytes.extend(self.positions[*v as usize].map(|x| (x as f32).to_le_bytes()).as_flattened());
            }
            bytes.extend([0; 2]);
        }
        std::fs::write(path, bytes).unwrap();
    }
}

/// Two files, side by side.
struct Files {
    folder: TempDir,
    a: PathBuf,
    b: PathBuf,
}

impl Files {
    fn new(a: &Sketch, b: &Sketch) -> Files {
        Self::of(|path| a.ply(path), |path| b.ply(path))
    }

    fn of(a: impl Fn(&Path), b: impl Fn(&Path)) -> Files {
        let folder = tempfile::tempdir().unwrap();
        let files = Files { a: folder.path().join("a"), b: folder.path().join("b"), folder };
        a(&files.a);
        b(&files.b);
        files
    }

    /// The figures, and the bytes that scratch took; within as little memory as will do, or in plenty.
    fn measured(&self, options: Options, workers: usize, tight: bool) -> Result<(Deviation, u64)> {
        let progress = Progress::default();
        let (a, b) = (Scan::open(&self.a, &progress)?, Scan::open(&self.b, &progress)?);
        let pair = Pair { a: &a, b: &b };
        let crew = Crew { workers, progress: &progress };
        let scratch = Scratch::in_folder(self.folder.path());
        let array_bytes = if tight { Needs::of::<f64>(&pair, &options).bytes() } else { 1 << 30 };
        let options = Options { array_bytes, ..options };
        let deviation = match pair.held().scalar() {
            Scalar::F32 => measure::<f32>(pair, &crew, &scratch, &options)?.deviation,
            Scalar::F64 => measure::<f64>(pair, &crew, &scratch, &options)?.deviation,
        };
        Ok((deviation, scratch.bytes()))
    }

    fn deviation(&self) -> Deviation {
        self.measured(OPTIONS, 2, false).unwrap().0
    }
}

const OPTIONS: Options =
    Options { samples: 1000, most_vertices: MOST_VERTICES, seed: 3, shades: false, array_bytes: 0 };

fn close(x: f64, y: f64) -> bool {
    (x - y).abs() <= 1e-12 * y.abs()
}

#[test]
fn parallel_squares_are_their_distance_apart() {
    let found = Files::new(&Sketch::square(0.0), &Sketch::square(0.25)).deviation();
    for way in [&found.a_to_b, &found.b_to_a] {
        assert!(close(way.mean, 0.25) && close(way.rms, 0.25) && close(way.max, 0.25), "{way:?}");
        assert_eq!((way.area_samples, way.vertices), (1000, 4));
    }
    assert!(close(found.e_avg(), 0.0625) && close(found.e_max(), 0.25), "{found:?}");
    assert!(close(found.mean(), 0.25) && close(found.rms(), 0.25));
    assert_eq!((found.diagonal, found.samples()), (2f64.sqrt(), 2008));
}

#[test]
fn a_smaller_square_is_near_and_the_rim_of_the_larger_is_not() {
    // The larger one reaches out by 1 to each side: its corners are √2 away, and the smaller one lies within it.
    let large = Sketch::square(0.0).map(|[x, y, z]| [3.0 * x - 1.0, 3.0 * y - 1.0, z]);
    let found = Files::new(&large, &Sketch::square(0.0)).deviation();
    assert_eq!((found.b_to_a.max, found.b_to_a.rms), (0.0, 0.0));
    assert!(close(found.a_to_b.max, 2f64.sqrt()), "{found:?}");
    // Over the eight outer unit squares: ½ on average beside an edge, 0.7652 about a corner.
    let mean = (4.0 * 0.5 + 4.0 * 0.765_195_716) / 9.0;
    assert!((found.a_to_b.mean - mean).abs() < 0.02, "{found:?}, not {mean}");
    assert!(found.a_to_b.farthest.iter().all(|x| [-1.0, 2.0, 0.0].contains(x)), "{found:?}");
}

#[test]
fn a_cube_beside_itself() {
    let found = Files::new(&Sketch::cube(0.0), &Sketch::cube(0.25)).deviation();
    for way in [&found.a_to_b, &found.b_to_a] {
        assert!(close(way.max, 0.25), "{way:?}");
        // One face a quarter away (1/6); of four, a quarter of the area at ⅛ on average (1/48); one within the other, where
        // every point is min(¼, its distance to the rim) away (0.16667/6).
        assert!((way.mean - (0.25 / 6.0 + 1.0 / 48.0 + 1.0 / 36.0 * 1.0)).abs() < 0.004, "{way:?}");
    }
}

#[test]
fn equal_files_are_nothing_apart() {
    let far = |[x, y, z]: [f64; 3]| [500_000.123 + x, 5_400_000.456 + y, 300.0 + z];
    for sketch in [Sketch::hills(40, 0.1), Sketch::hills(20, 0.1).map(far).in_doubles(), Sketch::cube(1e-30)] {
        let found = Files::new(&sketch, &sketch).deviation();
        assert_eq!((found.e_avg(), found.e_max(), found.mean(), found.rms()), (0.0, 0.0, 0.0, 0.0));
        let shuffled = Files::new(&sketch, &sketch.clone().shuffled()).deviation();
        assert_eq!((shuffled.e_avg(), shuffled.e_max()), (0.0, 0.0));
    }
}

#[test]
fn a_millimetre_is_a_millimetre_far_from_the_origin() {
    let far = |z: f64| move |p: [f64; 3]| [500_000.0 + 2000.0 * p[0], 5_400_000.0 + 2000.0 * p[1], z];
    let sheet = |z| Sketch::hills(30, 0.0).map(far(z)).in_doubles();
    let found = Files::new(&sheet(300.001), &sheet(300.0)).deviation();
    let error = [found.mean(), found.rms(), found.e_max()].map(|x| (x - 0.001).abs());
    assert!(error.iter().all(|x| *x < 1e-9), "{found:?}");
}

/// What looking at every triangle for every sample gives.
fn naive(from: &Sketch, to: &Sketch) -> (f64, f64, f64) {
    let at = |sketch: &Sketch, face: [u32; 3]| face.map(|v| DVec3::from(sketch.positions[v as usize]));
    let to: Vec<[DVec3; 3]> = to.faces.iter().map(|face| at(to, *face)).collect();
    let nearest = |p: DVec3| to.iter().map(|triangle| distance_sq(p, *triangle)).fold(f64::INFINITY, f64::min);
    let faces: Vec<[DVec3; 3]> = from.faces.iter().map(|face| at(from, *face)).collect();
    let area = faces.iter().map(|[a, b, c]| area_of(*b - *a, *c - *a)).sum();
    let mut samples = Vec::new();
    let spread = Spread::new(OPTIONS.samples, area, OPTIONS.seed);
    (0..).zip(&faces).for_each(|(number, face)| spread.over(number, *face, |p| samples.push(nearest(p))));
    let stride = OPTIONS.stride(from.positions.len() as u64);
    let chosen = from.positions.iter().enumerate().filter(|(v, _)| stride.takes(*v as u64)).step_by(1);
    let vertices = chosen.map(|(_, p)| nearest(DVec3::from(*p))).fold(0.0, f64::max);
    let n = samples.len() as f64;
    let mean = samples.iter().map(|x| x.sqrt()).sum::<f64>() / n;
    let rms = (samples.iter().sum::<f64>() / n).sqrt();
    (mean, rms, samples.into_iter().fold(vertices, f64::max).sqrt())
}

fn same(way: &Way, (mean, rms, max): (f64, f64, f64)) {
    let near = |x: f64, y: f64| (x - y).abs() <= 1e-9 * y;
    assert!(near(way.mean, mean) && near(way.rms, rms) && near(way.max, max), "{way:?}, not {mean} {rms} {max}");
}

#[test]
fn streaming_finds_what_looking_at_all_finds() {
    let small = Sketch::hills(14, 0.12);
    for (large, tilt) in [(Sketch::hills(70, 0.1), 0.05), (Sketch::hills(60, 0.1), 2.0), (Sketch::hills(60, 0.0), 0.0)]
    {
        let large = large.map(|[x, y, z]| [x, y, z + tilt * x].map(|x| f64::from(x as f32)));
        for large in [large.clone(), large.clone().shuffled(), large.in_doubles()] {
            let few = Options { most_vertices: 300, ..OPTIONS };
            let found = Files::new(&large, &small).measured(OPTIONS, 2, false).unwrap().0;
            same(&found.a_to_b, naive(&large, &small));
            same(&found.b_to_a, naive(&small, &large));
            assert_eq!(found.a_to_b.vertices, large.positions.len() as u64);
            // The other way round, nothing changes but who is who.
            let turned = Files::new(&small, &large).measured(OPTIONS, 2, false).unwrap().0;
            assert_eq!((turned.b_to_a, turned.a_to_b), (found.a_to_b, found.b_to_a));
            let fewer = Files::new(&large, &small).measured(few, 2, false).unwrap().0;
            assert!((200..=300).contains(&fewer.a_to_b.vertices) && fewer.b_to_a.vertices == 225, "{fewer:?}");
        }
    }
}

#[test]
fn memory_and_threads_change_nothing() {
    let (large, small) = (Sketch::hills(170, 0.1), Sketch::hills(20, 0.11));
    let bytes = 12 * large.positions.len() as u64;
    let shuffled = large.clone().shuffled();
    for (sketch, scratch) in [(&large, bytes..=bytes), (&shuffled, bytes + 1..=5 * bytes + (1 << 20))] {
        let files = Files::new(sketch, &small);
        let (plenty, none) = files.measured(OPTIONS, 2, false).unwrap();
        assert_eq!(none, 0);
        for workers in [1, 2, 3, 8] {
            assert_eq!(files.measured(OPTIONS, workers, false).unwrap().0, plenty);
            let (tight, spilled) = files.measured(OPTIONS, workers, true).unwrap();
            assert_eq!(tight, plenty);
            assert!(scratch.contains(&spilled), "{spilled}, not {scratch:?}");
        }
    }
    let soup = Files::of(|path| large.stl(path), |path| small.stl(path));
    let found = soup.deviation();
    assert!([1, 3, 8].into_iter().all(|workers| soup.measured(OPTIONS, workers, true).unwrap() == (found, 0)));
    // A soup that streams has every corner; one that is held is welded.
    assert_eq!((found.b_to_a.vertices, small.positions.len()), (441, 441));
    let indexed = Files::new(&large, &small).deviation();
    let away = |x: f64, y: f64| (x / y - 1.0).abs();
    assert_eq!(found.a_to_b.mean, indexed.a_to_b.mean);
    assert!(away(found.b_to_a.mean, indexed.b_to_a.mean) < 1e-12, "{found:?} {indexed:?}");
}

#[test]
fn a_seed_moves_the_samples_and_little_else() {
    let files = Files::new(&Sketch::hills(50, 0.1), &Sketch::hills(14, 0.12));
    let [one, two] = [1, 2].map(|seed| files.measured(Options { seed, ..OPTIONS }, 2, false).unwrap().0);
    assert!(one.rms() != two.rms() && (one.rms() / two.rms() - 1.0).abs() < 0.1, "{one:?} {two:?}");
}

#[test]
fn vertices_that_no_face_uses_are_not_measured() {
    let mut large = Sketch::hills(30, 0.1);
    large.positions.push([1e6, f64::NAN, 0.0]);
    large.positions.insert(0, [0.0, 0.0, 1e6]);
    large.faces.iter_mut().flatten().for_each(|v| *v += 1);
    for tight in [false, true] {
        let files = Files::new(&large.clone().shuffled(), &Sketch::hills(14, 0.12));
        let found = files.measured(OPTIONS, 2, tight).unwrap().0;
        assert!(found.e_max() < 0.1 && found.diagonal < 2.0 && found.a_to_b.vertices == 961, "{found:?}");
    }
}

#[test]
fn what_cannot_be_measured_is_an_error() {
    let good = Sketch::hills(90, 0.1);
    let mut wild = Sketch::hills(120, 0.1);
    wild.positions[777][1] = f64::INFINITY;
    let mut flat = good.clone();
    flat.faces.iter_mut().for_each(|face| face[2] = face[0]);
    for tight in [false, true] {
        for sketch in [wild.clone(), wild.clone().shuffled()] {
            let error = Files::new(&sketch, &good).measured(OPTIONS, 2, tight).unwrap_err().to_string();
            assert!(error.contains("a: vertex ") && error.contains("not finite"), "{error}");
        }
        for (a, b, file) in [(&flat, &Sketch::cube(0.0), "a"), (&good, &flat, "b")] {
            let error = Files::new(a, b).measured(OPTIONS, 2, tight).unwrap_err().to_string();
            assert!(
                error.ends_with(&format!("/{file}: has no usable face: none has three distinct corners")),
                "{error}"
            );
        }
    }
    let away = |[x, y, z]: [f64; 3]| [x + 1e200, y, z];
    let error = Files::new(&good.clone().map(away).in_doubles(), &Sketch::cube(0.0)).measured(OPTIONS, 1, false);
    assert!(error.unwrap_err().to_string().contains("overflow"));
}

#[test]
fn too_small_a_budget_is_refused_with_one_that_does() {
    let files = Files::new(&Sketch::hills(60, 0.1), &Sketch::hills(20, 0.1));
    let progress = Progress::default();
    let (a, b) = (Scan::open(&files.a, &progress).unwrap(), Scan::open(&files.b, &progress).unwrap());
    let pair = Pair { a: &a, b: &b };
    let crew = Crew { workers: 1, progress: &progress };
    let scratch = Scratch::in_folder(files.folder.path());
    let within = |array_bytes| measure::<f32>(pair, &crew, &scratch, &Options { array_bytes, ..OPTIONS });
    let Err(Error::Budget { needed_bytes, .. }) = within(1000) else { panic!("a thousand bytes will not do") };
    assert!(within(needed_bytes - 1).is_err() && within(needed_bytes).is_ok());

    let needs = |options: &Options| Needs::of::<f32>(&pair, options);
    let small = Options { array_bytes: needs_of(20_000, &needs), samples: 1_000_000, ..OPTIONS };
    let fitted = small.fitted(needs).unwrap();
    let fits = |samples: u64, most_vertices: u64| {
        needs(&Options { samples, most_vertices, ..small }).check(small.array_bytes).is_ok()
    };
    assert!(fits(fitted.samples, fitted.most_vertices) && !fits(2 * fitted.samples, 2 * fitted.most_vertices));
    assert!(Options { array_bytes: 1000, ..OPTIONS }.fitted(needs).is_err());
}

fn needs_of(samples: u64, needs: &impl Fn(&Options) -> Needs) -> u64 {
    needs(&Options { samples, ..OPTIONS }).bytes()
}
