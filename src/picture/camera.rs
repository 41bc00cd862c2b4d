//! Where a picture is taken from.

use crate::error::{Error, Result};
use crate::mesh::Extent;
use crate::read::{Crew, Scan};
use glam::{DMat3, DVec3, Vec3};

/// Triangles that tell how a scan lies.
const SAMPLE: usize = 100_000;

/// A scan whose least side is below this share of its second one is taken for a relief, which is looked at from above.
const RELIEF: f64 = 0.3;
/// Degrees by which the camera is raised above the front of a body, turned to its side, and lowered from above a relief.
const RAISED: f64 = 14.0;
const TURNED: f64 = 24.0;
const LOWERED: f64 = 48.0;

/// Room around what is shown, as a share of it.
const MARGIN: f64 = 0.04;

/// Vertices further out than this many times the sample's extent are not what the picture is of.
const OUTLYING: f64 = 1.5;

/// A direction to look in, and what part of the world is in the picture. Parallel projection: lengths compare.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// To the right in the picture, upwards, and towards the eye.
    axes: [DVec3; 3],
    /// What is in the middle.
    centre: DVec3,
    /// Half of the width and of the height that must be seen.
    half: [f64; 2],
    /// Half of the depth that can hold anything.
    depth: f64,
}

impl Camera {
    /// Looks at a scan from where its shape shows: across its two longer sides, a little from the side and from above;
    /// at a relief, obliquely from above.
    pub fn of_scan(scan: &Scan, crew: &Crew) -> Result<Camera> {
        let sample = scan.sample(crew, SAMPLE)?.triangles;
        if sample.is_empty() {
            return Err(Error::input(scan.path(), "has no face to be seen"));
        }
        let axes = principal_axes(&sample);
        let sampled = extent(&axes, sample.iter().flatten().copied());
        let all = scan.vertices(crew, Extent::default, |extent, chunk| {
            chunk.positions.iter().for_each(|p| extent.include(along(&axes, DVec3::from(*p))));
            Ok(())
        })?;
        let all = all.into_iter().fold(Extent::default(), Extent::union);
        // A vertex that no face uses may lie anywhere.
        let outlying = (all.size() - OUTLYING * sampled.size()).max_element() > 0.1 * sampled.size().max_element();
        Ok(Camera::framing(axes, if outlying { sampled } else { all }))
    }

    /// Sees all of `extent`, which is along the axes.
    fn framing(axes: [DVec3; 3], extent: Extent) -> Camera {
        let middle = extent.min.midpoint(extent.max);
        let half = (0.5 + MARGIN) * extent.size().max(DVec3::splat(f64::MIN_POSITIVE));
        let centre = axes[0] * middle.x + axes[1] * middle.y + axes[2] * middle.z;
        Camera { axes, centre, half: [half.x, half.y], depth: half.length() }
    }

    /// Closer by a factor, with another point in the middle.
    pub fn zoomed(self, at: DVec3, by: f64) -> Camera {
        Camera { centre: at, half: self.half.map(|h| h / by), depth: 2.0 * self.depth, ..self }
    }

    /// A position as the eye has it: to the right, upwards, towards the eye, from the middle of the picture.
    #[inline(always)]
    pub(super) fn view(&self, p: DVec3) -> Vec3 {
        along(&self.axes, p - self.centre).as_vec3()
    }

    /// What is in the middle.
    pub fn centre(&self) -> DVec3 {
        self.centre
    }

    /// The position that is seen at this place, in front of the middle by `toward`.
    pub(super) fn place(&self, [right, up, toward]: [f64; 3]) -> DVec3 {
        self.centre + self.axes[0] * right + self.axes[1] * up + self.axes[2] * toward
    }

    /// The length that a pixel of such a picture shows.
    pub(super) fn pixel(&self, width: usize, height: usize) -> f64 {
        (2.0 * self.half[0] / width as f64).max(2.0 * self.half[1] / height as f64)
    }

    /// Half of the depth that can hold anything.
    pub(super) fn depth(&self) -> f64 {
        self.depth
    }

    /// The same direction, about the place that another camera has in the middle: positions in this view are moved by this
    /// to be in that one's.
    pub(super) fn shift_to(&self, other: &Camera) -> Vec3 {
        along(&self.axes, self.centre - other.centre).as_vec3()
    }

    /// Width over height of what is shown.
    pub fn aspect(&self) -> f64 {
        self.half[0] / self.half[1]
    }
}

#[inline(always)]
fn along(axes: &[DVec3; 3], p: DVec3) -> DVec3 {
    DVec3::new(axes[0].dot(p), axes[1].dot(p), axes[2].dot(p))
}

fn extent(axes: &[DVec3; 3], positions: impl Iterator<Item = [f64; 3]>) -> Extent {
    let mut extent = Extent::default();
    positions.for_each(|p| extent.include(along(axes, p.into())));
    extent
}

