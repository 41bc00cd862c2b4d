//! glTF 2: GLB, and glTF with its buffers beside or within it.
//!
//! A scan is the triangles of the default scene, each object where its node puts it: transforms of all parents multiplied
//! in doubles, corners reversed where one mirrors, as the format has it. Vertices of one object that several primitives
//! use are there once. Lines, points, skins, morph targets and other scenes are passed over; geometry that is compressed
//! (Draco, meshopt) or sparse is refused by name.
//!
//! Memory: the document without embedded buffers, up to 8 MiB of text, while the file is opened.

use super::attribute::Attribute;
use super::gltf_coat::Extras;
use super::gltf_json;
use super::gltf_looks::Looks;
use super::gltf_scene::Builder;
use super::map::{Input, WINDOW_BYTES, Window};
use super::stream::{CHUNK, Crew, Numbering, pump};
use super::{TriangleChunk, TriangleStep, VertexChunk, VertexStep};
use crate::error::{Error, Item, Result};
use crate::mesh::coat;
use crate::scratch::Scratch;
use glam::{DAffine3, DVec3};
use std::path::Path;

/// What a GLB begins with.
pub(super) const MAGIC: &[u8; 4] = b"glTF";

/// An open glTF file.
#[derive(Debug)]
pub(super) struct Gltf {
    /// Whether it is a GLB.
    pub is_binary: bool,
    /// Files that buffers are in, beside the one that was opened.
    pub others: Vec<Input>,
    pub clouds: Vec<Cloud>,
    pub patches: Vec<Patch>,
    pub looks: Looks,
    pub vertices: u64,
    pub triangles: u64,
    pub fits_f32: bool,
    pub attributes: Vec<Attribute>,
    pub trailing: u64,
}

/// Numbers of one kind in a buffer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Numbers {
    /// 0 for the file itself, others from 1 on.
    pub source: usize,
    pub offset: u64,
    pub stride: usize,
    pub count: u64,
    pub kind: Kind,
    pub normalised: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

/// Positions, and where they are put.
#[derive(Debug)]
pub(super) struct Cloud {
    pub numbers: Numbers,
    pub extras: Extras,
    pub transform: Option<DAffine3>,
    pub first: u64,
}

/// Triangles over a cloud.
#[derive(Debug)]
pub(super) struct Patch {
    pub cloud: usize,
    pub shape: Shape,
    /// Without, vertices are taken as they come.
    pub indices: Option<Numbers>,
    pub mirrored: bool,
    /// What its triangles belong to, by the numbers that [`Looks`] has.
    pub belongs: coat::Patch,
    pub triangles: u64,
    pub first: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Shape {
    Apart,
    Strip,
    Fan,
}

/// Whether text that begins like this may be glTF.
pub(super) fn is_json(head: &[u8]) -> bool {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head).trim_ascii_start();
    head.first() == Some(&b'{') && head[1..].trim_ascii_start().first().is_none_or(|b| matches!(b, b'"' | b'}'))
}

impl Gltf {
    /// Reads the document and finds where everything is.
    pub fn open(input: &Input, scratch: Option<&Scratch>) -> Result<Gltf> {
        let mut magic = [0; 4];
        let is_binary = input.len() >= 12 && input.read_at(&mut magic, 0).is_ok() && &magic == MAGIC;
        let parts =
            if is_binary { Parts::of_glb(input)? } else { Parts { json: (0, input.len()), ..Parts::default() } };
        let (document, unpacked) = gltf_json::read(input, parts.json.0, parts.json.1, scratch)?;
        let mut others = Vec::new();
        for file in unpacked {
            others.push(Input::unpacked(input.path(), file)?);
        }
        let mut builder = Builder::new(input, &document, parts.binary, others);
        builder.check_extensions()?;
        builder.scene()?;
        builder.finish(is_binary, parts.trailing)
    }

    pub(super) fn input<'a>(&'a self, input: &'a Input, numbers: &Numbers) -> &'a Input {
        numbers.source.checked_sub(1).and_then(|i| self.others.get(i)).unwrap_or(input)
    }

    /// Bytes of all files.
    pub fn bytes(&self, input: &Input) -> u64 {
        input.len() + self.others.iter().map(Input::len).sum::<u64>()
    }

