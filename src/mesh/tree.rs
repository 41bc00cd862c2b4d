//! The nearest point of a mesh: a tree of boxes over its triangles.
//!
//! The answer is exact: distances are measured in doubles, to triangles, and boxes only rule out what cannot be nearer.
//! It is also a function of the mesh and the point alone: among triangles that are equally near (those around a vertex, say)
//! the one of the lowest number is named, wherever the search begins. A good beginning saves time, nothing else.
//!
//! **Memory** ([`Tree::bytes`], [`Tree::build_bytes`]): 4 bytes a face of order and about 9.4 of nodes; while it is built,
//! 16 more. The mesh is borrowed, not copied.

use super::boxes::{Aabb, Boxes, Item, Origin};
use super::triangle::{distance_sq, nearest_on_triangle};
use super::{Coordinate, Extent, IndexedMesh};
use glam::DVec3;
use rayon::prelude::*;

/// Triangles a leaf: a node's worth of boxes costs as much as measuring a triangle or two.
const LEAF: usize = 4;

/// A mesh that can be asked for its nearest point.
#[derive(Debug, Clone)]
pub struct Tree<'a, S> {
    mesh: &'a IndexedMesh<S>,
    origin: Origin,
    boxes: Boxes<LEAF>,
    /// The faces in the tree's order.
    order: Vec<u32>,
}

/// A place on a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// The face that it is on.
    pub face: u32,
    /// Where it is.
    pub point: DVec3,
    /// The squared distance to the point that asked.
    pub distance_sq: f64,
}

impl<'a, S: Coordinate> Tree<'a, S> {
    /// Builds a tree over a mesh that has faces, on rayon's threads.
    pub fn build(mesh: &'a IndexedMesh<S>) -> Self {
        assert!(!mesh.faces.is_empty(), "a mesh without faces has no nearest point");
        let mut extent = Extent::default();
        (0..mesh.positions.len() as u32).for_each(|v| extent.include(mesh.at(v)));
        let origin = Origin::of(&extent);
        let around = |face: usize| origin.around(mesh.faces[face].map(|v| origin.about(mesh.at(v))));
        let item = |face: usize| {
            let b = around(face);
            Item { at: 0.5 * (b.min + b.max), id: face as u32 }
        };
        let mut items: Vec<Item> = (0..mesh.faces.len()).into_par_iter().map(item).collect();
        let boxes = Boxes::build(&mut items, |item| around(item.id as usize));
        let order = items.iter().map(|item| item.id).collect();
        Tree { mesh, origin, boxes, order }
    }

    /// The nearest place to `p`. The search begins at face `start`: the nearer that is, the less is left to look at.
    #[inline]
    pub fn nearest(&self, p: DVec3, start: u32) -> Nearest {
        let (face, _) = self.search(p, start);
        let (point, distance_sq) = nearest_on_triangle(p, self.corners(face));
        Nearest { face, point, distance_sq }
    }

    /// The face that is nearest to `p`, and its squared distance; all of [`Tree::nearest`] but the point.
    #[inline]
    pub fn search(&self, p: DVec3, start: u32) -> (u32, f64) {
        let start = if (start as usize) < self.mesh.faces.len() { start } else { 0 };
        let mut best = (distance_sq(p, self.corners(start)), start);
        self.boxes.search(Aabb::at(self.origin.about(p)), best.0, |items| {
            for &face in &self.order[items] {
                let here = (distance_sq(p, self.corners(face)), face);
                if here < best {
                    best = here;
                }
            }
            best.0
        });
        (best.1, best.0)
    }

    #[inline(always)]
    fn corners(&self, face: u32) -> [DVec3; 3] {
        let [a, b, c] = self.mesh.faces[face as usize];
        [self.mesh.at(a), self.mesh.at(b), self.mesh.at(c)]
    }

    /// The mesh.
    pub fn mesh(&self) -> &'a IndexedMesh<S> {
        self.mesh
    }

    /// Bytes of a tree over so many faces.
    pub const fn bytes(faces: u64) -> u64 {
        Boxes::<LEAF>::bytes(faces) + 4 * faces
    }

    /// Bytes that it takes while it is built.
    pub const fn build_bytes(faces: u64) -> u64 {
        Self::bytes(faces) + size_of::<Item>() as u64 * faces
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A crumpled grid: near and far triangles, steep and flat ones, some of them twice and some without area.
    fn crumpled(side: u32) -> IndexedMesh<f32> {
        let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 8) as f32 / (1 << 24) as f32;
        let at =
            |i: u32| [(i % side) as f32, (i / side) as f32 + noise(i), 3.0 * noise(i + 7)].map(|x| x / side as f32);
        let quad =
            |i: u32| [[i, i + 1, i + side], [i + 1, i + side + 1, i + side], [i, i + side, i + 1], [i, i + 1, i]];
        let faces = (0..side * (side - 1) - 1).flat_map(quad).filter(|f| f[0] != f[2] || f[0] % 5 == 0).collect();
        IndexedMesh { positions: (0..side * side).map(at).collect(), faces }
    }

    #[test]
    fn it_finds_what_looking_at_all_finds_wherever_it_begins() {
        let mesh = crumpled(23);
        let tree = Tree::build(&mesh);
        let faces = mesh.faces.len() as u32;
        for i in 0..400u32 {
            let turn = |by: u32| f64::from(i.wrapping_mul(by) >> 10) / f64::from(1 << 22);
            let p = DVec3::new(turn(2_654_435_761), turn(40_503 * 7919), turn(97 * 65_537)) * 1.6 - 0.3;
            // Every fourth on the surface, where distances vanish.
            let p = if i % 4 == 0 { tree.nearest(p, 0).point } else { p };
            let all = (0..faces).map(|f| (distance_sq(p, tree.corners(f)), f));
            let (least, face) = all.min_by(|a, b| a.partial_cmp(b).unwrap()).unwrap();
            for start in [0, i % faces, faces - 1, face, u32::MAX] {
                assert_eq!(tree.search(p, start), (face, least), "{p} from {start}");
                let found = tree.nearest(p, start);
                assert_eq!((found.face, found.distance_sq), (face, least));
                assert!(((found.point - p).length_squared() - least).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn far_points_and_offsets_lose_nothing() {
        let near = crumpled(9);
        let far = DVec3::new(500_000.0, 5_400_000.0, 300.0);
        let positions = near.positions.iter().map(|p| (DVec3::from(p.map(f64::from)) + far).to_array()).collect();
        let mesh = IndexedMesh::<f64> { positions, faces: near.faces };
        let tree = Tree::build(&mesh);
        for (i, p) in [DVec3::ZERO, far, far + 0.25, far - 9e5, DVec3::splat(1e9)].into_iter().enumerate() {
            let all = (0..mesh.faces.len() as u32).map(|f| (distance_sq(p, tree.corners(f)), f));
            let (least, face) = all.min_by(|a, b| a.partial_cmp(b).unwrap()).unwrap();
            assert_eq!(tree.search(p, 7 * i as u32), (face, least), "{p}");
        }
    }
}
