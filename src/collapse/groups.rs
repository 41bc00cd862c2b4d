//! Far from the target: a batch of groups, each a pair of vertices and those that follow them.
//!
//! Where the order of collapses hardly matters, more than an edge can go at a time: every vertex looks for its cheapest edge;
//! two that prefer one another lead a group, and those follow who prefer one of the two, or one who follows. That moves four
//! vertices in five in one turn, with one look at each edge; a matching takes three turns to move nine in ten of half as
//! many. Edges are ranked by what their ends have learnt, without current quadrics and without keeping any cost.

use super::batch::{Batch, NONE, hash};
use super::surface::Surface;
use super::{Options, Stride};
use crate::mesh::Coordinate;
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

/// Chooses groups as large as `stride` allows.
pub(super) fn select<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>, stride: Stride, options: &Options) {
    batch.begin(surface.positions.len(), NONE);
    let costs = prefer(batch, surface, options.locks());
    let free = costs.par_iter().with_min_len(4096).filter(|cost| cost.is_finite()).count();
    let limit = super::limit(&costs, (stride.share * free as f64) as u64);
    let limit = options.part.map_or(limit, |part| limit.min(part.most_cost));
    follow(batch, &costs, limit, stride.longest);
    drop(costs);
    settle(batch, surface);
    batch.take_back_folds(surface, 1);
}

/// Every vertex looks for its cheapest edge, where some are locked to one that is not. Returns what it costs.
fn prefer<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>, locks: bool) -> Vec<f32> {
    let mut costs = vec![f32::INFINITY; surface.positions.len()];
    batch.next.par_iter_mut().zip(&mut costs).enumerate().with_min_len(1024).for_each(|(v, (best, cost))| {
        let v = v as u32;
        let is_locked = |v: u32| locks && surface.locked(v);
        if surface.pieces.is_small(v) || is_locked(v) {
            return;
        }
        let mut least = (u64::MAX, NONE);
        // Where faces agree, each neighbour comes first in one of them. The body is there once, so that it stays a loop.
        for way in 0..=usize::from(surface.odd(v)) {
            for &corner in surface.stars.of(v) {
                let (p, q) = surface.ends(corner);
                let u = if way == 0 { p } else { q };
                if is_locked(u) {
                    continue;
                }
                let cost = surface.rank(v, u);
                let key = u64::from(cost.to_bits()) << 32 | u64::from(hash(v.min(u), v.max(u)));
                least = if key < least.0 { (key, u) } else { least };
            }
        }
        // All around are locked.
        if least.1 == NONE {
            return;
        }
        *best.get_mut() = least.1;
        *cost = f32::from_bits((least.0 >> 32) as u32);
    });
    costs
}

/// Who follows whom, among those whose cheapest edge is not above `limit`: from preference to preference, costs fall, until
/// two prefer one another.
fn follow<S: Coordinate>(batch: &mut Batch<S>, costs: &[f32], limit: f32, longest: usize) {
    let (next, leaders) = (&batch.next, &batch.leaders);
    let prefers = |v: u32| next[v as usize].load(Relaxed);
    leaders.par_iter().zip(costs).enumerate().with_min_len(4096).for_each(|(v, (leader, &cost))| {
        let (mut v, mut u) = (v as u32, prefers(v as u32));
        if cost > limit {
            return;
        }
        for _ in 0..=longest {
            let w = prefers(u);
            if w == v {
                leader.store(u.min(v), Relaxed);
                return;
            }
            (v, u) = (u, w);
        }
    });
    // The groups as rings. Leaders are in before those who follow.
    for v in 0..leaders.len() as u32 {
        if batch.leader(v) == v {
            *batch.next[v as usize].get_mut() = v;
        }
    }
    for v in 0..batch.leaders.len() as u32 {
        let leader = batch.leader(v);
        if leader != NONE && leader != v {
            let after = std::mem::replace(batch.next[leader as usize].get_mut(), v);
            *batch.next[v as usize].get_mut() = after;
        }
    }
}

/// Finds each group's place.
fn settle<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>) {
    let mut spots = std::mem::take(&mut batch.spots);
    let this = &*batch;
    spots.par_iter_mut().enumerate().with_min_len(1024).for_each_init(Vec::new, |members, (v, spot)| {
        if this.leader(v as u32) == v as u32 {
            this.members(v as u32, members);
            *spot = this.place(surface, members);
        }
    });
    batch.spots = spots;
}
