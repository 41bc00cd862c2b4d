//! What a camera exposes: depth and colour of the nearest surface behind each sample.

use super::shade::{PLAIN, Tones, light};
use super::{BACKGROUND, Camera, Picture};
use glam::{DVec3, Vec2, Vec3, Vec3Swizzles};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Nothing is seen behind a sample.
const EMPTY: u64 = u64::MAX;

/// The low bits of a sample that only its depth is known of.
const DOT: u64 = 1 << 24;

/// The colours of a triangle.
#[derive(Debug, Clone, Copy)]
pub enum Paint<'a> {
    /// The same for all.
    Plain,
    /// One for each corner, as a screen takes it.
    Corners(&'a [[u8; 3]; 3]),
}

/// A picture being taken. Threads draw on it side by side; who comes first changes nothing.
#[derive(Debug)]
pub struct Plate {
    camera: Camera,
    /// Samples along a pixel's side.
    fineness: usize,
    /// In samples.
    width: usize,
    height: usize,
    /// Samples in a length of one.
    scale: f32,
    depth: f32,
    /// Whether edges of triangles are drawn.
    edges: bool,
    /// Depth, then colour: the least is nearest, and of the same depth the same colour wins whoever draws.
    samples: Vec<AtomicU64>,
}

impl Plate {
    /// A plate for a picture of so many pixels, with so many samples along the side of each.
    pub fn new(camera: Camera, width: usize, height: usize, fineness: usize) -> Plate {
        let scale = fineness as f64 / camera.pixel(width, height);
        let (width, height) = (width * fineness, height * fineness);
        let samples = (0..width * height).map(|_| AtomicU64::new(EMPTY)).collect();
        Plate {
            camera,
            fineness,
            width,
            height,
            scale: scale as f32,
            depth: camera.depth() as f32,
            edges: false,
            samples,
        }
    }

    /// Draws the edges of triangles, too.
    pub fn with_edges(self, edges: bool) -> Plate {
        Plate { edges, ..self }
    }

    /// What a plate for so many pixels takes.
    pub fn bytes(width: usize, height: usize, fineness: usize) -> u64 {
        (width * height * fineness * fineness * size_of::<u64>()) as u64
    }

    /// The camera that took it.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// From the eye's place to samples, with depth from 0 (nearest) to 1.
    fn project(&self, p: Vec3) -> Vec3 {
        Vec3::new(
            0.5 * self.width as f32 + p.x * self.scale,
            0.5 * self.height as f32 - p.y * self.scale,
            0.5 - 0.5 * p.z / self.depth,
        )
    }

    /// Shows the colour behind a sample if nothing nearer is seen there.
    #[inline(always)]
    fn expose(&self, sample: usize, depth: f32, colour: impl FnOnce() -> u64) {
        let depth = (f64::from(depth.clamp(0.0, 1.0)) * DEEPEST) as u64;
        let sample = &self.samples[sample];
        if depth <= sample.load(Relaxed) >> 32 {
            sample.fetch_min(depth << 32 | colour(), Relaxed);
        }
    }

    /// Whether a position is in the picture, or a tenth of its size beside it.
    pub(super) fn is_around(&self, p: Vec3) -> bool {
        let p = self.project(p);
        let (width, height) = (self.width as f32, self.height as f32);
        p.x > -0.1 * width && p.x < 1.1 * width && p.y > -0.1 * height && p.y < 1.1 * height
    }

    /// Draws a position of which nothing else is known.
    pub(super) fn dot(&self, p: Vec3) {
        let p = self.project(p);
        if p.x >= 0.0 && p.y >= 0.0 && p.x < self.width as f32 && p.y < self.height as f32 {
            self.expose(p.y as usize * self.width + p.x as usize, p.z, || DOT);
        }
    }

    /// Draws a triangle that the eye sees so.
    #[inline]
    pub(super) fn triangle(&self, corners: [Vec3; 3], paint: Paint) {
        let (a, b, c) = (self.project(corners[0]), self.project(corners[1]), self.project(corners[2]));
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        let (left, right) = covered(low.x, high.x, self.width);
        let (top, bottom) = covered(low.y, high.y, self.height);
        if left >= right || top >= bottom {
            return;
        }
        let facet = Facet::new(a, b, c);
        if !facet.is_flat() {
            self.fill(&facet, [left, right, top, bottom], corners, paint);
        }
    }

