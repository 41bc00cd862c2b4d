//! OFF, the Object File Format of Geomview: counts, then a vertex a line, then a face a line.
//!
//! `COFF`, `NOFF`, `STOFF` and their like have more numbers a vertex, behind the coordinates; a face may have colours
//! behind its corners. `OFF BINARY` is big-endian, and made of the same records as a PLY file: it is read as one.

use super::attribute::{Attribute, Carrier};
use super::lines::{Dialect, Line, Text, Wrong, integer, unexpected, words};
use super::map::Input;
use super::ply_header::{Element, Header, Property, Role, Shape, shown};
use super::ply_records::no_such_vertex;
use crate::error::{Error, Item, Result};
use crate::mesh::columns::{Column, Meaning, Number};
use crate::progress::Progress;
use memchr::memchr;
use ply_rs::ply::Encoding;

/// How far the counts may be from the beginning of the file: comments may come first.
const HEAD_BYTES: u64 = 1 << 16;

/// An open OFF file in words.
pub(super) type OffText = Text<Off>;

/// The dialect: which lines are what follows from the counts.
#[derive(Debug)]
pub(super) struct Off {
    pub vertices: u64,
    pub faces: u64,
    /// Numbers that vertices have behind their coordinates, and what the file's are to be multiplied by.
    pub numbers: Vec<(Column, f64)>,
    /// The same of faces, behind their corners.
    pub of_faces: Vec<(Column, f64)>,
}

/// What vertices carry, by the letters before `OFF`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Carried {
    uvs: bool,
    colours: bool,
    normals: bool,
}

impl Carried {
    /// Names of the numbers, in the order of the file, with colours of so many parts.
    fn names(self, parts: usize) -> Vec<&'static str> {
        let there = |is: bool, names: &[&'static str]| if is { names.to_vec() } else { Vec::new() };
        let colours = &["red", "green", "blue", "alpha"][..parts.min(4)];
        [there(self.normals, &["nx", "ny", "nz"]), there(self.colours, colours), there(self.uvs, &["s", "t"])].concat()
    }

    /// The numbers of a file of which this is a vertex. Colours are bytes, or shares of full brightness: those have a point.
    fn numbers(self, vertex: &[u8]) -> Vec<(Column, f64)> {
        let others = 3 + 3 * usize::from(self.normals) + 2 * usize::from(self.uvs);
        let parts = words(vertex).count().saturating_sub(others);
        let first = 3 + 3 * usize::from(self.normals);
        let shares = words(vertex).skip(first).take(parts).any(|word| word.contains(&b'.'));
        let names = if self.colours && parts < 3 { Carried { colours: false, ..self } } else { self }.names(parts);
        names.into_iter().map(|name| column(name, shares)).collect()
    }
}

/// A number by its name, and what it is to be multiplied by: colours may be shares of full brightness.
fn column(name: &str, shares: bool) -> (Column, f64) {
    let meaning = Meaning::of(name);
    let is_colour = matches!(meaning, Meaning::Colour(_));
    let number = if is_colour { Number::U8 } else { Number::F32 };
    (Column { name: name.into(), number, meaning }, if is_colour && shares { 255.0 } else { 1.0 })
}

/// The parts of a colour.
fn colour_numbers(parts: usize, shares: bool) -> Vec<(Column, f64)> {
    ["red", "green", "blue", "alpha"][..parts].iter().map(|name| column(name, shares)).collect()
}

impl Off {
    /// What vertices carry, as names and types.
    pub fn attributes(&self) -> Vec<Attribute> {
        let attribute = |carrier| move |(c, _): &(Column, f64)| Attribute::of(carrier, &c.name, c.number.word());
        let of_faces = self.of_faces.iter().map(attribute(Carrier::Face));
        self.numbers.iter().map(attribute(Carrier::Vertex)).chain(of_faces).collect()
    }

