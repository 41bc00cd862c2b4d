//! Parallel batched edge collapse under quadrics: the reduced mesh in, the small mesh out.
//!
//! **The loop** (thesis §3.4, with the batches of §9.2): rank the edges → limit the round to the cheaper ones → select
//! a batch → take back what folds → commit → compact. Far from the target a batch is of groups of up to a dozen
//! vertices and a round takes three fifths of all; within thirty times the target it is a matching, and takes a third;
//! within five times one of edges whose costs are kept from round to round, and takes up to 45 %; the last ones go one
//! at a time from a heap, so that the count is exact: the target or one below it on manifolds, at most two below
//! elsewhere.
//!
//! **The cost.** Every vertex carries what it has *learnt* of the scan: the sum of the area-weighted quadrics of all
//! faces it stands for (thesis §3.4), from clustering where the scan was clustered. Down to five times the target,
//! learnt quadrics choose what collapses and where to. From there on the planes of the *current* faces choose the place
//! (each face of both stars once, as in Lindstrom–Turk's memoryless simplification), and the learnt quadric's value at
//! that place is added to their cost at half weight: noisy planes of the scan, extended far from where they lie, are
//! poor judges of where a vertex belongs, but they alone remember that a horn was longer.
//!
//! Measured with the last factor at ten, pairs throughout and no refit:
//!
//! | E_avg against QSlim 2.1 | cow 300 | bunny 1,600 | femur 1 % | teeth 1 % |
//! |---|--:|--:|--:|--:|
//! | learnt quadrics all the way | 1.14 | 0.92 | 0.93 | 1.28 |
//! | current quadrics for the last factor of ten | 1.66 | 0.48 | 0.48 | 1.20 |
//! | current plus 0.5 × learnt | 0.72 | 0.51 | 0.52 | 0.88 |
//!
//! A piece of the mesh (a connected component) is not flattened for next to nothing: its last collapse costs at least
//! what deviation would say of its loss (`pieces`).
//!
//! Attributes, where a scan has them and fits the budget, are solved for with the place (`shade`); seams are held
//! (`seams`).
//!
//! **Promises.** Input as it comes: borders, non-manifold edges and vertices, coincident and zero-area faces. No face
//! turns over unless the count cannot be reached otherwise ([`Collapsed::folded`]). The same mesh for any number of
//! threads, since every step is a function of the state before it. No constant depends on the scan's size: coordinates
//! are in the [`Frame`](crate::mesh::Frame). Topology may change, as in the thesis: holes close, handles vanish.
//!
//! **Memory.** [`bytes`] of arrays: 36 a face and 113 a vertex (161 in doubles); compaction is in place. Where groups went
//! first it is less: arrays give back what has gone before those of the edges' costs and of current quadrics join them.

mod batch;
mod check;
mod classify;
mod commit;
mod evaluate;
mod faces;
mod forms;
mod groups;
mod hold;
mod join;
mod pairs;
mod penalty;
mod pieces;
mod place;
mod policy;
mod rank;
mod seams;
mod shade;
mod surface;
mod tail;
mod weigh;

pub use crate::mesh::audit::Irregularities;
pub use pieces::Dropped;
pub use policy::{
    Features, FoldCheck, Least, PairDistance, Placement, Policies, Primitive, Quadrics, Topology, Weighting,
};

use crate::Result;
use crate::cores::InPieces;
use crate::mesh::{Coordinate, IndexedMesh, Reference, Shades, Wedges, widen};
use crate::progress::{Progress, Stage};
use crate::quadric::PackedQuadric;
use batch::{Batch, order};
use glam::DVec3;
use rayon::prelude::*;
use surface::{LOCKED, REFUSED, SEAM, Surface, TOUCHED, settled};

/// What steers the collapse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options<'a> {
    /// Faces to end with, at most.
    pub target: usize,
    /// Largest error of a merged vertex, √(cost ÷ area), in the frame's units; infinite for none.
    pub max_error: f64,
    /// How it is steered.
    pub policies: Policies,
    /// The vertices nearest to these points stay where they are.
    pub locked: &'a [DVec3],
    /// Whether to keep the mesh as it was at ten times the target, and what became of it.
    pub keep_reference: bool,
    /// From how many times the target on the current faces choose: [`LAST_FACTOR`], or less.
    pub last_factor: usize,
    /// Faces that are left to the heap, at least: [`TAIL_FACES`], or fewer.
    pub tail_faces: usize,
    /// Where the mesh is a part of a larger one.
    pub part: Option<Part>,
}

