//! Far from the target: a batch of groups, each a pair of vertices and those that follow them.
//!
//! Where the order of collapses hardly matters, more than an edge can go at a time: every vertex looks for its cheapest edge;
//! two that prefer one another lead a group, and those follow who prefer one of the two, or one who follows. That moves four
//! vertices in five in one turn, with one look at each edge. Nearer, where those who follow would cost closeness, it is a
//! matching as in [`pairs`](super::pairs): whoever is left looks again at who else is. Edges are ranked by what their ends have
//! learnt, without current quadrics and without keeping any cost.

use super::batch::{Batch, Edges, NONE, first_by_hash, hash};
use super::pairs::TURNS;
use super::rank::LANES;
use super::surface::Surface;
use super::{GROUPS_SHARE, Options};
use crate::cores::InPieces;
use crate::mesh::Coordinate;
use fearless_simd::{Level, Simd, dispatch, prelude::*, u32x8};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Chooses groups: of those at most `longest` steps from a pair that they follow, or pairs where that is 0.
pub(super) fn select<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>, longest: usize, options: &Options) {
    batch.begin(surface.positions.len(), NONE);
    let costs = prefer(batch, surface, options.locks());
    let free = costs.par_iter().in_pieces(4096).filter(|cost| cost.is_finite()).count();
    let limit = super::limit(&costs, (GROUPS_SHARE * free as f64) as u64);
    let limit = options.part.map_or(limit, |part| limit.min(part.most_cost));
    match longest {
        0 => pair(batch, surface, &costs, limit, options.locks()),
        longest => follow(batch, &costs, limit, longest),
    }
    drop(costs);
    settle(batch, surface);
    batch.take_back_folds(surface, 1);
}

/// Vertices that look together.
const LOOKING: usize = 256;

/// Every vertex looks for its cheapest edge, where some are locked to one that is not. Returns what it costs.
fn prefer<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>, locks: bool) -> Vec<f32> {
    let mut costs: Vec<f32> = bytemuck::zeroed_vec(batch.next.len());
    let looking = batch.next.par_chunks_mut(LOOKING).zip(costs.par_chunks_mut(LOOKING)).enumerate();
    looking.in_pieces(1).for_each(|(chunk, (best, costs))| {
        let first = (chunk * LOOKING) as u32;
        dispatch!(Level::new(), simd => look(simd, surface, locks, first, best, costs));
    });
    costs
}

/// Vertices from `first` on look for their cheapest edges.
#[inline(always)]
fn look<S: Coordinate, V: Simd>(
    simd: V,
    surface: &Surface<S>,
    locks: bool,
    first: u32,
    best: &mut [AtomicU32],
    costs: &mut [f32],
) {
    let is_locked = |v: u32| locks && surface.locked(v);
    let mut around = Around::default();
    for (v, (best, cost)) in (first..).zip(best.iter_mut().zip(costs)) {
        *cost = f32::INFINITY;
        if surface.pieces.is_small(v) || is_locked(v) {
            continue;
        }
        around.fill(surface, v);
        let (least, end) = (Ranked { simd, surface, v, around: &around, may: |u| !is_locked(u) }).cheapest(u32::MAX);
        // Else all around are locked.
        if end != NONE {
            *best.get_mut() = end;
            *cost = f32::from_bits(least);
        }
    }
}

/// The neighbours of a vertex.
#[derive(Default)]
struct Around {
    /// In lots of [`LANES`], the last of which is filled up.
    lots: Vec<[u32; LANES]>,
    count: usize,
}

impl Around {
    /// Those of `v`. Where faces agree, each comes first in one of them; else all are taken from both sides.
    #[inline(always)]
    fn fill<S: Coordinate>(&mut self, surface: &Surface<S>, v: u32) {
        let star = surface.stars.of(v);
        self.count = if surface.odd(v) { 2 * star.len() } else { star.len() };
        self.lots.resize(self.count.div_ceil(LANES), [v; LANES]);
        if let Some(last) = self.lots.last_mut() {
            *last = [v; LANES];
        }
        let all = self.lots.as_flattened_mut();
        for (to, &corner) in all.iter_mut().zip(star) {
            *to = surface.ends(corner).0;
        }
        if surface.odd(v) {
            for (to, &corner) in all[star.len()..].iter_mut().zip(star) {
                *to = surface.ends(corner).1;
            }
        }
    }
}

/// The edges at `v`, to neighbours that it may go with.
struct Ranked<'a, S, V, F> {
    simd: V,
    surface: &'a Surface<S>,
    v: u32,
    around: &'a Around,
    may: F,
}

