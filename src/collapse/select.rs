//! One independent batch: which edges collapse together.
//!
//! A batch is a matching: no vertex is in two of its collapses. It is found as the sequential algorithm would find it,
//! taking edges from the cheapest up and skipping those with a vertex already taken, but in parallel: an edge that is the
//! cheapest at *both* its ends would be taken before any of its neighbours, so all such edges are taken at once, and again
//! among what is left. Each turn is a function of the one before, so threads cannot change it.
//!
//! Stars of neighbouring collapses overlap. Each collapse is checked alone against the round's geometry, then all faces
//! with two or more moving corners are checked with all of them moved; of the collapses at a face that folds over, one is
//! taken back (by a hash: any rule that threads cannot change will do), until none folds.

use super::Options;
use super::surface::{Surface, turned};
use crate::mesh::adjacency::{after, before, parts};
use crate::mesh::{Coordinate, step, widen};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// No vertex.
pub(super) const NONE: u32 = u32::MAX;

/// A preference that must be looked for.
const ASK: u32 = u32::MAX - 1;

/// Turns of the matching in one round. On a scan of 1.2 M faces they took 70, 25 and 5 % of a batch; a fourth would add 1 %.
const TURNS: usize = 3;

/// The arrays of one round, kept for the next: 8 bytes a vertex and a position.
pub(super) struct Batch<S> {
    /// The end of the cheapest edge; [`NONE`] or [`ASK`].
    best: Vec<AtomicU32>,
    /// The other end of the collapse that a vertex is in, or [`NONE`].
    mates: Vec<AtomicU32>,
    /// Where the collapse that a vertex leads puts it. A collapse is led by its lower end.
    spots: Vec<[S; 3]>,
}

/// A collapse of the batch: the lower end stays, the higher goes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pair {
    pub stays: u32,
    pub goes: u32,
}

impl<S: Coordinate> Batch<S> {
    /// No collapses.
    pub fn new() -> Self {
        Batch { best: Vec::new(), mates: Vec::new(), spots: Vec::new() }
    }

    /// Chooses a batch among the edges of at most `limit`; costs of refused collapses are marked as such.
    pub fn select(&mut self, surface: &mut Surface<S>, limit: f32, options: &Options) {
        let n = surface.positions.len();
        self.best.clear();
        self.best.resize_with(n, || AtomicU32::new(ASK));
        self.mates.clear();
        self.mates.resize_with(n, || AtomicU32::new(NONE));
        self.spots.resize(n, [S::narrow(0.0); 3]);
        for turn in 0..TURNS {
            if turn == 0 {
                self.prefer(surface, limit, |_, _| true);
            } else {
                self.prefer(surface, limit, |mates, v| mates[v as usize].load(Relaxed) == NONE);
            }
            let (taken, refused) = self.take(surface, options);
            for &(v, u) in &refused {
                surface.refuse(v, u);
            }
            if taken + refused.len() == 0 {
                break;
            }
        }
        self.take_back_folds(surface);
    }

    /// Every free vertex looks for its cheapest edge to a free vertex, unless the one it found before still stands.
    fn prefer(&mut self, surface: &Surface<S>, limit: f32, is_free: impl Fn(&[AtomicU32], u32) -> bool + Sync) {
        let mates = &self.mates;
        let free = |v: u32| is_free(mates, v);
        self.best.par_iter_mut().enumerate().with_min_len(1024).for_each(|(v, best)| {
            let (v, best) = (v as u32, best.get_mut());
            if *best == NONE || *best != ASK && free(v) && free(*best) {
                return;
            }
            *best = if free(v) { cheapest(surface, v, limit, free) } else { NONE };
        });
    }

