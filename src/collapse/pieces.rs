//! The pieces that a mesh falls into, and what losing one would cost.
//!
//! Quadrics know planes, not that a piece ends: a speck of a few faces costs next to nothing to flatten, though it may lie
//! far from all else, and the distance from where it was to what is left is what deviation measures (an archive's CT scans
//! have a thousand such pieces). So the collapse that would end a piece costs at least its *stake*: its area times the mean
//! squared distance from it to the nearest other piece. Specks close to a surface go as before, those that float
//! stay for as long as nothing else is cheaper to lose.

use super::batch::NONE;
use super::policy::Least;
use crate::cores::InPieces;
use crate::mesh::groups::Groups;
use crate::mesh::{Coordinate, Extent, IndexedMesh, Shades, Wedges, widen};
use crate::quadric::PackedQuadric;
use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// Vertices of a piece from which the nearest other piece is looked for.
const PROBES: usize = 8;

/// A piece of at most so many faces is left alone by rounds of groups, which could take it whole.
const SMALL: u32 = 64;

/// Which piece each vertex is in, and the pieces. 4 bytes a vertex where there is more than one.
#[derive(Debug, Default)]
pub(super) struct Pieces {
    /// Empty where all is one piece; [`NONE`] for vertices without a face.
    pub of: Vec<u32>,
    list: Vec<Piece>,
}

#[derive(Debug, Clone, Copy)]
struct Piece {
    faces: u32,
    /// With so many faces or fewer, its next collapse ends it: a tetrahedron's leaves two faces back to back.
    last: u32,
    stake: f32,
}

impl Pieces {
    /// Finds the pieces of a mesh, whose vertices [`joined`] has joined. `is_odd` says of a vertex whether it is on a border.
    pub fn find<S: Coordinate>(mesh: &IndexedMesh<S>, joined: Vec<u32>, is_odd: impl Fn(u32) -> bool + Sync) -> Self {
        let mut of = joined;
        let first = mesh.faces.first().map_or(0, |face| of[face[0] as usize]);
        if mesh.faces.par_iter().in_pieces(4096).all(|face| of[face[0] as usize] == first) {
            return Pieces::default();
        }
        let roots: Vec<AtomicU32> = of.par_iter().in_pieces(4096).map(|_| AtomicU32::new(NONE)).collect();
        mesh.faces.par_iter().in_pieces(4096).for_each(|face| {
            let root = &roots[of[face[0] as usize] as usize];
            if root.load(Relaxed) == NONE {
                root.store(0, Relaxed);
            }
        });
        let mut list = Vec::new();
        for root in roots.iter().filter(|root| root.load(Relaxed) != NONE) {
            root.store(list.len() as u32, Relaxed);
            list.push(Piece { faces: 0, last: 4, stake: 0.0 });
        }
        of.par_iter_mut().in_pieces(4096).for_each(|root| *root = roots[*root as usize].load(Relaxed));
        let odd = |v: &u32| of[*v as usize] != NONE && is_odd(*v);
        let odd: Vec<u32> = (0..of.len() as u32).into_par_iter().in_pieces(4096).filter(odd).collect();
        odd.into_iter().for_each(|v| list[of[v as usize] as usize].last = 2);
        let mut pieces = Pieces { of, list };
        pieces.count(&mesh.faces);
        pieces.set_stakes(mesh);
        pieces
    }

    /// Counts every piece's faces.
    pub fn count(&mut self, faces: &[[u32; 3]]) {
        if self.of.is_empty() {
            return;
        }
        // A part of the faces a thread, as long as its counts are less work than they.
        let Pieces { of, list } = self;
        let part = (faces.len() / rayon::current_num_threads()).max(list.len()).max(1);
        let count = |faces: &[[u32; 3]]| {
            let mut counts = vec![0u32; list.len()];
            faces.iter().for_each(|face| counts[of[face[0] as usize] as usize] += 1);
            counts
        };
        let counts: Vec<Vec<u32>> = faces.par_chunks(part).map(count).collect();
        list.iter_mut().for_each(|piece| piece.faces = 0);
        for counts in counts {
            list.iter_mut().zip(counts).for_each(|(piece, count)| piece.faces += count);
        }
    }

    /// One face of the piece that `v` is in has gone.
    pub fn lose_face(&mut self, v: u32) {
        if let Some(&piece) = self.of.get(v as usize) {
            self.list[piece as usize].faces -= 1;
        }
    }

