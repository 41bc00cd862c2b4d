//! The mesh while it is collapsed: its arrays, and what is asked of them at one edge.

use super::pieces::Pieces;
use super::policy::{FoldCheck, Placement, Quadrics};
use super::{LEARNT_WEIGHT, Options};
use crate::mesh::adjacency::{Stars, after, before, parts};
use crate::mesh::{Coordinate, IndexedMesh, Reference, Shades, Wedges, narrow, widen};
use crate::quadric::{PackedQuadric, Quadric};
use glam::{DVec3, Vec3};
use std::sync::atomic::{AtomicU8, Ordering::Relaxed};

/// A cost that says that the edge's collapse was tried on this geometry and refused. Any finite cost is below it.
pub(super) const REFUSED: f32 = f32::MAX;

/// Where no more than one face in so many is left, costs and current quadrics add less than 6 bytes to the 75 to 80 that
/// each face had at first: to give back what has gone would take 2 % of the collapse of 2 M faces to a hundredth.
const SMALL: usize = 8;

/// Arrays of one mesh: 24 bytes a face (faces, costs), 12 more for the stars; 70 a vertex, 24 more once the current
/// quadrics are kept (82 and 48 in doubles). Roots are 12 a face (24), once half of the faces have gone.
pub(super) struct Surface<S> {
    pub faces: Vec<[u32; 3]>,
    /// Cost of the edge that leaves each corner; infinite where another corner answers for the edge. Empty far from the
    /// target.
    pub costs: Vec<[f32; 3]>,
    pub positions: Vec<[S; 3]>,
    /// What each vertex has learnt of the scan: the sum of the quadrics of all it stands for, about its position.
    pub learnt: Vec<PackedQuadric>,
    /// `A` of the faces that now meet at each vertex, about its position (so `b` and `c` are zero). Empty far
    /// from the target. In the file's scalar: a vertex's place along a flat is the quotient of what is nearly nothing, and the
    /// last bit of a single is felt there.
    pub current: Vec<[S; 6]>,
    /// A vector a face whose product with itself is the face's plane: while edges are evaluated, where arrays that have
    /// shrunk have made room for it; else empty.
    pub roots: Vec<[S; 3]>,
    /// Faces that came in.
    pub faces_at_first: usize,
    /// Attributes as lengths, where they steer; else empty.
    pub shades: Shades,
    /// What corners are on either side of seams, where there are seams; else empty.
    pub wedges: Wedges,
    /// The count cannot be reached while seams are held.
    pub seams_give_way: bool,
    pub marks: Vec<AtomicU8>,
    pub pieces: Pieces,
    pub stars: Stars,
}

/// The vertex was on an odd edge (one with a number of faces other than two, or faces that disagree on its direction).
pub(super) const ODD: u8 = 1;
/// A face at the vertex was changed by the last round.
pub(super) const TOUCHED: u8 = 2;
/// The vertex stays where it is.
pub(super) const LOCKED: u8 = 8;
/// The vertex was on a feature edge.
pub(super) const FEATURE: u8 = 16;
/// The vertex is on a seam.
pub(super) const SEAM: u8 = 32;
/// Marks that a merged vertex has from those it stands for.
pub(super) const KEPT: u8 = ODD | LOCKED | FEATURE | SEAM;

/// Where corners of a vertex are looked up: the round's stars, or the tail's.
pub(super) trait Around {
    fn of(&self, v: u32) -> &[u32];
}

impl Around for Stars {
    #[inline(always)]
    fn of(&self, v: u32) -> &[u32] {
        Stars::of(self, v)
    }
}

/// A possible collapse: where the merged vertex would go, and what it would cost.
#[derive(Debug, Clone, Copy)]
pub(super) struct Candidate {
    /// Relative to the middle of the edge.
    pub step: DVec3,
    pub cost: f64,
}

/// The least cosine between a face's normals before and after: a face may tilt, never fold over (thesis §3.7 asks the
/// same of each face by edge planes). 0.2 refuses less than 1 collapse in 100 on a noisy scan of 1.2 M faces.
pub(super) const LEAST_COSINE: f64 = 0.2;

impl<S: Coordinate> Surface<S> {
    /// Of a mesh, without stars, marks and pieces yet.
    pub fn new(mesh: IndexedMesh<S>, learnt: Option<Vec<PackedQuadric>>, shades: Shades, wedges: Wedges) -> Self {
        let marks = (0..mesh.positions.len()).map(|_| AtomicU8::new(0)).collect();
        Surface {
            faces_at_first: mesh.faces.len(),
            faces: mesh.faces,
            costs: Vec::new(),
            positions: mesh.positions,
            learnt: learnt.unwrap_or_default(),
            current: Vec::new(),
            roots: Vec::new(),
            shades,
            wedges,
            seams_give_way: false,
            marks,
            pieces: Pieces::default(),
            stars: Stars::default(),
        }
    }

    #[inline(always)]
    pub fn at(&self, v: u32) -> DVec3 {
        widen(self.positions[v as usize])
    }