    /// Where among the numbers of a vertex its texture coordinates are, which come last.
    pub fn texture(&self) -> Option<usize> {
        self.numbers.len().checked_sub(2).filter(|at| self.numbers[*at].0.name == "s")
    }

    /// What vertices carry, texture coordinates left out: a texture has seams, over which they must not be averaged.
    pub fn columns(&self) -> Vec<Column> {
        let count = self.texture().unwrap_or(self.numbers.len());
        self.numbers[..count].iter().map(|(column, _)| column.clone()).collect()
    }

    /// What faces carry.
    pub fn face_columns(&self) -> Vec<Column> {
        self.of_faces.iter().map(|(column, _)| column.clone()).collect()
    }

    /// Whether there is anything that corners or faces carry.
    pub fn is_coated(&self) -> bool {
        self.texture().is_some() || !self.of_faces.is_empty()
    }

    /// The numbers of faces, of which this is one.
    fn look_at(&mut self, face: &[u8]) {
        let corners = words(face).next().and_then(integer).and_then(|n| usize::try_from(n).ok()).unwrap_or(0);
        let rest: Vec<&[u8]> = words(face).skip(corners.saturating_add(1)).collect();
        if matches!(rest.len(), 3 | 4) {
            self.of_faces = colour_numbers(rest.len(), rest.iter().any(|word| word.contains(&b'.')));
        }
    }
}

/// What the first word says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Keyword {
    carried: Carried,
    /// Bytes of it.
    len: usize,
}

/// The keyword that a file begins with, behind comments.
pub(super) fn keyword(head: &[u8]) -> Option<(usize, Keyword)> {
    let mut at = if head.starts_with(b"\xef\xbb\xbf") { 3 } else { 0 };
    loop {
        at += head[at..].iter().position(|b| !b.is_ascii_whitespace())?;
        if head[at] != b'#' {
            break;
        }
        at += head[at..].iter().position(|b| matches!(b, b'\n' | b'\r'))?;
    }
    let mut rest = &head[at..];
    let mut take = |prefix: &[u8]| rest.strip_prefix(prefix).inspect(|after| rest = after).is_some();
    let carried = Carried { uvs: take(b"ST"), colours: take(b"C"), normals: take(b"N") };
    if !take(b"OFF") {
        return None;
    }
    // Some write the counts without a space behind the keyword.
    let apart = rest.first().is_none_or(|b| b.is_ascii_whitespace() || b.is_ascii_digit() || *b == b'#');
    let len = head.len() - at - rest.len();
    apart.then_some((at, Keyword { carried, len }))
}

/// An OFF file of either kind.
pub(super) enum Opened {
    Words(OffText),
    /// To be read as a PLY file with such a header.
    Binary(Header),
}

/// Reads the counts, and counts what they do not say.
pub(super) fn open(input: &Input, progress: &Progress) -> Result<Opened> {
    let mut head = vec![0; input.len().min(HEAD_BYTES) as usize];
    input.read_at(&mut head, 0)?;
    let Some((at, Keyword { carried, len })) = keyword(&head) else {
        return Err(Error::input(input.path(), "does not begin with `OFF`"));
    };
    let behind = at + len;
    if let Some(payload) = binary_payload(&head, behind) {
        return binary(input, &head, payload, carried).map(Opened::Binary);
    }
    let (counts, payload) = counts(input, &head, behind)?;
    let [vertices, faces] = counts;
    check(input, vertices, faces)?;
    // A character and the end of the line each, at the least.
    if u128::from(vertices) + u128::from(faces) > u128::from(input.len() - payload).div_ceil(2) {
        let what = format!("its {vertices} vertices and {faces} faces need more lines than {} bytes hold", input.len());
        return Err(Error::input(input.path(), what));
    }
    let numbers = carried.numbers(first_line(head.get(payload as usize..).unwrap_or_default()));
    let off = Off { vertices, faces, numbers, of_faces: Vec::new() };
    let mut text = Text::open(input, progress, off, payload)?;
    if let Some(face) = text.first_face(input)? {
        text.dialect.look_at(&face);
    }
    let found = text.total;
    if (found.vertices, found.faces) != (vertices, faces) {
        let (kind, ordinal) =
            if found.vertices < vertices { ("vertex", found.vertices) } else { ("face", found.faces) };
        let what = format!("the file ends before it, but the header counts {vertices} vertices and {faces} faces");
        return Err(Error::input_at(input.path(), Item { kind, ordinal }, input.len(), what));
    }
    if found.triangles == 0 {
        return Err(Error::input(input.path(), "has no usable face: every polygon has fewer than three corners"));
    }
    Ok(Opened::Words(text))
}

