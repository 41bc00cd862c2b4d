//! Least squares over the faces of the result.
//!
//! A sample at barycentric coordinates `b` of a face with value `t` adds `(Σ bᵢ xᵢ − t)²`. The sums `Σ bᵢ²` a vertex,
//! `Σ bᵢ bⱼ` an edge of a face and `Σ bᵢ t` a vertex and column are all that is kept, in steps of 2⁻³².

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// A sum of one.
const ONE: f64 = 4_294_967_296.0;

/// Smoothing, as a share of what the average vertex's samples weigh: a neighbour's pull where samples are few, without a say
/// where there are some.
pub(super) const SMOOTHING: f64 = 0.002;

/// The same for what should not move at all where it is an even function of the place: texture coordinates. With
/// [`SMOOTHING`] a height field at a hundredth of its faces had them 2.4 times as far off as looking them up would be.
pub(super) const LITTLE_SMOOTHING: f64 = 1e-4;

/// The valence of a regular vertex. One of more faces is pulled as much as it is by so many: a hub whose spokes all pulled would
/// move whatever its samples say.
const REGULAR: f64 = 6.0;

/// What holds a piece without any sample to the average.
const ANCHOR: f64 = 1e-6;

/// Steps of the solver at most, and the residual that it is content with, as a share of the first.
const STEPS: usize = 200;
const RESIDUAL: f64 = 1e-5;

/// Sums that workers add to together.
pub(super) struct Sums {
    square: Vec<AtomicU64>,
    cross: Vec<[AtomicU64; 3]>,
    right: Vec<AtomicU64>,
    columns: usize,
}

impl Sums {
    pub fn of(faces: usize, vertices: usize, columns: usize) -> Sums {
        Sums {
            square: zeros(vertices),
            cross: (0..faces).map(|_| Default::default()).collect(),
            right: zeros(vertices * columns),
            columns,
        }
    }

    /// Adds a sample.
    #[inline]
    pub fn add(&self, face: usize, corners: [u32; 3], weights: [f64; 3], values: &[f64]) {
        for (i, (v, b)) in corners.into_iter().zip(weights).enumerate() {
            self.square[v as usize].fetch_add((b * b * ONE) as u64, Relaxed);
            self.cross[face][i].fetch_add((b * weights[(i + 1) % 3] * ONE) as u64, Relaxed);
            for (c, t) in values.iter().enumerate() {
                self.right[v as usize * self.columns + c].fetch_add((b * t * ONE) as u64, Relaxed);
            }
        }
    }

    /// The equations, over these faces.
    pub fn into_system(self, faces: &[[u32; 3]], smoothing: f64) -> System<'_> {
        let vertices = self.square.len();
        let mut system = System {
            faces,
            square: self.square.iter().map(number).collect(),
            cross: self.cross.iter().map(|c| [number(&c[0]), number(&c[1]), number(&c[2])]).collect(),
            right: self.right.iter().map(number).collect(),
            columns: self.columns,
            pulls: Vec::new(),
            anchor: 0.0,
        };
        let all: f64 = system.square.iter().sum::<f64>() + 2.0 * system.cross.as_flattened().iter().sum::<f64>();
        let average = (all / vertices.max(1) as f64).max(1e-3);
        let mut valences = vec![0.0; vertices];
        faces.as_flattened().iter().for_each(|v| valences[*v as usize] += 1.0);
        system.pulls = valences.iter().map(|n| smoothing * average * (REGULAR / n).min(1.0)).collect();
        system.anchor = ANCHOR * average;
        system
    }
}

fn zeros(n: usize) -> Vec<AtomicU64> {
    bytemuck::zeroed_vec(n)
}

fn number(sum: &AtomicU64) -> f64 {
    sum.load(Relaxed) as f64 / ONE
}

/// `A x = r` for each column: `A` has a row a vertex.
pub(super) struct System<'a> {
    faces: &'a [[u32; 3]],
    square: Vec<f64>,
    cross: Vec<[f64; 3]>,
    right: Vec<f64>,
    columns: usize,
    /// By vertex: what an edge's two ends pull each other by is the lesser of theirs.
    pulls: Vec<f64>,
    anchor: f64,
}

impl System<'_> {
    /// The values of one column, by conjugate gradients.
    pub fn solve(&self, column: usize) -> Vec<f64> {
        let n = self.square.len();
        let right: Vec<f64> = (0..n).map(|v| self.right[v * self.columns + column]).collect();
        // A row's sum is what a vertex's samples weigh, so this is their average.
        let ones = self.apply(&vec![1.0; n]);
        let weight: f64 = ones.iter().sum();
        let mean = right.iter().sum::<f64>() / weight.max(f64::MIN_POSITIVE);
        let right: Vec<f64> = right.into_iter().map(|r| r + self.anchor * mean).collect();
        let mut x: Vec<f64> = right.iter().zip(&ones).map(|(r, w)| r / w).collect();
        let preconditioner: Vec<f64> = self.diagonal().into_iter().map(|d| 1.0 / d).collect();

        let applied = self.apply(&x);
        let mut residual: Vec<f64> = right.iter().zip(&applied).map(|(r, a)| r - a).collect();
        let first = dot(&right, &right).sqrt();
        let mut direction: Vec<f64> = residual.iter().zip(&preconditioner).map(|(r, p)| r * p).collect();
        let mut energy = dot(&residual, &direction);
        for _ in 0..STEPS {
            if dot(&residual, &residual).sqrt() <= RESIDUAL * first {
                break;
            }
            let applied = self.apply(&direction);
            let step = energy / dot(&direction, &applied);
            if !step.is_finite() {
                break;
            }
            for i in 0..n {
                x[i] += step * direction[i];
                residual[i] -= step * applied[i];
            }
            let before = energy;
            energy = (0..n).map(|i| residual[i] * residual[i] * preconditioner[i]).sum();
            let turn = energy / before;
            for i in 0..n {
                direction[i] = residual[i] * preconditioner[i] + turn * direction[i];
            }
        }
        x
    }

    fn apply(&self, x: &[f64]) -> Vec<f64> {
        let mut y: Vec<f64> = x.iter().zip(&self.square).map(|(x, square)| x * (square + self.anchor)).collect();
        for (face, cross) in self.faces.iter().zip(&self.cross) {
            for (i, cross) in cross.iter().enumerate() {
                let (u, v) = (face[i] as usize, face[(i + 1) % 3] as usize);
                let pull = self.pull(u, v) * (x[u] - x[v]);
                y[u] += cross * x[v] + pull;
                y[v] += cross * x[u] - pull;
            }
        }
        y
    }

    fn diagonal(&self) -> Vec<f64> {
        let mut diagonal: Vec<f64> = self.square.iter().map(|square| square + self.anchor).collect();
        for face in self.faces {
            for i in 0..3 {
                let (u, v) = (face[i] as usize, face[(i + 1) % 3] as usize);
                let pull = self.pull(u, v);
                diagonal[u] += pull;
                diagonal[v] += pull;
            }
        }
        diagonal
    }

    /// How strongly neighbours are held to one value.
    #[inline]
    fn pull(&self, u: usize, v: usize) -> f64 {
        self.pulls[u].min(self.pulls[v])
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
