//! Attributes that steer (thesis ch. 5; H. Hoppe, New quadric metric for simplifying meshes with appearance attributes, 1999):
//! colours, texture coordinates, normals, or all of them, up to eight numbers.
//!
//! Over a face a number is a linear function `g·x + d` of the place. Merging the faces around an edge into one vertex at `x`
//! with number `s` costs `Σ w |g·x + d − s|²` over those faces, `w` their areas: geometry's quadric and this one are solved
//! together. Of all `s` the best is the mean of `g·x + d`, whatever `x`; put in, it leaves a quadric of `x` alone,
//! `Σ w (g·x + d)² − (Σ w (g·x + d))² / Σ w`, which is added to that of the planes. So placement and cost stay problems of
//! three unknowns, and a scan without attributes pays for none of it. On a seam each side has numbers of its own, and a sum
//! of its own.
//!
//! As the planes of the last factor, the numbers are those of the current faces, not of all that they stand for. Far from
//! the target, where edges are only ranked, an edge costs what the numbers of its ends differ.
//!
//! Numbers are kept as lengths: what a full range is worth is said by who gives them. What the result's vertices
//! finally get is worked out from the scan itself (`carry`); here they only steer.

use super::surface::{Around, Surface};
use crate::mesh::adjacency::parts;
use crate::mesh::{Coordinate, Shades};
use crate::quadric::Quadric;
use glam::DVec3;

/// Numbers of one vertex or wedge.
pub(super) type Numbers = [f32; Shades::MOST];

/// What the numbers of current faces come to, about a place.
#[derive(Clone, Default)]
struct Sum {
    /// How many there are.
    dims: usize,
    /// What they are counted from.
    about: [f64; Shades::MOST],
    /// `Σ w g gᵀ`, `Σ w d g`, `Σ w d²` over faces and numbers, and `Σ w` over faces.
    form: Quadric,
    /// `Σ w g` and `Σ w d` of each number.
    moments: [(DVec3, f64); Shades::MOST],
}

impl Sum {
    /// Of no face yet.
    fn about(about: &[f32]) -> Sum {
        let mut sum = Sum { dims: about.len(), ..Sum::default() };
        sum.about.iter_mut().zip(about).for_each(|(x, about)| *x = f64::from(*about));
        sum
    }

    /// Adds a face: corners about the place, and their numbers.
    #[inline]
    fn add(&mut self, [p, q, r]: [DVec3; 3], [s, t, u]: [&[f32]; 3]) {
        let (e, f) = (q - p, r - p);
        let normal = e.cross(f);
        let square = normal.length_squared();
        if square <= 0.0 {
            return;
        }
        let w = 0.5 * square.sqrt();
        let (along_e, along_f) = (f.cross(normal) / square, normal.cross(e) / square);
        self.form.w += w;
        for (i, (sum_g, sum_d)) in self.moments[..self.dims].iter_mut().enumerate() {
            let [s, t, u] = [s[i], t[i], u[i]].map(|x| f64::from(x) - self.about[i]);
            let g = along_e * (t - s) + along_f * (u - s);
            let d = s - g.dot(p);
            let m = g * w;
            let outer = [m.x * g.x, m.x * g.y, m.x * g.z, m.y * g.y, m.y * g.z, m.z * g.z];
            self.form.a.iter_mut().zip(outer).for_each(|(a, x)| *a += x);
            self.form.b += m * d;
            self.form.c += w * d * d;
            *sum_g += m;
            *sum_d += w * d;
        }
    }

    /// The quadric that is left with the best numbers put in. It weighs no surface.
    fn eliminated(&self) -> Quadric {
        let mut q = self.form;
        let w = q.w;
        if w <= 0.0 {
            return Quadric::default();
        }
        for (g, d) in &self.moments[..self.dims] {
            let outer = [g.x * g.x, g.x * g.y, g.x * g.z, g.y * g.y, g.y * g.z, g.z * g.z];
            q.a.iter_mut().zip(outer).for_each(|(a, x)| *a -= x / w);
            q.b -= *g * (d / w);
            q.c -= d * d / w;
        }
        // What is left of the diagonal is a sum of squares; rounding must not make it less.
        for i in [0, 3, 5] {
            q.a[i] = q.a[i].max(0.0);
        }
        Quadric { w: 0.0, ..q }
    }

    /// The best value of a number at a place.
    fn best(&self, i: usize, x: DVec3) -> f64 {
        let w = self.form.w;
        self.about[i] + if w > 0.0 { (self.moments[i].0.dot(x) + self.moments[i].1) / w } else { 0.0 }
    }
}

impl<S: Coordinate> Surface<S> {
    /// Whether attributes steer.
    #[inline(always)]
    pub fn is_shaded(&self) -> bool {
        !self.shades.is_empty()
    }

    /// The numbers at a corner of a face.
    #[inline]
    fn shade(&self, f: usize, side: usize) -> &[f32] {
        let of = if self.is_seamed() { &self.wedges.corners } else { &self.faces };
        self.shades.of(of[f][side])
    }

    /// Numbers of the faces at these vertices, each once, about a place: a sum for each vertex or wedge that they will be,
    /// by its number.
    fn shades_around(&self, around: &impl Around, members: &[u32], at: DVec3) -> Vec<(u32, Sum)> {
        let pairs = if self.is_seamed() { self.wedge_pairs(around, members[0], members[1]) } else { Vec::new() };
        let mut sums: Vec<(u32, Sum)> = Vec::with_capacity(1);
        for (i, &v) in members.iter().enumerate() {
            for &corner in around.of(v) {
                let (f, side) = parts(corner);
                let face = self.faces[f];
                if face.iter().any(|u| members[..i].contains(u)) {
                    continue;
                }
                let mut key = members[0];
                if self.is_seamed() {
                    let wedge = self.wedges.corners[f][side];
                    key = pairs.iter().find(|(_, of_b)| i > 0 && *of_b == wedge).map_or(wedge, |(of_a, _)| *of_a);
                }
                let found = sums.iter().position(|(k, _)| *k == key);
                let found = found.unwrap_or_else(|| {
                    sums.push((key, Sum::about(self.shade(f, side))));
                    sums.len() - 1
                });
                sums[found].1.add(face.map(|u| self.at(u) - at), [0, 1, 2].map(|i| self.shade(f, i)));
            }
        }
        sums
    }

