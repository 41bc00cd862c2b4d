//! Faces that survive: three corners in three cells.
//!
//! They are kept as triples of cell numbers in one array that all workers append to, and *netted* at the end: of
//! coincident triples, pairs of opposite orientation go. A pair takes two faces from each of its edges and one triple
//! alone is never taken, so no edge gains or loses an odd number of faces: where the scan is closed, what is left is
//! closed.

use crate::cores::InPieces;
use crate::error::Result;
use crate::read::Crew;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering::Relaxed};

/// Bytes of a surviving triple.
pub(super) const TRIPLE_BYTES: usize = 12;

/// Triples that a worker holds back before it appends them.
const HELD_BACK: usize = 1024;
/// Bytes of a worker's [`Appender`].
pub(super) const APPENDER_BYTES: usize = HELD_BACK * TRIPLE_BYTES;

/// Where workers append triples.
pub(super) struct Survivors {
    /// Three a triple.
    cells: Vec<AtomicU32>,
    count: AtomicUsize,
}

impl Survivors {
    /// Room for `capacity` triples; pages are touched as they fill.
    pub(super) fn new(capacity: usize) -> Self {
        Survivors { cells: bytemuck::zeroed_vec(capacity * 3), count: AtomicUsize::new(0) }
    }

    /// How many were appended, more than there is room for included.
    pub(super) fn count(&self) -> usize {
        self.count.load(Relaxed)
    }

    /// Whether more were appended than there is room for.
    pub(super) fn overflowed(&self) -> bool {
        self.count() > self.cells.len() / 3
    }

    fn append(&self, triples: &[[u32; 3]]) {
        let first = self.count.fetch_add(triples.len(), Relaxed) * 3;
        // Past the end nothing is stored but all is counted.
        let room = self.cells.get(first..).unwrap_or_default();
        for (cell, x) in room.iter().zip(triples.as_flattened()) {
            cell.store(*x, Relaxed);
        }
    }

    /// The triples, in whatever order they came.
    pub(super) fn into_triples(self) -> Vec<[u32; 3]> {
        let count = self.count();
        let mut cells = self.cells;
        // Pages that no triple has touched stay untouched.
        cells.truncate(count * 3);
        let mut cells: Vec<u32> = cells.into_iter().map(AtomicU32::into_inner).collect();
        let whole = cells.capacity() / 3 * 3;
        cells.shrink_to(whole);
        bytemuck::try_cast_vec(cells).unwrap_or_else(|(_, cells)| cells.as_chunks().0.to_vec())
    }
}

/// A worker's end of [`Survivors`].
pub(super) struct Appender<'a> {
    survivors: &'a Survivors,
    held: Box<[[u32; 3]; HELD_BACK]>,
    count: usize,
}

impl<'a> Appender<'a> {
    pub(super) fn new(survivors: &'a Survivors) -> Self {
        Appender { survivors, held: Box::new([[0; 3]; HELD_BACK]), count: 0 }
    }

    /// Appends a triple if it survives, which no processor can predict.
    #[inline(always)]
    pub(super) fn push_if(&mut self, survives: bool, triple: [u32; 3]) {
        self.held[self.count % HELD_BACK] = triple;
        self.count += usize::from(survives);
        if self.count == HELD_BACK {
            self.flush();
        }
    }

    #[inline(never)]
    pub(super) fn flush(&mut self) {
        self.survivors.append(&self.held[..self.count]);
        self.count = 0;
    }
}

/// Says which way round a sorted triple goes, in the lowest bit of its last number.
const FLIPPED: u32 = 1;

/// A triple as it is sorted: least cell, the two others in order, and the orientation as lowest bit.
#[inline]
fn encode([a, b, c]: [u32; 3]) -> [u32; 3] {
    let [a, b, c] = if a < b && a < c {
        [a, b, c]
    } else if b < c {
        [b, c, a]
    } else {
        [c, a, b]
    };
    if b < c { [a, b, c << 1] } else { [a, c, b << 1 | FLIPPED] }
}

#[inline]
fn decode([a, b, c]: [u32; 3]) -> [u32; 3] {
    if c & FLIPPED == 0 { [a, b, c >> 1] } else { [a, c >> 1, b] }
}

/// What triples are sorted by: one number, since three are compared with branches that nobody can predict.
#[inline]
fn key([a, b, c]: [u32; 3]) -> u128 {
    u128::from(a) << 64 | u128::from(b) << 32 | u128::from(c)
}

/// Whether two triples have the same cells.
#[inline]
fn coincide(one: [u32; 3], other: [u32; 3]) -> bool {
    key(one) >> 1 == key(other) >> 1
}

/// Parts that triples are sorted in, at most: each of them stays near, and so do the ends of all while they are filled.
const PARTS: usize = 1 << 12;

/// Renumbers triples, turns each so that its least cell leads, sorts them and takes opposite pairs out: of `n₊` and
/// `n₋` coincident triples of the two orientations `|n₊ − n₋|` stay. In place. Returns the pairs taken.
pub(super) fn net(triples: &mut Vec<[u32; 3]>, ranks: &[u32], crew: &Crew) -> Result<u64> {
    triples.par_iter_mut().in_pieces(4096).for_each(|triple| *triple = encode(triple.map(|cell| ranks[cell as usize])));
    crew.progress.check()?;
    let parts = parted(triples, ranks.len());
    crew.progress.check()?;
    let netted: Vec<(usize, usize, u64)> = (parts.into_par_iter().in_pieces(16))
        .map(|part| {
            part.sort_unstable_by_key(|triple| key(*triple));
            let (kept, pairs) = net_sorted(part);
            (part.len(), kept, pairs)
        })
        .collect();
    crew.progress.check()?;
    let (mut begin, mut kept, mut pairs) = (0, 0, 0);
    for (length, kept_here, pairs_here) in netted {
        triples.copy_within(begin..begin + kept_here, kept);
        (begin, kept, pairs) = (begin + length, kept + kept_here, pairs + pairs_here);
    }
    triples.truncate(kept);
    Ok(pairs)
}

