//! Colours that steer (thesis ch. 5; H. Hoppe, New quadric metric for simplifying meshes with appearance attributes, 1999).
//!
//! Over a face a colour is a linear function `g·x + d` of the place, one for each of its parts. Merging the faces around an
//! edge into one vertex at `x` with colour `s` costs `Σ w |g·x + d − s|²` over those faces, `w` their areas: geometry's
//! quadric and this one are solved together. Of all `s` the best is the mean of `g·x + d`, whatever `x`; put in, it leaves
//! a quadric of `x` alone, `Σ w (g·x + d)² − (Σ w (g·x + d))² / Σ w`, which is added to that of the planes. So placement
//! and cost stay problems of three unknowns, and a scan without colours pays for none of it.
//!
//! As the planes of the last factor, the colours are those of the current faces, not of all that they stand for. Far from
//! the target, where edges are only ranked, an edge costs what the two colours differ.
//!
//! Colours are kept as lengths: what full brightness is worth is said by who gives them. What the result's vertices
//! finally get is worked out from the scan itself (`carry`); here they only steer.

use super::surface::{Around, Surface};
use crate::mesh::Coordinate;
use crate::mesh::adjacency::parts;
use crate::quadric::Quadric;
use glam::DVec3;

/// What colours of current faces come to, about a place.
#[derive(Default)]
struct Sum {
    /// `Σ w g gᵀ`, `Σ w d g`, `Σ w d²` over faces and parts, and `Σ w` over faces.
    form: Quadric,
    /// `Σ w g` and `Σ w d` of each part.
    moments: [(DVec3, f64); 3],
}

impl Sum {
    /// Adds a face: corners about the place, colours about some colour.
    #[inline]
    fn add(&mut self, [p, q, r]: [DVec3; 3], [s, t, u]: [DVec3; 3]) {
        let (e, f) = (q - p, r - p);
        let normal = e.cross(f);
        let square = normal.length_squared();
        if square <= 0.0 {
            return;
        }
        let w = 0.5 * square.sqrt();
        let (along_e, along_f) = (f.cross(normal) / square, normal.cross(e) / square);
        self.form.w += w;
        for (part, (sum_g, sum_d)) in self.moments.iter_mut().enumerate() {
            let g = along_e * (t[part] - s[part]) + along_f * (u[part] - s[part]);
            let d = s[part] - g.dot(p);
            let m = g * w;
            let outer = [m.x * g.x, m.x * g.y, m.x * g.z, m.y * g.y, m.y * g.z, m.z * g.z];
            self.form.a.iter_mut().zip(outer).for_each(|(a, x)| *a += x);
            self.form.b += m * d;
            self.form.c += w * d * d;
            *sum_g += m;
            *sum_d += w * d;
        }
    }

    /// The quadric that is left with the best colour put in. It weighs no surface.
    fn eliminated(self) -> Quadric {
        let mut q = self.form;
        let w = q.w;
        if w <= 0.0 {
            return Quadric::default();
        }
        for (g, d) in self.moments {
            let outer = [g.x * g.x, g.x * g.y, g.x * g.z, g.y * g.y, g.y * g.z, g.z * g.z];
            q.a.iter_mut().zip(outer).for_each(|(a, x)| *a -= x / w);
            q.b -= g * (d / w);
            q.c -= d * d / w;
        }
        // What is left of the diagonal is a sum of squares; rounding must not make it less.
        for i in [0, 3, 5] {
            q.a[i] = q.a[i].max(0.0);
        }
        Quadric { w: 0.0, ..q }
    }

    /// The best colour at a place.
    fn best(&self, x: DVec3) -> DVec3 {
        let w = self.form.w;
        let part = |i: usize| if w > 0.0 { (self.moments[i].0.dot(x) + self.moments[i].1) / w } else { 0.0 };
        DVec3::new(part(0), part(1), part(2))
    }
}

/// A stored colour.
fn wide(shade: [f32; 3]) -> DVec3 {
    DVec3::from_array(shade.map(f64::from))
}

impl<S: Coordinate> Surface<S> {
    /// Whether colours steer.
    #[inline(always)]
    pub fn is_shaded(&self) -> bool {
        !self.shades.is_empty()
    }

