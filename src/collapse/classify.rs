//! What the mesh's edges and vertices are: regular, border, non-manifold.

use super::surface::{ODD, Surface};
use crate::cores::InPieces;
use crate::mesh::Coordinate;
use crate::mesh::audit::{Irregularities, irregularities, is_regular};
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

/// Marks the vertices of odd edges and counts. Needs fresh stars.
pub(super) fn classify<S: Coordinate>(surface: &Surface<S>) -> Irregularities {
    (0..surface.positions.len() as u32)
        .into_par_iter()
        .in_pieces(256)
        .map_init(Vec::new, |ends, v| {
            ends.clear();
            ends.extend(surface.stars.of(v).iter().map(|&c| surface.ends(c)));
            if is_regular(ends) {
                return Irregularities::default();
            }
            let (odd, found) = irregularities(v, ends);
            if odd {
                surface.marks[v as usize].fetch_or(ODD, Relaxed);
            }
            found
        })
        .reduce(Irregularities::default, |a, b| a + b)
}
