//! An indexed triangle mesh.

use super::Coordinate;
use crate::cores::InPieces;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

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

/// New numbers for those of `vertices` vertices that faces use, in their order and without gaps, [`u32::MAX`] for the others;
/// and how many are used.
pub(crate) fn number_used(faces: &[[u32; 3]], vertices: usize) -> (Vec<u32>, usize) {
    let used: Vec<AtomicU32> =
        (0..vertices).into_par_iter().in_pieces(4096).map(|_| AtomicU32::new(u32::MAX)).collect();
    let mark = |face: &[u32; 3]| face.iter().for_each(|v| used[*v as usize].store(0, Relaxed));
    faces.par_iter().in_pieces(4096).for_each(mark);
    let mut numbers: Vec<u32> = used.into_iter().map(AtomicU32::into_inner).collect();
    let mut next = 0;
    for number in numbers.iter_mut().filter(|number| **number == 0) {
        *number = next;
        next += 1;
    }
    (numbers, next as usize)
}

/// Gives the corners of faces such numbers.
pub(crate) fn renumber(faces: &mut [[u32; 3]], numbers: &[u32]) {
    faces.par_iter_mut().in_pieces(4096).for_each(|face| *face = face.map(|v| numbers[v as usize]));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_faces_use_is_numbered_without_gaps() {
        let mut faces = vec![[7, 2, 4], [2, 7, 9]];
        let (numbers, used) = number_used(&faces, 11);
        const NONE: u32 = u32::MAX;
        assert_eq!((numbers.as_slice(), used), ([NONE, NONE, 0, NONE, 1, NONE, NONE, 2, NONE, 3, NONE].as_slice(), 4));
        renumber(&mut faces, &numbers);
        assert_eq!(faces, [[2, 0, 1], [0, 2, 3]]);
    }
}
