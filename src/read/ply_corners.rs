//! What corners and faces of a PLY carry: texture coordinates of vertices or of corners, labels and colours of faces.

use super::FaceStep;
use super::ascii::Ascii;
use super::cursor::Cursor;
use super::map::Input;
use super::ply::Ply;
use super::ply_binary::Binary;
use super::ply_records::{LabelledStep, Records, Row, Values};
use crate::error::Result;
use crate::mesh::coat::{Bytes, Coat, Corners, Look, NOTHING, Patch, Picture};
use crate::mesh::columns::Column;
use crate::progress::Progress;
use ply_rs::ply::Encoding;
use rustc_hash::FxHashMap;
use std::path::Path;

/// More patches than this share of the faces are no labels, but noise: there would be nothing but borders between them.
const MOST_PATCHES: u64 = 20;

/// So many different ones are no labels either, whatever the scan: they would take more memory than it does.
const MOST_LABELS: usize = 1 << 16;

impl Ply {
    /// Whether there is anything that corners or faces carry.
    pub fn is_coated(&self) -> bool {
        self.vertex.texture().is_some() || self.face.corner_texture().is_some() || !self.face.labels().is_empty()
    }

    /// Texture coordinates, at most.
    pub fn coat_values(&self) -> u64 {
        if self.face.corner_texture().is_some() { 3 * self.triangles } else { 0 }
    }

    /// Values and labels.
    pub fn coat(&self, input: &Input, progress: &Progress) -> Result<Coat> {
        let mut coat = Coat { face_columns: self.labelled().into_iter().map(|(_, c)| c).collect(), ..Coat::default() };
        if self.face.corner_texture().is_none() && self.vertex.texture().is_some() {
            coat.uvs = self.vertex_uvs(input, progress)?;
        }
        let of_corners = self.face.corner_texture().is_some();
        let mut labels = Labels::default();
        self.faces(input, progress, &self.labels(), &mut |corners, values, uvs| {
            if of_corners {
                let uv = |i: usize| uvs.get(2 * i..2 * i + 2).map_or([f32::NAN; 2], |uv| [uv[0] as f32, uv[1] as f32]);
                coat.uvs.extend((0..corners.len()).map(uv));
            }
            labels.number(values);
        })?;
        coat.patches = labels.into_patches(self.triangles, &mut coat.face_columns);
        self.wear(&mut coat, input);
        Ok(coat)
    }

