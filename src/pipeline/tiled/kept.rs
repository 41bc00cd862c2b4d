//! Tiles that wait for their last collapses, and the result that they are joined to.

use crate::collapse::{Collapsed, Proposal};
use crate::error::Result;
use crate::mesh::samples::SurfaceSample;
use crate::mesh::{Coordinate, IndexedMesh};
use crate::scratch::{Scratch, ScratchFile};
use rustc_hash::FxHashMap;
use std::marker::PhantomData;

/// Tiles after a sweep that told what it would do next.
pub(super) struct Tiled<S> {
    file: ScratchFile,
    pub tiles: Vec<Kept>,
    proposals: Vec<Offer<S>>,
    pub faces: u64,
    /// The largest estimated errors of all sweeps until now together, in the frame.
    pub error: f64,
}

/// Where a tile is on scratch, and how much of it there is.
pub(super) struct Kept {
    offset: u64,
    vertices: usize,
    faces: usize,
    locked: usize,
    samples: usize,
}

impl Kept {
    /// Its faces, what will be collapsed among them.
    pub fn faces(&self) -> u64 {
        self.faces as u64
    }
}

/// A collapse that could be done in a tile.
pub(super) struct Offer<S> {
    pub tile: u32,
    proposal: Proposal<S>,
}

impl<S: Coordinate> Tiled<S> {
    /// None yet.
    pub fn new(scratch: &Scratch) -> Result<Self> {
        Ok(Tiled { file: scratch.file()?, tiles: Vec::new(), proposals: Vec::new(), faces: 0, error: 0.0 })
    }

    /// Faces that could go in one more step.
    pub fn removable(&self) -> u64 {
        self.proposals.iter().map(|offer| u64::from(offer.proposal.faces)).sum()
    }

    pub fn keep(&mut self, collapsed: Collapsed<S>, samples: &[SurfaceSample]) -> Result<()> {
        let Collapsed { mesh, locked, proposals, error_estimate, .. } = collapsed;
        let offset = self.file.length();
        let sections: [&[u8]; 4] = [
            bytemuck::cast_slice(samples),
            bytemuck::cast_slice(&mesh.positions),
            bytemuck::cast_slice(&mesh.faces),
            bytemuck::cast_slice(&locked),
        ];
        for section in sections {
            self.file.append(section)?;
        }
        let tile = self.tiles.len() as u32;
        self.proposals.extend(proposals.into_iter().map(|proposal| Offer { tile, proposal }));
        self.faces += mesh.faces.len() as u64;
        self.error = self.error.max(error_estimate);
        let (vertices, faces) = (mesh.positions.len(), mesh.faces.len());
        self.tiles.push(Kept { offset, vertices, faces, locked: locked.len(), samples: samples.len() });
        Ok(())
    }

    pub fn load(&self, kept: &Kept) -> Result<(IndexedMesh<S>, Vec<u32>, Vec<SurfaceSample>)> {
        let mut samples: Vec<SurfaceSample> = bytemuck::zeroed_vec(kept.samples);
        let mut positions: Vec<[S; 3]> = bytemuck::zeroed_vec(kept.vertices);
        let mut faces: Vec<[u32; 3]> = bytemuck::zeroed_vec(kept.faces);
        let mut locked: Vec<u32> = bytemuck::zeroed_vec(kept.locked);
        let mut at = kept.offset;
        let sections: [&mut [u8]; 4] = [
            bytemuck::cast_slice_mut(&mut samples),
            bytemuck::cast_slice_mut(&mut positions),
            bytemuck::cast_slice_mut(&mut faces),
            bytemuck::cast_slice_mut(&mut locked),
        ];
        for section in sections {
            self.file.read_exact_at(section, at)?;
            at += section.len() as u64;
        }
        Ok((IndexedMesh { positions, faces }, locked, samples))
    }