    /// The other two vertices of the face that a corner is in, in its order.
    #[inline(always)]
    pub fn ends(&self, corner: u32) -> (u32, u32) {
        let ((f, side), corners) = (parts(corner), self.faces.as_flattened());
        (corners[3 * f + after(side)], corners[3 * f + before(side)])
    }

    #[inline(always)]
    pub fn odd(&self, v: u32) -> bool {
        self.marks[v as usize].load(Relaxed) & ODD != 0
    }

    #[inline(always)]
    pub fn mark(&self, v: u32) -> u8 {
        self.marks[v as usize].load(Relaxed)
    }

    /// Whether `v` is a corner of a face, without a branch.
    #[inline(always)]
    pub fn has(&self, f: u32, v: u32) -> bool {
        let [a, b, c] = self.faces[f as usize];
        (a == v) | (b == v) | (c == v)
    }

    /// Twice the area times the unit normal of a face.
    #[inline(always)]
    pub fn normal(&self, f: u32) -> DVec3 {
        let [a, b, c] = self.faces[f as usize].map(|v| self.at(v));
        (b - a).cross(c - a)
    }

    /// Whether the edge that leaves `corner` is evaluated there: once an edge, from its lower end; an odd edge may have no
    /// corner that leaves its lower end, so those are evaluated wherever they occur.
    #[inline(always)]
    pub fn answers_for(&self, a: u32, b: u32) -> bool {
        a < b || (self.odd(a) && self.odd(b))
    }

    /// Faces at both `a` and `b`.
    pub fn shared(&self, around: &impl Around, a: u32, b: u32) -> impl Iterator<Item = u32> {
        let has_b = move |&&corner: &&u32| self.has(corner >> 2, b);
        around.of(a).iter().filter(has_b).map(|&corner| corner >> 2)
    }

    /// The cheapest place for the vertex that `a` and `b` would become.
    pub fn candidate(&self, around: &impl Around, a: u32, b: u32, options: &Options) -> Candidate {
        let (pa, pb) = (self.at(a), self.at(b));
        let half = 0.5 * (pb - pa);
        let policies = &options.policies;
        let learnt = self.learnt_form(a, b, half);
        let shaded = |q: Quadric| if self.is_shaded() { q + self.shade_form(around, a, b) } else { q };
        let mut candidate = match policies.quadrics {
            Quadrics::Accumulated => self.place(around, a, b, &shaded(learnt), half, options),
            Quadrics::Current => {
                let q = shaded(self.current_form(around, a, b, half, options));
                let mut candidate = self.place(around, a, b, &q, half, options);
                candidate.cost += LEARNT_WEIGHT * learnt.value(candidate.step);
                candidate
            }
        };
        if policies.penalises() {
            candidate.cost += self.penalty(around, a, b, pa + half + candidate.step, policies);
        }
        if S::DOUBLE {
            candidate.cost = above_rounding(candidate.cost, learnt.w * half.length_squared());
        }
        candidate
    }

    /// The best place for the vertex that `a` and `b` become: where a locked one is.
    #[inline(always)]
    fn place(&self, around: &impl Around, a: u32, b: u32, q: &Quadric, half: DVec3, options: &Options) -> Candidate {
        if self.at_seam(&[a, b]) {
            return self.seam_candidate(around, a, b, q, half);
        }
        if options.locks() && (self.locked(a) || self.locked(b)) {
            let step = if self.locked(a) { -half } else { half };
            let both = self.locked(a) && self.locked(b);
            return Candidate { step, cost: if both { f64::INFINITY } else { q.value(step) } };
        }
        options.policies.placement.on_edge(q, half)
    }

    /// What an edge's collapse costs, [`REFUSED`] at most.
    #[inline(always)]
    pub fn cost(&self, around: &impl Around, a: u32, b: u32, options: &Options) -> f32 {
        at_most_refused(self.pieces.price(a, settled::<S>(self.candidate(around, a, b, options).cost as f32)))
    }

    /// Finds the pieces that the mesh falls into, of which `joined` says what is joined.
    pub fn find_pieces(&mut self, joined: Vec<u32>) {
        let mesh =
            IndexedMesh { positions: std::mem::take(&mut self.positions), faces: std::mem::take(&mut self.faces) };
        self.pieces = Pieces::find(&mesh, joined, |v| self.odd(v));
        (self.positions, self.faces) = (mesh.positions, mesh.faces);
    }

    /// The mesh as it is now, for a reference.
    pub fn reference(&self) -> Reference<S> {
        let mesh = IndexedMesh { positions: self.positions.clone(), faces: self.faces.clone() };
        Reference { mesh, homes: (0..self.positions.len() as u32).collect() }
    }

    /// Whether merging `a` and `b` at `x` would fold a face over. Faces without area may become anything.
    pub fn folds(&self, around: &impl Around, a: u32, b: u32, x: [S; 3], check: FoldCheck) -> bool {
        let folds_at = |v: u32, other: u32| {
            let at = self.positions[v as usize];
            around.of(v).iter().any(|&corner| {
                let (p, q) = self.ends(corner);
                if p == other || q == other {
                    return false;
                }
                let (p, q) = (self.positions[p as usize], self.positions[q as usize]);
                check.refuses(at, x, p, q)
            })
        };
        folds_at(a, b) || folds_at(b, a)
    }