/// A part of a mesh, cut out to be collapsed alone. What decides is a cost that is the same in all parts: `target` is
/// no count to reach, but what the part would have if all were thinned alike, which says how far off the end is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Part {
    /// Collapses that cost more are not done.
    pub most_cost: f32,
    /// Faces below which it does not go either.
    pub least: usize,
    /// Whether to tell what would be done next.
    pub proposes: bool,
}

/// A collapse that was not done: `goes` would become `keeps`. No two of a mesh have a vertex in common.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Proposal<S> {
    /// What it costs.
    pub cost: f32,
    /// The vertex that would stay.
    pub keeps: u32,
    /// The vertex that would go.
    pub goes: u32,
    /// Faces that would go.
    pub faces: u32,
    /// Where the vertex that stays would be.
    pub spot: [S; 3],
}

impl Options<'_> {
    /// To that many faces, by the default policies.
    pub fn to(target: usize) -> Self {
        Options {
            target,
            max_error: f64::INFINITY,
            policies: Policies::default(),
            locked: &[],
            keep_reference: false,
            last_factor: LAST_FACTOR,
            tail_faces: TAIL_FACES,
            part: None,
        }
    }
}

/// What is known of the vertices that are handed on.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Carried {
    /// What each vertex has learnt, about its position.
    pub quadrics: Vec<PackedQuadric>,
    /// Vertices that somebody wants to find again, [`u32::MAX`] for none.
    pub homes: Vec<u32>,
    /// Attributes that are to steer, as lengths in the frame: what a difference of them counts against a distance. Of
    /// wedges, where there are any.
    pub shades: Shades,
    /// What is on either side of seams.
    pub wedges: Wedges,
    /// Vertices that stay where they are, since other parts of the mesh use them: only of a [`Part`].
    pub locked: Vec<u32>,
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
    /// What the result stands for, if it was to be kept: the mesh that came in, or what was left of it at ten times the
    /// target.
    pub reference: Option<Reference<S>>,
    /// What became of [`Carried::homes`].
    pub homes: Vec<u32>,
    /// Rounds of batches.
    pub rounds: u32,
    /// Whether faces had to be folded over to reach the count.
    pub folded: bool,
    /// Pieces that were too small and went before anything else.
    pub dropped: Dropped,
    /// Vertices of the result that are locked, or on seams.
    pub locked: Vec<u32>,
    /// What became of [`Carried::wedges`].
    pub wedges: Wedges,
    /// What became of [`Carried::shades`].
    pub shades: Shades,
    /// Whether seams could not be held to the end.
    pub seams_gave_way: bool,
    /// What would be done next, if that was asked.
    pub proposals: Vec<Proposal<S>>,
}

impl<S> Collapsed<S> {
    /// A mesh that needs no collapse any more, with such an error.
    pub fn done(mesh: IndexedMesh<S>, error_estimate: f64) -> Self {
        Collapsed {
            mesh,
            error_estimate,
            irregularities: Irregularities::default(),
            reference: None,
            homes: Vec::new(),
            rounds: 0,
            folded: false,
            dropped: Dropped::default(),
            locked: Vec::new(),
            wedges: Wedges::default(),
            shades: Shades::default(),
            seams_gave_way: false,
            proposals: Vec::new(),
        }
    }
}

/// From how many times the target on the current faces choose, and learnt quadrics advise. After a refit, 10 and 7 are no
/// better on seven of eight models (the femur gains 5 %), and take twice the time from ten times the target on.
pub const LAST_FACTOR: usize = 5;

/// At how many times the target the reference is kept: a tenth as many samples lose 2 % against all, a fifth 9 %.
pub const REFERENCE_FACTOR: usize = 10;

/// Weight of the learnt quadric in the cost of the last factor. 0 erodes thin parts (1.66 × QSlim's E_avg on the cow at
/// 300 faces against 0.72), 1 costs 10 % on smooth ones (femur).
const LEARNT_WEIGHT: f64 = 0.5;

/// Vertices that may move in a round of groups, those with the cheapest edges first, as a share. Without any limit rounds
/// would thin a finely and a coarsely meshed part alike, and a scan of uneven density would lose its coarse part. Where
/// groups are pairs 0.6 takes an eighth to a third longer than this, for one percent of E_avg.
const GROUPS_SHARE: f64 = 0.9;

/// From so many times the target on rounds go far: three fifths of all vertices at a time. Nearer, chains cost a fifth of
/// E_avg on models of a few thousand faces; from here on, nothing.
const FAR_FACTOR: usize = 30;

/// Steps from a vertex to the pair that it follows in a far round, at most; in others, none: those left over pair up among
/// themselves.
const LONGEST: usize = 2;