    /// Streams the vertices.
    pub fn vertices(&self, input: &Input, crew: &Crew<'_>, step: &VertexStep<'_>) -> Result<()> {
        let numbers = Numbering::default();
        let mut clouds = self.clouds.iter();
        let mut now = clouds.next().map(|cloud| (cloud, 0));
        let next = || {
            while let Some((cloud, done)) = now {
                if done == cloud.numbers.count {
                    now = clouds.next().map(|cloud| (cloud, 0));
                    continue;
                }
                let some = cloud.numbers.in_window().min(cloud.numbers.count - done);
                let window = cloud.numbers.window(self.input(input, &cloud.numbers), done, some, 3)?;
                now = Some((cloud, done + some));
                let bytes = window.len() as u64;
                return Ok(Some(((cloud, done, window), bytes)));
            }
            Ok(None)
        };
        let local = || (numbers.next(), Vec::with_capacity(CHUNK));
        pump(crew, next, local, |(mine, positions), (cloud, done, window)| {
            let stride = cloud.numbers.stride;
            for (i, records) in window.chunks(CHUNK * stride).enumerate() {
                positions.clear();
                cloud.decode(records, positions);
                step(*mine, VertexChunk { first: cloud.first + done + (i * CHUNK) as u64, positions })?;
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Streams the triangles.
    pub fn triangles(&self, input: &Input, crew: &Crew<'_>, step: &TriangleStep<'_>) -> Result<()> {
        let numbers = Numbering::default();
        let mut patches = self.patches.iter();
        let mut now = patches.next().map(|patch| (patch, 0));
        let next = || {
            while let Some((patch, done)) = now {
                if done == patch.triangles {
                    now = patches.next().map(|patch| (patch, 0));
                    continue;
                }
                let some = (CHUNK as u64).min(patch.triangles - done);
                let (first, len) = patch.shape.corners(done, some);
                let source = patch.indices.map(|n| self.input(input, &n));
                let mut hub = 0;
                let mut window = None;
                if let (Some(indices), Some(source)) = (&patch.indices, source) {
                    window = Some(indices.window(source, first, len, 1)?);
                    if patch.shape == Shape::Fan {
                        hub = indices.first(source)?;
                    }
                }
                now = Some((patch, done + some));
                let bytes = window.as_ref().map_or(0, |w: &Window| w.len() as u64);
                return Ok(Some(((patch, done, some, hub, window), bytes)));
            }
            Ok(None)
        };
        let local = || (numbers.next(), Vec::with_capacity(3 * CHUNK), Vec::with_capacity(CHUNK));
        pump(crew, next, local, |(mine, corners, triangles), (patch, done, some, hub, window)| {
            let (first, len) = patch.shape.corners(done, some);
            let cloud = &self.clouds[patch.cloud];
            corners.clear();
            match (&patch.indices, &window) {
                (Some(indices), Some(window)) => {
                    indices.decode_indices(window, corners);
                    let bad = corners.iter().position(|v| u64::from(*v) >= cloud.numbers.count);
                    let bad = bad.or((u64::from(hub) >= cloud.numbers.count).then_some(0));
                    if let Some(bad) = bad {
                        let index = if u64::from(corners[bad]) < cloud.numbers.count { hub } else { corners[bad] };
                        let source = self.input(input, indices);
                        let byte = indices.offset + (first + bad as u64) * indices.stride as u64;
                        let triangle = patch.first + done + patch.shape.triangle_of(bad as u64).min(some - 1);
                        return Err(no_such_vertex(source, triangle, byte, index, cloud.numbers.count));
                    }
                }
                _ => corners.extend((first..first + len).map(|v| v as u32)),
            }
            patch.assemble(done, some as usize, hub, corners, cloud.first as u32, triangles);
            step(*mine, TriangleChunk { first: patch.first + done, triangles })
        })?;
        Ok(())
    }

    /// The file and byte of a vertex, if the byte is one of the file that was named.
    pub fn vertex_place<'a>(&'a self, input: &'a Input, vertex: u64) -> (&'a Path, Option<u64>) {
        let after = self.clouds.partition_point(|cloud| cloud.first <= vertex);
        let Some(cloud) = after.checked_sub(1).and_then(|i| self.clouds.get(i)) else { return (input.path(), None) };
        let source = self.input(input, &cloud.numbers);
        let byte = cloud.numbers.offset + (vertex - cloud.first) * cloud.numbers.stride as u64;
        (source.path(), (!source.is_unpacked()).then_some(byte))
    }
}

fn no_such_vertex(source: &Input, ordinal: u64, byte: u64, index: u32, vertices: u64) -> Error {
    let what = format!("index {index}, but its primitive has {vertices} vertices");
    let byte = (!source.is_unpacked()).then_some(byte);
    Error::Input { file: source.path().into(), item: Some(Item { kind: "face", ordinal }), byte, what }
}

/// Where the parts of a GLB are: offset and length.
#[derive(Debug, Default)]
struct Parts {
    json: (u64, u64),
    binary: Option<(u64, u64)>,
    trailing: u64,
}

impl Parts {
    fn of_glb(input: &Input) -> Result<Parts> {
        let word = |at: u64| {
            let mut bytes = [0; 4];
            input.read_at(&mut bytes, at).map(|()| u32::from_le_bytes(bytes))
        };
        let wrong = |byte, what: String| Error::Input { file: input.path().into(), item: None, byte: Some(byte), what };
        let (version, length) = (word(4)?, u64::from(word(8)?));
        if version != 2 {
            return Err(wrong(4, format!("glTF version {version}, expected 2")));
        }
        if length > input.len() || length < 20 {
            let what = format!("a length of {length} bytes, but the file has {}", input.len());
            return Err(wrong(8, what));
        }
        let mut parts = Parts { trailing: input.len() - length, ..Parts::default() };
        let mut at = 12;
        while at + 8 <= length {
            let (len, kind) = (u64::from(word(at)?), word(at + 4)?);
            if at + 8 + len > length {
                let what = format!("a chunk of {len} bytes, but {} are left", length - at - 8);
                return Err(wrong(at, what));
            }
            match kind {
                0x4e4f_534a if at == 12 => parts.json = (at + 8, len),
                0x004e_4942 if parts.binary.is_none() => parts.binary = Some((at + 8, len)),
                _ => {}
            }
            // Chunks begin at multiples of four.
            at += 8 + len.next_multiple_of(4);
        }
        if parts.json.1 == 0 {
            return Err(wrong(12, "no JSON, which a GLB begins with".into()));
        }
        Ok(parts)
    }
}

impl Kind {
    pub fn of(component_type: u32) -> Option<Kind> {
        Some(match component_type {
            5120 => Kind::I8,
            5121 => Kind::U8,
            5122 => Kind::I16,
            5123 => Kind::U16,
            5125 => Kind::U32,
            5126 => Kind::F32,
            _ => return None,
        })
    }

    pub fn bytes(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::U32 | Kind::F32 => 4,
        }
    }

    pub fn word(self) -> &'static str {
        match self {
            Kind::I8 => "byte",
            Kind::U8 => "unsigned byte",
            Kind::I16 => "short",
            Kind::U16 => "unsigned short",
            Kind::U32 => "unsigned int",
            Kind::F32 => "float",
        }
    }

    /// A coordinate.
    #[inline(always)]
    fn number(self, b: &[u8], normalised: bool) -> f64 {
        let (x, most) = match self {
            Kind::I8 => (f64::from(b[0] as i8), 127.0),
            Kind::U8 => (f64::from(b[0]), 255.0),
            Kind::I16 => (f64::from(i16::from_le_bytes([b[0], b[1]])), 32_767.0),
            Kind::U16 => (f64::from(u16::from_le_bytes([b[0], b[1]])), 65_535.0),
            Kind::U32 => (f64::from(u32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
            Kind::F32 => (f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])), 1.0),
        };
        if normalised { (x / most).max(-1.0) } else { x }
    }
}