/// The first line of a text that says something.
fn first_line(text: &[u8]) -> &[u8] {
    let lines = text.split(|b| matches!(b, b'\n' | b'\r'));
    lines
        .map(|line| &line[..memchr(b'#', line).unwrap_or(line.len())])
        .find(|l| words(l).next().is_some())
        .unwrap_or(b"")
}

fn check(input: &Input, vertices: u64, faces: u64) -> Result<()> {
    match (vertices, faces) {
        (0, _) => Err(Error::input(input.path(), "has no vertex: the header counts 0")),
        (_, 0) => Err(Error::input(input.path(), "has no faces: the header counts 0")),
        _ => Ok(()),
    }
}

/// The counts of vertices and faces behind byte `at`, and where the line after them begins. That of edges may be missing.
fn counts(input: &Input, head: &[u8], mut at: usize) -> Result<([u64; 2], u64)> {
    loop {
        let len = head[at..].iter().position(|b| matches!(b, b'\n' | b'\r')).unwrap_or(head.len() - at);
        let mut numbers = words(&head[at..at + len]);
        let end = (at + len + 1).min(head.len());
        if let Some(first) = numbers.next() {
            let count = |word: Option<&[u8]>| {
                let number = word.and_then(integer).and_then(|n| u64::try_from(n).ok());
                number.ok_or_else(|| {
                    let word = shown(&String::from_utf8_lossy(word.unwrap_or_default()));
                    let item = Item { kind: "header line at byte", ordinal: at as u64 };
                    let what = format!("`{word}`, expected the counts of vertices, faces and edges");
                    Error::input_at(input.path(), item, at as u64, what)
                })
            };
            return Ok(([count(Some(first))?, count(numbers.next())?], end as u64));
        }
        if len == head.len() - at {
            return Err(Error::input(input.path(), "has no counts of vertices, faces and edges behind `OFF`"));
        }
        at = end;
    }
}

/// Where the counts of a binary file are, if it is one.
fn binary_payload(head: &[u8], behind: usize) -> Option<usize> {
    let len = head[behind..].iter().position(|b| *b == b'\n')?;
    let line = head[behind..behind + len].trim_ascii();
    (line == b"BINARY").then_some(behind + len + 1)
}

/// A header that says of a PLY file what this one is.
fn binary(input: &Input, head: &[u8], payload: usize, carried: Carried) -> Result<Header> {
    let Some(counts) = head.get(payload..payload + 12) else {
        return Err(Error::input(input.path(), "ends before its counts of vertices, faces and edges"));
    };
    let count = |i: usize| {
        let n = i32::from_be_bytes([counts[i], counts[i + 1], counts[i + 2], counts[i + 3]]);
        u64::try_from(n).map_err(|_| Error::input(input.path(), format!("counts {n} vertices or faces")))
    };
    let (vertices, faces) = (count(0)?, count(4)?);
    let number = |role, name: &str| Property { role, shape: Shape::Scalar(Number::F32), name: name.into() };
    let axes = (0..3).map(|axis| number(Role::Axis(axis), ""));
    let vertex = axes.chain(carried.names(4).into_iter().map(|name| number(Role::Other, name))).collect();
    let list = |role, item| Property { role, shape: Shape::List { count: Number::I32, item }, name: String::new() };
    let face = vec![list(Role::Corners, Number::I32), list(Role::Other, Number::F32)];
    Ok(Header {
        encoding: Encoding::BinaryBigEndian,
        payload: payload as u64 + 12,
        textures: Vec::new(),
        elements: vec![
            Element { kind: "vertex", count: vertices, properties: vertex },
            Element { kind: "face", count: faces, properties: face },
        ],
    })
}

