//! One batch: the collapses that are performed together.
//!
//! A batch says of every vertex which one it becomes: its *leader*, which moves to the group's spot. Near the target a group
//! is an edge's two ends ([`pairs`](super::pairs)); far from it more may go together ([`groups`](super::groups)).
//!
//! Stars of neighbouring groups overlap. All faces with moving corners are checked with all of them moved; of the groups at
//! a face that folds over, one is taken back (by a hash: any rule that threads cannot change will do), until none folds.

use super::evaluate::{Vector, dot};
use super::place::optimal;
use super::rank::LANES;
use super::surface::{LEAST_COSINE, Surface, turned};
use crate::cores::InPieces;
use crate::mesh::adjacency::parts;
use crate::mesh::marked::Marked;
use crate::mesh::{Coordinate, narrow, step};
use fearless_simd::{Level, Simd, dispatch, f32x8, prelude::*};
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// No vertex.
pub(super) const NONE: u32 = u32::MAX;

/// The arrays of one round, kept for the next: 8 bytes a vertex and a position.
pub(super) struct Batch<S> {
    /// While the batch is chosen: the end of a vertex's cheapest edge. Then: the next member of its group, round and round.
    pub next: Vec<AtomicU32>,
    /// The vertex that each one becomes, or [`NONE`] where it stays as it is.
    pub leaders: Vec<AtomicU32>,
    /// Where a leader goes.
    pub spots: Vec<[S; 3]>,
}

impl<S: Coordinate> Batch<S> {
    /// No collapses.
    pub fn new() -> Self {
        Batch { next: Vec::new(), leaders: Vec::new(), spots: Vec::new() }
    }

    /// Makes room for a batch among `vertices`, in which nothing moves yet.
    pub fn begin(&mut self, vertices: usize, next: u32) {
        let fill = |numbers: &mut Vec<AtomicU32>, x: u32| {
            (0..vertices).into_par_iter().in_pieces(4096).map(|_| AtomicU32::new(x)).collect_into_vec(numbers);
        };
        fill(&mut self.next, next);
        fill(&mut self.leaders, NONE);
        if self.spots.len() < vertices {
            self.spots = Vec::new();
            self.spots = bytemuck::zeroed_vec(vertices);
        }
        self.spots.truncate(vertices);
    }

    /// The leader of the group that `v` is in, or [`NONE`].
    #[inline(always)]
    pub fn leader(&self, v: u32) -> u32 {
        self.leaders[v as usize].load(Relaxed)
    }

    /// Whether `v` is in a group.
    #[inline(always)]
    pub fn moves(&self, v: u32) -> bool {
        self.leader(v) != NONE
    }

    /// The vertex that `v` becomes.
    #[inline(always)]
    pub fn becomes(&self, v: u32) -> u32 {
        let leader = self.leader(v);
        if leader == NONE { v } else { leader }
    }

    /// All leaders, in order.
    pub fn all_leaders(&self) -> Vec<u32> {
        let leads = |(v, leader): (usize, &AtomicU32)| (leader.load(Relaxed) == v as u32).then_some(v as u32);
        self.leaders.par_iter().enumerate().in_pieces(4096).filter_map(leads).collect()
    }

    /// How many vertices are in groups.
    pub fn moving(&self) -> usize {
        self.leaders.par_iter().in_pieces(4096).filter(|leader| leader.load(Relaxed) != NONE).count()
    }

    /// The members of a group, its leader first.
    pub fn members(&self, leader: u32, members: &mut Vec<u32>) {
        members.clear();
        let mut v = leader;
        loop {
            members.push(v);
            v = self.next[v as usize].load(Relaxed);
            if v == leader {
                return;
            }
        }
    }

    /// The member of a group that comes behind `v`: of a pair the other one.
    pub fn next_of(&self, v: u32) -> u32 {
        self.next[v as usize].load(Relaxed)
    }

    /// Takes a group out of the batch.
    pub fn take_back(&self, members: &[u32]) {
        for &v in members {
            self.leaders[v as usize].store(NONE, Relaxed);
        }
    }

