//! What edges cost near the target, two at a time: by the same operations in the same order as [`Surface::candidate`] for
//! the usual policies, so the same to the last bit. One at a time an edge waits for its own divisions.

use super::place::{PULL, REACH};
use super::policy::{Placement, Quadrics, Weighting};
use super::surface::{STEP, Surface, at_most_refused, settled};
use super::{LEARNT_WEIGHT, Options};
use crate::cores::InPieces;
use crate::mesh::Coordinate;
use crate::quadric::{product, solve};
use rayon::prelude::*;
use wide::f64x2;

/// Edges that are evaluated together.
const LANES: usize = 2;

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
    }

    /// The faces at both `a` and `b`, if they are two.
    #[inline(always)]
    fn sides(&self, a: u32, b: u32) -> Option<[u32; 2]> {
        let mut shared = self.shared(&self.stars, a, b);
        let sides = [shared.next()?, shared.next()?];
        shared.next().is_none().then_some(sides)
    }

    #[inline(always)]
    fn evaluate_together(&self, edges: &[Edge; LANES], costs: &mut [f32]) {
        for (edge, cost) in edges.iter().zip(self.costs_of(edges)) {
            costs[edge.slot] = at_most_refused(self.pieces.price(edge.ends[0], settled::<S>(cost as f32)));
        }
    }

    /// What edges cost, of whatever piece.
    #[inline(always)]
    fn costs_of(&self, edges: &[Edge; LANES]) -> [f64; LANES] {
        let ends = [0, 1];
        let [pa, pb] = ends.map(|end| {
            [0, 1, 2].map(|axis| lanes(edges, |edge| self.positions[edge.ends[end] as usize][axis].widen()))
        });
        let half: Vector = std::array::from_fn(|axis| f64x2::splat(0.5) * (pb[axis] - pa[axis]));

        let [qa, qb] = ends.map(|end| {
            let learnt = |edge: &Edge| &self.learnt[edge.ends[end] as usize];
            Form {
                a: std::array::from_fn(|i| lanes(edges, |edge| f64::from(learnt(edge).a[i]))),
                b: std::array::from_fn(|i| lanes(edges, |edge| f64::from(learnt(edge).b[i]))),
                c: lanes(edges, |edge| f64::from(learnt(edge).c)),
            }
        });
        let (ga, gb) = (qa.product(&half), qb.product(&half));
        let gap: Vector = std::array::from_fn(|i| ga[i] + gb[i] + f64x2::splat(2.0) * (qa.b[i] - qb.b[i]));
        let learnt = Form {
            a: std::array::from_fn(|i| qa.a[i] + qb.a[i]),
            b: std::array::from_fn(|i| (qa.b[i] + qb.b[i]) + (ga[i] - gb[i])),
            c: (qa.c + qb.c) + dot(&gap, &half),
        };

        let [qa, qb] = ends.map(|end| {
            let a = std::array::from_fn(|i| lanes(edges, |edge| self.current[edge.ends[end] as usize][i].widen()));
            Form { a, ..Form::default() }
        });
        let (ga, gb) = (qa.product(&half), qb.product(&half));
        let both: Vector = std::array::from_fn(|i| ga[i] + gb[i]);
        let mut current = Form {
            a: std::array::from_fn(|i| qa.a[i] + qb.a[i]),
            b: std::array::from_fn(|i| ga[i] - gb[i]),
            c: dot(&both, &half),
        };
        for side in 0..2 {
            let m: Vector =
                std::array::from_fn(|axis| lanes(edges, |edge| self.roots[edge.faces[side] as usize][axis].widen()));
            let plane = [m[0] * m[0], m[0] * m[1], m[0] * m[2], m[1] * m[1], m[1] * m[2], m[2] * m[2]];
            current.a.iter_mut().zip(plane).for_each(|(x, y)| *x -= y);
        }

        let (step, mut cost) = current.best(&half);
        cost += f64x2::splat(LEARNT_WEIGHT) * learnt.value(&step);
        if S::DOUBLE {
            let weight = lanes(edges, |edge| {
                let [a, b] = edge.ends.map(|v| f64::from(self.learnt[v as usize].w));
                a + b
            });
            let most = f64x2::splat(STEP * (1u64 << 52) as f64) * (weight * dot(&half, &half));
            cost = (cost + most) - most;
        }
        cost.to_array()
    }
}

