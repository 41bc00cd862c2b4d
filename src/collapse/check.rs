//! What forbids a collapse: faces that would fold over, topology that would change, vertices that are locked (thesis §3.7).

use super::Options;
use super::batch::{Batch, NONE, order};
use super::policy::{FoldCheck, Topology};
use super::surface::{Around, Surface, turned};
use crate::cores::InPieces;
use crate::mesh::{Coordinate, step};
use rayon::prelude::*;

impl FoldCheck {
    /// Whether the face of `at`, `p` and `q` folds over when its first corner goes to `to`. One without area may become
    /// anything.
    #[inline(always)]
    pub(super) fn refuses<S: Coordinate>(self, at: [S; 3], to: [S; 3], p: [S; 3], q: [S; 3]) -> bool {
        match self {
            FoldCheck::Normals => turns(at, to, p, q),
            FoldCheck::Planes => crosses(at, to, p, q),
            FoldCheck::Both => turns(at, to, p, q) || crosses(at, to, p, q),
            FoldCheck::Off => false,
        }
    }
}

#[inline(always)]
fn turns<S: Coordinate>(at: [S; 3], to: [S; 3], p: [S; 3], q: [S; 3]) -> bool {
    turned(step(at, p).cross(step(at, q)), step(to, p).cross(step(to, q)))
}

/// Whether a corner leaves its side of the plane through the opposite edge that is perpendicular to the face (Fig. 3.15).
fn crosses<S: Coordinate>(at: [S; 3], to: [S; 3], p: [S; 3], q: [S; 3]) -> bool {
    let edge = step(p, q).as_dvec3();
    let (was, would) = (step(p, at).as_dvec3(), step(p, to).as_dvec3());
    let normal = was.cross(edge);
    let inwards = edge.cross(normal);
    normal.length_squared() > 0.0 && inwards.dot(would) * inwards.dot(was) <= 0.0
}

impl<S: Coordinate> Surface<S> {
    /// Whether nothing that holds without exception forbids to merge `a` and `b`.
    #[inline(always)]
    pub fn allows(&self, around: &impl Around, a: u32, b: u32, options: &Options) -> bool {
        let both_locked = options.locks() && self.locked(a) && self.locked(b);
        !both_locked
            && self.keeps_seams(around, a, b)
            && (options.policies.topology == Topology::Simplify || self.keeps_topology(around, a, b))
    }

    /// The link condition: what is next to both ends is what their common faces hold, the outside of a border counted as
    /// a neighbour of its own. Of three vertices that two triangles have back to back, none could go.
    fn keeps_topology(&self, around: &impl Around, a: u32, b: u32) -> bool {
        let opposite = |&f: &u32| self.faces[f as usize].into_iter().find(|v| *v != a && *v != b);
        let apexes: Vec<u32> = self.shared(around, a, b).collect::<Vec<_>>().iter().filter_map(opposite).collect();
        let of_b = self.neighbours(around, b);
        let common = self.neighbours(around, a).into_iter().filter(|u| of_b.binary_search(u).is_ok()).count();
        let is_border = |u: u32, v: u32| self.shared(around, u, v).count() == 1;
        let has_face = |u: u32, v: u32, w: u32| self.shared(around, u, v).any(|f| self.faces[f as usize].contains(&w));
        match apexes[..] {
            [c] => common == 1 && !(is_border(a, c) && is_border(b, c)),
            [c, d] if c != d => {
                let closed = has_face(a, c, d) && has_face(b, c, d);
                common == 2 && !closed && !(self.odd(a) && self.odd(b))
            }
            _ => false,
        }
    }
}

/// Takes back pairs until the link condition holds for all that are left, in whatever order they go: no pair may have its
/// ends next to different ends of another. Of two such, that of the higher hash goes.
pub(super) fn take_back_neighbours<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>) {
    let this = &*batch;
    let partner = |v: u32| {
        let (leader, next) = (this.leader(v), this.next[v as usize].load(std::sync::atomic::Ordering::Relaxed));
        if leader == NONE { NONE } else { next }
    };
    let loses = |&v: &u32| {
        let u = partner(v);
        let of_u = surface.neighbours(&surface.stars, u);
        surface.neighbours(&surface.stars, v).into_iter().any(|p| {
            let q = partner(p);
            p != u && q != NONE && of_u.binary_search(&q).is_ok() && order(p, q) < order(v, u)
        })
    };
    let back: Vec<u32> = this.all_leaders().into_par_iter().in_pieces(256).filter(loses).collect();
    for v in back {
        let u = this.next[v as usize].load(std::sync::atomic::Ordering::Relaxed);
        this.take_back(&[v, u]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_and_normals_see_different_folds() {
        let [at, p, q] = [[0.0f32, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        let refused = |to: [f32; 3]| {
            [FoldCheck::Normals, FoldCheck::Planes, FoldCheck::Both, FoldCheck::Off].map(|c| c.refuses(at, to, p, q))
        };
        assert_eq!(refused([0.3, 0.5, 0.1]), [false; 4]);
        assert_eq!(refused([0.0, -0.5, 0.0]), [true, true, true, false]);
        // It tilts steeply, yet stays on its side of the opposite edge.
        assert_eq!(refused([0.0, 0.1, 3.0]), [true, false, true, false]);
        assert!(!FoldCheck::Both.refuses(p, [0.0; 3], p, q), "a face without area becomes anything");
    }
}