impl Numbers {
    /// Elements in a window.
    fn in_window(&self) -> u64 {
        let fit = WINDOW_BYTES / self.stride;
        (if fit > CHUNK { fit / CHUNK * CHUNK } else { fit.max(1) }) as u64
    }

    /// Elements `first..first + n`, each of so many numbers. The last is not followed by what is between it and the next.
    pub(super) fn window(&self, source: &Input, first: u64, n: u64, numbers: usize) -> Result<Window> {
        let bytes = (n as usize - 1) * self.stride + numbers * self.kind.bytes();
        source.window(self.offset + first * self.stride as u64, bytes)
    }

    /// Elements of so many numbers each.
    pub(super) fn each<const N: usize>(&self, bytes: &[u8], mut take: impl FnMut([f64; N])) {
        let size = self.kind.bytes();
        for record in bytes.chunks(self.stride).filter(|record| record.len() >= N * size) {
            take(std::array::from_fn(|i| self.kind.number(&record[i * size..], self.normalised)));
        }
    }

    fn first(&self, source: &Input) -> Result<u32> {
        let mut bytes = [0; 4];
        source.read_at(&mut bytes[..self.kind.bytes()], self.offset)?;
        Ok(u32::from_le_bytes(bytes))
    }

    fn decode_indices(&self, bytes: &[u8], out: &mut Vec<u32>) {
        match self.kind {
            Kind::U8 => out.extend(bytes.iter().map(|b| u32::from(*b))),
            Kind::U16 => out.extend(bytes.as_chunks().0.iter().map(|b| u32::from(u16::from_le_bytes(*b)))),
            _ => out.extend(bytes.as_chunks().0.iter().map(|b| u32::from_le_bytes(*b))),
        }
    }
}

