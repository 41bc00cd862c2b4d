//! Samples of what the result stands for, and the faces that they are nearest to.

use super::NONE;
use super::around::Around;
use super::ground::{Ground, Place};
use crate::cores::InPieces;
use crate::mesh::groups::Groups;
use crate::mesh::{Coordinate, IndexedMesh, Reference, SurfaceSamples, narrow, step, widen};
use fearless_simd::{Level, Simd, dispatch};
use glam::Vec3;
use rayon::prelude::*;

/// Points of a face of the reference, by barycentric coordinates: exact for squared distances to a plane. At ten times
/// the target that is 30 to a face of the result; its centroid alone loses 4 % of E_avg.
pub(super) const POINTS: [[f32; 3]; 3] = [[A, B, B], [B, A, B], [B, B, A]];
const A: f32 = 2.0 / 3.0;
const B: f32 = 1.0 / 6.0;

/// What the result is fitted to: points of the surface.
pub(super) trait Evidence<S>: Sync {
    /// How many there are.
    fn count(&self) -> usize;
    /// A point.
    fn point(&self, k: u32) -> Point<S>;
    /// The vertex of the result that a point was near to before anything moved.
    fn near(&self, k: u32) -> Option<u32>;
    /// The place on the finer mesh that is nearest to a point of the result, one of whose faces has point `k`.
    fn back(&self, fine: Ground<S>, at: [S; 3], normal: Vec3, k: u32) -> Option<Place>;
}

impl<S: Coordinate> Evidence<S> for Reference<S> {
    fn count(&self) -> usize {
        3 * self.mesh.faces.len()
    }

    #[inline(always)]
    fn point(&self, k: u32) -> Point<S> {
        Point::on(&self.mesh, k as usize / 3, POINTS[k as usize % 3])
    }

    #[inline(always)]
    fn near(&self, k: u32) -> Option<u32> {
        let homes = self.mesh.faces[k as usize / 3].map(|v| self.homes[v as usize]);
        (k..k + 3).map(|i| homes[i as usize % 3]).find(|&home| home != NONE)
    }

    fn back(&self, fine: Ground<S>, at: [S; 3], normal: Vec3, k: u32) -> Option<Place> {
        fine.near_face(at, normal, k / 3)
    }
}

/// Points of the scan itself.
pub(super) struct Scanned<'a> {
    samples: &'a SurfaceSamples,
    /// For each vertex of the result one of the finer mesh that has become it, where there is a finer mesh.
    origins: Vec<u32>,
}

impl<'a> Scanned<'a> {
    /// Samples of a scan that a mesh of so many vertices was reduced from, by way of `reference`.
    pub fn new<S>(samples: &'a SurfaceSamples, vertices: usize, reference: Option<&Reference<S>>) -> Self {
        let mut origins = Vec::new();
        if let Some(reference) = reference {
            origins.resize(vertices, NONE);
            for (v, &home) in reference.homes.iter().enumerate().filter(|(_, home)| **home != NONE) {
                origins[home as usize] = v as u32;
            }
        }
        Scanned { samples, origins }
    }
}

impl<S: Coordinate> Evidence<S> for Scanned<'_> {
    fn count(&self) -> usize {
        self.samples.samples.len()
    }

    #[inline(always)]
    fn point(&self, k: u32) -> Point<S> {
        let sample = &self.samples.samples[k as usize];
        // As heavy as three points a face would make it.
        let weight = (SIXFOLD * self.samples.area) as f32;
        Point { at: self.samples.lattice.position(sample), normal: sample.direction(), weight }
    }

    #[inline(always)]
    fn near(&self, k: u32) -> Option<u32> {
        Some(self.samples.samples[k as usize].near)
    }

    fn back(&self, fine: Ground<S>, at: [S; 3], normal: Vec3, k: u32) -> Option<Place> {
        let origin = *self.origins.get(self.samples.samples[k as usize].near as usize)?;
        (origin != NONE).then(|| fine.near_vertex(at, normal, origin)).flatten()
    }
}

/// A face's three points are each as heavy as twice its area.
const SIXFOLD: f64 = 6.0;

/// A point on a face, and what it stands for.
pub(super) struct Point<S> {
    pub at: [S; 3],
    /// The direction of its face's normal; of any length.
    pub normal: Vec3,
    /// Twice the area of its face.
    pub weight: f32,
}

impl<S: Coordinate> Point<S> {
    #[inline(always)]
    pub fn on(mesh: &IndexedMesh<S>, face: usize, weights: [f32; 3]) -> Self {
        let [a, b, c] = mesh.faces[face].map(|v| mesh.positions[v as usize]);
        let (ab, ac) = (step(a, b), step(a, c));
        let along = ab * weights[1] + ac * weights[2];
        let normal = ab.cross(ac);
        Point { at: narrow(widen(a) + along.as_dvec3()), normal, weight: normal.length() }
    }
}

/// For every sample the face that it is nearest to, and for every face its samples. 8 bytes a sample, 4 a face.
#[derive(Default)]
pub(super) struct Samples {
    /// By sample; [`NONE`] where all around looks the other way or has vanished.
    faces: Vec<u32>,
    /// By face, in order.
    of_faces: Groups,
}

/// Samples that are looked up by one task.
const TOGETHER: usize = 4096;

/// The faces that samples from `first` on are nearest to, from where their vertices have gone.
#[inline(always)]
fn find<S: Coordinate, V: Simd>(
    simd: V,
    ground: Ground<S>,
    evidence: &impl Evidence<S>,
    first: u32,
    faces: &mut [u32],
) {
    let mut around = Around::new(simd);
    for (k, face) in (first..).zip(faces) {
        let point = evidence.point(k);
        let near = evidence.near(k).and_then(|v| around.near(ground, point.at, point.normal, v));
        *face = near.unwrap_or(NONE);
    }
}

impl Samples {
    /// Looks up every sample's nearest face: from where its vertex has gone at first, then from the face it had.
    pub fn assign<S: Coordinate>(&mut self, ground: Ground<S>, evidence: &impl Evidence<S>) {
        if self.faces.is_empty() {
            self.faces = bytemuck::zeroed_vec(evidence.count());
            self.faces.par_chunks_mut(TOGETHER).enumerate().in_pieces(1).for_each(|(chunk, faces)| {
                let first = (chunk * TOGETHER) as u32;
                dispatch!(Level::new(), simd => find(simd, ground, evidence, first, faces));
            });
        } else {
            self.faces.par_iter_mut().enumerate().in_pieces(512).filter(|(_, face)| **face != NONE).for_each(
                |(k, face)| {
                    let point = evidence.point(k as u32);
                    *face = ground.near_face(point.at, point.normal, *face).map_or(NONE, |place| place.face);
                },
            );
        }
        let faces = &self.faces;
        self.of_faces.rebuild(ground.mesh.faces.len(), faces.len(), |range| {
            faces[range.clone()].iter().copied().zip(range.start as u32..)
        });
    }

    /// The samples that are nearest to a face.
    #[inline(always)]
    pub fn of(&self, face: usize) -> &[u32] {
        self.of_faces.of(face)
    }
}
