//! Which points of a mesh are measured.
//!
//! Over the area: a face gets `⌊area × density + u⌋` samples, with `u` drawn from the face's number and the seed, so that
//! every face gets its share, on average exactly, and nobody has to know the faces before it. Within a face they follow a
//! sequence of low discrepancy from a drawn start. Vertices: every so many, counted by number.

use crate::facets::NUMBER_BITS;
use crate::mesh::mix;
use glam::DVec3;

/// How samples are spread over the faces of a mesh.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spread {
    /// Samples for each unit of area.
    density: f64,
    seed: u64,
}

impl Spread {
    /// About `samples` over `area`; none over a mesh without area.
    pub(super) fn new(samples: u64, area: f64, seed: u64) -> Self {
        let density = samples as f64 / area;
        Spread { density: if density.is_finite() { density } else { 0.0 }, seed }
    }

    /// Gives the samples of a face to `take`.
    #[inline(always)]
    pub(super) fn over(&self, face: u32, [a, b, c]: [DVec3; 3], take: impl FnMut(DVec3)) {
        let (ab, ac) = (b - a, c - a);
        let drawn = mix(self.seed ^ mix(u64::from(face & ((1 << NUMBER_BITS) - 1))));
        let count = (area_of(ab, ac) * self.density + unit(drawn)) as u64;
        if count > 0 {
            scatter(count, mix(drawn), [a, b, c], take);
        }
    }
}

/// Gives evenly spread points of a face to `take`; `start` says where they begin.
pub(super) fn scatter(count: u64, start: u64, [a, b, c]: [DVec3; 3], mut take: impl FnMut(DVec3)) {
    let (ab, ac) = (b - a, c - a);
    let (mut u, mut v) = (unit(start), unit(start << 32));
    for _ in 0..count {
        let (s, t) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
        take(a + ab * s + ac * t);
        (u, v) = ((u + STEP[0]).fract(), (v + STEP[1]).fract());
    }
}

/// 1/g and 1/g² for the real root g of g³ = g + 1: multiples of this step spread over the unit square evenly
/// (M. Roberts, the R₂ sequence).
const STEP: [f64; 2] = [0.754_877_666_246_692_8, 0.569_840_290_998_053_3];

/// The area of a triangle with these two sides.
#[inline(always)]
pub(super) fn area_of(ab: DVec3, ac: DVec3) -> f64 {
    0.5 * ab.cross(ac).length()
}

/// In `0..1`, from the upper 32 bits.
#[inline(always)]
fn unit(x: u64) -> f64 {
    (x >> 32) as f64 * (1.0 / (1u64 << 32) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_as_many_as_asked_on_average_and_within_their_face() {
        let face = [DVec3::new(1.0, 0.0, 2.0), DVec3::new(3.0, 0.0, 2.0), DVec3::new(1.0, 1.0, 2.0)];
        let spread = Spread::new(25_000, 10_000.0, 7);
        let (mut count, mut mean) = (0, DVec3::ZERO);
        for number in 0..10_000 {
            let before = count;
            spread.over(number, face, |p| {
                let (s, t) = ((p.x - 1.0) / 2.0, p.y);
                assert!(s >= 0.0 && t >= 0.0 && s + t <= 1.0 + 1e-15 && p.z == 2.0, "{p}");
                (count, mean) = (count + 1, mean + p);
            });
            assert!((2..=3).contains(&(count - before)));
        }
        assert!((24_900..25_100).contains(&count), "{count}");
        assert!((mean / f64::from(count) - (face[0] + face[1] + face[2]) / 3.0).length() < 0.01, "{mean}");
    }

    #[test]
    fn samples_of_one_face_fill_it_evenly() {
        let face = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let mut counts = [0; 4];
        Spread::new(4_000, 0.5, 1).over(0, face, |p| {
            let quarter = if p.x > 0.5 {
                1
            } else if p.y > 0.5 {
                2
            } else {
                3 * usize::from(p.x + p.y > 0.5)
            };
            counts[quarter] += 1;
        });
        assert!(counts.iter().all(|n| (960..1040).contains(n)), "{counts:?}");
    }

    #[test]
    fn a_seed_moves_samples_and_no_area_has_none() {
        let face = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let first = |seed| {
            let mut places = Vec::new();
            Spread::new(3, 0.5, seed).over(9, face, |p| places.push(p));
            places
        };
        assert_eq!(first(1), first(1));
        assert_ne!(first(1), first(2));
        Spread::new(1_000_000, 0.0, 1).over(0, [DVec3::ZERO; 3], |_| panic!("a sample of nothing"));
    }
}
