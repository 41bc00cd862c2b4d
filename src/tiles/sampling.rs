//! Samples of the scan on their way through the sweeps: each stays with a vertex of the mesh.

use super::grid::{Blocks, Lie, uncut};
use super::partition::Tile;
use super::store::{Group, Store, find};
use crate::cores::InPieces;
use crate::error::Result;
use crate::mesh::samples::{Lattice, SAMPLE_BYTES, SurfaceSample};
use crate::mesh::{Coordinate, IndexedMesh, mix, step, widen};
use crate::scratch::Scratch;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::marker::PhantomData;

/// What is kept of a sample beside its vertex.
const REST_BYTES: usize = SAMPLE_BYTES - 4;

/// Bytes of a sample on scratch: the position of its vertex, and the rest.
pub const fn record_bytes<S>() -> usize {
    size_of::<[S; 3]>() + REST_BYTES
}

/// Samples by cubes that no tile cuts.
pub struct SampleStore<S> {
    store: Store,
    scalar: PhantomData<S>,
}

/// Draws so many samples for a unit of area from the faces of a mesh, each near one of its vertices. A face has what
/// its area asks for, rounded up or down by a hash of where it lies.
pub fn draw<S: Coordinate>(mesh: &IndexedMesh<S>, lattice: &Lattice, rate: f64) -> Vec<SurfaceSample> {
    let of_face = |face: &[u32; 3]| {
        let corners = face.map(|v| mesh.positions[v as usize]);
        let (first, u, v) = (widen(corners[0]), step(corners[0], corners[1]), step(corners[0], corners[2]));
        let cross = u.as_dvec3().cross(v.as_dvec3());
        let hash = corners.as_flattened().iter().fold(0, |hash, x| mix(hash ^ x.widen().to_bits()));
        let count = (0.5 * cross.length() * rate + part(hash >> 32)) as u32;
        let normal = cross.normalize_or_zero().as_vec3();
        let count = if normal == Vec3::ZERO { 0 } else { count };
        let face = *face;
        (0..count).scan(hash, move |hash, _| {
            *hash = mix(*hash);
            let (mut s, mut t) = (part(*hash), part(*hash >> 32));
            if s + t > 1.0 {
                (s, t) = (1.0 - s, 1.0 - t);
            }
            let near = if 1.0 - s - t >= s.max(t) {
                0
            } else if s >= t {
                1
            } else {
                2
            };
            let position: DVec3 = first + s * u.as_dvec3() + t * v.as_dvec3();
            Some(SurfaceSample::new(lattice, position, normal, face[near]))
        })
    };
    mesh.faces.par_iter().in_pieces(1024).flat_map_iter(of_face).flatten_iter().collect()
}

/// In `0..1`, from 24 bits.
fn part(bits: u64) -> f64 {
    (bits & 0xff_ffff) as f64 / f64::from(1 << 24)
}

impl<S: Coordinate> SampleStore<S> {
    /// None yet.
    pub fn new(writer_bytes: u64, scratch: &Scratch) -> Result<Self> {
        Ok(SampleStore { store: Store::new(record_bytes::<S>(), writer_bytes, scratch)?, scalar: PhantomData })
    }

    /// Puts samples where their vertices are, of which `mesh` has the positions.
    pub fn add(&self, blocks: &Blocks, mesh: &IndexedMesh<S>, samples: &[SurfaceSample]) -> Result<()> {
        let mut writer = self.store.writer();
        for sample in samples {
            let Some(at) = mesh.positions.get(sample.near as usize) else { continue };
            writer.push(uncut(blocks.of(widen(*at))), &[bytemuck::bytes_of(at), &bytemuck::bytes_of(sample)[4..]])?;
        }
        writer.flush()
    }

    /// The samples of tiles.
    pub fn tiles(&mut self, lie: Lie) -> SampleTiles<'_, S> {
        let places = self.store.groups(|block| lie.tile(block));
        SampleTiles { samples: self, places }
    }
}

/// Samples by tile.
pub struct SampleTiles<'a, S> {
    samples: &'a SampleStore<S>,
    places: Vec<(u64, Group)>,
}

impl<S: Coordinate> SampleTiles<'_, S> {
    /// The samples of a tile whose vertices it has.
    pub fn load(&self, number: u64, tile: &Tile<S>) -> Result<Vec<SurfaceSample>> {
        let (store, group) = (&self.samples.store, find(&self.places, number));
        let count = store.records(&group);
        let (mut at, mut samples) = (Vec::with_capacity(count), Vec::with_capacity(count));
        store.each(&group, |record| {
            let (position, rest) = record.split_at(size_of::<[S; 3]>());
            at.push(bytemuck::pod_read_unaligned::<[S; 3]>(position));
            let mut sample = [0; SAMPLE_BYTES];
            sample[4..].copy_from_slice(rest);
            samples.push(bytemuck::pod_read_unaligned::<SurfaceSample>(&sample));
        })?;
        tile.find(&at, |i, vertex| samples[i].near = vertex.unwrap_or(u32::MAX));
        samples.retain(|sample| sample.near != u32::MAX);
        Ok(samples)
    }
}
