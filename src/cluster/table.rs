//! The table of occupied cells: a position's cell to its number.
//!
//! Cells are found through blocks of 4³: a surface fills about 16 of a block's 64, so a scan in any sensible order
//! finds its block in the cache and the cell without a probe. Workers share the table without locks; numbers are
//! handed out first come, first served, and [`CellTable::ranks`] makes them independent of who came first. Whether the
//! table overflows depends on the scan alone: it does when there are more distinct cells or blocks than it has room
//! for.

use super::grid::{COORDINATE_BITS, LOCAL_BITS, MAX_CELLS, Steps, cell_key};
use crate::cores::InPieces;
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::*};

/// Cells for which the table has one block. Surfaces need one for 14 to 17 cells; sparse vertices need more, and then
/// the grid is chosen coarser.
const CELLS_PER_BLOCK: usize = 10;
/// Slots per block that may be taken, in quarters: linear probing stays short at a load of 4/5.
const SLOTS_PER_4_BLOCKS: usize = 5;

/// Bytes of a block slot: its key and 64 cell numbers.
const SLOT_BYTES: usize = 8 + 64 * 4;

/// A cell number that is being handed out.
const PENDING: u32 = u32::MAX;
/// A cell number that could not be handed out.
const REFUSED: u32 = u32::MAX - 1;

/// Concurrent map from cell to number.
pub(super) struct CellTable {
    /// A block's key plus one; 0 is a free slot.
    blocks: Vec<AtomicU64>,
    /// 64 a block in Morton order: a cell's number plus one, 0 for a cell not met yet.
    numbers: Vec<AtomicU32>,
    /// Each cell's key by number.
    keys: Vec<AtomicU64>,
    cells: AtomicU32,
    taken: AtomicU32,
    full: AtomicBool,
}

impl CellTable {
    /// Bytes of a table for `cells` cells, their keys included.
    pub(super) const fn bytes(cells: usize) -> usize {
        Self::slots(cells) * SLOT_BYTES + cells * 8
    }

    /// Blocks that a table for `cells` cells has room for.
    pub(super) const fn block_capacity(cells: usize) -> usize {
        cells / CELLS_PER_BLOCK + 16
    }

    const fn slots(cells: usize) -> usize {
        Self::block_capacity(cells) * SLOTS_PER_4_BLOCKS / 4
    }

    /// A table with room for `cells` cells. All of it is written at once: a page that is looked at before it is written is
    /// mapped twice, the second time with all other threads at a halt.
    pub(super) fn new(cells: usize) -> Self {
        let cells = cells.min(MAX_CELLS);
        let slots = Self::slots(cells);
        CellTable {
            blocks: (0..slots).into_par_iter().in_pieces(4096).map(|_| AtomicU64::new(0)).collect(),
            numbers: (0..slots * 64).into_par_iter().in_pieces(4096).map(|_| AtomicU32::new(0)).collect(),
            keys: bytemuck::zeroed_vec(cells),
            cells: AtomicU32::new(0),
            taken: AtomicU32::new(0),
            full: AtomicBool::new(false),
        }
    }

    /// Whether a cell was refused. What was binned is then worth nothing.
    #[inline]
    pub(super) fn is_full(&self) -> bool {
        self.full.load(Relaxed)
    }

    /// The number of the cell that holds a position, given out now if it is new; `None` when there is no room. Sooner
    /// where the position before was in the same block.
    #[inline(always)]
    pub(super) fn number(&self, s: Steps, last: &mut LastBlock) -> Option<u32> {
        self.number_at(block_key(s), place_in_block(s), || cell_key(s), last)
    }

    /// The same, of the cell at a [`place_in_block`] of a block.
    #[inline(always)]
    pub(super) fn number_at(
        &self,
        block: u64,
        place: usize,
        cell: impl FnOnce() -> u64,
        last: &mut LastBlock,
    ) -> Option<u32> {
        let key = block + 1;
        if last.key != key {
            *last = LastBlock { key, slot: self.slot(key)? };
        }
        let entry = &self.numbers[last.slot * 64 + place % 64];
        match entry.load(Acquire) {
            0 | PENDING | REFUSED => self.hand_out(entry, cell()),
            number => Some(number - 1),
        }
    }

    #[inline(always)]
    fn slot(&self, key: u64) -> Option<usize> {
        let mut slot = spread(key, self.blocks.len());
        loop {
            match self.blocks[slot].load(Relaxed) {
                found if found == key => return Some(slot),
                0 => {
                    if let Some(found) = self.take(slot, key) {
                        return found.then_some(slot);
                    }
                }
                _ => {}
            }
            slot += 1;
            if slot == self.blocks.len() {
                slot = 0;
            }
        }
    }

