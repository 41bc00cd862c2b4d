//! Wavefront OBJ: `v x y z`, `f a b c …`, and much that concerns neither positions nor faces.
//!
//! Corners are `v`, `v/vt`, `v//vn` or `v/vt/vn`; numbers begin at 1, negative ones count back from the latest vertex.
//! Groups, materials, curves and all else are passed over.

use super::attribute::{Attribute, Carrier};
use super::lines::{Dialect, Line, Text, Wrong, integer, unexpected, words};
use super::map::Input;
use super::ply_records::no_such_vertex;
use crate::error::{Error, Result};
use crate::mesh::columns::{Column, Meaning, Number};
use crate::progress::Progress;
use memchr::memchr;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// An open OBJ file.
pub(super) type ObjText = Text<Obj>;

/// The dialect, and what it came across.
#[derive(Debug, Default)]
pub(super) struct Obj {
    uvs: AtomicU64,
    normals: AtomicU64,
    /// Lines that say what faces are made of.
    materials: AtomicU64,
    /// Lines that say what groups and objects faces belong to.
    names: AtomicU64,
    /// Numbers of the first vertex.
    numbers: AtomicU64,
    /// All of these are known.
    counted: bool,
}

/// Words that lines of an OBJ file begin with.
const KEYWORDS: [&[u8]; 30] = [
    b"v", b"vt", b"vn", b"vp", b"f", b"fo", b"l", b"p", b"o", b"g", b"s", b"mg", b"mtllib", b"usemtl", b"usemap",
    b"maplib", b"cstype", b"deg", b"bmat", b"step", b"curv", b"curv2", b"surf", b"parm", b"trim", b"hole", b"scrv",
    b"sp", b"end", b"lod",
];

/// Whether text that begins like this is an OBJ: all of its lines that are whole begin with words that it has.
pub(super) fn is_obj(head: &[u8], whole: bool, named: bool) -> bool {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    let end = if whole { head.len() } else { head.iter().rposition(|b| matches!(b, b'\n' | b'\r')).unwrap_or(0) };
    let firsts = head[..end].split(|b| matches!(b, b'\n' | b'\r')).filter_map(|line| words(line).next());
    let (mut known, mut strange, mut geometry) = (0, 0, false);
    for word in firsts {
        let is_known = KEYWORDS.contains(&word);
        known += usize::from(is_known);
        strange += usize::from(!is_known);
        geometry |= matches!(word, b"v" | b"vt" | b"vn" | b"f" | b"mtllib" | b"o" | b"g");
    }
    let control = |b: &u8| *b < b' ' && !matches!(b, b'\t'..=b'\r');
    !head.iter().any(control) && (geometry && strange * 8 <= known || named && known >= strange)
}

/// Counts what the file holds.
pub(super) fn open(input: &Input, progress: &Progress) -> Result<ObjText> {
    let mut mark = [0; 3];
    let marked = input.len() >= 3 && input.read_at(&mut mark, 0).is_ok() && &mark == b"\xef\xbb\xbf";
    let mut text = Text::open(input, progress, Obj::default(), if marked { 3 } else { 0 })?;
    text.dialect.counted = true;
    let refuse = |what| Err(Error::input(input.path(), what));
    match (text.total.vertices, text.total.faces, text.total.triangles) {
        (0, ..) => refuse("has no vertex: no line begins with `v`"),
        (_, 0, _) => refuse("has no faces: no line begins with `f`"),
        (_, _, 0) => refuse("has no usable face: every polygon has fewer than three corners"),
        _ => Ok(text),
    }
}

impl Obj {
    /// Numbers that vertices carry: colours, as bytes in place of shares.
    pub fn columns(&self) -> Vec<Column> {
        if self.numbers.load(Relaxed) < 6 {
            return Vec::new();
        }
        let column = |name: &str| Column { name: name.into(), number: Number::U8, meaning: Meaning::of(name) };
        ["red", "green", "blue"].map(column).to_vec()
    }

    /// Whether there is anything that corners or faces carry.
    pub fn is_coated(&self) -> bool {
        self.coat_values() + self.materials.load(Relaxed) > 0 || self.names.load(Relaxed) > 1
    }

    #[inline]
    fn count_one(&self, lines: &AtomicU64) {
        if !self.counted {
            lines.fetch_add(1, Relaxed);
        }
    }

    /// Lines with values of corners.
    pub fn coat_values(&self) -> u64 {
        self.uvs.load(Relaxed) + self.normals.load(Relaxed)
    }

    /// What vertices, corners and faces carry.
    pub fn attributes(&self) -> Vec<Attribute> {
        let mut found = Vec::new();
        if self.numbers.load(Relaxed) >= 6 {
            found.push(Attribute::of(Carrier::Vertex, "colour", "3 numbers"));
        }
        if self.normals.load(Relaxed) > 0 {
            found.push(Attribute::of(Carrier::Corner, "vn", "3 numbers"));
        }
        if self.uvs.load(Relaxed) > 0 {
            found.push(Attribute::of(Carrier::Corner, "vt", "2 numbers"));
        }
        // One name for all faces tells none of them apart.
        for (lines, name, least) in [(&self.materials, "usemtl", 1), (&self.names, "g", 2)] {
            if lines.load(Relaxed) >= least {
                found.push(Attribute::of(Carrier::Face, name, "name"));
            }
        }
        found
    }
}

impl Dialect for Obj {
    #[inline]
    fn sort<'a>(&self, line: &'a [u8], _: u64) -> Line<'a> {
        match line {
            [b'v', b' ' | b'\t', rest @ ..] => {
                if self.numbers.load(Relaxed) == 0 {
                    self.numbers.store(words(rest).count() as u64, Relaxed);
                }
                Line::Vertex(rest)
            }
            [b'f', b' ' | b'\t', rest @ ..] | [b'f', b'o', b' ' | b'\t', rest @ ..] => Line::Face(rest),
            [b'v', b't', b' ' | b'\t', ..] => {
                self.count_one(&self.uvs);
                Line::Other
            }
            [b'v', b'n', b' ' | b'\t', ..] => {
                self.count_one(&self.normals);
                Line::Other
            }
            [b'u', b's', b'e', b'm', b't', b'l', ..] => {
                self.count_one(&self.materials);
                Line::Other
            }
            [b'g' | b'o', b' ' | b'\t', ..] => {
                self.count_one(&self.names);
                Line::Other
            }
            _ => Line::Other,
        }
    }

    #[inline]
    fn count<'a>(&self, face: &'a [u8]) -> Result<u64, Wrong<'a>> {
        Ok(words(face).count() as u64)
    }

    fn corners<'a>(&self, face: &'a [u8], known: u64, vertices: u64, out: &mut Vec<u32>) -> Result<(), Wrong<'a>> {
        for word in words(face) {
            let number = &word[..memchr(b'/', word).unwrap_or(word.len())];
            let index = integer(number).ok_or_else(|| unexpected(word, "a vertex number, as in 7, 7/8 or 7//9"))?;
            let vertex = if index < 0 { known as i64 + index } else { index - 1 };
            if index == 0 || vertex < 0 || vertex as u64 >= vertices.min(1 << 32) {
                return Err((word, no_such_vertex(index, vertices)));
            }
            out.push(vertex as u32);
        }
        Ok(())
    }
}
