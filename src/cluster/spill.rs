//! Binned vertices: in memory when they fit (`resident.rs`); packed in a scratch file when they do not.
//!
//! **Packed.** Vertices that follow one another share cells: each 512 of them, a *strip*, keep a list of their cells,
//! and a vertex its place in the cell (39 bits) and in that list (9 bits), 6 bytes. The list is written as differences,
//! a byte to four for a cell: a third of a byte a vertex where vertices are in a sensible order, 2 to 4 where they are
//! shuffled. Workers write as many vertices as they bin at once, a *lot*, wherever the file ends; lots are found by
//! their first vertex, strips by a list at the beginning of the lot.
//!
//! The file is read with positioned reads only: pages of it that the system keeps in memory are the system's, not
//! ours, so the resident set stays what the arithmetic says. 16 bytes a lot stay in memory: one for 16,384 vertices.

use super::grid::{Corner, LOCAL_BITS};
use super::resident::{Binned, Resident};
use super::used::Used;
use crate::error::Result;
use crate::scratch::{Scratch, ScratchFile};
use std::ops::Range;
use std::sync::{Mutex, PoisonError};

/// Vertices of a strip.
const STRIP: usize = 512;
/// Bytes of a vertex in a strip.
const RECORD: usize = 6;
/// Bytes behind strips: the last record is read in one word, as all are.
const SPARE: usize = 8 - RECORD;
/// Bits of a place in the cell.
const PLACE_BITS: u32 = 3 * LOCAL_BITS;

/// Vertices a page of a [`PageCache`] holds.
const PAGE: usize = 512;
/// Pages that a [`PageCache`] holds, a power of two.
const PAGES: usize = 512;

/// Bytes of a [`PageCache`]: a page may lie in two strips, or where lots meet in three.
pub(super) const PAGE_CACHE_BYTES: usize = PAGES * (PAGE * (8 + 1) + 4) + 3 * STRIP * (RECORD + 4);

/// One [`Corner`] a vertex.
pub(super) enum Spill {
    /// All in memory.
    Resident(Resident),
    /// On scratch.
    Filed(SpillFile),
}

/// The same while workers write to it, or ask for corners.
pub(super) enum Opened<'a> {
    /// All in memory.
    Resident(Binned<'a>),
    /// On scratch.
    Filed(&'a SpillFile),
}

/// The scratch file of a [`Spill`].
pub(super) struct SpillFile {
    file: ScratchFile,
    vertices: u64,
    /// As they are written.
    fresh: Mutex<Vec<Lot>>,
    /// In order, once all are written.
    lots: Vec<Lot>,
}

/// Consecutive vertices that were written at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Lot {
    first: u64,
    offset: u64,
}

impl Spill {
    /// Whether a spill for `vertices` vertices is resident: if they take at most `resident_bytes`.
    pub(super) fn is_resident(vertices: u64, resident_bytes: u64) -> bool {
        vertices.saturating_mul(8) <= resident_bytes
    }

    /// A spill for `vertices` vertices, resident if they take at most `resident_bytes` and the system gives them. Faces have
    /// them in a sensible order, if they are `coherent`.
    pub(super) fn new(vertices: u64, resident_bytes: u64, scratch: &Scratch, coherent: bool) -> Result<Self> {
        if Spill::is_resident(vertices, resident_bytes)
            && let Ok(resident) = Resident::of(vertices, coherent)
        {
            return Ok(Spill::Resident(resident));
        }
        Ok(Spill::Filed(SpillFile { file: scratch.file()?, vertices, fresh: Mutex::default(), lots: Vec::new() }))
    }

    /// Opens it to workers.
    pub(super) fn open(&mut self) -> Opened<'_> {
        match self {
            Spill::Resident(resident) => Opened::Resident(resident.open()),
            Spill::Filed(spill) => Opened::Filed(spill),
        }
    }

    /// Whether the vertices that faces have are noted when their corners are asked for.
    pub(super) fn notes_used(&self) -> bool {
        matches!(self, Spill::Resident(resident) if resident.notes_used())
    }

    /// How many vertices no face has, if that is noted.
    pub(super) fn unused(&self) -> Option<u64> {
        match self {
            Spill::Resident(resident) => resident.unused(),
            Spill::Filed(_) => None,
        }
    }

    /// All are written, and in so many cells; now they can be read.
    pub(super) fn close(&mut self, cells: usize) {
        match self {
            Spill::Resident(resident) => resident.close(cells),
            Spill::Filed(spill) => {
                spill.lots = std::mem::take(spill.fresh.get_mut().unwrap_or_else(PoisonError::into_inner));
                spill.lots.sort_unstable();
            }
        }
    }
}

