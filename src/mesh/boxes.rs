//! A tree of boxes over anything that has a place: four boxes a node, side by side for the processor's lanes.
//!
//! Boxes are kept in single precision about an origin, and only ever used to rule things out. So that this is safe, a box
//! is widened by [`Origin::pad`] when it is made and a bound by [`loosen`] when it is asked for: between them they cover
//! every rounding of boxes, of points and of the distance itself. What is measured is measured in doubles.
//!
//! The tree is as full as its leaves allow: the shape follows from the number of items alone, and items are parted at the
//! median of the longest side. It does not depend on threads. A node takes 112 bytes for at most four leaves or nodes, so
//! [`Boxes::bytes`] are about 37 a leaf.

use super::Extent;
use glam::{DVec3, Vec3, Vec4};
use std::ops::Range;

/// Where single precision begins: the middle of what a tree is built over.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Origin {
    middle: DVec3,
    pad: f32,
}

impl Origin {
    /// The origin for items within `extent`.
    pub fn of(extent: &Extent) -> Self {
        let middle = 0.5 * extent.min + 0.5 * extent.max;
        // A coordinate c is off by 2⁻²⁵ |c| when it is rounded; four of those meet in a difference. Of what is more than
        // twice as far out as the items, the roundings are covered by `loosen`.
        let pad = extent.size().max_element() as f32 * (1.0 / (1u32 << 22) as f32);
        Origin { middle, pad: if pad.is_finite() { pad } else { 0.0 } }
    }

    /// A point about the origin.
    #[inline(always)]
    pub fn about(&self, p: DVec3) -> Vec3 {
        (p - self.middle).as_vec3()
    }

    /// What boxes are widened by, to each side.
    pub fn pad(&self) -> f32 {
        self.pad
    }

    /// The widened box of some points about the origin.
    #[inline(always)]
    pub fn around(&self, points: [Vec3; 3]) -> Aabb {
        let [a, b, c] = points;
        Aabb { min: a.min(b).min(c) - self.pad, max: a.max(b).max(c) + self.pad }
    }
}

/// A bound on squared distances that a box has to stay within: a little more than it was.
#[inline(always)]
pub fn loosen(distance_sq: f64) -> f32 {
    (distance_sq * (1.0 + 1.0 / f64::from(1 << 18))) as f32
}

/// An axis-aligned box in single precision.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aabb {
    /// Least coordinates.
    pub min: Vec3,
    /// Largest coordinates.
    pub max: Vec3,
}

impl Aabb {
    /// A box that holds nothing.
    pub const EMPTY: Aabb = Aabb { min: Vec3::INFINITY, max: Vec3::NEG_INFINITY };

    /// The box of a point alone.
    #[inline(always)]
    pub fn at(p: Vec3) -> Aabb {
        Aabb { min: p, max: p }
    }

    /// The box of both.
    #[inline(always)]
    pub fn union(self, other: Aabb) -> Aabb {
        Aabb { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// The squared distance to a point; 0 within.
    #[inline(always)]
    pub fn gap_sq(&self, p: Vec3) -> f32 {
        (self.min - p).max(p - self.max).max(Vec3::ZERO).length_squared()
    }

    /// The squared length of the diagonal; 0 of an empty box.
    #[inline(always)]
    pub fn diagonal_sq(&self) -> f32 {
        (self.max - self.min).max(Vec3::ZERO).length_squared()
    }
}

/// One box in all four lanes.
#[derive(Debug, Clone, Copy)]
pub struct Lanes {
    min: [Vec4; 3],
    max: [Vec4; 3],
}

impl From<Aabb> for Lanes {
    #[inline(always)]
    fn from(one: Aabb) -> Self {
        let splat = |v: Vec3| [Vec4::splat(v.x), Vec4::splat(v.y), Vec4::splat(v.z)];
        Lanes { min: splat(one.min), max: splat(one.max) }
    }
}

/// Four boxes side by side.
#[derive(Debug, Clone, Copy)]
pub struct Four {
    min: [Vec4; 3],
    max: [Vec4; 3],
}

impl Default for Four {
    fn default() -> Self {
        Four { min: [Vec4::INFINITY; 3], max: [Vec4::NEG_INFINITY; 3] }
    }
}

impl Four {
    /// Of four boxes, some of which may be empty.
    #[inline(always)]
    pub fn new(boxes: [Aabb; 4]) -> Four {
        let [a, b, c, d] = boxes;
        let lanes = |a: Vec3, b: Vec3, c: Vec3, d: Vec3| {
            [Vec4::new(a.x, b.x, c.x, d.x), Vec4::new(a.y, b.y, c.y, d.y), Vec4::new(a.z, b.z, c.z, d.z)]
        };
        Four { min: lanes(a.min, b.min, c.min, d.min), max: lanes(a.max, b.max, c.max, d.max) }
    }

    /// Squared distances between a box and each of the four: 0 where they meet, infinite to an empty one.
    #[inline(always)]
    pub fn gaps_sq(&self, one: &Lanes) -> [f32; 4] {
        let mut sum = Vec4::ZERO;
        for axis in 0..3 {
            let gap = (self.min[axis] - one.max[axis]).max(one.min[axis] - self.max[axis]).max(Vec4::ZERO);
            sum += gap * gap;
        }
        sum.to_array()
    }
}

/// What a tree is built of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Item {
    /// Its place, by which items are parted.
    pub at: Vec3,
    /// Its number.
    pub id: u32,
}

/// What a node's lane leads to: [`NOTHING`], a leaf, or a node.
pub type Link = u32;

/// A lane that leads nowhere.
pub const NOTHING: Link = u32::MAX;

const LEAF: Link = 1 << 31;

/// The leaf that a link leads to, if it is one.
#[inline(always)]
pub fn leaf_of(link: Link) -> Option<usize> {
    (link & LEAF != 0).then_some((link & !LEAF) as usize)
}

/// Four boxes and what is in them.
#[derive(Debug, Clone, Copy)]
pub struct Node {
    /// The boxes.
    pub boxes: Four,
    /// What each leads to.
    pub links: [Link; 4],
}

const EMPTY_NODE: Node =
    Node { boxes: Four { min: [Vec4::INFINITY; 3], max: [Vec4::NEG_INFINITY; 3] }, links: [NOTHING; 4] };

/// A tree of boxes; its leaves hold `LEAF_SIZE` consecutive items each.
#[derive(Debug, Clone)]
pub struct Boxes<const LEAF_SIZE: usize> {
    nodes: Vec<Node>,
    items: usize,
}

/// Leaves below which a subtree is built by one thread.
const ALONE: usize = 1 << 10;

impl<const LEAF_SIZE: usize> Boxes<LEAF_SIZE> {
    /// Most items that links can number.
    pub const MOST_ITEMS: usize = (LEAF as usize - 1) * LEAF_SIZE;

