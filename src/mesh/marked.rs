//! Sets of numbers: a bit for each that could be in it.

/// A set of numbers below a bound.
#[derive(Debug)]
pub struct Marked(Vec<u64>);

impl Marked {
    /// The empty set of numbers below `bound`.
    pub fn below(bound: usize) -> Self {
        Marked(vec![0; bound.div_ceil(64)])
    }

    /// Adds a number.
    #[inline(always)]
    pub fn add(&mut self, number: u32) {
        self.0[number as usize / 64] |= 1 << (number % 64);
    }

    /// Takes a number out again.
    #[inline(always)]
    pub fn remove(&mut self, number: u32) {
        self.0[number as usize / 64] &= !(1 << (number % 64));
    }

    /// Whether a number is in the set.
    #[inline(always)]
    pub fn has(&self, number: u32) -> bool {
        self.0[number as usize / 64] >> (number % 64) & 1 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_added_is_there_until_it_is_removed() {
        let mut marked = Marked::below(1000);
        let squares: Vec<u32> = (0..1000u32).map(|i| i * i % 1000).collect();
        squares.iter().for_each(|square| marked.add(*square));
        assert!((0..1000).all(|i| marked.has(i) == squares.contains(&i)));
        squares.iter().for_each(|square| marked.remove(*square));
        assert!((0..1000).all(|i| !marked.has(i)));
    }
}
