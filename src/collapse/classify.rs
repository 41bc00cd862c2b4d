//! What the mesh's edges and vertices are: regular, border, non-manifold.

use super::surface::{ODD, Surface};
use crate::cores::InPieces;
use crate::mesh::Coordinate;
use crate::mesh::audit::{Irregularities, LANES, irregularities, is_regular, is_regular_together};
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::Ordering::Relaxed;

/// Marks the vertices of odd edges and counts. Needs fresh stars.
pub(super) fn classify<S: Coordinate>(surface: &Surface<S>) -> Irregularities {
    let vertices = surface.positions.len() as u32;
    let some = |first: u32| {
        let vertices = first..vertices.min(first + TOGETHER);
        dispatch!(Level::new(), simd => classify_some(simd, surface, vertices))
    };
    let firsts = (0..vertices.div_ceil(TOGETHER)).into_par_iter().map(|i| i * TOGETHER);
    firsts.in_pieces(1).map(some).reduce(Irregularities::default, |a, b| a + b)
}

/// Vertices that are looked at by one task.
const TOGETHER: u32 = 256;

#[inline(always)]
fn classify_some<S: Coordinate, V: Simd>(simd: V, surface: &Surface<S>, vertices: Range<u32>) -> Irregularities {
    let (mut all, mut ends) = (Irregularities::default(), Vec::new());
    for v in vertices {
        let star = surface.stars.of(v);
        let (mut from, mut to) = ([0; LANES], [0; LANES]);
        for ((from, to), &corner) in from.iter_mut().zip(&mut to).zip(star) {
            (*from, *to) = surface.ends(corner);
        }
        let is_short = star.len() <= LANES;
        if is_short && is_regular_together(simd, &from, &to, star.len()) {
            continue;
        }
        ends.clear();
        ends.extend(star.iter().map(|&corner| surface.ends(corner)));
        if !is_short && is_regular(&ends) {
            continue;
        }
        let (odd, found) = irregularities(v, &ends);
        if odd {
            surface.marks[v as usize].fetch_or(ODD, Relaxed);
        }
        all = all + found;
    }
    all
}
