//! Making one vertex of coincident ones.

use super::{Coordinate, IndexedMesh};

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

/// Welds vertices with equal coordinates, drops faces that then repeat a corner and vertices that no face uses. The first
/// of coincident vertices stays, orders are kept. In place, with one `u32` a vertex and a hash table of 8 to 16 bytes a
/// vertex beside it.
pub fn weld<S: Coordinate>(mesh: &mut IndexedMesh<S>) -> WeldReport {
    let mut report = WeldReport::default();
    let vertices = mesh.positions.len();
    const NONE: u32 = u32::MAX;

    let mut first: Vec<u32> = Vec::with_capacity(vertices);
    {
        let mask = (vertices * 3 / 2 + 1).next_power_of_two() - 1;
        let mut table = vec![NONE; mask + 1];
        for (v, p) in mesh.positions.iter().enumerate() {
            let mut slot = hash_position(p) as usize & mask;
            let found = loop {
                match table[slot] {
                    NONE => {
                        table[slot] = v as u32;
                        break v as u32;
                    }
                    u if mesh.positions[u as usize] == *p => break u,
                    _ => slot = (slot + 1) & mask,
                }
            };
            report.duplicate_vertices += u64::from(found != v as u32);
            first.push(found);
        }
    }

    let faces = mesh.faces.len();
    mesh.faces.retain_mut(|f| {
        *f = f.map(|v| first[v as usize]);
        f[0] != f[1] && f[1] != f[2] && f[2] != f[0]
    });
    report.repeated_corner_faces = (faces - mesh.faces.len()) as u64;

    let mut renumbered = first;
    renumbered.fill(NONE);
    for &v in mesh.faces.iter().flatten() {
        renumbered[v as usize] = 0;
    }
    let mut kept = 0u32;
    for (v, r) in renumbered.iter_mut().enumerate() {
        if *r != NONE {
            mesh.positions[kept as usize] = mesh.positions[v];
            *r = kept;
            kept += 1;
        }
    }
    report.unreferenced_vertices = vertices as u64 - report.duplicate_vertices - u64::from(kept);
    mesh.positions.truncate(kept as usize);
    for v in mesh.faces.iter_mut().flatten() {
        *v = renumbered[*v as usize];
    }
    report
}

/// Equal for equal positions: −0 and +0 are one coordinate.
pub(crate) fn hash_position<S: Coordinate>(p: &[S; 3]) -> u64 {
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
        let report = weld(&mut mesh);
        assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.positions, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]);
        assert_eq!(report, WeldReport { duplicate_vertices: 2, unreferenced_vertices: 1, repeated_corner_faces: 1 });
    }
}
