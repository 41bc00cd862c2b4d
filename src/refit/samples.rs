//! Samples of the reference, and the faces that they are nearest to.

use super::NONE;
use super::ground::Ground;
use crate::mesh::{Coordinate, IndexedMesh, Reference, narrow, step, widen};
use glam::Vec3;
use rayon::prelude::*;

/// Points of a face of the reference, by barycentric coordinates: exact for squared distances to a plane. At ten times the
/// target that is 30 to a face of the result; its centroid alone loses 4 % of E_avg.
pub(super) const POINTS: [[f32; 3]; 3] = [[A, B, B], [B, A, B], [B, B, A]];
const A: f32 = 2.0 / 3.0;
const B: f32 = 1.0 / 6.0;

/// A point on a face, and what it stands for.
pub(super) struct Point<S> {
    pub at: [S; 3],
    /// Twice the area times the unit normal of its face.
    pub normal: Vec3,
}

impl<S: Coordinate> Point<S> {
    #[inline(always)]
    pub fn on(mesh: &IndexedMesh<S>, face: usize, weights: [f32; 3]) -> Self {
        let [a, b, c] = mesh.faces[face].map(|v| mesh.positions[v as usize]);
        let (ab, ac) = (step(a, b), step(a, c));
        let along = ab * weights[1] + ac * weights[2];
        Point { at: narrow(widen(a) + along.as_dvec3()), normal: ab.cross(ac) }
    }
}

/// For every sample the face that it is nearest to, and for every face its samples. 8 bytes a sample, 4 a face.
#[derive(Default)]
pub(super) struct Samples {
    /// By sample, which is three times the face of the reference and which of its points; [`NONE`] where all around looks the
    /// other way or has vanished.
    faces: Vec<u32>,
    /// `order[first[f]..first[f + 1]]` are the samples of face `f`.
    first: Vec<u32>,
    order: Vec<u32>,
}

impl Samples {
    /// A sample's place on the reference.
    #[inline(always)]
    pub fn point<S: Coordinate>(reference: &Reference<S>, sample: u32) -> Point<S> {
        Point::on(&reference.mesh, sample as usize / 3, POINTS[sample as usize % 3])
    }

    /// Looks up every sample's nearest face: from where its vertex has gone at first, then from the face it had.
    pub fn assign<S: Coordinate>(&mut self, ground: Ground<S>, reference: &Reference<S>) {
        let at_first = self.faces.is_empty();
        self.faces.resize(3 * reference.mesh.faces.len(), NONE);
        self.faces.par_iter_mut().enumerate().with_min_len(1024).for_each(|(k, face)| {
            let point = Samples::point(reference, k as u32);
            let place = if at_first {
                let homes = reference.mesh.faces[k / 3].map(|v| reference.homes[v as usize]);
                let home = [homes[k % 3], homes[(k + 1) % 3], homes[(k + 2) % 3]].into_iter().find(|&h| h != NONE);
                home.and_then(|v| ground.near_vertex(point.at, point.normal, v))
            } else {
                (*face != NONE).then(|| ground.near_face(point.at, point.normal, *face)).flatten()
            };
            *face = place.map_or(NONE, |place| place.face);
        });
        self.sort(ground.mesh.faces.len());
    }

    fn sort(&mut self, faces: usize) {
        self.first.clear();
        self.first.resize(faces + 1, 0);
        let assigned = || self.faces.iter().enumerate().filter(|(_, f)| **f != NONE);
        for (_, &f) in assigned() {
            self.first[f as usize] += 1;
        }
        let mut end = 0;
        for first in &mut self.first {
            end += *first;
            *first = end;
        }
        self.order.clear();
        self.order.resize(end as usize, 0);
        // From the last sample to the first, so that the ends become the beginnings.
        for (k, &f) in assigned().rev() {
            self.first[f as usize] -= 1;
            self.order[self.first[f as usize] as usize] = k as u32;
        }
    }

    /// The samples that are nearest to a face.
    #[inline(always)]
    pub fn of(&self, face: usize) -> &[u32] {
        &self.order[self.first[face] as usize..self.first[face + 1] as usize]
    }
}