    /// Takes vertices out of their groups until no face folds over that has as many moving corners as `least_moving` or more.
    pub fn take_back_folds(&mut self, surface: &Surface<S>, least_moving: usize) {
        let folded = |this: &Self, faces: &[[u32; 3]]| {
            let mut back = Vec::new();
            dispatch!(Level::new(), simd => this.all_folded(simd, surface, faces, least_moving, &mut back));
            back
        };
        let mut back: Vec<u32> = {
            let this = &*self;
            surface.faces.par_chunks(CHECKED).in_pieces(1).flat_map_iter(|faces| folded(this, faces)).collect()
        };
        if back.is_empty() {
            return;
        }
        let mut leaving = Marked::below(surface.positions.len());
        while !back.is_empty() {
            back.iter().for_each(|&v| leaving.add(v));
            let mut leaders: Vec<u32> = back.iter().map(|&v| self.leader(v)).collect();
            leaders.par_sort_unstable();
            leaders.dedup();
            let this = &*self;
            let shrunk: Vec<_> =
                leaders.par_chunks(SHRUNK).map(|leaders| this.shrink_some(surface, leaders, &leaving)).collect();
            for &(leader, spot) in shrunk.iter().flat_map(|shrunk| &shrunk.moved) {
                self.spots[leader as usize] = spot;
            }
            back.iter().for_each(|&v| leaving.remove(v));
            let this = &*self;
            // Only faces at a group that has changed can have changed.
            let folded_around = |shrunk: &Shrunk<S>| {
                let corners = shrunk.members.iter().flat_map(|&v| surface.stars.of(v));
                let faces: Vec<_> = corners.map(|&corner| surface.faces[parts(corner).0]).collect();
                folded(this, &faces)
            };
            back = shrunk.par_iter().flat_map_iter(folded_around).collect();
        }
    }

    /// Takes those who are `leaving` out of some groups.
    fn shrink_some(&self, surface: &Surface<S>, leaders: &[u32], leaving: &Marked) -> Shrunk<S> {
        let (mut shrunk, mut members) = (Shrunk { members: Vec::new(), moved: Vec::new() }, Vec::new());
        for &leader in leaders {
            self.members(leader, &mut members);
            shrunk.members.extend_from_slice(&members);
            self.shrink(&mut members, leaving);
            if members.len() > 1 {
                shrunk.moved.push((leader, self.place(surface, &members)));
            }
        }
        shrunk
    }

    /// Takes those who are `leaving` out of their group: the leader, or all but one of the members, only with all others.
    /// Leaves those in `members` who stay.
    fn shrink(&self, members: &mut Vec<u32>, leaving: &Marked) {
        let leader = members[0];
        let leaves = |v: u32| leaving.has(v);
        if leaves(leader) || members[1..].iter().all(|&v| leaves(v)) {
            self.take_back(members);
            members.clear();
            return;
        }
        members.retain(|&v| {
            if leaves(v) {
                self.leaders[v as usize].store(NONE, Relaxed);
            }
            !leaves(v)
        });
        self.link(members);
    }

    /// Has the members of a group follow one another in that order.
    pub fn link(&self, members: &[u32]) {
        for (&v, &next) in members.iter().zip(members[1..].iter().chain(&members[..1])) {
            self.next[v as usize].store(next, Relaxed);
        }
    }

    /// Where the merged vertex of a group belongs for what its members have learnt.
    #[inline(always)]
    pub fn place(&self, surface: &Surface<S>, members: &[u32]) -> [S; 3] {
        let at = surface.at(members[0]);
        let steps = members.iter().map(|&u| surface.at(u) - at);
        let middle = steps.clone().sum::<DVec3>() / members.len() as f64;
        narrow(at + optimal(&surface.merged(members, at), middle, steps).step)
    }

    /// What [`Batch::folded`] says of some faces, as far as it says anything.
    #[inline(always)]
    fn all_folded<V: Simd>(
        &self,
        simd: V,
        surface: &Surface<S>,
        faces: &[[u32; 3]],
        least_moving: usize,
        back: &mut Vec<u32>,
    ) {
        // Most faces vanish or stay as they are; which ones is as good as random, so that is told without a branch.
        let (mut asking, mut count) = ([[0; 3]; CHECKED], 0);
        for faces in faces.chunks(CHECKED) {
            for face in faces {
                let [a, b, c] = [self.leader(face[0]), self.leader(face[1]), self.leader(face[2])];
                let moving = usize::from(a != NONE) + usize::from(b != NONE) + usize::from(c != NONE);
                let vanishes = (a != NONE) & ((a == b) | (a == c)) | (b != NONE) & (b == c);
                asking[count % CHECKED] = *face;
                count += usize::from((moving >= least_moving) & !vanishes);
            }
            let (together, rest) = asking[..std::mem::take(&mut count)].as_chunks::<LANES>();
            for faces in together {
                let mut doubtful = self.may_fold(simd, surface, faces);
                while doubtful != 0 {
                    let face = &faces[doubtful.trailing_zeros() as usize % LANES];
                    doubtful &= doubtful - 1;
                    back.extend(self.folded(surface, face, least_moving));
                }
            }
            back.extend(rest.iter().filter_map(|face| self.folded(surface, face, least_moving)));
        }
    }