/// Vertices that a round of pairs may remove, as a share: 0.35 gains nothing, for an eighth more rounds.
const PAIRS_SHARE: f64 = 0.45;
/// The edges that a round of pairs may choose from, as a multiple of the collapses it wants, from the cheapest up;
/// there are three times as many edges as vertices. At 2.5 the cow at 300 faces is a third further off, and other
/// models the same.
const PAIRS_SLACK: f64 = 1.5;

/// Faces that are left to the heap above the target: at least the former, or this share of the target. Where only a few
/// hundred faces are asked for, each matters, and 1,000 take about 10 ms.
pub const TAIL_FACES: usize = 1000;
const TAIL_SHARE: f64 = 0.02;

/// Faces that are left to the heap at least where it joins pieces or contracts faces, since rounds know edges only; for
/// more than five times the target neither matters yet.
const SERIAL_FACES: usize = 50_000;

/// Where a round of groups removes fewer than one face in this many, pairs go on.
const GROUPS_STALL: usize = 10;

/// A round of pairs that removes fewer than one face in this many has nothing left that batches can do; the heap goes on.
const STALL: usize = 2000;

/// Bytes of arrays at the peak for a mesh of that many faces and vertices.
pub fn bytes<S: Coordinate>(faces: u64, vertices: u64) -> u64 {
    36 * faces + (12 * size_of::<S>() as u64 + 65) * vertices
}

/// Bytes a vertex (or wedge) that each number adds that steers.
pub const SHADE_BYTES: u64 = 4;

/// Bytes that a reference of so many faces and vertices adds. One that is kept when twenty times the target or more
/// come in adds nothing: by then the arrays of those that have gone make room.
pub fn reference_bytes<S: Coordinate>(faces: u64, vertices: u64) -> u64 {
    12 * faces + (3 * size_of::<S>() as u64 + 4) * vertices
}

/// Bytes that the last steps take on the way to so many faces: a heap of the edges that are left then, which grows by
/// doubling, and their stars.
pub fn tail_bytes(target: u64, policies: &Policies) -> u64 {
    if policies.ends_serially() {
        return SERIAL_BYTES.saturating_mul(target.saturating_add(serial_faces(target as usize) as u64));
    }
    TAIL_BYTES.saturating_mul(target)
}

/// Bytes of [`tail_bytes`] a face that is asked for, and a face where the heap does more than edges.
const TAIL_BYTES: u64 = 96;
const SERIAL_BYTES: u64 = 250;

/// Faces above the target that are left to a heap that does more than edges.
fn serial_faces(target: usize) -> usize {
    SERIAL_FACES.max(target.saturating_mul(LAST_FACTOR - 1))
}

/// Collapses `mesh` to at most `options.target` faces. Without quadrics that are carried, vertices learn those of their
/// faces. Ends above the target only where `options.max_error` forbids the rest.
pub fn collapse<S: Coordinate>(
    mut mesh: IndexedMesh<S>,
    carried: Option<Carried>,
    options: &Options,
    progress: &Progress,
) -> Result<Collapsed<S>> {
    let Carried { quadrics, homes, mut shades, mut wedges, locked } = carried.unwrap_or_default();
    let mut learnt = Some(quadrics).filter(|quadrics| !quadrics.is_empty());
    let least = options.policies.min_component;
    let dropped =
        least.map_or(Dropped::default(), |l| pieces::drop_small(&mut mesh, &mut learnt, &mut shades, &mut wedges, l));
    progress.begin(Stage::Collapse, mesh.faces.len().saturating_sub(options.target) as u64);
    let mut error_sq = learnt.as_deref().map_or(0.0, largest_error_sq);
    let (mut surface, irregularities) = prepare(mesh, learnt, (shades, wedges), &locked, options, progress)?;
    let mut rounds = Rounds::new(options, homes);
    while let Some(round_error_sq) = rounds.turn(&mut surface, progress)? {
        error_sq = error_sq.max(round_error_sq);
    }
    let proposals = match options.part {
        Some(Part { proposes: true, .. }) => rounds.propose(&mut surface),
        _ => Vec::new(),
    };
    let count = rounds.count;
    let mut followed = rounds.followed;
    if options.keep_reference && followed.reference.is_none() {
        followed.reference = Some(surface.reference());
    }
    let mut folded = false;
    if surface.faces.len() > options.target && options.max_error == f64::INFINITY && options.part.is_none() {
        if options.policies.quadrics == Quadrics::Current {
            surface.renew_current(options);
        }
        surface.evaluate(options, |marks| marks & TOUCHED != 0);
        let end = tail::finish(&mut surface, options, &mut followed, progress)?;
        error_sq = error_sq.max(end.error_sq);
        folded = end.folded;
    }
    let locked = match options.locks() || surface.is_seamed() {
        true => (0..surface.positions.len() as u32).filter(|&v| surface.mark(v) & (LOCKED | SEAM) != 0).collect(),
        false => Vec::new(),
    };
    let mesh = IndexedMesh { positions: surface.positions, faces: surface.faces };
    let error_estimate = error_sq.sqrt();
    let Followed { reference, homes } = followed;
    let (wedges, shades, seams_gave_way) = (surface.wedges, surface.shades, surface.seams_give_way);
    let rounds = count;
    Ok(Collapsed {
        mesh,
        error_estimate,
        irregularities,
        reference,
        homes,
        rounds,
        folded,
        dropped,
        locked,
        wedges,
        shades,
        seams_gave_way,
        proposals,
    })
}

