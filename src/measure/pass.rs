//! What is done with the faces that stream by, in each of the two passes.

use super::patch::{FACES, Patch};
use super::probes::Probes;
use super::sample::{Spread, area_of, scatter};
use super::tally::{Sum, Tally};
use crate::facets::{Facet, Sink, Stride};
use crate::mesh::boxes::Origin;
use crate::mesh::{Coordinate, Extent, Tree};
use glam::{DVec3, Vec3};

/// Points of one face at most: they say what is near before faces do, and a small scan is soon done by its faces alone.
const MOST_OF_EACH: u64 = 4;

/// Which points of the mesh are kept: so many of every so many faces.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kept {
    faces: Stride,
    of_each: u64,
}

impl Kept {
    /// About `points` of a mesh of so many faces.
    pub(super) fn new(faces: u64, points: u64) -> Self {
        Kept { faces: Stride::new(faces, points), of_each: (points / faces.max(1)).clamp(1, MOST_OF_EACH) }
    }
}

/// The first pass: how large the mesh is, and points on it.
pub(super) struct Survey {
    origin: Origin,
    kept: Kept,
    pub(super) area: Sum,
    pub(super) extent: Extent,
    pub(super) points: Vec<Vec3>,
}

impl Survey {
    /// A survey that has seen nothing yet.
    pub(super) fn new(origin: Origin, kept: Kept) -> Self {
        Survey { origin, kept, area: Sum::default(), extent: Extent::default(), points: Vec::new() }
    }

    /// All workers' together. The order of the points depends on the workers; nothing depends on the order.
    pub(super) fn merged(workers: Vec<Survey>) -> Survey {
        let mut workers = workers.into_iter();
        let Some(mut all) = workers.next() else { unreachable!("a pass has a worker") };
        for worker in workers {
            all.area.merge(&worker.area);
            all.extent = all.extent.union(worker.extent);
            all.points.extend(worker.points);
        }
        all
    }
}

/// Points begin at the middle of a face, at a third of both its sides.
const MIDDLE: u64 = 0x5555_5555_5555_5555;

impl Sink for Survey {
    fn take(&mut self, faces: &[Facet]) {
        for facet in faces {
            let [a, b, c] = facet.corners;
            self.area.add(area_of(b - a, c - a));
            self.extent.min = self.extent.min.min(a).min(b).min(c);
            self.extent.max = self.extent.max.max(a).max(b).max(c);
            if self.kept.faces.takes(facet.number().into()) || self.points.is_empty() {
                let (origin, points) = (self.origin, &mut self.points);
                scatter(self.kept.of_each, MIDDLE, facet.corners, |p| points.push(origin.about(p)));
            }
        }
    }
}

/// Probes that could be met in the time that it takes to find those that are near.
const ERRAND: f64 = 16.0;

/// The second pass: both ways.
pub(super) struct Measuring<'a, S> {
    tree: &'a Tree<'a, S>,
    probes: &'a Probes,
    origin: Origin,
    spread: Spread,
    patch: Box<Patch>,
    /// The area that it costs to bring something to the probes.
    errand: f32,
    /// The face that was nearest to the last sample: the next one's is not far.
    last: u32,
    pub(super) tally: Tally,
}

impl<'a, S: Coordinate> Measuring<'a, S> {
    /// Samples by `spread`, to be measured to `tree`; faces to be measured from `probes`.
    pub(super) fn new(
        tree: &'a Tree<'a, S>,
        probes: &'a Probes,
        origin: Origin,
        spread: Spread,
        nothing_sq: f64,
    ) -> Self {
        let (tally, errand) = (Tally::new(nothing_sq), (ERRAND * probes.spacing_sq()) as f32);
        Measuring { tree, probes, origin, spread, patch: Box::default(), errand, last: 0, tally }
    }

    #[inline]
    fn measure(&mut self, is_vertex: bool, p: DVec3) {
        let (face, distance_sq) = self.tree.search(p, self.last);
        self.last = face;
        self.tally.add(is_vertex, p.to_array(), distance_sq);
    }
}

impl<S: Coordinate> Sink for Measuring<'_, S> {
    fn take(&mut self, faces: &[Facet]) {
        let spread = self.spread;
        for facet in faces {
            spread.over(facet.number(), facet.corners, |p| self.measure(false, p));
            for (corner, p) in facet.corners.iter().enumerate() {
                if facet.is_chosen(corner) {
                    self.measure(true, *p);
                }
            }
        }
        for faces in faces.chunks(FACES) {
            self.patch.fill(faces, &self.origin, self.errand);
            self.probes.meet(&self.patch);
        }
    }
}
