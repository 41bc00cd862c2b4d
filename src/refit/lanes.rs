//! Points and triangles, eight at a time.

use fearless_simd::{Simd, f32x8, mask32x8, prelude::*};
use glam::Vec3;

/// Points or triangles that are looked at together.
pub(super) const LANES: usize = 8;

/// Three coordinates of eight vectors.
#[derive(Clone, Copy)]
pub(super) struct Vec3x8<V: Simd>([f32x8<V>; 3]);

impl<V: Simd> Vec3x8<V> {
    /// Eight times the same vector.
    #[inline(always)]
    pub fn splat(simd: V, v: Vec3) -> Self {
        Vec3x8([f32x8::splat(simd, v.x), f32x8::splat(simd, v.y), f32x8::splat(simd, v.z)])
    }

    /// From coordinates by axis.
    #[inline(always)]
    pub fn from_axes(simd: V, axes: [[f32; LANES]; 3]) -> Self {
        let [x, y, z] = axes;
        Vec3x8([f32x8::load_array(simd, x), f32x8::load_array(simd, y), f32x8::load_array(simd, z)])
    }

    #[inline(always)]
    pub fn dot(self, o: Self) -> f32x8<V> {
        self.0[0] * o.0[0] + self.0[1] * o.0[1] + self.0[2] * o.0[2]
    }

    /// This and `t` times another.
    #[inline(always)]
    pub fn plus(self, t: f32x8<V>, o: Self) -> Self {
        Vec3x8([self.0[0] + t * o.0[0], self.0[1] + t * o.0[1], self.0[2] + t * o.0[2]])
    }

    /// The sum of all eight.
    #[inline(always)]
    pub fn sum(self) -> Vec3 {
        Vec3::new(sum(self.0[0]), sum(self.0[1]), sum(self.0[2]))
    }
}

/// The sum of eight numbers, in one order on every machine.
#[inline(always)]
pub(super) fn sum<V: Simd>(x: f32x8<V>) -> f32 {
    let [a, b, c, d, e, f, g, h] = x.to_array();
    ((a + e) + (b + f)) + ((c + g) + (d + h))
}

/// The least of eight numbers.
#[inline(always)]
pub(super) fn least<V: Simd>(x: f32x8<V>) -> f32 {
    let [a, b, c, d, e, f, g, h] = x.to_array();
    let least = |a: f32, b: f32| if a < b { a } else { b };
    least(least(least(a, e), least(b, f)), least(least(c, g), least(d, h)))
}

/// Eight triangles, each about its first corner: the edges from there, and their products.
#[derive(Clone, Copy)]
pub(super) struct Triangles<V: Simd> {
    pub ab: Vec3x8<V>,
    pub ac: Vec3x8<V>,
    bb: f32x8<V>,
    bc: f32x8<V>,
    cc: f32x8<V>,
}

/// Where eight triangles are nearest to points.
pub(super) struct Nearest<V: Simd> {
    /// Weights of the corners; exactly zero for those that the place is not near to.
    pub weights: [f32x8<V>; 3],
    /// From the place to the point.
    pub step: Vec3x8<V>,
}

impl<V: Simd> Triangles<V> {
    #[inline(always)]
    pub fn new(ab: Vec3x8<V>, ac: Vec3x8<V>) -> Self {
        Triangles { ab, ac, bb: ab.dot(ab), bc: ab.dot(ac), cc: ac.dot(ac) }
    }

