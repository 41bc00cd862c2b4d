//! What the mesh's edges and vertices are: regular, border, non-manifold.

use super::surface::{ODD, Surface};
use crate::mesh::Coordinate;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
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
            let (odd, found) = irregularities(v, ends);
            if odd {
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
    // The walk is quadratic: large stars are sorted instead.
    if ends.len() > 64 {
        return false;
    }
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

/// Whether `v` is on an odd edge, and what is irregular there; each edge is counted at its lower end.
fn irregularities(v: u32, ends: &[(u32, u32)]) -> (bool, Irregularities) {
    let mut sides: Vec<(u32, bool)> = ends.iter().flat_map(|&(out, back)| [(out, true), (back, false)]).collect();
    sides.sort_unstable();
    let mut found = Irregularities::default();
    let mut odd = false;
    for edge in sides.chunk_by(|a, b| a.0 == b.0) {
        if let [(_, false), (_, true)] = edge {
            continue;
        }
        odd = true;
        if v < edge[0].0 {
            if edge.len() == 1 {
                found.border_edges += 1;
            } else {
                found.nonmanifold_edges += 1;
            }
        }
    }
    found.nonmanifold_vertices = u64::from(!odd && fan_length(ends) < ends.len());
    (odd, found)
}

/// How many of a vertex's faces the fan of the first has. All edges are regular.
fn fan_length(ends: &[(u32, u32)]) -> usize {
    let turns: FxHashMap<u32, u32> = ends.iter().copied().collect();
    let Some(&(start, mut u)) = ends.first() else { return 0 };
    let mut faces = 1;
    while u != start && faces <= ends.len() {
        let Some(&next) = turns.get(&u) else { break };
        u = next;
        faces += 1;
    }
    faces
}
