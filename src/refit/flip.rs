//! Edge flips: where the other diagonal of two faces is nearer to the samples, or undoes a face that has turned over and is
//! no further from them.

use super::ground::{Ground, nearest_to_origin};
use super::samples::{Evidence, Samples};
use crate::cores::InPieces;
use crate::mesh::adjacency::{after, before, parts};
use crate::mesh::{Coordinate, IndexedMesh, Wedges, step};
use glam::Vec3;
use rayon::prelude::*;

/// A flip must lower the squared error of its samples by this share: less is noise, and flips that undo one another.
const LEAST_GAIN: f32 = 0.02;

/// Distances below this share of an edge are rounding, and flat regions stay as they are.
const ROUNDING: f32 = 1e-5;

/// The least cosine between the normals of the new faces and of the old ones, where none of these has turned over.
const LEAST_COSINE: f32 = 0.5;

/// An edge whose flip pays: of faces (u, v, a) and (v, u, b).
struct Flip {
    mends: bool,
    gain: f32,
    faces: [u32; 2],
    quad: [u32; 4],
}

/// Which edges are to flip.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Wanted {
    /// All that pay.
    All,
    /// Those of faces that have turned over.
    Turned,
}

/// The faces that flips of edges that pay make, best first, no two at one vertex.
pub(super) fn flip<S: Coordinate>(
    ground: Ground<S>,
    evidence: &impl Evidence<S>,
    samples: &Samples,
    wedges: &Wedges,
    wanted: Wanted,
) -> Vec<(u32, [u32; 3])> {
    let faces = ground.mesh.faces.len();
    let turned: Vec<bool> = (0..faces as u32).into_par_iter().in_pieces(256).map(|f| ground.has_turned(f)).collect();
    let mut flips: Vec<Flip> = (0..faces as u32)
        .into_par_iter()
        .in_pieces(256)
        .flat_map_iter(|f| {
            let turned = &turned;
            (0..3).filter_map(move |side| candidate(ground, evidence, samples, turned, wanted, [f, side]))
        })
        .filter(|flip| wedges.is_empty() || !is_seam(ground.mesh, wedges, flip))
        .collect();
    flips.sort_unstable_by(|a, b| b.mends.cmp(&a.mends).then(b.gain.total_cmp(&a.gain)).then(a.faces.cmp(&b.faces)));
    let mut taken = vec![false; if flips.is_empty() { 0 } else { ground.mesh.positions.len() }];
    let mut changed = Vec::new();
    for Flip { faces: [f, g], quad: [u, b, v, a], .. } in flips {
        let quad = [u, b, v, a];
        if quad.iter().any(|&w| taken[w as usize]) {
            continue;
        }
        quad.iter().for_each(|&w| taken[w as usize] = true);
        changed.extend([(f, [u, b, a]), (g, [b, v, a])]);
    }
    changed
}

/// Whether the faces of an edge see different things at it.
fn is_seam<S>(mesh: &IndexedMesh<S>, wedges: &Wedges, flip: &Flip) -> bool {
    let [f, g] = flip.faces;
    [flip.quad[0], flip.quad[2]].iter().any(|&v| wedge(mesh, wedges, f, v) != wedge(mesh, wedges, g, v))
}

fn wedge<S>(mesh: &IndexedMesh<S>, wedges: &Wedges, f: u32, v: u32) -> Option<u32> {
    let side = mesh.faces[f as usize].iter().position(|u| *u == v)?;
    Some(wedges.corners[f as usize][side])
}

/// Gives corners of flipped faces the wedges that their vertices have there. `mesh` is as it was.
pub(super) fn move_wedges<S>(flips: &[(u32, [u32; 3])], mesh: &IndexedMesh<S>, wedges: &mut Wedges) {
    if wedges.is_empty() {
        return;
    }
    for pair in flips.chunks(2) {
        let at = |v: u32| pair.iter().find_map(|&(f, _)| wedge(mesh, wedges, f, v)).unwrap_or(0);
        let now: Vec<_> = pair.iter().map(|(f, face)| (*f, face.map(at))).collect();
        now.into_iter().for_each(|(f, corners)| wedges.corners[f as usize] = corners);
    }
}

/// The flip of the edge that leaves `side` of face `f`, if it pays.
fn candidate<S: Coordinate>(
    ground: Ground<S>,
    evidence: &impl Evidence<S>,
    samples: &Samples,
    turned: &[bool],
    wanted: Wanted,
    [f, side]: [u32; 2],
) -> Option<Flip> {
    let side = side as usize;
    let face = ground.mesh.faces[f as usize];
    let (u, v, a) = (face[side], face[after(side)], face[before(side)]);
    if u > v {
        return None;
    }
    let (g, b) = ground.opposite(f, u, v)?;
    let was = [ground.normal(f), ground.normal(g)];
    let quad = [u, b, v, a];
    let mends = turned[f as usize] || turned[g as usize];
    if wanted == Wanted::Turned && !mends {
        return None;
    }
    let joined = ground.stars.of(a).iter().any(|&c| ground.mesh.faces[parts(c).0].contains(&b));
    if a == b || joined {
        return None;
    }
    let at = |w: u32| ground.mesh.positions[w as usize];
    let would = [[u, b, a], [b, v, a]];
    let tilts = |n: Vec3| was.iter().any(|w| n.dot(*w) < LEAST_COSINE * n.length() * w.length());
    if !mends && would.iter().any(|t| tilts(ground.normal_of(*t))) {
        return None;
    }
    let (mut before_sq, mut after_sq) = (0.0, 0.0);
    for &k in samples.of(f as usize).iter().chain(samples.of(g as usize)) {
        let point = evidence.point(k);
        let distance_sq = |t: [u32; 3]| {
            let corners = t.map(|w| step(point.at, at(w)));
            let l = nearest_to_origin(corners);
            (corners[0] * l[0] + corners[1] * l[1] + corners[2] * l[2]).length_squared()
        };
        before_sq += point.weight * distance_sq(face).min(distance_sq(ground.mesh.faces[g as usize]));
        after_sq += point.weight * distance_sq(would[0]).min(distance_sq(would[1]));
    }
    let gain = before_sq - after_sq;
    let rounding_sq = ROUNDING * ROUNDING * was[0].length() * step(at(u), at(v)).length_squared();
    let least = LEAST_GAIN * before_sq + rounding_sq;
    if gain <= if mends { -least } else { least } {
        return None;
    }
    let [now, left] = ground.turned_by_flip([f, g], quad);
    let allowed = if mends { left < now } else { left == 0 };
    allowed.then_some(Flip { mends, gain, faces: [f, g], quad })
}