impl Cloud {
    pub(super) fn decode(&self, records: &[u8], out: &mut Vec<[f64; 3]>) {
        let Numbers { stride, kind, normalised, .. } = self.numbers;
        let size = kind.bytes();
        if (kind, stride) == (Kind::F32, 12) {
            let float = |b: &[u8; 4]| f64::from(f32::from_le_bytes(*b));
            out.extend(records.as_chunks::<12>().0.iter().map(|r| {
                let [x, y, z] = [0, 4, 8].map(|at| r[at..].first_chunk().map_or(0.0, float));
                [x, y, z]
            }));
        } else {
            let axis = |r: &[u8], axis: usize| kind.number(&r[axis * size..], normalised);
            out.extend(records.chunks(stride).map(|r| [axis(r, 0), axis(r, 1), axis(r, 2)]));
        }
        if let Some(transform) = &self.transform {
            for p in out {
                *p = transform.transform_point3(DVec3::from_array(*p)).to_array();
            }
        }
    }
}

impl Shape {
    /// The first corner of triangles `done..done + some`, and how many corners they have together.
    fn corners(self, done: u64, some: u64) -> (u64, u64) {
        match self {
            Shape::Apart => (3 * done, 3 * some),
            Shape::Strip => (done, some + 2),
            Shape::Fan => (done + 1, some + 1),
        }
    }

    /// The triangle that a corner is first needed for.
    fn triangle_of(self, corner: u64) -> u64 {
        match self {
            Shape::Apart => corner / 3,
            Shape::Strip => corner.saturating_sub(2),
            Shape::Fan => corner.saturating_sub(1),
        }
    }

    pub fn triangles(self, corners: u64) -> u64 {
        if self == Shape::Apart { corners / 3 } else { corners.saturating_sub(2) }
    }
}

impl Patch {
    fn assemble(&self, done: u64, some: usize, hub: u32, corners: &[u32], base: u32, out: &mut Vec<[u32; 3]>) {
        out.clear();
        match self.shape {
            Shape::Apart => out.extend_from_slice(&corners.as_chunks().0[..some]),
            Shape::Strip => out.extend(corners.windows(3).take(some).enumerate().map(|(i, t)| {
                // Every other triangle of a strip runs the other way.
                if (done + i as u64).is_multiple_of(2) { [t[0], t[1], t[2]] } else { [t[1], t[0], t[2]] }
            })),
            Shape::Fan => out.extend(corners.windows(2).take(some).map(|pair| [hub, pair[0], pair[1]])),
        }
        for triangle in out {
            if self.mirrored {
                triangle.swap(1, 2);
            }
            *triangle = triangle.map(|v| v + base);
        }
    }
}
