//! What is known of the surface at each vertex: the planes it has learnt of the scan, and those of the current faces.

use super::Options;
use super::policy::Weighting;
use super::surface::{Around, Surface, TOUCHED};
use crate::cores::InPieces;
use crate::mesh::adjacency::{after, before, parts};
use crate::mesh::{Coordinate, narrow};
use crate::quadric::{PackedQuadric, Quadric};
use fearless_simd::{Level, Simd, dispatch};
use glam::DVec3;
use rayon::prelude::*;

/// Vertices that are seen to by one task.
const TOGETHER: usize = 256;

/// Where no more than one face in so many is left, those that have gone have made room for the roots of all.
const ROOTS_FROM: usize = 2;

impl<S: Coordinate> Surface<S> {
    /// The sum of what both ends have learnt, about the middle of the edge.
    #[inline(always)]
    pub(super) fn learnt_form(&self, a: u32, b: u32, half: DVec3) -> Quadric {
        let (qa, qb) = (self.learnt[a as usize].unpack(), self.learnt[b as usize].unpack());
        let (ga, gb) = (qa.product(half), qb.product(half));
        let mut q = qa + qb;
        q.b += ga - gb;
        q.c += (ga + gb + 2.0 * (qa.b - qb.b)).dot(half);
        q
    }

    /// The quadric, about the middle of the edge, of the faces that now meet at `a` or `b`, each counted once, and of the
    /// borders there. Planes and lines of `a`'s star pass through `a`: only `A` is stored; those of faces at both ends hold
    /// the whole edge, so that `A·half` vanishes for them.
    #[inline(always)]
    pub(super) fn current_form(&self, around: &impl Around, a: u32, b: u32, half: DVec3, options: &Options) -> Quadric {
        let form = |v: u32| Quadric { a: self.current[v as usize].map(S::widen), ..Default::default() };
        let (qa, qb) = (form(a), form(b));
        let (ga, gb) = (qa.product(half), qb.product(half));
        let mut q = qa + qb;
        q.b = ga - gb;
        q.c = (ga + gb).dot(half);
        let mut faces = 0;
        for f in self.shared(around, a, b) {
            faces += 1;
            let mut plane = self.plane(f);
            if options.policies.weighting != Weighting::Area {
                // It was counted at both ends: once is by the mean of what it counts there.
                plane = scaled(&plane, 0.5 * (self.share(f, a, options) + self.share(f, b, options)));
            }
            subtract(&mut q, &plane);
        }
        if faces == 1 {
            subtract(&mut q, &options.policies.border_line(2.0 * half));
        }
        if let Some(features) = options.policies.features {
            subtract(&mut q, &self.feature(around, a, b, features).unwrap_or_default());
        }
        if self.holds_seams() {
            subtract(&mut q, &self.seam_line(around, a, b, options).unwrap_or_default());
        }
        q
    }

    /// The area-weighted planes of the faces around `v`, and the lines of the borders there. All pass through `v`, so that
    /// only `A` is not zero.
    #[inline(always)]
    pub fn form_around(&self, around: &impl Around, v: u32, options: &Options) -> Quadric {
        let at = self.at(v);
        let star = around.of(v);
        let mut q = Quadric::default();
        for &corner in star {
            let plane = match self.roots.is_empty() {
                true => {
                    let (p, s) = self.ends(corner);
                    plane_through((self.at(p) - at).cross(self.at(s) - at))
                }
                false => self.plane(corner >> 2),
            };
            q += match options.policies.weighting {
                Weighting::Area => plane,
                _ => scaled(&plane, self.share(corner >> 2, v, options)),
            };
        }
        if let Some(features) = options.policies.features {
            q += self.features_at(around, v, features);
        }
        if self.holds_seams() {
            q += self.seams_at(around, v, options);
        }
        if self.odd(v) { q + self.borders_at(around, v, options) } else { q }
    }

