//! The scene of a glTF file: which numbers are positions and corners of the scan, and where they are put.
//!
//! All that a document says is held against the sizes of views, buffers and files here.

use super::attribute::{Attribute, Carrier};
use super::gltf::{Cloud, Gltf, Kind, Numbers, Patch, Shape};
use super::gltf_coat::Extras;
use super::gltf_json::{Accessor, Document, Image, Node, Place, Primitive, View, place};
use super::gltf_looks::{Texturing, Wanted};
use super::map::Input;
use super::ply_header::shown;
use crate::error::{Error, Item, Result};
use crate::mesh::coat::{self, Bytes};
use glam::{DAffine3, DMat4, DQuat, DVec3};
use rustc_hash::FxHashMap;
use std::path::{Path, PathBuf};

/// The longest stride that is read: far beyond the 252 bytes that the format allows.
const MOST_STRIDE: u64 = 1 << 16;

/// A scene is taken as in doubles where objects are moved by more than so many times their own size: floats would lose
/// digits that the object has.
const FAR: f64 = 8.0;

/// Puts a scan together from a document.
pub(super) struct Builder<'a> {
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
    wanted: Wanted,
}

impl<'a> Builder<'a> {
    /// Nothing yet; `here` is the binary part of the file, `unpacked` are buffers that it embeds.
    pub fn new(input: &'a Input, document: &'a Document, here: Option<(u64, u64)>, unpacked: Vec<Input>) -> Self {
        Builder {
            input,
            document,
            here,
            others: unpacked,
            beside: FxHashMap::default(),
            clouds: Vec::new(),
            patches: Vec::new(),
            vertices: 0,
            triangles: 0,
            fits_f32: true,
            wanted: Wanted::default(),
        }
    }