impl<S: Coordinate, V: Simd, F: Fn(u32) -> bool> Ranked<'_, S, V, F> {
    /// What [`cheapest`] finds, among a lot at a time.
    #[inline(always)]
    fn cheapest(&self, most: u32) -> (u32, u32) {
        let (mut least, mut tied, mut those) = ((most, NONE), false, 0);
        for (lot, to) in self.around.lots.iter().enumerate() {
            let costs = u32x8::load_array(self.simd, self.costs(lot, to));
            let lowest = costs.reduce_min();
            those = costs.simd_eq(u32x8::splat(self.simd, lowest)).to_bitmask();
            tied = if lowest < least.0 { !those.is_power_of_two() } else { tied || lowest == least.0 };
            least = if lowest < least.0 { (lowest, to[those.trailing_zeros() as usize % LANES]) } else { least };
        }
        match self.around.lots.as_slice() {
            _ if !tied || least.1 == NONE => least,
            [to] => (least.0, first_of(self.v, to, those)),
            _ => (least.0, first_by_hash(self.v, least.0, self)),
        }
    }

    /// What a lot's edges cost, as bits; more than anything where none may be chosen.
    #[inline(always)]
    fn costs(&self, lot: usize, to: &[u32; LANES]) -> [u32; LANES] {
        let ranks = self.surface.ranks(self.simd, self.v, *to);
        let mut costs = [u32::MAX; LANES];
        for (i, (cost, rank)) in costs.iter_mut().zip(ranks).enumerate() {
            *cost = if lot * LANES + i < self.around.count && (self.may)(to[i]) { rank.to_bits() } else { u32::MAX };
        }
        costs
    }
}

impl<S: Coordinate, V: Simd, F: Fn(u32) -> bool> Edges for Ranked<'_, S, V, F> {
    #[inline(always)]
    fn each(&self, mut take: impl FnMut(u32, u32)) {
        for (lot, to) in self.around.lots.iter().enumerate() {
            self.costs(lot, to).into_iter().zip(to).for_each(|(cost, u)| take(cost, *u));
        }
    }
}

/// The first by hash of those neighbours of `v`, a bit each: what [`first_by_hash`] finds.
#[inline(always)]
fn first_of(v: u32, to: &[u32; LANES], mut those: u64) -> u32 {
    let mut first = (u32::MAX, NONE);
    while those != 0 {
        let u = to[those.trailing_zeros() as usize % LANES];
        those &= those - 1;
        first = first.min((hash(v.min(u), v.max(u)), u));
    }
    first.1
}

/// Who goes with whom, among those whose cheapest edge is not above `limit`: ends of edges that both prefer, in some turns.
/// The order of a group of two is what its members prefer.
fn pair<S: Coordinate>(batch: &Batch<S>, surface: &Surface<S>, costs: &[f32], limit: f32, locks: bool) {
    let (next, leaders) = (&batch.next, &batch.leaders);
    let prefers = |v: u32| next[v as usize].load(Relaxed);
    let take = |v: u32| {
        let u = prefers(v);
        if v < u && u != NONE && prefers(u) == v {
            [v, u].into_iter().for_each(|member| leaders[member as usize].store(v, Relaxed));
        }
    };
    let is_left = |v: &u32| !batch.moves(*v) && prefers(*v) != NONE;
    let within = (0..costs.len() as u32).into_par_iter().in_pieces(4096).filter(|v| costs[*v as usize] <= limit);
    within.clone().for_each(take);
    let mut left: Vec<u32> = within.filter(is_left).collect();
    for _ in 1..TURNS {
        left.par_chunks(LOOKING).in_pieces(1).for_each(|vertices| {
            dispatch!(Level::new(), simd => look_again(simd, batch, surface, locks, vertices, limit));
        });
        left.par_iter().in_pieces(4096).for_each(|v| take(*v));
        left = left.into_par_iter().in_pieces(4096).filter(is_left).collect();
    }
}

/// Those of `vertices` who prefer somebody who has gone with another look for somebody else.
#[inline(always)]
fn look_again<S: Coordinate, V: Simd>(
    simd: V,
    batch: &Batch<S>,
    surface: &Surface<S>,
    locks: bool,
    vertices: &[u32],
    limit: f32,
) {
    let may = |u: u32| !(batch.moves(u) || locks && surface.locked(u));
    let mut around = Around::default();
    for &v in vertices {
        let best = &batch.next[v as usize];
        if batch.moves(best.load(Relaxed)) {
            around.fill(surface, v);
            let ranked = Ranked { simd, surface, v, around: &around, may };
            best.store(ranked.cheapest(limit.to_bits() + 1).1, Relaxed);
        }
    }
}

