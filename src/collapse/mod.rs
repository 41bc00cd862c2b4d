//! Parallel batched edge collapse under quadrics: the reduced mesh in, the small mesh out.
//!
//! **The loop** (thesis §3.4, with the batches of §9.2): evaluate the edges whose surroundings changed → limit the round to
//! the cheaper ones → select a matching → check and take back what folds → commit → compact. A round removes up to 45 % of
//! the vertices far from the target, up to 35 % near it; the last ones go one at a time from a heap, so that the count is
//! exact: the target or one below it on manifolds, at most two below elsewhere.
//!
//! **The cost.** Every vertex carries what it has *learnt* of the scan: the sum of the area-weighted quadrics of all faces it
//! stands for (thesis §3.4), from clustering where the scan was clustered. Down to ten times the target, learnt
//! quadrics choose what collapses and where to. From there on the planes of the *current* faces choose the place (each face
//! of both stars once, as in Lindstrom–Turk's memoryless simplification), and the learnt quadric's value at that place is
//! added to their cost at half weight: noisy planes of the scan, extended far from where they lie, are poor judges of
//! where a vertex belongs, but they alone remember that a horn was longer.
//!
//! | E_avg against QSlim 2.1 | cow 300 | bunny 1,600 | femur 1 % | teeth 1 % |
//! |---|--:|--:|--:|--:|
//! | learnt quadrics all the way | 1.14 | 0.92 | 0.93 | 1.28 |
//! | current quadrics for the last factor of ten | 1.66 | 0.48 | 0.48 | 1.20 |
//! | current plus 0.5 × learnt | 0.72 | 0.51 | 0.52 | 0.88 |
//!
//! **Promises.** Input as it comes: borders, non-manifold edges and vertices, coincident and zero-area faces. No face turns
//! over unless the count cannot be reached otherwise ([`Collapsed::folded`]). The same mesh for any number of threads, since
//! every step is a function of the state before it. No constant depends on the scan's size: coordinates are in the
//! [`Frame`](crate::mesh::Frame). Topology may change, as in the thesis: holes close, handles vanish.
//!
//! **Memory.** [`bytes`] of arrays: 36 a face and 109 a vertex (133 in doubles); compaction is in place.

mod classify;
mod commit;
mod select;
mod surface;
mod tail;

pub use classify::Irregularities;

use crate::Result;
use crate::mesh::adjacency::Stars;
use crate::mesh::{Coordinate, IndexedMesh};
use crate::progress::{Progress, Stage};
use crate::quadric::PackedQuadric;
use rayon::prelude::*;
use select::{Batch, Pair, order};
use std::sync::atomic::AtomicU8;
use surface::{MERGED, REFUSED, Surface, TOUCHED};

/// What steers the collapse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Faces to end with, at most.
    pub target: usize,
    /// Largest error of a merged vertex, √(cost ÷ area), in the frame's units; infinite for none.
    pub max_error: f64,
    /// Weight of border edges against area: a border edge's squared length times this is the weight of the squared distance
    /// to its line. 0 lets borders shrink, 10 costs 45 % of E_avg on the bunny.
    pub boundary_weight: f64,
}

/// The reduced mesh and what happened.
#[derive(Debug, Clone, PartialEq)]
pub struct Collapsed<S> {
    /// The result, in the frame.
    pub mesh: IndexedMesh<S>,
    /// √(largest cost ÷ its area), in the frame's units.
    pub error_estimate: f64,
    /// What was irregular in the mesh that came in.
    pub irregularities: Irregularities,
    /// Rounds of batches.
    pub rounds: u32,
    /// Whether faces had to be folded over to reach the count.
    pub folded: bool,
}

/// From how many times the target on the current faces choose, and learnt quadrics advise. On a noisy scan of 1.2 M faces
/// at 1 %, 5 costs 3 % of E_avg, and 20 gains nothing for a tenth more time.
const LAST_FACTOR: usize = 10;

/// Weight of the learnt quadric in the cost of the last factor. 0 erodes thin parts (1.66 × QSlim's E_avg on the cow at 300
/// faces against 0.72), 1 costs 10 % on smooth ones (femur).
const LEARNT_WEIGHT: f64 = 0.5;

/// How far one round goes.
#[derive(Clone, Copy)]
struct Pace {
    /// Vertices that a round may remove, as a share.
    share: f64,
    /// The edges that a round may choose from, as a multiple of the collapses it wants, from the cheapest up. There are
    /// three times as many edges as vertices.
    slack: f64,
}