    /// Takes a free slot: `Some(true)` if it is the block's now, `Some(false)` if there is no room for another block,
    /// `None` if another block was faster.
    #[cold]
    fn take(&self, slot: usize, key: u64) -> Option<bool> {
        if self.is_full() {
            return Some(false);
        }
        match self.blocks[slot].compare_exchange(0, key, Relaxed, Relaxed) {
            Ok(_) => {
                let room = self.taken.fetch_add(1, Relaxed) < Self::block_capacity(self.keys.len()) as u32;
                if !room {
                    self.full.store(true, Relaxed);
                }
                Some(room)
            }
            Err(found) if found == key => Some(true),
            Err(_) => None,
        }
    }

    #[cold]
    fn hand_out(&self, entry: &AtomicU32, key: u64) -> Option<u32> {
        if entry.compare_exchange(0, PENDING, Acquire, Acquire).is_ok() {
            let number = self.cells.fetch_add(1, Relaxed);
            if number as usize >= self.keys.len() {
                self.full.store(true, Relaxed);
                entry.store(REFUSED, Release);
                return None;
            }
            self.keys[number as usize].store(key, Relaxed);
            entry.store(number + 1, Release);
            return Some(number);
        }
        // Another worker is between two instructions of the branch above.
        for turn in 1u32.. {
            match entry.load(Acquire) {
                PENDING if turn % 64 == 0 => std::thread::yield_now(),
                PENDING => std::hint::spin_loop(),
                REFUSED => return None,
                number => return Some(number - 1),
            }
        }
        None
    }

    /// Cells met so far.
    pub(super) fn len(&self) -> usize {
        (self.cells.load(Relaxed) as usize).min(self.keys.len())
    }

    /// The keys of cells met so far.
    pub(super) fn cells(&self) -> impl IndexedParallelIterator<Item = u64> {
        self.keys[..self.len()].par_iter().in_pieces(4096).map(|key| key.load(Relaxed))
    }

    /// Blocks met so far.
    pub(super) fn blocks(&self) -> usize {
        self.taken.load(Relaxed) as usize
    }

    /// The key of a cell that was numbered before by this worker or before its threads began.
    #[inline(always)]
    pub(super) fn key(&self, cell: u32) -> u64 {
        self.keys[cell as usize].load(Relaxed)
    }

    /// Has the keys of such cells brought near, so that the waits for them overlap.
    pub(super) fn fetch(&self, cells: impl Iterator<Item = u32>) {
        std::hint::black_box(cells.fold(0, |bits, cell| bits | self.key(cell)));
    }

    /// Has the places where blocks, and cells at a [`place_in_block`] of each, are looked up first brought near, so that the
    /// waits for them overlap: in a loop with little else in it, since a processor looks only so far ahead.
    pub(super) fn fetch_numbers<const N: usize>(&self, blocks: &[u64; N], places: &[u64; N]) {
        let slots = dispatch!(Level::new(), simd => first_slots(simd, blocks, self.blocks.len()));
        let bits = slots.iter().zip(places).fold(0, |bits, (slot, place)| {
            let slot = *slot as usize;
            let number = self.numbers[slot * 64 + *place as usize % 64].load(Relaxed);
            bits | self.blocks[slot].load(Relaxed) | u64::from(number)
        });
        std::hint::black_box(bits);
    }

    /// Each cell's rank in Morton order: a numbering that only the set of cells decides, and in which neighbours in
    /// space are neighbours in memory.
    pub(super) fn ranks(&self) -> Vec<u32> {
        let block = |(slot, key): (usize, &AtomicU64)| Some((morton(key.load(Relaxed).checked_sub(1)?), slot as u32));
        let mut order: Vec<(u64, u32)> = self.blocks.par_iter().enumerate().in_pieces(4096).filter_map(block).collect();
        order.par_sort_unstable();
        let numbers = |slot: u32| &self.numbers[slot as usize * 64..][..64];
        let count = |slot: u32| numbers(slot).iter().map(|number| u32::from(number.load(Relaxed) != 0)).sum::<u32>();
        let mut firsts: Vec<u32> = order.par_iter().in_pieces(256).map(|(_, slot)| count(*slot)).collect();
        let mut next = 0;
        for first in &mut firsts {
            next += std::mem::replace(first, next);
        }
        let ranks: Vec<AtomicU32> = bytemuck::zeroed_vec(self.len());
        order.par_iter().zip(firsts).in_pieces(256).for_each(|((_, slot), first)| {
            // Which of the places are taken is as good as random, so they are gathered without a branch.
            let (mut taken, mut cells) = ([0; 64], 0);
            for number in numbers(*slot) {
                let number = number.load(Relaxed);
                taken[cells % 64] = number;
                cells += usize::from(number != 0);
            }
            for (rank, number) in (first..).zip(&taken[..cells]) {
                if let Some(of) = ranks.get(*number as usize - 1) {
                    of.store(rank, Relaxed);
                }
            }
        });
        ranks.into_iter().map(AtomicU32::into_inner).collect()
    }

    /// Drops all but the cells' keys: nothing can be binned any more.
    pub(super) fn keep_keys(&mut self) {
        self.blocks = Vec::new();
        self.numbers = Vec::new();
    }
}

