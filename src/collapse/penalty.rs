//! What makes a collapse dearer than its distance: bad shapes of faces (thesis §3.7).

use super::policy::Policies;
use super::surface::{Around, Surface};
use crate::mesh::Coordinate;
use glam::DVec3;

/// Faces at a vertex that nobody minds: six is the mean.
const COMMON_VALENCE: usize = 8;

/// Penalties are relative to the square of the mean squared edge length around the merged vertex, which is a cost. This
/// much of it stands above what collapses of smooth parts cost, and below what those of a model's parts do.
const SHARE: f64 = 0.05;

impl<S: Coordinate> Surface<S> {
    /// What is added to the cost of merging `a` and `b` at `x`.
    pub fn penalty(&self, around: &impl Around, a: u32, b: u32, x: DVec3, policies: &Policies) -> f64 {
        let short = |corners: [DVec3; 3]| (1.0 - compactness(corners) / policies.compactness).max(0.0);
        let (mut worse, mut squares, mut faces) = (0.0, 0.0, 0usize);
        for (v, other) in [(a, b), (b, a)] {
            for &corner in around.of(v) {
                let (p, q) = self.ends(corner);
                let goes = p == other || q == other;
                let (at, p, q) = (self.at(v), self.at(p), self.at(q));
                if policies.compactness > 0.0 {
                    // A face that goes is seen from both ends.
                    worse += if goes { -0.5 * short([at, p, q]) } else { short([x, p, q]) - short([at, p, q]) };
                }
                if !goes {
                    squares += (p - x).length_squared() + (q - x).length_squared() + (q - p).length_squared();
                    faces += 1;
                }
            }
        }
        let excess = faces.saturating_sub(COMMON_VALENCE) as f64;
        let scale = squares / (3 * faces.max(1)) as f64;
        SHARE * scale * scale * (worse.max(0.0) + policies.valence_penalty * excess)
    }
}

/// How compact a triangle is: 1 if equilateral, 0 if its corners are on a line (eq. 3.20).
fn compactness([a, b, c]: [DVec3; 3]) -> f64 {
    let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    let twice_area = (b - a).cross(c - a).length();
    if squares > 0.0 { 2.0 * 3f64.sqrt() * twice_area / squares } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compactness_is_that_of_the_thesis() {
        let top = DVec3::new(0.5, 0.75f64.sqrt(), 0.0);
        assert!((compactness([DVec3::ZERO, DVec3::X, top]) - 1.0).abs() < 1e-12);
        assert_eq!(compactness([DVec3::ZERO, DVec3::X, DVec3::X * 3.0]), 0.0);
        assert_eq!(compactness([DVec3::X; 3]), 0.0);
    }
}