impl Opened<'_> {
    /// Stores the corners of consecutive vertices.
    pub(super) fn write(&self, first: u64, corners: &[Corner], packer: &mut Packer) -> Result<()> {
        match self {
            Opened::Resident(binned) => {
                binned.write(first, corners);
                Ok(())
            }
            Opened::Filed(spill) => spill.write(first, corners, packer),
        }
    }
}

impl SpillFile {
    /// Number of vertices.
    pub(super) fn vertices(&self) -> u64 {
        self.vertices
    }

    fn write(&self, first: u64, corners: &[Corner], packer: &mut Packer) -> Result<()> {
        if corners.is_empty() {
            return Ok(());
        }
        let offset = self.file.append(packer.pack(corners))?;
        self.fresh.lock().unwrap_or_else(PoisonError::into_inner).push(Lot { first, offset });
        Ok(())
    }

    /// Reads the corners of consecutive vertices.
    pub(super) fn read(&self, first: u64, mut corners: &mut [Corner], reader: &mut Reader) -> Result<()> {
        let mut at = first;
        while !corners.is_empty() {
            if !reader.lot.contains(&at) {
                self.find_lot(at, reader)?;
            }
            let count = (reader.lot.end - at).min(corners.len() as u64);
            let now;
            (now, corners) = corners.split_at_mut(count as usize);
            self.read_of_lot((at - reader.lot.start) as usize, now, reader)?;
            at += count;
        }
        Ok(())
    }

    /// Has a reader know the lot of a vertex.
    fn find_lot(&self, vertex: u64, reader: &mut Reader) -> Result<()> {
        let next = self.lots.partition_point(|lot| lot.first <= vertex);
        let Lot { first, offset } = self.lots[next - 1];
        let end = self.lots.get(next).map_or(self.vertices, |lot| lot.first);
        reader.lot = 0..0;
        reader.starts.resize(((end - first) as usize).div_ceil(STRIP) + 1, 0);
        self.file.read_exact_at(bytemuck::cast_slice_mut(&mut reader.starts), offset)?;
        (reader.lot, reader.offset) = (first..end, offset);
        Ok(())
    }

    /// Those of the lot that `reader` knows, from its vertex `first` on.
    fn read_of_lot(&self, first: usize, corners: &mut [Corner], reader: &mut Reader) -> Result<()> {
        let Reader { offset, starts, bytes, .. } = reader;
        let starts = &starts[first / STRIP..=(first + corners.len()).div_ceil(STRIP)];
        let [begin, .., end] = *starts else { return Ok(()) };
        bytes.resize((end - begin) as usize + SPARE, 0);
        let (packed, _) = bytes.split_at_mut((end - begin) as usize);
        self.file.read_exact_at(packed, *offset + u64::from(begin))?;
        let (mut left, mut from) = (corners, first % STRIP);
        for start in &starts[..starts.len() - 1] {
            let now;
            (now, left) = left.split_at_mut(left.len().min(STRIP - from));
            unpack(&bytes[(start - begin) as usize..], from, now);
            from = 0;
        }
        Ok(())
    }
}

/// What reading keeps from one time to the next.
#[derive(Default)]
pub(super) struct Reader {
    /// The vertices of the lot that was last read from, and where in the file it begins.
    lot: Range<u64>,
    offset: u64,
    /// Where in the lot its strips begin, and where the last of them ends.
    starts: Vec<u32>,
    /// Packed corners.
    bytes: Vec<u8>,
}

/// Packs corners of vertices that follow one another; one a worker.
pub(super) struct Packer {
    bytes: Vec<u8>,
    /// Cells of the strip, found by their low bits or from there on.
    slots: Vec<Slot>,
    strips: u32,
    cells: Vec<u32>,
}

/// A cell's place in the list of the strip that it was last in.
#[derive(Debug, Clone, Copy, Default)]
struct Slot {
    strip: u32,
    cell: u32,
    place: u32,
}

/// Twice as many as a strip has vertices, a power of two.
const SLOTS: usize = 2 * STRIP;

impl Packer {
    pub(super) fn new() -> Self {
        let slots = vec![Slot::default(); SLOTS];
        Packer { bytes: Vec::new(), slots, strips: 0, cells: Vec::with_capacity(STRIP) }
    }

    /// A lot: where its strips start and where it ends, then the strips.
    fn pack(&mut self, corners: &[Corner]) -> &[u8] {
        let count = corners.len().div_ceil(STRIP);
        self.bytes.clear();
        self.bytes.resize(4 * (count + 1), 0);
        for (i, strip) in corners.chunks(STRIP).enumerate() {
            self.mark_start(i);
            self.pack_strip(strip);
        }
        self.mark_start(count);
        &self.bytes
    }

    fn mark_start(&mut self, strip: usize) {
        let start = self.bytes.len() as u32;
        self.bytes[4 * strip..][..4].copy_from_slice(&start.to_ne_bytes());
    }