/// A number of each edge.
#[inline(always)]
fn lanes(edges: &[Edge; LANES], number: impl Fn(&Edge) -> f64) -> f64x2 {
    f64x2::new(edges.each_ref().map(number))
}

type Vector = [f64x2; 3];

#[inline(always)]
fn dot(x: &Vector, y: &Vector) -> f64x2 {
    x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
}

/// [`Quadric`](crate::quadric::Quadric)s side by side, without their weights.
#[derive(Clone, Copy, Default)]
struct Form {
    a: [f64x2; 6],
    b: Vector,
    c: f64x2,
}

impl Form {
    #[inline(always)]
    fn product(&self, x: &Vector) -> Vector {
        product(&self.a, *x)
    }

    #[inline(always)]
    fn value(&self, x: &Vector) -> f64x2 {
        let ax = self.product(x);
        let along: Vector = std::array::from_fn(|i| ax[i] + f64x2::splat(2.0) * self.b[i]);
        (dot(&along, x) + self.c).fast_max(f64x2::ZERO)
    }

    /// The best place for the ends of edges, which are `half` from the origin on either side, and its value: as
    /// [`optimal`](super::place::optimal) finds it.
    #[inline(always)]
    fn best(&self, half: &Vector) -> (Vector, f64x2) {
        let r = f64x2::splat(PULL) * (self.a[0] + self.a[3] + self.a[5]) * f64x2::splat(1.0 / 3.0);
        let (step, [first, second, third]) = solve(&self.a, r, self.b.map(|b| -b));
        let zero = f64x2::ZERO;
        let most = f64x2::splat((2.0 * REACH) * (2.0 * REACH)) * dot(half, half);
        // No number is not near either.
        let definite = first.simd_gt(zero) & second.simd_gt(zero) & third.simd_gt(zero);
        let near = definite & dot(&step, &step).simd_le(most);
        let cost = self.value(&step);
        if near.all() {
            return (step, cost);
        }
        let (mut best, mut least) = ([zero; 3], f64x2::splat(f64::INFINITY));
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

    fn together_is_alone<S: Coordinate>() {
        let options = Options::to(1);
        let mut surface = with_roots(bumps::<S>(), &options);
        assert!(surface.is_usual(&options));
        surface.evaluate(&options, |_| false);
        let (mut together, mut elsewhere) = (0, 0);
        for (face, costs) in surface.faces.iter().zip(&surface.costs) {
            for (i, cost) in costs.iter().enumerate() {
                let (a, b) = (face[i], face[(i + 1) % 3]);
                if surface.answers_for(a, b) {
                    assert_eq!(*cost, surface.cost(&surface.stars, a, b, &options), "{a} {b}");
                    together += usize::from(surface.sides(a, b).is_some());
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
        for quadrics in [[bent, bent], [bent, skew], [skew, bent], [skew, skew], [Quadric::default(), bent]] {
            let number = |of: &dyn Fn(&Quadric) -> f64| f64x2::new(quadrics.each_ref().map(of));
            let form = Form {
                a: std::array::from_fn(|i| number(&|q| q.a[i])),
                b: std::array::from_fn(|i| number(&|q| q.b[i])),
                c: number(&|q| q.c),
            };
            let (steps, costs) = form.best(&half.to_array().map(f64x2::splat));
            for (lane, q) in quadrics.iter().enumerate() {
                let alone = optimal(q, DVec3::ZERO, [half, -half]);
                assert_eq!(steps.map(|along| along.to_array()[lane]), alone.step.to_array());
                assert_eq!(costs.to_array()[lane], alone.cost);
            }
        }
        let far = skew.minimiser(DVec3::ZERO, PULL).unwrap();
        assert!(far.length() > 2.0 * REACH * half.length(), "{far}");
    }

    #[test]
    fn edges_cost_the_same_together_and_alone() {
        together_is_alone::<f32>();
        together_is_alone::<f64>();
    }
}