    /// What a face's plane counts at one of its corners, as a multiple of its area.
    fn share(&self, f: u32, v: u32, options: &Options) -> f64 {
        let face = self.faces[f as usize];
        let side = face.iter().position(|&u| u == v).unwrap_or(0);
        let at = self.at(v);
        options.policies.weighting.share(self.at(face[after(side)]) - at, self.at(face[before(side)]) - at)
    }

    /// The lines of the border edges at `v`: to neighbours that only one of its faces has.
    pub fn borders_at(&self, around: &impl Around, v: u32, options: &Options) -> Quadric {
        let mut neighbours: Vec<u32> = around.of(v).iter().map(|&c| self.ends(c)).flat_map(|(p, s)| [p, s]).collect();
        neighbours.sort_unstable();
        let mut q = Quadric::default();
        for same in neighbours.chunk_by(|a, b| a == b) {
            if let [u] = same {
                q += options.policies.border_line(self.at(*u) - self.at(v));
            }
        }
        q
    }

    /// Learns the planes of the faces and the borders. Each face's plane is worked out once, as the vector whose product
    /// with itself is its quadric.
    pub fn learn(&mut self, options: &Options) {
        if options.policies.weighting != Weighting::Area || options.policies.features.is_some() || self.holds_seams() {
            let this = &*self;
            let form = |v: u32| this.form_around(&this.stars, v, options).pack();
            self.learnt = (0..this.positions.len() as u32).into_par_iter().in_pieces(256).map(form).collect();
            return;
        }
        let mut roots = Vec::new();
        self.find_roots::<f32>(&mut roots);
        let this = &*self;
        let mut learnt: Vec<PackedQuadric> = bytemuck::zeroed_vec(this.positions.len());
        learnt.par_chunks_mut(TOGETHER).enumerate().in_pieces(1).for_each(|(chunk, learnt)| {
            let first = (chunk * TOGETHER) as u32;
            dispatch!(Level::new(), simd => this.learn_some(simd, &roots, first, learnt, options));
        });
        self.learnt = learnt;
    }

    /// What vertices from `first` on learn of faces with these roots.
    #[inline(always)]
    fn learn_some<V: Simd>(
        &self,
        _: V,
        roots: &[[f32; 3]],
        first: u32,
        learnt: &mut [PackedQuadric],
        options: &Options,
    ) {
        for (v, learnt) in (first..).zip(learnt) {
            let mut q = if self.odd(v) { self.borders_at(&self.stars, v, options) } else { Quadric::default() };
            for &corner in self.stars.of(v) {
                q += squared(roots[parts(corner).0].map(f64::from));
            }
            *learnt = q.pack();
        }
    }

    /// The sum of what vertices have learnt, about `x`.
    #[inline(always)]
    pub fn merged(&self, members: &[u32], x: DVec3) -> Quadric {
        let mut q = Quadric::default();
        for &v in members {
            q += self.learnt[v as usize].unpack().shifted(x - self.at(v));
        }
        q
    }

    /// The square root of each face's quadric: a vector whose product with itself is its plane, weighted by area.
    fn find_roots<T: Coordinate>(&self, roots: &mut Vec<[T; 3]>) {
        let root = |f: usize| {
            let normal = self.normal(f as u32);
            let length = normal.length();
            narrow(if length > 0.0 { normal * (0.5 / length).sqrt() } else { DVec3::ZERO })
        };
        (0..self.faces.len()).into_par_iter().in_pieces(256).map(root).collect_into_vec(roots);
    }

    /// The area-weighted plane of a face, as its root says if that is known.
    #[inline(always)]
    fn plane(&self, f: u32) -> Quadric {
        match self.roots.get(f as usize) {
            Some(root) => squared(root.map(S::widen)),
            None => plane_through(self.normal(f)),
        }
    }

    /// Forgets what holds only as long as no face changes.
    pub fn forget_roots(&mut self) {
        self.roots.clear();
    }