    fn fill(&self, facet: &Facet, [left, right, top, bottom]: [usize; 4], corners: [Vec3; 3], paint: Paint) {
        let mut bright = None;
        for y in top..bottom {
            for x in left..right {
                let Some(weights) = facet.weights(x, y) else { continue };
                self.expose(y * self.width + x, facet.depth(weights), || {
                    let bright = *bright.get_or_insert_with(|| brightness(corners));
                    let tones = Tones::get();
                    let colour = match paint {
                        Paint::Plain => PLAIN,
                        Paint::Corners(corners) => mixed(tones, corners, weights),
                    };
                    let edge = if self.edges && facet.on_edge(weights) { EDGE_SHADE } else { 1.0 };
                    packed(tones.to_srgb(colour * (bright * edge)))
                });
            }
        }
    }

    /// The picture: dots shaded, samples averaged.
    pub fn develop(&self) -> Picture {
        let n = self.fineness;
        let (width, height) = (self.width / n, self.height / n);
        let tones = Tones::get();
        let mut rgb = Vec::with_capacity(3 * width * height);
        for y in 0..height {
            for x in 0..width {
                let mut sum = Vec3::ZERO;
                for k in 0..n * n {
                    sum += tones.to_linear(self.sample(n * x + k % n, n * y + k / n));
                }
                rgb.extend(tones.to_srgb(sum / (n * n) as f32));
            }
        }
        Picture { width, height, rgb }
    }

    fn at(&self, x: usize, y: usize) -> u64 {
        self.samples[y * self.width + x].load(Relaxed)
    }

    /// The colour of a sample.
    fn sample(&self, x: usize, y: usize) -> [u8; 3] {
        match self.at(x, y) {
            EMPTY => self.between_dots(x, y),
            key if key & DOT != 0 => self.among_dots(x, y),
            key => [(key >> 16) as u8, (key >> 8) as u8, key as u8],
        }
    }

    /// A gap between dots is filled by what is around it.
    fn between_dots(&self, x: usize, y: usize) -> [u8; 3] {
        match self.dot_depth(x as i64, y as i64) {
            Some(_) => self.among_dots(x, y),
            None => BACKGROUND,
        }
    }

    /// A surface of dots is shaded by its slope.
    fn among_dots(&self, x: usize, y: usize) -> [u8; 3] {
        let (x, y) = (x as i64, y as i64);
        let depth = |dx: i64, dy: i64| self.dot_depth(x + dx, y + dy);
        let reach = self.fineness as i64;
        let rise = |dx: i64, dy: i64| match (depth(-dx, -dy), depth(dx, dy), depth(0, 0)) {
            (Some(a), Some(b), _) => 0.5 * (a - b),
            (Some(a), None, Some(m)) => a - m,
            (None, Some(b), Some(m)) => m - b,
            _ => 0.0,
        };
        let to_samples = 2.0 * self.depth * self.scale / reach as f32;
        let (right, up) = (to_samples * rise(reach, 0), to_samples * rise(0, -reach));
        let bright = light(Vec3::new(-right, -up, 1.0).normalize());
        Tones::get().to_srgb(PLAIN * bright)
    }

    /// The depth of a dot here, or of the nearest of those beside it where there are several.
    fn dot_depth(&self, x: i64, y: i64) -> Option<f32> {
        let depth = |x: i64, y: i64| {
            let inside = x >= 0 && y >= 0 && x < self.width as i64 && y < self.height as i64;
            let key = if inside { self.at(x as usize, y as usize) } else { EMPTY };
            (key != EMPTY && key & DOT != 0).then(|| (key >> 32) as f32 / u32::MAX as f32)
        };
        let around = || (-1..=1).flat_map(move |i| (-1..=1).map(move |j| (i, j)));
        let beside: Vec<f32> = around().filter_map(|(i, j)| depth(x + i, y + j)).collect();
        match (depth(x, y), beside.len()) {
            (None, 0..3) => None,
            // What shows through a gap in the surface in front lies behind all that is beside it.
            _ => beside.iter().copied().min_by(f32::total_cmp),
        }
    }

