//! Applying a batch: merge, renumber, compact. Orders are kept, so that numbers stay monotone and locality stays.

use super::Followed;
use super::batch::{Batch, NONE};
use super::shade::Numbers;
use super::surface::{KEPT, Surface, TOUCHED};
use crate::cores::InPieces;
use crate::mesh::{Coordinate, widen};
use crate::quadric::PackedQuadric;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU8, AtomicU32, Ordering::Relaxed};

/// A face still uses the vertex.
const USED: u8 = 4;

/// Groups whose merged quadrics are held at a time, 64 bytes each.
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
    surface.marks.par_iter().in_pieces(4096).for_each(|m| {
        m.fetch_and(KEPT, Relaxed);
    });
    surface.forget_roots();
    let error_sq = merge(surface, batch, leaders);
    rename(surface, batch);
    compact(surface, batch.spare());
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
        let merged: Vec<(PackedQuadric, u8, f64)> = block
            .par_iter()
            .in_pieces(256)
            .map_init(Vec::new, |members, &v| {
                batch.members(v, members);
                let q = this.merged(members, widen(batch.spots[v as usize]));
                let marks = members.iter().fold(0, |marks, &u| marks | this.mark(u)) & KEPT;
                (q.pack(), marks, if q.w > 0.0 { q.c / q.w } else { 0.0 })
            })
            .collect();
        put(&mut surface.learnt, block, |quadric, i| *quadric = merged[i].0);
        put(&mut surface.marks, block, |mark, i| *mark.get_mut() = merged[i].1);
        error_sq = merged.iter().map(|merged| merged.2).fold(error_sq, f64::max);
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

/// Gives faces their new vertices and marks those that are no more, by [`NONE`].
fn rename<S: Coordinate>(surface: &mut Surface<S>, batch: &Batch<S>) {
    let marks = &surface.marks;
    let mark = |v: u32, bits: u8| {
        let m = &marks[v as usize];
        if m.load(Relaxed) & bits != bits {
            m.fetch_or(bits, Relaxed);
        }
    };
    surface.faces.par_iter_mut().in_pieces(4096).for_each(|face| {
        let now = face.map(|v| batch.becomes(v));
        // Leaders move, too.
        let changed = batch.moves(face[0]) | batch.moves(face[1]) | batch.moves(face[2]);
        if now[0] != now[1] && now[1] != now[2] && now[2] != now[0] {
            let bits = if changed { USED | TOUCHED } else { USED };
            now.iter().for_each(|&v| mark(v, bits));
            *face = now;
        } else {
            face[0] = NONE;
        }
    });
}

/// Drops faces that are no more and vertices that no face uses.
fn compact<S: Coordinate>(surface: &mut Surface<S>, numbers: &mut [AtomicU32]) {
    let Surface { faces, costs, positions, learnt, current, shades, wedges, marks, pieces, .. } = surface;
    // How many are kept of each part first, so that threads can number parts.
    let kept = |marks: &[AtomicU8]| marks.iter().map(|mark| u32::from(mark.load(Relaxed) & USED != 0)).sum::<u32>();
    let mut firsts: Vec<u32> = marks.par_chunks(PART).map(kept).collect();
    let mut next = 0;
    for first in &mut firsts {
        next += std::mem::replace(first, next);
    }
    numbers.par_chunks_mut(PART).zip(marks.par_chunks_mut(PART)).zip(firsts).for_each(
        |((numbers, marks), mut next)| {
            for (number, mark) in numbers.iter_mut().zip(marks) {
                let used = *mark.get_mut() & USED != 0;
                *number.get_mut() = if used { next } else { NONE };
                next += u32::from(used);
            }
        },
    );
    let numbers = &*numbers;
    let lives = |f: usize| faces[f][0] != NONE;
    keep(costs, |f, _| lives(f));
    keep(&mut wedges.corners, |f, _| lives(f));
    // Those of wedges stay where they are.
    if wedges.is_empty() {
        shades.keep(numbers.len(), |i| Some(numbers[i].load(Relaxed)).filter(|new| *new != NONE));
    }
    let stays = |v: usize| numbers[v].load(Relaxed) != NONE;
    keep(learnt, |v, _| stays(v));
    keep(current, |v, _| stays(v));
    keep(positions, |v, _| stays(v));
    keep(&mut pieces.of, |v, _| stays(v));
    let kept: Vec<AtomicU8> = bytemuck::zeroed_vec(next as usize);
    marks.par_iter().zip(numbers).in_pieces(4096).for_each(|(mark, number)| {
        if let Some(place) = kept.get(number.load(Relaxed) as usize) {
            place.store(mark.load(Relaxed), Relaxed);
        }
    });
    *marks = kept;
    faces.par_iter_mut().in_pieces(4096).filter(|face| face[0] != NONE).for_each(|face| {
        *face = face.map(|v| numbers[v as usize].load(Relaxed));
    });
    keep(faces, |_, face| face[0] != NONE);
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
