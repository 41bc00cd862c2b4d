//! Faces that survive: three corners in three cells.
//!
//! They are kept as triples of cell numbers in one array that all workers append to, and *netted* at the end: of
//! coincident triples, pairs of opposite orientation go. A pair takes two faces from each of its edges and one triple
//! alone is never taken, so no edge gains or loses an odd number of faces: where the scan is closed, what is left is
//! closed.

use crate::cores::InPieces;
use crate::error::Result;
use crate::mesh::groups::Groups;
use crate::progress::Progress;
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

/// Renumbers triples, turns each so that its least cell leads, sorts them and takes opposite pairs out: of `n₊` and
/// `n₋` coincident triples of the two orientations `|n₊ − n₋|` stay. In place, and in `room` bytes beside if 8 a triple and 4
/// a cell are there. Returns the pairs taken.
pub(super) fn net(triples: &mut Vec<[u32; 3]>, ranks: &[u32], room: usize, progress: &Progress) -> Result<u64> {
    triples.par_iter_mut().in_pieces(4096).for_each(|triple| *triple = encode(triple.map(|cell| ranks[cell as usize])));
    progress.check()?;
    if size_of::<Led>() * triples.len() + 4 * ranks.len() <= room {
        return net_by_cell(triples, ranks.len(), progress);
    }
    triples.par_sort_unstable_by_key(|&[a, b, c]| u128::from(a) << 64 | u128::from(key([b, c])));
    progress.check()?;
    let (mut kept, mut pairs) = (0, 0);
    let mut next = 0;
    while let Some(&[a, b, c]) = triples.get(next) {
        let coincides = |other: &&[u32; 3]| other[0] == a && coincide([b, c], [other[1], other[2]]);
        let coincident = triples[next..].iter().take_while(coincides);
        let end = next + coincident.clone().count();
        let flipped = coincident.filter(|triple| triple[2] & FLIPPED != 0).count();
        let (majority, stay, opposite) = netted(end - next, flipped);
        let majority = decode(triples[next + majority]);
        triples[kept..kept + stay].fill(majority);
        (next, kept, pairs) = (end, kept + stay, pairs + opposite);
    }
    triples.truncate(kept);
    Ok(pairs)
}

/// Of so many coincident triples, in order, of which so many are flipped: which one stays, how often, and the pairs that go.
#[inline(always)]
fn netted(all: usize, flipped: usize) -> (usize, usize, u64) {
    let plain = all - flipped;
    (if plain > flipped { 0 } else { all - 1 }, plain.abs_diff(flipped), plain.min(flipped) as u64)
}

/// An encoded triple without its least cell.
type Led = [u32; 2];

/// What they are sorted by: one number, since two are compared with branches that nobody can predict.
#[inline]
fn key([b, c]: Led) -> u64 {
    u64::from(b) << 32 | u64::from(c)
}

/// Whether two triples that one cell leads have the same cells.
#[inline]
fn coincide(one: Led, other: Led) -> bool {
    key(one) >> 1 == key(other) >> 1
}

/// Cells that are netted by one task.
const PART: usize = 1024;

/// Sorts and nets encoded triples of so many cells. A cell leads two or three, so they are counted into it and sorted there.
fn net_by_cell(triples: &mut Vec<[u32; 3]>, cells: usize, progress: &Progress) -> Result<u64> {
    let mut led = Groups::<Led>::default();
    led.rebuild(cells, triples.len(), |range| triples[range].iter().map(|&[a, b, c]| (a, [b, c])));
    progress.check()?;
    let (first, mut led) = led.into_parts();
    let (mut rest, mut room) = (led.as_mut_slice(), triples.as_mut_slice());
    let part = |begin: usize| {
        let first = &first[begin..first.len().min(begin + PART + 1)];
        let count = (first[first.len() - 1] - first[0]) as usize;
        let (led, later) = std::mem::take(&mut rest).split_at_mut(count);
        let (to, behind) = std::mem::take(&mut room).split_at_mut(count);
        (rest, room) = (later, behind);
        (begin as u32, first, led, to)
    };
    let parts: Vec<_> = (0..cells).step_by(PART).map(part).collect();
    let netted: Vec<(usize, usize, u64)> = (parts.into_par_iter().in_pieces(1))
        .map(|(begin, first, led, to)| {
            let (kept, pairs) = net_led(begin, first, led, to);
            (to.len(), kept, pairs)
        })
        .collect();
    progress.check()?;
    let (mut begin, mut kept, mut pairs) = (0, 0, 0);
    for (length, kept_here, pairs_here) in netted {
        triples.copy_within(begin..begin + kept_here, kept);
        (begin, kept, pairs) = (begin + length, kept + kept_here, pairs + pairs_here);
    }
    triples.truncate(kept);
    Ok(pairs)
}

/// The same of those that cells from `begin` on lead, each from one of `first` to the next: how many are kept, in `to`, and
/// the pairs taken.
fn net_led(begin: u32, first: &[u32], led: &mut [Led], to: &mut [[u32; 3]]) -> (usize, u64) {
    let (mut kept, mut pairs) = (0, 0);
    let mut rest = led;
    for (a, ends) in (begin..).zip(first.windows(2)) {
        let (of_cell, later) = std::mem::take(&mut rest).split_at_mut((ends[1] - ends[0]) as usize);
        rest = later;
        of_cell.sort_unstable_by_key(|led| key(*led));
        for coincident in of_cell.chunk_by(|one, other| coincide(*one, *other)) {
            let flipped = coincident.iter().filter(|led| led[1] & FLIPPED != 0).count();
            let (majority, stay, opposite) = netted(coincident.len(), flipped);
            let [b, c] = coincident[majority];
            to[kept..kept + stay].fill(decode([a, b, c]));
            (kept, pairs) = (kept + stay, pairs + opposite);
        }
    }
    (kept, pairs)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cores::on_threads;
    use std::collections::HashMap;

    fn netted(triples: &[[u32; 3]], workers: usize) -> (Vec<[u32; 3]>, u64) {
        let ranks: Vec<u32> = (0..4000).collect();
        let net = |room: usize| {
            let mut triples = triples.to_vec();
            let pairs = net(&mut triples, &ranks, room, &Progress::default())?;
            Ok((triples, pairs))
        };
        // In place, and with room beside.
        let needed = 4 * ranks.len() + 8 * triples.len();
        let [in_place, by_cell] = [0, needed].map(|room| on_threads(workers, || net(room)).unwrap());
        assert_eq!(in_place, by_cell);
        by_cell
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
            .map(|i| [i * 7 % 19, 20 + i * i % 23, 45 + i / 3 % 17].map(|cell| 60 * cell))
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