/// To the right, upwards and towards the eye.
fn principal_axes(triangles: &[[[f64; 3]; 3]]) -> [DVec3; 3] {
    let (across, spread) = least_axis(triangles);
    let main = (0..3).max_by(|&a, &b| across[a].abs().total_cmp(&across[b].abs())).unwrap_or(2);
    // People stand in front of things: x and z point at them, y away from them where z is up.
    let across = if (across[main] < 0.0) == (main == 1) { across } else { -across };
    let box_of = extent(&[DVec3::X, DVec3::Y, DVec3::Z], triangles.iter().flatten().copied()).size();
    let upright = match main {
        0 if box_of.y > box_of.z => DVec3::Y,
        2 => DVec3::Y,
        _ => DVec3::Z,
    };
    let right = upright.cross(across).normalize_or(DVec3::X);
    let up = across.cross(right);
    let relief = spread[0] < RELIEF * spread[1];
    let (tilt, turn) = if relief { (-LOWERED, 0.0) } else { (RAISED, TURNED) };
    let (tilt, turn): (f64, f64) = (f64::to_radians(tilt), f64::to_radians(turn));
    let turned = across * turn.cos() + right * turn.sin();
    let right = right * turn.cos() - across * turn.sin();
    let toward = turned * tilt.cos() + up * tilt.sin();
    [right, toward.cross(right), toward]
}

/// The direction in which triangles spread least, and how far they spread along all three, from the least.
fn least_axis(triangles: &[[[f64; 3]; 3]]) -> (DVec3, [f64; 3]) {
    let origin = DVec3::from(triangles[0][0]);
    let (mut weight, mut sum, mut squares) = (0.0, DVec3::ZERO, DMat3::ZERO);
    for triangle in triangles {
        let [a, b, c] = triangle.map(|p| DVec3::from(p) - origin);
        let area = (b - a).cross(c - a).length();
        let middle = (a + b + c) / 3.0;
        weight += area;
        sum += middle * area;
        squares += DMat3::from_cols(middle * middle.x, middle * middle.y, middle * middle.z) * area;
    }
    if !(weight > 0.0 && weight.is_finite()) {
        return (DVec3::Z, [1.0; 3]);
    }
    let mean = sum / weight;
    let covariance = squares * weight.recip() - DMat3::from_cols(mean * mean.x, mean * mean.y, mean * mean.z);
    let (values, vectors) = eigen(covariance);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
    let spread = order.map(|i| values[i].max(0.0).sqrt());
    // A body that is as deep as it is wide has no front but the one it was given.
    if spread[0] > 0.9 * spread[1] {
        return (if spread[2] > 1.1 * spread[1] { least_of_box(vectors.col(order[2])) } else { DVec3::Z }, spread);
    }
    (vectors.col(order[0]), spread)
}

/// An axis of the file that is across `long`.
fn least_of_box(long: DVec3) -> DVec3 {
    if long.abs().z > 0.5 { DVec3::NEG_Y } else { DVec3::Z }
}

/// Eigenvalues and -vectors of a symmetric matrix, by Jacobi's rotations.
fn eigen(mut m: DMat3) -> ([f64; 3], DMat3) {
    let mut vectors = DMat3::IDENTITY;
    for _ in 0..24 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            let off = m.col(q)[p];
            if off == 0.0 {
                continue;
            }
            let theta = 0.5 * (2.0 * off).atan2(m.col(q)[q] - m.col(p)[p]);
            let (s, c) = theta.sin_cos();
            let mut turn = DMat3::IDENTITY;
            turn.col_mut(p)[p] = c;
            turn.col_mut(q)[q] = c;
            turn.col_mut(q)[p] = s;
            turn.col_mut(p)[q] = -s;
            m = turn.transpose() * m * turn;
            vectors *= turn;
        }
    }
    ([m.x_axis.x, m.y_axis.y, m.z_axis.z], vectors)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eigenvectors_are_those_of_the_matrix() {
        let m = DMat3::from_cols_array(&[4.0, 1.0, -0.5, 1.0, 3.0, 0.25, -0.5, 0.25, 1.0]);
        let (values, vectors) = eigen(m);
        for (i, value) in values.iter().enumerate() {
            let v = vectors.col(i);
            assert!((m * v - v * *value).length() < 1e-12, "{value} {v}");
        }
    }

    #[test]
    fn a_relief_is_seen_from_above_and_a_statue_upright() {
        // A wide, flat box of points, and a tall one that is least deep in y.
        let cloud = |size: [f64; 3]| -> Vec<[[f64; 3]; 3]> {
            let corner = |i: u32, j: u32, k: u32| [i, j, k].map(f64::from);
            let at = |p: [f64; 3]| [0, 1, 2].map(|i| p[i] * size[i] / 4.0 + 5e6);
            (0..64)
                .map(|n| corner(n % 4, n / 4 % 4, n / 16))
                .map(|[x, y, z]| [at([x, y, z]), at([x + 1.0, y, z]), at([x, y + 1.0, z + 1.0])])
                .collect()
        };
        let [right, up, toward] = principal_axes(&cloud([10.0, 8.0, 0.5]));
        assert!(right.x > 0.99 && up.y > 0.5 && toward.z > 0.5 && toward.y < -0.5, "{right} {up} {toward}");
        let [right, up, toward] = principal_axes(&cloud([4.0, 2.5, 9.0]));
        assert!(right.x > 0.8 && up.z > 0.9 && toward.y < -0.7, "{right} {up} {toward}");
        for axes in [principal_axes(&cloud([1.0, 1.0, 1.0])), principal_axes(&cloud([3.0, 0.0, 0.0]))] {
            let m = DMat3::from_cols(axes[0], axes[1], axes[2]);
            assert!((m.determinant() - 1.0).abs() < 1e-9, "{m}");
        }
    }
}
