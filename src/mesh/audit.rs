//! What a mesh's edges and vertices are: regular, border, non-manifold; and how many pieces and borders they form.

use super::adjacency::{Stars, after, before, parts};
use crate::cores::InPieces;
use fearless_simd::{Simd, prelude::*, u32x8};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

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

/// What a whole mesh comes to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Audit {
    /// What is not regular.
    pub irregularities: Irregularities,
    /// Pieces that share no vertex.
    pub components: u64,
    /// Runs of border edges that share no vertex.
    pub borders: u64,
}

impl Audit {
    /// Bytes that [`Audit::of`] takes.
    pub const fn bytes(faces: u64, vertices: u64) -> u64 {
        12 * faces + 8 * vertices
    }

    /// Of a mesh in which every vertex has a face.
    pub fn of(faces: &[[u32; 3]], vertices: usize) -> Audit {
        let mut pieces = Pieces::of(vertices);
        for [a, b, c] in faces {
            pieces.join(*a, *b);
            pieces.join(*a, *c);
        }
        let components = pieces.count();
        let mut stars = Stars::default();
        stars.rebuild(faces, vertices);
        let ends = |v: u32, ends: &mut Vec<(u32, u32)>| {
            ends.clear();
            ends.extend(stars.of(v).iter().map(|&corner| {
                let (f, side) = parts(corner);
                (faces[f][after(side)], faces[f][before(side)])
            }));
        };
        let irregularities = (0..vertices as u32)
            .into_par_iter()
            .in_pieces(1024)
            .map_init(Vec::new, |around, v| {
                ends(v, around);
                if is_regular(around) { Irregularities::default() } else { irregularities(v, around).1 }
            })
            .reduce(Irregularities::default, |a, b| a + b);
        let mut borders = 0;
        if irregularities.border_edges > 0 {
            pieces.part();
            let (mut around, mut on_border) = (Vec::new(), 0);
            for v in 0..vertices as u32 {
                ends(v, &mut around);
                if is_regular(&around) {
                    continue;
                }
                let mut is_on_border = false;
                for_each_edge(&around, |other, sides| {
                    if sides.len() == 1 {
                        is_on_border = true;
                        pieces.join(v, other);
                    }
                });
                on_border += u64::from(is_on_border);
            }
            borders = pieces.count() - (vertices as u64 - on_border);
        }
        Audit { irregularities, components, borders }
    }
}

/// Sets of vertices that are joined bit by bit: 4 bytes a vertex.
#[derive(Debug)]
pub struct Pieces(Vec<u32>);

impl Pieces {
    /// So many, each apart.
    pub fn of(vertices: usize) -> Pieces {
        Pieces((0..vertices as u32).collect())
    }

    /// Joins the sets of two.
    #[inline]
    pub fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        // The lower number is the root: scans join neighbours, whose numbers are near.
        if a < b {
            self.0[b as usize] = a;
        } else {
            self.0[a as usize] = b;
        }
    }

    #[inline]
    fn root(&mut self, mut v: u32) -> u32 {
        while self.0[v as usize] != v {
            let above = self.0[self.0[v as usize] as usize];
            self.0[v as usize] = above;
            v = above;
        }
        v
    }

    /// How many sets there are.
    pub fn count(&self) -> u64 {
        self.0.iter().enumerate().filter(|(v, root)| *v as u32 == **root).count() as u64
    }

    /// Parts all again.
    fn part(&mut self) {
        self.0.iter_mut().enumerate().for_each(|(v, root)| *root = v as u32);
    }
}

/// Whether the faces at a vertex, each from one neighbour to the next, form one closed fan.
#[inline(always)]
pub fn is_regular(ends: &[(u32, u32)]) -> bool {
    let Some(&(start, mut u)) = ends.first() else { return true };
    // The walk is quadratic: large stars are sorted instead.
    if ends.len() > 64 {
        return false;
    }
    let mut fan = 1;
    while u != start {
        // Which of them goes on is as good as random: without a branch.
        let (mut after, mut found) = (u, 0);
        for &(from, to) in ends {
            after = if from == u { to } else { after };
            found += u32::from(from == u);
        }
        u = after;
        fan += 1;
        if found != 1 || fan > ends.len() {
            return false;
        }
    }
    fan == ends.len()
}

/// Faces of a star that one instruction looks at.
pub const LANES: usize = 8;

/// What [`is_regular`] says, of `n` faces at most [`LANES`], each from one neighbour to the next: which of them follows each
/// is found for all at once.
#[inline(always)]
pub fn is_regular_together<V: Simd>(simd: V, from: &[u32; LANES], to: &[u32; LANES], n: usize) -> bool {
    let all = u32x8::load_array_ref(simd, from);
    let there = (1 << n) - 1;
    let (mut next, mut regular) = ([0; LANES], true);
    for (next, to) in next.iter_mut().zip(to).take(n) {
        let found = all.simd_eq(u32x8::splat(simd, *to)).to_bitmask() & there;
        regular &= found.is_power_of_two();
        *next = found.trailing_zeros() as usize;
    }
    let mut at = 0;
    for step in 1..=n {
        at = next[at % LANES];
        regular &= (at == 0) == (step == n);
    }
    regular
}