/// Far from the target the order matters less. Without any limit, though, rounds thin a finely and a coarsely meshed part
/// alike, and a scan of uneven density loses its coarse part.
const FAR: Pace = Pace { share: 0.45, slack: 2.5 };

/// Near the target the order matters: at a slack of 2.5, E_avg is 4 % higher on a noisy scan of 1.2 M faces, at 5, 19 %; a
/// share of 0.25 gains nothing for half as many rounds more.
const NEAR: Pace = Pace { share: 0.35, slack: 1.5 };

/// Faces that are left to the heap above the target: at least the former, or this share of the target. Where only a few
/// hundred faces are asked for, each matters, and 1,000 take about 10 ms.
const TAIL_FACES: usize = 1000;
const TAIL_SHARE: f64 = 0.02;

/// A round that removes fewer than one face in this many has nothing left that batches can do; the heap goes on.
const STALL: usize = 2000;

/// Bytes of arrays at the peak for a mesh of that many faces and vertices.
pub fn bytes<S: Coordinate>(faces: u64, vertices: u64) -> u64 {
    let position = 3 * size_of::<S>() as u64;
    36 * faces + (2 * position + 85) * vertices
}

/// Collapses `mesh` to at most `options.target` faces. `learnt` are the quadrics that its vertices carry, about their
/// positions; without them, those of its faces. Ends above the target only where `options.max_error` forbids the rest.
pub fn collapse<S: Coordinate>(
    mesh: IndexedMesh<S>,
    learnt: Option<Vec<PackedQuadric>>,
    options: &Options,
    progress: &Progress,
) -> Result<Collapsed<S>> {
    progress.begin(Stage::Collapse, mesh.faces.len().saturating_sub(options.target) as u64);
    let (mut surface, irregularities) = prepare(mesh, learnt, options);
    let mut error_sq = largest_error_sq(&surface.learnt);
    let mut rounds = Rounds::new(options);
    while let Some(round_error_sq) = rounds.turn(&mut surface, progress)? {
        error_sq = error_sq.max(round_error_sq);
    }
    let count = rounds.count;
    drop(rounds);
    let mut folded = false;
    if surface.faces.len() > options.target && options.max_error == f64::INFINITY {
        surface.renew_current(options);
        let end = tail::finish(&mut surface, options, progress)?;
        error_sq = error_sq.max(end.error_sq);
        folded = end.folded;
    }
    let mesh = IndexedMesh { positions: surface.positions, faces: surface.faces };
    Ok(Collapsed { mesh, error_estimate: error_sq.sqrt(), irregularities, rounds: count, folded })
}

/// Lays out the arrays, classifies, and learns the faces' quadrics where none are carried.
fn prepare<S: Coordinate>(
    mesh: IndexedMesh<S>,
    learnt: Option<Vec<PackedQuadric>>,
    options: &Options,
) -> (Surface<S>, Irregularities) {
    let n = mesh.positions.len();
    let mut stars = Stars::default();
    stars.rebuild(&mesh.faces, n);
    let mut surface = Surface {
        costs: vec![[0.0; 3]; mesh.faces.len()],
        faces: mesh.faces,
        positions: mesh.positions,
        learnt: learnt.unwrap_or_default(),
        current: Vec::new(),
        marks: (0..n).map(|_| AtomicU8::new(0)).collect(),
        stars,
    };
    let irregularities = classify::classify(&surface);
    if surface.learnt.is_empty() {
        surface.learn(options);
    }
    (surface, irregularities)
}

/// The largest error that the vertices come with: clustering's, zero for the scan itself.
fn largest_error_sq(learnt: &[PackedQuadric]) -> f64 {
    let error_sq = |q: &PackedQuadric| if q.w > 0.0 { f64::from(q.c) / f64::from(q.w) } else { 0.0 };
    learnt.par_iter().with_min_len(4096).map(error_sq).reduce(|| 0.0, f64::max)
}

/// The rounds of batches, and what they keep from one to the next.
struct Rounds<'a, S> {
    options: &'a Options,
    batch: Batch<S>,
    /// Faces at which the rounds end.
    floor: usize,
    count: u32,
    /// No cost has been computed under the present metric.
    fresh: bool,
    stalled: bool,
}

