//! Items in groups, by a counting sort that threads share.

use crate::cores::InPieces;
use rayon::prelude::*;
use std::ops::Range;

/// Items, numbers as a rule, by the group that each is in: those of group `g` are `items[first[g]..first[g + 1]]`, in the
/// order in which they came. 4 bytes a group beside the items.
#[derive(Debug, Default)]
pub struct Groups<T = u32> {
    first: Vec<u32>,
    items: Vec<T>,
}

/// Into how many ranges of groups work is cut where each range goes through all items: more would cost more than it
/// spreads.
pub fn ranges() -> usize {
    rayon::current_num_threads().min(4)
}

/// Sources that are passed over together by the ranges that none of their groups is in.
const BLOCK: usize = 1 << 11;

/// Sources from which on they are cut whatever their order: of 500,000 two threads are no faster then, of 70,000 they take
/// twice as long.
const UNCUT: usize = 1 << 19;

/// Consecutive sources, and between which groups theirs are.
struct Block {
    sources: Range<usize>,
    least: u32,
    most: u32,
}

impl<T: bytemuck::Pod + Send + Sync> Groups<T> {
    /// Sorts the items of pairs into `groups` groups, reusing the memory; a pair is a group and an item, and one whose group
    /// is not among them is left out. There are `sources` of pairs, whose order pairs follow, such as faces with three each.
    ///
    /// Groups are cut into ranges, and each goes through the pairs for what is its own, so that nothing depends on how many
    /// there are: in a sensible order of sources, through few of others'.
    pub fn rebuild<I: Iterator<Item = (u32, T)>>(
        &mut self,
        groups: usize,
        sources: usize,
        pairs: impl Fn(Range<usize>) -> I + Sync,
    ) {
        let block = |first: usize| {
            let sources = first..sources.min(first + BLOCK);
            let among = pairs(sources.clone()).map(|(group, _)| group).filter(|group| (*group as usize) < groups);
            let (least, most) = among.fold((u32::MAX, 0), |(least, most), group| (least.min(group), most.max(group)));
            Block { sources, least, most }
        };
        let count = sources.div_ceil(BLOCK);
        let ranges = if count > 2 { ranges() } else { 1 };
        if ranges == 1 {
            let all = Block { sources: 0..sources, least: 0, most: u32::MAX };
            return self.rebuild_in(groups, 1, &[all], &pairs);
        }
        let blocks: Vec<Block> = (0..count).into_par_iter().in_pieces(1).map(|i| block(i * BLOCK)).collect();
        let span = span(groups, ranges);
        let passes = |block: &Block| (block.most as usize / span + 1).saturating_sub(block.least as usize / span);
        let passes: usize = blocks.iter().map(passes).sum();
        let cut = sources >= UNCUT || 2 * passes < 3 * count;
        self.rebuild_in(groups, if cut { ranges } else { 1 }, &blocks, &pairs);
    }

    fn rebuild_in<I: Iterator<Item = (u32, T)>>(
        &mut self,
        groups: usize,
        ranges: usize,
        blocks: &[Block],
        pairs: &(impl Fn(Range<usize>) -> I + Sync),
    ) {
        let Groups { first, items } = self;
        first.clear();
        first.resize(groups + 1, 0);
        let span = span(groups, ranges);
        let pairs_in = |low: u32, len: usize| {
            let high = u64::from(low) + len as u64;
            let near = blocks.iter().filter(move |block| u64::from(block.least) < high && block.most >= low);
            near.flat_map(|block| pairs(block.sources.clone()))
        };

        // first[g + 1] counts g's items, then holds where they begin, and after filling where they end.
        first[1..].par_chunks_mut(span).enumerate().for_each(|(range, counts)| {
            let low = (range * span) as u32;
            pairs_in(low, counts.len()).for_each(|(group, _)| {
                if let Some(count) = counts.get_mut(group.wrapping_sub(low) as usize) {
                    *count += 1;
                }
            });
        });
        let mut all = 0;
        for slot in &mut first[1..] {
            all += std::mem::replace(slot, all);
        }
        make_room(items, all as usize);

        let mut rest = items.as_mut_slice();
        let mut taken = 0;
        let mut parts = Vec::with_capacity(ranges);
        let mut ends = first[1..].chunks_mut(span).peekable();
        while let Some(cursors) = ends.next() {
            let end = ends.peek().map_or(all, |next| next[0]);
            let (part, later) = rest.split_at_mut((end - taken) as usize);
            parts.push((taken, cursors, part));
            (rest, taken) = (later, end);
        }
        parts.into_par_iter().enumerate().for_each(|(range, (base, cursors, part))| {
            let low = (range * span) as u32;
            pairs_in(low, cursors.len()).for_each(|(group, item)| {
                if let Some(cursor) = cursors.get_mut(group.wrapping_sub(low) as usize) {
                    part[(*cursor - base) as usize] = item;
                    *cursor += 1;
                }
            });
        });
    }

    /// The items of a group.
    #[inline(always)]
    pub fn of(&self, group: usize) -> &[T] {
        &self.items[self.first[group] as usize..self.first[group + 1] as usize]
    }

    /// Where each group begins and the last one ends, and all items, one group after the other.
    pub fn into_parts(self) -> (Vec<u32>, Vec<T>) {
        (self.first, self.items)
    }

    /// Gives back the memory that is not in use.
    pub fn give_back(&mut self) {
        self.first.shrink_to_fit();
        self.items.shrink_to_fit();
    }
}

/// Groups of a range.
fn span(groups: usize, ranges: usize) -> usize {
    groups.div_ceil(ranges).max(1)
}

/// So many items, whatever they are: where they need new memory, pages that those who fill them touch first.
fn make_room<T: bytemuck::Pod>(items: &mut Vec<T>, count: usize) {
    if items.capacity() < count {
        *items = Vec::new();
        *items = bytemuck::zeroed_vec(count);
    }
    items.resize(count, T::zeroed());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_in_its_group_in_order_and_strangers_are_left_out() {
        // In a sensible order, in none, and few.
        let orders = [(50_000, 300, 1), (50_000, 1, 113), (100, 1, 200)];
        for (threads, (sources, step, around)) in [1, 2, 3, 4].into_iter().flat_map(|t| orders.map(|order| (t, order)))
        {
            let group = move |i: u32| i / step * 7 % around + i / step / around % 160 + i % 5;
            // Two pairs of each.
            let pairs = |range: Range<usize>| {
                range.flat_map(move |i| [(group(i as u32), i as u32), (group(i as u32) + 3, !(i as u32))])
            };
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut groups = Groups::default();
            groups.rebuild(3, 1, |_| [(2, 8), (u32::MAX, 9)].into_iter());
            pool.install(|| groups.rebuild(150, sources as usize, pairs));
            for group in 0..150 {
                let of_group = pairs(0..sources as usize).filter(|pair| pair.0 == group).map(|pair| pair.1);
                assert_eq!(groups.of(group as usize), of_group.collect::<Vec<_>>());
            }
        }
        let mut groups = Groups::default();
        groups.rebuild(3, 2, |range| [(2, 8), (u32::MAX, 9)][range].iter().copied());
        assert_eq!([0, 1, 2].map(|g| groups.of(g).to_vec()), [vec![], vec![], vec![8]]);
        assert_eq!(std::mem::take(&mut groups).into_parts(), (vec![0, 0, 0, 1], vec![8]));
        groups.rebuild(0, 0, |_| std::iter::empty());
    }
}
