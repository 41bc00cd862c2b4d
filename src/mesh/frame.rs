//! Coordinates: the scalar they are stored in, the power of two they are scaled by, and where they are counted from.
//!
//! A scan is scaled so that its longest side is in `[0.5, 1)`. The factor is a power of two, so scaling is exact in both
//! directions, every constant of the later stages is relative to a scan of size one, and a scan scaled by a power of two
//! gives the same mesh, scaled. Arithmetic is done in `f64` on differences.
//!
//! A position keeps the bits it came with (an offset of 500 km in doubles survives). One in floats is not translated.
//! One in doubles is counted from a point near the scan, where that lies far from the file's origin ([`Frame::around`]):
//! subtracting it is exact, and what is placed is not rounded to what doubles hold that far away before it is written. So a
//! georeferenced scan is reduced like the same scan at home.

use crate::error::{Error, Result};
use glam::DVec3;
use std::path::Path;

/// The scalar that positions are stored in: the file's own, `f32` or `f64`.
pub trait Coordinate: Copy + Send + Sync + PartialEq + std::fmt::Debug + bytemuck::Pod {
    /// Whether this is `f64`.
    const DOUBLE: bool;
    /// Exact.
    fn widen(self) -> f64;
    /// Rounds to the nearest.
    fn narrow(x: f64) -> Self;
    /// A difference, in single precision: what is near in doubles is told apart before it is rounded.
    fn minus(self, other: Self) -> f32;
}

impl Coordinate for f32 {
    const DOUBLE: bool = false;
    #[inline(always)]
    fn widen(self) -> f64 {
        f64::from(self)
    }
    #[inline(always)]
    fn narrow(x: f64) -> Self {
        x as f32
    }
    #[inline(always)]
    fn minus(self, other: Self) -> f32 {
        self - other
    }
}

impl Coordinate for f64 {
    const DOUBLE: bool = true;
    #[inline(always)]
    fn widen(self) -> f64 {
        self
    }
    #[inline(always)]
    fn narrow(x: f64) -> Self {
        x
    }
    #[inline(always)]
    fn minus(self, other: Self) -> f32 {
        (self - other) as f32
    }
}

/// Between the file's units and the frame that the stages work in: a power of two and an origin.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Frame {
    exponent: i32,
    /// In the file's units; 0 on the axes that are not translated.
    origin: DVec3,
}

/// An extent is far from the file's origin on the axes on which it is so many of the frame's units away, and not so many
/// that doubles are no finer there than floats are at home. From eight on a difference to a point within a unit and a
/// half is exact (Sterbenz).
const FAR: std::ops::Range<f64> = 8.0..(1 << 28) as f64;

impl Frame {
    /// The frame in which the longest side of `extent` is in `[0.5, 1)`, or a millionth less; the identity for a point or nothing at all.
    pub fn of(extent: &Extent) -> Self {
        // Where a scan is moved far away, its longest side rounds: by no more than this, so that a power of two gives the
        // same frame there.
        let side = extent.size().max_element() * (1.0 + 1e-6);
        if !(side > 0.0 && side.is_finite()) {
            return Frame::default();
        }
        // frexp: the exponent e with side = m · 2^e and m in [0.5, 1), subnormals included.
        let (scaled, shift) = if side < f64::MIN_POSITIVE { (side * 2f64.powi(64), -64) } else { (side, 0) };
        Frame { exponent: (scaled.to_bits() >> 52 & 0x7ff) as i32 - 1022 + shift, origin: DVec3::ZERO }
    }

    /// The same for positions in `S`. Far doubles are counted from the middle of `extent`, in whole units of the frame, so
    /// that moving a scan by any number of units moves its origin along.
    pub fn around<S: Coordinate>(extent: &Extent) -> Self {
        let frame = Frame::of(extent);
        let of_axis = |middle: f64| {
            let units = frame.to_frame(middle);
            if S::DOUBLE && FAR.contains(&units.abs()) { frame.to_file(units.round()) } else { 0.0 }
        };
        let middle = 0.5 * extent.min + 0.5 * extent.max;
        Frame { origin: if middle.is_finite() { middle.map(of_axis) } else { DVec3::ZERO }, ..frame }
    }

    /// Where the frame begins, in the file's units.
    pub fn origin(self) -> DVec3 {
        self.origin
    }

    /// A point in the frame from one in the file's units.
    #[inline]
    pub fn place(self, p: DVec3) -> DVec3 {
        (p - self.origin).map(|x| self.to_frame(x))
    }

