//! Coordinates: the scalar they are stored in and the power of two they are scaled by.
//!
//! A scan is scaled so that its longest side is in `[0.5, 1)`. The factor is a power of two, so scaling is exact in both
//! directions, every constant of the later stages is relative to a scan of size one, and a scan scaled by a power of two
//! gives the same mesh, scaled. Nothing is translated: a position keeps the bits it came with (an offset of 500 km in
//! doubles survives), and arithmetic is done in `f64` on differences.

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

/// The power of two between the file's units and the frame that the stages work in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Frame {
    exponent: i32,
}

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
        Frame { exponent: (scaled.to_bits() >> 52 & 0x7ff) as i32 - 1022 + shift }
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
    fn a_point_keeps_its_units() {
        let extent = Extent { min: DVec3::splat(4.0), max: DVec3::splat(4.0) };
        assert_eq!(Frame::of(&extent).to_frame(3.5), 3.5);
        assert_eq!(Frame::of(&Extent::default()), Frame::default());
    }
}