/// Calls `each` with the other end of every edge at a vertex, and with the faces that it has there: whether each runs away
/// from the vertex along it.
fn for_each_edge(ends: &[(u32, u32)], mut each: impl FnMut(u32, &[(u32, bool)])) {
    let mut sides: Vec<(u32, bool)> = ends.iter().flat_map(|&(out, back)| [(out, true), (back, false)]).collect();
    sides.sort_unstable();
    for edge in sides.chunk_by(|a, b| a.0 == b.0) {
        each(edge[0].0, edge);
    }
}

/// Whether `v` is on an odd edge, and what is irregular there; each edge is counted at its lower end.
pub fn irregularities(v: u32, ends: &[(u32, u32)]) -> (bool, Irregularities) {
    let mut found = Irregularities::default();
    let mut odd = false;
    for_each_edge(ends, |other, sides| {
        if let [(_, false), (_, true)] = sides {
            return;
        }
        odd = true;
        if v < other {
            if sides.len() == 1 {
                found.border_edges += 1;
            } else {
                found.nonmanifold_edges += 1;
            }
        }
    });
    found.nonmanifold_vertices = u64::from(!odd && fan_length(ends) < ends.len());
    (odd, found)
}

/// How many of a vertex's faces the fan of the first has. All edges are regular.
fn fan_length(ends: &[(u32, u32)]) -> usize {
    let turns: FxHashMap<u32, u32> = ends.iter().copied().collect();
    let Some(&(start, mut u)) = ends.first() else { return 0 };
    let mut faces = 1;
    while u != start && faces <= ends.len() {
        let Some(&next) = turns.get(&u) else { break };
        u = next;
        faces += 1;
    }
    faces
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vectors::levels;
    use fearless_simd::dispatch;

    #[test]
    fn stars_are_as_regular_together_as_one_by_one() {
        let mut regular = 0;
        for seed in 0..20_000u32 {
            // A fan in some order; in half of them a few ends are others.
            let n = (seed % 9) as usize;
            let mut ends: Vec<(u32, u32)> = (0..n as u32).map(|i| (i, (i + 1) % n as u32)).collect();
            let mut lot = seed.wrapping_mul(0x9e37_79b9) | 1;
            let mut draw = |most: usize| {
                lot = lot.wrapping_mul(0x2c1b_3c6d) ^ lot >> 15;
                (lot >> 8) as usize % most
            };
            for i in 0..n {
                ends.swap(i, draw(n));
            }
            for _ in 0..draw(3) * usize::from(n > 0 && seed % 2 == 0) {
                let (i, j) = (draw(n), draw(n));
                match draw(2) {
                    0 => ends[i].1 = ends[j].1,
                    _ => (ends[i].1, ends[j].1) = (ends[j].1, ends[i].1),
                }
            }
            let (mut from, mut to) = ([7; LANES], [7; LANES]);
            ends.iter().enumerate().for_each(|(i, end)| (from[i], to[i]) = *end);
            for level in levels() {
                let together = dispatch!(level, simd => is_regular_together(simd, &from, &to, n));
                assert_eq!(together, is_regular(&ends), "{ends:?}");
            }
            regular += usize::from(is_regular(&ends));
        }
        assert!((5000..19_000).contains(&regular), "{regular}");
    }

    const TETRAHEDRON: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];

    fn moved(faces: &[[u32; 3]], by: u32) -> impl Iterator<Item = [u32; 3]> {
        faces.iter().map(move |face| face.map(|v| v + by))
    }

    #[test]
    fn pieces_and_borders_are_counted() {
        let closed = Audit { components: 1, ..Audit::default() };
        assert_eq!(Audit::of(&TETRAHEDRON, 4), closed);
        let two: Vec<[u32; 3]> = TETRAHEDRON.into_iter().chain(moved(&TETRAHEDRON, 4)).collect();
        assert_eq!(Audit::of(&two, 8), Audit { components: 2, ..closed });
        let open: Vec<[u32; 3]> = TETRAHEDRON[1..].iter().copied().chain(moved(&TETRAHEDRON[..3], 4)).collect();
        let found = Audit::of(&open, 8);
        assert_eq!((found.components, found.borders, found.irregularities.border_edges), (2, 2, 6));
        // A third face at an edge, and two surfaces that meet in a vertex.
        let fin: Vec<[u32; 3]> = TETRAHEDRON.into_iter().chain([[0, 1, 4]]).collect();
        let found = Audit::of(&fin, 5);
        assert_eq!((found.irregularities.nonmanifold_edges, found.irregularities.border_edges), (1, 2));
        assert_eq!(found.borders, 1);
        let touching: Vec<[u32; 3]> = TETRAHEDRON.into_iter().chain(moved(&TETRAHEDRON, 3)).collect();
        let found = Audit::of(&touching, 7);
        assert_eq!((found.irregularities.nonmanifold_vertices, found.components), (1, 1));
    }
}
