//! Numbers in groups, by a counting sort that threads share.

use rayon::prelude::*;

/// Numbers by the group that each is in: those of group `g` are `items[first[g]..first[g + 1]]`, in the order in which
/// they came. 4 bytes an item and 4 a group.
#[derive(Debug, Default)]
pub struct Groups {
    first: Vec<u32>,
    items: Vec<u32>,
}

/// Into how many ranges of groups work is cut where each range goes through all items: more would cost more than it
/// spreads.
pub fn ranges() -> usize {
    rayon::current_num_threads().min(4)
}

impl Groups {
    /// Sorts the items of `pairs` into `groups` groups, reusing the memory; a pair is a group and an item, and one whose
    /// group is not among them is left out. Groups are cut into `ranges`, each of which goes through all pairs for what is
    /// its own, so that nothing depends on their number.
    pub fn rebuild<I: Iterator<Item = (u32, u32)>>(
        &mut self,
        groups: usize,
        ranges: usize,
        pairs: impl Fn() -> I + Sync,
    ) {
        let Groups { first, items } = self;
        first.clear();
        first.resize(groups + 1, 0);
        let span = groups.div_ceil(ranges).max(1);

        // first[g + 1] counts g's items, then holds where they begin, and after filling where they end.
        first[1..].par_chunks_mut(span).enumerate().for_each(|(range, counts)| {
            let low = (range * span) as u32;
            pairs().for_each(|(group, _)| {
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
            pairs().for_each(|(group, item)| {
                if let Some(cursor) = cursors.get_mut(group.wrapping_sub(low) as usize) {
                    part[(*cursor - base) as usize] = item;
                    *cursor += 1;
                }
            });
        });
    }

    /// The items of a group.
    #[inline(always)]
    pub fn of(&self, group: usize) -> &[u32] {
        &self.items[self.first[group] as usize..self.first[group + 1] as usize]
    }

    /// Where each group begins and the last one ends, and all items, one group after the other.
    pub fn into_parts(self) -> (Vec<u32>, Vec<u32>) {
        (self.first, self.items)
    }

    /// Gives back the memory that is not in use.
    pub fn give_back(&mut self) {
        self.first.shrink_to_fit();
        self.items.shrink_to_fit();
    }
}

/// So many items, whatever they are: where they need new memory, pages that those who fill them touch first.
fn make_room(items: &mut Vec<u32>, count: usize) {
    if items.capacity() < count {
        *items = Vec::new();
        *items = bytemuck::zeroed_vec(count);
    }
    items.resize(count, 0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_in_its_group_in_order_and_strangers_are_left_out() {
        let pairs = || (0..5000u32).map(|i| (i * 7 % 113 + i % 5, i));
        let mut groups = Groups::default();
        for ranges in [3, 1, 2, 4] {
            groups.rebuild(100, ranges, pairs);
            for group in 0..100 {
                let expected: Vec<u32> = pairs().filter(|pair| pair.0 == group).map(|pair| pair.1).collect();
                assert_eq!(groups.of(group as usize), expected);
            }
        }
        groups.rebuild(3, 2, || [(2, 8), (u32::MAX, 9)].into_iter());
        assert_eq!([0, 1, 2].map(|g| groups.of(g).to_vec()), [vec![], vec![], vec![8]]);
        assert_eq!(std::mem::take(&mut groups).into_parts(), (vec![0, 0, 0, 1], vec![8]));
        groups.rebuild(0, 2, std::iter::empty);
    }
}
