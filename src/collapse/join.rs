//! Pairs of vertices that no edge joins, and that may merge all the same (thesis §3.2.1, §6.4): of different pieces, or
//! both on borders, so that pieces which lie close by become one.

use super::policy::PairDistance;
use super::surface::Surface;
use crate::mesh::Coordinate;
use glam::{DVec3, IVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Nearest partners that a vertex has at most: a threshold that is far too large must not make pairs of everything.
const MOST: usize = 8;

/// What share of a vertex's edges' mean length is near by itself. On the bones of a foot at a tenth of their faces and less, a
/// quarter to a half is closer to the scan than no pairs at all, and the whole length up to twice as far off.
const AUTO_SHARE: f64 = 0.25;

/// The pairs, from either side.
#[derive(Debug, Default)]
pub(super) struct Joins(FxHashMap<u32, Vec<u32>>);

impl Joins {
    /// Finds the pairs of a mesh.
    pub fn find<S: Coordinate>(surface: &Surface<S>, distance: PairDistance) -> Self {
        let used = |v: &u32| !surface.stars.of(*v).is_empty();
        let vertices: Vec<u32> = (0..surface.positions.len() as u32).filter(used).collect();
        let reach = |v: u32| match distance {
            PairDistance::Within(distance) => distance,
            PairDistance::Auto => AUTO_SHARE * surface.mean_edge(v),
        };
        let reaches: Vec<f64> = vertices.par_iter().map(|&v| reach(v)).collect();
        let side = reaches.iter().copied().fold(0.0, f64::max).max(f64::MIN_POSITIVE);
        let cell = |p: DVec3| (p / side).floor().as_ivec3();
        let mut cells: FxHashMap<IVec3, Vec<u32>> = FxHashMap::default();
        for &v in &vertices {
            cells.entry(cell(surface.at(v))).or_default().push(v);
        }
        let nearest = |(&v, &reach): (&u32, &f64)| {
            let at = surface.at(v);
            let around =
                (0..27).filter_map(|i| cells.get(&(cell(at) + IVec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1))));
            let near = around.flatten().filter(|&&u| u != v && surface.at(u).distance_squared(at) < reach * reach);
            let mut near: Vec<u32> = near.copied().filter(|&u| surface.may_join(v, u)).collect();
            near.sort_by(|&a, &b| {
                surface.at(a).distance_squared(at).total_cmp(&surface.at(b).distance_squared(at)).then(a.cmp(&b))
            });
            near.truncate(MOST);
            near.into_iter().map(|u| (v, u)).collect::<Vec<_>>()
        };
        let pairs: Vec<Vec<(u32, u32)>> = vertices.par_iter().zip(&reaches).map(nearest).collect();
        let mut joins = Joins::default();
        for (v, u) in pairs.into_iter().flatten() {
            joins.add(v, u);
        }
        joins
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn add(&mut self, v: u32, u: u32) {
        for (v, u) in [(v, u), (u, v)] {
            let partners = self.0.entry(v).or_default();
            if !partners.contains(&u) {
                partners.push(u);
            }
        }
    }

    /// The vertices that `v` may merge with though no edge joins them.
    pub fn of(&self, v: u32) -> &[u32] {
        self.0.get(&v).map_or(&[], Vec::as_slice)
    }

    /// Every pair, once.
    pub fn pairs(&self) -> impl Iterator<Item = (u32, u32)> {
        self.0.iter().flat_map(|(&v, partners)| partners.iter().filter(move |&&u| v < u).map(move |&u| (v, u)))
    }

    /// `b` has become `a`.
    pub fn merge(&mut self, a: u32, b: u32) {
        for u in self.0.remove(&b).unwrap_or_default() {
            if let Some(partners) = self.0.get_mut(&u) {
                partners.retain(|&v| v != b);
            }
            if u != a {
                self.add(a, u);
            }
        }
    }
}

impl<S: Coordinate> Surface<S> {
    /// Whether two vertices without an edge belong to what could be joined.
    fn may_join(&self, v: u32, u: u32) -> bool {
        let apart = self.pieces.of.get(v as usize) != self.pieces.of.get(u as usize);
        apart || self.odd(v) && self.odd(u) && self.shared(&self.stars, v, u).next().is_none()
    }

    fn mean_edge(&self, v: u32) -> f64 {
        let neighbours = self.neighbours(&self.stars, v);
        let sum: f64 = neighbours.iter().map(|&u| self.at(u).distance(self.at(v))).sum();
        sum / neighbours.len().max(1) as f64
    }
}
