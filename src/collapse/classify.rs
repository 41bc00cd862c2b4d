//! What the scan's edges and vertices are: regular, border, non-manifold; and which faces cancel.

use super::surface::{ODD, Surface};
use crate::mesh::Coordinate;
use crate::mesh::adjacency::{next, previous};
use rayon::prelude::*;
use std::sync::atomic::Ordering::Relaxed;

/// Counts of what is not regular.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Irregularities {
    /// Edges of a single face.
    pub border_edges: u64,
    /// Edges of three and more faces, or of two that run along it the same way.
    pub nonmanifold_edges: u64,
    /// Vertices without such edges whose faces form more than one fan.
    pub nonmanifold_vertices: u64,
}

impl std::ops::Add for Irregularities {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Irregularities {
            border_edges: self.border_edges + o.border_edges,
            nonmanifold_edges: self.nonmanifold_edges + o.nonmanifold_edges,
            nonmanifold_vertices: self.nonmanifold_vertices + o.nonmanifold_vertices,
        }
    }
}

/// Marks the vertices of odd edges and counts. Needs fresh stars.
pub(super) fn classify<S: Coordinate>(surface: &Surface<S>) -> Irregularities {
    (0..surface.positions.len() as u32)
        .into_par_iter()
        .with_min_len(1024)
        .map(|v| classify_vertex(surface, v))
        .reduce(Irregularities::default, |a, b| a + b)
}

fn classify_vertex<S: Coordinate>(surface: &Surface<S>, v: u32) -> Irregularities {
    let star = surface.stars.of(v);
    let count = |u: u32| {
        let out = star.iter().filter(|&&c| surface.vertex(next(c)) == u).count();
        let back = star.iter().filter(|&&c| surface.vertex(previous(c)) == u).count();
        (out, back)
    };
    let mut found = Irregularities::default();
    let mut odd = false;
    for (i, &corner) in star.iter().enumerate() {
        for u in [surface.vertex(next(corner)), surface.vertex(previous(corner))] {
            let (out, back) = count(u);
            if (out, back) == (1, 1) {
                continue;
            }
            odd = true;
            let earlier = |&&c: &&u32| surface.vertex(next(c)) == u || surface.vertex(previous(c)) == u;
            if v < u && !star[..i].iter().any(|c| earlier(&c)) {
                if out + back == 1 {
                    found.border_edges += 1;
                } else {
                    found.nonmanifold_edges += 1;
                }
            }
        }
    }
    if odd {
        surface.marks[v as usize].fetch_or(ODD, Relaxed);
    } else if let Some(&start) = star.first() {
        let mut corner = start;
        let mut fan = 0;
        loop {
            fan += 1;
            let u = surface.vertex(previous(corner));
            let Some(&turn) = star.iter().find(|&&c| surface.vertex(next(c)) == u) else { break };
            corner = turn;
            if corner == start {
                break;
            }
        }
        found.nonmanifold_vertices += u64::from(fan < star.len());
    }
    found
}

/// Faces that cancel: of coincident faces, equally many of both orientations. Dropping such a pair leaves the parity of
/// every edge as it was, and with it closed what was closed. Needs fresh stars; in face order, pairs not adjacent.
pub(super) fn fins<S: Coordinate>(surface: &Surface<S>) -> Vec<u32> {
    let mut found: Vec<u32> = (0..surface.positions.len() as u32)
        .into_par_iter()
        .with_min_len(1024)
        .flat_map_iter(|v| fins_led_by(surface, v))
        .collect();
    found.sort_unstable();
    found
}

fn fins_led_by<S: Coordinate>(surface: &Surface<S>, v: u32) -> Vec<u32> {
    let mut led = Vec::new();
    let star = surface.stars.of(v);
    let ends = |c: u32| (surface.vertex(next(c)), surface.vertex(previous(c)));
    for (i, &c) in star.iter().enumerate() {
        let (p, q) = ends(c);
        if p < v || q < v {
            continue;
        }
        // The k-th face of one orientation cancels against the k-th of the other, where there is one.
        let same = star[..i].iter().filter(|&&d| ends(d) == (p, q)).count();
        let other = star.iter().filter(|&&d| ends(d) == (q, p)).count();
        if same < other {
            led.push(c / 3);
        }
    }
    led
}
