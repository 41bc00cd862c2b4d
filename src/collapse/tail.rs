//! The last collapses, one at a time from a heap, so that the count is exact and the order is the thesis's.

use super::batch::{NONE, order};
use super::join::Joins;
use super::policy::Primitive;
use super::surface::{Around, KEPT, REFUSED, Surface};
use super::{Followed, Options, limit};
use crate::mesh::adjacency::{Stars, parts};
use crate::mesh::{Coordinate, number_used, renumber, widen};
use crate::{Result, progress::Progress};
use rustc_hash::FxHashMap;
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::atomic::Ordering::Relaxed;

/// The stars of the round that came last, and over them those that the tail has changed.
pub(super) struct Overlay {
    stars: Stars,
    changed: FxHashMap<u32, Vec<u32>>,
}

impl Around for Overlay {
    fn of(&self, v: u32) -> &[u32] {
        match self.changed.get(&v) {
            Some(corners) => corners,
            None => self.stars.of(v),
        }
    }
}

/// Edges that the heap has at first for each face that is to go. A collapse takes two faces, and two or three edges with it.
const EDGES_A_FACE: u64 = 4;

/// An edge in the heap: cost as bits (costs are never negative, so bits order as numbers do), then the tie-break.
type Entry = Reverse<(u32, (u32, u32, u32))>;

/// How the tail ended.
pub(super) struct End {
    /// The largest squared error among the merged vertices.
    pub error_sq: f64,
    /// Whether faces had to be folded over.
    pub folded: bool,
}

/// What is done when nothing else is left.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Need {
    /// Nothing yet: no face folds over, and no edge of three and more faces takes the count further than one below the
    /// target, which is as far as those of manifolds go.
    None,
    /// Seams are no longer held.
    Seams,
    /// A few faces may fold over, and the count may end two below.
    Fold,
    /// The count may end anywhere below: many copies of one face go together.
    Overshoot,
}

/// Collapses until at most `options.target` faces are left.
pub(super) fn finish<S: Coordinate>(
    surface: &mut Surface<S>,
    options: &Options,
    followed: &mut Followed<S>,
    progress: &Progress,
) -> Result<End> {
    let joins = options.policies.pair_distance.map_or(Joins::default(), |distance| Joins::find(surface, distance));
    let overlay = Overlay { stars: std::mem::take(&mut surface.stars), changed: FxHashMap::default() };
    surface.forget_roots();
    let left = surface.faces.len();
    let becomes = (0..surface.positions.len() as u32).collect();
    let (heap, limit, error_sq) = (BinaryHeap::new(), f32::INFINITY, 0.0);
    let mut tail = Tail { becomes, left, surface, overlay, joins, heap, limit, error_sq, options };
    if options.policies.primitive == Primitive::Face {
        tail.surface.costs = Vec::new();
        tail.contract_faces(progress)?;
    }
    let mut need = Need::None;
    let mut folded = false;
    while tail.left > options.target {
        let before = tail.left;
        tail.fill_heap();
        tail.drain(need, progress)?;
        let advanced = tail.left < before;
        folded |= need >= Need::Fold && advanced;
        need = match need {
            _ if advanced || tail.limit < f32::INFINITY => Need::None,
            Need::None if tail.surface.holds_seams() => {
                tail.surface.seams_give_way = true;
                Need::Seams
            }
            Need::None | Need::Seams => Need::Fold,
            Need::Fold => Need::Overshoot,
            Need::Overshoot => break,
        };
    }
    let error_sq = tail.error_sq;
    let mut becomes = std::mem::take(&mut tail.becomes);
    let numbers = compact(surface);
    surface.wedges.settle();
    for homes in followed.lists() {
        for home in homes.iter_mut().filter(|home| **home != NONE) {
            while becomes[*home as usize] != *home {
                let next = becomes[*home as usize];
                becomes[*home as usize] = becomes[next as usize];
                *home = next;
            }
            *home = numbers[*home as usize];
        }
    }
    Ok(End { error_sq, folded })
}

pub(super) struct Tail<'a, S> {
    pub surface: &'a mut Surface<S>,
    pub overlay: Overlay,
    joins: Joins,
    heap: BinaryHeap<Entry>,
    /// What edges of the heap cost at most: there may be others that cost more.
    limit: f32,
    /// The vertex that each one was merged into, or itself.
    becomes: Vec<u32>,
    /// Faces that are left.
    pub left: usize,
    /// The largest squared error among the merged vertices.
    pub error_sq: f64,
    pub options: &'a Options<'a>,
}

