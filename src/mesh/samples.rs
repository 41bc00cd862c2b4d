//! Points of a scan's surface, on scratch while the scan is reduced, in memory when the result is fitted to them.
//!
//! They are spread evenly over the surface's area, so that each stands for as much of it as any other. A scan may have
//! more surface than was thought before it was read; thinning by [`SurfaceSample::level`], a hash of what the sample
//! is, then leaves the same ones whatever the order in which they came.

use super::{Coordinate, groups};
use crate::error::Result;
use crate::scratch::ScratchFile;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Levels that samples are told apart by.
pub const LEVELS: usize = 32;

/// Records of a block, which are read at a time: 256 KiB, which stay near.
const AT_ONCE: u64 = 1 << 14;

/// The vertex of a sample that is nowhere near one.
const NONE: u32 = u32::MAX;

/// A point of the surface. 16 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
pub struct SurfaceSample {
    /// The cell that it is near to, later the vertex.
    pub near: u32,
    /// The normal's direction, folded onto an octahedron.
    normal: [i16; 2],
    /// Three times 21 bits of place on the lattice, the lower and the upper half.
    at: [u32; 2],
}

/// Bytes of a sample.
pub const SAMPLE_BYTES: usize = size_of::<SurfaceSample>();

impl SurfaceSample {
    /// On a face with unit normal `normal`; `None` where `position` is outside the lattice.
    pub fn new(lattice: &Lattice, position: DVec3, normal: Vec3, near: u32) -> Option<Self> {
        let [place] = lattice.places(&lattice.steps_to(position).to_array().map(|x| [x]));
        Self::placed(place, fold(normal), near)
    }

    /// The same at one of [`Lattice::places`], with a normal that was folded.
    #[inline(always)]
    pub fn placed(place: u64, normal: [i16; 2], near: u32) -> Option<Self> {
        let at = [place as u32, (place >> 32) as u32];
        (place != OUTSIDE).then_some(SurfaceSample { near, at, normal })
    }

    /// How many halvings of the samples' number it outlasts.
    #[inline]
    pub fn level(&self) -> u32 {
        let mut hash = self.place().wrapping_mul(0x9e37_79b9_7f4a_7c15);
        hash = (hash ^ hash >> 29).wrapping_mul(0xd6e8_feb8_6659_fd93);
        (hash ^ hash >> 32).trailing_zeros().min(LEVELS as u32 - 1)
    }

    fn place(&self) -> u64 {
        u64::from(self.at[1]) << 32 | u64::from(self.at[0])
    }

    /// All that it is, its place first, what it is near to last: one number, which is compared without a branch.
    #[inline]
    fn key(&self) -> u128 {
        u128::from_le(bytemuck::cast(*self))
    }

    /// The direction of its face's normal, between 0.57 and 1 long.
    #[inline]
    pub fn direction(&self) -> Vec3 {
        unfold(self.normal)
    }
}

/// Bits of a place on the lattice, an axis.
const BITS: u32 = 21;
/// The place of what is outside the lattice.
const OUTSIDE: u64 = u64::MAX;

/// Where samples can lie: 2²¹ steps along the longest side. Where a thousand faces follow one another, that is an error
/// of 1/5,000 of a face, and it has no bias.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lattice {
    origin: DVec3,
    step: f64,
    per_step: f64,
}

impl Lattice {
    /// Over a box in the frame.
    pub fn over(min: DVec3, max: DVec3) -> Self {
        let longest = (max - min).max_element().max(f64::MIN_POSITIVE);
        let step = longest * (1.0 + 1e-6) / f64::from(1 << BITS);
        Lattice { origin: min, step, per_step: 1.0 / step }
    }

    /// A position in steps.
    pub fn steps_to(&self, p: DVec3) -> DVec3 {
        (p - self.origin) * self.per_step
    }

    /// A length in steps.
    pub fn steps_of(&self, length: f64) -> f64 {
        length * self.per_step
    }

    /// The places of some points in the lattice's steps, by axis; all bits are set of those that have none. As wide as the
    /// vectors of the function that this becomes a part of.
    #[inline(always)]
    pub fn places<const N: usize>(&self, [x, y, z]: &[[f64; N]; 3]) -> [u64; N] {
        let mut places = [0; N];
        for i in 0..N {
            let p = [x[i], y[i], z[i]];
            let inside = p.iter().fold(true, |inside, x| inside & (*x >= 0.0) & (*x < f64::from(1 << BITS)));
            let place = p.iter().fold(0, |place, x| place << BITS | u64::from(*x as i32 as u32));
            places[i] = if inside { place } else { OUTSIDE };
        }
        places
    }