    /// The place on the surface around which most is to be seen: of windows of a `part` of the picture, wholly covered,
    /// the one whose brightness varies most.
    pub fn most_detailed(&self, part: f64) -> Option<DVec3> {
        let side = ((self.width.min(self.height) as f64 * part) as usize).max(self.fineness);
        let step = (side / 2).max(1);
        let mut best = (0.0, None);
        for y in (0..self.height.saturating_sub(side)).step_by(step) {
            for x in (0..self.width.saturating_sub(side)).step_by(step) {
                let varies = self.variation(x, y, side);
                if varies > best.0 {
                    best = (varies, Some((x + side / 2, y + side / 2)));
                }
            }
        }
        let (x, y) = best.1?;
        let depth = (self.at(x, y) >> 32) as f64 / f64::from(u32::MAX);
        let length = |samples: f64| samples / f64::from(self.scale);
        Some(self.camera.place([
            length(x as f64 - 0.5 * self.width as f64),
            length(0.5 * self.height as f64 - y as f64),
            (1.0 - 2.0 * depth) * f64::from(self.depth),
        ]))
    }

    /// How much a window's brightness varies; less where it is not covered.
    fn variation(&self, x: usize, y: usize, side: usize) -> f64 {
        let (mut n, mut covered, mut sum, mut squares) = (0.0, 0.0, 0.0, 0.0);
        for (i, j) in (0..side).step_by(2).flat_map(|i| (0..side).step_by(2).map(move |j| (i, j))) {
            n += 1.0;
            if self.at(x + i, y + j) != EMPTY {
                let [r, g, b] = self.sample(x + i, y + j);
                let bright = f64::from(u32::from(r) + u32::from(g) + u32::from(b));
                covered += 1.0;
                sum += bright;
                squares += bright * bright;
            }
        }
        if self.at(x + side / 2, y + side / 2) == EMPTY {
            return 0.0;
        }
        let share: f64 = covered / n;
        share.powi(4) * (squares / covered - (sum / covered).powi(2)).max(1.0)
    }
}

/// Half of the width of an edge, in samples, and how bright it is.
const EDGE: f32 = 0.9;
const EDGE_SHADE: f32 = 0.35;

/// The depth of what is farthest.
const DEEPEST: f64 = (u32::MAX - 1) as f64;

/// The samples, which are in the middle of their squares, from `low` to `high`.
#[inline(always)]
fn covered(low: f32, high: f32, most: usize) -> (usize, usize) {
    // What is not a number becomes 0, and what is negative too.
    ((low - 0.5).ceil() as usize, ((high + 0.5).floor() as usize).min(most))
}

/// A triangle in samples.
struct Facet {
    a: Vec3,
    ab: Vec3,
    ac: Vec3,
    area: f32,
    inverse: f32,
}

impl Facet {
    #[inline(always)]
    fn new(a: Vec3, b: Vec3, c: Vec3) -> Self {
        let (ab, ac) = (b - a, c - a);
        let area = ab.xy().perp_dot(ac.xy());
        Facet { a, ab, ac, area, inverse: area.recip() }
    }

    /// Seen from its side, or not a triangle at all.
    #[inline(always)]
    fn is_flat(&self) -> bool {
        !self.area.is_finite() || !self.inverse.is_finite()
    }

    /// How near a sample within it is to each of the corners.
    #[inline(always)]
    fn weights(&self, x: usize, y: usize) -> Option<Vec3> {
        let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - self.a.xy();
        let (v, w) = (p.perp_dot(self.ac.xy()) * self.inverse, self.ab.xy().perp_dot(p) * self.inverse);
        let u = 1.0 - v - w;
        (u >= 0.0 && v >= 0.0 && w >= 0.0).then_some(Vec3::new(u, v, w))
    }

    #[inline(always)]
    fn depth(&self, weights: Vec3) -> f32 {
        self.a.z + weights.y * self.ab.z + weights.z * self.ac.z
    }

    fn on_edge(&self, weights: Vec3) -> bool {
        let sides = Vec3::new((self.ac - self.ab).xy().length(), self.ac.xy().length(), self.ab.xy().length());
        (weights * self.area.abs() / sides.max(Vec3::splat(1e-6))).min_element() < EDGE
    }
}

/// The light on a triangle, seen from either side.
fn brightness([a, b, c]: [Vec3; 3]) -> f32 {
    let normal = (b - a).cross(c - a).normalize_or_zero();
    light(if normal.z < 0.0 { -normal } else { normal })
}

fn packed([r, g, b]: [u8; 3]) -> u64 {
    u64::from(r) << 16 | u64::from(g) << 8 | u64::from(b)
}

fn mixed(tones: &Tones, corners: &[[u8; 3]; 3], weights: Vec3) -> Vec3 {
    let [a, b, c] = *corners;
    tones.to_linear(a) * weights.x + tones.to_linear(b) * weights.y + tones.to_linear(c) * weights.z
}