    /// A point in the file's units from one in the frame.
    #[inline]
    pub fn place_back(self, p: DVec3) -> DVec3 {
        let back = |x: f64, origin: f64| {
            let x = self.to_file(x);
            // Adding nothing would take the sign off a zero.
            if origin == 0.0 { x } else { x + origin }
        };
        DVec3::new(back(p.x, self.origin.x), back(p.y, self.origin.y), back(p.z, self.origin.z))
    }

    /// A length in the file's units from one in the frame.
    pub fn to_file(self, x: f64) -> f64 {
        scale_by_power(x, self.exponent)
    }

    /// A length in the frame from one in the file's units.
    #[inline]
    pub fn to_frame(self, x: f64) -> f64 {
        scale_by_power(x, -self.exponent)
    }
}

/// `x · 2^e` by two multiplications, so that every `e` a pair of doubles can be apart by is reached without overflow of
/// the factor.
#[inline]
fn scale_by_power(x: f64, e: i32) -> f64 {
    let half = e / 2;
    x * power(half) * power(e - half)
}

#[inline]
fn power(e: i32) -> f64 {
    f64::from_bits(((e + 1023) as u64) << 52)
}

/// An axis-aligned box of positions in the file's units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// Least coordinates.
    pub min: DVec3,
    /// Largest coordinates.
    pub max: DVec3,
}

impl Default for Extent {
    fn default() -> Self {
        Extent { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY }
    }
}

impl Extent {
    /// Grows to hold `p`; a non-finite position is passed over.
    #[inline]
    pub fn include(&mut self, p: DVec3) {
        if p.is_finite() {
            self.min = self.min.min(p);
            self.max = self.max.max(p);
        }
    }

    /// The box of both.
    pub fn union(self, other: Extent) -> Extent {
        Extent { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Side lengths; zero when nothing was included.
    pub fn size(&self) -> DVec3 {
        (self.max - self.min).max(DVec3::ZERO)
    }

    /// Refuses a box whose sides no double can hold.
    pub fn check(&self, file: &Path) -> Result<()> {
        if self.size().is_finite() {
            return Ok(());
        }
        let (min, max) = (self.min, self.max);
        Err(Error::input(file, format!("coordinates from {min} to {max}, expected an extent that a double can hold")))
    }

    /// Length of the diagonal.
    pub fn diagonal(&self) -> f64 {
        self.size().length()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_scales_exactly_and_back() {
        for side in [1e-300, 3e-12, 0.25, 0.5, 1.0, 7.3, 1e7, 1e300] {
            let extent = Extent { min: DVec3::ZERO, max: DVec3::new(side, side / 3.0, 0.0) };
            let frame = Frame::of(&extent);
            let unit = frame.to_frame(side);
            assert!((0.5..1.0).contains(&unit), "{side} became {unit}");
            assert_eq!(frame.to_file(unit), side);
        }
    }

    #[test]
    fn a_far_extent_is_counted_from_its_middle() {
        let local = Extent { min: DVec3::new(-1.25, 0.1, 3.0), max: DVec3::new(2.5, 0.7, 3.3) };
        let far = DVec3::new(500_000.0, -4_500_000.0, 0.0);
        let moved = Extent { min: local.min + far, max: local.max + far };
        let (frame, home) = (Frame::around::<f64>(&moved), Frame::around::<f64>(&local));
        assert_eq!(home, Frame::of(&local));
        for p in [moved.min, moved.max, moved.min + DVec3::new(0.1, 0.2, 0.3)] {
            // Exact, there and back, and like at home.
            assert_eq!(frame.place_back(frame.place(p)), p);
            assert_eq!(frame.place(p), home.place(p - far));
        }
        assert!(frame.place(DVec3::new(0.0, 0.0, -0.0)).z.is_sign_negative());
        assert!(frame.place_back(DVec3::new(0.0, 0.0, -0.0)).z.is_sign_negative());
        // Floats stay where they are, and doubles that are coarser there than floats at home.
        assert_eq!(Frame::around::<f32>(&moved), Frame::of(&moved));
        let farther = Extent { min: DVec3::splat(1e15), max: DVec3::splat(1e15) + local.size() };
        assert_eq!(Frame::around::<f64>(&farther), Frame::of(&farther));
    }

    #[test]
    fn a_point_keeps_its_units() {
        let extent = Extent { min: DVec3::splat(4.0), max: DVec3::splat(4.0) };
        assert_eq!(Frame::of(&extent).to_frame(3.5), 3.5);
        assert_eq!(Frame::of(&Extent::default()), Frame::default());
    }
}
