//! Text formats of a line an element: OBJ and OFF.
//!
//! When such a file is opened it is gone through once, in blocks of whole lines, and what each block holds is counted. From
//! then on every block can be decoded on its own, so the passes are worked by all of a crew, and pass over blocks without
//! what they look for. Memory: 80 bytes a block, which is up to a mebibyte of the file.

use super::ascii::number;
use super::map::{Input, WINDOW_BYTES, Window};
use super::ply_header::shown;
use super::ply_records::MAX_CORNERS;
use super::stream::{CHUNK, Crew, Numbering, pump};
use super::{CarriedChunk, CarriedStep, TriangleChunk, TriangleStep, VertexChunk, VertexStep};
use crate::error::{Error, Item, Result};
use crate::progress::Progress;
use memchr::{memchr, memrchr};

/// Of each block, so many vertices are looked at to find out what holds their digits.
const LOOKED_AT: u64 = 256;

/// What a line holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Line<'a> {
    /// The numbers of a vertex, coordinates first.
    Vertex(&'a [u8]),
    /// The corners of a face.
    Face(&'a [u8]),
    /// Anything else.
    Other,
}

/// What is wrong with a line: where, and what was expected.
pub(super) type Wrong<'a> = (&'a [u8], String);

/// How a format says what.
pub(super) trait Dialect: Sync {
    /// What a line holds that is not blank; `ordinal` counts such lines. Comments are [`Line::Other`], and not counted.
    fn sort<'a>(&self, line: &'a [u8], ordinal: u64) -> Line<'a>;
    /// How many corners a face has.
    fn count<'a>(&self, face: &'a [u8]) -> Result<u64, Wrong<'a>>;
    /// Appends the corners of a face; `known` vertices come before it, of `vertices` in all.
    fn corners<'a>(&self, face: &'a [u8], known: u64, vertices: u64, out: &mut Vec<u32>) -> Result<(), Wrong<'a>>;
}

/// What a stretch of the file holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Tally {
    pub lines: u64,
    pub vertices: u64,
    pub faces: u64,
    pub triangles: u64,
    pub short_polygons: u64,
}

impl std::ops::AddAssign for Tally {
    fn add_assign(&mut self, o: Self) {
        self.lines += o.lines;
        self.vertices += o.vertices;
        self.faces += o.faces;
        self.triangles += o.triangles;
        self.short_polygons += o.short_polygons;
    }
}

/// Whole lines that fit a window.
#[derive(Debug, Clone, Copy)]
struct Block {
    offset: u64,
    bytes: usize,
    before: Tally,
    here: Tally,
}

/// A file of such lines, counted.
#[derive(Debug)]
pub(super) struct Text<D> {
    pub dialect: D,
    ending: u8,
    blocks: Vec<Block>,
    pub total: Tally,
    /// Whether `f32` holds the coordinates to the last digit that is written.
    pub fits_f32: bool,
}

impl<D: Dialect> Text<D> {
    /// Counts what the lines from byte `from` on hold.
    pub fn open(input: &Input, progress: &Progress, dialect: D, from: u64) -> Result<Self> {
        let ending = ending(input, from)?;
        let mut text = Text { dialect, ending, blocks: Vec::new(), total: Tally::default(), fits_f32: true };
        let mut offset = from;
        while offset < input.len() {
            progress.check()?;
            let window = block(input, offset, ending)?;
            let here = text.tally(input, &window, offset)?;
            text.blocks.push(Block { offset, bytes: window.len(), before: text.total, here });
            text.total += here;
            offset += window.len() as u64;
        }
        Ok(text)
    }

    fn tally(&mut self, input: &Input, bytes: &[u8], offset: u64) -> Result<Tally> {
        let mut here = Tally::default();
        for line in lines(bytes, self.ending) {
            match self.sort(line, &mut here.lines, self.total.lines) {
                Line::Vertex(numbers) => {
                    if here.vertices < LOOKED_AT && self.fits_f32 {
                        self.fits_f32 = words(numbers).take(3).all(fits_f32);
                    }
                    here.vertices += 1;
                }
                Line::Face(face) => {
                    let ordinal = self.total.faces + here.faces;
                    let corners = self.dialect.count(face).and_then(|n| check_corners(face, n));
                    let corners = corners.map_err(|wrong| error(input, "face", ordinal, bytes, offset, wrong))?;
                    here.faces += 1;
                    here.triangles += corners.saturating_sub(2);
                    here.short_polygons += u64::from(corners < 3);
                }
                Line::Other => {}
            }
        }
        Ok(here)
    }

