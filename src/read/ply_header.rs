//! The header of a PLY file: what elements it has, of what properties, and where the payload begins.
//!
//! The grammar is read by `ply-rs`, on a cleaned copy of the header: real files have comments in Latin-1, blank lines, any
//! of three line endings and names with odd characters, all of which it refuses; names that nobody here asks for are
//! replaced by numbers, which also keeps equal ones apart.

use super::attribute::{Attribute, Carrier};
use super::map::Input;
use crate::error::{Error, Item, Result};
use crate::mesh::columns::{Column, Meaning, Number};
use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::{DefaultElement, ElementDef, Encoding, PropertyType, ScalarType};
use rustc_hash::FxHashMap;

/// The most numbers of a vertex that are carried.
pub(crate) const MOST_COLUMNS: usize = 13;

/// Names of texture coordinates, two by two.
const TEXTURE: [&str; 8] = ["s", "t", "u", "v", "texture_u", "texture_v", "tx", "ty"];

/// The longest header that is read.
const HEADER_BYTES: u64 = 1 << 20;

/// The type of a number, by the header's word.
fn number(scalar: &ScalarType) -> Number {
    match scalar {
        ScalarType::Char => Number::I8,
        ScalarType::UChar => Number::U8,
        ScalarType::Short => Number::I16,
        ScalarType::UShort => Number::U16,
        ScalarType::Int => Number::I32,
        ScalarType::UInt => Number::U32,
        ScalarType::Float => Number::F32,
        ScalarType::Double => Number::F64,
    }
}

/// What a property is to this program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    /// Coordinate 0, 1 or 2 of a vertex.
    Axis(usize),
    /// The corners of a face.
    Corners,
    /// Skipped.
    Other,
}

/// One number, or a counted list of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    Scalar(Number),
    List { count: Number, item: Number },
}

/// A property of an element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Property {
    pub role: Role,
    pub shape: Shape,
    /// As the file has it, without what cannot be shown.
    pub name: String,
}

/// An element: `count` records of the same properties.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Element {
    /// `vertex`, `face`, or `element` for any other.
    pub kind: &'static str,
    pub count: u64,
    pub properties: Vec<Property>,
}

impl Element {
    /// What its records carry beside positions and corners.
    pub fn attributes(&self) -> Vec<Attribute> {
        let carrier = if self.kind == "vertex" { Carrier::Vertex } else { Carrier::Face };
        let others = self.properties.iter().filter(|p| p.role == Role::Other && !p.name.is_empty());
        let kind = |shape| match shape {
            Shape::Scalar(kind) => kind.word().to_string(),
            Shape::List { count, item } => format!("list {} {}", count.word(), item.word()),
        };
        others.map(|p| Attribute::of(carrier, p.name.as_str(), kind(p.shape))).collect()
    }

