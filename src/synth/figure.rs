//! The figure: a bust in millimetres, swept from its foot to its crown.
//!
//! A level of the sweep is an ellipse that a cubic spline through [`PROFILE`] gives; features, cloth, hair and weather are
//! displacements along the ellipses' normal. The surface is smooth, closed, and the same on every machine.

use super::noise::{Lattice, ramp, signed_unit};
use crate::mesh::mix;
use glam::DVec3;

/// Control levels: height, forward offset of the axis (−y is the front), half width, half depth.
const PROFILE: [[f64; 4]; 43] = [
    [0.0, 0.0, 0.0, 0.0],
    [0.0, 0.0, 34.0, 34.0],
    [0.0, 0.0, 68.0, 68.0],
    [0.0, 0.0, 86.0, 86.0],
    [2.0, 0.0, 90.0, 90.0],
    [12.0, 0.0, 91.0, 91.0],
    [22.0, 0.0, 88.0, 88.0],
    [27.0, 0.0, 74.0, 74.0],
    [31.0, 0.0, 66.0, 66.0],
    [36.0, 0.0, 69.0, 69.0],
    [42.0, 0.0, 66.0, 66.0],
    [48.0, 0.0, 52.0, 52.0],
    [62.0, 0.0, 44.0, 44.0],
    [78.0, 0.0, 46.0, 45.0],
    [92.0, 0.0, 60.0, 54.0],
    [102.0, 0.0, 86.0, 68.0],
    [116.0, 0.0, 114.0, 82.0],
    [140.0, 0.0, 137.0, 93.0],
    [170.0, 0.0, 155.0, 101.0],
    [203.0, 0.0, 168.0, 105.0],
    [236.0, 2.0, 176.0, 103.0],
    [264.0, 5.0, 172.0, 96.0],
    [286.0, 9.0, 152.0, 86.0],
    [302.0, 12.0, 118.0, 74.0],
    [316.0, 13.0, 82.0, 64.0],
    [332.0, 14.0, 60.0, 56.0],
    [350.0, 14.0, 53.0, 53.0],
    [370.0, 13.0, 51.0, 52.0],
    [386.0, 4.0, 53.0, 62.0],
    [400.0, -4.0, 57.0, 75.0],
    [416.0, -5.0, 62.0, 81.0],
    [436.0, -4.0, 66.0, 86.0],
    [458.0, -2.0, 69.0, 90.0],
    [482.0, 0.0, 71.0, 93.0],
    [506.0, 2.0, 73.0, 95.0],
    [530.0, 3.0, 73.0, 94.0],
    [552.0, 4.0, 69.0, 88.0],
    [568.0, 5.0, 60.0, 76.0],
    [579.0, 6.0, 47.0, 59.0],
    [585.0, 6.0, 32.0, 40.0],
    [588.0, 6.0, 16.0, 20.0],
    [588.5, 6.0, 6.0, 7.5],
    [588.5, 6.0, 0.0, 0.0],
];

/// A bump: centre, radii, height along the normal. Mirrored where the centre is off the plane of symmetry.
struct Bump {
    centre: [f64; 3],
    radii: [f64; 3],
    height: f64,
}

const fn bump(centre: [f64; 3], radii: [f64; 3], height: f64) -> Bump {
    Bump { centre, radii, height }
}

/// The face.
const BUMPS: [Bump; 21] = [
    bump([0.0, -92.0, 470.0], [15.0, 45.0, 36.0], 13.0), // bridge of the nose
    bump([0.0, -90.0, 451.0], [17.0, 45.0, 19.0], 16.0), // tip
    bump([10.0, -88.0, 445.0], [11.0, 40.0, 10.0], 6.0), // wings
    bump([29.0, -84.0, 481.0], [25.0, 40.0, 17.0], -10.0), // sockets
    bump([29.0, -82.0, 480.0], [16.0, 40.0, 10.0], 9.5), // eyes
    bump([29.0, -82.0, 485.5], [19.0, 40.0, 4.5], 2.5),  // lids
    bump([27.0, -86.0, 497.0], [32.0, 45.0, 12.0], 6.0), // brows
    bump([0.0, -92.0, 520.0], [60.0, 40.0, 30.0], 3.0),  // forehead
    bump([43.0, -68.0, 462.0], [28.0, 45.0, 22.0], 5.0), // cheekbones
    bump([46.0, -58.0, 434.0], [22.0, 40.0, 24.0], -4.0), // cheeks
    bump([0.0, -84.0, 427.0], [34.0, 45.0, 22.0], 5.0),  // mouth
    bump([0.0, -86.0, 428.5], [23.0, 40.0, 6.5], 4.5),   // upper lip
    bump([0.0, -84.0, 417.0], [20.0, 40.0, 7.5], 5.5),   // lower lip
    bump([0.0, -85.0, 422.5], [25.0, 40.0, 3.4], -3.5),  // between them
    bump([0.0, -88.0, 438.0], [5.0, 40.0, 8.0], -2.0),   // philtrum
    bump([0.0, -76.0, 396.0], [26.0, 45.0, 20.0], 12.0), // chin
    bump([44.0, -40.0, 403.0], [30.0, 52.0, 22.0], 3.0), // jaw
    bump([71.0, 8.0, 470.0], [45.0, 17.0, 31.0], 15.0),  // ears
    bump([71.0, 3.0, 473.0], [45.0, 9.0, 18.0], -9.0),   // their shells
    bump([66.0, -50.0, 500.0], [30.0, 30.0, 26.0], -4.0), // temples
    bump([30.0, -46.0, 345.0], [16.0, 60.0, 60.0], 3.0), // muscles of the neck
];