    fn sort<'a>(&self, line: &'a [u8], here: &mut u64, before: u64) -> Line<'a> {
        let line = line.trim_ascii_start();
        if line.is_empty() || line[0] == b'#' {
            return Line::Other;
        }
        *here += 1;
        self.dialect.sort(line, before + *here - 1)
    }

    /// Streams the vertices.
    pub fn vertices(&self, input: &Input, crew: &Crew<'_>, step: &VertexStep<'_>) -> Result<()> {
        let numbers = Numbering::default();
        let local = || (numbers.next(), Vec::with_capacity(CHUNK));
        let held = |block: &Block| block.here.vertices > 0;
        self.pump(input, crew, held, local, |(mine, positions), block, bytes| {
            let (mut first, mut counted) = (block.before.vertices, 0);
            positions.clear();
            for line in lines(bytes, self.ending) {
                let Line::Vertex(numbers) = self.sort(line, &mut counted, block.before.lines) else { continue };
                let ordinal = first + positions.len() as u64;
                let position = position(numbers, self.fits_f32);
                positions.push(position.map_err(|w| error(input, "vertex", ordinal, bytes, block.offset, w))?);
                if positions.len() == CHUNK {
                    step(*mine, VertexChunk { first, positions })?;
                    first += CHUNK as u64;
                    positions.clear();
                }
            }
            if positions.is_empty() { Ok(()) } else { step(*mine, VertexChunk { first, positions }) }
        })?;
        Ok(())
    }

    /// Streams the vertices with the numbers behind their positions, each times its factor; what is not there is not a
    /// number.
    pub fn carried(&self, factors: &[f64], input: &Input, crew: &Crew<'_>, step: &CarriedStep<'_>) -> Result<()> {
        let (workers, columns) = (Numbering::default(), factors.len());
        let local = || (workers.next(), Vec::with_capacity(CHUNK), Vec::with_capacity(CHUNK * columns));
        let held = |block: &Block| block.here.vertices > 0;
        self.pump(input, crew, held, local, |(worker, positions, values), block, bytes| {
            let (mut first, mut counted) = (block.before.vertices, 0);
            positions.clear();
            values.clear();
            for line in lines(bytes, self.ending) {
                let Line::Vertex(numbers) = self.sort(line, &mut counted, block.before.lines) else { continue };
                let ordinal = first + positions.len() as u64;
                let position = position(numbers, self.fits_f32);
                positions.push(position.map_err(|w| error(input, "vertex", ordinal, bytes, block.offset, w))?);
                let mut more = words(numbers).skip(3);
                let number = |word| number(word, true).unwrap_or(f64::NAN);
                values.extend(factors.iter().map(|factor| factor * more.next().map_or(f64::NAN, number)));
                if positions.len() == CHUNK {
                    step(*worker, CarriedChunk { first, positions, values, columns })?;
                    first += CHUNK as u64;
                    positions.clear();
                    values.clear();
                }
            }
            if positions.is_empty() {
                return Ok(());
            }
            step(*worker, CarriedChunk { first, positions, values, columns })
        })?;
        Ok(())
    }

    /// Streams the triangles.
    pub fn triangles(&self, input: &Input, crew: &Crew<'_>, step: &TriangleStep<'_>) -> Result<()> {
        let numbers = Numbering::default();
        let local = || (numbers.next(), Vec::with_capacity(CHUNK), Vec::new());
        let held = |block: &Block| block.here.faces > 0;
        self.pump(input, crew, held, local, |(mine, triangles, corners), block, bytes| {
            let (mut first, mut counted) = (block.before.triangles, 0);
            let (mut known, mut ordinal) = (block.before.vertices, block.before.faces);
            triangles.clear();
            for line in lines(bytes, self.ending) {
                let face = match self.sort(line, &mut counted, block.before.lines) {
                    Line::Face(face) => face,
                    Line::Vertex(_) => {
                        known += 1;
                        continue;
                    }
                    Line::Other => continue,
                };
                corners.clear();
                let read = self.dialect.corners(face, known, self.total.vertices, corners);
                read.map_err(|w| error(input, "face", ordinal, bytes, block.offset, w))?;
                ordinal += 1;
                if let [a, rest @ ..] = &corners[..] {
                    triangles.extend(rest.windows(2).map(|pair| [*a, pair[0], pair[1]]));
                }
                while triangles.len() >= CHUNK {
                    step(*mine, TriangleChunk { first, triangles: &triangles[..CHUNK] })?;
                    first += CHUNK as u64;
                    triangles.drain(..CHUNK);
                }
            }
            if triangles.is_empty() { Ok(()) } else { step(*mine, TriangleChunk { first, triangles }) }
        })?;
        Ok(())
    }

    /// Goes through all lines that are neither blank nor comments, in order. An error names the line.
    pub fn in_order(
        &self,
        input: &Input,
        progress: &Progress,
        mut each: impl for<'a> FnMut(&'a [u8]) -> Result<(), Wrong<'a>>,
    ) -> Result<()> {
        let mut ordinal = 0;
        for block in &self.blocks {
            progress.check()?;
            let window = input.window(block.offset, block.bytes)?;
            for line in lines(&window, self.ending) {
                let line = line.trim_ascii_start();
                if !line.is_empty() && line[0] != b'#' {
                    each(line).map_err(|w| error(input, "line", ordinal, &window, block.offset, w))?;
                    ordinal += 1;
                }
            }
            progress.add(block.bytes as u64);
        }
        Ok(())
    }

    /// The first line that is a face.
    pub fn first_face(&self, input: &Input) -> Result<Option<Vec<u8>>> {
        let Some(block) = self.blocks.iter().find(|block| block.here.faces > 0) else { return Ok(None) };
        let window = input.window(block.offset, block.bytes)?;
        let mut counted = 0;
        let face =
            lines(&window, self.ending).find_map(|line| match self.sort(line, &mut counted, block.before.lines) {
                Line::Face(face) => Some(face.to_vec()),
                _ => None,
            });
        Ok(face)
    }

    fn pump<L: Send>(
        &self,
        input: &Input,
        crew: &Crew<'_>,
        held: impl Fn(&Block) -> bool,
        local: impl Fn() -> L + Sync,
        work: impl Fn(&mut L, &Block, &[u8]) -> Result<()> + Sync,
    ) -> Result<Vec<L>> {
        let mut blocks = self.blocks.iter().filter(|block| held(block));
        let next = || {
            let Some(block) = blocks.next() else { return Ok(None) };
            let window = input.window(block.offset, block.bytes)?;
            Ok(Some(((block, window), block.bytes as u64)))
        };
        pump(crew, next, local, |mine, (block, window)| work(mine, block, &window))
    }

    /// Where a vertex is written.
    pub fn vertex_byte(&self, input: &Input, vertex: u64) -> Option<u64> {
        let after = self.blocks.partition_point(|block| block.before.vertices <= vertex);
        let block = self.blocks.get(after.checked_sub(1)?)?;
        let window = input.window(block.offset, block.bytes).ok()?;
        let (mut left, mut counted) = (vertex - block.before.vertices, 0);
        for line in lines(&window, self.ending) {
            if let Line::Vertex(numbers) = self.sort(line, &mut counted, block.before.lines) {
                if left == 0 {
                    return Some(block.offset + offset_in(&window, numbers));
                }
                left -= 1;
            }
        }
        None
    }
}

