//! Applying a batch: merge, renumber, compact. Orders are kept, so that numbers stay monotone and locality stays.

use super::Followed;
use super::batch::{Batch, NONE};
use super::shade::Numbers;
use super::surface::{KEPT, Surface, TOUCHED};
use crate::cores::InPieces;
use crate::mesh::{Coordinate, widen};
use crate::quadric::PackedQuadric;
use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU8, AtomicU32, Ordering::Relaxed};

/// Which vertices faces use, a byte each: faces that stay as they are, and those that change.
type Seen = [Vec<AtomicU8>; 2];

/// Groups whose merged quadrics are held at a time, 56 bytes each.
const BLOCK: usize = 1 << 16;

/// Vertices that are seen to together.
const PART: usize = 1 << 14;

/// Performs the collapses of `batch`, whose leaders are given. Returns the largest squared error among the merged vertices.
pub(super) fn commit<S: Coordinate>(
    surface: &mut Surface<S>,
    batch: &mut Batch<S>,
    leaders: &[u32],
    followed: &mut Followed<S>,
) -> f64 {
    surface.forget_roots();
    let error_sq = merge(surface, batch, leaders);
    let seen = rename(surface, batch);
    compact(surface, batch.spare(), &seen);
    surface.pieces.count(&surface.faces);
    let numbers = &batch.next;
    for homes in followed.lists() {
        homes.par_iter_mut().in_pieces(4096).filter(|home| **home != NONE).for_each(|home| {
            *home = numbers[batch.becomes(*home) as usize].load(Relaxed);
        });
    }
    error_sq
}

fn merge<S: Coordinate>(surface: &mut Surface<S>, batch: &Batch<S>, leaders: &[u32]) -> f64 {
    let mut error_sq = 0.0f64;
    for block in leaders.chunks(BLOCK) {
        let this = &*surface;
        let mut merged: Vec<Merged> = bytemuck::zeroed_vec(block.len());
        merged.par_chunks_mut(TOGETHER).zip(block.par_chunks(TOGETHER)).in_pieces(1).for_each(|(merged, leaders)| {
            dispatch!(Level::new(), simd => merge_some(simd, this, batch, leaders, merged));
        });
        put(&mut surface.learnt, block, |quadric, i| *quadric = merged[i].quadric);
        put(&mut surface.marks, block, |mark, i| *mark.get_mut() = merged[i].marks as u8);
        error_sq = merged.iter().map(|merged| merged.error_sq).fold(error_sq, f64::max);
    }
    if surface.is_shaded() {
        let this = &*surface;
        let shades: Vec<Vec<(u32, Numbers)>> = leaders
            .par_iter()
            .in_pieces(256)
            .map_init(Vec::new, |members, &v| {
                batch.members(v, members);
                this.merged_shades(&this.stars, members, widen(batch.spots[v as usize]))
            })
            .collect();
        shades.into_iter().flatten().for_each(|(i, numbers)| surface.take_shade(i, &numbers));
    }
    if surface.is_seamed() {
        // Wedges belong to one vertex each, and a vertex to one pair.
        let mut members = Vec::new();
        for &v in leaders {
            batch.members(v, &mut members);
            for (of_a, of_b) in surface.wedge_pairs(&surface.stars, v, members[1]) {
                surface.wedges.unite(of_a, of_b);
            }
        }
        surface.wedges.settle();
    }
    put(&mut surface.positions, leaders, |position, i| *position = batch.spots[leaders[i] as usize]);
    error_sq
}

/// Groups that are merged by one task.
const TOGETHER: usize = 256;

/// What a group becomes.
#[derive(Clone, Copy, bytemuck::Zeroable)]
struct Merged {
    quadric: PackedQuadric,
    marks: u32,
    error_sq: f64,
}

#[inline(always)]
fn merge_some<S: Coordinate, V: Simd>(
    _: V,
    surface: &Surface<S>,
    batch: &Batch<S>,
    leaders: &[u32],
    merged: &mut [Merged],
) {
    let mut members = Vec::new();
    for (&v, merged) in leaders.iter().zip(merged) {
        batch.members(v, &mut members);
        let q = surface.merged(&members, widen(batch.spots[v as usize]));
        let marks = members.iter().fold(0, |marks, &u| marks | surface.mark(u)) & KEPT;
        let error_sq = if q.w > 0.0 { q.c / q.w } else { 0.0 };
        *merged = Merged { quadric: q.pack(), marks: marks.into(), error_sq };
    }
}

/// Changes the items of some of the leaders, which are in order; `change` hears which of them it is.
fn put<T: Send>(items: &mut [T], leaders: &[u32], change: impl Fn(&mut T, usize) + Sync) {
    items.par_chunks_mut(PART).enumerate().for_each(|(part, items)| {
        let first = (part * PART) as u32;
        let begin = leaders.partition_point(|&v| v < first);
        for (i, &v) in leaders.iter().enumerate().skip(begin) {
            let Some(item) = items.get_mut((v - first) as usize) else { break };
            change(item, i);
        }
    });
}

/// Faces that are renamed by one task.
const RENAMED: usize = 1 << 12;

