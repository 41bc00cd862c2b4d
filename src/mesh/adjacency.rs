//! Which corners meet at each vertex.

use super::groups::Groups;

/// The star of every vertex: the corners there, in face order. A corner is `4·face + side`, so that its parts come off by
/// shifts. 12 bytes a face and 4 a vertex.
#[derive(Debug, Default)]
pub struct Stars(Groups);

impl Stars {
    /// Gives back the memory that is not in use.
    pub fn give_back(&mut self) {
        self.0.give_back();
    }

    /// Rebuilds for `faces` over `vertices` vertices, reusing the memory. At most [`MOST_FACES`].
    pub fn rebuild(&mut self, faces: &[[u32; 3]], vertices: usize) {
        assert!(faces.len() <= MOST_FACES, "a corner is numbered in 32 bits");
        let corners = |(f, face): (u32, &[u32; 3])| [(face[0], 4 * f), (face[1], 4 * f + 1), (face[2], 4 * f + 2)];
        self.0.rebuild(vertices, faces.len(), |range| (range.start as u32..).zip(&faces[range]).flat_map(corners));
    }

    /// The corners at `v`.
    #[inline(always)]
    pub fn of(&self, v: u32) -> &[u32] {
        self.0.of(v as usize)
    }

    /// The face on the other side of an edge of face `f`; the first of more.
    pub fn across(&self, faces: &[[u32; 3]], f: usize, (u, v): (u32, u32)) -> Option<usize> {
        self.of(u).iter().map(|&corner| parts(corner).0).find(|&g| g != f && faces[g].contains(&v))
    }
}

/// Most faces that corners can be numbered for.
pub const MOST_FACES: usize = 1 << 30;

/// The face of a corner and its side there.
#[inline(always)]
pub fn parts(corner: u32) -> (usize, usize) {
    ((corner >> 2) as usize, (corner & 3) as usize)
}

/// The side after `side`. By shifts of the three answers: a table is laid out on the stack wherever this is used.
#[inline(always)]
pub fn after(side: usize) -> usize {
    0b00_10_01 >> (2 * (side & 3)) & 3
}

/// The side before `side`.
#[inline(always)]
pub fn before(side: usize) -> usize {
    0b01_00_10 >> (2 * (side & 3)) & 3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sides_follow_one_another() {
        assert_eq!([0, 1, 2].map(after), [1, 2, 0]);
        assert_eq!([0, 1, 2].map(before), [2, 0, 1]);
    }

    #[test]
    fn every_corner_is_in_the_star_of_its_vertex_and_nowhere_else() {
        let faces: Vec<[u32; 3]> = (0..9970u32).map(|i| [i * 7 % 113, i * 13 % 113 + 5, i * 31 % 120]).collect();
        let mut stars = Stars::default();
        for threads in [1, 2, 3, 4] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| stars.rebuild(&faces, 121));
            let mut seen = 0;
            for v in 0..121 {
                assert!(stars.of(v).is_sorted());
                for &c in stars.of(v) {
                    assert_eq!(faces[parts(c).0][parts(c).1], v);
                    seen += 1;
                }
            }
            assert_eq!(seen, 3 * faces.len());
        }
    }

    #[test]
    fn no_faces_leave_empty_stars() {
        let mut stars = Stars::default();
        stars.rebuild(&[], 5);
        assert!((0..5).all(|v| stars.of(v).is_empty()));
    }
}