/// Who follows whom, among those whose cheapest edge is not above `limit`: from preference to preference, costs fall, until
/// two prefer one another.
fn follow<S: Coordinate>(batch: &mut Batch<S>, costs: &[f32], limit: f32, longest: usize) {
    let (next, leaders) = (&batch.next, &batch.leaders);
    let prefers = |v: u32| next[v as usize].load(Relaxed);
    leaders.par_iter().zip(costs).enumerate().in_pieces(4096).for_each(|(v, (leader, &cost))| {
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
    // The groups as rings, in whatever order. Leaders are in before those who follow.
    batch.next.par_iter_mut().zip(leaders).enumerate().in_pieces(4096).for_each(|(v, (next, leader))| {
        if leader.load(Relaxed) == v as u32 {
            *next.get_mut() = v as u32;
        }
    });
    let (next, leaders) = (&batch.next, &batch.leaders);
    next.par_iter().zip(leaders).enumerate().in_pieces(4096).for_each(|(v, (after, leader))| {
        let (v, leader) = (v as u32, leader.load(Relaxed));
        if leader != NONE && leader != v {
            after.store(next[leader as usize].swap(v, Relaxed), Relaxed);
        }
    });
}

/// Puts each group in order and finds its place.
fn settle<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>) {
    let mut spots = std::mem::take(&mut batch.spots);
    let this = &*batch;
    spots.par_chunks_mut(LOOKING).enumerate().in_pieces(1).for_each(|(chunk, spots)| {
        let first = (chunk * LOOKING) as u32;
        dispatch!(Level::new(), simd => settle_some(simd, this, surface, first, spots));
    });
    batch.spots = spots;
}

/// The same of those groups whose leaders are numbered from `first` on.
#[inline(always)]
fn settle_some<S: Coordinate, V: Simd>(_: V, batch: &Batch<S>, surface: &Surface<S>, first: u32, spots: &mut [[S; 3]]) {
    let mut members = Vec::new();
    for (v, spot) in (first..).zip(spots) {
        if batch.leader(v) == v {
            batch.members(v, &mut members);
            if members.len() > 2 {
                members[1..].sort_unstable();
                batch.link(&members);
            }
            *spot = batch.place(surface, &members);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collapse::batch::cheapest;
    use crate::collapse::surface::tests::bumps;
    use crate::vectors::levels;

    #[test]
    fn a_lot_at_a_time_finds_what_one_at_a_time_does() {
        // On a plane all edges cost nothing, and hashes decide.
        let mut flat = bumps::<f32>();
        flat.positions.iter_mut().for_each(|p| p[2] = 0.0);
        flat.learn(&Options::to(0));
        for surface in [bumps::<f32>(), flat] {
            for (v, level) in
                (0..surface.positions.len() as u32).flat_map(|v| levels().into_iter().map(move |l| (v, l)))
            {
                let mut around = Around::default();
                around.fill(&surface, v);
                for (most, every) in [(u32::MAX, 1), (u32::MAX, 2), (1e-4f32.to_bits(), 1), (0, 1)] {
                    dispatch!(level, simd => {
                        let may = |u: u32| u.is_multiple_of(every);
                        let ranked = Ranked { simd, surface: &surface, v, around: &around, may };
                        assert_eq!(ranked.cheapest(most), cheapest(v, most, &ranked), "{v} {every}");
                    });
                }
            }
        }
    }

    #[test]
    fn those_left_over_pair_up_among_themselves() {
        let surface = bumps::<f32>();
        let vertices = 0..surface.positions.len() as u32;
        let mut batch = Batch::new();
        batch.begin(vertices.len(), NONE);
        let costs = prefer(&mut batch, &surface, false);
        let next = |v: u32| batch.next[v as usize].load(Relaxed);
        let at_once = vertices.clone().filter(|&v| next(next(v)) == v).count();
        pair(&batch, &surface, &costs, f32::MAX, false);
        let moving: Vec<u32> = vertices.filter(|&v| batch.moves(v)).collect();
        for &v in &moving {
            let u = batch.next_of(v);
            assert_eq!((batch.next_of(u), batch.leader(v), batch.leader(u)), (v, v.min(u), v.min(u)));
            assert!(surface.shared(&surface.stars, v, u).count() > 0, "{v} {u} have no edge");
        }
        assert!(at_once > 0 && moving.len() > at_once, "{at_once} {}", moving.len());
    }
}