    /// Which of these faces, of which none vanishes, the batch may fold over, a bit each: all that it does, and hardly one
    /// that it does not.
    #[inline(always)]
    fn may_fold<V: Simd>(&self, simd: V, surface: &Surface<S>, faces: &[[u32; 3]; LANES]) -> u64 {
        // The edges from the first corner, before and after, each axis side by side.
        let mut edges = [[[0f32; LANES]; 3]; 4];
        for (lane, face) in faces.iter().enumerate() {
            let place = |v: u32| {
                let leader = self.leader(v);
                let (places, at) = if leader == NONE { (&surface.positions, v) } else { (&self.spots, leader) };
                places[at as usize]
            };
            let was = [0, 1, 2].map(|i| surface.positions[face[i] as usize]);
            let would = [place(face[0]), place(face[1]), place(face[2])];
            let steps =
                [step(was[0], was[1]), step(was[0], was[2]), step(would[0], would[1]), step(would[0], would[2])];
            for (edge, step) in edges.iter_mut().zip(steps) {
                (edge[0][lane], edge[1][lane], edge[2][lane]) = (step.x, step.y, step.z);
            }
        }
        let [u, v, to_u, to_v] = &edges;
        let (was, would) = (cross(simd, u, v), cross(simd, to_u, to_v));
        let (was_sq, would_sq) = (dot(&was, &was), dot(&would, &would));
        let least = f32x8::splat(simd, SURE_COSINE) * (was_sq.sqrt() * would_sq.sqrt());
        let is_exact = was_sq.min(would_sq).simd_gt(f32x8::splat(simd, f32::MIN_POSITIVE / f32::EPSILON));
        let surely_not = dot(&was, &would).simd_gt(least) & is_exact;
        !surely_not.to_bitmask() & ((1 << LANES) - 1)
    }

    /// If the batch folds `face` over: one of its corners that would better stay, a leader only if there is no other.
    #[inline(always)]
    fn folded(&self, surface: &Surface<S>, face: &[u32; 3], least_moving: usize) -> Option<u32> {
        let leaders = face.map(|v| self.leader(v));
        let moving = leaders.iter().filter(|&&u| u != NONE).count();
        let vanishes = |i: usize, j: usize| leaders[i] != NONE && leaders[i] == leaders[j];
        if moving < least_moving || vanishes(0, 1) || vanishes(1, 2) || vanishes(2, 0) {
            return None;
        }
        let was = face.map(|v| surface.positions[v as usize]);
        let mut would = was;
        for (spot, leader) in would.iter_mut().zip(leaders).filter(|(_, leader)| *leader != NONE) {
            *spot = self.spots[leader as usize];
        }
        let normal = |p: [[S; 3]; 3]| step(p[0], p[1]).cross(step(p[0], p[2]));
        if !turned(normal(was), normal(would)) {
            return None;
        }
        let those = face.iter().zip(leaders).filter(|(_, leader)| *leader != NONE);
        those.max_by_key(|(v, leader)| (*v != leader, hash(*leader, **v), **v)).map(|(v, _)| *v)
    }

    /// The memory of the groups' order, once they are merged: the vertices' new numbers, then.
    pub fn spare(&mut self) -> &mut Vec<AtomicU32> {
        &mut self.next
    }
}

/// Groups that have lost members.
struct Shrunk<S> {
    /// Whoever was in one.
    members: Vec<u32>,
    /// The leaders of those that are left, and where they go now.
    moved: Vec<(u32, [S; 3])>,
}

/// Groups that are made smaller by one task.
const SHRUNK: usize = 64;

/// Faces that are looked at by one task.
const CHECKED: usize = 1 << 10;

/// A face whose normal turns by less than this has not folded over, however singles were rounded.
const SURE_COSINE: f32 = LEAST_COSINE as f32 + 1e-3;

/// Cross products of vectors side by side: the same numbers as of each alone.
#[inline(always)]
fn cross<V: Simd>(simd: V, u: &[[f32; LANES]; 3], v: &[[f32; LANES]; 3]) -> Vector<V> {
    let along = |of: &[f32; LANES]| f32x8::load_array_ref(simd, of);
    let ([ux, uy, uz], [vx, vy, vz]) =
        ([along(&u[0]), along(&u[1]), along(&u[2])], [along(&v[0]), along(&v[1]), along(&v[2])]);
    [uy * vz - vy * uz, uz * vx - vz * ux, ux * vy - vx * uy]
}

/// The edges at a vertex that may be chosen.
pub(super) trait Edges {
    /// Hands over what each costs, as bits (costs are never negative: their bits order as they do), and its other end. An edge
    /// may come twice.
    fn each(&self, take: impl FnMut(u32, u32));
}

