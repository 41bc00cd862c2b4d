//! Making one vertex of coincident ones.

use super::{Coordinate, IndexedMesh, number_used, renumber};
use crate::cores::InPieces;
use crate::error::Result;
use rayon::prelude::*;

/// What [`weld`] found.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct WeldReport {
    /// Vertices at a position that an earlier vertex already had.
    pub duplicate_vertices: u64,
    /// Vertices that no remaining face uses.
    pub unreferenced_vertices: u64,
    /// Faces with a repeated corner, before or after welding.
    pub repeated_corner_faces: u64,
}

/// Batches between two questions whether to go on.
const CHECKED_BATCHES: usize = 1 << 12;

/// Welds vertices with equal coordinates, drops faces that then repeat a corner and vertices that no face uses. The first
/// of coincident vertices stays, orders are kept. In place, with one `u32` a vertex and a hash table of 6 to 12 bytes a
/// vertex beside it. `check` is asked now and then whether to go on.
pub fn weld<S: Coordinate>(mesh: &mut IndexedMesh<S>, check: impl Fn() -> Result<()>) -> Result<WeldReport> {
    let mut report = WeldReport::default();
    let vertices = mesh.positions.len();

    let mut first: Vec<u32> = Vec::with_capacity(vertices);
    {
        let mut table = PositionTable::with_room_for(vertices);
        for (number, batch) in mesh.positions.chunks(BATCH).enumerate() {
            if number.is_multiple_of(CHECKED_BATCHES) {
                check()?;
            }
            let looked_up = table.look_up(batch, &mesh.positions);
            for (p, &look_up) in batch.iter().zip(&looked_up) {
                let v = first.len() as u32;
                let found = table.find_or_insert(p, look_up, &mesh.positions, v);
                report.duplicate_vertices += u64::from(found != v);
                first.push(found);
            }
        }
    }

    if report.duplicate_vertices > 0 {
        renumber(&mut mesh.faces, &first);
    }
    let repeats = |[a, b, c]: &[u32; 3]| a == b || b == c || c == a;
    report.repeated_corner_faces = mesh.faces.par_iter().in_pieces(4096).filter(|face| repeats(face)).count() as u64;
    if report.repeated_corner_faces > 0 {
        mesh.faces.retain(|face| !repeats(face));
    }

    drop(first);
    let (numbers, kept) = number_used(&mesh.faces, vertices);
    report.unreferenced_vertices = vertices as u64 - report.duplicate_vertices - kept as u64;
    if kept < vertices {
        let mut number = numbers.iter();
        mesh.positions.retain(|_| number.next() != Some(&NONE));
        renumber(&mut mesh.faces, &numbers);
    }
    Ok(report)
}

const NONE: u32 = u32::MAX;

/// Positions that are looked up together, so that the processor waits for memory once a batch instead of once a position.
pub(crate) const BATCH: usize = 48;

/// Finds the vertex at a position: open addressing over vertex numbers, 4 bytes a slot, at most two thirds full.
pub(crate) struct PositionTable {
    slots: Vec<u32>,
}

/// A position's hash, and the vertex in its first slot if that is at the very position.
#[derive(Clone, Copy)]
pub(crate) struct LookUp {
    hash: usize,
    vertex: u32,
}

impl PositionTable {
    /// A table for up to so many positions.
    pub fn with_room_for(positions: usize) -> Self {
        PositionTable { slots: vec![NONE; (positions * 3 / 2 + 1).next_power_of_two()] }
    }

    /// Whether so many positions would leave it at most two thirds full.
    pub fn has_room_for(&self, positions: usize) -> bool {
        positions * 3 / 2 < self.slots.len()
    }

    /// Looks into the first slot of each position of a batch. What is found stays true, whatever is inserted.
    pub fn look_up<S: Coordinate>(&self, batch: &[[S; 3]], positions: &[[S; 3]]) -> [LookUp; BATCH] {
        let mut looked_up = [LookUp { hash: 0, vertex: NONE }; BATCH];
        for (look_up, p) in looked_up.iter_mut().zip(batch) {
            look_up.hash = hash_position(p) as usize;
            look_up.vertex = self.slots[look_up.hash & (self.slots.len() - 1)];
        }
        for (look_up, p) in looked_up.iter_mut().zip(batch) {
            if positions.get(look_up.vertex as usize) != Some(p) {
                look_up.vertex = NONE;
            }
        }
        looked_up
    }

    /// The vertex at `p`, else `new`, which then is there.
    #[inline]
    pub fn find_or_insert<S: Coordinate>(&mut self, p: &[S; 3], at: LookUp, positions: &[[S; 3]], new: u32) -> u32 {
        if at.vertex != NONE {
            return at.vertex;
        }
        let mask = self.slots.len() - 1;
        let mut slot = at.hash & mask;
        loop {
            match self.slots[slot] {
                NONE => {
                    self.slots[slot] = new;
                    return new;
                }
                v if positions[v as usize] == *p => return v,
                _ => slot = (slot + 1) & mask,
            }
        }
    }

    /// The vertex at `p`, if there is one.
    pub fn find<S: Coordinate>(&self, p: &[S; 3], at: LookUp, positions: &[[S; 3]]) -> Option<u32> {
        if at.vertex != NONE {
            return Some(at.vertex);
        }
        let mask = self.slots.len() - 1;
        let mut slot = at.hash & mask;
        loop {
            match self.slots[slot] {
                NONE => return None,
                v if positions[v as usize] == *p => return Some(v),
                _ => slot = (slot + 1) & mask,
            }
        }
    }

    /// Doubles the slots. The old ones are given back first: the positions, all different, are all it takes.
    pub fn grow<S: Coordinate>(&mut self, positions: &[[S; 3]]) {
        let slots = 2 * self.slots.len();
        self.slots = Vec::new();
        self.slots.resize(slots, NONE);
        for (v, p) in positions.iter().enumerate() {
            let mut slot = hash_position(p) as usize & (slots - 1);
            while self.slots[slot] != NONE {
                slot = (slot + 1) & (slots - 1);
            }
            self.slots[slot] = v as u32;
        }
    }
}

/// Equal for equal positions: −0 and +0 are one coordinate.
fn hash_position<S: Coordinate>(p: &[S; 3]) -> u64 {
    let mut h = 0u64;
    for x in p {
        h = (h ^ (x.widen() + 0.0).to_bits()).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        h ^= h >> 32;
    }
    h
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn welding_makes_a_quad_of_two_loose_triangles() {
        let mut mesh = IndexedMesh::<f32> {
            positions: vec![
                [9.0, 9.0, 9.0],
                [0.0, 0.0, 0.0],
                [1.0, 0.0, 0.0],
                [1.0, 1.0, 0.0],
                [-0.0, 0.0, -0.0],
                [1.0, 1.0, 0.0],
                [0.0, 1.0, 0.0],
            ],
            faces: vec![[1, 2, 3], [4, 5, 6], [1, 4, 2]],
        };
        let report = weld(&mut mesh, || Ok(())).unwrap();
        assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.positions, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]);
        assert_eq!(report, WeldReport { duplicate_vertices: 2, unreferenced_vertices: 1, repeated_corner_faces: 1 });
    }
}
