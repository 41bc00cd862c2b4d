//! What edges cost near the target, eight at a time: what [`Surface::candidate`] says for the usual policies, in single
//! precision like the quadrics. It only ranks: where the vertex goes is worked out in doubles once an edge is taken. One at a
//! time an edge waits for its own divisions. Scans in doubles, whose ties must not be left to rounding, have it so.

use super::place::{PULL, REACH};
use super::policy::{Placement, Quadrics, Weighting};
use super::rank::{LANES, columns};
use super::surface::{LOCKED, Surface, at_most_refused};
use super::{LEARNT_WEIGHT, Options};
use crate::cores::InPieces;
use crate::mesh::{Coordinate, step};
use crate::quadric::{product, solve};
use fearless_simd::{Level, Simd, dispatch, f32x8, mask32x8, prelude::*};
use rayon::prelude::*;

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
        let stale = |marks: u8| none || stale(marks);
        this.faces.par_chunks(FACES).zip(costs.par_chunks_mut(FACES)).in_pieces(1).for_each(|(faces, costs)| {
            let costs = costs.as_flattened_mut();
            dispatch!(Level::new(), simd => this.evaluate_some(simd, (faces, costs), usual, options, stale));
        });
        self.costs = costs;
    }

    /// The same of the edges of some faces.
    #[inline(always)]
    fn evaluate_some<V: Simd>(
        &self,
        simd: V,
        (faces, costs): (&[[u32; 3]], &mut [f32]),
        usual: bool,
        options: &Options,
        stale: impl Fn(u8) -> bool,
    ) {
        let (mut edges, mut waiting) = ([Edge::default(); LANES], 0);
        for (slot, (a, b)) in faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).enumerate() {
            if !self.answers_for(a, b) {
                costs[slot] = f32::INFINITY;
                continue;
            }
            let marks = self.mark(a) | self.mark(b);
            if stale(marks) {
                // A locked vertex stays: there is no place to look for.
                let free = usual && marks & LOCKED == 0;
                match free.then(|| self.sides(a, b)).flatten() {
                    None => costs[slot] = self.cost(&self.stars, a, b, options),
                    Some(faces) => {
                        edges[waiting] = Edge { ends: [a, b], faces, slot };
                        waiting += 1;
                    }
                }
                if waiting == LANES {
                    self.evaluate_together(simd, &edges, costs);
                    waiting = 0;
                }
            }
        }
        if waiting > 0 {
            let last = edges[waiting - 1];
            edges[waiting..].fill(last);
            self.evaluate_together(simd, &edges, costs);
        }
    }

    /// Whether nothing but the current faces, and what was learnt, decides what edges with two faces cost.
    fn is_usual(&self, options: &Options) -> bool {
        let policies = &options.policies;
        policies.quadrics == Quadrics::Current
            && policies.weighting == Weighting::Area
            && policies.placement == Placement::Optimal
            && policies.features.is_none()
            && !policies.penalises()
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
            let f = corner >> 2;
            let has_b = self.has(f, b);
            first = first.min(if has_b { f } else { u32::MAX });
            last = if has_b { f } else { last };
            count += u32::from(has_b);
        }
        (count == 2).then_some([first, last])
    }

    #[inline(always)]
    fn evaluate_together<V: Simd>(&self, simd: V, edges: &[Edge; LANES], costs: &mut [f32]) {
        for (edge, cost) in edges.iter().zip(self.costs_of(simd, edges)) {
            costs[edge.slot] = at_most_refused(self.pieces.price(edge.ends[0], cost));
        }
    }

    /// What edges cost, of whatever piece.
    #[inline(always)]
    fn costs_of<V: Simd>(&self, simd: V, edges: &[Edge; LANES]) -> [f32; LANES] {
        let steps = edges.map(|Edge { ends: [a, b], .. }| step(self.positions[a as usize], self.positions[b as usize]));
        let half = scaled(f32x8::splat(simd, 0.5), vector(simd, steps.map(|step| step.to_array())));
        let current = self.current_forms(simd, edges, &half);
        let (step, cost) = current.best(simd, &half);
        let learnt = self.learnt_forms(simd, edges, &half);
        (cost + f32x8::splat(simd, LEARNT_WEIGHT as f32) * learnt.value(simd, &step)).to_array()
    }

    /// What both ends of edges have learnt, about the middles.
    #[inline(always)]
    fn learnt_forms<V: Simd>(&self, simd: V, edges: &[Edge; LANES], half: &Vector<V>) -> Form<V> {
        let (qa, qb) = (self.learnt_form_at(simd, edges, 0), self.learnt_form_at(simd, edges, 1));
        let (ga, gb) = (qa.product(half), qb.product(half));
        let two = f32x8::splat(simd, 2.0);
        let gap = added(added(ga, gb), scaled(two, subtracted(qa.b, qb.b)));
        Form {
            a: summed(qa.a, qb.a),
            b: added(added(qa.b, qb.b), subtracted(ga, gb)),
            c: (qa.c + qb.c) + dot(&gap, half),
        }
    }

    #[inline(always)]
    fn learnt_form_at<V: Simd>(&self, simd: V, edges: &[Edge; LANES], end: usize) -> Form<V> {
        let numbers = edges.each_ref().map(|edge| bytemuck::cast_ref(&self.learnt[edge.ends[end] as usize]));
        let [xx, xy, xz, yy] = columns::<V, 11>(simd, numbers, 0);
        let [yz, zz, bx, by] = columns::<V, 11>(simd, numbers, 4);
        let [_, bz, c, _] = columns::<V, 11>(simd, numbers, 7);
        Form { a: [xx, xy, xz, yy, yz, zz], b: [bx, by, bz], c }
    }

    /// The current faces around both ends of edges, each once, about the middles.
    #[inline(always)]
    fn current_forms<V: Simd>(&self, simd: V, edges: &[Edge; LANES], half: &Vector<V>) -> Form<V> {
        let (qa, qb) = (self.current_form_at(simd, edges, 0), self.current_form_at(simd, edges, 1));
        let (ga, gb) = (qa.product(half), qb.product(half));
        let mut a = summed(qa.a, qb.a);
        for side in 0..2 {
            let roots = edges.map(|edge| self.roots[edge.faces[side] as usize].map(narrow));
            let m = vector(simd, roots);
            let plane = [m[0] * m[0], m[0] * m[1], m[0] * m[2], m[1] * m[1], m[1] * m[2], m[2] * m[2]];
            for (x, y) in a.iter_mut().zip(plane) {
                *x -= y;
            }
        }
        Form { a, b: subtracted(ga, gb), c: dot(&added(ga, gb), half) }
    }

    #[inline(always)]
    fn current_form_at<V: Simd>(&self, simd: V, edges: &[Edge; LANES], end: usize) -> Form<V> {
        let numbers = edges.map(|edge| self.current[edge.ends[end] as usize].map(narrow));
        let [xx, xy, xz, yy] = columns(simd, numbers.each_ref(), 0);
        let [_, _, yz, zz] = columns(simd, numbers.each_ref(), 2);
        let none = f32x8::splat(simd, 0.0);
        Form { a: [xx, xy, xz, yy, yz, zz], b: [none; 3], c: none }
    }
}