/// The cheapest edge at `v` that costs less than `most`: its cost and its other end, or [`NONE`]. Ties go by hash: they are
/// the rule on flat regions, where all costs are zero, and an order by number would let one edge in a row collapse at a time.
/// Without branches on costs, which no processor can predict; hashes are looked at where they matter.
#[inline(always)]
pub(super) fn cheapest(v: u32, most: u32, edges: &impl Edges) -> (u32, u32) {
    let (mut least, mut tied) = ((most, NONE), false);
    edges.each(|cost, u| {
        tied = cost == least.0 && u != least.1 || tied && cost >= least.0;
        least = if cost < least.0 { (cost, u) } else { least };
    });
    if tied && least.1 != NONE { (least.0, first_by_hash(v, least.0, edges)) } else { least }
}

/// Among the edges at `v` of that cost the other end of the first by hash.
#[cold]
pub(super) fn first_by_hash(v: u32, cost: u32, edges: &impl Edges) -> u32 {
    let mut first = (u32::MAX, NONE);
    edges.each(|found, u| {
        let key = (hash(v.min(u), v.max(u)), u);
        if found == cost && key < first {
            first = key;
        }
    });
    first.1
}

/// The order among edges of one cost.
#[inline]
pub(super) fn order(a: u32, b: u32) -> (u32, u32, u32) {
    let (a, b) = (a.min(b), a.max(b));
    (hash(a, b), a, b)
}

#[inline(always)]
pub(super) fn hash(a: u32, b: u32) -> u32 {
    let mut h = (u64::from(a) << 32 | u64::from(b)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    h ^= h >> 29;
    (h.wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 32) as u32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collapse::surface::tests::bumps;
    use crate::vectors::levels;

    #[test]
    fn what_folds_together_is_what_folds_alone() {
        let surface = bumps::<f32>();
        let n = surface.positions.len() as u32;
        let mut all = 0;
        for seed in 0..400u32 {
            // Some vertices go with a neighbour in number, to places near and far.
            let mut batch = Batch::new();
            batch.begin(n as usize, NONE);
            for v in 0..n - 1 {
                if hash(seed, v).is_multiple_of(3) && !batch.moves(v) && !batch.moves(v + 1) {
                    [v, v + 1].into_iter().for_each(|u| batch.leaders[u as usize].store(v, Relaxed));
                }
            }
            for (v, spot) in batch.spots.iter_mut().enumerate() {
                let away = [1e-3, 0.1, 0.5, 1e-25][seed as usize % 4];
                let part = |axis| (hash(seed + axis, !(v as u32)) as f32 / u32::MAX as f32 - 0.5) * away;
                let at = surface.positions[v];
                *spot =
                    if seed % 4 == 3 { [part(0), part(1), part(2)] } else { [0, 1, 2].map(|i| at[i] + part(i as u32)) };
            }
            for least_moving in [1, 2] {
                let alone = |face| batch.folded(&surface, face, least_moving);
                let alone: Vec<_> = surface.faces.iter().filter_map(alone).collect();
                for level in levels() {
                    let mut together = Vec::new();
                    dispatch!(level, simd =>
                        batch.all_folded(simd, &surface, &surface.faces, least_moving, &mut together));
                    together.sort_unstable();
                    let mut alone = alone.clone();
                    alone.sort_unstable();
                    assert_eq!(together, alone);
                }
                all += alone.len();
            }
        }
        assert!(all > 1000, "{all}");
    }

    struct List<'a>(&'a [(f32, u32)]);

    impl Edges for List<'_> {
        fn each(&self, mut take: impl FnMut(u32, u32)) {
            self.0.iter().for_each(|(cost, u)| take(cost.to_bits(), *u));
        }
    }

    #[test]
    fn the_cheapest_edge_does_not_depend_on_the_order_and_ties_go_by_hash() {
        let v = 7;
        let first = [3, 9, 20, 41].into_iter().min_by_key(|&u| hash(v.min(u), v.max(u))).unwrap();
        for turn in 0..8 {
            let mut list = [(2.0, 5), (1.0, 3), (1.0, 9), (1.0, 3), (f32::INFINITY, 6), (1.0, 20), (1.0, 41), (1.5, 8)];
            list.rotate_left(turn);
            assert_eq!(cheapest(v, u32::MAX, &List(&list)), (1f32.to_bits(), first));
            list.iter_mut().for_each(|edge| edge.0 += if edge.1 == 8 { -0.75 } else { 0.0 });
            assert_eq!(cheapest(v, u32::MAX, &List(&list)), (0.75f32.to_bits(), 8));
        }
    }

    #[test]
    fn what_costs_too_much_is_not_chosen() {
        assert_eq!(cheapest(1, 2f32.to_bits() + 1, &List(&[(2.0, 5), (3.0, 2)])).1, 5);
        assert_eq!(cheapest(1, 2f32.to_bits(), &List(&[(2.0, 5), (2.0, 2)])).1, NONE);
        assert_eq!(cheapest(1, u32::MAX, &List(&[])).1, NONE);
    }
}
