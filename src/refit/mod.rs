//! Refit: the reduced mesh's vertices move, and edges flip, to where the scan is.
//!
//! Quadrics measure distance to *planes*, deviation is distance to the *surface*. Once the count is right, each vertex can
//! be put where the surface asks for it: samples of the [`Reference`] (the scan itself, or what was left of it at ten times
//! the target) find the faces that they are nearest to, and the vertices take the least-squares step towards them, as in Hoppe's
//! mesh optimisation (the thesis's decoupled synthesis, §9.2). One round takes 15 to 30 % off E_avg.
//!
//! **A round.** `samples` → nearest faces, by a walk that starts where the collapse has put the sample's vertex
//! (`ground`) → one block a face, a few steps of conjugate gradients (`system`) → steps that turn a face are halved
//! until none does. From the second round on, edges flip first where that brings samples nearer (`flip`), and points of
//! the result look for the reference too: faces that slide past the end of a thin part would else never be called back.
//!
//! **Promises.** No face turns by more than `LEAST_COSINE` allows in a round, none looks away from its samples; the count stays.
//! Borders and what is not manifold stay where they are. The same mesh for any number of threads.
//!
//! **Memory.** The reference is 12 bytes a face and 16 a vertex, its samples 24 a face; the result takes 150 a face. At a
//! reference of [`LEAST_RATIO`] times the result that is 96 for each of its faces; the collapse before took 112.

mod flip;
mod ground;
mod samples;
mod system;

use crate::Result;
use crate::mesh::adjacency::{Stars, after, before, parts};
use crate::mesh::{Coordinate, IndexedMesh, Reference, narrow, step, widen};
use crate::progress::{Progress, Stage};
use glam::Vec3;
use ground::Ground;
use rayon::prelude::*;
use samples::{Point, Samples};
use system::{Block, System};

/// No face, no vertex.
const NONE: u32 = u32::MAX;

/// Reference : result below which there is nothing to gain: fewer than nine samples a face would be followed into the noise.
pub const LEAST_RATIO: usize = 3;

/// The least cosine between a face's normals before and after a round.
const LEAST_COSINE: f32 = 0.3;

/// How often the steps around a face that would turn too far are halved before they are not taken at all.
const HALVINGS: usize = 4;

/// Points of a face of the result that look for the reference: the corners of its sixths.
const BACK: [[f32; 3]; 6] = [[E, D, D], [D, E, D], [D, D, E], [G, F, F], [F, G, F], [F, F, G]];
const D: f32 = 0.091_576_2;
const E: f32 = 1.0 - 2.0 * D;
const F: f32 = 0.445_948_5;
const G: f32 = 1.0 - 2.0 * F;

/// Refits `mesh` to `reference` in so many rounds. Vertices that are `locked` stay where they are.
pub fn refit<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    reference: &Reference<S>,
    rounds: u32,
    locked: &[u32],
    progress: &Progress,
) -> Result<()> {
    if reference.mesh.faces.len() < LEAST_RATIO * mesh.faces.len() || mesh.faces.is_empty() {
        return Ok(());
    }
    let mut stars = Stars::default();
    stars.rebuild(&mesh.faces, mesh.positions.len());
    let mut fixed = irregular(mesh, &stars);
    locked.iter().for_each(|&v| fixed[v as usize] = true);
    let mut fine = Stars::default();
    if rounds > 1 {
        fine.rebuild(&reference.mesh.faces, reference.mesh.positions.len());
    }
    let mut samples = Samples::default();
    progress.begin(Stage::Refit, u64::from(rounds));
    for round in 0..rounds {
        progress.check()?;
        samples.assign(Ground { mesh, stars: &stars }, reference);
        if round > 0 {
            let flips = flip::flip(Ground { mesh, stars: &stars }, reference, &samples, &fixed);
            for &(f, face) in &flips {
                mesh.faces[f as usize] = face;
            }
            stars.rebuild(&mesh.faces, mesh.positions.len());
            samples.assign(Ground { mesh, stars: &stars }, reference);
        }
        let back = (round > 0).then_some(Ground { mesh: &reference.mesh, stars: &fine });
        let blocks = blocks(Ground { mesh, stars: &stars }, back, reference, &samples);
        let steps = System { faces: &mesh.faces, stars: &stars, fixed: &fixed, blocks: &blocks }.solve();
        drop(blocks);
        take(mesh, steps);
        progress.add(1);
    }
    Ok(())
}

