//! Deviations as colours.
//!
//! The scale is even to the eye and for every kind of colour vision: lightness rises in proportion to the length, from a
//! dark violet (nothing) by way of blue, teal and green to a light yellow ([`Scale::top`] and beyond), at the same strength
//! of colour throughout. It is computed in Oklab (B. Ottosson, 2020), whose lightness from 0.25 to 0.95, hue from 290° to
//! 105° and chroma of 0.09 all lie within what sRGB can show.
//!
//! The top is not the largest deviation, which a single vertex may have and which would leave all others dark, but the one
//! that 99 vertices of 100 stay within.

/// Colours for lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scale {
    top: f64,
}

/// The share of vertices whose deviation is within the scale.
const WITHIN: f64 = 0.99;

const LIGHTNESS: [f64; 2] = [0.25, 0.95];
const HUE: [f64; 2] = [290.0, 105.0];
const CHROMA: f64 = 0.09;

impl Scale {
    /// The scale for some deviations. Where nearly all are nothing its top is the largest.
    pub fn of(deviations: &[f64]) -> Scale {
        let mut sorted = deviations.to_vec();
        sorted.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| sorted.get(((sorted.len() as f64 * share) as usize).min(sorted.len().max(1) - 1));
        let top = at(WITHIN).filter(|top| **top > 0.0).or(sorted.last());
        Scale { top: top.copied().unwrap_or(0.0) }
    }

    /// The length that has the last colour; what is longer has it too.
    pub fn top(&self) -> f64 {
        self.top
    }

    /// So many colours of any scale, from nothing to the last.
    pub fn ramp(colours: usize) -> impl Iterator<Item = [u8; 3]> {
        let scale = Scale { top: 1.0 };
        (0..colours).map(move |i| scale.colour(i as f64 / (colours - 1).max(1) as f64))
    }

    /// The colour of a length, in sRGB.
    pub fn colour(&self, length: f64) -> [u8; 3] {
        let t = if self.top > 0.0 { (length / self.top).clamp(0.0, 1.0) } else { 0.0 };
        let between = |[from, to]: [f64; 2]| from + t * (to - from);
        let (sin, cos) = between(HUE).to_radians().sin_cos();
        oklab_to_srgb([between(LIGHTNESS), CHROMA * cos, CHROMA * sin])
    }
}

fn oklab_to_srgb([lightness, a, b]: [f64; 3]) -> [u8; 3] {
    let cube = |x: f64| x * x * x;
    let l = cube(lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b);
    let m = cube(lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b);
    let s = cube(lightness - 0.089_484_177_5 * a - 1.291_485_548 * b);
    let linear = [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701 * s,
    ];
    linear.map(|x| {
        let shown = if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 };
        (255.0 * shown).round().clamp(0.0, 255.0) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_go_from_dark_violet_to_light_yellow() {
        let scale = Scale { top: 2.0 };
        assert_eq!([0.0, 1.0, 2.0].map(|x| scale.colour(x)), [[35, 22, 73], [43, 145, 147], [247, 243, 172]]);
        assert_eq!(scale.colour(9.0), scale.colour(2.0));
        // Every step is lighter to the eye than the one before (luma of Rec. 709).
        let luma = |x: u32| {
            let [r, g, b] = scale.colour(f64::from(x) / 50.0).map(f64::from);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        assert!((0..100).all(|x| luma(x) < luma(x + 1) + 0.5));
        assert!((0..95).all(|x| luma(x) + 5.0 < luma(x + 5)));
    }

    #[test]
    fn the_top_passes_over_a_few_large_ones() {
        let mut deviations: Vec<f64> = (0..1000).map(f64::from).collect();
        deviations[3] = 1e9;
        assert_eq!(Scale::of(&deviations).top(), 991.0);
        assert_eq!(Scale::of(&[0.0, 0.0, 7.0]).top(), 7.0);
        assert_eq!((Scale::of(&[0.0; 5]).top(), Scale::of(&[]).top()), (0.0, 0.0));
        assert_eq!(Scale::of(&[0.0; 5]).colour(0.0), Scale { top: 1.0 }.colour(0.0));
    }
}
