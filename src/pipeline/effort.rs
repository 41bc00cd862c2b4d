//! How long a reduction will take, about, from counts alone.
//!
//! Each stage takes so much for each thing that it goes through; figures are seconds of one thread, fitted to the models of
//! the thesis, a brain, coloured scans and scans of up to 27.6 M faces, at a half to a thousandth of their faces, with memory
//! for all and for a twentieth of them.

use crate::collapse;
use crate::job::Job;
use crate::plan::AIM;
use crate::refit;
use crate::report::Mode;

/// What a reduction goes through.
#[derive(Debug, Clone, PartialEq)]
pub struct Effort {
    /// Faces of the scan.
    pub faces: u64,
    /// Whether it has to be clustered first.
    pub mode: Mode,
    /// Faces of the meshes, the finest first.
    pub targets: Vec<u64>,
    /// Rounds of refit.
    pub refit_rounds: u32,
    /// Whether colours steer, where they can.
    pub coloured: bool,
    /// Samples that results are measured with; 0 where they are not.
    pub samples: u64,
    /// Whether pictures are taken.
    pub pictures: bool,
}

/// Seconds of beginning and ending, for a scan of no size.
const AT_LEAST: f64 = 0.02;

/// How much faster so many threads are than one: a share of every stage is done by one.
fn speed(threads: usize) -> f64 {
    (threads.max(1) as f64).powf(0.77)
}

impl Effort {
    /// What a job goes through, whose scan has so many faces.
    pub fn of(job: &Job, faces: u64, mode: Mode, coloured: bool, pictures: bool) -> Effort {
        let targets = std::iter::once(job.target).chain(job.coarser.iter().map(|level| level.target));
        // As few as a distance allows cannot be told: a tenth is what is usual.
        let targets = targets.map(|target| target.faces(faces).unwrap_or(faces / 10).min(faces)).collect();
        let samples = if job.verify { job.samples } else { 0 };
        let coloured = coloured && job.carry && job.policies.colour_weight > 0.0;
        Effort { faces, mode, targets, refit_rounds: job.refit_rounds, coloured, samples, pictures }
    }

    /// Seconds, with so many threads.
    pub fn seconds(&self, threads: usize) -> f64 {
        let per = |each: f64, n: f64| 1e-6 * each * n;
        let faces = self.faces as f64;
        let finest = self.targets.first().map_or(faces, |n| *n as f64);
        let mut work = match self.mode {
            Mode::InCore => {
                let steered = if self.coloured { COLOURS_FACTOR } else { 1.0 };
                per(LOAD, faces) + steered * collapse_work(faces, finest) + self.refit_work(faces, finest)
            }
            Mode::OutOfCore => {
                let intermediate = (AIM * finest).min(faces);
                let samples = refit::SAMPLES as f64 * finest;
                let fitted = if self.refit_rounds > 0 { per(SAMPLE, samples) } else { 0.0 };
                per(CLUSTER, faces) + collapse_work(intermediate, finest) + fitted
            }
        };
        for pair in self.targets.windows(2) {
            let (finer, coarser) = (pair[0] as f64, pair[1] as f64);
            work += collapse_work(finer, coarser) + self.refit_work(finer, coarser);
        }
        for target in &self.targets {
            if self.coloured {
                work += per(CARRY, faces) + per(CARRY_RESULT, *target as f64);
            }
            if self.samples > 0 {
                let kept = (4.0 * faces).min(MOST_KEPT);
                work += per(MEASURE, faces) + per(MEASURE_RESULT, *target as f64);
                work += per(KEPT, kept) + per(POINT, self.samples as f64);
            }
        }
        if self.pictures {
            work += PICTURE + per(DRAW, faces);
        }
        AT_LEAST + work / speed(threads)
    }

    /// The refit to the finer mesh, or to what was left of it at ten times the target.
    fn refit_work(&self, finer: f64, target: f64) -> f64 {
        if self.refit_rounds == 0 || refit::LEAST_RATIO as f64 * target > finer {
            return 0.0;
        }
        // Rounds after the first flip edges, and look both ways.
        let rounds = 1.0 + 2.0 * f64::from(self.refit_rounds - 1);
        1e-6 * REFIT * rounds * finer.min(collapse::REFERENCE_FACTOR as f64 * target)
    }
}

/// Batches from `faces` on; near the target they go in smaller steps.
fn collapse_work(faces: f64, target: f64) -> f64 {
    let near = faces.min(collapse::LAST_FACTOR as f64 * target) - target;
    1e-6 * (COLLAPSE * faces + COLLAPSE_NEAR * near.max(0.0))
}

/// Microseconds of one thread: loading a face;
const LOAD: f64 = 0.13;
/// a face that goes into the collapse, and one that goes in the last steps of it;
const COLLAPSE: f64 = 0.68;
const COLLAPSE_NEAR: f64 = 4.5;
/// how much more that is where colours steer;
const COLOURS_FACTOR: f64 = 2.5;
/// a face of the mesh that a result is refitted to, and a sample of the scan;
const REFIT: f64 = 1.2;
const SAMPLE: f64 = 0.28;
/// a face that is clustered;
const CLUSTER: f64 = 0.22;
/// what vertices carry, for a face of the scan and one of the result;
const CARRY: f64 = 0.15;
const CARRY_RESULT: f64 = 6.0;
/// what is measured: a face of the scan, one of the result, a point, one that is kept to tell what is near;
const MEASURE: f64 = 0.17;
const MEASURE_RESULT: f64 = 1.2;
const POINT: f64 = 1.6;
const KEPT: f64 = 0.45;
const MOST_KEPT: f64 = 524_288.0;
/// and a face in a picture.
const DRAW: f64 = 0.14;
/// Seconds of a picture of nothing.
const PICTURE: f64 = 0.2;

#[cfg(test)]
mod tests {
    use super::*;

    fn effort(faces: u64, mode: Mode, targets: &[u64]) -> Effort {
        let targets = targets.to_vec();
        Effort { faces, mode, targets, refit_rounds: 1, coloured: false, samples: 0, pictures: false }
    }

    #[test]
    fn levels_cost_little_and_whatever_is_asked_more_costs_more() {
        let one = effort(1_000_000, Mode::InCore, &[100_000]);
        let three = effort(1_000_000, Mode::InCore, &[100_000, 10_000, 1000]);
        let ratio = three.seconds(1) / one.seconds(1);
        assert!((1.0..1.3).contains(&ratio), "{ratio}");
        assert!(one.seconds(2) < 0.7 * one.seconds(1));
        for more in [
            Effort { coloured: true, ..one.clone() },
            Effort { samples: 30_000, ..one.clone() },
            Effort { pictures: true, ..one.clone() },
            Effort { refit_rounds: 5, ..one.clone() },
            effort(1_100_000, Mode::InCore, &[100_000]),
            effort(1_000_000, Mode::InCore, &[110_000]),
        ] {
            assert!(more.seconds(1) > 1.01 * one.seconds(1), "{more:?}");
        }
        let large = |mode| effort(27_600_000, mode, &[140_000]).seconds(1);
        assert!(large(Mode::OutOfCore) < large(Mode::InCore));
    }
}
