//! The nearest place on a mesh, found by walking over it from a face that is known to be near.

use crate::mesh::adjacency::{Stars, parts};
use crate::mesh::triangle::distance_sq;
use crate::mesh::{Coordinate, IndexedMesh, step, widen};
use glam::Vec3;

/// A mesh that can be walked over.
#[derive(Clone, Copy)]
pub(super) struct Ground<'a, S> {
    pub mesh: &'a IndexedMesh<S>,
    pub stars: &'a Stars,
}

/// A place on a face.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub face: u32,
    /// Barycentric coordinates; exactly zero at the corners that the place is not near to.
    pub weights: [f32; 3],
    /// From the point to the place.
    pub step: Vec3,
    pub distance_sq: f32,
}

/// Most faces that one search steps to. Searches that begin near need two or three.
const LONGEST_WALK: usize = 64;

/// Differences of distances below this share of a face's side are rounding.
pub(super) const ROUNDING: f32 = 4e-6;

/// Gains that differ from [`ROUNDING`] by less than this share of it are worked out in doubles: singles are that far off.
const UNSURE: f32 = 0.1;

impl<S: Coordinate> Ground<'_, S> {
    /// Twice the area times the unit normal of a face.
    #[inline(always)]
    pub fn normal(&self, face: u32) -> Vec3 {
        self.normal_of(self.mesh.faces[face as usize])
    }

    /// The same of a triangle of vertices.
    #[inline(always)]
    pub fn normal_of(&self, corners: [u32; 3]) -> Vec3 {
        let [a, b, c] = corners.map(|v| self.mesh.positions[v as usize]);
        step(a, b).cross(step(a, c))
    }

    /// The place on one face that is nearest to `point`.
    #[inline(always)]
    pub fn on_face(&self, point: [S; 3], face: u32) -> Place {
        let corners = self.mesh.faces[face as usize].map(|v| step(point, self.mesh.positions[v as usize]));
        let weights = nearest_to_origin(corners);
        let step = corners[0] * weights[0] + corners[1] * weights[1] + corners[2] * weights[2];
        Place { face, weights, step, distance_sq: step.length_squared() }
    }

    /// The nearest place around a vertex, on a face that looks the same way as `normal`.
    pub fn near_vertex(&self, point: [S; 3], normal: Vec3, v: u32) -> Option<Place> {
        let mut best = None;
        self.improve(&mut best, point, normal, self.stars.of(v).iter().map(|&c| parts(c).0 as u32));
        Some(self.walk(best?, point, normal))
    }

    /// The nearest place on the way down from a face, among faces that look the same way as `normal`.
    pub fn near_face(&self, point: [S; 3], normal: Vec3, face: u32) -> Option<Place> {
        if self.normal(face).dot(normal) > 0.0 {
            return Some(self.walk(self.on_face(point, face), point, normal));
        }
        let mut best = None;
        for v in self.mesh.faces[face as usize] {
            self.improve(&mut best, point, normal, self.stars.of(v).iter().map(|&c| parts(c).0 as u32));
        }
        Some(self.walk(best?, point, normal))
    }

    /// Steps across the edge or the corner that the place is on, as long as that is nearer.
    pub fn walk(&self, mut place: Place, point: [S; 3], normal: Vec3) -> Place {
        for _ in 0..LONGEST_WALK {
            let face = self.mesh.faces[place.face as usize];
            let on = |i: usize| place.weights[i] != 0.0;
            let before = place.face;
            let mut best = Some(place);
            match (on(0), on(1), on(2)) {
                (true, true, true) => return place,
                (true, true, false) => self.across(&mut best, point, normal, face[0], face[1]),
                (false, true, true) => self.across(&mut best, point, normal, face[1], face[2]),
                (true, false, true) => self.across(&mut best, point, normal, face[2], face[0]),
                (a, b, _) => {
                    let v = face[if a {
                        0
                    } else if b {
                        1
                    } else {
                        2
                    }];
                    self.improve(&mut best, point, normal, self.stars.of(v).iter().map(|&c| parts(c).0 as u32));
                }
            }
            place = best.unwrap_or(place);
            if place.face == before {
                return place;
            }
        }
        place
    }

    fn across(&self, best: &mut Option<Place>, point: [S; 3], normal: Vec3, u: u32, v: u32) {
        let faces = self.stars.of(u).iter().map(|&c| parts(c).0 as u32);
        self.improve(best, point, normal, faces.filter(|&f| self.mesh.faces[f as usize].contains(&v)));
    }

    /// Whether a place is nearer than another by more than rounding. What is nearest to an edge is as near to both its
    /// faces: the last bit must not choose between them, or a scan moved to where doubles round otherwise would be
    /// refitted otherwise. Where single precision cannot tell, doubles are asked.
    #[inline(always)]
    fn is_nearer(&self, point: [S; 3], place: Place, best: Place) -> bool {
        place.distance_sq < best.distance_sq && {
            let [a, b, c] = self.mesh.faces[best.face as usize].map(|v| self.mesh.positions[v as usize]);
            let long = step(a, b).abs().max(step(a, c).abs()).max_element();
            let least = ROUNDING * long;
            let distance = best.distance_sq.sqrt() - least;
            let gain = if S::DOUBLE { distance - place.distance_sq.sqrt() } else { f32::INFINITY };
            match gain.abs() < UNSURE * least {
                true => self.exact(point, best.face) - self.exact(point, place.face) > f64::from(least),
                false => distance > 0.0 && place.distance_sq < distance * distance,
            }
        }
    }

    /// The distance from a point to a face, in double precision.
    #[cold]
    fn exact(&self, point: [S; 3], face: u32) -> f64 {
        distance_sq(widen(point), self.mesh.faces[face as usize].map(|v| self.mesh.at(v))).sqrt()
    }

    #[inline(always)]
    fn improve(&self, best: &mut Option<Place>, point: [S; 3], normal: Vec3, faces: impl Iterator<Item = u32>) {
        for face in faces {
            let place = self.on_face(point, face);
            if best.is_none_or(|b| self.is_nearer(point, place, b)) && self.normal(face).dot(normal) > 0.0 {
                *best = Some(place);
            }
        }
    }
}

/// Barycentric coordinates of the point of a triangle that is nearest to the origin.
#[inline(always)]
pub(super) fn nearest_to_origin([a, b, c]: [Vec3; 3]) -> [f32; 3] {
    let (ab, ac) = (b - a, c - a);
    let (d1, d2) = (-ab.dot(a), -ac.dot(a));
    if d1 <= 0.0 && d2 <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let (d3, d4) = (-ab.dot(b), -ac.dot(b));
    if d3 >= 0.0 && d4 <= d3 {
        return [0.0, 1.0, 0.0];
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        let t = d1 / (d1 - d3);
        return [1.0 - t, t, 0.0];
    }
    let (d5, d6) = (-ab.dot(c), -ac.dot(c));
    if d6 >= 0.0 && d5 <= d6 {
        return [0.0, 0.0, 1.0];
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        let t = d2 / (d2 - d6);
        return [1.0 - t, 0.0, t];
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        let t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
        return [0.0, 1.0 - t, t];
    }
    let scale = 1.0 / (va + vb + vc);
    let (v, w) = (vb * scale, vc * scale);
    [1.0 - v - w, v, w]
}