    /// Whether so many faces are left that costs and current quadrics take much beside what was there at first.
    pub fn is_large(&self) -> bool {
        SMALL * self.faces.len() > self.faces_at_first
    }

    /// Gives back the memory of what has gone, before costs and current quadrics need theirs. Of large arrays nothing is
    /// copied for it.
    pub fn give_back(&mut self) {
        self.faces.shrink_to_fit();
        self.positions.shrink_to_fit();
        self.learnt.shrink_to_fit();
        self.wedges.corners.shrink_to_fit();
        self.shades.values.shrink_to_fit();
        self.marks.shrink_to_fit();
        self.pieces.of.shrink_to_fit();
        self.stars.give_back();
    }

    /// Remembers that the collapse of an edge was refused.
    pub fn refuse(&mut self, a: u32, b: u32) {
        for &corner in self.stars.of(a) {
            let (f, side) = parts(corner);
            let face = self.faces[f];
            for (from, u) in [(side, face[after(side)]), (before(side), face[before(side)])] {
                if u == b && self.costs[f][from] < REFUSED {
                    self.costs[f][from] = REFUSED;
                }
            }
        }
    }

    /// Where a merged vertex goes, as it will be stored: at an end exactly where that is the policy.
    pub fn spot(&self, a: u32, b: u32, step: DVec3, options: &Options) -> [S; 3] {
        if let Some(spot) = self.at_seam(&[a, b]).then(|| self.seam_spot(a, b)).flatten() {
            return spot;
        }
        if options.locks() && (self.locked(a) || self.locked(b)) {
            return self.positions[if self.locked(a) { a } else { b } as usize];
        }
        if options.policies.placement == Placement::Endpoint {
            return self.positions[if step.dot(self.at(b) - self.at(a)) > 0.0 { b } else { a } as usize];
        }
        narrow(0.5 * (self.at(a) + self.at(b)) + step)
    }
}

/// In doubles costs are multiples of this share of what an edge's planes would cost if they stood across it: less is what
/// the quadrics, kept in singles, round off.
pub(super) const STEP: f64 = 1.0 / (1 << 24) as f64;

/// Bits of a cost in singles that do not count in doubles. On models with many edges alike (a sphere by latitude and longitude,
/// CT surfaces) none, or 6 with twice the step, leave ties to rounding; 13 with sixteen times the step put scans apart
/// again that differ in the last bits of their doubles, by edges that are no ties.
const DROPPED: u32 = 8;

/// A cost without what is below rounding, of at most `most`. Edges that are alike then cost the same, wherever the scan lies;
/// which of them goes first is left to their hash.
#[inline(always)]
fn above_rounding(cost: f64, most: f64) -> f64 {
    let most = STEP * (1u64 << 52) as f64 * most;
    (cost + most) - most
}

/// A cost, or [`REFUSED`] for one that is no number below it.
#[inline(always)]
pub(super) fn at_most_refused(cost: f32) -> f32 {
    if cost < REFUSED { cost } else { REFUSED }
}

/// A cost to as many bits as count.
#[inline(always)]
pub(super) fn settled<S: Coordinate>(cost: f32) -> f32 {
    match S::DOUBLE {
        true => f32::from_bits((cost.to_bits() + (1 << (DROPPED - 1))) >> DROPPED << DROPPED),
        false => cost,
    }
}

/// Whether a normal has turned further than a face may. Squares of small areas need the range of doubles.
#[inline(always)]
pub(super) fn turned(was: Vec3, would: Vec3) -> bool {
    let (was, would) = (was.as_dvec3(), would.as_dvec3());
    let dot = was.dot(would);
    let (was_sq, would_sq) = (was.length_squared(), would.length_squared());
    was_sq > 0.0 && (dot <= 0.0 || dot * dot < LEAST_COSINE * LEAST_COSINE * was_sq * would_sq)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    const SIDE: u32 = 5;
    /// In the middle of [`bumps`], and its neighbours.
    pub(in crate::collapse) const MIDDLE: u32 = 12;
    pub(in crate::collapse) const NEIGHBOURS: [u32; 6] = [6, 7, 11, 13, 17, 18];

    /// A grid of five by five vertices that are not in a plane.
    pub(in crate::collapse) fn bumps<S: Coordinate>() -> Surface<S> {
        let at =
            |v: u32| DVec3::new(f64::from(v % SIDE), f64::from(v / SIDE), f64::from(v * v * 7 % 11) / 22.0) * 0.125;
        let positions = (0..SIDE * SIDE).map(|v| narrow(at(v))).collect();
        let square = |v: u32| [[v, v + 1, v + SIDE + 1], [v, v + SIDE + 1, v + SIDE]];
        let corners = (0..SIDE * (SIDE - 1)).filter(|v| v % SIDE + 1 < SIDE);
        let mesh = IndexedMesh { positions, faces: corners.flat_map(square).collect() };
        let mut surface = Surface::new(mesh, None, Shades::default(), Wedges::default());
        surface.stars.rebuild(&surface.faces, surface.positions.len());
        surface.learn(&Options::to(1));
        surface
    }
}
