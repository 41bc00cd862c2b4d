//! Samples of the mesh that is held, each with the least squared distance met so far, while the other mesh streams past.
//!
//! They lie in a tree of boxes of which every link also knows the largest distance below it. Faces that come by look only
//! at leaves where somebody is farther from all that has been seen than the faces might be. A least distance is the same
//! whatever the order in which faces come, and a largest one that is out of date is too large, which costs time and nothing
//! else: so workers need no locks.
//!
//! **Memory** ([`Probes::bytes`], [`Probes::build_bytes`]): 36 bytes a probe and about 5.2 for the tree; while it is
//! built, 40 more.

use super::patch::{Part, Patch};
use crate::mesh::boxes::{Aabb, Boxes, Item, Lanes, NOTHING, Node, Origin, leaf_of, loosen};
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering::Relaxed};

/// Probes a leaf.
const LEAF: usize = 8;

/// Points whose nearest distance is looked for.
pub(super) struct Probes {
    origin: Origin,
    /// Of the mesh that they lie on.
    area: f64,
    boxes: Boxes<LEAF>,
    /// Beside each node: the largest bound below each link, as bits of a loosened single.
    bounds: Vec<[AtomicU32; 4]>,
    positions: Vec<DVec3>,
    /// What each probe was numbered when it was given.
    ids: Vec<u32>,
    /// Bits of the least squared distance so far: those of doubles that are not negative are in the doubles' order.
    best: Vec<AtomicU64>,
}

impl Probes {
    /// Probes at these points, which are spread over an area and numbered as they come.
    pub(super) fn new(points: Vec<DVec3>, area: f64, origin: Origin) -> Self {
        let item = |(id, p): (usize, &DVec3)| Item { at: origin.about(*p), id: id as u32 };
        let mut items: Vec<Item> = points.par_iter().enumerate().map(item).collect();
        let pad = Vec3::splat(origin.pad());
        let boxes = Boxes::build(&mut items, |item| Aabb { min: item.at - pad, max: item.at + pad });
        let positions = items.iter().map(|item| points[item.id as usize]).collect();
        let ids = items.iter().map(|item| item.id).collect();
        let bounds = boxes.nodes().iter().map(|_| Default::default()).collect();
        let best = points.iter().map(|_| AtomicU64::new(f64::INFINITY.to_bits())).collect();
        Probes { origin, area, boxes, bounds, positions, ids, best }
    }

    /// The area for each probe.
    pub(super) fn spacing_sq(&self) -> f64 {
        self.area / (self.positions.len() as f64).max(1.0)
    }