    /// Brings `items` into the tree's order and builds it on rayon's threads. `around` gives the box of an item.
    pub fn build(items: &mut [Item], around: impl Fn(&Item) -> Aabb + Sync) -> Self {
        assert!(items.len() <= Self::MOST_ITEMS, "a leaf is numbered in 31 bits");
        let leaves = items.len().div_ceil(LEAF_SIZE);
        let mut nodes = vec![EMPTY_NODE; nodes_for(leaves)];
        let total = items.len();
        if total > 0 {
            Builder::<_, LEAF_SIZE> { around: &around }.build(&mut nodes, 0, items, 0);
        }
        Boxes { nodes, items: total }
    }

    /// The nodes, each before what it leads to.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// The items of a leaf, as positions in the tree's order.
    #[inline(always)]
    pub fn items_of(&self, leaf: usize) -> Range<usize> {
        let first = leaf * LEAF_SIZE;
        first..(first + LEAF_SIZE).min(self.items)
    }

    /// Walks the leaves that are within a squared distance of `from`, nearest first. `visit` is given a leaf's items and
    /// returns the distance within which those that follow have to be.
    #[inline(always)]
    pub fn search(&self, from: Aabb, within_sq: f64, mut visit: impl FnMut(Range<usize>) -> f64) {
        let from = Lanes::from(from);
        let mut within = loosen(within_sq);
        // Of each level at most three wait; sixteen levels have room for all items there can be.
        let mut waiting = [(0 as Link, 0.0f32); 64];
        let mut count = usize::from(!self.nodes.is_empty());
        while count > 0 {
            count -= 1;
            let (link, gap) = waiting[count];
            if gap > within {
                continue;
            }
            if let Some(leaf) = leaf_of(link) {
                within = loosen(visit(self.items_of(leaf)));
                continue;
            }
            let node = &self.nodes[link as usize];
            let gaps = node.boxes.gaps_sq(&from);
            let first = count;
            for (&gap, &link) in gaps.iter().zip(&node.links) {
                if gap <= within && link != NOTHING {
                    // The farthest first, so that the nearest is taken up first.
                    let mut to = count;
                    while to > first && waiting[to - 1].1 < gap {
                        waiting[to] = waiting[to - 1];
                        to -= 1;
                    }
                    waiting[to] = (link, gap);
                    count += 1;
                }
            }
        }
    }

    /// Bytes of a tree over so many items; while it is built, 16 an item more for the items.
    pub const fn bytes(items: u64) -> u64 {
        // A node has four children, but for one on each level: at most a third of the leaves, and sixteen.
        (items.div_ceil(LEAF_SIZE as u64) / 3 + 16) * size_of::<Node>() as u64
    }
}

/// The largest power of four below `leaves`, or 1: what each child of a node over so many holds, but for the last.
fn share(leaves: usize) -> usize {
    let mut share = 1;
    while 4 * share < leaves {
        share *= 4;
    }
    share
}

/// Nodes of a tree over so many leaves.
fn nodes_for(leaves: usize) -> usize {
    if leaves <= 4 {
        return usize::from(leaves > 0);
    }
    let share = share(leaves);
    let rest = leaves % share;
    1 + leaves / share * nodes_for(share) + if rest > 1 { nodes_for(rest) } else { 0 }
}

struct Builder<'a, F, const LEAF_SIZE: usize> {
    around: &'a F,
}

