//! GLB: one mesh, one node.
//!
//! Positions are floats, or 16-bit steps over the extent of each axis (`KHR_mesh_quantization`). What floats cannot hold of
//! a scan in doubles, its distance from the origin, is in the node's translation, so that what is lost is less than the
//! 16-millionth part of the mesh's own size. Faces of one material are a primitive; textures in PNG and JPEG are within
//! the file. Axes are as the scan has them, though glTF takes y for up.

use super::encode::Contents;
use super::{Clothes, Format, Sink, Texture};
use crate::error::{Error, Result};
use crate::mesh::columns::{Columns, Meaning};
use crate::mesh::{Coordinate, Extent, widen};
use glam::DVec3;
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;

/// What the header and the two chunks' own take.
const HEAD_BYTES: u64 = 12 + 8 + 8;

/// The largest 16-bit step.
const STEPS: f64 = 65_535.0;

/// The most vertices that 16-bit indices name: the largest index is kept for other uses.
const MOST_SHORT: usize = 65_535;

/// How positions become what is stored.
struct Mapping {
    /// Of the node.
    translation: DVec3,
    /// Of the node; 1 for floats.
    scale: DVec3,
    quantised: bool,
}

impl Mapping {
    fn of<S: Coordinate>(extent: &Extent, quantised: bool) -> Mapping {
        if quantised {
            let scale = (extent.size() / STEPS).map(|step| if step > 0.0 { step } else { 1.0 });
            return Mapping { translation: extent.min, scale, quantised };
        }
        let (size, centre) = (extent.size().max_element(), extent.min.midpoint(extent.max));
        let far = S::DOUBLE && centre.abs().max_element() > size;
        // A number of few digits near the centre.
        let unit = (size / 16.0).log2().ceil().exp2();
        let centre = if unit > 0.0 { (centre / unit).round() * unit } else { centre };
        Mapping { translation: if far { centre } else { DVec3::ZERO }, scale: DVec3::ONE, quantised }
    }

    /// A position in the file's units, as floats: those of 16-bit steps are whole.
    #[inline]
    fn stored(&self, p: DVec3) -> [f32; 3] {
        let local = (p - self.translation) / self.scale;
        let local = if self.quantised { local.round().clamp(DVec3::ZERO, DVec3::splat(STEPS)) } else { local };
        local.to_array().map(|x| x as f32)
    }

    fn vertex_bytes(&self) -> u64 {
        if self.quantised { 8 } else { 12 }
    }

    /// What the document says of the node beside its mesh.
    fn node(&self) -> Value {
        let mut node = json!({ "mesh": 0 });
        if self.translation != DVec3::ZERO {
            node["translation"] = json!(self.translation.to_array());
        }
        if self.scale != DVec3::ONE {
            node["scale"] = json!(self.scale.to_array());
        }
        node
    }
}

/// Bytes of the elements, about.
pub(super) fn element_bytes(format: Format, vertices: u64, faces: u64) -> u64 {
    let vertex = if format == Format::GlbQuantised { 8 } else { 12 };
    let index = if vertices <= MOST_SHORT as u64 { 2 } else { 4 };
    vertices * vertex + faces * 3 * index
}