    /// How many cells there are, their numbers, and the vertices.
    fn pack_strip(&mut self, corners: &[Corner]) {
        // Slots of strips before are worth nothing, whatever they hold.
        self.strips += 1;
        self.cells.clear();
        let mut words = [0u64; STRIP];
        let (mut last, mut place) = (u32::MAX, 0);
        for (word, corner) in words.iter_mut().zip(corners) {
            let cell = corner.cell();
            if cell != last {
                (last, place) = (cell, self.place(cell));
            }
            *word = corner.0 & ((1 << PLACE_BITS) - 1) | u64::from(place) << PLACE_BITS;
        }
        self.bytes.extend((self.cells.len() as u16).to_ne_bytes());
        let mut before = 0;
        for &cell in &self.cells {
            // Up and down alternate, so that what is near zero is small; seven bits a byte, the highest says whether more
            // follow.
            let difference = cell.wrapping_sub(before) as i32;
            let mut rest = (difference << 1 ^ difference >> 31) as u32;
            before = cell;
            while rest >= 0x80 {
                self.bytes.push(rest as u8 | 0x80);
                rest >>= 7;
            }
            self.bytes.push(rest as u8);
        }
        let first = self.bytes.len();
        self.bytes.resize(first + RECORD * corners.len(), 0);
        for (word, record) in words.iter().zip(self.bytes[first..].as_chunks_mut::<RECORD>().0) {
            record.copy_from_slice(&word.to_le_bytes()[..RECORD]);
        }
    }

    /// The place of a cell in the strip's list.
    fn place(&mut self, cell: u32) -> u32 {
        let mut at = cell as usize % SLOTS;
        loop {
            let slot = &mut self.slots[at];
            if slot.strip != self.strips {
                let place = self.cells.len() as u32;
                *slot = Slot { strip: self.strips, cell, place };
                self.cells.push(cell);
                return place;
            }
            if slot.cell == cell {
                return slot.place;
            }
            at = (at + 1) % SLOTS;
        }
    }
}

/// Corners of a strip's vertices, from `first` on; behind the strip there are [`SPARE`] bytes at least.
fn unpack(strip: &[u8], first: usize, corners: &mut [Corner]) {
    let mut cells = [0u64; STRIP];
    let count = usize::from(u16::from_ne_bytes([strip[0], strip[1]]));
    let (mut at, mut cell) = (2, 0u32);
    for known in &mut cells[..count] {
        let (mut rest, mut shift) = (0u32, 0);
        loop {
            let byte = strip[at];
            at += 1;
            rest |= u32::from(byte & 0x7f) << shift;
            shift += 7;
            if byte < 0x80 {
                break;
            }
        }
        cell = cell.wrapping_add(rest >> 1 ^ (rest & 1).wrapping_neg());
        *known = u64::from(cell) << PLACE_BITS;
    }
    let records = &strip[at + RECORD * first..];
    for (corner, at) in corners.iter_mut().zip((0..).step_by(RECORD)) {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&records[at..at + 8]);
        let word = u64::from_le_bytes(bytes);
        let place = (word >> PLACE_BITS) as usize % STRIP;
        *corner = Corner(cells[place] | word & ((1 << PLACE_BITS) - 1));
    }
}

/// A worker's window on a spill file: 2 MiB of pages, found by the low bits of their number. Scans in a sensible order
/// hit it; others are joined instead. Vertices that are asked for are marked beside their corners, a byte each, and a page's
/// marks are handed on when it makes room: three bits a face in a set of all vertices would be another wait for memory.
pub(super) struct PageCache<'a> {
    spill: &'a SpillFile,
    used: &'a Used,
    pages: Vec<Corner>,
    /// 1 for a vertex that was asked for.
    marks: Vec<u8>,
    /// The number of each held page; one that no vertex has for none.
    held: Vec<u32>,
    reader: Reader,
}

impl<'a> PageCache<'a> {
    /// Vertices that are asked for count as `used`, once the cache [is finished](Self::finish).
    pub(super) fn new(spill: &'a SpillFile, used: &'a Used) -> Self {
        let (pages, marks) = (bytemuck::zeroed_vec(PAGES * PAGE), vec![0; PAGES * PAGE]);
        PageCache { spill, used, pages, marks, held: vec![u32::MAX; PAGES], reader: Reader::default() }
    }

    /// The corner of a vertex that a face has.
    #[inline(always)]
    pub(super) fn get(&mut self, vertex: u32) -> Result<Corner> {
        let page = vertex / PAGE as u32;
        let slot = page as usize % PAGES;
        if self.held[slot] != page {
            self.fetch(slot, page)?;
        }
        let at = slot * PAGE + vertex as usize % PAGE;
        self.marks[at] = 1;
        Ok(self.pages[at])
    }