    /// The places that are nearest to points, which are about the first corners: as
    /// [`nearest_to_origin`](super::ground::nearest_to_origin) finds them one by one.
    #[inline(always)]
    pub fn nearest(&self, simd: V, p: Vec3x8<V>) -> Nearest<V> {
        let (zero, one) = (f32x8::splat(simd, 0.0), f32x8::splat(simd, 1.0));
        let (d1, d2) = (self.ab.dot(p), self.ac.dot(p));
        let (d3, d4) = (d1 - self.bb, d2 - self.bc);
        let (d5, d6) = (d1 - self.bc, d2 - self.cc);
        let (vc, vb, va) = (d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4);
        let scale = one / (va + vb + vc);
        let (mut b, mut c) = (vb * scale, vc * scale);
        let mut a = one - b - c;
        let mut put = |is: mask32x8<V>, to: [f32x8<V>; 3]| {
            (a, b, c) = (is.select(to[0], a), is.select(to[1], b), is.select(to[2], c));
        };
        // The first that is so is last to be put.
        let (e, f) = (d4 - d3, d5 - d6);
        let t = e / (e + f);
        put(va.simd_le(zero) & e.simd_ge(zero) & f.simd_ge(zero), [zero, one - t, t]);
        let t = d2 / self.cc;
        put(vb.simd_le(zero) & d2.simd_ge(zero) & d6.simd_le(zero), [one - t, zero, t]);
        put(d6.simd_ge(zero) & d5.simd_le(d6), [zero, zero, one]);
        let t = d1 / self.bb;
        put(vc.simd_le(zero) & d1.simd_ge(zero) & d3.simd_le(zero), [one - t, t, zero]);
        put(d3.simd_ge(zero) & d4.simd_le(d3), [zero, one, zero]);
        put(d1.simd_le(zero) & d2.simd_le(zero), [one, zero, zero]);
        Nearest { weights: [a, b, c], step: p.plus(-b, self.ab).plus(-c, self.ac) }
    }
}

#[cfg(test)]
mod tests {
    use super::super::ground::nearest_to_origin;
    use super::*;
    use crate::vectors::levels;
    use fearless_simd::dispatch;

    /// Weights, and steps' squared lengths.
    #[inline(always)]
    fn nearest_of<V: Simd>(simd: V, [b, c]: [&[Vec3]; 2], p: Vec3) -> ([[f32; LANES]; 3], [f32; LANES]) {
        let axes = |of: &[Vec3]| Vec3x8::from_axes(simd, std::array::from_fn(|k| std::array::from_fn(|i| of[i][k])));
        let found = Triangles::new(axes(b), axes(c)).nearest(simd, Vec3x8::splat(simd, p));
        (found.weights.map(|w| w.to_array()), found.step.dot(found.step).to_array())
    }

    #[test]
    fn eight_are_as_one() {
        let mut state = 3u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
        };
        let mut seen = [0; 8];
        for _ in 0..500 {
            let mut place = || Vec3::new(random(), random(), 0.3 * random());
            let (b, c): (Vec<Vec3>, Vec<Vec3>) = (0..LANES).map(|_| (place(), place())).unzip();
            let p = 1.5 * place();
            let by_level: Vec<_> =
                levels().into_iter().map(|level| dispatch!(level, simd => nearest_of(simd, [&b, &c], p))).collect();
            assert!(by_level.iter().all(|found| *found == by_level[0]), "the width of vectors shows");
            let (weights, distances_sq) = by_level[0];
            for (i, (&b, &c)) in b.iter().zip(&c).enumerate() {
                let expected = nearest_to_origin([-p, b - p, c - p]);
                let step = p - expected[1] * b - expected[2] * c;
                assert!((step.length_squared() - distances_sq[i]).abs() < 1e-5, "{step} {}", distances_sq[i]);
                let on = |w: [f32; 3]| w.map(|w| w != 0.0);
                let weights = [weights[0][i], weights[1][i], weights[2][i]];
                assert!((0..3).all(|k| (weights[k] - expected[k]).abs() < 1e-2), "{weights:?} {expected:?}");
                seen[on(weights).iter().fold(0, |bits, on| 2 * bits + usize::from(*on))] += 1;
            }
        }
        assert!(seen[1..].iter().all(|n| *n > 50) && seen[0] == 0, "{seen:?}");
    }
}
