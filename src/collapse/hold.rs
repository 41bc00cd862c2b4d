//! What is held in place: locked vertices, and feature edges by constraint planes (thesis §3.6, §4.5.2).

use super::Options;
use super::policy::Features;
use super::surface::{Around, FEATURE, LOCKED, Surface};
use crate::cores::InPieces;
use crate::mesh::Coordinate;
use crate::quadric::Quadric;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

impl Options<'_> {
    /// Whether some vertices stay where they are.
    #[inline(always)]
    pub(super) fn locks(&self) -> bool {
        self.policies.lock_border || !self.locked.is_empty() || self.part.is_some()
    }
}

impl<S: Coordinate> Surface<S> {
    /// Marks the vertices that are locked and those on feature edges.
    pub fn mark_held(&self, options: &Options) {
        for &point in options.locked {
            let distance_sq = |v: u32| self.at(v).distance_squared(point);
            let nearer = |a: u32, b: u32| if (distance_sq(b), b) < (distance_sq(a), a) { b } else { a };
            if let Some(v) = (0..self.positions.len() as u32).into_par_iter().in_pieces(4096).reduce_with(nearer) {
                self.marks[v as usize].fetch_or(LOCKED, Relaxed);
            }
        }
        if !options.policies.lock_border && options.policies.features.is_none() {
            return;
        }
        (0..self.positions.len() as u32).into_par_iter().in_pieces(1024).for_each(|v| {
            let neighbours = self.neighbours(&self.stars, v);
            let has = |is: &dyn Fn(u32) -> bool| neighbours.iter().any(|&u| is(u));
            let border = |u| self.shared(&self.stars, v, u).count() == 1;
            let mut bits = 0;
            if options.policies.lock_border && self.odd(v) && has(&border) {
                bits |= LOCKED;
            }
            if options.policies.features.is_some_and(|f| has(&|u| self.contour(&self.stars, v, u, f).is_some())) {
                bits |= FEATURE;
            }
            self.marks[v as usize].fetch_or(bits, Relaxed);
        });
    }

    /// Whether a vertex stays where it is.
    #[inline(always)]
    pub fn locked(&self, v: u32) -> bool {
        self.marks[v as usize].load(Relaxed) & LOCKED != 0
    }

    /// The vertices that share a face with `v`, in order.
    pub fn neighbours(&self, around: &impl Around, v: u32) -> Vec<u32> {
        let mut all: Vec<u32> = around.of(v).iter().map(|&c| self.ends(c)).flat_map(|(p, q)| [p, q]).collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    /// The feature edges at `v`, about it: edges that are sharp now, between vertices that were on features of the scan.
    pub fn features_at(&self, around: &impl Around, v: u32, features: Features) -> Quadric {
        if !self.on_feature(v) {
            return Quadric::default();
        }
        let contours = self.neighbours(around, v).into_iter().filter_map(|u| self.feature(around, v, u, features));
        contours.fold(Quadric::default(), |sum, q| sum + q)
    }

    /// The planes that hold an edge, if it is a feature.
    pub fn feature(&self, around: &impl Around, a: u32, b: u32, features: Features) -> Option<Quadric> {
        let both = self.on_feature(a) && self.on_feature(b);
        both.then(|| self.contour(around, a, b, features)).flatten()
    }

    fn on_feature(&self, v: u32) -> bool {
        self.marks[v as usize].load(Relaxed) & FEATURE != 0
    }

    /// The planes through an edge, each perpendicular to one of its two faces, if those meet sharply. They hold the whole
    /// edge: about either end only `A` is not zero.
    fn contour(&self, around: &impl Around, a: u32, b: u32, features: Features) -> Option<Quadric> {
        let mut faces = self.shared(around, a, b);
        let (Some(f), Some(g), None) = (faces.next(), faces.next(), faces.next()) else { return None };
        let (f, g) = (self.normal(f).try_normalize()?, self.normal(g).try_normalize()?);
        if f.dot(g) > features.angle.to_radians().cos() {
            return None;
        }
        let edge = self.at(b) - self.at(a);
        let plane = |normal: DVec3| Quadric::plane(edge.cross(normal).normalize_or_zero(), 0.0, edge.length_squared());
        let sum = plane(f) + plane(g);
        Some(Quadric { a: sum.a.map(|x| x * features.weight), ..Default::default() })
    }
}