/// Weather: wavelengths and heights, of which a scan shows those that it resolves.
const WEATHER: [[f64; 2]; 6] = [[48.0, 0.9], [19.0, 0.4], [7.0, 0.16], [2.7, 0.07], [1.0, 0.028], [0.4, 0.011]];

/// The figure of a seed.
pub(super) struct Figure {
    lattice: Lattice,
    profile: [[f64; 4]; 43],
}

/// One level of the sweep, prepared for its points.
pub(super) struct Level {
    height: f64,
    forward: f64,
    half: [f64; 2],
    slope: [f64; 4],
    /// Which bumps reach this height, one bit each.
    bumps: u32,
}

/// A point of the smooth figure and the direction in which the rest is laid on.
pub(super) struct Footing {
    ground: DVec3,
    normal: DVec3,
    /// The ground with the features on it.
    pub(super) smooth: DVec3,
}

impl Figure {
    /// The figure of a seed: its noise, and proportions a little of its own.
    pub(super) fn new(seed: u64) -> Self {
        let mut profile = PROFILE;
        let own = |part: u64| 1.0 + 0.05 * signed_unit(mix(seed) ^ part);
        let (shoulders, girth, width, depth) = (own(1), own(2), own(3), own(4));
        for level in &mut profile {
            let torso = ramp(level[0], 60.0, 150.0) * (1.0 - ramp(level[0], 290.0, 340.0));
            let head = ramp(level[0], 340.0, 420.0);
            level[2] *= 1.0 + (shoulders - 1.0) * torso + (width - 1.0) * head;
            level[3] *= 1.0 + (girth - 1.0) * torso + (depth - 1.0) * head;
        }
        Figure { lattice: Lattice::new(seed), profile }
    }

    /// The level at `u` of the sweep, from 0 at the foot to 1 at the crown.
    pub(super) fn level(&self, u: f64) -> Level {
        let last = self.profile.len() - 1;
        let at = u * last as f64;
        let knot = (at as usize).min(last - 1);
        let t = at - knot as f64;
        // Mirrored beyond both ends, where the sweep meets its axis at a right angle.
        let mirrored = |c: [f64; 4]| [c[0], c[1], -c[2], -c[3]];
        let before = if knot == 0 { mirrored(self.profile[1]) } else { self.profile[knot - 1] };
        let after = if knot + 2 > last { mirrored(self.profile[last - 1]) } else { self.profile[knot + 2] };
        let control = [before, self.profile[knot], self.profile[knot + 1], after];
        let s = 1.0 - t;
        let weight = [s * s * s, 4.0 - 6.0 * t * t + 3.0 * t * t * t, 4.0 - 6.0 * s * s + 3.0 * s * s * s, t * t * t];
        let slope_weight = [-s * s, 3.0 * t * t - 4.0 * t, 4.0 * s - 3.0 * s * s, t * t];
        let sum = |weight: [f64; 4], i: usize, scale: f64| {
            let [a, b, c, d] = control;
            (a[i] * weight[0] + b[i] * weight[1] + c[i] * weight[2] + d[i] * weight[3]) * scale
        };
        let value = [0, 1, 2, 3].map(|i| sum(weight, i, 1.0 / 6.0));
        let height = value[0];
        let reaches = |b: &Bump| (height - b.centre[2]).abs() < b.radii[2];
        Level {
            height,
            forward: value[1],
            half: [value[2], value[3]],
            slope: [0, 1, 2, 3].map(|i| sum(slope_weight, i, 0.5)),
            bumps: BUMPS.iter().enumerate().fold(0, |bits, (i, b)| bits | u32::from(reaches(b)) << i),
        }
    }