    /// A sample's position in the frame.
    #[inline]
    pub fn position<S: Coordinate>(&self, sample: &SurfaceSample) -> [S; 3] {
        let place = sample.place();
        let steps = [place >> (2 * BITS), place >> BITS, place].map(|x| (x & ((1 << BITS) - 1)) as f64 + 0.5);
        let p = self.origin + DVec3::from(steps) * self.step;
        p.to_array().map(S::narrow)
    }
}

/// Samples on scratch.
#[derive(Debug)]
pub struct SampleFile {
    /// The records, in whatever order they came.
    pub file: ScratchFile,
    /// How many there are.
    pub written: u64,
    /// How many samples of each level were made. Those of the highest levels are all in the file.
    pub levels: [u64; LEVELS],
    /// Where they lie.
    pub lattice: Lattice,
    /// The area that one stands for where none are left out.
    pub area: f64,
}

/// The level from which on there are at most `most` samples.
pub fn level_for(levels: &[u64; LEVELS], most: u64) -> u32 {
    let mut kept = 0u64;
    for (level, count) in levels.iter().enumerate().rev() {
        kept += count;
        if kept > most {
            return level as u32 + 1;
        }
    }
    0
}

/// Samples in memory, in an order that follows from what they are.
#[derive(Debug)]
pub struct SurfaceSamples {
    /// In order of the vertex that they are near to.
    pub samples: Vec<SurfaceSample>,
    /// Where they lie.
    pub lattice: Lattice,
    /// The area that each stands for.
    pub area: f64,
}

impl SurfaceSamples {
    /// Puts samples in order; those that are near no vertex are left out.
    pub fn sorted(mut samples: Vec<SurfaceSample>, lattice: Lattice, area: f64) -> Self {
        samples.retain(|sample| sample.near != NONE);
        samples.par_sort_unstable_by_key(|sample| (sample.near, sample.key()));
        SurfaceSamples { samples, lattice, area }
    }
}

impl SampleFile {
    /// Reads at most `most` of them back. `vertices` has a vertex for each cell; samples near none are left out.
    pub fn load(&self, most: usize, vertices: &[u32]) -> Result<SurfaceSamples> {
        let level = level_for(&self.levels, most as u64);
        let count = vertices.iter().filter(|v| **v != NONE).max().map_or(0, |v| *v as usize + 1);
        let threads = groups::ranges();
        // Where the samples of a vertex begin: counted first, a part of the file a thread, so that each is read straight to
        // where it belongs. And between which vertices those of a block are.
        let part = self.written.div_ceil(AT_ONCE).div_ceil(threads as u64) * AT_ONCE;
        let counted = |i: usize| {
            let begin = i as u64 * part;
            let blocks = (begin..self.written.min(begin + part)).step_by(AT_ONCE as usize);
            let (mut counts, mut spans) = (vec![0u32; count], Vec::new());
            self.read(blocks, level, vertices, |samples| {
                let mut span = (NONE, 0);
                for sample in samples {
                    counts[sample.near as usize] += 1;
                    span = (span.0.min(sample.near), span.1.max(sample.near));
                }
                spans.push(span);
            })?;
            Ok((counts, spans))
        };
        let parts: Vec<_> = (0..threads).into_par_iter().with_max_len(1).map(counted).collect::<Result<_>>()?;
        let (parts, spans): (Vec<_>, Vec<_>) = parts.into_iter().unzip();
        let spans = spans.concat();
        let mut first = Vec::with_capacity(count + 1);
        let mut all = 0;
        first.push(0);
        first.extend((0..count).map(|v| {
            all += parts.iter().map(|counts| counts[v]).sum::<u32>();
            all
        }));
        drop(parts);
        // Then each thread goes through all of it for the samples of its vertices: in a scan in sensible order, that is its
        // share of the blocks.
        let mut samples: Vec<SurfaceSample> = bytemuck::zeroed_vec(all as usize);
        let mut rest = samples.as_mut_slice();
        let mut tasks = Vec::with_capacity(threads);
        let mut begin = 0;
        for task in 1..=threads {
            let share = (u64::from(all) * task as u64 / threads as u64) as u32;
            let end = if task < threads { first.partition_point(|first| *first < share).max(begin) } else { count };
            let first = &first[begin..=end];
            let (own, later) = rest.split_at_mut((first[first.len() - 1] - first[0]) as usize);
            tasks.push((begin as u32..end as u32, first, own));
            (rest, begin) = (later, end);
        }
        tasks.into_par_iter().with_max_len(1).try_for_each(|(of, first, own)| {
            let mut next = first[..first.len() - 1].to_vec();
            let mut spans = spans.iter();
            let has_own = |_: &u64| spans.next().is_some_and(|(least, most)| *least < of.end && of.start <= *most);
            let blocks = (0..self.written).step_by(AT_ONCE as usize).filter(has_own);
            self.read(blocks, level, vertices, |samples| {
                for sample in samples {
                    if let Some(next) = next.get_mut(sample.near.wrapping_sub(of.start) as usize) {
                        own[(*next - first[0]) as usize] = sample;
                        *next += 1;
                    }
                }
            })
        })?;
        sort_groups(&mut samples, &first);
        Ok(SurfaceSamples { samples, lattice: self.lattice, area: self.area * f64::from(level).exp2() })
    }