    /// The pieces of two vertices have become one: it is lost when both are.
    pub fn join(&mut self, a: u32, b: u32) {
        let (Some(&p), Some(&q)) = (self.of.get(a as usize), self.of.get(b as usize)) else { return };
        if p == q {
            return;
        }
        let (one, other) = (self.list[p as usize], self.list[q as usize]);
        let stake = if one.stake == 0.0 || other.stake == 0.0 { 0.0 } else { one.stake + other.stake };
        self.list[p as usize] = Piece { faces: one.faces + other.faces, last: one.last.min(other.last), stake };
        self.of.iter_mut().filter(|piece| **piece == q).for_each(|piece| *piece = p);
    }

    /// What a collapse at `v` costs, stakes included.
    #[inline(always)]
    pub fn price(&self, v: u32, cost: f32) -> f32 {
        let Some(&piece) = self.of.get(v as usize) else { return cost };
        let piece = self.list[piece as usize];
        if piece.faces <= piece.last && cost < piece.stake { piece.stake } else { cost }
    }

    /// Whether `v` is in a piece that groups could take whole.
    #[inline(always)]
    pub fn is_small(&self, v: u32) -> bool {
        let piece = self.of.get(v as usize).and_then(|&piece| self.list.get(piece as usize));
        piece.is_some_and(|piece| piece.faces <= SMALL)
    }

    /// The stake of every piece but the largest.
    fn set_stakes<S: Coordinate>(&mut self, mesh: &IndexedMesh<S>) {
        let most = self.list.iter().map(|piece| piece.faces).max();
        let largest = self.list.iter().position(|piece| Some(piece.faces) == most).map_or(NONE, |i| i as u32);
        let ((areas, probes), places) =
            rayon::join(|| (self.areas(mesh, largest), self.probes(largest)), || Places::of(mesh, &self.of));
        let stakes: Vec<f32> = (areas.into_par_iter().zip(probes).zip(0..self.list.len() as u32))
            .map(|((area, probes), piece)| {
                let there = probes.iter().filter(|v| **v != NONE);
                let distances_sq = there.map(|&v| places.nearest_sq(mesh.at(v), piece));
                let (sum, count) = distances_sq.fold((0.0, 0), |(sum, count), d| (sum + d, count + 1));
                (area * sum / f64::from(count.max(1))) as f32
            })
            .collect();
        for (piece, stake) in self.list.iter_mut().zip(stakes) {
            piece.stake = if stake.is_finite() { stake } else { 0.0 };
        }
    }

    /// The area of every piece but one.
    fn areas<S: Coordinate>(&self, mesh: &IndexedMesh<S>, but: u32) -> Vec<f64> {
        let mut areas = vec![0.0; self.list.len()];
        for face in &mesh.faces {
            let piece = self.of[face[0] as usize];
            if piece != but {
                let [a, b, c] = face.map(|v| mesh.at(v));
                areas[piece as usize] += 0.5 * (b - a).cross(c - a).length();
            }
        }
        areas
    }

    /// Vertices of every piece but one, spread over its numbers.
    fn probes(&self, but: u32) -> Vec<[u32; PROBES]> {
        let mut vertices = vec![0u32; self.list.len()];
        let used = || self.of.iter().zip(0..).filter(|(piece, _)| **piece != NONE && **piece != but);
        for (&piece, _) in used() {
            vertices[piece as usize] += 1;
        }
        let mut probes = vec![[NONE; PROBES]; self.list.len()];
        let mut seen = vec![0u32; self.list.len()];
        for (&piece, v) in used() {
            let (seen, all) = (&mut seen[piece as usize], vertices[piece as usize]);
            let slot = u64::from(*seen) * PROBES as u64 / u64::from(all);
            probes[piece as usize][slot as usize] = v;
            *seen += 1;
        }
        probes
    }
}

/// What went because it was too small.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Dropped {
    /// Pieces.
    pub pieces: u64,
    /// Their faces.
    pub faces: u64,
}