    /// The smooth figure at a level and an angle in quarter turns, counter-clockwise from the back.
    #[inline]
    pub(super) fn footing(&self, level: &Level, quarters: f64) -> Footing {
        let [sin, cos] = turn(quarters);
        let [a, b] = level.half;
        let ground = DVec3::new(-a * sin, level.forward + b * cos, level.height);
        let [rise, drift, da, db] = level.slope;
        let across = DVec3::new(-b * sin * rise, a * cos * rise, -(a * cos * (drift + db * cos) + b * da * sin * sin));
        let length = across.length();
        // On the axis the sweep is level: foot and crown look down and up.
        let upright = DVec3::new(0.0, 0.0, if level.height < 100.0 { -1.0 } else { 1.0 });
        let normal = if length > 1e-9 { across / length } else { upright };
        Footing { ground, normal, smooth: ground + normal * features(level, ground) }
    }

    /// The finished point: cloth, hair, lobes and weather, as far as edges of length `edge` show them, and `grain` on top.
    #[inline]
    pub(super) fn point(&self, footing: &Footing, edge: f64, grain: f64) -> DVec3 {
        let p = footing.ground;
        let mut laid = footing.smooth - p;
        let noise = &self.lattice;
        // The foot was turned on a lathe; lobes begin above it.
        let carved = ramp(p.z, 50.0, 130.0);
        let mut height = grain;
        if carved > 0.0 {
            height += carved * 5.0 * noise.at(p / 110.0, 0);
        }
        height += self.cloth(p) + self.hair(p);
        for (octave, [wavelength, amount]) in WEATHER.into_iter().enumerate() {
            let shown = ramp(wavelength, 2.5 * edge, 5.0 * edge);
            if shown == 0.0 {
                break;
            }
            height += shown * amount * noise.at(p / wavelength, 8 + octave as u32);
        }
        laid += footing.normal * height;
        p + laid
    }

    /// Folds that fall from the shoulders and meet at the breast.
    #[inline]
    fn cloth(&self, p: DVec3) -> f64 {
        let cover = ramp(p.z, 96.0, 130.0) * (1.0 - ramp(p.z + 0.22 * p.y - 0.00075 * p.x * p.x, 262.0, 277.0));
        if cover == 0.0 {
            return 0.0;
        }
        let noise = &self.lattice;
        let sway = noise.at(p / 90.0, 1);
        // Across the folds quickly, along them slowly; they lean towards the middle.
        let lean = p.x + 0.00115 * p.x * (p.z - 330.0) * 1.6 + 26.0 * sway;
        let along = DVec3::new(lean / 46.0, p.y / 70.0, p.z / 190.0);
        let folds = noise.ridge(along, 2);
        let creases = noise.ridge(along * 2.3, 3);
        cover * (4.0 + 10.0 * folds + 3.0 * creases)
    }

    /// Curls on the crown and down to the nape.
    #[inline]
    fn hair(&self, p: DVec3) -> f64 {
        let cover = ramp(p.z + 0.62 * p.y, 474.0, 486.0) * ramp(p.z, 372.0, 396.0);
        if cover == 0.0 {
            return 0.0;
        }
        let noise = &self.lattice;
        let twist = DVec3::new(noise.at(p / 34.0, 4), noise.at(p / 34.0, 5), noise.at(p / 34.0, 6)) * 13.0;
        let curls = noise.ridge((p + twist) / 21.0, 7);
        let strands = noise.ridge((p + twist) / 7.5, 15);
        cover * (4.0 + 6.0 * curls + 1.2 * strands)
    }
}

/// Sine and cosine of a number of quarter turns in `[0, 4)`, by the rational circle: even enough in speed, and exact.
#[inline]
fn turn(quarters: f64) -> [f64; 2] {
    let quadrant = quarters as u32;
    let f = quarters - f64::from(quadrant);
    let d = 1.0 + f * f;
    let (c, s) = ((1.0 - f * f) / d, 2.0 * f / d);
    match quadrant & 3 {
        0 => [s, c],
        1 => [c, -s],
        2 => [-s, -c],
        _ => [-c, s],
    }
}

#[inline]
fn features(level: &Level, p: DVec3) -> f64 {
    let (mut sum, mut bits) = (0.0, level.bumps);
    while bits != 0 {
        let Bump { centre, radii, height } = &BUMPS[bits.trailing_zeros() as usize];
        bits &= bits - 1;
        let x = (if centre[0] > 0.0 { p.x.abs() } else { p.x } - centre[0]) / radii[0];
        let (y, z) = ((p.y - centre[1]) / radii[1], (p.z - centre[2]) / radii[2]);
        let near = 1.0 - (x * x + y * y + z * z);
        if near > 0.0 {
            sum += height * near * near * near;
        }
    }
    sum
}
