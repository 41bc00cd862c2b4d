//! What edges cost near the target, four at a time: what [`Surface::candidate`] says for the usual policies, in single
//! precision like the quadrics. It only ranks: where the vertex goes is worked out in doubles once an edge is taken. One at a
//! time an edge waits for its own divisions. Scans in doubles, whose ties must not be left to rounding, have it so.

use super::place::{PULL, REACH};
use super::policy::{Placement, Quadrics, Weighting};
use super::rank::{LANES, columns};
use super::surface::{Surface, at_most_refused};
use super::{LEARNT_WEIGHT, Options};
use crate::cores::InPieces;
use crate::mesh::{Coordinate, step};
use crate::quadric::{product, solve};
use rayon::prelude::*;
use wide::f32x4;

/// Faces whose edges are evaluated by one task.
const FACES: usize = 1 << 8;

/// An edge with a face on either side.
#[derive(Clone, Copy, Default)]
struct Edge {
    ends: [u32; 2],
    faces: [u32; 2],
    /// Where its cost goes.
    slot: usize,
}

impl<S: Coordinate> Surface<S> {
    /// Fills the costs of all edges for which `stale` says that they must be computed again: all where there are none.
    pub fn evaluate(&mut self, options: &Options, stale: impl Fn(u8) -> bool + Sync) {
        let mut costs = std::mem::take(&mut self.costs);
        let none = costs.is_empty();
        costs.resize(self.faces.len(), [0.0; 3]);
        let this = &*self;
        let usual = this.is_usual(options);
        this.faces.par_chunks(FACES).zip(costs.par_chunks_mut(FACES)).in_pieces(1).for_each(|(faces, costs)| {
            let (mut edges, mut waiting) = ([Edge::default(); LANES], 0);
            let costs = costs.as_flattened_mut();
            for (slot, (a, b)) in faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).enumerate() {
                if !this.answers_for(a, b) {
                    costs[slot] = f32::INFINITY;
                } else if none || stale(this.mark(a) | this.mark(b)) {
                    match usual.then(|| this.sides(a, b)).flatten() {
                        None => costs[slot] = this.cost(&this.stars, a, b, options),
                        Some(faces) => {
                            edges[waiting] = Edge { ends: [a, b], faces, slot };
                            waiting += 1;
                        }
                    }
                    if waiting == LANES {
                        this.evaluate_together(&edges, costs);
                        waiting = 0;
                    }
                }
            }
            if waiting > 0 {
                let last = edges[waiting - 1];
                edges[waiting..].fill(last);
                this.evaluate_together(&edges, costs);
            }
        });
        self.costs = costs;
    }

    /// Whether nothing but the current faces, and what was learnt, decides what edges with two faces cost.
    fn is_usual(&self, options: &Options) -> bool {
        let policies = &options.policies;
        policies.quadrics == Quadrics::Current
            && policies.weighting == Weighting::Area
            && policies.placement == Placement::Optimal
            && policies.features.is_none()
            && !policies.penalises()
            && !options.locks()
            && !self.is_shaded()
            && !self.is_seamed()
            && !self.roots.is_empty()
            && !S::DOUBLE
    }

    /// The faces at both `a` and `b`, if they are two. Which of a star's they are no processor can predict, so they are found
    /// without a branch.
    #[inline(always)]
    fn sides(&self, a: u32, b: u32) -> Option<[u32; 2]> {
        let (mut first, mut last, mut count) = (u32::MAX, 0, 0);
        for &corner in self.stars.of(a) {
            let (f, (p, q)) = (corner >> 2, self.ends(corner));
            let has_b = (p == b) | (q == b);
            first = first.min(if has_b { f } else { u32::MAX });
            last = if has_b { f } else { last };
            count += u32::from(has_b);
        }
        (count == 2).then_some([first, last])
    }

    #[inline(always)]
    fn evaluate_together(&self, edges: &[Edge; LANES], costs: &mut [f32]) {
        for (edge, cost) in edges.iter().zip(self.costs_of(edges)) {
            costs[edge.slot] = at_most_refused(self.pieces.price(edge.ends[0], cost));
        }
    }

    /// What edges cost, of whatever piece.
    #[inline(always)]
    fn costs_of(&self, edges: &[Edge; LANES]) -> [f32; LANES] {
        let steps = edges.map(|Edge { ends: [a, b], .. }| step(self.positions[a as usize], self.positions[b as usize]));
        let half: Vector = [0, 1, 2].map(|axis| f32x4::splat(0.5) * f32x4::new(steps.map(|step| step[axis])));

        let [qa, qb] = [0, 1].map(|end| {
            let numbers = edges.each_ref().map(|edge| bytemuck::cast_ref(&self.learnt[edge.ends[end] as usize]));
            let [[xx, xy, xz, yy], [yz, zz, bx, by], [_, bz, c, _]] =
                [0, 4, 7].map(|first| columns::<11>(numbers, first));
            Form { a: [xx, xy, xz, yy, yz, zz], b: [bx, by, bz], c }
        });
        let (ga, gb) = (qa.product(&half), qb.product(&half));
        let gap: Vector = std::array::from_fn(|i| ga[i] + gb[i] + f32x4::splat(2.0) * (qa.b[i] - qb.b[i]));
        let learnt = Form {
            a: std::array::from_fn(|i| qa.a[i] + qb.a[i]),
            b: std::array::from_fn(|i| (qa.b[i] + qb.b[i]) + (ga[i] - gb[i])),
            c: (qa.c + qb.c) + dot(&gap, &half),
        };

        let [qa, qb] = [0, 1].map(|end| {
            let numbers = edges.map(|edge| self.current[edge.ends[end] as usize].map(narrow));
            let [[xx, xy, xz, yy], [_, _, yz, zz]] = [0, 2].map(|first| columns(numbers.each_ref(), first));
            Form { a: [xx, xy, xz, yy, yz, zz], ..Form::default() }
        });
        let (ga, gb) = (qa.product(&half), qb.product(&half));
        let both: Vector = std::array::from_fn(|i| ga[i] + gb[i]);
        let mut current = Form {
            a: std::array::from_fn(|i| qa.a[i] + qb.a[i]),
            b: std::array::from_fn(|i| ga[i] - gb[i]),
            c: dot(&both, &half),
        };
        for side in 0..2 {
            let roots = edges.map(|edge| self.roots[edge.faces[side] as usize].map(narrow));
            let m: Vector = [0, 1, 2].map(|axis| f32x4::new(roots.map(|root| root[axis])));
            let plane = [m[0] * m[0], m[0] * m[1], m[0] * m[2], m[1] * m[1], m[1] * m[2], m[2] * m[2]];
            current.a.iter_mut().zip(plane).for_each(|(x, y)| *x -= y);
        }

        let (step, cost) = current.best(&half);
        (cost + f32x4::splat(LEARNT_WEIGHT as f32) * learnt.value(&step)).to_array()
    }
}

