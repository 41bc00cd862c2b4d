//! One batch: the collapses that are performed together.
//!
//! A batch says of every vertex which one it becomes: its *leader*, which moves to the group's spot. Near the target a group
//! is an edge's two ends ([`pairs`](super::pairs)); far from it more may go together ([`groups`](super::groups)).
//!
//! Stars of neighbouring groups overlap. All faces with moving corners are checked with all of them moved; of the groups at
//! a face that folds over, one is taken back (by a hash: any rule that threads cannot change will do), until none folds.

use super::place::optimal;
use super::surface::{Surface, turned};
use crate::cores::InPieces;
use crate::mesh::marked::Marked;
use crate::mesh::{Coordinate, narrow, step};
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
        let faces = surface.faces.len();
        let folded = |this: &Self, f: u32| this.folded(surface, &surface.faces[f as usize], least_moving);
        let mut back = {
            let this = &*self;
            (0..faces as u32).into_par_iter().in_pieces(4096).filter_map(|f| folded(this, f)).collect::<Vec<_>>()
        };
        if back.is_empty() {
            return;
        }
        let vertices = surface.positions.len();
        let (mut leaving, mut changed) = (Marked::below(vertices), Marked::below(vertices));
        let mut around = Marked::below(faces);
        while !back.is_empty() {
            let this = &*self;
            back.par_iter().for_each(|&v| {
                leaving.add(v);
                changed.add(this.leader(v));
            });
            let shrink = |members: &mut Vec<u32>, leader: u32| {
                this.members(leader, members);
                // Only faces at a group that has changed can have changed.
                members.iter().flat_map(|&v| surface.stars.of(v)).for_each(|corner| around.add(corner >> 2));
                this.shrink(members, &leaving);
                (members.len() > 1).then(|| (leader, this.place(surface, members)))
            };
            let moved: Vec<_> = changed.all().map_init(Vec::new, shrink).flatten_iter().collect();
            for (leader, spot) in moved {
                self.spots[leader as usize] = spot;
            }
            let this = &*self;
            back = around.all().filter_map(|f| folded(this, f)).collect();
            [&mut leaving, &mut changed, &mut around].into_iter().for_each(Marked::clear);
        }
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
        for (i, &v) in members.iter().enumerate() {
            self.next[v as usize].store(members[(i + 1) % members.len()], Relaxed);
        }
    }

    /// Where the merged vertex of a group belongs for what its members have learnt.
    pub fn place(&self, surface: &Surface<S>, members: &[u32]) -> [S; 3] {
        let at = surface.at(members[0]);
        let steps = members.iter().map(|&u| surface.at(u) - at);
        let middle = steps.clone().sum::<DVec3>() / members.len() as f64;
        narrow(at + optimal(&surface.merged(members, at), middle, steps).step)
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
fn first_by_hash(v: u32, cost: u32, edges: &impl Edges) -> u32 {
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