    fn vertex_uvs(&self, input: &Input, progress: &Progress) -> Result<Vec<[f32; 2]>> {
        let Some(at) = self.vertex.texture() else { return Ok(Vec::new()) };
        let mut wanted = at;
        wanted.sort_unstable();
        let mut uvs = Vec::with_capacity(self.vertex.count.min(input.len()) as usize);
        let cursor = Cursor::new(input, progress, self.vertex_offset);
        let mut take = |rows: &mut Vec<Row>| {
            let uv = |row: &Row| {
                let [a, b] = [row[3] as f32, row[4] as f32];
                if at == wanted { [a, b] } else { [b, a] }
            };
            uvs.extend(rows.iter().map(uv));
            rows.clear();
        };
        match self.encoding {
            Encoding::Ascii => {
                self.rows(Records::<Ascii<'_>>::new(input.path(), &self.vertex, cursor, 0), &wanted, &mut take)
            }
            Encoding::BinaryBigEndian => {
                self.rows(Records::<Binary<'_, true>>::new(input.path(), &self.vertex, cursor, 0), &wanted, &mut take)
            }
            Encoding::BinaryLittleEndian => {
                self.rows(Records::<Binary<'_, false>>::new(input.path(), &self.vertex, cursor, 0), &wanted, &mut take)
            }
        }?;
        Ok(uvs)
    }

    fn rows<'a, V: Values<'a>>(
        &self,
        mut records: Records<'a, V>,
        wanted: &[usize],
        take: &mut dyn FnMut(&mut Vec<Row>),
    ) -> Result<()> {
        let mut rows = Vec::new();
        loop {
            records.rows(wanted, 1024, &mut rows)?;
            if rows.is_empty() {
                return Ok(());
            }
            take(&mut rows);
        }
    }

    /// What tells faces apart: which texture they have where there are several, else all whole numbers.
    fn labelled(&self) -> Vec<(usize, Column)> {
        let number = self.face.texture_number().filter(|_| self.textures.len() > 1);
        number.map_or_else(|| self.face.labels(), |number| vec![number])
    }

    fn labels(&self) -> Vec<usize> {
        self.labelled().into_iter().map(|(i, _)| i).collect()
    }

    /// A material for each texture that the header names.
    fn wear(&self, coat: &mut Coat, input: &Input) {
        if self.textures.is_empty() || coat.uvs.is_empty() {
            return;
        }
        let folder = input.path().parent().unwrap_or(Path::new(""));
        for name in &self.textures {
            let path = folder.join(name.replace('\\', "/"));
            let is_there = path.is_file();
            if is_there {
                coat.pictures.push(Picture { name: name.clone(), place: Bytes::File(path) });
            } else {
                coat.lost.push(name.clone());
            }
            let picture = is_there.then(|| coat.pictures.len() - 1);
            coat.materials.push(format!("texture_{}", coat.materials.len()));
            coat.looks.push(Look { picture, ..Look::default() });
        }
        let numbered = self.face.texture_number().is_some() && self.textures.len() > 1;
        for patch in &mut coat.patches {
            let number = patch.labels.first().map_or(0.0, |bits| f64::from_bits(*bits));
            let material = if numbered { number } else { 0.0 };
            let is = material >= 0.0 && material < self.textures.len() as f64;
            patch.material = is.then_some(material as u32);
        }
    }

    /// Goes through the numbers of faces, with how many triangles each is.
    pub fn face_values(&self, input: &Input, progress: &Progress, each: &mut FaceStep<'_>) -> Result<()> {
        let wanted: Vec<usize> = self.face.columns().into_iter().map(|(i, _)| i).collect();
        self.faces(input, progress, &wanted, &mut |corners, values, _| {
            each(corners.len().saturating_sub(2), values);
        })
    }

    fn faces(&self, input: &Input, progress: &Progress, wanted: &[usize], each: &mut LabelledStep<'_>) -> Result<()> {
        let list = self.face.corner_texture();
        let (path, vertices, face) = (input.path(), self.vertex.count, &self.face);
        let cursor = Cursor::new(input, progress, self.face_offset);
        match self.encoding {
            Encoding::Ascii => Records::<Ascii<'_>>::new(path, face, cursor, vertices).labelled(wanted, list, each),
            Encoding::BinaryBigEndian => {
                Records::<Binary<'_, true>>::new(path, face, cursor, vertices).labelled(wanted, list, each)
            }
            Encoding::BinaryLittleEndian => {
                Records::<Binary<'_, false>>::new(path, face, cursor, vertices).labelled(wanted, list, each)
            }
        }
    }

    /// Triangles, in the order of the file.
    pub fn corners(
        &self,
        coat: &Coat,
        input: &Input,
        progress: &Progress,
        step: &mut dyn FnMut(Corners),
    ) -> Result<()> {
        let of_corners = self.face.corner_texture().is_some();
        let of_vertices = !of_corners && !coat.uvs.is_empty();
        let labelled = !coat.face_columns.is_empty();
        let (mut labels, mut first) = (Labels::default(), 0u32);
        self.faces(input, progress, &self.labels(), &mut |corners, values, _| {
            let patch = if labelled { labels.number(values) } else { 0 };
            for i in 2..corners.len() {
                let sides = [0, i - 1, i];
                let vertices = sides.map(|side| corners[side]);
                let uvs = if of_corners { sides.map(|side| first + side as u32) } else { vertices };
                let uvs = if of_corners || of_vertices { uvs } else { [NOTHING; 3] };
                step(Corners { vertices, uvs, normals: [NOTHING; 3], patch });
            }
            first = first.wrapping_add(corners.len() as u32);
        })
    }
}

/// Labels that faces have, numbered as they come.
#[derive(Default)]
pub(super) struct Labels {
    numbers: FxHashMap<Vec<u64>, u32>,
    list: Vec<Vec<u64>>,
    /// More came than anybody would call labels.
    is_full: bool,
}

impl Labels {
    /// The patches of a scan of so many triangles; none that differ where there are too many to be labels.
    pub fn into_patches(self, triangles: u64, columns: &mut Vec<Column>) -> Vec<Patch> {
        let mut list = self.list;
        if self.is_full || list.len() as u64 > 1 + triangles / MOST_PATCHES {
            columns.clear();
            list = vec![Vec::new()];
        }
        list.into_iter().map(|labels| Patch { labels, ..Patch::default() }).collect()
    }

    pub fn number(&mut self, values: &[f64]) -> u32 {
        let bits: Vec<u64> = values.iter().map(|x| x.to_bits()).collect();
        match self.numbers.get(&bits) {
            Some(number) => *number,
            None if self.list.len() == MOST_LABELS => {
                self.is_full = true;
                0
            }
            None => {
                self.list.push(bits.clone());
                self.numbers.insert(bits, self.list.len() as u32 - 1);
                self.list.len() as u32 - 1
            }
        }
    }
}
