//! The quadric: squared distances to a set of weighted planes, as one quadratic form.
//!
//! `Q(x) = xᵀA x + 2 bᵀx + c`, thesis eq. 3.4–3.6, with `A = Σ w n nᵀ`, `b = Σ w d n`, `c = Σ w d²` over planes
//! `nᵀx + d = 0`. Every quadric here is kept about a *local* origin (its vertex or its cell's representative), never about
//! the scan's: sums about a distant origin lose centimetres to cancellation, local ones nanometres. Moving the origin is
//! [`Quadric::shifted`], done in `f64`; storage is [`PackedQuadric`], 44 bytes of `f32`.

use fearless_simd::{Simd, f32x8};
use glam::{DMat3, DVec3};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A quadric about some origin, in the frame's units: `a` is an area, `b` area × length, `c` area × length².
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Quadric {
    /// `A`'s upper triangle: xx, xy, xz, yy, yz, zz.
    pub a: [f64; 6],
    /// Linear part.
    pub b: DVec3,
    /// Constant part: the value at the origin.
    pub c: f64,
    /// Sum of the weights: the area that `Q` stands for. `√(Q(x) / w)` is a root-mean-square distance.
    pub w: f64,
}

/// A [`Quadric`] as it is stored, 44 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Default, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct PackedQuadric {
    /// As [`Quadric::a`].
    pub a: [f32; 6],
    /// As [`Quadric::b`].
    pub b: [f32; 3],
    /// As [`Quadric::c`].
    pub c: f32,
    /// As [`Quadric::w`].
    pub w: f32,
}

/// What forms are made of: numbers, one or some side by side.
pub(crate) trait Number:
    Copy + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
}

impl Number for f64 {}
impl<V: Simd> Number for f32x8<V> {}

/// `A x`, of `A`'s upper triangle.
#[inline(always)]
pub(crate) fn product<T: Number>(&[xx, xy, xz, yy, yz, zz]: &[T; 6], x: [T; 3]) -> [T; 3] {
    [xx * x[0] + xy * x[1] + xz * x[2], xy * x[0] + yy * x[1] + yz * x[2], xz * x[0] + yz * x[1] + zz * x[2]]
}

/// Solves `(A + r·I) x = g` by LDLᵀ: `x`, and the pivots, all above zero where the matrix is positive definite.
#[inline(always)]
pub(crate) fn solve<T: Number>(&[xx, xy, xz, yy, yz, zz]: &[T; 6], r: T, g: [T; 3]) -> ([T; 3], [T; 3]) {
    let (xx, yy, zz) = (xx + r, yy + r, zz + r);
    let l10 = xy / xx;
    let l20 = xz / xx;
    let d1 = yy - l10 * xy;
    let t = yz - l20 * xy;
    let l21 = t / d1;
    let d2 = zz - l20 * xz - l21 * t;
    let y1 = g[1] - l10 * g[0];
    let y2 = g[2] - l20 * g[0] - l21 * y1;
    let z = y2 / d2;
    let y = y1 / d1 - l21 * z;
    let x = g[0] / xx - l10 * y - l20 * z;
    ([x, y, z], [xx, d1, d2])
}

impl Quadric {
    /// The plane with unit normal `n` at signed distance `d` below the origin (`n·x + d = 0`), with weight `w`.
    #[inline]
    pub fn plane(n: DVec3, d: f64, w: f64) -> Self {
        let m = n * w;
        Quadric { a: [m.x * n.x, m.x * n.y, m.x * n.z, m.y * n.y, m.y * n.z, m.z * n.z], b: m * d, c: w * d * d, w }
    }

    /// The line through `p` along the unit vector `t`, with weight `w`: `w · dist²`, as two perpendicular planes would
    /// give. Adds nothing to [`Quadric::w`]: a constraint is not surface.
    #[inline]
    pub fn line(p: DVec3, t: DVec3, w: f64) -> Self {
        let a = [
            w * (1.0 - t.x * t.x),
            -w * t.x * t.y,
            -w * t.x * t.z,
            w * (1.0 - t.y * t.y),
            -w * t.y * t.z,
            w * (1.0 - t.z * t.z),
        ];
        let q = Quadric { a, ..Default::default() };
        let b = -q.product(p);
        Quadric { b, c: -b.dot(p), ..q }
    }

    /// `A x`.
    #[inline(always)]
    pub fn product(&self, x: DVec3) -> DVec3 {
        DVec3::from(product(&self.a, x.to_array()))
    }

    /// `Q(x)`, never below zero.
    #[inline(always)]
    pub fn value(&self, x: DVec3) -> f64 {
        ((self.product(x) + 2.0 * self.b).dot(x) + self.c).max(0.0)
    }

    /// The same form about the origin `o` (given in the present coordinates).
    #[inline(always)]
    pub fn shifted(&self, o: DVec3) -> Self {
        let ao = self.product(o);
        Quadric { a: self.a, b: self.b + ao, c: ((ao + 2.0 * self.b).dot(o) + self.c).max(0.0), w: self.w }
    }