impl<F: Fn(&Item) -> Aabb + Sync, const LEAF_SIZE: usize> Builder<'_, F, LEAF_SIZE> {
    /// Builds the node `nodes[0]`, number `number`, and all below it, over items that begin with leaf `leaf`.
    fn build(&self, nodes: &mut [Node], number: usize, items: &mut [Item], leaf: usize) -> Aabb {
        let leaves = items.len().div_ceil(LEAF_SIZE);
        let share = share(leaves);
        self.part(items, share);
        let Some((node, below)) = nodes.split_first_mut() else { return Aabb::EMPTY };
        let mut parts = Vec::with_capacity(4);
        let (mut next, mut at) = (number + 1, leaf);
        let mut rest = below;
        for part in items.chunks_mut(share * LEAF_SIZE) {
            let here = part.len().div_ceil(LEAF_SIZE);
            let taken = if here > 1 { nodes_for(here) } else { 0 };
            let (mine, others) = std::mem::take(&mut rest).split_at_mut(taken);
            parts.push((mine, next, part, at));
            (rest, next, at) = (others, next + taken, at + here);
        }
        let mut boxes = [Aabb::EMPTY; 4];
        for (link, (mine, next, _, at)) in node.links.iter_mut().zip(&parts) {
            *link = if mine.is_empty() { LEAF | *at as u32 } else { *next as u32 };
        }
        let build = |(mine, next, part, at): (&mut [Node], usize, &mut [Item], usize)| {
            if mine.is_empty() { self.bound(part) } else { self.build(mine, next, part, at) }
        };
        if leaves > ALONE {
            rayon::scope(|scope| {
                for (to, part) in boxes.iter_mut().zip(parts) {
                    scope.spawn(move |_| *to = build(part));
                }
            });
        } else {
            for (to, part) in boxes.iter_mut().zip(parts) {
                *to = build(part);
            }
        }
        node.boxes = Four::new(boxes);
        boxes.into_iter().fold(Aabb::EMPTY, Aabb::union)
    }

    fn bound(&self, items: &[Item]) -> Aabb {
        items.iter().fold(Aabb::EMPTY, |sum, item| sum.union((self.around)(item)))
    }

    /// Parts items so that each run of `share` leaves is compact.
    fn part(&self, items: &mut [Item], share: usize) {
        let units = items.len().div_ceil(share * LEAF_SIZE);
        if units <= 1 {
            return;
        }
        let middle = units.div_ceil(2) * share * LEAF_SIZE;
        let of = items.iter().fold(Aabb::EMPTY, |sum, item| sum.union(Aabb::at(item.at)));
        let size = of.max - of.min;
        let axis = if size.x >= size.y && size.x >= size.z { 0 } else { 1 + usize::from(size.z > size.y) };
        items.select_nth_unstable_by(middle, |a, b| a.at[axis].total_cmp(&b.at[axis]).then(a.id.cmp(&b.id)));
        let (left, right) = items.split_at_mut(middle);
        if left.len() > share * LEAF_SIZE {
            self.part(left, share);
        }
        if right.len() > share * LEAF_SIZE {
            self.part(right, share);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn items(n: u32) -> Vec<Item> {
        let turn = |i: u32, by: u32| (i.wrapping_mul(by) % 1009) as f32 / 1009.0;
        (0..n).map(|id| Item { at: Vec3::new(turn(id, 7919), turn(id, 104_729), turn(id, 31)), id }).collect()
    }

    #[test]
    fn every_item_is_in_one_leaf_and_in_the_boxes_above_it() {
        for n in [0, 1, 3, 4, 5, 16, 17, 64, 65, 1000, 20_000] {
            let mut items = items(n);
            let tree = Boxes::<4>::build(&mut items, |item| Aabb::at(item.at));
            assert!(tree.nodes().len() as u64 * 112 <= Boxes::<4>::bytes(n.into()), "{n}");
            let mut seen = vec![0; n as usize];
            for node in tree.nodes() {
                for (lane, link) in node.links.into_iter().enumerate() {
                    for item in leaf_of(link).filter(|_| link != NOTHING).map_or(0..0, |leaf| tree.items_of(leaf)) {
                        seen[items[item].id as usize] += 1;
                        assert_eq!(node.boxes.gaps_sq(&Aabb::at(items[item].at).into())[lane], 0.0);
                    }
                }
            }
            assert!(seen.iter().all(|times| *times == 1), "{n}");
            for wanted in items.iter().step_by(37) {
                let mut found = false;
                tree.search(Aabb::at(wanted.at), 0.0, |range| {
                    found |= items[range].iter().any(|item| item.id == wanted.id);
                    0.0
                });
                assert!(found, "{n}: item {} is not found", wanted.id);
            }
        }
    }

    #[test]
    fn threads_do_not_change_a_tree() {
        let order = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut items = items(30_000);
            pool.install(|| Boxes::<4>::build(&mut items, |item| Aabb::at(item.at)));
            items
        };
        let one = order(1);
        assert!([2, 3, 8].into_iter().all(|threads| order(threads) == one));
    }
}