    /// Reads the blocks that begin there: those of their samples that are near a vertex and of `level` or above.
    fn read(
        &self,
        blocks: impl Iterator<Item = u64>,
        level: u32,
        vertices: &[u32],
        mut take: impl FnMut(Block),
    ) -> Result<()> {
        let mut records: Vec<SurfaceSample> = bytemuck::zeroed_vec(AT_ONCE as usize);
        for first in blocks {
            let records = &mut records[..(self.written - first).min(AT_ONCE) as usize];
            self.file.read_exact_at(bytemuck::cast_slice_mut(records), first * SAMPLE_BYTES as u64)?;
            take(Block { records: records.iter(), level, vertices });
        }
        Ok(())
    }
}

/// Samples of a block that are near a vertex and of `level` or above, each with its vertex.
struct Block<'a> {
    records: std::slice::Iter<'a, SurfaceSample>,
    level: u32,
    vertices: &'a [u32],
}

impl Iterator for Block<'_> {
    type Item = SurfaceSample;

    #[inline(always)]
    fn next(&mut self) -> Option<SurfaceSample> {
        self.records.by_ref().find_map(|sample| {
            let near = self.vertices.get(sample.near as usize).copied().unwrap_or(NONE);
            let counts = near != NONE && (self.level == 0 || sample.level() >= self.level);
            counts.then_some(SurfaceSample { near, ..*sample })
        })
    }
}

/// Groups that are sorted by one task.
const GROUPS: usize = 1024;

/// Sorts samples within groups, of which each begins at one of `first` and ends at the next.
fn sort_groups(samples: &mut [SurfaceSample], first: &[u32]) {
    let mut rest = samples;
    let mut tasks = Vec::new();
    for groups in first[..first.len() - 1].chunks(GROUPS).zip(first[1..].chunks(GROUPS)) {
        let (Some(begin), Some(end)) = (groups.0.first(), groups.1.last()) else { continue };
        let (task, left) = rest.split_at_mut((end - begin) as usize);
        tasks.push((task, *begin, groups.1));
        rest = left;
    }
    tasks.into_par_iter().with_max_len(1).for_each(|(mut rest, mut begin, ends)| {
        for end in ends {
            let (group, left) = rest.split_at_mut((end - begin) as usize);
            group.sort_unstable_by_key(SurfaceSample::key);
            (rest, begin) = (left, *end);
        }
    });
}

/// A direction as a point of the square that an octahedron unfolds to.
#[inline(always)]
pub fn fold(n: Vec3) -> [i16; 2] {
    let n = n / (n.x.abs() + n.y.abs() + n.z.abs()).max(f32::MIN_POSITIVE);
    let (x, y) =
        if n.z >= 0.0 { (n.x, n.y) } else { ((1.0 - n.y.abs()).copysign(n.x), (1.0 - n.x.abs()).copysign(n.y)) };
    // Rounded by cutting off, which is one instruction everywhere.
    [x, y].map(|t| (t * 32767.0 + 0.5f32.copysign(t)) as i16)
}

