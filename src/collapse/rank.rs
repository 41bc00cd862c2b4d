//! How far from the target edges are told apart: by what their ends have learnt, eight edges at a time.

use super::surface::{STEP, Surface, at_most_refused, settled};
use crate::mesh::{Coordinate, step};
use crate::quadric::PackedQuadric;
use crate::vectors::transposed;
use fearless_simd::{Simd, f32x4, f32x8, prelude::*};
use glam::Vec3;

/// Edges that are ranked together.
pub(super) const LANES: usize = 8;

impl<S: Coordinate> Surface<S> {
    /// What edges from `v` cost for what their ends have learnt: the best of the middle and the ends stands for the optimum.
    /// That is less work, and E_avg was no higher on any of nine models tried. The same from either end.
    #[inline(always)]
    pub fn ranks<V: Simd>(&self, simd: V, v: u32, to: [u32; LANES]) -> [f32; LANES] {
        let steps = to.map(|u| step(self.positions[v as usize], self.positions[u as usize]));
        let others = to.map(|u| &self.learnt[u as usize]);
        let mut costs = least_of_three::<S, V>(simd, &self.learnt[v as usize], others, steps);
        if self.is_shaded() {
            costs += f32x8::load_array(simd, to.map(|u| self.shade_rank(v, u)));
        }
        costs.to_array().map(|cost| at_most_refused(settled::<S>(cost)))
    }
}

/// Four of the numbers that each edge has, from the `first` on, side by side.
#[inline(always)]
pub(super) fn columns<V: Simd, const N: usize>(simd: V, numbers: [&[f32; N]; LANES], first: usize) -> [f32x8<V>; 4] {
    let mut rows = [f32x4::splat(simd, 0.0); LANES];
    for (row, of) in rows.iter_mut().zip(numbers) {
        *row = f32x4::from_slice(simd, &of[first..first + 4]);
    }
    let [a, b, c, d, e, f, g, h] = rows;
    let ([a, b, c, d], [e, f, g, h]) = (transposed([a, b, c, d]), transposed([e, f, g, h]));
    [a.combine(e), b.combine(f), c.combine(g), d.combine(h)]
}

/// The least values of sums of quadrics, of `p` with each of some others `steps` away, at the middles between their origins
/// and at both of them. In single precision, like the quadrics: it only ranks.
#[inline(always)]
fn least_of_three<S: Coordinate, V: Simd>(
    simd: V,
    p: &PackedQuadric,
    others: [&PackedQuadric; LANES],
    steps: [Vec3; LANES],
) -> f32x8<V> {
    let numbers = others.map(bytemuck::cast_ref);
    let [xx, xy, xz, yy] = columns::<V, 11>(simd, numbers, 0);
    let [yz, zz, bx, by] = columns::<V, 11>(simd, numbers, 4);
    let [_, bz, c, w] = columns::<V, 11>(simd, numbers, 7);
    let of = |x: f32| f32x8::splat(simd, x);
    let half = |axis: usize| f32x8::load_array(simd, steps.map(|step| step[axis])) * of(0.5);
    let [x, y, z] = [half(0), half(1), half(2)];
    let two = of(2.0);
    let s = [x * x, two * x * y, two * x * z, y * y, two * y * z, z * z];
    let form =
        |a: [f32x8<V>; 6]| ((a[0] * s[0] + a[1] * s[1]) + (a[2] * s[2] + a[3] * s[3])) + (a[4] * s[4] + a[5] * s[5]);
    let along = |b: [f32x8<V>; 3]| two * (b[0] * x + b[1] * y + b[2] * z);
    // p at its own origin is c, in the middle c + 2b·h + hᵀAh, at q's origin c + 4b·h + 4hᵀAh; q likewise towards −h.
    let (pb, qb) = (along([of(p.b[0]), of(p.b[1]), of(p.b[2])]), -along([bx, by, bz]));
    let (pa, qa) = (
        form([of(p.a[0]), of(p.a[1]), of(p.a[2]), of(p.a[3]), of(p.a[4]), of(p.a[5])]),
        form([xx, xy, xz, yy, yz, zz]),
    );
    let middle = (pb + qb) + (pa + qa);
    let at_p = two * qb + of(4.0) * qa;
    let at_q = two * pb + of(4.0) * pa;
    let mut cost = of(p.c) + c + middle.min(at_p.min(at_q));
    if S::DOUBLE {
        let most = of((STEP * (1u64 << 23) as f64) as f32) * (of(p.w) + w) * (s[0] + s[3] + s[5]);
        cost = (cost + most) - most;
    }
    cost.max(of(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collapse::surface::tests::{MIDDLE, bumps};
    use crate::vectors::levels;
    use fearless_simd::dispatch;
    use glam::DVec3;

    fn ranks_are_least_of_three<S: Coordinate>() {
        let surface = bumps::<S>();
        let to = [6, 7, 11, 13, 17, 18, 18, 18];
        let narrowest = dispatch!(levels()[0], simd => surface.ranks(simd, MIDDLE, to));
        for level in levels() {
            let ranks = dispatch!(level, simd => surface.ranks(simd, MIDDLE, to));
            assert_eq!(ranks, narrowest, "the width of vectors shows");
            for (rank, u) in ranks.into_iter().zip(to) {
                let (p, q) = (surface.at(MIDDLE), surface.at(u));
                let value = |x: DVec3| surface.merged(&[MIDDLE, u], x).c;
                let least = value(p).min(value(q)).min(value(0.5 * (p + q)));
                assert!(least > 1e-6 && (f64::from(rank) - least).abs() < 1e-4 * least, "{rank} {least}");
                let back = dispatch!(level, simd => surface.ranks(simd, u, [MIDDLE; LANES]));
                assert_eq!(back[3], rank, "either end says the same");
            }
        }
    }

    #[test]
    fn edges_are_ranked_by_the_best_of_the_middle_and_the_ends() {
        ranks_are_least_of_three::<f32>();
        ranks_are_least_of_three::<f64>();
    }
}
