//! What a measurement takes of memory, added up before anything is read.

use super::probes::{Points, Probes};
use super::{Options, Pair, patch, tally};
use crate::error::{Error, Result};
use crate::facets;
use crate::mesh::{Coordinate, IndexedMesh, Tree};
use crate::read::{Crew, Layout, Scalar, Scan, load_peak_bytes};
use std::path::PathBuf;

/// Points of the larger mesh that are kept at most, and at least.
const POINTS: std::ops::RangeInclusive<u64> = (1 << 12)..=(1 << 19);

/// Bytes of a kept point: twice while workers gather them, and under a tree.
const POINT_BYTES: u64 = 48;

/// Samples that a measurement that takes what the budget leaves is content with.
const LEAST_SAMPLES: u64 = 10_000;

impl Options {
    /// The same with half as many points, and again, until they fit: a measurement that nobody asked a number of. Refuses
    /// when few are still too many.
    pub fn fitted(mut self, needs: impl Fn(&Options) -> Needs) -> Result<Options> {
        loop {
            match needs(&self).check(self.array_bytes) {
                Err(_) if self.samples / 2 >= LEAST_SAMPLES => {
                    self.samples /= 2;
                    self.most_vertices /= 2;
                }
                other => return other.map(|()| self),
            }
        }
    }
}

/// The share of spare memory that kept points may take.
const POINTS_SHARE: u64 = 8;

/// Bytes that a worker takes, beside what reading does.
pub const fn bytes_per_worker() -> usize {
    facets::bytes_per_worker() + size_of::<patch::Patch>() + tally::BYTES
}

/// What a measurement takes, in bytes of arrays.
#[derive(Debug, Clone, PartialEq)]
pub struct Needs {
    held: PathBuf,
    faces: u64,
    /// Vertices of the held mesh; where it is a soup, the most there can be.
    vertices: u64,
    is_soup: bool,
    position_bytes: u64,
    load_bytes: u64,
    options: Options,
    streamed_vertices: u64,
    /// What the streaming mesh takes at least.
    stream_bytes: u64,
}

/// What is left when all that must be held is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Spare {
    /// Points to keep of the larger mesh.
    pub(super) points: u64,
    /// Bytes for its positions.
    pub(super) positions: u64,
}

impl Needs {
    /// Of measuring `pair`, the smaller of which is held in `S`.
    pub fn of<S: Coordinate>(pair: &Pair, options: &Options) -> Needs {
        let (held, streamed) = (pair.held(), pair.streamed());
        let position = if streamed.scalar() == Scalar::F64 { 24 } else { 12 };
        let chosen = options.stride(streamed.vertex_count()).rank(streamed.vertex_count());
        let stream_bytes = match streamed.layout() {
            Layout::Soup => 0,
            Layout::Indexed => chosen / 8 + facets::least_bytes(streamed.vertex_count(), position),
        };
        Needs {
            held: held.path().into(),
            faces: held.triangle_count(),
            vertices: held.vertex_count(),
            is_soup: held.layout() == Layout::Soup,
            position_bytes: size_of::<[S; 3]>() as u64,
            // What streaming takes is set aside for all passes alike.
            load_bytes: load_peak_bytes(held).saturating_sub(Crew::stream_bytes(1)),
            options: *options,
            streamed_vertices: streamed.vertex_count(),
            stream_bytes,
        }
    }

    /// Of measuring a mesh that is still to be made, of so many faces, against `scan`: if it has no more than a vertex a
    /// face.
    pub fn of_result<S: Coordinate>(faces: u64, scan: &Scan, options: &Options) -> Needs {
        let position_bytes = size_of::<[S; 3]>() as u64;
        let table = 4 * (faces.saturating_mul(3) / 2 + 1).next_power_of_two();
        let load_bytes = faces.saturating_mul(12 + position_bytes + 4).saturating_add(table);
        let pair = Pair { a: scan, b: scan };
        Needs { faces, vertices: faces, is_soup: false, position_bytes, load_bytes, ..Needs::of::<S>(&pair, options) }
    }

    /// Points to be measured of a held mesh of so many vertices, at most.
    pub(super) fn probes(&self, vertices: u64) -> u64 {
        let chosen = if self.options.shades { vertices } else { self.options.stride(vertices).rank(vertices) };
        // The number of samples is drawn; it is hardly ever more than this.
        self.options.samples + self.options.samples / 64 + 4096 + chosen
    }

    /// The held mesh with its tree and probes.
    fn held_bytes(&self, faces: u64, vertices: u64) -> u64 {
        faces * 12 + vertices * self.position_bytes + Tree::<f32>::bytes(faces) + Probes::bytes(self.probes(vertices))
    }

    /// Bytes of arrays at the peak, for a held mesh of so many vertices.
    fn peak(&self, vertices: u64) -> u64 {
        let mesh = self.faces * 12 + vertices * self.position_bytes;
        let tree = mesh + Tree::<f32>::build_bytes(self.faces);
        let probes = mesh + Tree::<f32>::bytes(self.faces) + Probes::build_bytes(self.probes(vertices));
        let points = POINTS.start() * POINT_BYTES;
        let streaming = self.held_bytes(self.faces, vertices) + points + self.stream_bytes;
        tree.max(probes).max(streaming)
    }

    /// The least bytes of arrays that do.
    pub fn bytes(&self) -> u64 {
        self.load_bytes.max(self.peak(self.vertices))
    }

    /// Refuses what does not fit `array_bytes`. A soup that would fit if it were closed is let through.
    pub fn check(&self, array_bytes: u64) -> Result<()> {
        let fits = if self.is_soup { self.peak(self.faces / 2) } else { self.bytes() } <= array_bytes;
        if fits { Ok(()) } else { Err(self.refusal("does not fit")) }
    }

    fn refusal(&self, what: &str) -> Error {
        let held = self.held.display();
        let what =
            format!("{held}: measuring {} samples a side, the smaller mesh {what} this budget", self.options.samples);
        Error::Budget { what, needed_bytes: self.bytes() }
    }

    /// The most distinct vertices that the held mesh may turn out to have.
    pub(super) fn most_vertices(&self, array_bytes: u64) -> u64 {
        if !self.is_soup {
            return u64::MAX;
        }
        let fits = |vertices: u64| {
            // While a soup is welded: a hash table of at most 12 bytes a vertex, or 18 while it grows.
            let welding = self.faces * 12 + vertices * (self.position_bytes + 18);
            self.peak(vertices).max(welding) <= array_bytes
        };
        let (mut low, mut high) = (0, self.vertices + 1);
        while high - low > 1 {
            let middle = low.midpoint(high);
            if fits(middle) { low = middle } else { high = middle }
        }
        low
    }

    pub(super) fn too_many_vertices(&self) -> Error {
        self.refusal("has too many vertices for")
    }

    /// What is left of `array_bytes` beside the held mesh.
    pub(super) fn spare<S>(&self, array_bytes: u64, mesh: &IndexedMesh<S>) -> Spare {
        let held = self.held_bytes(mesh.faces.len() as u64, mesh.positions.len() as u64);
        let chosen = self.options.stride(self.streamed_vertices).rank(self.streamed_vertices) / 8;
        let spare = array_bytes.saturating_sub(held + chosen);
        let points = (spare / POINTS_SHARE / POINT_BYTES).clamp(*POINTS.start(), *POINTS.end());
        Spare { points, positions: spare.saturating_sub(points * POINT_BYTES) }
    }
}

const _: () = assert!(Points::build_bytes(1 << 20) <= POINT_BYTES << 20);