/// Drops the pieces that are less than `least`, with their vertices.
pub(super) fn drop_small<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    learnt: &mut Option<Vec<PackedQuadric>>,
    shades: &mut Shades,
    wedges: &mut Wedges,
    least: Least,
) -> Dropped {
    let of = joined(&mesh.faces, mesh.positions.len());
    let mut sizes = vec![0.0f64; of.len()];
    for &[a, b, c] in &mesh.faces {
        let area = || 0.5 * (mesh.at(b) - mesh.at(a)).cross(mesh.at(c) - mesh.at(a)).length();
        sizes[of[a as usize] as usize] += if let Least::Area(_) = least { area() } else { 1.0 };
    }
    let least = match least {
        Least::Faces(faces) => faces as f64,
        Least::Area(area) => area,
    };
    let small: Vec<bool> = of.iter().map(|&root| sizes[root as usize] < least).collect();
    let is_small = |face: &[u32; 3]| small[face[0] as usize];
    let roots_of_small: FxHashSet<u32> = mesh.faces.iter().filter(|f| is_small(f)).map(|f| of[f[0] as usize]).collect();
    let pieces = roots_of_small.len();
    let before = mesh.faces.len();
    let mut go = mesh.faces.iter().map(is_small);
    wedges.corners.retain(|_| go.next() == Some(false));
    mesh.faces.retain(|face| !is_small(face));
    let numbers = small.iter().scan(0, |kept, small| {
        *kept += u32::from(!small);
        Some(*kept - u32::from(!small))
    });
    let numbers: Vec<u32> = numbers.collect();
    mesh.faces.iter_mut().flatten().for_each(|v| *v = numbers[*v as usize]);
    keep(&mut mesh.positions, &small);
    if let Some(learnt) = learnt {
        keep(learnt, &small);
    }
    if wedges.is_empty() {
        shades.keep(small.len(), |i| (!small[i]).then(|| numbers[i]));
    }
    Dropped { pieces: pieces as u64, faces: (before - mesh.faces.len()) as u64 }
}

/// Keeps the items that do not go.
fn keep<T>(items: &mut Vec<T>, go: &[bool]) {
    let mut go = go.iter();
    items.retain(|_| go.next() == Some(&false));
}

/// For every one of `vertices` vertices the least that `faces` join it to: itself where it has none.
pub(super) fn joined(faces: &[[u32; 3]], vertices: usize) -> Vec<u32> {
    let mut up: Vec<u32> = (0..vertices as u32).collect();
    let root = |up: &mut [u32], mut v: u32| {
        while up[v as usize] != v {
            up[v as usize] = up[up[v as usize] as usize];
            v = up[v as usize];
        }
        v
    };
    for face in faces {
        let [p, q, r] = face.map(|v| up[v as usize]);
        if p == q && q == r {
            continue;
        }
        let mut low = root(&mut up, p);
        for v in [q, r] {
            let r = root(&mut up, v);
            up[low.max(r) as usize] = low.min(r);
            low = low.min(r);
        }
        face.iter().for_each(|v| up[*v as usize] = low);
    }
    // A vertex's way up only falls, so that one step is enough when all before it are flat.
    for v in 0..up.len() {
        up[v] = up[up[v] as usize];
    }
    up
}

/// Positions in the order of a space-filling curve: a cube of space is a range of them.
struct Places {
    /// Curve keys, and below them the vertices.
    sorted: Vec<u64>,
    /// Where the cubes at [`COARSE`] begin.
    begins: Vec<u32>,
    at: Vec<DVec3>,
    /// The piece of each.
    of: Vec<u32>,
    /// How often the piece has changed on the way to each: where it has not, a range is of one piece.
    changes: Vec<u32>,
    low: DVec3,
    side: f64,
}

/// Levels of the curve: cubes of 2⁻¹⁰ of the longest side, so that a key and a vertex share a word.
const LEVELS: u32 = 10;

/// The level whose cubes are listed.
const COARSE: u32 = 5;

/// A cube with so few positions is looked through.
const LEAF: usize = 16;

