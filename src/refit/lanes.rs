//! Points and triangles, eight at a time.

use glam::Vec3;
use wide::f32x8;

/// Points or triangles that are looked at together.
pub(super) const LANES: usize = 8;

/// Three coordinates of eight vectors.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Vec3x8([f32x8; 3]);

impl Vec3x8 {
    /// Eight times the same vector.
    #[inline(always)]
    pub fn splat(v: Vec3) -> Self {
        Vec3x8(v.to_array().map(f32x8::splat))
    }

    /// From coordinates by axis.
    #[inline(always)]
    pub fn from_axes(axes: [[f32; LANES]; 3]) -> Self {
        Vec3x8(axes.map(f32x8::from))
    }

    #[inline(always)]
    pub fn dot(self, o: Self) -> f32x8 {
        self.0[0] * o.0[0] + self.0[1] * o.0[1] + self.0[2] * o.0[2]
    }

    /// This and `t` times another.
    #[inline(always)]
    pub fn plus(self, t: f32x8, o: Self) -> Self {
        Vec3x8(std::array::from_fn(|i| self.0[i] + t * o.0[i]))
    }

    /// The sum of all eight.
    #[inline(always)]
    pub fn sum(self) -> Vec3 {
        Vec3::from(self.0.map(sum))
    }
}

/// The sum of eight numbers, in one order on every machine.
#[inline(always)]
pub(super) fn sum(x: f32x8) -> f32 {
    let [a, b, c, d, e, f, g, h] = x.to_array();
    ((a + e) + (b + f)) + ((c + g) + (d + h))
}

/// The least of eight numbers.
#[inline(always)]
pub(super) fn least(x: f32x8) -> f32 {
    let [a, b, c, d, e, f, g, h] = x.to_array();
    let least = |a: f32, b: f32| if a < b { a } else { b };
    least(least(least(a, e), least(b, f)), least(least(c, g), least(d, h)))
}

/// Eight triangles, each about its first corner: the edges from there, and their products.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Triangles {
    pub ab: Vec3x8,
    pub ac: Vec3x8,
    bb: f32x8,
    bc: f32x8,
    cc: f32x8,
}

/// Where eight triangles are nearest to points.
pub(super) struct Nearest {
    /// Weights of the corners; exactly zero for those that the place is not near to.
    pub weights: [f32x8; 3],
    /// From the place to the point.
    pub step: Vec3x8,
}

impl Triangles {
    pub fn new(ab: Vec3x8, ac: Vec3x8) -> Self {
        Triangles { ab, ac, bb: ab.dot(ab), bc: ab.dot(ac), cc: ac.dot(ac) }
    }

    /// The places that are nearest to points, which are about the first corners: as
    /// [`nearest_to_origin`](super::ground::nearest_to_origin) finds them one by one.
    #[inline(always)]
    pub fn nearest(&self, p: Vec3x8) -> Nearest {
        let (zero, one) = (f32x8::ZERO, f32x8::ONE);
        let (d1, d2) = (self.ab.dot(p), self.ac.dot(p));
        let (d3, d4) = (d1 - self.bb, d2 - self.bc);
        let (d5, d6) = (d1 - self.bc, d2 - self.cc);
        let (vc, vb, va) = (d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4);
        let scale = one / (va + vb + vc);
        let (mut b, mut c) = (vb * scale, vc * scale);
        let mut a = one - b - c;
        let mut put = |is: f32x8, to: [f32x8; 3]| {
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
            let axes = |of: &[Vec3]| Vec3x8::from_axes(std::array::from_fn(|k| std::array::from_fn(|i| of[i][k])));
            let found = Triangles::new(axes(&b), axes(&c)).nearest(Vec3x8::splat(p));
            let (weights, distances_sq) = (found.weights.map(|w| w.to_array()), found.step.dot(found.step).to_array());
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