    /// Each probe's number, place and least squared distance.
    pub(super) fn results(&self) -> impl Iterator<Item = (u32, DVec3, f64)> + '_ {
        let best = self.best.iter().map(|best| f64::from_bits(best.load(Relaxed)));
        self.ids.iter().zip(&self.positions).zip(best).map(|((id, p), best)| (*id, *p, best))
    }

    /// Begins with a distance that the other mesh is known not to be beyond: that to the nearest of some points on it.
    /// Gives up where `goes_on` says so.
    pub(super) fn begin_with(&mut self, points: &Points, goes_on: impl Fn() -> bool + Sync) {
        const RUN: usize = 1024;
        self.positions.par_chunks(RUN).zip(self.best.par_chunks(RUN)).for_each(|(positions, best)| {
            if !goes_on() {
                return;
            }
            let mut last = 0;
            for (p, best) in positions.iter().zip(best) {
                let (nearest, distance_sq) = points.nearest(self.origin.about(*p), last);
                last = nearest;
                // What is met later is measured better than these points are kept; it must not be beaten by a rounding.
                let beyond = distance_sq.sqrt() * (1.0 + 1e-6) + 4.0 * f64::from(self.origin.pad());
                best.store((beyond * beyond).to_bits(), Relaxed);
            }
        });
        self.bound_all();
    }

    /// Works out all bounds afresh, from the last node, which leads to leaves only, to the first.
    fn bound_all(&self) {
        for (node, bounds) in self.boxes.nodes().iter().zip(&self.bounds).rev() {
            for (link, bound) in node.links.into_iter().zip(bounds) {
                let largest = match leaf_of(link) {
                    _ if link == NOTHING => 0.0,
                    Some(leaf) => self.farthest(self.boxes.items_of(leaf)),
                    None => self.largest(link as usize),
                };
                bound.store(largest.to_bits(), Relaxed);
            }
        }
    }

    #[inline(always)]
    fn best(&self, probe: usize) -> f64 {
        f64::from_bits(self.best[probe].load(Relaxed))
    }

    /// The largest bound in a leaf.
    #[inline(always)]
    fn farthest(&self, probes: Range<usize>) -> f32 {
        loosen(probes.map(|probe| self.best(probe)).fold(0.0, f64::max))
    }

    /// The largest bound below a node.
    #[inline(always)]
    fn largest(&self, node: usize) -> f32 {
        self.bounds[node].iter().map(|bound| f32::from_bits(bound.load(Relaxed))).fold(0.0, f32::max)
    }

    /// Measures the faces of a patch.
    pub(super) fn meet(&self, patch: &Patch) {
        if self.positions.is_empty() {
            return;
        }
        patch.compact_parts(&mut |part| {
            self.meet_below(0, patch, part, &Lanes::from(patch.around(part)));
        });
    }

    /// Returns the largest bound that is left below a node.
    fn meet_below(&self, node: usize, patch: &Patch, part: Part, around: &Lanes) -> f32 {
        let Node { boxes, links } = &self.boxes.nodes()[node];
        let gaps = boxes.gaps_sq(around);
        for ((gap, link), bound) in gaps.iter().zip(links).zip(&self.bounds[node]) {
            let before = f32::from_bits(bound.load(Relaxed));
            if *gap > before || *link == NOTHING {
                continue;
            }
            let after = match leaf_of(*link) {
                Some(leaf) => self.meet_leaf(self.boxes.items_of(leaf), patch, part),
                None => self.meet_below(*link as usize, patch, part, around),
            };
            if after < before {
                bound.store(after.to_bits(), Relaxed);
            }
        }
        self.largest(node)
    }

    fn meet_leaf(&self, probes: Range<usize>, patch: &Patch, part: Part) -> f32 {
        let around = patch.around(part);
        for probe in probes.clone() {
            let (p, before) = (self.positions[probe], self.best(probe));
            let at = self.origin.about(p);
            if around.gap_sq(at) > loosen(before) {
                continue;
            }
            let after = patch.nearest(part, p, &Lanes::from(Aabb::at(at)), before);
            if after < before {
                self.best[probe].fetch_min(after.to_bits(), Relaxed);
            }
        }
        self.farthest(probes)
    }

    /// Bytes of so many probes.
    pub(super) const fn bytes(probes: u64) -> u64 {
        let nodes = Boxes::<LEAF>::bytes(probes);
        probes * 36 + nodes + nodes / size_of::<Node>() as u64 * 16
    }

    /// Bytes while they are made.
    pub(super) const fn build_bytes(probes: u64) -> u64 {
        Self::bytes(probes) + probes * 40
    }
}

/// Points of which the nearest is looked for, in single precision.
///
/// 12 bytes a point and about 4.7 for the tree; 16 more while it is built.
pub(super) struct Points {
    boxes: Boxes<LEAF>,
    positions: Vec<Vec3>,
}

impl Points {
    /// A tree of points, at least one.
    pub(super) fn new(points: Vec<Vec3>) -> Self {
        let item = |(id, at): (usize, &Vec3)| Item { at: *at, id: id as u32 };
        let mut items: Vec<Item> = points.par_iter().enumerate().map(item).collect();
        drop(points);
        let boxes = Boxes::build(&mut items, |item| Aabb::at(item.at));
        Points { boxes, positions: items.iter().map(|item| item.at).collect() }
    }

    /// A nearest point and its squared distance; the search begins at point `start`.
    fn nearest(&self, p: Vec3, start: usize) -> (usize, f64) {
        let distance_sq = |i: usize| f64::from((self.positions[i] - p).length_squared());
        let mut best = (start, distance_sq(start));
        self.boxes.search(Aabb::at(p), best.1, |points| {
            for i in points {
                let here = distance_sq(i);
                if here < best.1 {
                    best = (i, here);
                }
            }
            best.1
        });
        best
    }

    /// Bytes while they are made.
    pub(super) const fn build_bytes(points: u64) -> u64 {
        points * 28 + Boxes::<LEAF>::bytes(points)
    }
}
