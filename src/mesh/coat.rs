//! What a surface has beside its shape: numbers at the corners of faces, materials, groups.

use super::columns::{Column, Columns, Number};
use std::fs::File;
use std::path::PathBuf;
use std::sync::Arc;

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

/// What a material looks like.
#[derive(Debug, Clone, PartialEq)]
pub struct Look {
    /// Its colour, as screens show it.
    pub colour: [f64; 3],
    /// How opaque it is.
    pub alpha: f64,
    /// The number of its texture.
    pub picture: Option<usize>,
}

impl Default for Look {
    fn default() -> Self {
        Look { colour: [1.0; 3], alpha: 1.0, picture: None }
    }
}

/// A texture.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// The name of its file, or one that is good for a file.
    pub name: String,
    /// Where its bytes are.
    pub place: Bytes,
}

/// Where some bytes are.
#[derive(Debug, Clone)]
pub enum Bytes {
    /// All of a file.
    File(PathBuf),
    /// A part of one that is open.
    Part {
        /// The file.
        file: Arc<File>,
        /// Where they begin.
        offset: u64,
        /// How many they are.
        length: u64,
    },
}

impl PartialEq for Bytes {
    fn eq(&self, other: &Bytes) -> bool {
        match (self, other) {
            (Bytes::File(a), Bytes::File(b)) => a == b,
            (Bytes::Part { file: a, offset: i, length: m }, Bytes::Part { file: b, offset: j, length: n }) => {
                Arc::ptr_eq(a, b) && (i, m) == (j, n)
            }
            _ => false,
        }
    }
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
    /// What materials look like: none, where `libraries` say it, or one for each.
    pub looks: Vec<Look>,
    /// Textures that `looks` have.
    pub pictures: Vec<Picture>,
    /// Textures that are named and cannot be had.
    pub lost: Vec<String>,
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