    #[cold]
    fn fetch(&mut self, slot: usize, page: u32) -> Result<()> {
        self.hand_on(slot);
        let first = u64::from(page) * PAGE as u64;
        let count = (self.spill.vertices() - first).min(PAGE as u64) as usize;
        self.spill.read(first, &mut self.pages[slot * PAGE..][..count], &mut self.reader)?;
        self.held[slot] = page;
        Ok(())
    }

    /// Hands on the marks of a page, which is held no more.
    fn hand_on(&mut self, slot: usize) {
        let page = std::mem::replace(&mut self.held[slot], u32::MAX);
        if page != u32::MAX {
            let marks = &mut self.marks[slot * PAGE..][..PAGE];
            self.used.add_marked(page * PAGE as u32, marks);
            marks.fill(0);
        }
    }

    /// Hands on all that is still marked.
    pub(super) fn finish(mut self) {
        (0..PAGES).for_each(|slot| self.hand_on(slot));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Vertices as a scan of rows has them, six to a cell, with some that are nowhere.
    fn rows(n: usize) -> Vec<Corner> {
        let corner = |v: usize| {
            let (x, y) = (v % 1000, v / 1000);
            let place = (v as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> (64 - PLACE_BITS);
            let cell = 5000 + (x / 6 + 167 * (y / 6)) as u32;
            if v % 997 == 3 { Corner::NOWHERE } else { Corner::at(cell, place) }
        };
        (0..n).map(corner).collect()
    }

    /// Writes lots of all lengths, last lots first.
    fn filed(corners: &[Corner], folder: &std::path::Path) -> SpillFile {
        let mut spill = Spill::new(corners.len() as u64, 0, &Scratch::in_folder(folder), true).unwrap();
        let mut packer = Packer::new();
        let mut lots = Vec::new();
        let (mut first, mut length) = (0, 1);
        while first < corners.len() {
            let end = (first + length).min(corners.len());
            lots.push(first..end);
            (first, length) = (end, length * 7 % 16_385 + 1);
        }
        for lot in lots.into_iter().rev() {
            spill.open().write(lot.start as u64, &corners[lot], &mut packer).unwrap();
        }
        spill.close(0);
        match spill {
            Spill::Filed(file) => file,
            Spill::Resident(_) => panic!("it was to be on scratch"),
        }
    }

    #[test]
    fn what_is_read_is_what_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let mut shuffled = rows(100_000);
        (0..shuffled.len()).for_each(|i| shuffled.swap(i, i.wrapping_mul(7919) % 100_000));
        shuffled[17] = Corner::at(0, 0);
        shuffled[18] = Corner::at((1 << 25) - 2, (1 << PLACE_BITS) - 1);
        for corners in [rows(100_000), shuffled, rows(1)] {
            let file = filed(&corners, folder.path());
            let mut reader = Reader::default();
            for (first, count) in [(0, corners.len()), (3, 1), (511, 2), (777, 1024), (16_000, 50_001), (99_999, 1)] {
                let Some(expected) = corners.get(first..first + count) else { continue };
                let mut read = vec![Corner::default(); count];
                file.read(first as u64, &mut read, &mut reader).unwrap();
                assert!(read == expected, "{count} from {first}");
            }
        }
    }

    #[test]
    fn pages_hold_what_was_written_and_those_that_are_asked_for_are_used() {
        let folder = tempfile::tempdir().unwrap();
        // Twice as many as are held at once.
        let corners = rows(2 * PAGES * PAGE + 100);
        let file = filed(&corners, folder.path());
        let used = Used::of(corners.len() as u64);
        let all = (0..corners.len()).step_by(61).chain([corners.len() - 1]);
        for worker in 0..2 {
            let mut pages = PageCache::new(&file, &used);
            for v in all.clone().chain(all.clone().rev()).filter(|v| v % 2 == worker) {
                assert_eq!(pages.get(v as u32).unwrap(), corners[v], "{v}");
            }
            pages.finish();
            let asked = all.clone().filter(|v| worker == 1 || v % 2 == 0).count();
            assert_eq!(used.unused(corners.len() as u64), Some((corners.len() - asked) as u64));
        }
    }

    #[test]
    fn vertices_in_order_take_six_bytes_and_a_half_and_shuffled_ones_eight() {
        let folder = tempfile::tempdir().unwrap();
        let mut corners = rows(400_000);
        let bytes = |corners: &[Corner]| filed(corners, folder.path()).file.length() as f64 / corners.len() as f64;
        let in_order = bytes(&corners);
        (0..corners.len()).for_each(|i| corners.swap(i, i.wrapping_mul(2_654_435_761) % 400_000));
        let shuffled = bytes(&corners);
        assert!((6.0..6.5).contains(&in_order) && (7.5..8.5).contains(&shuffled), "{in_order} {shuffled}");
    }
}
