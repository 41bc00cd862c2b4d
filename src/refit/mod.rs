//! Refit: the reduced mesh's vertices move, and edges flip, to where the scan is.
//!
//! Quadrics measure distance to *planes*, deviation is distance to the *surface*. Once the count is right, each vertex
//! can be put where the surface asks for it: samples of the scan find the faces that they are nearest to, and the
//! vertices take the least-squares step towards them, as in Hoppe's mesh optimisation (the thesis's decoupled
//! synthesis, §9.2). One round takes 15 to 30 % off E_avg. In core the samples are of a [`Reference`], which is what
//! was left of the scan at ten times the target; out of core clustering has taken them from the scan itself
//! ([`SurfaceSamples`]).
//!
//! **A round.** `samples` → nearest faces, by a walk that starts where the collapse has put the sample's vertex
//! (`ground`) → one block a face, a few steps of conjugate gradients (`system`) → steps that turn a face are halved
//! until none does. From the second round on, edges flip first where that brings samples nearer (`flip`), and points of
//! the result look for the reference too: faces that slide past the end of a thin part would else never be called back.
//!
//! **Promises.** No face turns by more than `LEAST_COSINE` allows in a round, none looks away from its samples; the
//! count stays. Borders and what is not manifold stay where they are. The same mesh for any number of threads.
//!
//! **Memory.** The reference is 12 bytes a face and 16 a vertex, its samples 24 a face; the result takes
//! [`BYTES_A_FACE`]. At a reference of [`LEAST_RATIO`] times the result that is 96 for each of its faces; the collapse
//! before took 112. Samples of the scan are [`BYTES_A_SAMPLE`] each.

mod around;
mod flip;
mod ground;
mod lanes;
mod samples;
mod system;
mod turned;

use crate::Result;
use crate::cores::InPieces;
use crate::mesh::adjacency::{Stars, after, before, parts};
use crate::mesh::samples::SAMPLE_BYTES;
use crate::mesh::{Coordinate, IndexedMesh, Reference, SurfaceSamples, Wedges, narrow, step, widen};
use crate::progress::{Progress, Stage};
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use flip::Wanted;
use glam::Vec3;
use ground::Ground;
use lanes::{LANES, Triangles, Vec3x8};
use rayon::prelude::*;
use samples::{Evidence, Point, Samples, Scanned};
use system::{Block, System, Wishes};
use turned::is_against;

/// No face, no vertex.
const NONE: u32 = u32::MAX;

/// Reference : result below which there is nothing to gain: fewer than nine samples a face would be followed into the
/// noise.
pub const LEAST_RATIO: usize = 3;

/// Samples of the scan for each face of the result. 40 take 1.6 % off E_avg on a scan of 27.6 M faces, for a fourteenth of the
/// time of all; at 10 it is 7 % more, at 5 a fifth.
pub const SAMPLES: usize = 24;
/// With fewer of them the reference is better.
pub const LEAST_SAMPLES: usize = 4;

/// Bytes of a result at work, for each of its faces: 20 of the mesh, 14 of stars, 72 of a block, 40 to 60 of the system.
pub const BYTES_A_FACE: u64 = 180;
/// Bytes of a sample of the scan: itself, its face, its place in the faces' lists.
pub const BYTES_A_SAMPLE: u64 = SAMPLE_BYTES as u64 + 8;

/// The least cosine between a face's normals before and after a round.
const LEAST_COSINE: f64 = 0.3;

/// From this cosine on a face turns so little that it is not looked at whether it turns over.
const STEADY: f64 = 0.99;

/// How often the steps around a face that would turn too far are halved before they are not taken at all.
const HALVINGS: usize = 4;

/// Points of a face of the result that look for the reference: the corners of its sixths.
const BACK: [[f32; 3]; 6] = [[E, D, D], [D, E, D], [D, D, E], [G, F, F], [F, G, F], [F, F, G]];
const D: f32 = 0.091_576_2;
const E: f32 = 1.0 - 2.0 * D;
const F: f32 = 0.445_948_5;
const G: f32 = 1.0 - 2.0 * F;

