//! The point of a triangle that is nearest to another point.

use glam::DVec3;

/// The nearest point of the triangle `abc` to `p`, and its squared distance. Exact up to rounding for every triangle, those
/// without area included.
pub fn nearest_on_triangle(p: DVec3, [a, b, c]: [DVec3; 3]) -> (DVec3, f64) {
    match Region::of(p, [a, b, c]) {
        Region::Inside { normal, height, square } => (p - normal * (height / square), height * height / square),
        Region::Beyond { ab, bc, ca } => {
            let mut nearest = (a, f64::INFINITY);
            for (is_beyond, from, to) in [(ab, a, b), (bc, b, c), (ca, c, a)] {
                if is_beyond {
                    let point = nearest_on_segment(p, from, to);
                    let distance_sq = (p - point).length_squared();
                    if distance_sq < nearest.1 {
                        nearest = (point, distance_sq);
                    }
                }
            }
            nearest
        }
    }
}

/// The squared distance from `p` to the triangle: the same number as [`nearest_on_triangle`] gives, sooner.
#[inline]
pub fn distance_sq(p: DVec3, [a, b, c]: [DVec3; 3]) -> f64 {
    match Region::of(p, [a, b, c]) {
        Region::Inside { height, square, .. } => height * height / square,
        Region::Beyond { ab, bc, ca } => {
            let to = |is_beyond: bool, from: DVec3, to: DVec3| {
                if is_beyond { (p - nearest_on_segment(p, from, to)).length_squared() } else { f64::INFINITY }
            };
            to(ab, a, b).min(to(bc, b, c)).min(to(ca, c, a))
        }
    }
}

/// Where a point lies about a triangle.
enum Region {
    /// In the prism over it: the plane's normal (not of unit length), its square, and the height along it.
    Inside { normal: DVec3, height: f64, square: f64 },
    /// Outside: the nearest point is on one of the edges that the point lies beyond.
    Beyond { ab: bool, bc: bool, ca: bool },
}

/// The squared sine of an angle below which three corners are taken to be on a line.
const FLAT: f64 = 1e-24;

impl Region {
    #[inline(always)]
    fn of(p: DVec3, [a, b, c]: [DVec3; 3]) -> Region {
        let (ab, ac, ap) = (b - a, c - a, p - a);
        let normal = ab.cross(ac);
        let square = normal.length_squared();
        let longest = ab.length_squared().max(ac.length_squared());
        // False for corners that coincide, too.
        if square > FLAT * longest * longest {
            // Twice the areas of the triangles that the point's projection makes with each edge, times the normal's length.
            let of_b = ap.cross(ac).dot(normal);
            let of_c = ab.cross(ap).dot(normal);
            let of_a = square - of_b - of_c;
            if of_a >= 0.0 && of_b >= 0.0 && of_c >= 0.0 {
                return Region::Inside { normal, height: ap.dot(normal), square };
            }
            // Beyond one edge, the nearest point is on it; beyond two, on either.
            return Region::Beyond { ab: of_c < 0.0, bc: of_a < 0.0, ca: of_b < 0.0 };
        }
        Region::Beyond { ab: true, bc: true, ca: true }
    }
}

/// The nearest point to `p` between `from` and `to`.
#[inline(always)]
fn nearest_on_segment(p: DVec3, from: DVec3, to: DVec3) -> DVec3 {
    let along = to - from;
    let square = along.length_squared();
    let t = if square > 0.0 { ((p - from).dot(along) / square).clamp(0.0, 1.0) } else { 0.0 };
    from + along * t
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> [DVec3; 3] {
        [DVec3::ZERO, DVec3::new(4.0, 0.0, 0.0), DVec3::new(0.0, 3.0, 0.0)]
    }

    #[track_caller]
    fn check(p: [f64; 3], triangle: [DVec3; 3], point: [f64; 3]) {
        let (p, expected) = (DVec3::from(p), DVec3::from(point));
        let [a, b, c] = triangle;
        for turned in [[a, b, c], [b, c, a], [c, a, b], [a, c, b]] {
            let (found, square) = nearest_on_triangle(p, turned);
            assert!((found - expected).length() < 1e-12, "{p}: {found}, not {expected}");
            assert!((square - (p - expected).length_squared()).abs() < 1e-12, "{p}: {square}");
            assert_eq!(square, distance_sq(p, turned));
        }
    }

    #[test]
    fn each_region_has_its_nearest_point() {
        check([1.0, 1.0, 2.0], triangle(), [1.0, 1.0, 0.0]);
        check([1.0, 1.0, -7.0], triangle(), [1.0, 1.0, 0.0]);
        check([2.0, -5.0, 1.0], triangle(), [2.0, 0.0, 0.0]);
        check([-1.0, 1.0, 1.0], triangle(), [0.0, 1.0, 0.0]);
        check([2.56 + 1.2, 1.08 + 1.6, 0.0], triangle(), [2.56, 1.08, 0.0]);
        check([-1.0, -1.0, 3.0], triangle(), [0.0, 0.0, 0.0]);
        check([6.0, -1.0, 0.0], triangle(), [4.0, 0.0, 0.0]);
        check([-1.0, 5.0, 0.5], triangle(), [0.0, 3.0, 0.0]);
    }

    #[test]
    fn an_obtuse_triangle_is_met_on_the_right_edge() {
        let obtuse = [DVec3::ZERO, DVec3::new(4.0, 0.0, 0.0), DVec3::new(6.0, 1.0, 0.0)];
        check([5.0, -1.0, 0.0], obtuse, [4.4, 0.2, 0.0]);
        check([4.1, -3.0, 0.0], obtuse, [4.0, 0.0, 0.0]);
        check([2.0, 9.0, 0.0], obtuse, [126.0 / 37.0, 21.0 / 37.0, 0.0]);
    }

    #[test]
    fn triangles_without_area_are_segments_and_points() {
        let (a, b) = (DVec3::ZERO, DVec3::new(2.0, 0.0, 0.0));
        check([1.5, 2.0, 0.0], [a, b, a], [1.5, 0.0, 0.0]);
        check([1.5, 2.0, 0.0], [a, b, DVec3::new(0.5, 0.0, 0.0)], [1.5, 0.0, 0.0]);
        check([3.0, 0.0, 1.0], [a, b, b], [2.0, 0.0, 0.0]);
        check([1.0, 1.0, 1.0], [b; 3], [2.0, 0.0, 0.0]);
    }
}