/// What the vertices of those that go are written to instead, far enough apart that no two threads write to one line.
const NOBODIES: usize = 64;
const LINE: usize = 64;

/// Gives faces their new vertices and marks those that are no more, by [`NONE`]. Which these are is as good as random, so that
/// is done without a branch, and a byte is only ever written. Returns which vertices faces still use.
fn rename<S: Coordinate>(surface: &mut Surface<S>, batch: &Batch<S>) -> Seen {
    let vertices = surface.positions.len();
    let seen: Seen = [(); 2].map(|()| bytemuck::zeroed_vec(vertices + LINE * NOBODIES));
    surface.faces.par_chunks_mut(RENAMED).enumerate().in_pieces(1).for_each(|(chunk, faces)| {
        let nobody = vertices + chunk % NOBODIES * LINE;
        for face in faces {
            let leaders = face.map(|v| batch.leader(v));
            let mut now = *face;
            for (now, leader) in now.iter_mut().zip(leaders) {
                *now = if leader == NONE { *now } else { leader };
            }
            // Leaders move, too.
            let changes = (leaders[0] != NONE) | (leaders[1] != NONE) | (leaders[2] != NONE);
            let lives = (now[0] != now[1]) & (now[1] != now[2]) & (now[2] != now[0]);
            let seen = &seen[usize::from(changes)];
            for v in now {
                seen[if lives { v as usize } else { nobody }].store(1, Relaxed);
            }
            now[0] = if lives { now[0] } else { NONE };
            *face = now;
        }
    });
    seen
}

/// Drops faces that are no more and vertices that no face uses.
fn compact<S: Coordinate>(surface: &mut Surface<S>, numbers: &mut [AtomicU32], [same, changed]: &Seen) {
    let Surface { faces, costs, positions, learnt, current, shades, wedges, marks, pieces, .. } = surface;
    // How many are kept of each part first, so that threads can number parts.
    let is_used = |v: usize| u32::from(same[v].load(Relaxed) | changed[v].load(Relaxed));
    let kept = |part: &[AtomicU32], first: usize| (first..first + part.len()).map(is_used).sum::<u32>();
    let parts = numbers.par_chunks(PART).enumerate();
    let mut firsts: Vec<u32> = parts.map(|(part, numbers)| kept(numbers, part * PART)).collect();
    let mut next = 0;
    for first in &mut firsts {
        next += std::mem::replace(first, next);
    }
    numbers.par_chunks_mut(PART).enumerate().zip(firsts).for_each(|((part, numbers), mut next)| {
        for (v, number) in (part * PART..).zip(numbers) {
            let used = is_used(v);
            *number.get_mut() = if used != 0 { next } else { NONE };
            next += used;
        }
    });
    let numbers = &*numbers;
    let lives = |f: usize| faces[f][0] != NONE;
    keep(costs, |f, _| lives(f));
    keep(&mut wedges.corners, |f, _| lives(f));
    // Those of wedges stay where they are.
    if wedges.is_empty() {
        shades.keep(numbers.len(), |i| Some(numbers[i].load(Relaxed)).filter(|new| *new != NONE));
    }
    let stays = |v: usize| numbers[v].load(Relaxed) != NONE;
    // What a part moves up is moved by one thread, so that two arrays go side by side.
    let others = || {
        keep(current, |v, _| stays(v));
        keep(positions, |v, _| stays(v));
        keep(&mut pieces.of, |v, _| stays(v));
    };
    rayon::join(|| keep(learnt, |v, _| stays(v)), others);
    let kept: Vec<AtomicU8> = bytemuck::zeroed_vec(next as usize);
    marks.par_iter().zip(numbers).zip(changed).in_pieces(4096).for_each(|((mark, number), changed)| {
        if let Some(place) = kept.get(number.load(Relaxed) as usize) {
            let touched = if changed.load(Relaxed) == 0 { 0 } else { TOUCHED };
            place.store(mark.load(Relaxed) & KEPT | touched, Relaxed);
        }
    });
    *marks = kept;
    keep(faces, |_, face| face[0] != NONE);
    faces.par_iter_mut().in_pieces(4096).for_each(|face| *face = face.map(|v| numbers[v as usize].load(Relaxed)));
}

/// Keeps the items that stay, in their order: threads move those of each part to its beginning, then parts move up. Which
/// stay no processor can predict, so all are moved, and those that go are written over.
fn keep<T: Copy + Send>(items: &mut Vec<T>, stays: impl Fn(usize, &T) -> bool + Sync) {
    let gather = |(part, items): (usize, &mut [T])| {
        let mut kept = 0;
        for i in 0..items.len() {
            let stay = stays(part * PART + i, &items[i]);
            items[kept] = items[i];
            kept += usize::from(stay);
        }
        kept
    };
    let gathered: Vec<usize> = items.par_chunks_mut(PART).enumerate().map(gather).collect();
    let mut end = 0;
    for (part, kept) in gathered.into_iter().enumerate() {
        items.copy_within(part * PART..part * PART + kept, end);
        end += kept;
    }
    items.truncate(end);
}