/// Whether each vertex stays where it is: on a border, or where the surface is not manifold.
fn irregular<S: Coordinate>(mesh: &IndexedMesh<S>, stars: &Stars) -> Vec<bool> {
    (0..mesh.positions.len() as u32)
        .into_par_iter()
        .with_min_len(1024)
        .map_init(Vec::new, |sides, v| {
            sides.clear();
            for &corner in stars.of(v) {
                let (f, i) = parts(corner);
                sides.extend([(mesh.faces[f][after(i)], true), (mesh.faces[f][before(i)], false)]);
            }
            sides.sort_unstable();
            !sides.chunk_by(|a, b| a.0 == b.0).all(|edge| matches!(edge, [(_, false), (_, true)]))
        })
        .collect()
}

/// What the samples ask of each face; with `back`, what the reference asks of points of the face, too.
fn blocks<S: Coordinate>(
    ground: Ground<S>,
    back: Option<Ground<S>>,
    reference: &Reference<S>,
    samples: &Samples,
) -> Vec<Block> {
    let block = |f: usize| {
        let normal = ground.normal(f as u32);
        let mut block = Block::new(normal.normalize_or_zero());
        for &k in samples.of(f) {
            let point = Samples::point(reference, k);
            let place = ground.on_face(point.at, f as u32);
            block.add(point.normal.length(), place.weights, -place.step);
        }
        let Some(fine) = back else { return block };
        for weights in BACK {
            let point = Point::on(ground.mesh, f, weights);
            let distance_sq = |k: &&u32| step(point.at, Samples::point(reference, **k).at).length_squared();
            let nearest = samples.of(f).iter().min_by(|a, b| distance_sq(a).total_cmp(&distance_sq(b)));
            if let Some(place) = nearest.and_then(|k| fine.near_face(point.at, normal, k / 3)) {
                block.add(0.5 * normal.length(), weights, place.step);
            }
        }
        block
    };
    (0..ground.mesh.faces.len()).into_par_iter().with_min_len(64).map(block).collect()
}

/// Moves the vertices, as far as no face turns.
fn take<S: Coordinate>(mesh: &mut IndexedMesh<S>, mut steps: Vec<Vec3>) {
    for turn in 0..=HALVINGS {
        let at = |v: u32| mesh.positions[v as usize];
        let turned = |face: &[u32; 3]| {
            let [a, b, c] = face.map(at);
            let [s, t, u] = face.map(|v| steps[v as usize]);
            let (ab, ac) = (step(a, b), step(a, c));
            let (was, would) = (ab.cross(ac).as_dvec3(), (ab + (t - s)).cross(ac + (u - s)).as_dvec3());
            was.dot(would) < f64::from(LEAST_COSINE) * was.length() * would.length()
        };
        let mut vertices: Vec<u32> = mesh.faces.par_iter().filter(|face| turned(face)).flatten().copied().collect();
        if vertices.is_empty() {
            break;
        }
        vertices.sort_unstable();
        vertices.dedup();
        for v in vertices {
            steps[v as usize] *= if turn < HALVINGS { 0.5 } else { 0.0 };
        }
    }
    for (position, step) in mesh.positions.iter_mut().zip(steps) {
        *position = narrow(widen(*position) + step.as_dvec3());
    }
}

#[cfg(test)]
mod tests;