/// `\n`, unless the first line ends at a bare `\r`.
fn ending(input: &Input, from: u64) -> Result<u8> {
    let mut bytes = vec![0; (input.len() - from).min(1 << 16) as usize];
    input.read_at(&mut bytes, from)?;
    Ok(match bytes.iter().position(|b| matches!(b, b'\r' | b'\n')) {
        Some(i) if bytes[i] == b'\r' && bytes.get(i + 1) != Some(&b'\n') => b'\r',
        _ => b'\n',
    })
}

/// As many whole lines from `offset` on as fit a window.
fn block(input: &Input, offset: u64, ending: u8) -> Result<Window> {
    let left = input.len() - offset;
    if left <= WINDOW_BYTES as u64 {
        return input.window(offset, left as usize);
    }
    let window = input.window(offset, WINDOW_BYTES)?;
    let mut end = window.len();
    while let Some(at) = memrchr(ending, &window[..end]) {
        if !is_continued(&window[..at]) {
            return input.window(offset, at + 1);
        }
        end = at;
    }
    let item = Item { kind: "line that begins here, at", ordinal: offset };
    Err(Error::input_at(input.path(), item, offset, "is longer than a mebibyte"))
}

/// Whether a line that ends so goes on in the next one.
fn is_continued(line: &[u8]) -> bool {
    line.strip_suffix(b"\r").unwrap_or(line).ends_with(b"\\")
}

/// The lines of a block, continued ones as one.
fn lines(mut bytes: &[u8], ending: u8) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        if bytes.is_empty() {
            return None;
        }
        let mut end = memchr(ending, bytes).unwrap_or(bytes.len());
        while end < bytes.len() && is_continued(&bytes[..end]) {
            end = memchr(ending, &bytes[end + 1..]).map_or(bytes.len(), |more| end + 1 + more);
        }
        let line = &bytes[..end];
        bytes = &bytes[(end + 1).min(bytes.len())..];
        Some(line)
    })
}

/// The words of a line up to a comment.
pub(super) fn words(line: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = line;
    std::iter::from_fn(move || {
        let begin = rest.iter().position(|b| !is_apart(*b))?;
        rest = &rest[begin..];
        if rest[0] == b'#' {
            return None;
        }
        let len = rest.iter().position(|b| is_apart(*b)).unwrap_or(rest.len());
        let (word, after) = rest.split_at(len);
        rest = after;
        Some(word)
    })
}