/// What a result is fitted to. Samples of the scan itself are better than a reference where there are enough of them.
#[derive(Debug)]
pub struct Aim<'a, S> {
    /// A finer mesh: all that there is where the scan is in memory, and what points of the result look for.
    pub reference: Option<&'a Reference<S>>,
    /// Samples of the scan, each near a vertex of the result.
    pub samples: Option<&'a SurfaceSamples>,
}

/// What a refit leaves as it is.
#[derive(Debug)]
pub struct Held<'a> {
    /// Vertices that stay where they are.
    pub locked: &'a [u32],
    /// Seams, whose edges do not flip; where others do, corners keep their wedges.
    pub wedges: &'a mut Wedges,
}

/// Refits `mesh` to `aim` in so many rounds.
pub fn refit<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    aim: &Aim<S>,
    rounds: u32,
    held: Held,
    progress: &Progress,
) -> Result<()> {
    let faces = mesh.faces.len();
    if faces == 0 || rounds == 0 {
        return Ok(());
    }
    let enough = |samples: &&SurfaceSamples| samples.samples.len() >= LEAST_SAMPLES * faces;
    if let Some(samples) = aim.samples.filter(enough) {
        let scanned = Scanned::new(samples, mesh.positions.len(), aim.reference);
        return fit(mesh, &scanned, aim.reference, rounds, held, progress);
    }
    match aim.reference.filter(|reference| reference.mesh.faces.len() >= LEAST_RATIO * faces) {
        Some(reference) => fit(mesh, reference, Some(reference), rounds, held, progress),
        None => Ok(()),
    }
}

/// The same to one kind of evidence.
fn fit<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    evidence: &impl Evidence<S>,
    reference: Option<&Reference<S>>,
    rounds: u32,
    held: Held,
    progress: &Progress,
) -> Result<()> {
    let Held { locked, wedges } = held;
    let mut stars = Stars::default();
    stars.rebuild(&mesh.faces, mesh.positions.len());
    let mut fixed = irregular(mesh, &stars);
    locked.iter().for_each(|&v| fixed[v as usize] = true);
    let mut fine = Stars::default();
    let fine_mesh = reference.filter(|_| rounds > 1).map(|reference| &reference.mesh);
    if let Some(mesh) = fine_mesh {
        fine.rebuild(&mesh.faces, mesh.positions.len());
    }
    let mut samples = Samples::default();
    progress.begin(Stage::Refit, u64::from(rounds));
    for round in 0..rounds {
        progress.check()?;
        samples.assign(Ground { mesh, stars: &stars }, evidence);
        if round > 0 {
            flip(mesh, &mut stars, evidence, &samples, wedges, Wanted::All);
            samples.assign(Ground { mesh, stars: &stars }, evidence);
        }
        let back = fine_mesh.filter(|_| round > 0).map(|mesh| Ground { mesh, stars: &fine });
        let blocks = blocks(Ground { mesh, stars: &stars }, back, evidence, &samples);
        let steps = System { faces: &mesh.faces, stars: &stars, fixed: &fixed, blocks: &blocks }.solve();
        drop(blocks);
        take(mesh, &stars, steps);
        progress.add(1);
    }
    flip(mesh, &mut stars, evidence, &samples, wedges, Wanted::Turned);
    Ok(())
}

/// Flips the edges that pay.
fn flip<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    stars: &mut Stars,
    evidence: &impl Evidence<S>,
    samples: &Samples,
    wedges: &mut Wedges,
    wanted: Wanted,
) {
    let flips = flip::flip(Ground { mesh, stars }, evidence, samples, wedges, wanted);
    if flips.is_empty() {
        return;
    }
    flip::move_wedges(&flips, mesh, wedges);
    for (f, face) in flips {
        mesh.faces[f as usize] = face;
    }
    stars.rebuild(&mesh.faces, mesh.positions.len());
}