/// Streams the whole file.
pub(super) fn encode<S: Coordinate, W: Write>(
    contents: &Contents<'_, S>,
    format: Format,
    path: &Path,
    sink: &mut Sink<'_, W>,
) -> Result<()> {
    let Contents { mesh, frame, carried, clothes, .. } = *contents;
    let at = |p: [S; 3]| frame.place_back(widen(p));
    let mut extent = Extent::default();
    mesh.positions.iter().for_each(|p| extent.include(at(*p)));
    let mapping = Mapping::of::<S>(&extent, format == Format::GlbQuantised);
    let refuse = |what: &str| Err(Error::Unmet { file: path.into(), what: format!("{what}: write a .ply") });
    let (mut least, mut most) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for p in &mesh.positions {
        let stored = mapping.stored(at(*p));
        if !stored.iter().all(|x| x.is_finite()) {
            return refuse("glTF holds floats, which end at 3.4e38, and this mesh goes beyond");
        }
        for axis in 0..3 {
            least[axis] = least[axis].min(stored[axis]);
            most[axis] = most[axis].max(stored[axis]);
        }
    }
    let (vertices, faces) = (mesh.positions.len(), mesh.faces.len());
    let short = vertices <= MOST_SHORT;
    let position_bytes = vertices as u64 * mapping.vertex_bytes();
    let index_bytes = faces as u64 * if short { 6 } else { 12 };
    let index_room = index_bytes.next_multiple_of(4);
    let shades = Shades::of(carried, mapping.quantised);
    let parts = Parts::of(mesh.faces.len(), clothes);
    let mut attributes = json!({ "POSITION": 0 });
    let mut accessors = vec![json!({
        "bufferView": 0, "componentType": if mapping.quantised { 5123 } else { 5126 }, "type": "VEC3",
        "count": vertices, "min": least.map(f64::from), "max": most.map(f64::from),
    })];
    let index_size = if short { 2 } else { 4 };
    for (_, first, count) in &parts.runs {
        accessors.push(json!({
            "bufferView": 1, "byteOffset": 3 * index_size * first, "componentType": if short { 5123 } else { 5125 },
            "type": "SCALAR", "count": 3 * count,
        }));
    }
    let mut views = vec![
        view(0, position_bytes, 34962, mapping.quantised.then_some(8)),
        view(position_bytes, index_bytes, 34963, None),
    ];
    let mut end = position_bytes + index_room;
    if shades.colour.is_some() {
        attributes["COLOR_0"] = json!(accessors.len());
        accessors.push(json!({
            "bufferView": views.len(), "componentType": 5123, "normalized": true, "type": "VEC4", "count": vertices,
        }));
        views.push(view(end, 8 * vertices as u64, 34962, None));
        end += 8 * vertices as u64;
    }
    if shades.normal.is_some() {
        attributes["NORMAL"] = json!(accessors.len());
        accessors.push(json!({
            "bufferView": views.len(), "componentType": 5126, "type": "VEC3", "count": vertices,
        }));
        views.push(view(end, 12 * vertices as u64, 34962, None));
        end += 12 * vertices as u64;
    }
    if shades.texture.is_some() {
        attributes["TEXCOORD_0"] = json!(accessors.len());
        accessors.push(json!({
            "bufferView": views.len(), "componentType": 5126, "type": "VEC2", "count": vertices,
        }));
        views.push(view(end, 8 * vertices as u64, 34962, None));
        end += 8 * vertices as u64;
    }
    let images = parts.images(clothes, shades.texture.is_some())?;
    let mut image_views = Vec::new();
    for (_, _, bytes) in &images {
        image_views.push(views.len());
        views.push(json!({ "buffer": 0, "byteOffset": end, "byteLength": bytes }));
        end += bytes.next_multiple_of(4);
    }
    let primitives: Vec<Value> = (parts.runs.iter().enumerate())
        .map(|(i, (material, ..))| {
            let mut primitive = json!({ "attributes": attributes, "indices": 1 + i, "mode": 4 });
            if let Some(material) = material {
                primitive["material"] = json!(material);
            }
            primitive
        })
        .collect();
    let mut document = json!({
        "asset": { "version": "2.0", "generator": format!("meshmill {}", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [mapping.node()],
        "meshes": [{ "primitives": primitives }],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": end }],
    });
    if mapping.quantised {
        document["extensionsUsed"] = json!(["KHR_mesh_quantization"]);
        document["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    }
    materials(&mut document, clothes, &images, &image_views);
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let payload = end;
    let length = HEAD_BYTES + text.len() as u64 + payload;
    let Ok(length) = u32::try_from(length) else { return refuse("glTF binary holds 4 GiB, and this mesh takes more") };

    sink.put(b"glTF")?;
    sink.put(&[2u32, length, text.len() as u32, 0x4e4f_534a].map(u32::to_le_bytes).concat())?;
    sink.put(&text)?;
    sink.put(&[payload as u32, 0x004e_4942].map(u32::to_le_bytes).concat())?;
    if mapping.quantised {
        sink.put_each(&mesh.positions, |p| {
            let [x, y, z] = mapping.stored(at(*p)).map(|x| (x as u16).to_le_bytes());
            Ok([x[0], x[1], y[0], y[1], z[0], z[1], 0, 0])
        })?;
    } else {
        sink.put_each(&mesh.positions, |p| Ok(super::ply_vertex(mapping.stored(at(*p)))))?;
    }
    let sorted: Vec<[u32; 3]> = parts.order.iter().map(|f| mesh.faces[*f as usize]).collect();
    let sorted = if parts.order.is_empty() { &mesh.faces } else { &sorted };
    if short {
        sink.put_each(sorted, |face| {
            let [a, b, c] = face.map(|v| (v as u16).to_le_bytes());
            Ok([a[0], a[1], b[0], b[1], c[0], c[1]])
        })?;
    } else {
        sink.put_each(sorted, |face| Ok(bytemuck::cast::<_, [u8; 12]>(face.map(u32::to_le_bytes))))?;
    }
    sink.put(&[0; 4][..(index_room - index_bytes) as usize])?;
    shades.put(carried, vertices, sink)?;
    for ((at, _, bytes), Clothes { wardrobe, .. }) in images.iter().zip(clothes.into_iter().cycle()) {
        put_image(&wardrobe.textures[*at], *bytes, sink)?;
    }
    Ok(())
}

/// Faces of one material together.
struct Parts {
    /// The faces in that order; empty where there is one part.
    order: Vec<u32>,
    /// Material, first face, and how many.
    runs: Vec<(Option<u32>, usize, usize)>,
}

/// The number of a texture, its type and how many bytes it has.
type Image = (usize, &'static str, u64);

impl Parts {
    fn of(faces: usize, clothes: Option<Clothes<'_>>) -> Parts {
        let Some(Clothes { dress, coat, .. }) = clothes.filter(|c| !c.coat.materials.is_empty()) else {
            return Parts { order: Vec::new(), runs: vec![(None, 0, faces)] };
        };
        let material = |f: u32| coat.patches[dress.patches[f as usize] as usize].material;
        let mut order: Vec<u32> = (0..faces as u32).collect();
        order.sort_by_key(|f| material(*f));
        let mut runs: Vec<(Option<u32>, usize, usize)> = Vec::new();
        for (i, f) in order.iter().enumerate() {
            match runs.last_mut().filter(|run| run.0 == material(*f)) {
                Some(run) => run.2 += 1,
                None => runs.push((material(*f), i, 1)),
            }
        }
        Parts { order, runs }
    }

    /// The textures that materials in use have, where vertices have coordinates for them.
    fn images(&self, clothes: Option<Clothes<'_>>, textured: bool) -> Result<Vec<Image>> {
        let mut images: Vec<Image> = Vec::new();
        let Some(Clothes { wardrobe, .. }) = clothes.filter(|_| textured) else { return Ok(images) };
        for material in self.runs.iter().filter_map(|run| wardrobe.materials.get(run.0? as usize)) {
            let Some(at) = material.texture.filter(|at| images.iter().all(|image| image.0 != *at)) else { continue };
            if let Some(mime) = wardrobe.textures[at].mime() {
                images.push((at, mime, wardrobe.textures[at].length()?));
            }
        }
        Ok(images)
    }
}

/// Puts a texture, of which so many bytes were promised.
fn put_image<W: Write>(texture: &Texture, bytes: u64, sink: &mut Sink<'_, W>) -> Result<()> {
    let mut put = 0;
    texture.pieces(&mut |piece, _| {
        put += piece.len() as u64;
        sink.put(&piece[..piece.len() - put.saturating_sub(bytes).min(piece.len() as u64) as usize])
            .map(|()| put < bytes)
    })?;
    if put < bytes {
        let what = format!("had {bytes} bytes a moment ago, but has {put} now");
        return Err(Error::input(Path::new(&texture.name), what));
    }
    sink.put(&[0; 4][..(bytes.next_multiple_of(4) - bytes) as usize])
}

/// What the document says of materials and textures.
fn materials(document: &mut Value, clothes: Option<Clothes<'_>>, images: &[Image], views: &[usize]) {
    let Some(Clothes { wardrobe, .. }) = clothes.filter(|c| !c.wardrobe.materials.is_empty()) else { return };
    let material = |material: &super::Material| {
        let [r, g, b] = material.colour.map(linear);
        let mut pbr = json!({ "baseColorFactor": [r, g, b, material.alpha], "metallicFactor": 0.0 });
        if let Some(texture) = images.iter().position(|image| Some(image.0) == material.texture) {
            pbr["baseColorTexture"] = json!({ "index": texture });
        }
        let mut found = json!({ "name": material.name, "pbrMetallicRoughness": pbr, "doubleSided": true });
        if material.alpha < 1.0 {
            found["alphaMode"] = json!("BLEND");
        }
        found
    };
    document["materials"] = wardrobe.materials.iter().map(material).collect();
    if !images.is_empty() {
        let image = |((at, mime, _), view): (&Image, &usize)| json!({ "name": wardrobe.textures[*at].file_name(), "bufferView": view, "mimeType": mime });
        document["images"] = images.iter().zip(views).map(image).collect();
        document["samplers"] = json!([{ "magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497 }]);
        document["textures"] = (0..images.len()).map(|i| json!({ "source": i, "sampler": 0 })).collect();
    }
}

/// The columns that glTF has a place for.
struct Shades {
    colour: Option<[usize; 3]>,
    alpha: Option<usize>,
    normal: Option<[usize; 3]>,
    texture: Option<[usize; 2]>,
}

impl Shades {
    fn of(carried: &Columns, quantised: bool) -> Shades {
        // A node that stretches its axes differently would bend normals.
        let normal = if quantised { None } else { carried.find(Meaning::Normal) };
        let alpha = carried.find::<1>(|_| Meaning::Colour(3)).map(|[at]| at);
        Shades { colour: carried.find(Meaning::Colour), alpha, normal, texture: carried.find(Meaning::Texture) }
    }

    fn put<W: Write>(&self, carried: &Columns, vertices: usize, sink: &mut Sink<'_, W>) -> Result<()> {
        let mut record = Vec::with_capacity(12);
        for v in (0..vertices).take_while(|_| self.colour.is_some()) {
            record.clear();
            let share = |c: usize| carried.columns[c].brightness(carried.of(v)[c]);
            // Scans have colours as screens show them, glTF as light adds up.
            let parts = self.colour.into_iter().flatten().map(|c| linear(share(c)));
            parts
                .chain([self.alpha.map_or(1.0, share)])
                .for_each(|x| record.extend(((x * STEPS).round() as u16).to_le_bytes()));
            sink.put(&record)?;
        }
        for v in (0..vertices).take_while(|_| self.normal.is_some()) {
            record.clear();
            self.normal.into_iter().flatten().for_each(|c| record.extend((carried.of(v)[c] as f32).to_le_bytes()));
            sink.put(&record)?;
        }
        for (v, [s, t]) in (0..vertices).flat_map(|v| self.texture.map(|at| (v, at))) {
            record.clear();
            // Pictures begin at the top here, at the bottom there.
            let [s, t] = [carried.of(v)[s], 1.0 - carried.of(v)[t]].map(|x| (x as f32).to_le_bytes());
            sink.put(&[s, t].concat())?;
        }
        Ok(())
    }
}

/// The light of a colour's part (sRGB).
fn linear(share: f64) -> f64 {
    if share <= 0.04045 { share / 12.92 } else { ((share + 0.055) / 1.055).powf(2.4) }
}

fn view(offset: u64, length: u64, target: u32, stride: Option<u32>) -> Value {
    let mut view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": length, "target": target });
    if let Some(stride) = stride {
        view["byteStride"] = json!(stride);
    }
    view
}