impl<'a, S: Coordinate> Rounds<'a, S> {
    fn new(options: &'a Options) -> Self {
        let bounded = options.max_error < f64::INFINITY;
        let tail = TAIL_FACES.max((options.target as f64 * TAIL_SHARE) as usize);
        let floor = if bounded { options.target } else { options.target.saturating_add(tail) };
        Rounds { options, batch: Batch::new(), floor, count: 0, fresh: true, stalled: false }
    }

    /// One round: the largest squared error among its merged vertices, or `None` when there is nothing more for rounds.
    fn turn(&mut self, surface: &mut Surface<S>, progress: &Progress) -> Result<Option<f64>> {
        progress.check()?;
        let before = surface.faces.len();
        if before <= self.floor || self.stalled {
            return Ok(None);
        }
        let near = self.options.max_error < f64::INFINITY || before / LAST_FACTOR <= self.options.target;
        self.evaluate(surface, near);

        let pace = if near { NEAR } else { FAR };
        let most = (before - self.floor).div_ceil(2);
        let wanted = most.min((pace.share * surface.positions.len() as f64) as usize).max(1);
        let limit = limit(surface, (pace.slack * wanted as f64) as u64);
        self.batch.select(surface, limit, self.options);
        let mut pairs = self.batch.pairs();
        self.hold_back(&mut pairs, surface, most);
        if pairs.is_empty() {
            return Ok(None);
        }
        let error_sq = commit::commit(surface, &mut self.batch, &pairs);
        surface.stars.rebuild(&surface.faces, surface.positions.len());

        let removed = before - surface.faces.len();
        self.count += 1;
        self.stalled = removed < before / STALL && self.options.max_error == f64::INFINITY;
        progress.add(removed as u64);
        Ok(Some(error_sq))
    }

    /// Brings the costs up to date: those at merged vertices, and where current faces count those at all changed faces.
    fn evaluate(&mut self, surface: &mut Surface<S>, near: bool) {
        if near {
            self.fresh |= surface.current.is_empty();
            surface.renew_current(self.options);
        }
        let by = if near { TOUCHED } else { MERGED };
        let fresh = std::mem::take(&mut self.fresh);
        surface
            .evaluate(self.options, |cost, marks| fresh || marks & by != 0 || cost == REFUSED && marks & TOUCHED != 0);
    }

    /// Keeps only the `most` cheapest collapses of the batch.
    fn hold_back(&mut self, pairs: &mut Vec<Pair>, surface: &Surface<S>, most: usize) {
        if pairs.len() <= most {
            return;
        }
        let key = |p: &Pair| {
            let cost = surface.candidate(&surface.stars, p.stays, p.goes, self.options).cost as f32;
            (cost.to_bits(), order(p.stays, p.goes))
        };
        let mut keyed: Vec<_> = pairs.par_iter().map(|p| (key(p), *p)).collect();
        keyed.sort_unstable_by_key(|k| k.0);
        for (_, pair) in keyed.drain(most..) {
            self.batch.take_back(pair);
        }
        pairs.clear();
        pairs.extend(keyed.into_iter().map(|k| k.1));
    }
}

/// The cost of the `rank`-th cheapest edge, to 1 %; no limit where there cannot be so many.
fn limit<S: Coordinate>(surface: &Surface<S>, rank: u64) -> f32 {
    if rank >= 3 * surface.positions.len() as u64 {
        return f32::from_bits(REFUSED.to_bits() - 1);
    }
    const SHIFT: u32 = 16;
    const BUCKETS: usize = 1 << (31 - SHIFT);
    let count = |mut counts: Vec<u32>, costs: &[f32; 3]| {
        for cost in costs.iter().filter(|c| **c < REFUSED) {
            counts[(cost.to_bits() >> SHIFT) as usize] += 1;
        }
        counts
    };
    let empty = || vec![0u32; BUCKETS];
    let counts = surface.costs.par_iter().with_min_len(1 << 17).fold(empty, count).reduce(empty, |mut a, b| {
        a.iter_mut().zip(b).for_each(|(x, y)| *x += y);
        a
    });
    let mut below = 0u64;
    for (bucket, &count) in counts.iter().enumerate() {
        below += u64::from(count);
        if below >= rank {
            return f32::from_bits(((bucket as u32 + 1) << SHIFT) - 1);
        }
    }
    f32::from_bits(REFUSED.to_bits() - 1)
}

#[cfg(test)]
mod tests;