/// The block that was looked up last: its key plus one, 0 for none, and where it is.
#[derive(Default)]
pub(super) struct LastBlock {
    key: u64,
    slot: usize,
}

const BLOCK_BITS: u32 = COORDINATE_BITS - 2;

/// The key of the block of 4³ cells that holds a position.
#[inline(always)]
pub(super) fn block_key(s: Steps) -> u64 {
    const SHIFT: u32 = LOCAL_BITS + 2;
    (s[0] >> SHIFT) | (s[1] >> SHIFT) << BLOCK_BITS | (s[2] >> SHIFT) << (2 * BLOCK_BITS)
}

/// A cell's place among the 64 of its block, in Morton order.
#[inline(always)]
pub(super) fn place_in_block(s: Steps) -> usize {
    let bits = |x: u64| (x >> LOCAL_BITS & 1) | (x >> (LOCAL_BITS + 1) & 1) << 3;
    (bits(s[0]) | bits(s[1]) << 1 | bits(s[2]) << 2) as usize
}

/// A hash of `key` in `0..slots`, of which there are fewer than 2³².
#[inline(always)]
fn spread(key: u64, slots: usize) -> usize {
    (((mix(key) >> 32) * slots as u64) >> 32) as usize
}

/// The slots in which blocks are looked for first, worked out as wide as the processor's vectors.
#[inline(always)]
fn first_slots<V: Simd, const N: usize>(_: V, blocks: &[u64; N], slots: usize) -> [u64; N] {
    let mut first = [0; N];
    for (slot, block) in first.iter_mut().zip(blocks) {
        *slot = spread(block + 1, slots) as u64;
    }
    first
}

/// A hash whose upper bits depend on all of a key's.
#[inline(always)]
pub(super) fn mix(key: u64) -> u64 {
    let hash = key.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    (hash ^ hash >> 32).wrapping_mul(0xd6e8_feb8_6659_fd93)
}

/// A block key's coordinates, interleaved; what is above them stays there.
fn morton(key: u64) -> u64 {
    let mut code = key >> (3 * BLOCK_BITS) << (3 * BLOCK_BITS);
    for bit in 0..BLOCK_BITS {
        for axis in 0..3 {
            code |= (key >> (axis * BLOCK_BITS + bit) & 1) << (3 * bit + axis);
        }
    }
    code
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: u64, y: u64, z: u64) -> Steps {
        [x << LOCAL_BITS, y << LOCAL_BITS, z << LOCAL_BITS]
    }

    fn number(table: &CellTable, s: Steps) -> Option<u32> {
        table.number(s, &mut LastBlock::default())
    }

    #[test]
    fn a_cell_keeps_its_number_and_key() {
        let table = CellTable::new(100);
        let cells = [at(0, 0, 0), at(3, 3, 3), at(4, 0, 0), at(2_000_000, 5, 1_999_999), at(0, 0, 1)];
        let numbers = cells.map(|s| number(&table, s).unwrap());
        assert_eq!(numbers, [0, 1, 2, 3, 4]);
        assert_eq!(cells.map(|s| number(&table, s).unwrap()), numbers);
        for (s, n) in cells.into_iter().zip(numbers) {
            assert_eq!(table.key(n), cell_key(s));
        }
        assert_eq!(table.ranks(), [0, 2, 3, 4, 1]);
    }

    #[test]
    fn it_is_full_when_a_cell_or_a_block_has_no_room_and_not_before() {
        let table = CellTable::new(20);
        for x in 0..20 {
            assert!(number(&table, at(x, 0, 0)).is_some() && !table.is_full());
        }
        assert!(number(&table, at(20, 0, 0)).is_none() && table.is_full());

        let table = CellTable::new(20);
        for x in 0..18 {
            assert!(number(&table, at(8 * x, 0, 0)).is_some() && !table.is_full());
        }
        assert!(number(&table, at(8 * 18, 0, 0)).is_none() && table.is_full());
    }

    #[test]
    fn ranks_do_not_depend_on_who_came_first() {
        let cells: Vec<Steps> = (0..5000u64).map(|i| at(i * i % 97, i % 61, i * 7 % 13)).collect();
        let by_key = |workers: usize| {
            let table = CellTable::new(50_000);
            std::thread::scope(|scope| {
                for w in 0..workers {
                    let (table, cells) = (&table, &cells);
                    scope.spawn(move || (w * 1000..w * 1000 + 5000).for_each(|i| _ = number(table, cells[i % 5000])));
                }
            });
            let mut of: Vec<_> = table.ranks().into_iter().zip(0..).map(|(r, n)| (r, table.key(n))).collect();
            of.sort_unstable();
            of
        };
        let one = by_key(1);
        assert!(one.iter().enumerate().all(|(i, (rank, _))| i == *rank as usize));
        assert!(one == by_key(4));
    }
}
