//! The least-squares system of one round: where the vertices should go.
//!
//! A sample at `s`, nearest to the place `Σ λᵢ xᵢ` on a face with unit normal `n`, asks that moving the face's vertices
//! by `δᵢ` brings the place to it: `w·(n·(Σ λᵢ δᵢ − r))² + μ·w·|Σ λᵢ δᵢ − r|²`, `r` from the place to the sample. All
//! samples of a face share `n`, so that a face adds up to one symmetric 3 × 3 matrix of weights and three right-hand
//! sides, whatever their number; the system is applied face by face and never written out.

use super::lanes::{Vec3x8, sum};
use crate::cores::InPieces;
use crate::mesh::adjacency::{Stars, parts};
use fearless_simd::{Simd, f32x8, prelude::*};
use glam::{Mat3, Vec3};
use rayon::prelude::*;

/// Weight of the distance along the face against that across it: enough to hold the mesh together. 0.05 costs 2 % of
/// E_avg,
/// 0.15 costs 6 %, 0.01 lets single vertices slide (E_max of the femur and the dragon rises by a tenth).
const ALONG: f32 = 0.02;

/// Pull towards staying, as a share of the mean weight of a vertex.
const STAY: f32 = 1e-3;

/// Steps of the conjugate gradients: 2 lose 0.5 %, 8 gain nothing.
const STEPS: usize = 3;

/// What the samples of one face ask of its corners. 72 bytes.
#[derive(Clone, Copy, Default)]
pub(super) struct Block {
    /// Unit normal.
    normal: Vec3,
    /// `Σ w λᵢ λⱼ`: 00, 01, 02, 11, 12, 22.
    weights: [f32; 6],
    /// `Σ w λᵢ (n nᵀ + μ) r`.
    sides: [Vec3; 3],
}

impl Block {
    /// Adds the wish of one more sample: that the place at `lambda` moves by `step`.
    #[inline(always)]
    pub fn add(&mut self, weight: f32, lambda: [f32; 3], step: Vec3) {
        let pull = weight * self.pull(step);
        let [a, b, c] = lambda;
        for (side, l) in self.sides.iter_mut().zip(lambda) {
            *side += l * pull;
        }
        for (sum, l) in self.weights.iter_mut().zip([a * a, a * b, a * c, b * b, b * c, c * c]) {
            *sum += weight * l;
        }
    }

    /// `(n nᵀ + μ) x`.
    #[inline(always)]
    fn pull(&self, x: Vec3) -> Vec3 {
        self.normal * self.normal.dot(x) + ALONG * x
    }

    fn matrix(&self) -> Mat3 {
        let n = self.normal;
        Mat3::from_cols(n * n.x, n * n.y, n * n.z) + Mat3::from_diagonal(Vec3::splat(ALONG))
    }

    #[inline(always)]
    fn weight(&self, i: usize, j: usize) -> f32 {
        self.weights[[[0, 1, 2], [1, 3, 4], [2, 4, 5]][i & 3][j & 3]]
    }
}

/// What samples ask of one face, eight sums at a time.
pub(super) struct Wishes<V: Simd> {
    /// As [`Block::weights`].
    weights: [f32x8<V>; 6],
    /// `Σ w λᵢ r`.
    sides: [Vec3x8<V>; 3],
}

impl<V: Simd> Wishes<V> {
    /// None yet.
    #[inline(always)]
    pub fn new(simd: V) -> Self {
        Wishes { weights: [f32x8::splat(simd, 0.0); 6], sides: [Vec3x8::splat(simd, Vec3::ZERO); 3] }
    }

    /// Adds the wishes of eight samples: that the places at `lambda` move by `step`.
    #[inline(always)]
    pub fn add(&mut self, weight: f32x8<V>, lambda: [f32x8<V>; 3], step: Vec3x8<V>) {
        let [a, b, c] = lambda;
        let [wa, wb, wc] = [weight * a, weight * b, weight * c];
        for (side, l) in self.sides.iter_mut().zip([wa, wb, wc]) {
            *side = side.plus(l, step);
        }
        for (sum, l) in self.weights.iter_mut().zip([wa * a, wa * b, wa * c, wb * b, wb * c, wc * c]) {
            *sum += l;
        }
    }