impl Dialect for Off {
    #[inline]
    fn sort<'a>(&self, line: &'a [u8], ordinal: u64) -> Line<'a> {
        if ordinal < self.vertices {
            Line::Vertex(line)
        } else if ordinal - self.vertices < self.faces {
            Line::Face(line)
        } else {
            Line::Other
        }
    }

    #[inline]
    fn count<'a>(&self, face: &'a [u8]) -> Result<u64, Wrong<'a>> {
        let Some(word) = words(face).next() else { return Ok(0) };
        let count = integer(word).and_then(|n| u64::try_from(n).ok());
        count.ok_or_else(|| unexpected(word, "how many corners the face has"))
    }

    fn corners<'a>(&self, face: &'a [u8], _: u64, vertices: u64, out: &mut Vec<u32>) -> Result<(), Wrong<'a>> {
        let mut words = words(face);
        let n = words.next().and_then(integer).unwrap_or(0);
        for _ in 0..n {
            let word = words.next().ok_or_else(|| (face, format!("fewer corners than {n}")))?;
            let index = integer(word).ok_or_else(|| unexpected(word, "a vertex index"))?;
            if index < 0 || index as u64 >= vertices.min(1 << 32) {
                return Err((word, no_such_vertex(index, vertices)));
            }
            out.push(index as u32);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_that_the_first_vertex_has() {
        let all = Carried { uvs: true, colours: true, normals: true };
        let of = |carried: Carried, line: &[u8]| {
            let numbers = carried.numbers(first_line(line)).into_iter();
            numbers.map(|(column, factor)| (column.name, factor)).collect::<Vec<_>>()
        };
        let names = |names: &[(&str, f64)]| names.iter().map(|(n, f)| (n.to_string(), *f)).collect::<Vec<_>>();
        let normal = [("nx", 1.0), ("ny", 1.0), ("nz", 1.0)];
        let bytes = [("red", 1.0), ("green", 1.0), ("blue", 1.0)];
        let uv = [("s", 1.0), ("t", 1.0)];
        let found = of(all, b"# none\n\n1 2 3  0 0 1  255 0 7  0.5 0.25 # here\n");
        assert_eq!(found, names(&[&normal[..], &bytes, &uv].concat()));
        let colours = Carried { colours: true, ..Carried::default() };
        let shares = [("red", 255.0), ("green", 255.0), ("blue", 255.0), ("alpha", 255.0)];
        assert_eq!(of(colours, b"1.5 2 3 1. 0 0.5 1\n"), names(&shares));
        assert_eq!(of(colours, b"1.5 2.5 3.5 255 0 7"), names(&bytes));
        assert_eq!(of(colours, b"1.5 2.5 3.5 7"), names(&[]), "an index into a map of colours");
    }

    #[test]
    fn keywords_say_what_vertices_carry() {
        let carried = |head: &[u8]| keyword(head).map(|(at, k)| (at, k.len, k.carried));
        assert_eq!(carried(b"OFF\n"), Some((0, 3, Carried::default())));
        assert_eq!(carried(b"# made\r\n OFF8 6 12"), Some((9, 3, Carried::default())));
        let all = Carried { uvs: true, colours: true, normals: true };
        assert_eq!(carried(b"STCNOFF BINARY\n"), Some((0, 7, all)));
        for foreign in [&b"OFFER"[..], b"4OFF", b"nOFF", b"off", b"", b"#", b"CN"] {
            assert_eq!(carried(foreign), None);
        }
    }
}
