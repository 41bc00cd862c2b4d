//! Face contraction (thesis §3.8): the three corners of a face become one vertex.
//!
//! Groups contract more than faces far from the target anyway; from ten times the target on, and at least the last
//! [`SERIAL_FACES`](super::SERIAL_FACES), faces go one at a time from a heap. Edges finish what is fewer than a face's worth.

use super::LEARNT_WEIGHT;
use super::batch::order;
use super::forms::plane_through;
use super::place::{best, optimal};
use super::policy::{Placement, Quadrics};
use super::surface::{Around, Candidate};
use super::tail::Tail;
use crate::Result;
use crate::mesh::{Coordinate, narrow, widen};
use crate::progress::Progress;
use crate::quadric::Quadric;
use glam::DVec3;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// A face in the heap: its cost as bits, a tie-break, its number and corners.
type Entry = Reverse<(u32, u32, u32, [u32; 3])>;

impl<S: Coordinate> Tail<'_, S> {
    /// Contracts faces, the cheapest first, for as long as that does not go below the target.
    pub fn contract_faces(&mut self, progress: &Progress) -> Result<()> {
        let all = 0..self.surface.faces.len() as u32;
        let mut heap: BinaryHeap<Entry> = all.map(|f| self.face_entry(f)).collect();
        let mut turns = 0u32;
        while let Some(Reverse((cost, _, f, face))) = heap.pop() {
            turns = turns.wrapping_add(1);
            if turns.is_multiple_of(4096) {
                progress.check()?;
            }
            if self.surface.faces[f as usize] != face {
                continue;
            }
            let now = self.face_entry(f);
            if now.0.0 > cost {
                heap.push(now);
                continue;
            }
            let spot = self.face_spot(face);
            if self.left < self.options.target + self.vanishing(face) || !self.face_may_go(face, spot) {
                continue;
            }
            let merged = self.surface.merged(&face, widen(spot));
            self.error_sq = self.error_sq.max(if merged.w > 0.0 { merged.c / merged.w } else { 0.0 });
            self.merge(face[0], face[1], spot);
            self.merge(face[0], face[2], spot);
            let ring = self.surface.neighbours(&self.overlay, face[0]);
            self.renew(face[0], &ring);
            let around: Vec<u32> = self.overlay.of(face[0]).iter().map(|c| c >> 2).collect();
            heap.extend(around.into_iter().map(|f| self.face_entry(f)));
        }
        Ok(())
    }

    fn face_entry(&self, f: u32) -> Entry {
        let face = self.surface.faces[f as usize];
        let cost = self.surface.pieces.price(face[0], self.face_candidate(face).cost as f32);
        Reverse((cost.to_bits(), order(f, f).0, f, face))
    }

    /// Where the corners of a face would go, as it will be stored: at a corner exactly where that is the policy.
    fn face_spot(&self, face: [u32; 3]) -> [S; 3] {
        let surface = &*self.surface;
        let spot = surface.at(face[0]) + self.face_candidate(face).step;
        let off_sq = |v: &u32| surface.at(*v).distance_squared(spot);
        match face.into_iter().min_by(|a, b| off_sq(a).total_cmp(&off_sq(b))) {
            Some(v) if self.options.policies.placement == Placement::Endpoint => surface.positions[v as usize],
            _ => narrow(spot),
        }
    }

    /// Where the corners of a face would go, relative to the first, and what that would cost.
    fn face_candidate(&self, face: [u32; 3]) -> Candidate {
        let surface = &*self.surface;
        let at = surface.at(face[0]);
        let steps = face.map(|v| surface.at(v) - at);
        let middle = (steps[0] + steps[1] + steps[2]) / 3.0;
        let learnt = surface.merged(&face, at);
        let place = |q: &Quadric| match self.options.policies.placement {
            Placement::Optimal => optimal(q, middle, steps),
            Placement::Line | Placement::EndpointOrMidpoint => best(q, steps.into_iter().chain([middle])),
            Placement::Endpoint => best(q, steps),
        };
        match self.options.policies.quadrics {
            Quadrics::Accumulated => place(&learnt),
            Quadrics::Current => {
                let mut candidate = place(&self.current_of(face, at));
                candidate.cost += LEARNT_WEIGHT * learnt.value(candidate.step);
                candidate
            }
        }
    }

    /// The quadric, about `at`, of the faces that now meet at a face's corners, each once, and of the borders there.
    fn current_of(&self, face: [u32; 3], at: DVec3) -> Quadric {
        let surface = &*self.surface;
        let mut q = Quadric::default();
        let mut faces: Vec<u32> = face.iter().flat_map(|&v| self.overlay.of(v)).map(|c| c >> 2).collect();
        faces.sort_unstable();
        faces.dedup();
        for f in faces {
            let corner = surface.at(surface.faces[f as usize][0]);
            q += plane_through(surface.normal(f)).shifted(at - corner);
        }
        for v in face.into_iter().filter(|&v| surface.odd(v)) {
            q += surface.borders_at(&self.overlay, v, self.options).shifted(at - surface.at(v));
        }
        q
    }

    /// How many faces go when this one does: those with two and three of its corners.
    fn vanishing(&self, face: [u32; 3]) -> usize {
        let mut faces: Vec<u32> = face.iter().flat_map(|&v| self.overlay.of(v)).map(|c| c >> 2).collect();
        faces.sort_unstable();
        faces.chunk_by(|a, b| a == b).filter(|same| same.len() > 1).count()
    }

    /// Whether nothing folds over or is locked.
    fn face_may_go(&self, face: [u32; 3], spot: [S; 3]) -> bool {
        let surface = &*self.surface;
        if surface.at_seam(&face) || self.options.locks() && face.iter().any(|&v| surface.locked(v)) {
            return false;
        }
        let check = self.options.policies.fold_check;
        !face.iter().any(|&v| {
            self.overlay.of(v).iter().any(|&corner| {
                let (p, q) = surface.ends(corner);
                let [at, p_at, q_at] = [v, p, q].map(|u| surface.positions[u as usize]);
                !face.contains(&p) && !face.contains(&q) && check.refuses(at, spot, p_at, q_at)
            })
        })
    }
}
