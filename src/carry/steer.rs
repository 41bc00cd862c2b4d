//! What steers the collapse: colours and normals of vertices as lengths, and what a full range of them is worth.

use super::{Pick, Places};
use crate::error::Result;
use crate::mesh::adjacency::Stars;
use crate::mesh::columns::{Column, Meaning};
use crate::mesh::{Coordinate, Extent, Frame, IndexedMesh, Shades, Tree};
use crate::progress::Stage;
use crate::read::{Crew, Scan};
use glam::DVec3;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};

/// A number that steers: its column, and its full range as a length in the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steer {
    /// Which of the scan's columns.
    pub column: usize,
    /// What its full range is worth.
    pub length: f64,
}

impl Steer {
    /// The share of the full range that a value is: of colours from none to full brightness, of normals from -1 to 1.
    fn share(&self, columns: &[Column], values: &[f64]) -> f64 {
        let (column, value) = (&columns[self.column], values[self.column]);
        match column.meaning {
            Meaning::Normal(_) => 0.5 + 0.5 * (value / column.full()).clamp(-1.0, 1.0),
            _ => column.brightness(value),
        }
    }
}

/// What a full range counts where it weighs 1: so many times the square of an edge of the result over the scan's
/// diagonal, since that is how deviation grows with edges on what is smooth.
const RANGE_LENGTH: f64 = 8.0;

/// And so many times the scan's noise, which no result comes nearer than: without, colours of a scanner's mesh have no
/// say at all. At most the faces that one of the result stands for, since what looks like noise may be fine shape.
const NOISE_LENGTH: f64 = 16.0;

/// Faces that are asked how far the next one is from their plane.
const ASKED_FOR_NOISE: usize = 20_000;

/// What the full range of a number that steers is worth as a length in the frame, at a weight of 1.
pub fn range_length<S: Coordinate>(mesh: &IndexedMesh<S>, asked: Option<u64>) -> f64 {
    let area = |face: &[u32; 3]| {
        let [a, b, c] = face.map(|v| mesh.at(v));
        0.5 * (b - a).cross(c - a).length()
    };
    let count = mesh.faces.len().max(1) as f64;
    let faces = (asked.unwrap_or(0) as f64).max(count / 50.0).max(1.0);
    let area = mesh.faces.iter().map(area).sum::<f64>();
    let mut extent = Extent::default();
    (0..mesh.positions.len() as u32).for_each(|v| extent.include(mesh.at(v)));
    let smooth = |faces: f64| RANGE_LENGTH * area / faces / extent.diagonal();
    smooth(faces) + NOISE_LENGTH.min(count / faces) * (roughness(mesh) - smooth(count)).max(0.0)
}

/// How far a face's neighbours reach from its plane, on average.
fn roughness<S: Coordinate>(mesh: &IndexedMesh<S>) -> f64 {
    let mut stars = Stars::default();
    stars.rebuild(&mesh.faces, mesh.positions.len());
    let (mut sum, mut count) = (0.0, 0.0);
    for f in (0..mesh.faces.len()).step_by(mesh.faces.len().div_ceil(ASKED_FOR_NOISE).max(1)) {
        let [a, b, c] = mesh.faces[f];
        let at = mesh.at(a);
        let Some(normal) = (mesh.at(b) - at).cross(mesh.at(c) - at).try_normalize() else { continue };
        for (u, v) in [(a, b), (b, c), (c, a)] {
            let Some(g) = stars.across(&mesh.faces, f, (u, v)) else { continue };
            let Some(w) = mesh.faces[g].into_iter().find(|w| *w != u && *w != v) else { continue };
            sum += (mesh.at(w) - at).dot(normal).abs();
            count += 1.0;
        }
    }
    if count > 0.0 { sum / count } else { 0.0 }
}

