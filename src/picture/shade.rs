//! How bright a surface is.

use glam::Vec3;
use std::sync::LazyLock;

/// Towards the lamps, as the eye has them, with their strengths: a key light from the upper left, a fill from the right, and
/// one at the eye, so that nothing is black.
const LAMPS: [(Vec3, f32); 3] =
    [(Vec3::new(-0.451, 0.702, 0.551), 0.66), (Vec3::new(0.796, 0.1, 0.597), 0.16), (Vec3::new(0.0, 0.0, 1.0), 0.2)];

/// What is bright wherever it faces.
const AMBIENT: f32 = 0.07;

/// What a surface without colours of its own reflects, in linear light: a warm grey.
pub(super) const PLAIN: Vec3 = Vec3::new(0.70, 0.67, 0.62);

/// The light on a surface of such a normal, which faces the eye.
pub(super) fn light(normal: Vec3) -> f32 {
    LAMPS.iter().fold(AMBIENT, |sum, (toward, strength)| sum + strength * normal.dot(*toward).max(0.0))
}

/// Between linear light and what a screen takes, by tables.
pub(super) struct Tones {
    srgb: Vec<u8>,
    linear: Vec<f32>,
}

const STEPS: usize = 4096;

impl Tones {
    /// The tables.
    pub(super) fn get() -> &'static Tones {
        static TONES: LazyLock<Tones> = LazyLock::new(|| Tones {
            srgb: (0..=STEPS).map(|i| (255.0 * shown(i as f32 / STEPS as f32)).round() as u8).collect(),
            linear: (0..256).map(|i| reflected(i as f32 / 255.0)).collect(),
        });
        &TONES
    }

    /// A colour in linear light as a screen takes it.
    pub(super) fn to_srgb(&self, linear: Vec3) -> [u8; 3] {
        let tone = |x: f32| self.srgb[(x.clamp(0.0, 1.0) * STEPS as f32) as usize];
        [tone(linear.x), tone(linear.y), tone(linear.z)]
    }

    /// Linear light from what a screen takes.
    pub(super) fn to_linear(&self, srgb: [u8; 3]) -> Vec3 {
        let tone = |x: u8| self.linear[usize::from(x)];
        Vec3::new(tone(srgb[0]), tone(srgb[1]), tone(srgb[2]))
    }
}

fn shown(x: f32) -> f32 {
    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * x.powf(1.0 / 2.4) - 0.055 }
}

fn reflected(x: f32) -> f32 {
    if x <= 0.040_45 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn screens_and_linear_light_are_each_others_inverse() {
        for x in 0..=255u8 {
            let tones = Tones::get();
            let back = tones.to_srgb(tones.to_linear([x; 3]))[0];
            assert!(back.abs_diff(x) <= 1, "{x} {back}");
        }
    }

    #[test]
    fn what_faces_the_eye_is_brighter_than_what_is_seen_from_the_side() {
        assert!(light(Vec3::Z) > 1.5 * light(Vec3::X));
        assert!(light(Vec3::NEG_Y) >= AMBIENT && light(Vec3::new(-0.4, 0.6, 0.6).normalize()) <= 1.0);
    }
}
