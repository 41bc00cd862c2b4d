//! Sets of numbers that threads add to together: a bit for each that could be in it.

use crate::cores::InPieces;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Words that are looked through by one task.
const TOGETHER: usize = 16;

/// A set of numbers below a bound.
#[derive(Debug)]
pub struct Marked(Vec<AtomicU64>);

impl Marked {
    /// The empty set of numbers below `bound`.
    pub fn below(bound: usize) -> Self {
        Marked(std::iter::repeat_with(AtomicU64::default).take(bound.div_ceil(64)).collect())
    }

    /// Adds a number.
    #[inline(always)]
    pub fn add(&self, number: u32) {
        let (word, bit) = (&self.0[number as usize / 64], 1 << (number % 64));
        if word.load(Relaxed) & bit == 0 {
            word.fetch_or(bit, Relaxed);
        }
    }

    /// Whether a number is in the set.
    #[inline(always)]
    pub fn has(&self, number: u32) -> bool {
        self.0[number as usize / 64].load(Relaxed) >> (number % 64) & 1 == 1
    }

    /// All numbers in the set, in order.
    pub fn all(&self) -> impl ParallelIterator<Item = u32> {
        self.some_at_a_time().flatten_iter()
    }

    /// The same, up to a thousand at a time.
    pub fn some_at_a_time(&self) -> impl ParallelIterator<Item = Vec<u32>> {
        self.0.par_chunks(TOGETHER).enumerate().in_pieces(1).map(|(chunk, words)| {
            let mut numbers = Vec::new();
            for (word, first) in words.iter().zip((chunk * TOGETHER * 64..).step_by(64)) {
                let mut left = word.load(Relaxed);
                while left != 0 {
                    numbers.push(first as u32 + left.trailing_zeros());
                    left &= left - 1;
                }
            }
            numbers
        })
    }

    /// Takes all out again.
    pub fn clear(&mut self) {
        self.0.iter_mut().for_each(|word| *word.get_mut() = 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_added_is_there_once_and_in_order() {
        let mut marked = Marked::below(1000);
        for _ in 0..2 {
            (0..1000u32).into_par_iter().for_each(|i| marked.add(i * i % 1000));
            let mut squares: Vec<u32> = (0..1000).map(|i| i * i % 1000).collect();
            squares.sort_unstable();
            squares.dedup();
            assert_eq!(marked.all().collect::<Vec<_>>(), squares);
            assert!((0..1000).all(|i| marked.has(i) == squares.binary_search(&i).is_ok()));
            marked.clear();
            assert_eq!(marked.all().count(), 0);
        }
    }
}