impl Places {
    /// Of those vertices of a mesh that are in a piece.
    fn of<S: Coordinate>(mesh: &IndexedMesh<S>, pieces: &[u32]) -> Self {
        let include = |mut extent: Extent, p: &[S; 3]| {
            extent.include(widen(*p));
            extent
        };
        let positions = mesh.positions.par_iter().in_pieces(4096);
        let extent = positions.fold(Extent::default, include).reduce(Extent::default, Extent::union);
        let (low, side) = (extent.min, extent.size().max_element());
        let cubes = f64::from(1u32 << LEVELS);
        let key = |p: DVec3| {
            let scaled = ((p - low) / side * cubes).clamp(DVec3::ZERO, DVec3::splat(cubes - 1.0));
            spread(scaled.x as u64) | spread(scaled.y as u64) << 1 | spread(scaled.z as u64) << 2
        };
        // By coarse cubes first, each of which is little to sort then.
        let key_of = |(p, piece): (&[S; 3], &u32)| if *piece == NONE { NONE } else { key(widen(*p)) as u32 };
        let keys: Vec<u32> = mesh.positions.par_iter().zip(pieces).in_pieces(4096).map(key_of).collect();
        let mut coarse = Groups::default();
        coarse.rebuild(1 << (3 * (LEVELS - COARSE)), keys.len(), |range| {
            keys[range.clone()].iter().map(|key| key >> (3 * COARSE)).zip(range.start as u32..)
        });
        let (begins, vertices) = coarse.into_parts();
        let entry = |v: &u32| u64::from(keys[*v as usize]) << 32 | u64::from(*v);
        let mut sorted: Vec<u64> = vertices.par_iter().in_pieces(4096).map(entry).collect();
        sorted
            .par_chunk_by_mut(|a, b| a >> (32 + 3 * COARSE) == b >> (32 + 3 * COARSE))
            .for_each(<[u64]>::sort_unstable);
        let sort = || sorted.par_iter().in_pieces(4096).map(|entry| *entry as u32);
        let at = sort().map(|v| mesh.at(v)).collect();
        let of: Vec<u32> = sort().map(|v| pieces[v as usize]).collect();
        let mut changes = vec![0; of.len()];
        for i in 1..of.len() {
            changes[i] = changes[i - 1] + u32::from(of[i] != of[i - 1]);
        }
        Places { sorted, begins, at, of, changes, low, side }
    }

    /// The squared distance to the nearest position in another piece than this; infinite if there is none.
    fn nearest_sq(&self, from: DVec3, not: u32) -> f64 {
        let mut best = f64::INFINITY;
        self.search((from, not), (0, self.sorted.len()), LEVELS, self.low, &mut best);
        best
    }

    fn search(
        &self,
        (from, not): (DVec3, u32),
        (begin, end): (usize, usize),
        level: u32,
        corner: DVec3,
        best: &mut f64,
    ) {
        if begin == end || self.of[begin] == not && self.changes[begin] == self.changes[end - 1] {
            return;
        }
        if end - begin <= LEAF || level == 0 {
            for (at, of) in self.at[begin..end].iter().zip(&self.of[begin..end]) {
                let distance_sq = at.distance_squared(from);
                if distance_sq < *best && *of != not {
                    *best = distance_sq;
                }
            }
            return;
        }
        let side = self.side * 0.5f64.powi((LEVELS - level + 1) as i32);
        let mut children = [(f64::INFINITY, (0, 0), corner); 8];
        let (mut at, shift) = (begin, 3 * (level - 1));
        let first = (self.sorted[begin] >> (32 + shift)) & !7;
        for (i, child) in children.iter_mut().enumerate() {
            let next = first + i as u64 + 1;
            let stop = match shift.checked_sub(3 * COARSE) {
                Some(shift) => self.begins[(next << shift) as usize] as usize,
                None => at + self.sorted[at..end].partition_point(|&entry| entry >> (32 + shift) < next),
            };
            let low = corner + side * DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64);
            if stop > at {
                *child = (from.distance_squared(from.clamp(low, low + side)), (at, stop), low);
            }
            at = stop;
        }
        children.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (distance_sq, range, low) in children {
            if distance_sq < *best {
                self.search((from, not), range, level - 1, low, best);
            }
        }
    }
}