    /// The numbers that are carried, and which of the properties they are: as many as there is room for, by names that can be
    /// written again. Texture coordinates are none: a texture has seams, over which they must not be averaged.
    pub fn columns(&self) -> Vec<(usize, Column)> {
        let mut found: Vec<(usize, Column)> = Vec::new();
        for (i, property) in self.properties.iter().enumerate() {
            let name = property.name.as_str();
            let plain = !name.is_empty() && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"_.-".contains(&b));
            let known = TEXTURE.contains(&name) || found.iter().any(|(_, c)| c.name == name);
            if let (Role::Other, Shape::Scalar(kind)) = (property.role, property.shape)
                && plain
                && !known
                && found.len() < MOST_COLUMNS
            {
                let column = Column { name: name.into(), number: kind, meaning: Meaning::of(name) };
                found.push((i, column));
            }
        }
        found
    }

    /// The properties that are texture coordinates of vertices.
    pub fn texture(&self) -> Option<[usize; 2]> {
        let find = |name: &str| {
            let is = |p: &Property| p.name == name && matches!(p.shape, Shape::Scalar(_)) && p.role == Role::Other;
            self.properties.iter().position(is)
        };
        (TEXTURE.as_chunks::<2>().0.iter()).find_map(|[s, t]| Some([find(s)?, find(t)?]))
    }

    /// The list of texture coordinates that faces have for their corners.
    pub fn corner_texture(&self) -> Option<usize> {
        let is = |p: &Property| p.name == "texcoord" && matches!(p.shape, Shape::List { .. });
        self.properties.iter().position(is)
    }

    /// The number of the texture that a face has.
    pub fn texture_number(&self) -> Option<(usize, Column)> {
        self.columns().into_iter().find(|(_, column)| column.name == "texnumber" && column.number.is_integer())
    }

    /// Whole numbers that faces carry: labels, colours.
    pub fn labels(&self) -> Vec<(usize, Column)> {
        let whole = |p: &Property| matches!(p.shape, Shape::Scalar(kind) if kind.is_integer());
        self.columns().into_iter().filter(|(i, _)| whole(&self.properties[*i])).collect()
    }

    /// Where in a binary record without lists a property begins.
    pub fn offset_of(&self, property: usize) -> usize {
        Element { properties: self.properties[..property].to_vec(), ..*self }.bytes_with(0) as usize
    }

    /// Bytes of a binary record whose lists have `corners` corners and nothing else.
    pub fn bytes_with(&self, corners: u64) -> u64 {
        let bytes = |p: &Property| match (p.shape, p.role) {
            (Shape::Scalar(kind), _) => kind.bytes() as u64,
            (Shape::List { count, item }, Role::Corners) => count.bytes() as u64 + corners * item.bytes() as u64,
            (Shape::List { count, .. }, _) => count.bytes() as u64,
        };
        self.properties.iter().map(bytes).sum()
    }

    /// Lists among the properties.
    pub fn lists(&self) -> usize {
        self.properties.iter().filter(|p| matches!(p.shape, Shape::List { .. })).count()
    }

    /// Where in a binary record the property of a role begins, and its shape, if no other list is before it.
    pub fn find(&self, role: Role) -> Option<(usize, Shape)> {
        let i = self.properties.iter().position(|p| p.role == role)?;
        let before = Element { properties: self.properties[..i].to_vec(), ..*self };
        Some((before.bytes_with(0) as usize, self.properties[i].shape))
    }
}

/// A header, checked as far as it can be without the payload.
#[derive(Debug)]
pub(super) struct Header {
    pub encoding: Encoding,
    /// Where the first element begins.
    pub payload: u64,
    pub elements: Vec<Element>,
    /// Files that comments name as textures.
    pub textures: Vec<String>,
}

/// Whether a file that begins like this is a PLY file.
pub(super) fn is_ply(head: &[u8]) -> bool {
    head.starts_with(b"ply") && head.get(3).is_none_or(u8::is_ascii_whitespace)
}

/// Reads the header.
pub(super) fn read(input: &Input) -> Result<Header> {
    let (bytes, payload) = header_bytes(input)?;
    let mut cleaner = Cleaner::new(input);
    let cleaned = cleaner.clean(&bytes)?;
    let parsed = Parser::<DefaultElement>::new().read_header(&mut Reader::new(cleaned.as_bytes()));
    let parsed =
        parsed.map_err(|e| Error::input(input.path(), format!("PLY header: {}", first_line(&e.to_string()))))?;
    let elements = parsed.elements.values().map(|def| element(def, &cleaner.names)).collect();
    Ok(Header { encoding: parsed.encoding, payload, elements, textures: textures(&bytes) })
}

/// The most textures that a header is asked for.
const MOST_TEXTURES: usize = 1024;

/// What `comment TextureFile` lines name.
fn textures(header: &[u8]) -> Vec<String> {
    let name = |line: &[u8]| {
        let line = String::from_utf8_lossy(line.trim_ascii());
        let rest = line.strip_prefix("comment")?.trim_start().strip_prefix("TextureFile")?;
        let name = rest.trim_start();
        (rest.len() > name.len() && !name.is_empty() && !name.contains('\0')).then(|| name.to_string())
    };
    header.split(|b| *b == line_ending(header)).filter_map(name).take(MOST_TEXTURES).collect()
}

