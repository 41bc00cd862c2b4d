//! What a file carries beside positions and faces.

use serde::Serialize;

/// What an attribute belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Carrier {
    /// A vertex.
    Vertex,
    /// A face.
    Face,
    /// A corner of a face: what lies at a vertex may differ from face to face.
    Corner,
}

/// A property by the file's own name and type.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Attribute {
    /// What it belongs to.
    pub carrier: Carrier,
    /// As the file calls it.
    pub name: String,
    /// As the file calls it: `uchar`, `float`, `list uchar float`, `VEC4 float`.
    pub kind: String,
}

impl Attribute {
    pub(super) fn of(carrier: Carrier, name: impl Into<String>, kind: impl Into<String>) -> Self {
        Attribute { carrier, name: name.into(), kind: kind.into() }
    }
}
