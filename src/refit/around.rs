//! The faces around a vertex, laid out so that a point is held against eight of them at a time.
//!
//! Samples of one vertex follow one another, and each begins with the same faces: their edges and normals are worked
//! out once.

use super::NONE;
use super::ground::{Ground, ROUNDING};
use super::lanes::{LANES, Triangles, Vec3x8, least};
use crate::mesh::adjacency::{after, before, parts};
use crate::mesh::{Coordinate, step};
use fearless_simd::{Simd, f32x8, prelude::*};
use glam::Vec3;

/// Vertices that are remembered.
const STARS: usize = 16;

/// Faces of a vertex that are laid out. Where there are more, these are few.
const MOST: usize = 2 * LANES;

/// Faces around vertices, one worker's.
pub(super) struct Around<V: Simd>(V, Box<[Star<V>; STARS]>);

/// The faces around one vertex, each with that vertex as its first corner.
#[derive(Clone, Copy)]
struct Star<V: Simd> {
    vertex: u32,
    /// [`NONE`] where there is no further one.
    faces: [u32; MOST],
    /// The longest side's extent along an axis.
    long: [[f32; LANES]; MOST / LANES],
    triangles: [Triangles<V>; MOST / LANES],
    normals: [Vec3x8<V>; MOST / LANES],
}

impl<V: Simd> Around<V> {
    #[inline(always)]
    pub fn new(simd: V) -> Self {
        let none = Vec3x8::splat(simd, Vec3::ZERO);
        let star = Star {
            vertex: NONE,
            faces: [NONE; MOST],
            long: [[0.0; LANES]; MOST / LANES],
            triangles: [Triangles::new(none, none); MOST / LANES],
            normals: [none; MOST / LANES],
        };
        Around(simd, Box::new([star; STARS]))
    }

    /// The face that is nearest to `point`, found from vertex `v` as [`Ground::near_vertex`] does.
    #[inline(always)]
    pub fn near<S: Coordinate>(&mut self, ground: Ground<S>, point: [S; 3], normal: Vec3, v: u32) -> Option<u32> {
        // In doubles, what single precision cannot tell apart is worked out exactly, which is done one by one.
        if S::DOUBLE || ground.stars.of(v).len() > MOST {
            return ground.near_vertex(point, normal, v).map(|place| place.face);
        }
        let (simd, star) = (self.0, &mut self.1[v as usize % STARS]);
        if star.vertex != v {
            star.lay_out(simd, ground, v);
        }
        let (face, is_beyond) = star.nearest(simd, step(ground.mesh.positions[v as usize], point), normal)?;
        // A place at the vertex, or on an edge that it is an end of, has been held against all that it belongs to.
        if is_beyond { Some(ground.walk(ground.on_face(point, face), point, normal).face) } else { Some(face) }
    }
}

impl<V: Simd> Star<V> {
    #[inline(always)]
    fn lay_out<S: Coordinate>(&mut self, simd: V, ground: Ground<S>, v: u32) {
        self.vertex = v;
        self.faces = [NONE; MOST];
        let at = ground.mesh.positions[v as usize];
        let (mut ab, mut ac, mut normals) = ([[[0.0; LANES]; 3]; 2], [[[0.0; LANES]; 3]; 2], [[[0.0; LANES]; 3]; 2]);
        for (i, &corner) in ground.stars.of(v).iter().take(MOST).enumerate() {
            let (f, side) = parts(corner);
            let face = ground.mesh.faces[f];
            let to = |side: usize| step(at, ground.mesh.positions[face[side] as usize]);
            let (b, c) = (to(after(side)), to(before(side)));
            self.faces[i] = f as u32;
            self.long[i / LANES][i % LANES] = b.abs().max(c.abs()).max_element();
            for (lanes, x) in [(&mut ab, b), (&mut ac, c), (&mut normals, b.cross(c))] {
                (0..3).for_each(|axis| lanes[i / LANES][axis][i % LANES] = x[axis]);
            }
        }
        for (half, (triangles, normal)) in self.triangles.iter_mut().zip(&mut self.normals).enumerate() {
            let axes = |axes| Vec3x8::from_axes(simd, axes);
            *triangles = Triangles::new(axes(ab[half]), axes(ac[half]));
            *normal = axes(normals[half]);
        }
    }

    /// The face nearest to a point about the vertex, among those that look the same way as `normal`: the first of those
    /// between which only rounding decides. And whether the nearest place is on the far side of it.
    #[inline(always)]
    fn nearest(&self, simd: V, point: Vec3, normal: Vec3) -> Option<(u32, bool)> {
        let (p, n) = (Vec3x8::splat(simd, point), Vec3x8::splat(simd, normal));
        let of = |x: f32| f32x8::splat(simd, x);
        let mut distances = [of(f32::INFINITY); MOST / LANES];
        let mut beyond = [0; MOST / LANES];
        for half in 0..MOST / LANES {
            if self.faces[half * LANES] == NONE {
                break;
            }
            let found = self.triangles[half].nearest(simd, p);
            let is_alike = self.normals[half].dot(n).simd_gt(of(0.0));
            distances[half] = is_alike.select(found.step.dot(found.step).sqrt(), distances[half]);
            beyond[half] = found.weights[0].simd_eq(of(0.0)).to_bitmask();
        }
        // Which of eight is nearer no processor can predict: they are held against the nearest at once.
        let nearest = distances.into_iter().map(least).fold(f32::INFINITY, |a, b| if b < a { b } else { a });
        if nearest == f32::INFINITY {
            return None;
        }
        for (half, (distances, beyond)) in distances.into_iter().zip(beyond).enumerate() {
            let slack = of(ROUNDING) * f32x8::load_array(simd, self.long[half]);
            let within = (distances - slack).simd_le(of(nearest)).to_bitmask();
            if within != 0 {
                let i = within.trailing_zeros() as usize;
                return Some((self.faces[half * LANES + i], beyond >> i & 1 == 1));
            }
        }
        None
    }
}