/// Every third bit.
fn spread(x: u64) -> u64 {
    let mut x = x & 0x3ff;
    x = (x | x << 16) & 0x0300_00ff;
    x = (x | x << 8) & 0x0300_f00f;
    x = (x | x << 4) & 0x030c_30c3;
    (x | x << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `count` tetrahedra of that size, in places that a hash chooses.
    fn dust(count: u32, size: f32) -> IndexedMesh<f32> {
        let mut mesh = IndexedMesh::default();
        for i in 0..count {
            let h = |s: u32| ((i * 4 + s).wrapping_mul(2_654_435_761) >> 8) as f32 / (1u32 << 24) as f32;
            let at = [h(1), h(2), 3.0 * h(3)];
            let n = mesh.positions.len() as u32;
            for corner in [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
                mesh.positions.push([0, 1, 2].map(|k| at[k] + size * corner[k]));
            }
            mesh.faces.extend([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|f| f.map(|v| v + n)));
        }
        mesh
    }

    #[test]
    fn the_nearest_vertex_of_another_piece_is_found() {
        let mesh = dust(300, 0.01);
        // Two tetrahedra a piece, and every seventh vertex in none.
        let piece = |v: u32| if v % 7 == 3 { NONE } else { v / 8 };
        let pieces: Vec<u32> = (0..1200).map(piece).collect();
        let places = Places::of(&mesh, &pieces);
        for v in (0..1200).step_by(7) {
            let others = (0..1200).filter(|&u| piece(u) != NONE && piece(u) != piece(v));
            let nearest = others.map(|u| mesh.at(u).distance_squared(mesh.at(v))).fold(f64::INFINITY, f64::min);
            assert_eq!(places.nearest_sq(mesh.at(v), piece(v)), nearest);
        }
        assert_eq!(Places::of(&mesh, &[5; 1200]).nearest_sq(DVec3::ZERO, 5), f64::INFINITY);
    }

    fn found(mesh: &IndexedMesh<f32>) -> Pieces {
        Pieces::find(mesh, joined(&mesh.faces, mesh.positions.len()), |_| false)
    }

    #[test]
    fn pieces_are_found_whatever_the_order_of_faces() {
        let mut mesh = dust(50, 0.01);
        // Joined to one chain from its end to its beginning, and one piece apart.
        for i in (1..49u32).rev() {
            mesh.faces.insert(i as usize * 3, [4 * i + 3, 4 * i - 2, 4 * i]);
        }
        mesh.positions.push([0.0; 3]);
        let pieces = found(&mesh);
        let last = pieces.of[196];
        assert!((0..196).all(|v| pieces.of[v] == pieces.of[0]) && last != pieces.of[0]);
        assert_eq!((pieces.list.len(), pieces.list[last as usize].faces, pieces.of[200]), (2, 4, NONE));
        assert!(found(&dust(1, 0.1)).of.is_empty());
    }

    #[test]
    fn small_pieces_are_dropped_by_faces_or_by_area() {
        for (least, pieces) in
            [(Least::Faces(5), 0), (Least::Area(1e-3), 0), (Least::Area(1e-5), 1), (Least::Faces(4), 1)]
        {
            let mut mesh = dust(1, 0.01);
            let big = dust(1, 0.5);
            mesh.faces.extend(big.faces.iter().map(|f| f.map(|v| v + 4)));
            mesh.faces.push([4, 5, 6]);
            mesh.positions.extend(&big.positions);
            let dropped = drop_small(&mut mesh, &mut None, &mut Shades::default(), &mut Wedges::default(), least);
            assert_eq!((dropped.pieces, dropped.faces), (1 - pieces, 4 - 4 * pieces), "{least:?}");
            assert_eq!((mesh.faces.len() as u64, mesh.positions.len() as u64), (5 + 4 * pieces, 4 + 4 * pieces));
            assert!(mesh.faces.iter().flatten().all(|&v| u64::from(v) < 4 + 4 * pieces));
        }
    }

    #[test]
    fn the_last_collapse_of_a_piece_costs_its_stake() {
        let mut mesh = dust(2, 0.125);
        for v in 0..8 {
            let offset = if v < 4 { 0.0 } else { 2.0 };
            mesh.positions[v] = mesh.positions[v % 4].map(|x| x + offset);
        }
        mesh.faces.extend([[0, 1, 2], [0, 1, 2]]);
        let mut pieces = found(&mesh);
        // Half of three squares' halves and the slanted face; about 3.46 away.
        let area = 0.125 * 0.125 * (1.5 + 0.75f64.sqrt());
        let stake = f64::from(pieces.price(5, 0.0));
        assert!(stake > area * 3.1 * 3.1 && stake < area * 3.5 * 3.5, "{stake}");
        assert_eq!((pieces.price(5, 1e3), pieces.price(0, 0.0)), (1e3, 0.0));
        pieces.list[1].faces = 5;
        assert_eq!(pieces.price(5, 0.0), 0.0);
        pieces.lose_face(6);
        assert!(pieces.price(5, 0.0) > 0.0);
    }
}