impl<S: Coordinate> Tail<'_, S> {
    /// Every edge, at the cost that the rounds have kept of it where nothing has changed since; but where they have kept
    /// costs only the cheaper ones, which should do.
    fn fill_heap(&mut self) {
        let mut entries = Vec::new();
        let kept = std::mem::take(&mut self.surface.costs);
        let enough = EDGES_A_FACE * (self.left - self.options.target) as u64;
        let all = kept.is_empty() || 2 * enough > self.left as u64;
        self.limit = if all { f32::INFINITY } else { limit(kept.as_flattened(), enough) };
        for (f, face) in self.surface.faces.iter().enumerate() {
            if face[0] == NONE {
                continue;
            }
            for i in 0..3 {
                let (a, b) = (face[i], face[(i + 1) % 3]);
                if kept.get(f).is_some_and(|costs| self.limit < costs[i] && costs[i] < REFUSED) {
                    continue;
                }
                let first = || self.surface.shared(&self.overlay, a, b).min() == Some(f as u32);
                if a < b || self.surface.answers_for(a, b) && first() {
                    // One that was refused is asked again: its neighbours may have gone since.
                    let cost = kept.get(f).map(|costs| costs[i]).filter(|cost| *cost < REFUSED);
                    entries.push(cost.map_or_else(|| self.entry(a, b), |cost| Reverse((cost.to_bits(), order(a, b)))));
                }
            }
        }
        entries.extend(self.joins.pairs().map(|(a, b)| self.entry(a, b)));
        self.heap = BinaryHeap::from(entries);
    }

    fn entry(&self, a: u32, b: u32) -> Entry {
        let cost = match self.joined(a, b) {
            false => self.surface.cost(&self.overlay, a, b, self.options),
            // That ends no piece.
            true => (self.surface.candidate(&self.overlay, a, b, self.options).cost as f32).min(REFUSED),
        };
        Reverse((cost.to_bits(), order(a, b)))
    }

    /// Whether two vertices may merge without an edge between them.
    fn joined(&self, a: u32, b: u32) -> bool {
        !self.joins.is_empty()
            && self.joins.of(a).contains(&b)
            && self.surface.shared(&self.overlay, a, b).next().is_none()
    }

    fn alive(&self, v: u32) -> bool {
        !self.overlay.of(v).is_empty()
    }

    /// Collapses from the heap until it is empty or the count is reached; under need, only a few times.
    fn drain(&mut self, need: Need, progress: &Progress) -> Result<()> {
        let most = if need <= Need::Seams { usize::MAX } else { 1 + (self.left - self.options.target) / 32 };
        let mut done = 0;
        let mut turns = 0u32;
        while self.left > self.options.target {
            turns = turns.wrapping_add(1);
            if turns.is_multiple_of(4096) {
                progress.check()?;
            }
            let Some(Reverse((cost, (_, a, b)))) = self.heap.pop() else { return Ok(()) };
            if f32::from_bits(cost) > self.limit {
                return Ok(());
            }
            let shared = self.surface.shared(&self.overlay, a, b).count();
            if shared == 0 && !self.joined(a, b) || !self.alive(a) || !self.alive(b) {
                continue;
            }
            let now = self.entry(a, b);
            if now.0.0 > cost {
                self.heap.push(now);
                continue;
            }
            let below = [1, 1, 2, usize::MAX][need as usize];
            if shared > 2 && (self.left + below.min(shared)) < self.options.target + shared {
                continue;
            }
            done += usize::from(self.collapse(a, b, need >= Need::Fold));
            if done >= most {
                return Ok(());
            }
        }
        Ok(())
    }

    /// Merges two vertices, unless a face would fold over. Returns whether it did.
    fn collapse(&mut self, a: u32, b: u32, may_fold: bool) -> bool {
        let s = &*self.surface;
        let candidate = s.candidate(&self.overlay, a, b, self.options);
        let spot = s.spot(a, b, candidate.step, self.options);
        let merged = s.merged(&[a, b], widen(spot));
        let error_sq = if merged.w > 0.0 { merged.c / merged.w } else { 0.0 };
        let check = self.options.policies.fold_check;
        let folds = !may_fold && s.folds(&self.overlay, a, b, spot, check);
        if folds || !s.allows(&self.overlay, a, b, self.options) {
            return false;
        }
        self.error_sq = self.error_sq.max(error_sq);
        self.merge(a, b, spot);
        self.refresh(a);
        true
    }

    /// `a` and `b` become one at `spot`, without any question.
    pub fn merge(&mut self, a: u32, b: u32, spot: [S; 3]) {
        let v = a as usize;
        if self.surface.is_shaded() {
            let merged = self.surface.merged_shades(&self.overlay, &[a, b], widen(spot));
            merged.iter().for_each(|(i, numbers)| self.surface.take_shade(*i, numbers));
        }
        if self.surface.is_seamed() {
            self.unite_wedges(a, b);
        }
        self.surface.learnt[v] = self.surface.merged(&[a, b], widen(spot)).pack();
        self.surface.positions[v] = spot;
        let marks = self.surface.mark(b) & KEPT;
        self.surface.marks[v].fetch_or(marks, Relaxed);
        self.becomes[b as usize] = a;
        self.surface.pieces.join(a, b);
        self.joins.merge(a, b);
        self.rewire(a, b);
    }

    /// Wedges of `b` become `a`'s on the faces that both have.
    fn unite_wedges(&mut self, a: u32, b: u32) {
        let pairs = self.surface.wedge_pairs(&self.overlay, a, b);
        let wedges = &mut self.surface.wedges;
        for (of_a, of_b) in pairs {
            wedges.unite(of_a, of_b);
        }
        for &corner in self.overlay.of(a).iter().chain(self.overlay.of(b)) {
            let (f, side) = parts(corner);
            wedges.corners[f][side] = wedges.root(wedges.corners[f][side]);
        }
    }

    /// Faces of `b` become `a`'s; faces of both go.
    fn rewire(&mut self, a: u32, b: u32) {
        let mut star = self.overlay.of(a).to_vec();
        star.extend_from_slice(self.overlay.of(b));
        for &corner in &star {
            let (f, side) = parts(corner);
            self.surface.faces[f][side] = a;
        }
        let repeated = |face: [u32; 3]| face.iter().filter(|&&v| v == a).count() > 1;
        let gone: Vec<u32> =
            star.iter().map(|c| c >> 2).filter(|&f| repeated(self.surface.faces[f as usize])).collect();
        star.retain(|c| !gone.contains(&(c >> 2)));
        self.overlay.changed.insert(a, star);
        self.overlay.changed.insert(b, Vec::new());
        let mut gone = gone;
        gone.sort_unstable();
        gone.dedup();
        for f in gone {
            self.remove(f);
        }
    }

    fn remove(&mut self, f: u32) {
        self.surface.pieces.lose_face(self.surface.faces[f as usize][0]);
        for v in self.surface.faces[f as usize] {
            let mut star = self.overlay.of(v).to_vec();
            star.retain(|c| c >> 2 != f);
            self.overlay.changed.insert(v, star);
        }
        self.surface.faces[f as usize] = [NONE; 3];
        self.left -= 1;
    }

    /// Renews the current quadrics around `v` and the entries of its edges.
    fn refresh(&mut self, v: u32) {
        let mut ring: Vec<u32> = Vec::new();
        for &c in self.overlay.of(v) {
            let (p, q) = self.surface.ends(c);
            ring.extend([p, q]);
        }
        ring.sort_unstable();
        ring.dedup();
        self.renew(v, &ring);
        ring.extend_from_slice(self.joins.of(v));
        for u in ring {
            let entry = self.entry(v, u);
            self.heap.push(entry);
        }
    }

    /// Renews the current quadrics of `v` and its ring.
    pub fn renew(&mut self, v: u32, ring: &[u32]) {
        let kept = !self.surface.current.is_empty();
        for &u in ring.iter().chain([&v]).filter(|_| kept) {
            let form = self.surface.form_around(&self.overlay, u, self.options);
            self.surface.current[u as usize] = form.a.map(S::narrow);
        }
    }
}

/// Drops what the tail has removed. Returns the vertices' new numbers.
fn compact<S: Coordinate>(surface: &mut Surface<S>) -> Vec<u32> {
    let mut lives = surface.faces.iter().map(|f| f[0] != NONE);
    surface.wedges.corners.retain(|_| lives.next() == Some(true));
    surface.faces.retain(|f| f[0] != NONE);
    let (numbers, kept) = number_used(&surface.faces, surface.positions.len());
    for (v, &number) in numbers.iter().enumerate().filter(|(_, number)| **number != NONE) {
        surface.positions[number as usize] = surface.positions[v];
        surface.marks.swap(number as usize, v);
    }
    if surface.wedges.is_empty() {
        surface.shades.keep(numbers.len(), |v| Some(numbers[v]).filter(|new| *new != NONE));
    }
    surface.positions.truncate(kept);
    surface.marks.truncate(kept);
    renumber(&mut surface.faces, &numbers);
    numbers
}