/// The direction that [`fold`] made a point of, not normalised.
#[inline]
fn unfold(folded: [i16; 2]) -> Vec3 {
    let [x, y] = folded.map(|t| f32::from(t) / 32767.0);
    let z = 1.0 - x.abs() - y.abs();
    let under = (-z).max(0.0);
    Vec3::new(x - under.copysign(x), y - under.copysign(y), z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scratch::Scratch;

    fn lattice() -> Lattice {
        Lattice::over(DVec3::new(-1.0, 0.0, 5.0), DVec3::new(0.0, 0.5, 5.25))
    }

    fn sample(k: u32) -> SurfaceSample {
        let t = f64::from(k) / 1000.0;
        let at = DVec3::new(-t, 0.5 * t * t, 5.0 + 0.25 * t.sin());
        SurfaceSample::new(&lattice(), at, Vec3::new(0.6, 0.0, -0.8), k % 7).unwrap()
    }

    #[test]
    fn a_sample_keeps_its_place_and_its_normal() {
        for n in [Vec3::X, Vec3::NEG_Z, Vec3::new(-0.48, 0.6, 0.64), Vec3::new(0.36, -0.48, -0.8), Vec3::NEG_Y] {
            let p = DVec3::new(-0.123, 0.456, 5.2);
            let sample = SurfaceSample::new(&lattice(), p, n, 3).unwrap();
            let at = DVec3::from(lattice().position::<f64>(&sample));
            assert!(
                (at - p).length() < 5e-7 && sample.direction().normalize().distance(n) < 1e-4,
                "{n}: {at}, {}",
                sample.direction()
            );
        }
        for outside in [[-1.1, 0.0, 5.0], [0.1, 0.0, 5.0], [f64::NAN, 0.0, 5.0]] {
            assert!(SurfaceSample::new(&lattice(), outside.into(), Vec3::X, 0).is_none(), "{outside:?}");
        }
    }

    #[test]
    fn loading_thins_by_what_samples_are_and_sorts() {
        let folder = tempfile::tempdir().unwrap();
        let file = Scratch::in_folder(folder.path()).file().unwrap();
        let made: Vec<SurfaceSample> = (0..1000).rev().map(sample).collect();
        let mut levels = [0; LEVELS];
        made.iter().for_each(|s| levels[s.level() as usize] += 1);
        file.write_all_at(bytemuck::cast_slice(&made), 0).unwrap();
        let kept = SampleFile { file, written: 1000, levels, lattice: lattice(), area: 2.0 };
        let homes = [9, 8, NONE, 6, 5, 4, 3];
        let all = kept.load(1000, &homes).unwrap();
        assert_eq!((all.samples.len(), all.area), (1000 - 143, 2.0));
        assert!(all.samples.is_sorted_by_key(|s| (s.near, s.key())) && all.samples.iter().all(|s| s.near != NONE));
        let some = kept.load(600, &homes).unwrap();
        assert!(some.area == 4.0 && (400..560).contains(&some.samples.len()), "{}", some.samples.len());
        assert!(some.samples.iter().all(|s| all.samples.contains(s) && s.level() >= 1));
        assert_eq!(kept.load(0, &homes).unwrap().samples.len(), 0);
    }

    #[test]
    fn loading_many_blocks_is_sorting() {
        let folder = tempfile::tempdir().unwrap();
        // Each vertex in blocks of its own or two, and every one in all of them.
        for near in [|k: u32| k / 9000, |k: u32| k % 7] {
            let made: Vec<SurfaceSample> =
                (0..60_000).map(|k| SurfaceSample { near: near(k), ..sample(k * 7 % 1000) }).collect();
            let file = Scratch::in_folder(folder.path()).file().unwrap();
            file.write_all_at(bytemuck::cast_slice(&made), 0).unwrap();
            let kept = SampleFile { file, written: 60_000, levels: [0; LEVELS], lattice: lattice(), area: 2.0 };
            let loaded = kept.load(60_000, &[6, 5, 4, 3, 2, 1, 0]).unwrap();
            let placed = made.iter().map(|sample| SurfaceSample { near: 6 - sample.near, ..*sample }).collect();
            assert!(loaded.samples == SurfaceSamples::sorted(placed, lattice(), 2.0).samples);
        }
    }
}
