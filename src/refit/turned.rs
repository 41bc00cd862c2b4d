//! Faces that look against those around them, as a sliver does that has turned over.

use super::ground::Ground;
use crate::mesh::Coordinate;
use crate::mesh::adjacency::{after, before, parts};
use glam::Vec3;

impl<S: Coordinate> Ground<'_, S> {
    /// The one other face of the edge from `u` to `v` of face `f`, and its third vertex.
    pub fn opposite(&self, f: u32, u: u32, v: u32) -> Option<(u32, u32)> {
        let mut found = None;
        for &corner in self.stars.of(u) {
            let (g, i) = parts(corner);
            let face = self.mesh.faces[g];
            if g as u32 == f || !face.contains(&v) {
                continue;
            }
            if found.is_some() || face[before(i)] != v {
                return None;
            }
            found = Some((g as u32, face[after(i)]));
        }
        found
    }

    /// The other faces of a face's edges.
    pub fn neighbours(&self, f: u32) -> impl Iterator<Item = u32> {
        let face = self.mesh.faces[f as usize];
        (0..3).filter_map(move |side| Some(self.opposite(f, face[side], face[after(side)])?.0))
    }

    /// Whether a face looks against those around it.
    pub fn has_turned(&self, f: u32) -> bool {
        is_against(self.normal(f), self.neighbours(f).map(|g| self.normal(g)).sum())
    }

    /// How many of faces (u, v, a) and (v, u, b) look against those around them, and how many of the two that a flip makes
    /// of them.
    pub fn turned_by_flip(&self, [f, g]: [u32; 2], [u, b, v, a]: [u32; 4]) -> [usize; 2] {
        let beyond = |face: u32, x: u32, y: u32| self.opposite(face, x, y).map_or(Vec3::ZERO, |(h, _)| self.normal(h));
        let (ub, bv, va, au) = (beyond(g, u, b), beyond(g, b, v), beyond(f, v, a), beyond(f, a, u));
        let turned = |[n, m]: [Vec3; 2], [around_n, around_m]: [Vec3; 2]| {
            usize::from(is_against(n, m + around_n)) + usize::from(is_against(m, n + around_m))
        };
        let would = [self.normal_of([u, b, a]), self.normal_of([b, v, a])];
        [turned([self.normal(f), self.normal(g)], [va + au, ub + bv]), turned(would, [ub + au, bv + va])]
    }
}

/// Whether a face with the first normal looks against those around it, whose normals add up to the second. The tips of sharp
/// spikes do so, too.
pub(super) fn is_against(n: Vec3, around: Vec3) -> bool {
    n.dot(around) < 0.0
}