/// Whether a byte is between words: white space, and what continues a line.
#[inline(always)]
fn is_apart(byte: u8) -> bool {
    byte <= b' ' || byte == b'\\'
}

/// A whole number.
#[inline]
pub(super) fn integer(word: &[u8]) -> Option<i64> {
    let (negative, digits) = match word {
        [b'-', digits @ ..] => (true, digits),
        [b'+', digits @ ..] => (false, digits),
        digits => (false, digits),
    };
    if digits.is_empty() || digits.len() > 18 {
        return None;
    }
    let mut n = 0i64;
    for d in digits {
        if !d.is_ascii_digit() {
            return None;
        }
        n = n * 10 + i64::from(d - b'0');
    }
    Some(if negative { -n } else { n })
}

fn position(numbers: &[u8], single: bool) -> Result<[f64; 3], Wrong<'_>> {
    let mut position = [0.0; 3];
    let mut words = words(numbers);
    for coordinate in &mut position {
        let word = words.next().ok_or_else(|| (numbers, "fewer than three coordinates".to_string()))?;
        *coordinate = number(word, single).ok_or_else(|| unexpected(word, "a number"))?;
    }
    Ok(position)
}

/// What is wrong with a word.
pub(super) fn unexpected<'a>(word: &'a [u8], expected: &str) -> Wrong<'a> {
    (word, format!("`{}`, expected {expected}", shown(&String::from_utf8_lossy(word))))
}

/// Whether a number is one that a float was written as: rounded to a float, it is within half a unit of its last digit.
/// What is no number is left to the pass that needs it.
fn fits_f32(word: &[u8]) -> bool {
    let Some(x) = number(word, false) else { return true };
    let single = f64::from(x as f32);
    if single == x || !x.is_finite() {
        return true;
    }
    let mantissa_end = word.iter().position(|b| matches!(b, b'e' | b'E')).unwrap_or(word.len());
    let mantissa = &word[..mantissa_end];
    // Of a large whole number, zeros at the end are no digits that anybody knew.
    let decimals = match memchr(b'.', mantissa) {
        Some(point) => (mantissa_end - point - 1) as i64,
        None => -(mantissa.iter().rev().take_while(|b| **b == b'0').count() as i64),
    };
    let exponent = integer(word.get(mantissa_end + 1..).unwrap_or_default()).unwrap_or(0);
    let unit = 10f64.powf((exponent - decimals) as f64);
    single.is_finite() && (single - x).abs() <= 0.5 * unit + 4.0 * f64::EPSILON * x.abs()
}

fn check_corners(face: &[u8], n: u64) -> Result<u64, Wrong<'_>> {
    if n > MAX_CORNERS {
        return Err((face, format!("a polygon of {n} corners; at most {MAX_CORNERS} are read")));
    }
    Ok(n)
}

/// Where in `bytes` a part of them begins.
fn offset_in(bytes: &[u8], part: &[u8]) -> u64 {
    (part.as_ptr() as usize).saturating_sub(bytes.as_ptr() as usize).min(bytes.len()) as u64
}

#[cold]
fn error(input: &Input, kind: &'static str, ordinal: u64, bytes: &[u8], offset: u64, (at, what): Wrong<'_>) -> Error {
    Error::input_at(input.path(), Item { kind, ordinal }, offset + offset_in(bytes, at), what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_go_on_behind_a_backslash() {
        let found: Vec<&[u8]> = lines(b"a b\\\r\n c\nd\n\n\\\ne", b'\n').collect();
        assert_eq!(found, [&b"a b\\\r\n c"[..], b"d", b"", b"\\\ne"]);
        assert_eq!(words(found[0]).collect::<Vec<_>>(), [b"a", b"b", b"c"]);
        assert_eq!(words(b" f 1 2#3\\ # 4 5").collect::<Vec<_>>(), [&b"f"[..], b"1", b"2#3"]);
    }

    #[test]
    fn digits_tell_what_they_were_stored_in() {
        for text in
            ["0.1", "0", "-12.5", "1e-7", "123456.789062", "16777216", "0.123456791", "3.4028235e38", "nan", "x"]
        {
            assert!(fits_f32(text.as_bytes()), "{text}");
        }
        for text in ["500123.456", "4512345.1", "16777217", "0.123456789", "1e39", "1.00000000001e-3"] {
            assert!(!fits_f32(text.as_bytes()), "{text}");
        }
    }

    #[test]
    fn every_float_is_taken_for_one_however_it_is_written() {
        let mut bits = 1u32;
        for _ in 0..20_000 {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let x = f32::from_bits(bits);
            if x.is_finite() {
                for text in [format!("{x}"), format!("{x:e}"), format!("{x:.6}"), format!("{x:.9e}")] {
                    assert!(fits_f32(text.as_bytes()), "{text}");
                }
            }
        }
    }
}
