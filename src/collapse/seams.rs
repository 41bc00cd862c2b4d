//! Seams: edges at which texture coordinates, hard normals, materials or groups break off (thesis §3.6, §5.4).
//!
//! The mesh that collapses is welded; what lies on either side of a seam is told by the wedges at the corners of faces.
//! When two vertices merge, so do their wedges on each face that both have; all others stay apart, so that no face ever
//! sees what belongs to the other side. Seam edges are contours, held by lines as borders are. A vertex on a seam moves
//! along it, merging only with the next one; others merge with it where it is. Where seams meet, end, or reach a border, a
//! vertex stays. No chart is squeezed to nothing.
//!
//! Where a count cannot be reached like this, seams give way in the end: their vertices merge like others, and faces keep
//! what they have.

use super::Options;
use super::place::best;
use super::policy::Placement;
use super::surface::{Around, Candidate, LOCKED, SEAM, Surface};
use crate::cores::InPieces;
use crate::mesh::Coordinate;
use crate::quadric::Quadric;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

impl<S: Coordinate> Surface<S> {
    /// Whether corners have wedges.
    #[inline(always)]
    pub fn is_seamed(&self) -> bool {
        !self.wedges.is_empty()
    }

    /// Whether seams are held.
    #[inline(always)]
    pub fn holds_seams(&self) -> bool {
        self.is_seamed() && !self.seams_give_way
    }

    /// Whether one of these vertices is on a seam that is held.
    #[inline(always)]
    pub fn at_seam(&self, vertices: &[u32]) -> bool {
        self.holds_seams() && vertices.iter().any(|&v| self.mark(v) & SEAM != 0)
    }

    fn on_seam(&self, v: u32) -> bool {
        self.mark(v) & SEAM != 0
    }

    fn stays(&self, v: u32) -> bool {
        self.mark(v) & LOCKED != 0
    }

    /// The wedges of `a` and `b` at the faces that have both, each pair once.
    pub fn wedge_pairs(&self, around: &impl Around, a: u32, b: u32) -> Vec<(u32, u32)> {
        let mut pairs = Vec::with_capacity(2);
        for f in self.shared(around, a, b) {
            let at = |v: u32| {
                let side = self.faces[f as usize].iter().position(|u| *u == v).unwrap_or(0);
                self.wedges.corners[f as usize][side]
            };
            let pair = (at(a), at(b));
            if !pairs.contains(&pair) {
                pairs.push(pair);
            }
        }
        pairs
    }

    /// Whether the faces at an edge see different things there.
    pub fn is_seam(&self, around: &impl Around, a: u32, b: u32) -> bool {
        self.wedge_pairs(around, a, b).len() > 1
    }

    /// Marks the vertices on seams, and as locked those where seams meet, end or reach a border. Needs to know what is odd.
    pub fn mark_seams(&self) {
        if !self.is_seamed() {
            return;
        }
        (0..self.positions.len() as u32).into_par_iter().in_pieces(1024).for_each(|v| {
            let seams =
                self.neighbours(&self.stars, v).into_iter().filter(|&u| self.is_seam(&self.stars, v, u)).count();
            let stays = if seams == 2 && !self.odd(v) { 0 } else { LOCKED };
            if seams > 0 {
                self.marks[v as usize].fetch_or(SEAM | stays, Relaxed);
            }
        });
    }

    /// The place for the vertex that `a` and `b` become, one of which is on a seam: on it.
    pub fn seam_candidate(&self, around: &impl Around, a: u32, b: u32, q: &Quadric, half: DVec3) -> Candidate {
        let never = Candidate { step: DVec3::ZERO, cost: f64::INFINITY };
        if self.stays(a) && self.stays(b) {
            return never;
        }
        match (self.on_seam(a), self.on_seam(b)) {
            (true, true) if !self.is_seam(around, a, b) => never,
            (true, false) if self.stays(b) => never,
            (false, true) if self.stays(a) => never,
            (true, true) if !self.stays(a) && !self.stays(b) => Placement::Line.on_edge(q, half),
            (of_a, of_b) => best(q, [if of_a && (!of_b || self.stays(a)) { -half } else { half }]),
        }
    }

    /// Where such a vertex goes, as it will be stored: where one of the two is, if that is where it has to be.
    pub fn seam_spot(&self, a: u32, b: u32) -> Option<[S; 3]> {
        match (self.on_seam(a), self.on_seam(b), self.stays(a), self.stays(b)) {
            (true, true, false, false) => None,
            (true, true, true, _) | (true, false, ..) => Some(self.positions[a as usize]),
            _ => Some(self.positions[b as usize]),
        }
    }

    /// Whether merging `a` and `b` leaves seams what they are.
    pub fn keeps_seams(&self, around: &impl Around, a: u32, b: u32) -> bool {
        if !self.at_seam(&[a, b]) {
            return true;
        }
        if self.stays(a) && self.stays(b) {
            return false;
        }
        if !(self.on_seam(a) && self.on_seam(b)) {
            return !self.stays(if self.on_seam(a) { b } else { a });
        }
        // Along the seam, and none of the faces that go is all that is left of a chart between two seams.
        let squeezed = |f: u32| {
            let apex = self.faces[f as usize].into_iter().find(|v| *v != a && *v != b);
            apex.is_some_and(|c| self.is_seam(around, a, c) && self.is_seam(around, b, c))
        };
        let of_b = self.neighbours(around, b);
        let common = self.neighbours(around, a).into_iter().filter(|u| of_b.binary_search(u).is_ok()).count();
        self.is_seam(around, a, b)
            && common <= self.shared(around, a, b).count()
            && !self.shared(around, a, b).any(squeezed)
    }

    /// The lines of the seams at `v`.
    pub fn seams_at(&self, around: &impl Around, v: u32, options: &Options) -> Quadric {
        if !self.on_seam(v) {
            return Quadric::default();
        }
        let seams = self.neighbours(around, v).into_iter().filter(|&u| self.on_seam(u) && self.is_seam(around, v, u));
        seams.fold(Quadric::default(), |q, u| q + options.policies.border_line(self.at(u) - self.at(v)))
    }

    /// The line of one edge, if it is a seam.
    pub fn seam_line(&self, around: &impl Around, a: u32, b: u32, options: &Options) -> Option<Quadric> {
        let is = self.on_seam(a) && self.on_seam(b) && self.is_seam(around, a, b);
        is.then(|| options.policies.border_line(self.at(b) - self.at(a)))
    }
}
