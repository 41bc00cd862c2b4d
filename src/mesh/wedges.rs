//! Vertices as each side of a seam sees them, and what is known of them while they merge.

/// A wedge is a vertex together with the values that it has on some of the faces around it. A vertex on a seam has
/// several; an edge is a seam where its faces do not have the same wedges at both its ends.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wedges {
    /// The wedge at each corner of each face. Empty where there are none.
    pub corners: Vec<[u32; 3]>,
    /// The wedge that each one has become: itself as long as it is there.
    pub becomes: Vec<u32>,
}

impl Wedges {
    /// Whether there are none.
    #[inline(always)]
    pub fn is_empty(&self) -> bool {
        self.corners.is_empty()
    }

    /// What a wedge has become.
    pub fn root(&self, mut wedge: u32) -> u32 {
        while self.becomes[wedge as usize] != wedge {
            wedge = self.becomes[wedge as usize];
        }
        wedge
    }

    /// `b` becomes `a`. Corners are told by whoever knows which.
    pub fn unite(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.becomes[b as usize] = a;
    }

    /// Makes every wedge know at once what it has become, corners included.
    pub fn settle(&mut self) {
        for wedge in 0..self.becomes.len() as u32 {
            let root = self.root(wedge);
            let mut at = wedge;
            while self.becomes[at as usize] != root {
                at = std::mem::replace(&mut self.becomes[at as usize], root);
            }
        }
        self.corners.iter_mut().flatten().for_each(|wedge| *wedge = self.becomes[*wedge as usize]);
    }
}

/// Numbers that steer the collapse, as lengths: so many for each vertex, or for each wedge where there are any.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Shades {
    /// Numbers of one.
    pub dims: usize,
    /// All of them, one after the other.
    pub values: Vec<f32>,
}

impl Shades {
    /// Numbers of one at the most.
    pub const MOST: usize = 8;

    /// Whether there are none.
    #[inline(always)]
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// The numbers of one vertex or wedge.
    #[inline(always)]
    pub fn of(&self, i: u32) -> &[f32] {
        &self.values[i as usize * self.dims..][..self.dims]
    }

    /// The same, to be changed.
    #[inline(always)]
    pub fn of_mut(&mut self, i: u32) -> &mut [f32] {
        &mut self.values[i as usize * self.dims..][..self.dims]
    }

    /// Makes all of them so many times as large.
    pub fn scale(&mut self, factor: f64) {
        self.values.iter_mut().for_each(|x| *x = (f64::from(*x) * factor) as f32);
    }

    /// Keeps those of the numbers `i` for which `number` has a new one, which is never larger.
    pub fn keep(&mut self, count: usize, number: impl Fn(usize) -> Option<u32>) {
        let (dims, mut kept) = (self.dims, 0);
        for i in 0..if self.is_empty() { 0 } else { count } {
            if let Some(new) = number(i) {
                self.values.copy_within(i * dims..(i + 1) * dims, new as usize * dims);
                kept += 1;
            }
        }
        self.values.truncate(kept * dims);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wedges_know_what_they_have_become() {
        let mut wedges = Wedges { corners: vec![[0, 1, 2], [3, 4, 2]], becomes: (0..5).collect() };
        wedges.unite(1, 2);
        wedges.unite(4, 1);
        wedges.unite(2, 4);
        wedges.settle();
        assert_eq!((wedges.becomes, wedges.corners), (vec![0, 4, 4, 3, 4], vec![[0, 4, 4], [3, 4, 4]]));
    }

    #[test]
    fn shades_keep_their_order() {
        let mut shades = Shades { dims: 2, values: (0..8).map(|x| x as f32).collect() };
        shades.keep(4, |i| [None, Some(0), None, Some(1)][i]);
        assert_eq!(shades.values, [2.0, 3.0, 6.0, 7.0]);
    }
}
