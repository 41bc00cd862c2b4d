//! What a surface has beside its shape: numbers at the corners of faces, materials, groups.

use super::columns::{Column, Columns, Number};

/// What faces belong to.
#[derive(Debug, Clone, Default, PartialEq, Eq, Hash)]
pub struct Patch {
    /// The number of its material.
    pub material: Option<u32>,
    /// The number of its group.
    pub group: Option<u32>,
    /// What else its faces carry, one number of each of [`Coat::face_columns`], as bits of doubles.
    pub labels: Vec<u64>,
}

/// Names and values that corners and faces refer to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Coat {
    /// Texture coordinates.
    pub uvs: Vec<[f32; 2]>,
    /// Normals.
    pub normals: Vec<[f32; 3]>,
    /// What faces belong to.
    pub patches: Vec<Patch>,
    /// Names of materials.
    pub materials: Vec<String>,
    /// Names of groups; of objects with `o ` before them.
    pub groups: Vec<String>,
    /// Files that materials are in, as they are named.
    pub libraries: Vec<String>,
    /// Numbers of faces.
    pub face_columns: Vec<Column>,
}

/// Whether what faces carry is one number that fits the two bytes that STL has for each.
pub fn is_spare(of_faces: &[Column]) -> bool {
    matches!(of_faces, [c] if matches!(c.number, Number::U8 | Number::U16))
}

/// A mesh's coat: its vertices split where they lie on seams.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Dress {
    /// The vertex of each wedge.
    pub vertices: Vec<u32>,
    /// The wedges at the corners of each face.
    pub corners: Vec<[u32; 3]>,
    /// Numbers of wedges.
    pub columns: Columns,
    /// The patch of each face, as [`Coat::patches`] has them.
    pub patches: Vec<u32>,
}

impl Dress {
    /// Whether vertices are split: where they carry nothing there is no reason to, and a soup has no vertices.
    pub fn splits(&self, soup: bool) -> bool {
        !soup && !self.columns.columns.is_empty()
    }
}

/// No texture coordinates, no normal.
pub const NOTHING: u32 = u32::MAX;

/// A triangle and what its corners carry: numbers in the lists of a [`Coat`], or [`NOTHING`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Corners {
    /// Vertices of the file.
    pub vertices: [u32; 3],
    /// Texture coordinates.
    pub uvs: [u32; 3],
    /// Normals.
    pub normals: [u32; 3],
    /// What the triangle belongs to.
    pub patch: u32,
}