    /// What attributes say of the place for the vertex that `a` and `b` become, about the middle of the edge.
    pub fn shade_form(&self, around: &impl Around, a: u32, b: u32) -> Quadric {
        let middle = 0.5 * (self.at(a) + self.at(b));
        let sums = self.shades_around(around, &[a, b], middle);
        sums.iter().fold(Quadric::default(), |q, (_, sum)| q + sum.eliminated())
    }

    /// The numbers of the vertex at `x` that these become, or of its wedges, within what those of the merged ones are.
    pub fn merged_shades(&self, around: &impl Around, members: &[u32], x: DVec3) -> Vec<(u32, Numbers)> {
        let sums = self.shades_around(around, members, x);
        let pairs = if self.is_seamed() { self.wedge_pairs(around, members[0], members[1]) } else { Vec::new() };
        let merged = sums.into_iter().map(|(key, sum)| {
            let mut numbers = [0.0; Shades::MOST];
            for (i, number) in numbers[..sum.dims].iter_mut().enumerate() {
                let one = |of: u32| f64::from(self.shades.of(of)[i]);
                let (mut least, mut most) = (one(key), one(key));
                let others = pairs.iter().filter(|(of_a, _)| *of_a == key).map(|(_, of_b)| *of_b);
                let plain = if self.is_seamed() { &[][..] } else { members };
                for other in others.chain(plain.iter().copied()) {
                    (least, most) = (least.min(one(other)), most.max(one(other)));
                }
                // Extrapolated, a number may leave what there is: by no more than what the merged ones differ.
                let slack = most - least;
                *number = sum.best(i, DVec3::ZERO).clamp(least - slack, most + slack) as f32;
            }
            (key, numbers)
        });
        merged.collect()
    }

    /// Gives a vertex or wedge its numbers.
    pub fn take_shade(&mut self, i: u32, numbers: &Numbers) {
        let dims = self.shades.dims;
        self.shades.of_mut(i).copy_from_slice(&numbers[..dims]);
    }

    /// What the numbers of two vertices differ, as a cost.
    #[inline]
    pub fn shade_rank(&self, a: u32, b: u32) -> f32 {
        let square: f32 = self.shades.of(a).iter().zip(self.shades.of(b)).map(|(x, y)| (x - y) * (x - y)).sum();
        let [wa, wb] = [a, b].map(|v| self.learnt[v as usize].w);
        let both = wa + wb;
        if both > 0.0 { RANKED * square * wa * wb / both } else { 0.0 }
    }
}

/// What a difference counts where edges are ranked, against what it costs.
const RANKED: f32 = 0.25;

#[cfg(test)]
mod tests {
    use super::*;

    fn sum(colour: impl Fn(DVec3) -> DVec3) -> Sum {
        let centre = DVec3::new(0.1, -0.2, 0.0);
        let rim: Vec<DVec3> = (0..7)
            .map(|i| f64::from(i) / 7.0 * std::f64::consts::TAU)
            .map(|a| DVec3::new(a.cos(), a.sin(), 0.0))
            .collect();
        let mut sum = Sum::about(&[0.25, 0.5, -1.0]);
        for i in 0..7 {
            let face = [centre, rim[i], rim[(i + 1) % 7]];
            let numbers = face.map(|p| colour(p).as_vec3().to_array());
            sum.add(face, [&numbers[0], &numbers[1], &numbers[2]]);
        }
        sum
    }

    fn best(sum: &Sum, x: DVec3) -> DVec3 {
        DVec3::new(sum.best(0, x), sum.best(1, x), sum.best(2, x))
    }

    #[test]
    fn a_colour_that_varies_evenly_costs_nothing_anywhere() {
        let colour = |p: DVec3| DVec3::new(1.0 + 2.0 * p.x, -p.y, 0.5 * p.x + 3.0 * p.y);
        let x = DVec3::new(0.3, -0.4, 0.0);
        let found = sum(colour);
        assert!(best(&found, x).distance(colour(x)) < 1e-6);
        assert!(found.eliminated().value(x) < 1e-10);
    }

    #[test]
    fn the_quadric_is_the_cost_of_the_best_colour() {
        let found = sum(|p| DVec3::new(p.x * p.x, (p.x - p.y).abs(), f64::from(p.x > 0.2)));
        let about = DVec3::new(found.about[0], found.about[1], found.about[2]);
        for x in [DVec3::ZERO, DVec3::new(0.5, 0.25, 0.1), DVec3::new(-0.9, 0.3, -0.2)] {
            let s = best(&found, x) - about;
            let at = |s: DVec3| {
                let parts = found.moments[..3].iter().zip(s.to_array());
                let linear: f64 = parts.map(|((g, d), s)| s * (found.form.w * s - 2.0 * (g.dot(x) + d))).sum();
                found.form.value(x) + linear
            };
            let q = found.eliminated();
            assert!((q.value(x) - at(s)).abs() < 1e-9, "{} {}", q.value(x), at(s));
            for other in [s + 0.1 * DVec3::X, s - 0.05 * DVec3::ONE] {
                assert!(at(other) > at(s));
            }
        }
    }
}