/// Lays out the arrays, classifies, and learns the faces' quadrics where none are carried.
fn prepare<S: Coordinate>(
    mesh: IndexedMesh<S>,
    learnt: Option<Vec<PackedQuadric>>,
    (shades, wedges): (Shades, Wedges),
    locked: &[u32],
    options: &Options,
    progress: &Progress,
) -> Result<(Surface<S>, Irregularities)> {
    let n = mesh.positions.len();
    let mut surface = Surface::new(mesh, learnt, shades, wedges);
    surface.stars.rebuild(&surface.faces, n);
    progress.check()?;
    let (irregularities, joined) = rayon::join(|| classify::classify(&surface), || pieces::joined(&surface.faces, n));
    progress.check()?;
    surface.mark_held(options);
    locked.iter().for_each(|v| *surface.marks[*v as usize].get_mut() |= LOCKED);
    surface.mark_seams();
    surface.find_pieces(joined);
    progress.check()?;
    if surface.learnt.is_empty() {
        surface.learn(options);
    }
    Ok((surface, irregularities))
}

/// The largest error that vertices come with: clustering's. Those of a scan itself have none.
fn largest_error_sq(learnt: &[PackedQuadric]) -> f64 {
    let error_sq = |q: &PackedQuadric| if q.w > 0.0 { f64::from(q.c) / f64::from(q.w) } else { 0.0 };
    learnt.par_iter().in_pieces(4096).map(error_sq).reduce(|| 0.0, f64::max)
}

/// What is to be found again in the result.
struct Followed<S> {
    reference: Option<Reference<S>>,
    homes: Vec<u32>,
}

impl<S> Followed<S> {
    /// The lists of vertices, to be kept up to date.
    fn lists(&mut self) -> impl Iterator<Item = &mut Vec<u32>> {
        self.reference.iter_mut().map(|reference| &mut reference.homes).chain([&mut self.homes])
    }
}

/// The rounds of batches, and what they keep from one to the next.
struct Rounds<'a, S> {
    options: &'a Options<'a>,
    batch: Batch<S>,
    /// Faces at which the rounds end.
    floor: usize,
    followed: Followed<S>,
    count: u32,
    /// Groups have nothing left to take.
    paired: bool,
    stalled: bool,
}

impl<'a, S: Coordinate> Rounds<'a, S> {
    fn new(options: &'a Options<'a>, homes: Vec<u32>) -> Self {
        let bounded = options.max_error < f64::INFINITY;
        let tail = match options.policies.ends_serially() {
            false => options.tail_faces.max((options.target as f64 * TAIL_SHARE) as usize),
            true => serial_faces(options.target),
        };
        let floor = match options.part {
            Some(part) => part.least,
            None if bounded => options.target,
            None => options.target.saturating_add(tail),
        };
        let followed = Followed { reference: None, homes };
        Rounds { options, batch: Batch::new(), floor, followed, count: 0, paired: bounded, stalled: false }
    }

