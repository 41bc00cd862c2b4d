//! What planes and lines count (thesis §3.4.1, §3.6).

use super::policy::{Policies, Weighting};
use crate::quadric::Quadric;
use glam::DVec3;
use std::f64::consts::PI;

impl Weighting {
    /// What a face's plane counts at the corner between two of its edges, as a multiple of the face's area: 1 on average,
    /// save where all planes count alike.
    pub(super) fn share(self, e: DVec3, f: DVec3) -> f64 {
        let twice_area = e.cross(f).length();
        match self {
            Weighting::Area => 1.0,
            Weighting::Angle => 3.0 / PI * twice_area.atan2(e.dot(f)),
            Weighting::Uniform if twice_area > 0.0 => 2.0 / twice_area,
            Weighting::Uniform => 0.0,
        }
    }

    /// What a line counts along `edge`: as a square over it would.
    #[inline(always)]
    fn of_line(self, edge: DVec3) -> f64 {
        match self {
            Weighting::Uniform if edge != DVec3::ZERO => 1.0 / edge.length_squared(),
            _ => 1.0,
        }
    }
}

impl Policies {
    /// The quadric of a border edge about one of its ends: squared distance to its line, as two perpendicular planes would
    /// give, weighted by its squared length (§3.6).
    #[inline(always)]
    pub(super) fn border_line(&self, edge: DVec3) -> Quadric {
        along(edge, self.boundary_weight * self.weighting.of_line(edge))
    }
}

/// Squared distance to the line along `edge`, times the edge's squared length and `weight`.
#[inline(always)]
fn along(edge: DVec3, weight: f64) -> Quadric {
    let l2 = edge.length_squared();
    Quadric {
        a: [
            weight * (l2 - edge.x * edge.x),
            -weight * edge.x * edge.y,
            -weight * edge.x * edge.z,
            weight * (l2 - edge.y * edge.y),
            -weight * edge.y * edge.z,
            weight * (l2 - edge.z * edge.z),
        ],
        ..Default::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_a_face_add_up_to_its_weight() {
        let corners = [DVec3::ZERO, DVec3::new(3.0, 0.5, 0.0), DVec3::new(0.5, 1.0, 1.0)];
        let sum = |weighting: Weighting| -> f64 {
            (0..3).map(|i| weighting.share(corners[(i + 1) % 3] - corners[i], corners[(i + 2) % 3] - corners[i])).sum()
        };
        let area = 0.5 * corners[1].cross(corners[2]).length();
        for (weighting, whole) in [(Weighting::Area, 3.0), (Weighting::Angle, 3.0), (Weighting::Uniform, 3.0 / area)] {
            assert!((sum(weighting) - whole).abs() < 1e-12, "{weighting:?}: {}", sum(weighting));
        }
        assert_eq!(Weighting::Uniform.share(DVec3::X, DVec3::X), 0.0);
    }

    #[test]
    fn a_border_line_weighs_as_planes_do() {
        let policies = Policies { weighting: Weighting::Uniform, boundary_weight: 3.0, ..Default::default() };
        let away = DVec3::new(0.0, 2.0, 0.0);
        assert!((policies.border_line(DVec3::X * 0.01).value(away) - 12.0).abs() < 1e-12);
        let policies = Policies { boundary_weight: 3.0, ..Default::default() };
        assert!((policies.border_line(DVec3::X * 0.5).value(away) - 3.0).abs() < 1e-12);
    }
}