/// A number in single precision, as it is but in scans that are not evaluated here.
#[inline(always)]
fn narrow<S: Coordinate>(x: S) -> f32 {
    x.widen() as f32
}

pub(super) type Vector<V> = [f32x8<V>; 3];

/// Vectors side by side.
#[inline(always)]
fn vector<V: Simd>(simd: V, of: [[f32; 3]; LANES]) -> Vector<V> {
    let along = |axis: usize| f32x8::load_array(simd, of.map(|v| v[axis]));
    [along(0), along(1), along(2)]
}

#[inline(always)]
fn added<V: Simd>(x: Vector<V>, y: Vector<V>) -> Vector<V> {
    [x[0] + y[0], x[1] + y[1], x[2] + y[2]]
}

#[inline(always)]
fn subtracted<V: Simd>(x: Vector<V>, y: Vector<V>) -> Vector<V> {
    [x[0] - y[0], x[1] - y[1], x[2] - y[2]]
}

#[inline(always)]
fn scaled<V: Simd>(t: f32x8<V>, x: Vector<V>) -> Vector<V> {
    [t * x[0], t * x[1], t * x[2]]
}

#[inline(always)]
fn summed<V: Simd>(x: [f32x8<V>; 6], y: [f32x8<V>; 6]) -> [f32x8<V>; 6] {
    [x[0] + y[0], x[1] + y[1], x[2] + y[2], x[3] + y[3], x[4] + y[4], x[5] + y[5]]
}

