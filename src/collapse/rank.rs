//! How far from the target edges are told apart: by what their ends have learnt, four edges at a time.

use super::surface::{STEP, Surface, at_most_refused, settled};
use crate::mesh::{Coordinate, step};
use crate::quadric::PackedQuadric;
use glam::Vec3;
use wide::f32x4;

/// Edges that are ranked together.
pub(super) const LANES: usize = 4;

impl<S: Coordinate> Surface<S> {
    /// What edges from `v` cost for what their ends have learnt: the best of the middle and the ends stands for the optimum.
    /// That is less work, and E_avg was no higher on any of nine models tried. The same from either end.
    #[inline(always)]
    pub fn ranks(&self, v: u32, to: [u32; LANES]) -> [f32; LANES] {
        let steps = to.map(|u| step(self.positions[v as usize], self.positions[u as usize]));
        let mut costs = least_of_three::<S>(&self.learnt[v as usize], to.map(|u| &self.learnt[u as usize]), steps);
        if self.is_shaded() {
            costs += f32x4::from(to.map(|u| self.shade_rank(v, u)));
        }
        costs.to_array().map(|cost| at_most_refused(settled::<S>(cost)))
    }
}

/// Four of the numbers that each edge has, from the `first` on, side by side.
#[inline(always)]
pub(super) fn columns<const N: usize>(numbers: [&[f32; N]; LANES], first: usize) -> [f32x4; 4] {
    f32x4::transpose(numbers.map(|of| f32x4::new(std::array::from_fn(|i| of[first + i]))))
}

/// The least values of sums of quadrics, of `p` with each of some others `steps` away, at the middles between their origins
/// and at both of them. In single precision, like the quadrics: it only ranks.
#[inline(always)]
fn least_of_three<S: Coordinate>(p: &PackedQuadric, others: [&PackedQuadric; LANES], steps: [Vec3; LANES]) -> f32x4 {
    let numbers = others.map(bytemuck::cast_ref);
    let [[xx, xy, xz, yy], [yz, zz, bx, by], [_, bz, c, w]] = [0, 4, 7].map(|first| columns::<11>(numbers, first));
    let [x, y, z] = [0, 1, 2].map(|axis| f32x4::new(steps.map(|step| step[axis])) * f32x4::splat(0.5));
    let two = f32x4::splat(2.0);
    let s = [x * x, two * x * y, two * x * z, y * y, two * y * z, z * z];
    let form =
        |a: [f32x4; 6]| ((a[0] * s[0] + a[1] * s[1]) + (a[2] * s[2] + a[3] * s[3])) + (a[4] * s[4] + a[5] * s[5]);
    let along = |b: [f32x4; 3]| two * (b[0] * x + b[1] * y + b[2] * z);
    // p at its own origin is c, in the middle c + 2b·h + hᵀAh, at q's origin c + 4b·h + 4hᵀAh; q likewise towards −h.
    let (pb, qb) = (along(p.b.map(f32x4::splat)), -along([bx, by, bz]));
    let (pa, qa) = (form(p.a.map(f32x4::splat)), form([xx, xy, xz, yy, yz, zz]));
    let middle = (pb + qb) + (pa + qa);
    let at_p = two * qb + f32x4::splat(4.0) * qa;
    let at_q = two * pb + f32x4::splat(4.0) * pa;
    let mut cost = f32x4::splat(p.c) + c + middle.fast_min(at_p.fast_min(at_q));
    if S::DOUBLE {
        let most = f32x4::splat((STEP * (1u64 << 23) as f64) as f32) * (f32x4::splat(p.w) + w) * (s[0] + s[3] + s[5]);
        cost = (cost + most) - most;
    }
    cost.fast_max(f32x4::ZERO)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collapse::surface::tests::{MIDDLE, bumps};
    use glam::DVec3;

    fn ranks_are_least_of_three<S: Coordinate>() {
        let surface = bumps::<S>();
        for to in [[6, 7, 11, 13], [17, 18, 18, 18]] {
            let ranks = surface.ranks(MIDDLE, to);
            for (rank, u) in ranks.into_iter().zip(to) {
                let (p, q) = (surface.at(MIDDLE), surface.at(u));
                let value = |x: DVec3| surface.merged(&[MIDDLE, u], x).c;
                let least = value(p).min(value(q)).min(value(0.5 * (p + q)));
                assert!(least > 1e-6 && (f64::from(rank) - least).abs() < 1e-4 * least, "{rank} {least}");
                assert_eq!(surface.ranks(u, [MIDDLE; LANES])[3], rank, "either end says the same");
            }
        }
    }

    #[test]
    fn edges_are_ranked_by_the_best_of_the_middle_and_the_ends() {
        ranks_are_least_of_three::<f32>();
        ranks_are_least_of_three::<f64>();
    }
}
