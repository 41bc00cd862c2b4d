//! What the mesh's edges and vertices are: regular, border, non-manifold.

use super::surface::{ODD, Surface};
use crate::mesh::Coordinate;
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

/// Counts of what is not regular.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Irregularities {
    /// Edges of a single face.
    pub border_edges: u64,
    /// Edges of three and more faces, or of two that run along it the same way.
    pub nonmanifold_edges: u64,
    /// Vertices without such edges whose faces form more than one fan.
    pub nonmanifold_vertices: u64,
}

impl std::ops::Add for Irregularities {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Irregularities {
            border_edges: self.border_edges + o.border_edges,
            nonmanifold_edges: self.nonmanifold_edges + o.nonmanifold_edges,
            nonmanifold_vertices: self.nonmanifold_vertices + o.nonmanifold_vertices,
        }
    }
}

/// Marks the vertices of odd edges and counts. Needs fresh stars.
pub(super) fn classify<S: Coordinate>(surface: &Surface<S>) -> Irregularities {
    (0..surface.positions.len() as u32)
        .into_par_iter()
        .with_min_len(1024)
        .map_init(Vec::new, |ends, v| {
            ends.clear();
            ends.extend(surface.stars.of(v).iter().map(|&c| surface.ends(c)));
            if is_regular(ends) {
                return Irregularities::default();
            }
            let found = irregularities(v, ends);
            if found.nonmanifold_vertices == 0 {
                surface.marks[v as usize].fetch_or(ODD, Relaxed);
            }
            found
        })
        .reduce(Irregularities::default, |a, b| a + b)
}

/// Whether the faces at a vertex, each from one neighbour to the next, form one closed fan.
#[inline(always)]
fn is_regular(ends: &[(u32, u32)]) -> bool {
    let Some(&(start, mut u)) = ends.first() else { return true };
    let mut fan = 1;
    while u != start {
        let mut next = None;
        for e in ends {
            if e.0 == u {
                if next.is_some() {
                    return false;
                }
                next = Some(e.1);
            }
        }
        let Some(after) = next else { return false };
        u = after;
        fan += 1;
        if fan > ends.len() {
            return false;
        }
    }
    fan == ends.len()
}

/// What is irregular at `v`; each edge is counted at its lower end.
fn irregularities(v: u32, ends: &[(u32, u32)]) -> Irregularities {
    let mut found = Irregularities::default();
    let mut odd = false;
    for (i, e) in ends.iter().enumerate() {
        for u in [e.0, e.1] {
            let out = ends.iter().filter(|e| e.0 == u).count();
            let back = ends.iter().filter(|e| e.1 == u).count();
            if (out, back) == (1, 1) {
                continue;
            }
            odd = true;
            if v < u && !ends[..i].iter().any(|e| e.0 == u || e.1 == u) {
                if out + back == 1 {
                    found.border_edges += 1;
                } else {
                    found.nonmanifold_edges += 1;
                }
            }
        }
    }
    found.nonmanifold_vertices = u64::from(!odd);
    found
}