    /// All of them, of a face with unit normal `normal`.
    #[inline(always)]
    pub fn of_face(&self, normal: Vec3) -> Block {
        let block = Block { normal, weights: self.weights.map(sum), ..Block::default() };
        Block { sides: self.sides.map(|side| block.pull(side.sum())), ..block }
    }
}

/// The system of all faces, over the vertices that may move.
pub(super) struct System<'a> {
    pub faces: &'a [[u32; 3]],
    pub stars: &'a Stars,
    pub fixed: &'a [bool],
    pub blocks: &'a [Block],
}

impl System<'_> {
    /// The steps that minimise the sum, nearly: conjugate gradients, preconditioned by each vertex's own 3 × 3 block.
    pub fn solve(&self) -> Vec<Vec3> {
        let n = self.fixed.len();
        let total: f64 = self.blocks.iter().map(|b| f64::from(b.weights[0] + b.weights[3] + b.weights[5])).sum();
        let stay = STAY * (total / n.max(1) as f64) as f32;
        let inverses: Vec<Mat3> = self.vertices(|v| {
            let own =
                |&c: &u32| self.blocks[parts(c).0].matrix() * self.blocks[parts(c).0].weight(parts(c).1, parts(c).1);
            let sum = self.stars.of(v).iter().map(own).fold(Mat3::from_diagonal(Vec3::splat(stay)), |a, b| a + b);
            let inverse = sum.inverse();
            if self.fixed[v as usize] || !inverse.is_finite() { Mat3::ZERO } else { inverse }
        });
        let mut rest: Vec<Vec3> =
            self.vertices(|v| self.stars.of(v).iter().map(|&c| self.blocks[parts(c).0].sides[parts(c).1 & 3]).sum());
        let mut found = vec![Vec3::ZERO; n];
        let mut scaled: Vec<Vec3> = self.vertices(|v| inverses[v as usize] * rest[v as usize]);
        let mut way = scaled.clone();
        let mut left = dot(&rest, &scaled);
        for _ in 0..STEPS {
            let image = self.vertices(|v| if self.fixed[v as usize] { Vec3::ZERO } else { self.image(&way, v, stay) });
            let bend = dot(&way, &image);
            if !(left > 0.0 && bend > 0.0) {
                break;
            }
            let length = (left / bend) as f32;
            for (v, found) in found.iter_mut().enumerate() {
                *found += length * way[v];
                rest[v] -= length * image[v];
                scaled[v] = inverses[v] * rest[v];
            }
            let before = std::mem::replace(&mut left, dot(&rest, &scaled));
            let keep = (left / before) as f32;
            way.iter_mut().zip(&scaled).for_each(|(way, s)| *way = *s + keep * *way);
        }
        found
    }

    /// The system's row of one vertex, times `x`.
    fn image(&self, x: &[Vec3], v: u32, stay: f32) -> Vec3 {
        let mut y = stay * x[v as usize];
        for &corner in self.stars.of(v) {
            let (f, i) = parts(corner);
            let block = &self.blocks[f];
            let [a, b, c] = self.faces[f].map(|u| x[u as usize]);
            y += block.pull(a * block.weight(i, 0) + b * block.weight(i, 1) + c * block.weight(i, 2));
        }
        y
    }

    fn vertices<T: Send>(&self, each: impl Fn(u32) -> T + Sync + Send) -> Vec<T> {
        (0..self.fixed.len() as u32).into_par_iter().in_pieces(256).map(each).collect()
    }
}

/// In order, in double precision: threads cannot change it.
fn dot(a: &[Vec3], b: &[Vec3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a.dot(*b))).sum()
}