    /// Brings the quadrics of the current faces up to date, after the last round or for the first time.
    pub fn renew_current(&mut self, options: &Options) {
        if ROOTS_FROM * self.faces.len() <= self.faces_at_first && options.policies.weighting == Weighting::Area {
            let mut roots = std::mem::take(&mut self.roots);
            self.find_roots(&mut roots);
            self.roots = roots;
        }
        let mut current = std::mem::take(&mut self.current);
        let all = current.is_empty();
        current.resize(self.positions.len(), [S::narrow(0.0); 6]);
        let this = &*self;
        current.par_chunks_mut(TOGETHER).enumerate().in_pieces(1).for_each(|(chunk, forms)| {
            let first = (chunk * TOGETHER) as u32;
            dispatch!(Level::new(), simd => this.renew_some(simd, first, forms, all, options));
        });
        self.current = current;
    }

    /// The same of vertices from `first` on: of all, or of those that were touched.
    #[inline(always)]
    fn renew_some<V: Simd>(&self, _: V, first: u32, forms: &mut [[S; 6]], all: bool, options: &Options) {
        for (v, form) in (first..).zip(forms) {
            if all || self.mark(v) & TOUCHED != 0 {
                *form = self.form_around(&self.stars, v, options).a.map(S::narrow);
            }
        }
    }
}

/// The area-weighted quadric of a face about one of its vertices, from `normal` = 2·area·n.
#[inline(always)]
pub(super) fn plane_through(normal: DVec3) -> Quadric {
    let length = normal.length();
    if length == 0.0 {
        return Quadric::default();
    }
    let m = normal * (0.5 / length);
    let n = normal;
    Quadric {
        a: [m.x * n.x, m.x * n.y, m.x * n.z, m.y * n.y, m.y * n.z, m.z * n.z],
        w: 0.5 * length,
        ..Default::default()
    }
}

/// The plane of a root.
#[inline(always)]
fn squared(m: [f64; 3]) -> Quadric {
    Quadric {
        a: [m[0] * m[0], m[0] * m[1], m[0] * m[2], m[1] * m[1], m[1] * m[2], m[2] * m[2]],
        w: m[0] * m[0] + m[1] * m[1] + m[2] * m[2],
        ..Default::default()
    }
}

/// The same planes, with another weight.
fn scaled(q: &Quadric, factor: f64) -> Quadric {
    Quadric { a: q.a.map(|x| x * factor), w: q.w * factor, ..Default::default() }
}

#[inline(always)]
fn subtract(q: &mut Quadric, o: &Quadric) {
    for (x, y) in q.a.iter_mut().zip(o.a) {
        *x -= y;
    }
    q.w -= o.w;
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::collapse::surface::tests::{MIDDLE, NEIGHBOURS, bumps};

    /// With the quadrics of its faces, and their roots as where half of the faces have gone.
    pub(in crate::collapse) fn with_roots<S: Coordinate>(mut surface: Surface<S>, options: &Options) -> Surface<S> {
        surface.faces_at_first = ROOTS_FROM * surface.faces.len();
        surface.renew_current(options);
        surface
    }

    fn roots_are_planes<S: Coordinate>() {
        let options = Options::to(1);
        let mut surface = bumps::<S>();
        let costs = |surface: &mut Surface<S>| {
            surface.current.clear();
            surface.renew_current(&options);
            NEIGHBOURS.map(|u| surface.candidate(&surface.stars, MIDDLE, u, &options).cost)
        };
        let plain = costs(&mut surface);
        assert!(surface.roots.is_empty(), "no face has gone");
        surface.faces_at_first = ROOTS_FROM * surface.faces.len();
        let by_roots = costs(&mut surface);
        assert_eq!(surface.roots.len(), surface.faces.len());
        for (plain, by_root) in plain.into_iter().zip(by_roots) {
            assert!(plain > 1e-6 && (plain - by_root).abs() < 1e-4 * plain, "{plain} {by_root}");
        }
    }

    #[test]
    fn planes_are_the_same_by_roots() {
        roots_are_planes::<f32>();
        roots_are_planes::<f64>();
    }
}