/// Whether each vertex stays where it is: on a border, or where the surface is not manifold.
fn irregular<S: Coordinate>(mesh: &IndexedMesh<S>, stars: &Stars) -> Vec<bool> {
    (0..mesh.positions.len() as u32)
        .into_par_iter()
        .in_pieces(256)
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
    evidence: &impl Evidence<S>,
    samples: &Samples,
) -> Vec<Block> {
    let block = |f: usize| {
        let normal = ground.normal(f as u32);
        let mut block = dispatch!(Level::new(), simd => ask(simd, ground, evidence, samples, f));
        let Some(fine) = back else { return block };
        for weights in BACK {
            let point = Point::on(ground.mesh, f, weights);
            let distance_sq = |k: &&u32| step(point.at, evidence.point(**k).at).length_squared();
            let nearest = samples.of(f).iter().min_by(|a, b| distance_sq(a).total_cmp(&distance_sq(b)));
            if let Some(place) = nearest.and_then(|k| evidence.back(fine, point.at, normal, *k)) {
                block.add(0.5 * normal.length(), weights, place.step);
            }
        }
        block
    };
    (0..ground.mesh.faces.len()).into_par_iter().in_pieces(64).map(block).collect()
}

/// What its samples ask of one face, eight of them at a time.
#[inline(always)]
fn ask<S: Coordinate, V: Simd>(
    simd: V,
    ground: Ground<S>,
    evidence: &impl Evidence<S>,
    samples: &Samples,
    f: usize,
) -> Block {
    let [a, b, c] = ground.mesh.faces[f].map(|v| ground.mesh.positions[v as usize]);
    let (ab, ac) = (step(a, b), step(a, c));
    let triangles = Triangles::new(Vec3x8::splat(simd, ab), Vec3x8::splat(simd, ac));
    let mut wishes = Wishes::new(simd);
    for few in samples.of(f).chunks(LANES) {
        let (mut axes, mut weights) = ([[0.0; LANES]; 3], [0.0; LANES]);
        for (i, &k) in few.iter().enumerate() {
            let point = evidence.point(k);
            let at = step(a, point.at);
            (0..3).for_each(|axis| axes[axis][i] = at[axis]);
            weights[i] = point.weight;
        }
        let found = triangles.nearest(simd, Vec3x8::from_axes(simd, axes));
        wishes.add(f32x8::load_array(simd, weights), found.weights, found.step);
    }
    wishes.of_face(ab.cross(ac).normalize_or_zero())
}

/// Moves the vertices, as far as no face turns too far or over.
fn take<S: Coordinate>(mesh: &mut IndexedMesh<S>, stars: &Stars, mut steps: Vec<Vec3>) {
    // A face that stays where it is has not turned, so that this ends.
    for turn in 0.. {
        let ground = Ground { mesh, stars };
        let at = |v: u32| mesh.positions[v as usize];
        let moved = |f: u32| {
            let [a, b, c] = mesh.faces[f as usize];
            let [s, t, u] = [a, b, c].map(|v| steps[v as usize]);
            (step(at(a), at(b)) + (t - s)).cross(step(at(a), at(c)) + (u - s))
        };
        let turned = |f: u32| {
            let (was, would) = (ground.normal(f), moved(f));
            let along = was.as_dvec3().dot(would.as_dvec3());
            let lengths = was.as_dvec3().length() * would.as_dvec3().length();
            let over = || {
                let around = |normal: &dyn Fn(u32) -> Vec3| ground.neighbours(f).map(normal).sum();
                is_against(would, around(&moved)) && !is_against(was, around(&|g| ground.normal(g)))
            };
            along < LEAST_COSINE * lengths || (along < STEADY * lengths && over())
        };
        let faces = (0..mesh.faces.len() as u32).into_par_iter().in_pieces(256);
        let mut vertices: Vec<u32> = faces.filter(|&f| turned(f)).flat_map_iter(|f| mesh.faces[f as usize]).collect();
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
