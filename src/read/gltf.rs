//! glTF 2: GLB, and glTF with its buffers beside or within it.
//!
//! A scan is the triangles of the default scene, each object where its node puts it: transforms of all parents multiplied
//! in doubles, corners reversed where one mirrors, as the format has it. Vertices of one object that several primitives
//! use are there once. Lines, points, skins, morph targets and other scenes are passed over; geometry that is compressed
//! (Draco, meshopt) or sparse is refused by name.
//!
//! Memory: the document without embedded buffers, up to 8 MiB of text, while the file is opened.

use super::attribute::{Attribute, Carrier};
use super::gltf_json::{self, Accessor, Document, Node, Place, Primitive, View};
use super::map::{Input, WINDOW_BYTES, Window};
use super::stream::{CHUNK, Crew, Numbering, pump};
use super::{TriangleChunk, TriangleStep, VertexChunk, VertexStep};
use crate::error::{Error, Item, Result};
use crate::scratch::Scratch;
use glam::{DAffine3, DMat4, DQuat, DVec3};
use rustc_hash::FxHashMap;
use std::path::{Path, PathBuf};

/// What a GLB begins with.
pub(super) const MAGIC: &[u8; 4] = b"glTF";

/// The longest stride that is read: far beyond the 252 bytes that the format allows.
const MOST_STRIDE: u64 = 1 << 16;

/// A scene is taken as in doubles where objects are moved by more than so many times their own size: floats would lose
/// digits that the object has.
const FAR: f64 = 8.0;

/// An open glTF file.
#[derive(Debug)]
pub(super) struct Gltf {
    /// Whether it is a GLB.
    pub is_binary: bool,
    /// Files that buffers are in, beside the one that was opened.
    others: Vec<Input>,
    clouds: Vec<Cloud>,
    patches: Vec<Patch>,
    pub vertices: u64,
    pub triangles: u64,
    pub fits_f32: bool,
    pub attributes: Vec<Attribute>,
    pub trailing: u64,
}

/// Numbers of one kind in a buffer.
#[derive(Debug, Clone, Copy)]
struct Numbers {
    /// 0 for the file itself, others from 1 on.
    source: usize,
    offset: u64,
    stride: usize,
    count: u64,
    kind: Kind,
    normalised: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    U32,
    F32,
}

/// Positions, and where they are put.
#[derive(Debug)]
struct Cloud {
    numbers: Numbers,
    transform: Option<DAffine3>,
    first: u64,
}

/// Triangles over a cloud.
#[derive(Debug)]
struct Patch {
    cloud: usize,
    shape: Shape,
    /// Without, vertices are taken as they come.
    indices: Option<Numbers>,
    mirrored: bool,
    triangles: u64,
    first: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shape {
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
        let mut builder = Builder {
            input,
            document: &document,
            here: parts.binary,
            others,
            beside: FxHashMap::default(),
            clouds: Vec::new(),
            patches: Vec::new(),
            vertices: 0,
            triangles: 0,
            fits_f32: true,
        };
        builder.check_extensions()?;
        builder.scene()?;
        builder.finish(is_binary, parts.trailing)
    }

