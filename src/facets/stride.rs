//! Every so many of a mesh's vertices, or faces.

/// Every so many of a mesh's vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stride {
    every: u64,
    /// ⌈2⁶⁴ / every⌉, 0 for 1: tells multiples by one product (Lemire, Kaser and Kurz, 2019).
    inverse: u64,
}

impl Stride {
    /// So that of `vertices` at most `most` are taken.
    pub fn new(vertices: u64, most: u64) -> Self {
        let every = vertices.div_ceil(most.max(1)).max(1);
        Stride { every, inverse: (u64::MAX / every).wrapping_add(1) }
    }

    /// Whether vertex `v`, of fewer than 2³², is taken.
    #[inline(always)]
    pub fn takes(&self, v: u64) -> bool {
        v.wrapping_mul(self.inverse) <= self.inverse.wrapping_sub(1)
    }

    /// How many vertices are taken before vertex `v`.
    pub fn rank(&self, v: u64) -> u64 {
        v.div_ceil(self.every)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stride_takes_every_so_many() {
        for (vertices, most) in [(10, 10), (11, 10), (200_001, 200_000), (4_000_000_000, 200_000), (5, 0), (1, 7)] {
            let stride = Stride::new(vertices, most);
            let every = vertices.div_ceil(u64::max(most, 1));
            for v in (0..1_000.min(vertices)).chain(vertices.saturating_sub(1_000)..vertices) {
                assert_eq!(stride.takes(v), v % every == 0, "{v} of {vertices}");
                assert_eq!(stride.rank(v), v.div_ceil(every));
            }
            assert!(stride.rank(vertices) <= most.max(1));
        }
    }
}