    /// One round: the largest squared error among its merged vertices, or `None` when there is nothing more for rounds.
    fn turn(&mut self, surface: &mut Surface<S>, progress: &Progress) -> Result<Option<f64>> {
        progress.check()?;
        let before = surface.faces.len();
        if before <= self.floor || self.stalled {
            return Ok(None);
        }
        let within = |factor: usize| before / factor <= self.options.target;
        let last = self.paired || within(self.options.last_factor);
        let holds = self.options.locks() && self.options.part.is_none();
        let near = last || self.options.policies.by_pairs() || holds || surface.is_seamed();
        let most = (before - self.floor).div_ceil(2);
        if self.options.keep_reference && self.followed.reference.is_none() && (last || within(REFERENCE_FACTOR)) {
            self.followed.reference = Some(surface.reference());
        }
        if near {
            if surface.costs.is_empty() {
                self.batch = Batch::new();
                if surface.is_large() {
                    surface.give_back();
                }
            }
            self.pair(surface, most, self.options.part.map_or(f32::INFINITY, |part| part.most_cost));
        } else {
            groups::select(&mut self.batch, surface, if within(FAR_FACTOR) { 0 } else { LONGEST }, self.options);
        }
        progress.check()?;
        let mut leaders = self.batch.all_leaders();
        self.hold_back(&mut leaders, surface, most, near);
        if leaders.is_empty() && near {
            return Ok(None);
        }
        progress.check()?;
        let error_sq = commit::commit(surface, &mut self.batch, &leaders, &mut self.followed);
        progress.check()?;
        surface.stars.rebuild(&surface.faces, surface.positions.len());

        let removed = before - surface.faces.len();
        self.count += 1;
        let few = |share: usize| (removed == 0 || removed < before / share) && self.options.max_error == f64::INFINITY;
        self.stalled = near && few(STALL);
        self.paired |= few(GROUPS_STALL);
        progress.add(removed as u64);
        Ok(Some(error_sq))
    }

    /// Chooses pairs that cost at most so much, and of which at most so many are to go.
    fn pair(&mut self, surface: &mut Surface<S>, most: usize, most_cost: f32) {
        if self.options.policies.quadrics == Quadrics::Current {
            surface.renew_current(self.options);
        }
        surface.evaluate(self.options, |marks| marks & TOUCHED != 0);
        let wanted = most.min((PAIRS_SHARE * surface.positions.len() as f64) as usize).max(1);
        let limit = limit(surface.costs.as_flattened(), (PAIRS_SLACK * wanted as f64) as u64);
        pairs::select(&mut self.batch, surface, limit.min(most_cost), self.options);
    }

    /// What one more round of pairs would do, whatever it costs.
    fn propose(&mut self, surface: &mut Surface<S>) -> Vec<Proposal<S>> {
        self.pair(surface, usize::MAX, f32::INFINITY);
        let (surface, batch) = (&*surface, &self.batch);
        let proposal = |&keeps: &u32| {
            let goes = batch.next_of(keeps);
            let cost = surface.cost(&surface.stars, keeps, goes, self.options);
            let faces = surface.shared(&surface.stars, keeps, goes).count() as u32;
            Proposal { cost, keeps, goes, faces, spot: batch.spots[keeps as usize] }
        };
        batch.all_leaders().par_iter().in_pieces(256).map(proposal).collect()
    }

    /// Keeps only the cheapest groups of the batch, so that at most `most` vertices go.
    fn hold_back(&mut self, leaders: &mut Vec<u32>, surface: &Surface<S>, most: usize, near: bool) {
        // At most all are moving, which far from the target is seldom too many, and needs no count.
        if surface.positions.len() - leaders.len() <= most || self.batch.moving() - leaders.len() <= most {
            return;
        }
        let batch = &self.batch;
        let key = |members: &mut Vec<u32>, &v: &u32| {
            batch.members(v, members);
            let cost = match near {
                false => surface.merged(members, widen(batch.spots[v as usize])).c,
                true => f64::from(surface.cost(&surface.stars, v, members[1], self.options)),
            };
            (settled::<S>(cost as f32).to_bits(), order(v, v), members.len() - 1)
        };
        let mut keyed: Vec<_> = leaders.par_iter().in_pieces(256).map_init(Vec::new, key).collect();
        keyed.sort_unstable();
        let mut members = Vec::new();
        let mut gone = 0;
        for (_, (_, v, _), goes) in keyed {
            gone += goes;
            if gone > most {
                batch.members(v, &mut members);
                batch.take_back(&members);
            }
        }
        leaders.retain(|&v| batch.moves(v));
    }
}

/// The `rank`-th least cost, to 1 %; no limit where there are not so many.
fn limit(costs: &[f32], rank: u64) -> f32 {
    const SHIFT: u32 = 16;
    const BUCKETS: usize = 1 << (31 - SHIFT);
    let count = |mut counts: Vec<u32>, costs: &[f32]| {
        for cost in costs.iter().filter(|c| **c < REFUSED) {
            counts[(cost.to_bits() >> SHIFT) as usize] += 1;
        }
        counts
    };
    let empty = || vec![0u32; BUCKETS];
    let counts = costs.par_chunks(1 << 18).fold(empty, count).reduce(empty, |mut a, b| {
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
