//! Noise that every machine agrees on: additions, multiplications, divisions and square roots only.

use crate::mesh::mix;
use glam::DVec3;

const SIDE: usize = 64;

/// Periodic value noise on a lattice, smooth to the second derivative, in `[-1, 1]`.
pub(super) struct Lattice {
    values: Vec<f32>,
}

/// A number in `[-1, 1)` for every number.
#[inline]
pub(super) fn signed_unit(x: u64) -> f64 {
    (mix(x) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

impl Lattice {
    /// The lattice of a seed.
    pub(super) fn new(seed: u64) -> Self {
        let base = mix(seed);
        Lattice { values: (0..SIDE.pow(3) as u64).map(|i| signed_unit(base.wrapping_add(i)) as f32).collect() }
    }

    /// Noise of wavelength one at `p`; `octave` shifts it, so that octaves do not repeat one another at the origin.
    #[inline]
    pub(super) fn at(&self, p: DVec3, octave: u32) -> f64 {
        // A rotation: no octave shows the axes of the lattice along the axes of the figure.
        const THIRD: f64 = 1.0 / 3.0;
        let q = DVec3::new(2.0 * p.x - p.y + 2.0 * p.z, 2.0 * p.x + 2.0 * p.y - p.z, 2.0 * p.y + 2.0 * p.z - p.x);
        // Positive, so that cutting off is rounding down.
        let q = q * THIRD + DVec3::splat(65536.0 + 17.31 * f64::from(octave));
        let cell = q.as_ivec3();
        let f = q - cell.as_dvec3();
        let f = f * f * f * (f * (f * 6.0 - DVec3::splat(15.0)) + DVec3::splat(10.0));
        let wrap = |i: i32| i as usize & (SIDE - 1);
        let (x0, x1) = (wrap(cell.x) * SIDE * SIDE, wrap(cell.x + 1) * SIDE * SIDE);
        let (y0, y1) = (wrap(cell.y) * SIDE, wrap(cell.y + 1) * SIDE);
        let (z0, z1) = (wrap(cell.z), wrap(cell.z + 1));
        let value = |i: usize| f64::from(self.values[i & (SIDE * SIDE * SIDE - 1)]);
        let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
        let plane = |z: usize| {
            let low = mix(value(x0 + y0 + z), value(x1 + y0 + z), f.x);
            let high = mix(value(x0 + y1 + z), value(x1 + y1 + z), f.x);
            mix(low, high, f.y)
        };
        mix(plane(z0), plane(z1), f.z)
    }

    /// Ridges: 1 along the lines where the noise is nought, falling off on both sides; in `[0, 1]`.
    #[inline]
    pub(super) fn ridge(&self, p: DVec3, octave: u32) -> f64 {
        let n = self.at(p, octave);
        // Steep near the line, yet smooth across it.
        1.0 / (1.0 + 24.0 * n * n)
    }
}

/// 0 below `low`, 1 above `high`, smooth between.
#[inline]
pub(super) fn ramp(x: f64, low: f64, high: f64) -> f64 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_bounded_continuous_and_bound_to_its_seed() {
        let (one, other) = (Lattice::new(1), Lattice::new(2));
        let (mut least, mut largest) = (0.0f64, 0.0f64);
        for i in 0..20_000 {
            let p = DVec3::new(f64::from(i) * 0.013, f64::from(i % 977) * 0.11 - 50.0, f64::from(i % 31));
            let n = one.at(p, 3);
            (least, largest) = (least.min(n), largest.max(n));
            assert!((n - one.at(p + DVec3::splat(1e-7), 3)).abs() < 1e-5);
        }
        assert!(least > -1.0 && largest < 1.0 && largest - least > 1.5, "{least} {largest}");
        assert_ne!(one.at(DVec3::splat(0.3), 0), other.at(DVec3::splat(0.3), 0));
        assert_eq!(one.at(DVec3::splat(0.3), 0), Lattice::new(1).at(DVec3::splat(0.3), 0));
    }
}