/// What steers of a loaded scan's vertices. A vertex takes it from the first one of the file at its place.
pub fn shades<S: Coordinate>(
    scan: &Scan,
    steers: &[Steer],
    mesh: &IndexedMesh<S>,
    frame: Frame,
    crew: &Crew<'_>,
) -> Result<Shades> {
    let places = Places::of(mesh, frame);
    let dims = steers.len();
    let mut shades = vec![f32::NAN; dims * mesh.positions.len()];
    let crew = Crew { workers: 1, ..*crew };
    let all = Mutex::new(&mut shades);
    scan.carried(
        &crew,
        || (),
        |(), chunk| {
            let mut shades = all.lock().unwrap_or_else(PoisonError::into_inner);
            for (p, values) in chunk.positions.iter().zip(chunk.values.chunks_exact(chunk.columns)) {
                let Some(vertex) = places.find(*p) else { continue };
                let shade = &mut shades[dims * vertex as usize..][..dims];
                if shade[0].is_nan() {
                    let share = |steer: &Steer| steer.share(scan.columns(), values);
                    shade.iter_mut().zip(steers).for_each(|(x, steer)| *x = (steer.length * share(steer)) as f32);
                }
            }
            Ok(())
        },
    )?;
    // What has no colour, or none that is a number, is black.
    shades.iter_mut().filter(|x| !x.is_finite()).for_each(|x| *x = 0.0);
    Ok(Shades { dims, values: shades })
}

/// The same for what clustering has made of a scan: each vertex takes the mean of the scan's vertices next to it.
pub fn mean_shades<S: Coordinate>(
    scan: &Scan,
    steers: &[Steer],
    mesh: &IndexedMesh<S>,
    frame: Frame,
    crew: &Crew<'_>,
) -> Result<Shades> {
    let dims = steers.len();
    let pick =
        Pick { stride: scan.vertex_count().div_ceil(SAMPLES_TO_STEER * (mesh.positions.len() as u64).max(1)).max(1) };
    crew.progress.begin(Stage::Carry, scan.bytes());
    // Of each vertex the numbers and how many there were.
    let sums: Vec<AtomicU64> = (0..(dims + 1) * mesh.positions.len()).map(|_| AtomicU64::new(0)).collect();
    let tree = Tree::build(mesh);
    scan.carried(
        crew,
        || 0,
        |near, chunk| {
            let vertices = chunk.positions.iter().zip(chunk.values.chunks_exact(chunk.columns));
            for (vertex, (p, values)) in (chunk.first..).zip(vertices) {
                let p = frame.place(DVec3::from_array(*p));
                if !pick.takes(vertex) || !p.is_finite() || steers.iter().any(|s| !values[s.column].is_finite()) {
                    continue;
                }
                (*near, _) = tree.search(p, *near);
                let [a, b, c] = mesh.faces[*near as usize];
                let nearer = |a: u32, b: u32| {
                    let off = |v: u32| mesh.at(v).distance_squared(p);
                    if off(b) < off(a) { b } else { a }
                };
                let sum = &sums[nearer(nearer(a, b), c) as usize * (dims + 1)..][..dims + 1];
                sum[dims].fetch_add(1, Relaxed);
                for (sum, steer) in sum.iter().zip(steers) {
                    sum.fetch_add((FULL * steer.share(scan.columns(), values)).round() as u64, Relaxed);
                }
            }
            Ok(())
        },
    )?;
    drop(tree);
    let mean = |(sum, steer): (&AtomicU64, &Steer), n: u64| {
        (steer.length * sum.load(Relaxed) as f64 / (FULL * n as f64)) as f32
    };
    let values = sums.chunks_exact(dims + 1).flat_map(|sum| {
        let n = sum[dims].load(Relaxed).max(1);
        sum.iter().zip(steers).map(move |pair| mean(pair, n))
    });
    Ok(Shades { dims, values: values.collect() })
}

/// Vertices of the scan for each of a clustered one's that are asked what colour steers.
const SAMPLES_TO_STEER: u64 = 8;

/// Full brightness in sums.
const FULL: f64 = 65_535.0;
