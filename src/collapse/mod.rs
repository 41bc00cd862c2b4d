//! Batched edge collapse under quadrics.

mod classify;
mod commit;
mod select;
mod surface;
mod tail;

pub use classify::Irregularities;

use crate::mesh::adjacency::Stars;
use crate::mesh::{Coordinate, IndexedMesh};
use crate::progress::{Progress, Stage};
use crate::quadric::{PackedQuadric, Quadric};
use crate::Result;
use rayon::prelude::*;
use select::{Batch, order};
use std::sync::atomic::AtomicU8;
use surface::{MERGED, REFUSED, Surface, TOUCHED};

/// What steers the collapse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Faces to end with, at most.
    pub target: usize,
    /// Largest error of a merged vertex, √(cost ÷ area), in the frame's units; infinite for none.
    pub max_error: f64,
    /// Weight of border edges against area: squared length times this.
    pub boundary_weight: f64,
    /// From how many times the target on the quadrics of the *current* faces choose what collapses, instead of those
    /// learnt from the scan.
    pub memoryless_below: f64,
    pub share: f64,
    pub slack: f64,
    pub tail: f64,
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

/// Collapses `mesh` to at most `options.target` faces. `learnt` are the quadrics that its vertices carry, about their
/// positions; without them, those of its faces.
pub fn collapse<S: Coordinate>(
    mesh: IndexedMesh<S>,
    learnt: Option<Vec<PackedQuadric>>,
    options: &Options,
    progress: &Progress,
) -> Result<Collapsed<S>> {
    let start = mesh.faces.len();
    progress.begin(Stage::Collapse, start.saturating_sub(options.target) as u64);
    let (mut surface, irregularities) = prepare(mesh, learnt, options);
    let mut error_sq = surface
        .learnt
        .par_iter()
        .map(|q| if q.w > 0.0 { f64::from(q.c) / f64::from(q.w) } else { 0.0 })
        .reduce(|| 0.0, f64::max);
    let margin = ((options.target as f64 * options.tail) as usize).max(200);
    let floor = options.target + margin;
    let mut batch = Batch::new();
    let mut fresh = true;
    let mut rounds = 0;
    while surface.faces.len() > floor {
        progress.check()?;
        let before = surface.faces.len();
        let memoryless = (before as f64) <= options.memoryless_below * options.target as f64;
        if memoryless && surface.current.is_empty() {
            surface.keep_current(options);
            fresh = true;
        } else if memoryless {
            surface.refresh_current(options, |m| m & TOUCHED != 0);
        }
        let by = if memoryless { TOUCHED } else { MERGED };
        surface.evaluate(options, |cost, marks| {
            fresh || marks & by != 0 || cost == REFUSED && marks & TOUCHED != 0
        });
        fresh = false;
        let wanted = ((before - floor).div_ceil(2)).min((options.share * surface.positions.len() as f64) as usize).max(1);
        let limit = limit(&surface, (options.slack * wanted as f64) as u64);
        let mut fins = classify::fins(&surface);
        batch.select(&mut surface, limit, options);
        let mut pairs = batch.pairs();
        let overshoot = (2 * pairs.len() + fins.len()).saturating_sub(before - floor);
        if overshoot > 0 {
            fins.truncate(0);
            hold_back(&mut batch, &mut pairs, &surface, (before - floor) / 2, options);
        }
        if pairs.is_empty() && fins.is_empty() {
            break;
        }
        error_sq = error_sq.max(commit::commit(&mut surface, &batch, &pairs, &fins));
        rounds += 1;
        if std::env::var("TRACE").is_ok() {
            eprintln!(
                "round {rounds}: {before} -> {} faces, {} pairs, {} fins, limit {limit:e} wanted {wanted}",
                surface.faces.len(),
                pairs.len(),
                fins.len()
            );
        }
        progress.add((before - surface.faces.len()) as u64);
        let n = surface.positions.len();
        surface.stars.rebuild(&surface.faces, n);
        if before - surface.faces.len() < before / 2000 {
            break;
        }
    }
    let mut folded = false;
    if surface.faces.len() > options.target {
        if options.memoryless_below > 0.0 && surface.current.is_empty() {
            surface.keep_current(options);
        } else if !surface.current.is_empty() {
            surface.refresh_current(options, |m| m & TOUCHED != 0);
        }
        let (tail_error_sq, tail_folded) = tail::finish(&mut surface, options.target, options, progress)?;
        error_sq = error_sq.max(tail_error_sq);
        folded = tail_folded;
    }
    let mesh = IndexedMesh { positions: surface.positions, faces: surface.faces };
    Ok(Collapsed { mesh, error_estimate: error_sq.sqrt(), irregularities, rounds, folded })
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
        let s = &surface;
        let form = |v| s.form_around(&s.stars, v, options).pack();
        surface.learnt = (0..n as u32).into_par_iter().with_min_len(1024).map(form).collect();
    }
    (surface, irregularities)
}

/// The cost of the `rank`-th cheapest edge, to 1 %.
fn limit<S: Coordinate>(surface: &Surface<S>, rank: u64) -> f32 {
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

/// Keeps only the `keep` cheapest collapses of the batch.
fn hold_back<S: Coordinate>(
    batch: &mut Batch<S>,
    pairs: &mut Vec<select::Pair>,
    surface: &Surface<S>,
    keep: usize,
    options: &Options,
) {
    if pairs.len() <= keep {
        return;
    }
    let key = |p: &select::Pair| {
        let cost = surface.candidate(&surface.stars, p.stays, p.goes, options).cost as f32;
        (cost.to_bits(), order(p.stays, p.goes))
    };
    let mut keyed: Vec<_> = pairs.par_iter().map(|p| (key(p), *p)).collect();
    keyed.sort_unstable_by_key(|k| k.0);
    for (_, pair) in keyed.drain(keep..) {
        batch.take_back(pair);
    }
    pairs.clear();
    pairs.extend(keyed.into_iter().map(|k| k.1));
}

#[allow(dead_code)]
fn unused(_: Quadric) {}