    /// The cheapest collapses that leave at most `asked` faces, by tile.
    pub fn choose(&mut self, asked: u64) -> Vec<Offer<S>> {
        let mut offers = std::mem::take(&mut self.proposals);
        let hash = |offer: &Offer<S>| {
            let place = u64::from(offer.tile) << 32 | u64::from(offer.proposal.keeps);
            (place.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32, offer.tile, offer.proposal.keeps)
        };
        offers.sort_unstable_by_key(|offer| (offer.proposal.cost.to_bits(), hash(offer)));
        let mut left = self.faces;
        offers.retain(|offer| {
            let wanted = left > asked;
            if wanted {
                left -= u64::from(offer.proposal.faces);
            }
            wanted
        });
        offers.shrink_to_fit();
        offers.sort_unstable_by_key(|offer| (offer.tile, offer.proposal.keeps));
        offers
    }
}

/// Does the collapses that were chosen.
pub(super) fn apply<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    locked: &mut Vec<u32>,
    samples: &mut [SurfaceSample],
    offers: &[Offer<S>],
) {
    let mut becomes: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for Offer { proposal, .. } in offers {
        becomes[proposal.goes as usize] = proposal.keeps;
        mesh.positions[proposal.keeps as usize] = proposal.spot;
    }
    for corner in mesh.faces.as_flattened_mut() {
        *corner = becomes[*corner as usize];
    }
    mesh.faces.retain(|&[a, b, c]| a != b && b != c && c != a);
    let mut numbers = vec![u32::MAX; becomes.len()];
    mesh.faces.as_flattened().iter().for_each(|v| numbers[*v as usize] = 0);
    let mut kept = 0;
    for (v, number) in numbers.iter_mut().enumerate().filter(|(_, number)| **number == 0) {
        mesh.positions[kept as usize] = mesh.positions[v];
        *number = kept;
        kept += 1;
    }
    mesh.positions.truncate(kept as usize);
    let now = |v: u32| numbers[becomes[v as usize] as usize];
    mesh.faces.as_flattened_mut().iter_mut().for_each(|v| *v = numbers[*v as usize]);
    locked.iter_mut().for_each(|v| *v = now(*v));
    locked.retain(|v| *v != u32::MAX);
    samples.iter_mut().for_each(|sample| sample.near = now(sample.near));
}

/// The result as it grows, on scratch: tiles share the vertices at their cuts.
pub(super) struct Joined<S> {
    positions: ScratchFile,
    faces: ScratchFile,
    vertices: u32,
    shared: FxHashMap<[u64; 3], u32>,
    scalar: PhantomData<S>,
}

impl<S: Coordinate> Joined<S> {
    pub fn new(scratch: &Scratch) -> Result<Self> {
        let (positions, faces) = (scratch.file()?, scratch.file()?);
        Ok(Joined { positions, faces, vertices: 0, shared: FxHashMap::default(), scalar: PhantomData })
    }

    pub fn add(&mut self, mesh: &IndexedMesh<S>, locked: &[u32]) -> Result<()> {
        let mut numbers = vec![u32::MAX; mesh.positions.len()];
        let key = |v: u32| mesh.positions[v as usize].map(|x| (x.widen() + 0.0).to_bits());
        for &v in locked {
            numbers[v as usize] = self.shared.get(&key(v)).copied().unwrap_or(u32::MAX);
        }
        let mut fresh = Vec::with_capacity(mesh.positions.len());
        for (number, position) in numbers.iter_mut().zip(&mesh.positions).filter(|(number, _)| **number == u32::MAX) {
            *number = self.vertices;
            self.vertices += 1;
            fresh.push(*position);
        }
        locked.iter().for_each(|&v| {
            self.shared.insert(key(v), numbers[v as usize]);
        });
        let faces: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.map(|v| numbers[v as usize])).collect();
        self.positions.append(bytemuck::cast_slice(&fresh))?;
        self.faces.append(bytemuck::cast_slice(&faces)).map(|_| ())
    }

    pub fn into_mesh(mut self) -> Result<IndexedMesh<S>> {
        // Let go before there is the whole result.
        self.shared = FxHashMap::default();
        let mut positions: Vec<[S; 3]> = bytemuck::zeroed_vec(self.vertices as usize);
        let mut faces: Vec<[u32; 3]> = bytemuck::zeroed_vec((self.faces.length() / 12) as usize);
        self.positions.read_exact_at(bytemuck::cast_slice_mut(&mut positions), 0)?;
        self.faces.read_exact_at(bytemuck::cast_slice_mut(&mut faces), 0)?;
        Ok(IndexedMesh { positions, faces })
    }
}