/// Puts triples in order of the upper bits of their least ones of so many cells, in place: the parts that this makes.
fn parted(triples: &mut [[u32; 3]], cells: usize) -> Vec<&mut [[u32; 3]]> {
    let shift = (cells / PARTS).checked_ilog2().map_or(0, |bits| bits + 1);
    let part_of = |triple: &[u32; 3]| (triple[0] >> shift) as usize;
    let mut counts = vec![0usize; PARTS];
    triples.iter().for_each(|triple| counts[part_of(triple)] += 1);
    let mut next: Vec<usize> = Vec::with_capacity(counts.len());
    let mut end = 0;
    for count in &counts {
        next.push(end);
        end += count;
    }
    // Each triple goes where its part goes on, and the one that was there is next, until one belongs where the first was.
    end = 0;
    for (part, count) in counts.iter().enumerate() {
        end += count;
        while next[part] < end {
            let mut triple = triples[next[part]];
            loop {
                let home = part_of(&triple);
                std::mem::swap(&mut triples[next[home]], &mut triple);
                next[home] += 1;
                if home == part {
                    break;
                }
            }
        }
    }
    let mut rest = triples;
    let part = |count: usize| {
        let (part, later) = std::mem::take(&mut rest).split_at_mut(count);
        rest = later;
        part
    };
    counts.into_iter().map(part).collect()
}

/// The same of sorted triples: how many are kept, in front, and the pairs taken.
fn net_sorted(triples: &mut [[u32; 3]]) -> (usize, u64) {
    let (mut kept, mut pairs) = (0, 0);
    let mut next = 0;
    while next < triples.len() {
        let [a, b, c] = triples[next];
        let group = triples[next..].iter().take_while(|t| coincide(**t, [a, b, c])).count();
        let plain = triples[next..next + group].iter().take_while(|t| t[2] & FLIPPED == 0).count();
        let flipped = group - plain;
        let last = triples[next + group - 1];
        let majority = if plain > flipped { [a, b, c] } else { last };
        for _ in 0..plain.abs_diff(flipped) {
            triples[kept] = decode(majority);
            kept += 1;
        }
        pairs += plain.min(flipped) as u64;
        next += group;
    }
    (kept, pairs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Progress;
    use std::collections::HashMap;

    fn netted(triples: &[[u32; 3]], workers: usize) -> (Vec<[u32; 3]>, u64) {
        let ranks: Vec<u32> = (0..100).collect();
        let mut triples = triples.to_vec();
        let progress = Progress::default();
        let pairs = net(&mut triples, &ranks, &Crew { workers, progress: &progress }).unwrap();
        (triples, pairs)
    }

    #[test]
    fn opposite_pairs_go_and_orientation_stays() {
        let triples = [[3, 2, 1], [1, 2, 3], [9, 5, 7], [2, 3, 1], [7, 5, 9], [5, 9, 7], [4, 6, 5]];
        let (kept, pairs) = netted(&triples, 1);
        assert_eq!(kept, [[1, 2, 3], [4, 6, 5], [5, 9, 7]]);
        assert_eq!(pairs, 2);
    }

    #[test]
    fn edges_keep_their_parity_and_threads_do_not_matter() {
        let triples: Vec<[u32; 3]> = (0..40_000u32)
            .map(|i| [i * 7 % 19, 20 + i * i % 23, 45 + i / 3 % 17])
            .enumerate()
            .map(|(i, [a, b, c])| if i % 3 == 0 { [c, b, a] } else { [b, c, a] })
            .collect();
        let parity = |triples: &[[u32; 3]]| {
            let mut odd: HashMap<(u32, u32), bool> = HashMap::new();
            for [a, b, c] in triples {
                for (u, v) in [(a, b), (b, c), (c, a)] {
                    *odd.entry((*u.min(v), *u.max(v))).or_default() ^= true;
                }
            }
            odd.retain(|_, odd| *odd);
            odd
        };
        let (kept, pairs) = netted(&triples, 1);
        assert_eq!(kept.len() as u64 + 2 * pairs, triples.len() as u64);
        assert!(pairs > 1000);
        assert_eq!(parity(&kept), parity(&triples));
        assert_eq!((kept, pairs), netted(&triples, 3));
    }

    #[test]
    fn appending_beyond_the_room_is_counted() {
        let survivors = Survivors::new(3);
        let mut appender = Appender::new(&survivors);
        for i in 0..3 {
            appender.push_if(false, [9; 3]);
            appender.push_if(true, [i, i + 1, i + 2]);
        }
        appender.flush();
        assert!(!survivors.overflowed());
        appender.push_if(true, [7, 8, 9]);
        appender.flush();
        assert!(survivors.overflowed() && survivors.count() == 4);

        let survivors = Survivors::new(5);
        let mut appender = Appender::new(&survivors);
        appender.push_if(true, [1, 2, 3]);
        appender.flush();
        assert_eq!(survivors.into_triples(), [[1, 2, 3]]);
    }
}
