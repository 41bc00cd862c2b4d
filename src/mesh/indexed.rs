//! An indexed triangle mesh.

use super::Coordinate;
use glam::{DVec3, Vec3};

/// Positions and triangles. What a stage takes from the one before it and gives to the one after.
///
/// Invariant: every index is below `positions.len()`, and no face repeats a vertex.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct IndexedMesh<S> {
    /// One position a vertex, in the frame.
    pub positions: Vec<[S; 3]>,
    /// Three vertices a face, counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
}

impl<S: Coordinate> IndexedMesh<S> {
    /// The position of vertex `v` in double precision.
    #[inline(always)]
    pub fn at(&self, v: u32) -> DVec3 {
        widen(self.positions[v as usize])
    }
}

/// A stored position in double precision.
#[inline(always)]
pub fn widen<S: Coordinate>(p: [S; 3]) -> DVec3 {
    DVec3::new(p[0].widen(), p[1].widen(), p[2].widen())
}

/// A position as it is stored.
#[inline(always)]
pub fn narrow<S: Coordinate>(p: DVec3) -> [S; 3] {
    [S::narrow(p.x), S::narrow(p.y), S::narrow(p.z)]
}

/// From one stored position to another, in single precision.
#[inline(always)]
pub fn step<S: Coordinate>(from: [S; 3], to: [S; 3]) -> Vec3 {
    Vec3::new(to[0].minus(from[0]), to[1].minus(from[1]), to[2].minus(from[2]))
}
