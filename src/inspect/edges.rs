//! Edges of a mesh that memory does not hold: written to scratch in parts that it does, then sorted part by part.

use crate::error::Result;
use crate::progress::Progress;
use crate::scratch::{Scratch, ScratchFile};
use bytemuck::Pod;
use rayon::prelude::*;

/// Edges that a worker gathers for each part before it writes them.
const GATHERED: usize = 512;

/// Parts at most.
pub(super) const MOST_PARTS: usize = 1024;

/// What tells a vertex from others: its number, or a hash of its place.
pub(super) trait Name: Pod + Ord + Send + Sync {
    /// Evenly spread bits of it.
    fn spread(self) -> u64;
}

impl Name for u32 {
    #[inline(always)]
    fn spread(self) -> u64 {
        u64::from(self).wrapping_mul(0x9e37_79b9_7f4a_7c15)
    }
}

impl Name for u64 {
    #[inline(always)]
    fn spread(self) -> u64 {
        self
    }
}

/// Edges as faces run along them, in scratch.
pub(super) struct Edges<N> {
    file: ScratchFile,
    /// Room for each part, which is exact but for what a part takes in another's blocks: blocks are handed out as they are
    /// filled, and each part remembers its own.
    blocks: Vec<std::sync::Mutex<Vec<(u64, u32)>>>,
    name: std::marker::PhantomData<N>,
}

/// Counts of odd edges.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Odd {
    pub border: u64,
    pub nonmanifold: u64,
}

/// What a worker has gathered.
pub(super) struct Gatherer<N>(Vec<Vec<[N; 2]>>);

/// Bytes that a worker gathers.
pub(super) const fn gatherer_bytes<N>(parts: usize) -> u64 {
    (parts * GATHERED * size_of::<[N; 2]>()) as u64
}

impl<N: Name> Edges<N> {
    /// For edges in so many parts.
    pub(super) fn new(scratch: &Scratch, parts: usize) -> Result<Self> {
        let blocks = (0..parts).map(|_| Default::default()).collect();
        Ok(Edges { file: scratch.file()?, blocks, name: std::marker::PhantomData })
    }

    /// What a worker gathers in.
    pub(super) fn gatherer(&self) -> Gatherer<N> {
        Gatherer(self.blocks.iter().map(|_| Vec::with_capacity(GATHERED)).collect())
    }

    /// Takes the edges of a triangle.
    #[inline]
    pub(super) fn take(&self, mine: &mut Gatherer<N>, [a, b, c]: [N; 3]) -> Result<()> {
        for edge in [[a, b], [b, c], [c, a]] {
            let low = edge[0].min(edge[1]);
            let part = ((u128::from(low.spread()) * self.blocks.len() as u128) >> 64) as usize;
            mine.0[part].push(edge);
            if mine.0[part].len() == GATHERED {
                self.write(part, &mut mine.0[part])?;
            }
        }
        Ok(())
    }

    /// Writes what is left with a worker.
    pub(super) fn finish(&self, mut mine: Gatherer<N>) -> Result<()> {
        (0..mine.0.len()).try_for_each(|part| self.write(part, &mut mine.0[part]))
    }

    fn write(&self, part: usize, edges: &mut Vec<[N; 2]>) -> Result<()> {
        let offset = self.file.append(bytemuck::cast_slice(edges))?;
        let mut blocks = self.blocks[part].lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        blocks.push((offset, edges.len() as u32));
        drop(blocks);
        edges.clear();
        Ok(())
    }

    /// Sorts part after part and counts what is odd; a part takes its own bytes of memory.
    pub(super) fn count(self, progress: &Progress) -> Result<Odd> {
        let mut odd = Odd::default();
        let mut edges: Vec<[N; 2]> = Vec::new();
        for blocks in self.blocks {
            progress.check()?;
            let blocks = blocks.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
            edges.clear();
            edges.resize(blocks.iter().map(|(_, n)| *n as usize).sum(), [N::zeroed(); 2]);
            let mut rest = edges.as_mut_slice();
            for (offset, n) in blocks {
                let (block, after) = rest.split_at_mut(n as usize);
                self.file.read_exact_at(bytemuck::cast_slice_mut(block), offset)?;
                rest = after;
            }
            edges.par_sort_unstable_by_key(|&[a, b]| (a.min(b), a.max(b)));
            for same in edges.chunk_by(|e, f| (e[0].min(e[1]), e[0].max(e[1])) == (f[0].min(f[1]), f[0].max(f[1]))) {
                match same {
                    [_] => odd.border += 1,
                    [e, f] if e[0] == f[1] => {}
                    _ => odd.nonmanifold += 1,
                }
            }
        }
        Ok(odd)
    }
}