    fn shade(&self, v: u32) -> DVec3 {
        wide(self.shades[v as usize])
    }

    /// Colours of the faces at these vertices, each once, about a place and a colour.
    fn shades_around(&self, around: &impl Around, members: &[u32], at: DVec3, about: DVec3) -> Sum {
        let mut sum = Sum::default();
        for (i, &v) in members.iter().enumerate() {
            for &corner in around.of(v) {
                let face = self.faces[parts(corner).0];
                if !face.iter().any(|u| members[..i].contains(u)) {
                    sum.add(face.map(|u| self.at(u) - at), face.map(|u| self.shade(u) - about));
                }
            }
        }
        sum
    }

    /// What colours say of the place for the vertex that `a` and `b` become, about the middle of the edge.
    pub fn shade_form(&self, around: &impl Around, a: u32, b: u32) -> Quadric {
        let middle = 0.5 * (self.at(a) + self.at(b));
        let about = 0.5 * (self.shade(a) + self.shade(b));
        self.shades_around(around, &[a, b], middle, about).eliminated()
    }

    /// The colour of the vertex at `x` that these become, within what their colours and those around them are.
    pub fn merged_shade(&self, around: &impl Around, members: &[u32], x: DVec3) -> [f32; 3] {
        let about = self.shade(members[0]);
        let best = self.shades_around(around, members, x, about).best(DVec3::ZERO) + about;
        // Extrapolated, a colour may leave what there is: by no more than what the merged ones differ.
        let least = members.iter().fold(about, |least, &v| least.min(self.shade(v)));
        let most = members.iter().fold(about, |most, &v| most.max(self.shade(v)));
        let slack = most - least;
        best.clamp(least - slack, most + slack).as_vec3().to_array()
    }

    /// What two colours differ, as a cost.
    #[inline]
    pub fn shade_rank(&self, a: u32, b: u32) -> f32 {
        let [p, q] = [a, b].map(|v| self.shades[v as usize]);
        let square: f32 = p.iter().zip(q).map(|(x, y)| (x - y) * (x - y)).sum();
        let [wa, wb] = [a, b].map(|v| self.learnt[v as usize].w);
        let both = wa + wb;
        if both > 0.0 { RANKED * square * wa * wb / both } else { 0.0 }
    }
}

/// What a difference of colours counts where edges are ranked, against what it costs.
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
        let mut sum = Sum::default();
        for i in 0..7 {
            let face = [centre, rim[i], rim[(i + 1) % 7]];
            sum.add(face, face.map(&colour));
        }
        sum
    }

    #[test]
    fn a_colour_that_varies_evenly_costs_nothing_anywhere() {
        let colour = |p: DVec3| DVec3::new(1.0 + 2.0 * p.x, -p.y, 0.5 * p.x + 3.0 * p.y);
        let x = DVec3::new(0.3, -0.4, 0.0);
        let found = sum(colour);
        assert!(found.best(x).distance(colour(x)) < 1e-12);
        assert!(found.eliminated().value(x) < 1e-12);
    }

    #[test]
    fn the_quadric_is_the_cost_of_the_best_colour() {
        let found = sum(|p| DVec3::new(p.x * p.x, (p.x - p.y).abs(), f64::from(p.x > 0.2)));
        for x in [DVec3::ZERO, DVec3::new(0.5, 0.25, 0.1), DVec3::new(-0.9, 0.3, -0.2)] {
            let s = found.best(x);
            let at = |s: DVec3| {
                let parts = found.moments.iter().zip(s.to_array());
                let linear: f64 = parts.map(|((g, d), s)| s * (found.form.w * s - 2.0 * (g.dot(x) + d))).sum();
                found.form.value(x) + linear
            };
            let q = sum(|p| DVec3::new(p.x * p.x, (p.x - p.y).abs(), f64::from(p.x > 0.2))).eliminated();
            assert!((q.value(x) - at(s)).abs() < 1e-9, "{} {}", q.value(x), at(s));
            for other in [s + 0.1 * DVec3::X, s - 0.05 * DVec3::ONE] {
                assert!(at(other) > at(s));
            }
        }
    }
}