/// A number in single precision, as it is but in scans that are not evaluated here.
#[inline(always)]
fn narrow<S: Coordinate>(x: S) -> f32 {
    x.widen() as f32
}

type Vector = [f32x4; 3];

#[inline(always)]
fn dot(x: &Vector, y: &Vector) -> f32x4 {
    x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
}

/// [`Quadric`](crate::quadric::Quadric)s side by side, without their weights.
#[derive(Clone, Copy, Default)]
struct Form {
    a: [f32x4; 6],
    b: Vector,
    c: f32x4,
}

impl Form {
    #[inline(always)]
    fn product(&self, x: &Vector) -> Vector {
        product(&self.a, *x)
    }

    #[inline(always)]
    fn value(&self, x: &Vector) -> f32x4 {
        let ax = self.product(x);
        let along: Vector = std::array::from_fn(|i| ax[i] + f32x4::splat(2.0) * self.b[i]);
        (dot(&along, x) + self.c).fast_max(f32x4::ZERO)
    }

    /// The best place for the ends of edges, which are `half` from the origin on either side, and its value: as
    /// [`optimal`](super::place::optimal) finds it.
    #[inline(always)]
    fn best(&self, half: &Vector) -> (Vector, f32x4) {
        let r = f32x4::splat((PULL / 3.0) as f32) * (self.a[0] + self.a[3] + self.a[5]);
        let (step, [first, second, third]) = solve(&self.a, r, self.b.map(|b| -b));
        let zero = f32x4::ZERO;
        let most = f32x4::splat((4.0 * REACH * REACH) as f32) * dot(half, half);
        // No number is not near either.
        let definite = first.simd_gt(zero) & second.simd_gt(zero) & third.simd_gt(zero);
        let near = definite & dot(&step, &step).simd_le(most);
        let cost = self.value(&step);
        if near.all() {
            return (step, cost);
        }
        let (mut best, mut least) = ([zero; 3], f32x4::splat(f32::INFINITY));
        for place in [[zero; 3], *half, half.map(|x| -x)] {
            let cost = self.value(&place);
            let less = cost.simd_lt(least);
            best = std::array::from_fn(|axis| less.select(place[axis], best[axis]));
            least = less.select(cost, least);
        }
        (std::array::from_fn(|axis| near.select(step[axis], best[axis])), near.select(cost, least))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collapse::place::optimal;
    use crate::collapse::surface::TOUCHED;
    use crate::collapse::surface::tests::{bumps, with_roots};
    use crate::quadric::Quadric;
    use glam::DVec3;
    use std::sync::atomic::Ordering::Relaxed;

    #[test]
    fn edges_cost_together_what_they_cost_alone() {
        let options = Options::to(1);
        let mut surface = with_roots(bumps::<f32>(), &options);
        assert!(surface.is_usual(&options) && !with_roots(bumps::<f64>(), &options).is_usual(&options));
        surface.evaluate(&options, |_| false);
        let (mut together, mut elsewhere) = (0, 0);
        for (face, costs) in surface.faces.iter().zip(&surface.costs) {
            for (i, cost) in costs.iter().enumerate() {
                let (a, b) = (face[i], face[(i + 1) % 3]);
                if surface.answers_for(a, b) {
                    let alone = surface.cost(&surface.stars, a, b, &options);
                    assert!((cost - alone).abs() < 1e-5 * alone.max(1e-6), "{a} {b}: {cost} {alone}");
                    together += usize::from(alone > 1e-6 && surface.sides(a, b).is_some());
                } else {
                    assert_eq!(*cost, f32::INFINITY);
                    elsewhere += 1;
                }
            }
        }
        assert!(together > 30 && elsewhere > 30, "{together} {elsewhere}");

        // One edge, that from the corner across its square, is too few for all lanes.
        let all = std::mem::replace(&mut surface.costs, vec![[7.0; 3]; surface.faces.len()]);
        surface.marks[0].fetch_or(TOUCHED, Relaxed);
        surface.evaluate(&options, |marks| marks & TOUCHED != 0);
        for (f, face) in surface.faces.iter().enumerate() {
            for i in 0..3 {
                let (a, b) = (face[i], face[(i + 1) % 3]);
                let again = surface.answers_for(a, b) && a.min(b) > 0;
                assert_eq!(surface.costs[f][i], if again { 7.0 } else { all[f][i] }, "{a} {b}");
            }
        }
    }

    #[test]
    fn what_is_far_away_is_not_the_best_place() {
        let half = DVec3::new(0.25, 0.5, -0.125);
        let plane = |x: f64, y: f64, z: f64, d: f64| Quadric::plane(DVec3::new(x, y, z).normalize(), d, 2.0);
        let bent = plane(1.0, 0.0, 0.0, -0.1) + plane(0.0, 1.0, 0.0, 0.2) + plane(0.0, 0.0, 1.0, 0.1);
        let skew = plane(1.0, 0.0, 0.0, -0.1) + plane(1.0, 0.05, 0.0, 3.0) + plane(0.0, 0.0, 1.0, 0.1);
        for quadrics in
            [[bent; 4], [bent, skew, bent, bent], [skew, bent, bent, skew], [skew; 4], [Quadric::default(); 4]]
        {
            let number = |of: &dyn Fn(&Quadric) -> f64| f32x4::new(quadrics.each_ref().map(|q| of(q) as f32));
            let form = Form {
                a: std::array::from_fn(|i| number(&|q| q.a[i])),
                b: std::array::from_fn(|i| number(&|q| q.b[i])),
                c: number(&|q| q.c),
            };
            let (steps, costs) = form.best(&half.to_array().map(|x| f32x4::splat(x as f32)));
            for (lane, q) in quadrics.iter().enumerate() {
                let alone = optimal(q, DVec3::ZERO, [half, -half]);
                let step = DVec3::from(steps.map(|along| f64::from(along.to_array()[lane])));
                assert!((step - alone.step).length() < 1e-5, "{step} {}", alone.step);
                assert!((f64::from(costs.to_array()[lane]) - alone.cost).abs() < 1e-5 * alone.cost.max(0.01));
            }
        }
        let far = skew.minimiser(DVec3::ZERO, PULL).unwrap();
        assert!(far.length() > 2.0 * REACH * half.length(), "{far}");
    }
}