    /// Trace of `A`: the total weight of all planes, constraints included.
    #[inline(always)]
    pub fn trace(&self) -> f64 {
        self.a[0] + self.a[3] + self.a[5]
    }

    /// The minimiser of `Q(x) + ε·tr(A)/3·|x − m|²`: the optimal placement of thesis eq. 3.10, made unique by a pull
    /// towards `m` so weak that it matters only along directions about which the planes say nothing. `None` for a quadric
    /// of weight zero or one whose solution overflows.
    #[inline(always)]
    pub fn minimiser(&self, m: DVec3, epsilon: f64) -> Option<DVec3> {
        let (x, is_one) = self.minimiser_if_one(m, epsilon);
        is_one.then_some(x)
    }

    /// The same, and whether it is one, without a branch, for loops over many.
    #[inline(always)]
    pub fn minimiser_if_one(&self, m: DVec3, epsilon: f64) -> (DVec3, bool) {
        let r = epsilon * self.trace() * (1.0 / 3.0);
        let g = -(self.product(m) + self.b);
        let (step, [p, q, r]) = solve(&self.a, r, g.to_array());
        let x = m + DVec3::from(step);
        let is_finite = x.x.is_finite() & x.y.is_finite() & x.z.is_finite();
        (x, (p > 0.0) & (q > 0.0) & (r > 0.0) & is_finite)
    }

    /// `A` as a matrix.
    pub fn matrix(&self) -> DMat3 {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
    }

    /// Rounded to storage.
    #[inline(always)]
    pub fn pack(&self) -> PackedQuadric {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        PackedQuadric {
            a: [xx as f32, xy as f32, xz as f32, yy as f32, yz as f32, zz as f32],
            b: self.b.as_vec3().to_array(),
            c: self.c as f32,
            w: self.w as f32,
        }
    }
}

impl std::ops::Add for Quadric {
    type Output = Quadric;
    #[inline(always)]
    fn add(self, o: Quadric) -> Quadric {
        let mut a = self.a;
        for (x, y) in a.iter_mut().zip(o.a) {
            *x += y;
        }
        Quadric { a, b: self.b + o.b, c: self.c + o.c, w: self.w + o.w }
    }
}

impl std::ops::AddAssign for Quadric {
    #[inline(always)]
    fn add_assign(&mut self, o: Quadric) {
        *self = *self + o;
    }
}

impl PackedQuadric {
    /// Exact.
    #[inline(always)]
    pub fn unpack(&self) -> Quadric {
        Quadric {
            a: self.a.map(f64::from),
            b: DVec3::new(f64::from(self.b[0]), f64::from(self.b[1]), f64::from(self.b[2])),
            c: f64::from(self.c),
            w: f64::from(self.w),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() <= 1e-12 * (1.0 + a.abs().max(b.abs()))
    }

    #[test]
    fn a_plane_measures_its_squared_distance() {
        let n = DVec3::new(1.0, 2.0, 2.0) / 3.0;
        let q = Quadric::plane(n, -1.5, 4.0);
        let x = DVec3::new(0.3, -2.0, 5.0);
        assert!(near(q.value(x), 4.0 * (n.dot(x) - 1.5).powi(2)));
    }

    #[test]
    fn a_line_measures_its_squared_distance() {
        let t = DVec3::new(2.0, -1.0, 2.0) / 3.0;
        let p = DVec3::new(0.5, 0.25, -1.0);
        let q = Quadric::line(p, t, 2.0);
        let x = DVec3::new(1.0, 2.0, 3.0);
        assert!(near(q.value(x), 2.0 * (x - p).cross(t).length_squared()));
        assert_eq!(q.w, 0.0);
    }

    #[test]
    fn shifting_changes_the_origin_and_nothing_else() {
        let q = Quadric::plane(DVec3::new(0.6, 0.0, 0.8), 0.25, 3.0) + Quadric::plane(DVec3::Y, -1.0, 0.5);
        let o = DVec3::new(0.1, 0.7, -0.4);
        let x = DVec3::new(-2.0, 0.3, 0.9);
        assert!(near(q.shifted(o).value(x - o), q.value(x)));
    }

    #[test]
    fn three_planes_meet_where_they_meet() {
        let p = DVec3::new(0.2, -0.7, 1.1);
        let q = [DVec3::X, DVec3::new(0.6, 0.8, 0.0), DVec3::new(0.0, 0.6, 0.8)]
            .into_iter()
            .fold(Quadric::default(), |q, n| q + Quadric::plane(n, -n.dot(p), 1.0));
        let x = q.minimiser(DVec3::ZERO, 1e-12).unwrap();
        assert!((x - p).length() < 1e-9, "{x}");
    }

    #[test]
    fn a_single_plane_is_met_below_the_mean() {
        let q = Quadric::plane(DVec3::Z, -2.0, 1.0);
        let x = q.minimiser(DVec3::new(3.0, 4.0, 1.0), 1e-6).unwrap();
        assert!((x - DVec3::new(3.0, 4.0, 2.0)).length() < 1e-5, "{x}");
        assert_eq!(Quadric::default().minimiser(DVec3::ZERO, 1e-4), None);
    }
}