    fn input<'a>(&'a self, input: &'a Input, numbers: &Numbers) -> &'a Input {
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
    fn of(component_type: u32) -> Option<Kind> {
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

    fn bytes(self) -> usize {
        match self {
            Kind::I8 | Kind::U8 => 1,
            Kind::I16 | Kind::U16 => 2,
            Kind::U32 | Kind::F32 => 4,
        }
    }

    fn word(self) -> &'static str {
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
    fn window(&self, source: &Input, first: u64, n: u64, numbers: usize) -> Result<Window> {
        let bytes = (n as usize - 1) * self.stride + numbers * self.kind.bytes();
        source.window(self.offset + first * self.stride as u64, bytes)
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
    fn decode(&self, records: &[u8], out: &mut Vec<[f64; 3]>) {
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

    fn triangles(self, corners: u64) -> u64 {
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

/// Puts a scan together from a document.
struct Builder<'a> {
    input: &'a Input,
    document: &'a Document,
    here: Option<(u64, u64)>,
    others: Vec<Input>,
    /// Files beside this one that are open, by path.
    beside: FxHashMap<PathBuf, usize>,
    clouds: Vec<Cloud>,
    patches: Vec<Patch>,
    vertices: u64,
    triangles: u64,
    fits_f32: bool,
}

impl Builder<'_> {
    fn wrong<T>(&self, kind: &'static str, ordinal: usize, what: impl Into<String>) -> Result<T> {
        let item = Some(Item { kind, ordinal: ordinal as u64 });
        Err(Error::Input { file: self.input.path().into(), item, byte: None, what: what.into() })
    }

    /// Refuses what cannot be read without an extension that is not known here.
    fn check_extensions(&self) -> Result<()> {
        const HARMLESS: [&str; 6] =
            ["KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_mesh_quantization"];
        let is_harmless = |name: &String| HARMLESS.iter().any(|prefix| name.starts_with(prefix));
        match self.document.extensions_required.iter().find(|name| !is_harmless(name)) {
            Some(name) => {
                let name = super::ply_header::shown(name);
                let what = format!("requires the extension {name}, which is not read: save it without");
                Err(Error::input(self.input.path(), what))
            }
            None => Ok(()),
        }
    }

    /// Takes the objects of the default scene; without scenes, those of all nodes that are nobody's children; without
    /// nodes, every mesh as it is.
    fn scene(&mut self) -> Result<()> {
        let document = self.document;
        if document.nodes.is_empty() {
            return (0..document.meshes.len()).try_for_each(|mesh| self.object(mesh, DAffine3::IDENTITY));
        }
        let roots = match document.scenes.get(document.scene.unwrap_or(0)) {
            Some(scene) => scene.nodes.clone(),
            None if document.scenes.is_empty() => {
                let mut is_child = vec![false; document.nodes.len()];
                for child in document.nodes.iter().flat_map(|node| &node.children) {
                    if let Some(is_child) = is_child.get_mut(*child) {
                        *is_child = true;
                    }
                }
                (0..document.nodes.len()).filter(|n| !is_child[*n]).collect()
            }
            None => return self.wrong("scene", document.scene.unwrap_or(0), "is named, but not there"),
        };
        let mut seen = vec![false; document.nodes.len()];
        let mut open: Vec<(usize, DAffine3)> = roots.into_iter().rev().map(|n| (n, DAffine3::IDENTITY)).collect();
        while let Some((n, parent)) = open.pop() {
            let Some(node) = document.nodes.get(n) else { return self.wrong("node", n, "is named, but not there") };
            if std::mem::replace(&mut seen[n], true) {
                return self.wrong("node", n, "is reached twice, expected a tree");
            }
            let Some(transform) = transform(node).map(|own| parent * own).filter(DAffine3::is_finite) else {
                return self.wrong("node", n, "has a transform that is not finite");
            };
            if let Some(mesh) = node.mesh {
                self.object(mesh, transform)?;
            }
            open.extend(node.children.iter().rev().map(|child| (*child, transform)));
        }
        Ok(())
    }

    /// Takes a mesh, put where a node puts it.
    fn object(&mut self, mesh: usize, transform: DAffine3) -> Result<()> {
        let document = self.document;
        let Some(found) = document.meshes.get(mesh) else { return self.wrong("mesh", mesh, "is named, but not there") };
        let mut clouds = FxHashMap::default();
        for primitive in &found.primitives {
            let shape = match primitive.mode.unwrap_or(4) {
                4 => Shape::Apart,
                5 => Shape::Strip,
                6 => Shape::Fan,
                _ => continue,
            };
            let Some(&positions) = primitive.attributes.get("POSITION") else { continue };
            self.check_primitive(mesh, primitive)?;
            let cloud = match clouds.get(&positions) {
                Some(cloud) => *cloud,
                None => {
                    let cloud = self.cloud(positions, transform)?;
                    clouds.insert(positions, cloud);
                    cloud
                }
            };
            self.patch(cloud, shape, primitive.indices, transform)?;
        }
        Ok(())
    }

    fn check_primitive(&self, mesh: usize, primitive: &Primitive) -> Result<()> {
        match primitive.extensions.keys().find(|name| name.contains("draco")) {
            Some(name) => {
                let name = super::ply_header::shown(name);
                self.wrong("mesh", mesh, format!("is compressed with {name}, which is not read: save it without"))
            }
            None => Ok(()),
        }
    }

    fn cloud(&mut self, accessor: usize, transform: DAffine3) -> Result<usize> {
        let numbers = self.numbers(accessor, "VEC3", 3)?;
        if numbers.kind == Kind::U32 {
            return self.wrong("accessor", accessor, "holds positions in unsigned int, which glTF does not have");
        }
        let is_moved = transform != DAffine3::IDENTITY;
        self.fits_f32 &= !is_moved || !is_far(&self.document.accessors[accessor], &transform);
        self.clouds.push(Cloud { numbers, transform: is_moved.then_some(transform), first: self.vertices });
        self.vertices = self.vertices.saturating_add(numbers.count);
        if self.vertices > 1 << 32 {
            return Err(Error::input(self.input.path(), "has more than 4294967296 vertices, too many to index"));
        }
        Ok(self.clouds.len() - 1)
    }

    fn patch(&mut self, cloud: usize, shape: Shape, indices: Option<usize>, transform: DAffine3) -> Result<()> {
        let indices = match indices {
            Some(accessor) => {
                let numbers = self.numbers(accessor, "SCALAR", 1)?;
                if !matches!(numbers.kind, Kind::U8 | Kind::U16 | Kind::U32) || numbers.stride != numbers.kind.bytes() {
                    return self.wrong(
                        "accessor",
                        accessor,
                        "holds no indices: expected unsigned integers, close packed",
                    );
                }
                Some(numbers)
            }
            None => None,
        };
        let corners = indices.map_or(self.clouds[cloud].numbers.count, |n| n.count);
        let triangles = shape.triangles(corners);
        if triangles > 0 {
            let mirrored = transform.matrix3.determinant() < 0.0;
            self.patches.push(Patch { cloud, shape, indices, mirrored, triangles, first: self.triangles });
            self.triangles = self.triangles.saturating_add(triangles);
        }
        Ok(())
    }

    /// Where the numbers of an accessor are, which is within the buffer and the file that it is in.
    fn numbers(&mut self, number: usize, shape: &str, width: u64) -> Result<Numbers> {
        let document = self.document;
        let Some(accessor) = document.accessors.get(number) else {
            return self.wrong("accessor", number, "is named, but not there");
        };
        if accessor.sparse.is_some() {
            return self.wrong("accessor", number, "is sparse, which is not read: save it dense");
        }
        let Some(kind) = Kind::of(accessor.component_type).filter(|_| accessor.shape == shape) else {
            let found = super::ply_header::shown(&accessor.shape);
            let what = format!("{found} of component type {}, expected {shape}", accessor.component_type);
            return self.wrong("accessor", number, what);
        };
        let Some(view) = accessor.buffer_view.and_then(|v| document.buffer_views.get(v)) else {
            return self.wrong("accessor", number, "has no bytes: it names no buffer view that is there");
        };
        self.check_view(number, view)?;
        let size = width * kind.bytes() as u64;
        let stride = view.byte_stride.filter(|n| *n > 0).unwrap_or(size);
        if !(size..=MOST_STRIDE).contains(&stride) {
            return self.wrong("accessor", number, format!("a stride of {stride} bytes for elements of {size}"));
        }
        if accessor.count == 0 {
            return self.wrong("accessor", number, "counts 0");
        }
        let end =
            u128::from(accessor.byte_offset) + u128::from(accessor.count - 1) * u128::from(stride) + u128::from(size);
        if end > u128::from(view.byte_length) {
            let what = format!("needs {end} bytes, but its buffer view has {}", view.byte_length);
            return self.wrong("accessor", number, what);
        }
        let (source, begin, length) = self.source(view.buffer)?;
        let view_end = u128::from(view.byte_offset) + u128::from(view.byte_length);
        if view_end > u128::from(length) {
            return self.wrong(
                "accessor",
                number,
                format!("its buffer view ends at {view_end}, its buffer at {length}"),
            );
        }
        let offset = begin + view.byte_offset + accessor.byte_offset;
        let (normalised, count) = (accessor.normalized && kind != Kind::F32, accessor.count);
        Ok(Numbers { source, offset, stride: stride as usize, count, kind, normalised })
    }

    fn check_view(&self, accessor: usize, view: &View) -> Result<()> {
        match view.extensions.keys().find(|name| name.contains("compression")) {
            Some(name) => {
                let name = super::ply_header::shown(name);
                self.wrong(
                    "accessor",
                    accessor,
                    format!("is compressed with {name}, which is not read: save it without"),
                )
            }
            None => Ok(()),
        }
    }

    /// The file that a buffer is in, where it begins there, and how long it is.
    fn source(&mut self, number: usize) -> Result<(usize, u64, u64)> {
        let document = self.document;
        let Some(buffer) = document.buffers.get(number) else {
            return self.wrong("buffer", number, "is named, but not there");
        };
        let (source, begin, room) = match buffer.place() {
            Place::Here => match self.here {
                Some((begin, length)) if number == 0 => (0, begin, length),
                _ => return self.wrong("buffer", number, "names no file, and there is no binary part that holds it"),
            },
            Place::Unpacked(i) => match self.others.get(i) {
                Some(file) => (i + 1, 0, file.len()),
                None => return self.wrong("buffer", number, "is not there"),
            },
            Place::Beside(uri) => {
                let i = self.file_beside(number, uri)?;
                (i + 1, 0, self.others[i].len())
            }
        };
        if buffer.byte_length > room {
            let what = format!("{} bytes are promised, but there are {room}", buffer.byte_length);
            return self.wrong("buffer", number, what);
        }
        Ok((source, begin, buffer.byte_length))
    }

    fn file_beside(&mut self, number: usize, uri: &str) -> Result<usize> {
        let shown = super::ply_header::shown(uri);
        let name = match unescaped(uri) {
            Some(name) if !name.is_empty() && !uri.contains("://") && !uri.starts_with("data:") => PathBuf::from(name),
            _ => {
                return self.wrong("buffer", number, format!("is at `{shown}`, expected the name of a file beside it"));
            }
        };
        if name.is_absolute() {
            return self.wrong("buffer", number, format!("is at `{shown}`, expected a path relative to this file"));
        }
        let path = self.input.path().parent().unwrap_or(Path::new("")).join(name);
        if let Some(i) = self.beside.get(&path) {
            return Ok(*i);
        }
        self.others.push(Input::open(&path)?);
        self.beside.insert(path, self.others.len() - 1);
        Ok(self.others.len() - 1)
    }

    fn finish(self, is_binary: bool, trailing: u64) -> Result<Gltf> {
        if self.triangles == 0 {
            return Err(Error::input(self.input.path(), "has no faces: no triangles in its scene"));
        }
        let attributes = attributes(self.document);
        let Builder { others, clouds, patches, vertices, triangles, fits_f32, .. } = self;
        Ok(Gltf { is_binary, others, clouds, patches, vertices, triangles, fits_f32, attributes, trailing })
    }
}

/// What vertices of any primitive carry, by name.
fn attributes(document: &Document) -> Vec<Attribute> {
    let primitives = document.meshes.iter().flat_map(|mesh| &mesh.primitives);
    let mut found: Vec<Attribute> = Vec::new();
    for (name, accessor) in primitives.flat_map(|primitive| &primitive.attributes) {
        let name = super::ply_header::shown(name);
        if name == "POSITION" || found.iter().any(|a| a.name == name) || found.len() == 64 {
            continue;
        }
        let kind = document.accessors.get(*accessor).map_or(String::new(), |accessor| {
            let shape = super::ply_header::shown(&accessor.shape);
            format!("{shape} {}", Kind::of(accessor.component_type).map_or("unknown", Kind::word))
        });
        found.push(Attribute::of(Carrier::Vertex, name, kind));
    }
    found.sort_by(|a, b| a.name.cmp(&b.name));
    found
}

/// A node's own transform.
fn transform(node: &Node) -> Option<DAffine3> {
    if let Some(columns) = node.matrix {
        return Some(DAffine3::from_mat4(DMat4::from_cols_array(&columns)));
    }
    let scale = node.scale.map_or(DVec3::ONE, DVec3::from_array);
    let rotation = match node.rotation.map(DQuat::from_array) {
        Some(rotation) => Some(rotation.normalize()).filter(|r| r.is_finite())?,
        None => DQuat::IDENTITY,
    };
    let translation = node.translation.map_or(DVec3::ZERO, DVec3::from_array);
    Some(DAffine3::from_scale_rotation_translation(scale, rotation, translation))
}

/// Whether an object is moved so far that floats would lose digits of it.
fn is_far(accessor: &Accessor, transform: &DAffine3) -> bool {
    let moved = transform.translation.abs().max_element();
    let size = match (accessor.min.first_chunk::<3>(), accessor.max.first_chunk::<3>()) {
        (Some(min), Some(max)) => {
            let most = DVec3::from_array(*min).abs().max(DVec3::from_array(*max).abs());
            let m = transform.matrix3;
            (m.x_axis.abs() * most.x + m.y_axis.abs() * most.y + m.z_axis.abs() * most.z).max_element()
        }
        _ => 0.0,
    };
    // Also true of what is not a number.
    !(moved <= FAR * size)
}

/// The text of a URI, `%20` and the like resolved.
fn unescaped(uri: &str) -> Option<String> {
    let mut bytes = Vec::new();
    let mut rest = uri.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match byte {
            b'%' => {
                let digits = [rest.next()?, rest.next()?];
                u8::from_str_radix(std::str::from_utf8(&digits).ok()?, 16).ok()?
            }
            0 => return None,
            other => other,
        });
    }
    String::from_utf8(bytes).ok().filter(|name| !name.contains('\0'))
}
