//! Where a merged vertex goes (thesis §3.5).

use super::policy::Placement;
use super::surface::Candidate;
use crate::quadric::Quadric;
use glam::DVec3;

/// Pull towards the middle of the edge, as a share of the mean weight: it fixes what the planes leave open (a flat's vertex
/// does not slide), and is too weak to be felt where they say something.
pub(super) const PULL: f64 = 1e-4;

/// A placement further from the middle than this many edge lengths is the intersection of nearly parallel planes, not a
/// place on the surface: the best of the middle and the ends is taken instead.
pub(super) const REACH: f64 = 3.0;

/// A quadric that bends less than this along an edge, as a share of its weight, is constant there: no place on it is best.
const FLAT: f64 = 1e-12;

impl Placement {
    /// The place for the vertex that an edge's ends become, which are `half` from its middle on either side. The quadric is
    /// about the middle.
    #[inline(always)]
    pub(super) fn on_edge(self, q: &Quadric, half: DVec3) -> Candidate {
        let ends = [half, -half];
        match self {
            Placement::Optimal => optimal(q, DVec3::ZERO, ends),
            Placement::Line => on_line(q, half),
            Placement::EndpointOrMidpoint => best(q, [DVec3::ZERO, half, -half]),
            Placement::Endpoint => best(q, ends),
        }
    }
}

/// Optimal placement with its fallbacks: the minimiser, unless it lies far from all that is merged; then the best of the
/// middle and the merged vertices.
#[inline(always)]
pub(super) fn optimal(q: &Quadric, middle: DVec3, merged: impl IntoIterator<Item = DVec3> + Clone) -> Candidate {
    let reach_sq = merged.clone().into_iter().map(|p| (p - middle).length_squared()).fold(0.0, f64::max);
    if let Some(step) = q.minimiser(middle, PULL)
        && (step - middle).length_squared() <= (2.0 * REACH) * (2.0 * REACH) * reach_sq
    {
        return Candidate { step, cost: q.value(step) };
    }
    best(q, std::iter::once(middle).chain(merged))
}

/// The best place on the edge; where all are alike, the better end.
fn on_line(q: &Quadric, half: DVec3) -> Candidate {
    let bend = q.product(half).dot(half);
    if bend <= FLAT * q.trace() * half.length_squared() {
        return best(q, [half, -half]);
    }
    let step = half * (-q.b.dot(half) / bend).clamp(-1.0, 1.0);
    Candidate { step, cost: q.value(step) }
}

/// The best of some places, the first of those that are alike.
#[inline(always)]
pub(super) fn best(q: &Quadric, steps: impl IntoIterator<Item = DVec3>) -> Candidate {
    let mut best = Candidate { step: DVec3::ZERO, cost: f64::INFINITY };
    for step in steps {
        let cost = q.value(step);
        if cost < best.cost {
            best = Candidate { step, cost };
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two planes that meet in a line across the edge, 0.75 of the way to its end.
    fn crossing(half: DVec3) -> Quadric {
        let p = 0.75 * half;
        [DVec3::X, DVec3::Z].into_iter().fold(Quadric::default(), |q, n| q + Quadric::plane(n, -n.dot(p), 2.0))
    }

    #[test]
    fn each_policy_finds_the_best_of_its_places() {
        let half = DVec3::new(0.5, 0.25, 0.0);
        let q = crossing(half);
        for (placement, at) in
            [(Placement::Line, 0.75 * half), (Placement::EndpointOrMidpoint, half), (Placement::Endpoint, half)]
        {
            let candidate = placement.on_edge(&q, half);
            assert!((candidate.step - at).length() < 1e-12, "{placement:?}: {}", candidate.step);
            assert_eq!(candidate.cost, q.value(candidate.step), "{placement:?}");
        }
        let optimum = Placement::Optimal.on_edge(&q, half);
        assert!((optimum.step.x - 0.375).abs() < 1e-4 && optimum.cost < 1e-8, "{}", optimum.step);
    }

    #[test]
    fn where_nothing_is_best_an_end_is_taken() {
        let half = DVec3::new(0.5, 0.0, 0.0);
        let flat = Quadric::plane(DVec3::Z, -1.0, 1.0);
        assert_eq!(Placement::Line.on_edge(&flat, half).step, half);
        assert_eq!(Placement::Endpoint.on_edge(&Quadric::default(), half).step, half);
        assert_eq!(Placement::EndpointOrMidpoint.on_edge(&flat, half).step, DVec3::ZERO);
    }
}