/// What a parser's error says, without the number of a line that the cleaned copy does not share with the file.
fn first_line(text: &str) -> String {
    let line = text.lines().next().unwrap_or_default();
    let what = line.split_once(": ").filter(|(place, _)| place.starts_with("Line ")).map_or(line, |(_, what)| what);
    what.escape_debug().take(200).collect()
}

/// The bytes up to `end_header`, and where the payload begins.
fn header_bytes(input: &Input) -> Result<(Vec<u8>, u64)> {
    let mut len = input.len().min(1 << 12);
    loop {
        let mut bytes = vec![0; len as usize];
        input.read_at(&mut bytes, 0)?;
        if let Some(end) = find_end(&bytes, len == input.len()) {
            bytes.truncate(end);
            return Ok((bytes, end as u64));
        }
        let most = input.len().min(HEADER_BYTES);
        if len == most {
            let what = if most < input.len() { "within a mebibyte" } else { "before the file ends" };
            return Err(Error::input(input.path(), format!("the PLY header has no end_header line {what}")));
        }
        len = (len * 16).min(most);
    }
}

/// One past the `end_header` line. A line ends at `\n`, unless the first one ends at a bare `\r`: then at `\r`, so that
/// a binary payload may begin with any byte.
fn find_end(bytes: &[u8], whole_file: bool) -> Option<usize> {
    let ending = line_ending(bytes);
    let mut from = 0;
    while from < bytes.len() {
        let len = bytes[from..].iter().position(|&b| b == ending);
        let line = &bytes[from..len.map_or(bytes.len(), |n| from + n)];
        if line.trim_ascii() == b"end_header" && (len.is_some() || whole_file) {
            return Some((from + line.len() + 1).min(bytes.len()));
        }
        from += line.len() + 1;
    }
    None
}

fn line_ending(bytes: &[u8]) -> u8 {
    match bytes.iter().position(|b| matches!(b, b'\r' | b'\n')) {
        Some(i) if bytes[i] == b'\r' && bytes.get(i + 1) != Some(&b'\n') => b'\r',
        _ => b'\n',
    }
}

fn element(def: &ElementDef, names: &FxHashMap<String, String>) -> Element {
    let kind = match def.name.as_str() {
        "vertex" => "vertex",
        "face" => "face",
        _ => "element",
    };
    let has_indices = def.properties.contains_key("vertex_indices");
    let property = |(name, def): (&String, &ply_rs::ply::PropertyDef)| {
        let shape = match &def.data_type {
            PropertyType::Scalar(kind) => Shape::Scalar(number(kind)),
            PropertyType::List(count, item) => Shape::List { count: number(count), item: number(item) },
        };
        let role = match (kind, name.as_str()) {
            ("vertex", "x") => Role::Axis(0),
            ("vertex", "y") => Role::Axis(1),
            ("vertex", "z") => Role::Axis(2),
            ("face", "vertex_indices") => Role::Corners,
            ("face", "vertex_index") if !has_indices => Role::Corners,
            _ => Role::Other,
        };
        let name = names.get(name).unwrap_or(name).clone();
        Property { role, shape, name }
    };
    Element { kind, count: def.count as u64, properties: def.properties.iter().map(property).collect() }
}

/// Copies a header so that the parser takes it and nothing that matters is lost.
struct Cleaner<'a> {
    input: &'a Input,
    line: Item,
    byte: u64,
    seen: Vec<String>,
    /// What the numbers stand for that names were replaced by.
    names: FxHashMap<String, String>,
}

impl<'a> Cleaner<'a> {
    fn new(input: &'a Input) -> Self {
        Cleaner {
            input,
            line: Item { kind: "header line", ordinal: 0 },
            byte: 0,
            seen: Vec::new(),
            names: FxHashMap::default(),
        }
    }

