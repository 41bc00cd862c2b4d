//! Near the target: a batch of pairs, the ends of edges.
//!
//! The batch is a matching: no vertex is in two of its collapses. It is found as the sequential algorithm would find it,
//! taking edges from the cheapest up and skipping those with a vertex already taken, but in parallel: an edge that is the
//! cheapest at *both* its ends would be taken before any of its neighbours, so all such edges are taken at once, and again
//! among what is left. Each turn is a function of the one before, so threads cannot change it.
//!
//! Each collapse is checked alone against the round's geometry as it is taken; how they fold faces together is the
//! batch's to see.

use super::Options;
use super::batch::{Batch, Edges, NONE, cheapest};
use super::check::take_back_neighbours;
use super::policy::{FoldCheck, Topology};
use super::surface::Surface;
use crate::cores::InPieces;
use crate::mesh::adjacency::{after, before, parts};
use crate::mesh::{Coordinate, widen};
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

/// A preference that must be looked for.
const ASK: u32 = u32::MAX - 1;

/// Turns of a matching in one round. On a scan of 1.2 M faces they took 70, 25 and 5 % of a batch; a fourth would add 1 %.
pub(super) const TURNS: usize = 3;

/// Chooses pairs among the edges of at most `limit`; costs of refused collapses are marked as such.
pub(super) fn select<S: Coordinate>(batch: &mut Batch<S>, surface: &mut Surface<S>, limit: f32, options: &Options) {
    batch.begin(surface.positions.len(), ASK);
    for turn in 0..TURNS {
        if turn == 0 {
            prefer(batch, surface, limit, |_, _| true);
        } else {
            prefer(batch, surface, limit, |leaders, v| leaders[v as usize].load(Relaxed) == NONE);
        }
        let (taken, refused) = take(batch, surface, options);
        for &(v, u) in &refused {
            surface.refuse(v, u);
        }
        if taken + refused.len() == 0 {
            break;
        }
    }
    if options.policies.topology == Topology::Preserve {
        take_back_neighbours(batch, surface);
    }
    if options.policies.fold_check != FoldCheck::Off {
        batch.take_back_folds(surface, 2);
    }
}

/// Every free vertex looks for its cheapest edge to a free vertex, unless the one it found before still stands.
fn prefer<S: Coordinate>(
    batch: &mut Batch<S>,
    surface: &Surface<S>,
    limit: f32,
    is_free: impl Fn(&[std::sync::atomic::AtomicU32], u32) -> bool + Sync,
) {
    let leaders = &batch.leaders;
    let free = |v: u32| is_free(leaders, v);
    batch.next.par_iter_mut().enumerate().in_pieces(256).for_each(|(v, best)| {
        let (v, best) = (v as u32, best.get_mut());
        if *best == NONE || !free(v) || *best != ASK && free(*best) {
            return;
        }
        *best = cheapest(v, limit.to_bits() + 1, &Kept { surface, v, free }).1;
    });
}

/// Takes every edge that both its ends prefer and whose collapse folds nothing; the ends of one that does will look
/// again. Returns how many were taken and which were refused.
fn take<S: Coordinate>(batch: &mut Batch<S>, surface: &Surface<S>, options: &Options) -> (usize, Vec<(u32, u32)>) {
    let (best, leaders) = (&batch.next, &batch.leaders);
    let prefers = |v: u32, u: u32| best[v as usize].load(Relaxed) == u;
    let free = |v: u32| leaders[v as usize].load(Relaxed) == NONE;
    batch
        .spots
        .par_iter_mut()
        .enumerate()
        .in_pieces(256)
        .fold(
            || (0, Vec::new()),
            |(taken, mut refused), (v, spot)| {
                let (v, u) = (v as u32, best[v].load(Relaxed));
                if u == NONE || u == ASK || v > u || !prefers(u, v) || !free(v) {
                    return (taken, refused);
                }
                let candidate = surface.candidate(&surface.stars, v, u, options);
                *spot = surface.spot(v, u, candidate.step, options);
                let admitted = admissible(surface, v, u, *spot, options);
                for x in [v, u] {
                    if admitted {
                        leaders[x as usize].store(v, Relaxed);
                    } else {
                        best[x as usize].store(ASK, Relaxed);
                    }
                }
                if !admitted {
                    refused.push((v, u));
                }
                (taken + usize::from(admitted), refused)
            },
        )
        .reduce(
            || (0, Vec::new()),
            |(n, mut a), (m, b)| {
                a.extend(b);
                (n + m, a)
            },
        )
}

/// The edges at `v` to what is free.
struct Kept<'a, S, F> {
    surface: &'a Surface<S>,
    v: u32,
    free: F,
}

impl<S: Coordinate, F: Fn(u32) -> bool> Edges for Kept<'_, S, F> {
    #[inline(always)]
    fn each(&self, mut take: impl FnMut(u32, u32)) {
        for &corner in self.surface.stars.of(self.v) {
            let (f, i) = parts(corner);
            let (face, costs) = (&self.surface.faces[f], &self.surface.costs[f]);
            for (cost, u) in [(costs[i], face[after(i)]), (costs[before(i)], face[before(i)])] {
                take(if (self.free)(u) { cost.to_bits() } else { u32::MAX }, u);
            }
        }
    }
}

/// Whether a collapse keeps the error bound and folds nothing over.
fn admissible<S: Coordinate>(surface: &Surface<S>, a: u32, b: u32, x: [S; 3], options: &Options) -> bool {
    if options.max_error < f64::INFINITY {
        let learnt = surface.merged(&[a, b], widen(x));
        if learnt.c > options.max_error * options.max_error * learnt.w {
            return false;
        }
    }
    !surface.folds(&surface.stars, a, b, x, options.policies.fold_check)
        && surface.allows(&surface.stars, a, b, options)
}