    /// What is read.
    pub fn document(&self) -> &'a Document {
        self.document
    }

    fn wrong<T>(&self, kind: &'static str, ordinal: usize, what: impl Into<String>) -> Result<T> {
        let item = Some(Item { kind, ordinal: ordinal as u64 });
        Err(Error::Input { file: self.input.path().into(), item, byte: None, what: what.into() })
    }

    /// Refuses what cannot be read without an extension that is not known here.
    pub fn check_extensions(&self) -> Result<()> {
        const HARMLESS: [&str; 6] =
            ["KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "KHR_mesh_quantization"];
        let is_harmless = |name: &String| HARMLESS.iter().any(|prefix| name.starts_with(prefix));
        match self.document.extensions_required.iter().find(|name| !is_harmless(name)) {
            Some(name) => {
                let name = shown(name);
                let what = format!("requires the extension {name}, which is not read: save it without");
                Err(Error::input(self.input.path(), what))
            }
            None => Ok(()),
        }
    }

    /// Takes the objects of the default scene; without scenes, those of all nodes that are nobody's children; without
    /// nodes, every mesh as it is.
    pub fn scene(&mut self) -> Result<()> {
        let document = self.document;
        if document.nodes.is_empty() {
            return (0..document.meshes.len()).try_for_each(|mesh| self.object(mesh, None, DAffine3::IDENTITY));
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
                self.object(mesh, node.name.as_deref(), transform)?;
            }
            open.extend(node.children.iter().rev().map(|child| (*child, transform)));
        }
        Ok(())
    }

    /// Takes a mesh, put where a node puts it.
    fn object(&mut self, mesh: usize, node: Option<&str>, transform: DAffine3) -> Result<()> {
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
            let texturing = Texturing::of(document, primitive.material);
            let names = [texturing.name(), "NORMAL".into(), "COLOR_0".into()];
            let extras = names.map(|name| primitive.attributes.get(&name).copied());
            let key = (positions, extras, texturing.turned.map(|_| primitive.material));
            let cloud = match clouds.get(&key) {
                Some(cloud) => *cloud,
                None => {
                    let cloud = self.cloud(positions, extras, texturing, transform)?;
                    clouds.insert(key, cloud);
                    cloud
                }
            };
            let belongs = coat::Patch {
                material: primitive.material.map(|material| self.wanted.material(document, material)),
                group: node.or(found.name.as_deref()).map(|name| self.wanted.group(name)),
                labels: Vec::new(),
            };
            self.patch(cloud, shape, primitive.indices, transform, belongs)?;
        }
        Ok(())
    }

    fn check_primitive(&self, mesh: usize, primitive: &Primitive) -> Result<()> {
        match primitive.extensions.keys().find(|name| name.contains("draco")) {
            Some(name) => {
                let name = shown(name);
                self.wrong("mesh", mesh, format!("is compressed with {name}, which is not read: save it without"))
            }
            None => Ok(()),
        }
    }

    fn cloud(
        &mut self,
        accessor: usize,
        extras: [Option<usize>; 3],
        texturing: Texturing,
        transform: DAffine3,
    ) -> Result<usize> {
        let numbers = self.numbers(accessor, "VEC3", 3)?;
        if numbers.kind == Kind::U32 {
            return self.wrong("accessor", accessor, "holds positions in unsigned int, which glTF does not have");
        }
        let is_moved = transform != DAffine3::IDENTITY;
        self.fits_f32 &= !is_moved || !is_far(&self.document.accessors[accessor], &transform);
        let [texture, normal, colour] = extras;
        let extras = Extras {
            turned: texturing.turned,
            texture: self.extra(texture, &[("VEC2", 2)], numbers.count),
            normal: self.extra(normal, &[("VEC3", 3)], numbers.count),
            colour: self.extra(colour, &[("VEC3", 3), ("VEC4", 4)], numbers.count),
        };
        self.clouds.push(Cloud { numbers, extras, transform: is_moved.then_some(transform), first: self.vertices });
        self.vertices = self.vertices.saturating_add(numbers.count);
        if self.vertices > 1 << 32 {
            return Err(Error::input(self.input.path(), "has more than 4294967296 vertices, too many to index"));
        }
        Ok(self.clouds.len() - 1)
    }

    /// Numbers that vertices carry, if all of them have some. What is wrong with them is no reason to refuse a shape.
    fn extra(&mut self, accessor: Option<usize>, shapes: &[(&str, u64)], count: u64) -> Option<Numbers> {
        let found = shapes.iter().find_map(|(shape, width)| self.numbers(accessor?, shape, *width).ok());
        found.filter(|numbers| numbers.count == count && numbers.kind != Kind::U32)
    }

    fn patch(
        &mut self,
        cloud: usize,
        shape: Shape,
        indices: Option<usize>,
        transform: DAffine3,
        belongs: coat::Patch,
    ) -> Result<()> {
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
            self.patches.push(Patch { cloud, shape, indices, mirrored, belongs, triangles, first: self.triangles });
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
            let found = shown(&accessor.shape);
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
                let name = shown(name);
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

    /// Where an image is.
    pub fn picture(&mut self, image: &Image) -> Option<Bytes> {
        if let Some(view) = image.buffer_view {
            let view = self.document.buffer_views.get(view)?;
            let (source, begin, length) = self.source(view.buffer).ok()?;
            let end = view.byte_offset.checked_add(view.byte_length)?;
            let file = source.checked_sub(1).map_or(self.input, |i| &self.others[i]);
            return (end <= length).then(|| file.part(begin + view.byte_offset, view.byte_length).ok()).flatten();
        }
        match place(image.uri.as_deref()?) {
            Place::Unpacked(i) => self.others.get(i).and_then(|file| file.part(0, file.len()).ok()),
            Place::Beside(uri) => {
                let name = unescaped(uri).filter(|name| !name.is_empty() && !uri.contains("://"))?;
                let path = Path::new(&name);
                let folder = self.input.path().parent().unwrap_or(Path::new(""));
                (path.is_relative() && folder.join(path).is_file()).then(|| Bytes::File(folder.join(path)))
            }
            Place::Here => None,
        }
    }

    fn file_beside(&mut self, number: usize, uri: &str) -> Result<usize> {
        let place = shown(uri);
        let name = match unescaped(uri) {
            Some(name) if !name.is_empty() && !uri.contains("://") && !uri.starts_with("data:") => PathBuf::from(name),
            _ => {
                return self.wrong("buffer", number, format!("is at `{place}`, expected the name of a file beside it"));
            }
        };
        if name.is_absolute() {
            return self.wrong("buffer", number, format!("is at `{place}`, expected a path relative to this file"));
        }
        let path = self.input.path().parent().unwrap_or(Path::new("")).join(name);
        if let Some(i) = self.beside.get(&path) {
            return Ok(*i);
        }
        self.others.push(Input::open(&path)?);
        self.beside.insert(path, self.others.len() - 1);
        Ok(self.others.len() - 1)
    }

    pub fn finish(mut self, is_binary: bool, trailing: u64) -> Result<Gltf> {
        if self.triangles == 0 {
            return Err(Error::input(self.input.path(), "has no faces: no triangles in its scene"));
        }
        let looks = std::mem::take(&mut self.wanted).looks(&mut self);
        looks.tidy(&mut self.patches);
        let mut attributes = attributes(self.document);
        attributes.extend(looks.attributes());
        let Builder { others, clouds, patches, vertices, triangles, fits_f32, .. } = self;
        Ok(Gltf { is_binary, others, clouds, patches, looks, vertices, triangles, fits_f32, attributes, trailing })
    }
}

/// What vertices of any primitive carry, by name.
fn attributes(document: &Document) -> Vec<Attribute> {
    let primitives = document.meshes.iter().flat_map(|mesh| &mesh.primitives);
    let mut found: Vec<Attribute> = Vec::new();
    for (name, accessor) in primitives.flat_map(|primitive| &primitive.attributes) {
        let name = shown(name);
        if name == "POSITION" || found.iter().any(|a| a.name == name) || found.len() == 64 {
            continue;
        }
        let kind = document.accessors.get(*accessor).map_or(String::new(), |accessor| {
            let shape = shown(&accessor.shape);
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
    moved.is_nan() || size.is_nan() || moved > FAR * size
}

/// The text of a URI, `%20` and the like resolved.
pub(super) fn unescaped(uri: &str) -> Option<String> {
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