    fn clean(&mut self, header: &[u8]) -> Result<String> {
        let ending = line_ending(header);
        let mut cleaned = String::new();
        for line in header.split(|&b| b == ending) {
            self.clean_line(line, &mut cleaned)?;
            self.byte += line.len() as u64 + 1;
            self.line.ordinal += 1;
        }
        Ok(cleaned)
    }

    fn clean_line(&mut self, line: &[u8], cleaned: &mut String) -> Result<()> {
        let line = String::from_utf8_lossy(line.trim_ascii());
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let words = match words[..] {
            [] | ["comment" | "obj_info", ..] => return Ok(()),
            ["element", name, count] => {
                self.seen.retain(|s| s.starts_with("element "));
                self.check_count(count)?;
                vec!["element".into(), self.name("element", name, &["vertex", "face"])?, count.into()]
            }
            ["property", "list", count, item, name] => {
                self.check_types(&[count, item])?;
                let name = self.name("property", name, &["x", "y", "z", "vertex_indices", "vertex_index"])?;
                vec!["property".into(), "list".into(), count.into(), item.into(), name]
            }
            ["property", kind, name] => {
                self.check_types(&[kind])?;
                let name = self.name("property", name, &["x", "y", "z", "vertex_indices", "vertex_index"])?;
                vec!["property".into(), kind.into(), name]
            }
            ["format", encoding, version] => {
                const ENCODINGS: [&str; 3] = ["ascii", "binary_little_endian", "binary_big_endian"];
                if !ENCODINGS.contains(&encoding) || version != "1.0" {
                    return Err(self.error(format!("`{}` is not a format that PLY has", shown(&line))));
                }
                words.iter().map(|w| w.to_string()).collect()
            }
            ["ply"] | ["end_header"] => words.iter().map(|w| w.to_string()).collect(),
            _ => return Err(self.error(format!("`{}` is not a line of a PLY header", shown(&line)))),
        };
        cleaned.push_str(&words.join(" "));
        cleaned.push('\n');
        Ok(())
    }

    /// The name, if it is one of those that matter, which must not come twice; else a number.
    fn name(&mut self, what: &str, name: &str, known: &[&str]) -> Result<String> {
        if !known.contains(&name) {
            let number = format!("skipped_{}", self.line.ordinal);
            self.names.insert(number.clone(), shown(name));
            return Ok(number);
        }
        let entry = format!("{what} {name}");
        if self.seen.contains(&entry) {
            return Err(self.error(format!("a second {entry}")));
        }
        self.seen.push(entry);
        Ok(name.into())
    }

    fn check_count(&self, count: &str) -> Result<()> {
        match count.parse::<u64>() {
            Ok(_) if count.bytes().all(|b| b.is_ascii_digit()) => Ok(()),
            _ => Err(self.error(format!("count `{}`, expected a number from 0 to 2^64 - 1", shown(count)))),
        }
    }

    fn check_types(&self, types: &[&str]) -> Result<()> {
        const TYPES: [&str; 16] = [
            "char", "uchar", "short", "ushort", "int", "uint", "float", "double", "int8", "uint8", "int16", "uint16",
            "int32", "uint32", "float32", "float64",
        ];
        match types.iter().find(|t| !TYPES.contains(t)) {
            Some(other) => Err(self.error(format!("`{}` is not a type that PLY has", shown(other)))),
            None => Ok(()),
        }
    }

    fn error(&self, what: String) -> Error {
        Error::input_at(self.input.path(), self.line, self.byte, what)
    }
}

/// Text of a file as it can be shown: short, on one line, without control characters.
pub(super) fn shown(text: &str) -> String {
    let mut shown: String = text.chars().take(40).flat_map(char::escape_debug).collect();
    if text.chars().nth(40).is_some() {
        shown.push('…');
    }
    shown
}
