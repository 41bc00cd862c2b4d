//! The threshold of the next sweep, from some of its tiles.

use super::line::Done;
use super::search::Search;
use super::{Between, MOST_AT_CUTS, Mill, NEAR_END, SPARE, SPARE_AT_END, Threshold, waiting};
use crate::error::Result;
use crate::mesh::Coordinate;
use crate::tiles::{Lie, Place, Tile};

/// The share of a sweep's tiles that it is tried on, one in so many, and the fewest, where there are as many. What they
/// leave of their faces is what all leave of theirs to 1 %.
const ONE_IN: usize = 12;
const LEAST_TILES: usize = 12;
/// How near to what is wanted a trial is to come.
const NEAR_ENOUGH: f64 = 0.02;
/// Trials at most.
const TURNS: u32 = 5;

/// What was found.
pub(super) struct Found {
    /// The threshold of the sweep.
    pub threshold: Threshold,
    /// How many times as much as is asked for the threshold of the sweep before would leave: how dense that has left
    /// what is at this one's cuts, for what is asked for.
    pub before: f64,
    /// Whether the sweep may be the last one. Else it evens what is at the cuts, and leaves more.
    pub is_last: bool,
    /// How many times as much as is asked for the sweep is to leave.
    aim: f64,
    search: Search,
}

impl Found {
    /// The sweep has left so many times as much as is asked for: too much, or too little. Another threshold, then.
    pub fn correct(&mut self, times: f64) {
        self.search.tried(self.threshold.strength(), times / self.aim);
        self.threshold = self.threshold.of_strength(self.search.next());
    }

    /// What was learnt for the next trial.
    pub fn learnt(&self) -> &Search {
        &self.search
    }
}

impl<S: Coordinate> Mill<'_, S> {
    /// Finds the next threshold, for what a sweep to `last` has left: one that leaves [`SPARE_AT_END`] times what is asked
    /// for, or [`SPARE`] times where what is at the cuts would stand out.
    pub(super) fn trial(&self, between: &mut Between<S>, lie: Lie, last: Threshold, learnt: &Search) -> Result<Found> {
        let (faces, tiles) = (between.faces, between.mesh.tiles(lie));
        let every = (tiles.places.len() / LEAST_TILES).clamp(1, ONE_IN);
        let some = waiting(tiles.places.iter().skip(every / 2).step_by(every));
        let before: u64 = some.iter().map(|tile| tile.faces).sum();
        let asked = self.asked as f64 * before as f64 / faces.max(1) as f64;
        let load = |place: &&Place| {
            self.run.progress.check()?;
            tiles.load(place)
        };
        let leaves = |threshold: Threshold| -> Result<f64> {
            let mut left = 0;
            let collapse = |tile: Tile<S>| {
                let held = (tile.locked, Vec::new());
                Ok((self.part(tile.mesh, held, faces, threshold, false)?, Vec::new()))
            };
            self.line().run(&some, load, collapse, |sampled| {
                left += sampled.faces();
                Ok(())
            })?;
            Ok(left as f64 / asked)
        };
        let mut threshold = last.among(faces, self.asked);
        let before = leaves(threshold)?;
        let mut is_last = threshold.is_flat() || before <= MOST_AT_CUTS;
        let aim = if is_last { SPARE_AT_END } else { SPARE };
        let (mut search, mut left) = (learnt.anew(), before);
        for _ in 1..TURNS {
            search.tried(threshold.strength(), left / aim);
            if (left / aim - 1.0).abs() < NEAR_ENOUGH {
                break;
            }
            threshold = threshold.of_strength(search.next());
            left = leaves(threshold)?;
        }
        is_last &= threshold.is_flat() || left <= NEAR_END;
        Ok(Found { threshold, before, is_last, aim, search })
    }
}