#[inline(always)]
fn chosen<V: Simd>(is: mask32x8<V>, x: Vector<V>, y: Vector<V>) -> Vector<V> {
    [is.select(x[0], y[0]), is.select(x[1], y[1]), is.select(x[2], y[2])]
}

#[inline(always)]
pub(super) fn dot<V: Simd>(x: &Vector<V>, y: &Vector<V>) -> f32x8<V> {
    x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
}

/// [`Quadric`](crate::quadric::Quadric)s side by side, without their weights.
#[derive(Clone, Copy)]
struct Form<V: Simd> {
    a: [f32x8<V>; 6],
    b: Vector<V>,
    c: f32x8<V>,
}

impl<V: Simd> Form<V> {
    #[inline(always)]
    fn product(&self, x: &Vector<V>) -> Vector<V> {
        product(&self.a, *x)
    }

    #[inline(always)]
    fn value(&self, simd: V, x: &Vector<V>) -> f32x8<V> {
        let ax = self.product(x);
        let along = added(ax, scaled(f32x8::splat(simd, 2.0), self.b));
        (dot(&along, x) + self.c).max(f32x8::splat(simd, 0.0))
    }

    /// The best place for the ends of edges, which are `half` from the origin on either side, and its value: as
    /// [`optimal`](super::place::optimal) finds it.
    #[inline(always)]
    fn best(&self, simd: V, half: &Vector<V>) -> (Vector<V>, f32x8<V>) {
        let of = |x: f32| f32x8::splat(simd, x);
        let zero = of(0.0);
        let r = of((PULL / 3.0) as f32) * (self.a[0] + self.a[3] + self.a[5]);
        let back = scaled(of(-1.0), *half);
        let (step, [first, second, third]) = solve(&self.a, r, [-self.b[0], -self.b[1], -self.b[2]]);
        let most = of((4.0 * REACH * REACH) as f32) * dot(half, half);
        // No number is not near either.
        let definite = first.simd_gt(zero) & second.simd_gt(zero) & third.simd_gt(zero);
        let near = definite & dot(&step, &step).simd_le(most);
        let cost = self.value(simd, &step);
        if near.all_true() {
            return (step, cost);
        }
        let (mut best, mut least) = ([zero; 3], of(f32::INFINITY));
        for place in [[zero; 3], *half, back] {
            let cost = self.value(simd, &place);
            let less = cost.simd_lt(least);
            best = chosen(less, place, best);
            least = less.select(cost, least);
        }
        (chosen(near, step, best), near.select(cost, least))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::collapse::forms::tests::with_roots;
    use crate::collapse::place::optimal;
    use crate::collapse::surface::TOUCHED;
    use crate::collapse::surface::tests::bumps;
    use crate::quadric::Quadric;
    use crate::vectors::levels;
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

    #[inline(always)]
    fn best_together<V: Simd>(simd: V, quadrics: &[Quadric; 4], half: DVec3) -> ([[f32; LANES]; 3], [f32; LANES]) {
        let number = |of: &dyn Fn(&Quadric) -> f64| f32x8::from_fn(simd, |i| of(&quadrics[i % 4]) as f32);
        let form = Form {
            a: std::array::from_fn(|i| number(&|q| q.a[i])),
            b: std::array::from_fn(|i| number(&|q| q.b[i])),
            c: number(&|q| q.c),
        };
        let (steps, costs) = form.best(simd, &half.to_array().map(|x| f32x8::splat(simd, x as f32)));
        (steps.map(|along| along.to_array()), costs.to_array())
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
            let together: Vec<_> = levels()
                .into_iter()
                .map(|level| dispatch!(level, simd => best_together(simd, &quadrics, half)))
                .inspect(|(steps, costs)| {
                    for (lane, q) in quadrics.iter().enumerate() {
                        let alone = optimal(q, DVec3::ZERO, [half, -half]);
                        let step = DVec3::from(steps.map(|along| f64::from(along[lane])));
                        assert!((step - alone.step).length() < 1e-5, "{step} {}", alone.step);
                        assert!((f64::from(costs[lane]) - alone.cost).abs() < 1e-5 * alone.cost.max(0.01));
                    }
                })
                .collect();
            assert!(together.iter().all(|found| *found == together[0]), "the width of vectors shows");
        }
        let far = skew.minimiser(DVec3::ZERO, PULL).unwrap();
        assert!(far.length() > 2.0 * REACH * half.length(), "{far}");
    }
}