    /// Takes every edge that both its ends prefer and whose collapse folds nothing; the ends of one that does will look
    /// again. Returns how many were taken and which were refused.
    fn take(&mut self, surface: &Surface<S>, options: &Options) -> (usize, Vec<(u32, u32)>) {
        let (best, mates) = (&self.best, &self.mates);
        let prefers = |v: u32, u: u32| best[v as usize].load(Relaxed) == u;
        self.spots
            .par_iter_mut()
            .enumerate()
            .with_min_len(1024)
            .fold(
                || (0, Vec::new()),
                |(taken, mut refused), (v, spot)| {
                    let (v, u) = (v as u32, best[v].load(Relaxed));
                    if u == NONE || u == ASK || v > u || !prefers(u, v) || mates[v as usize].load(Relaxed) != NONE {
                        return (taken, refused);
                    }
                    let candidate = surface.candidate(&surface.stars, v, u, options);
                    *spot = surface.spot(v, u, candidate.step);
                    let admitted = admissible(surface, v, u, *spot, options);
                    for (x, y) in [(v, u), (u, v)] {
                        if admitted {
                            mates[x as usize].store(y, Relaxed);
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

    /// The vertex that leads the collapse that `v` is in.
    #[inline(always)]
    fn leader(&self, v: u32) -> Option<u32> {
        let u = self.mates[v as usize].load(Relaxed);
        (u != NONE).then(|| u.min(v))
    }

    /// Takes collapses back until no face with two or more moving corners folds over.
    fn take_back_folds(&mut self, surface: &Surface<S>) {
        let faces = surface.faces.len() as u32;
        let mut back = self.folded_among(surface, (0..faces).into_par_iter().with_min_len(4096));
        while !back.is_empty() {
            let mut around = Vec::new();
            for leader in back {
                let mate = self.mates[leader as usize].load(Relaxed);
                for v in [leader, mate] {
                    if v != NONE {
                        self.mates[v as usize].store(NONE, Relaxed);
                        around.extend(surface.stars.of(v).iter().map(|c| c >> 2));
                    }
                }
            }
            // Only faces at a vertex that stays after all can have changed.
            back = self.folded_among(surface, around.into_par_iter());
        }
    }

    /// Leaders of collapses to take back: one for each face that the batch folds over, in order, once.
    fn folded_among(&self, surface: &Surface<S>, faces: impl ParallelIterator<Item = u32>) -> Vec<u32> {
        let mut back: Vec<u32> = faces.filter_map(|f| self.folded(surface, &surface.faces[f as usize])).collect();
        back.sort_unstable();
        back.dedup();
        back
    }

    /// If the batch folds `face` over: the leader of one of its collapses there.
    #[inline(always)]
    fn folded(&self, surface: &Surface<S>, face: &[u32; 3]) -> Option<u32> {
        let mates = face.map(|v| self.mates[v as usize].load(Relaxed));
        let moving = mates.iter().filter(|&&u| u != NONE).count();
        if moving < 2 || mates.iter().any(|u| face.contains(u)) {
            return None;
        }
        let was = face.map(|v| surface.positions[v as usize]);
        let mut would = was;
        let mut blamed = None;
        for i in 0..3 {
            if mates[i] != NONE {
                let leader = face[i].min(mates[i]);
                would[i] = self.spots[leader as usize];
                blamed = blamed.max(Some((hash(leader, leader), leader)));
            }
        }
        let normal = |p: [[S; 3]; 3]| step(p[0], p[1]).cross(step(p[0], p[2]));
        turned(normal(was), normal(would)).then_some(blamed?.1)
    }

    /// The collapses of the batch, by their leaders' order.
    pub fn pairs(&self) -> Vec<Pair> {
        self.mates
            .par_iter()
            .enumerate()
            .filter_map(|(v, mate)| {
                let u = mate.load(Relaxed);
                (u != NONE && (v as u32) < u).then_some(Pair { stays: v as u32, goes: u })
            })
            .collect()
    }

    /// Takes a collapse out of the batch.
    pub fn take_back(&mut self, pair: Pair) {
        *self.mates[pair.stays as usize].get_mut() = NONE;
        *self.mates[pair.goes as usize].get_mut() = NONE;
    }

    /// The memory of the preferences, which are no longer needed once the batch is chosen.
    pub fn spare(&mut self) -> &mut Vec<AtomicU32> {
        &mut self.best
    }

    /// Where a collapse puts its vertex.
    #[inline(always)]
    pub fn spot(&self, leader: u32) -> [S; 3] {
        self.spots[leader as usize]
    }

    /// The vertex that `v` becomes.
    #[inline(always)]
    pub fn becomes(&self, v: u32) -> u32 {
        self.leader(v).unwrap_or(v)
    }

    /// Whether `v` is in a collapse.
    #[inline(always)]
    pub fn moves(&self, v: u32) -> bool {
        self.mates[v as usize].load(Relaxed) != NONE
    }
}

/// The free end of the cheapest edge at `v` of at most `limit`, or [`NONE`]. Ties go by hash: they are the rule on flat
/// regions, where all costs are zero, and an order by number would let one edge in a row collapse at a time. Without
/// branches on costs, which no processor can predict.
#[inline(always)]
fn cheapest<S: Coordinate>(surface: &Surface<S>, v: u32, limit: f32, free: impl Fn(u32) -> bool) -> u32 {
    let mut least = ((u64::from(limit.to_bits()) + 1) << 32, NONE);
    for &corner in surface.stars.of(v) {
        let (f, i) = parts(corner);
        let (face, costs) = (surface.faces[f], surface.costs[f]);
        for (cost, u) in [(costs[i], face[after(i)]), (costs[before(i)], face[before(i)])] {
            // Costs are never negative: their bits order as they do. Both ends see the same key.
            let key = u64::from(cost.to_bits()) << 32 | u64::from(hash(v.min(u), v.max(u)));
            let key = if free(u) { key } else { u64::MAX };
            least = if key < least.0 { (key, u) } else { least };
        }
    }
    least.1
}

/// Whether a collapse keeps the error bound and folds nothing over.
pub(super) fn admissible<S: Coordinate>(surface: &Surface<S>, a: u32, b: u32, x: [S; 3], options: &Options) -> bool {
    if options.max_error < f64::INFINITY {
        let learnt = surface.merged(a, b, widen(x));
        if learnt.c > options.max_error * options.max_error * learnt.w {
            return false;
        }
    }
    !surface.folds(&surface.stars, a, b, x)
}

/// The order among edges of one cost.
#[inline]
pub(super) fn order(a: u32, b: u32) -> (u32, u32, u32) {
    let (a, b) = (a.min(b), a.max(b));
    (hash(a, b), a, b)
}

#[inline(always)]
fn hash(a: u32, b: u32) -> u32 {
    let mut h = (u64::from(a) << 32 | u64::from(b)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    h ^= h >> 29;
    (h.wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 32) as u32
}
