//! The threshold of the next sweep, from some of its tiles.

use super::search::Search;
use super::{Between, Mill, SPARE_AT_END, Threshold};
use crate::error::Result;
use crate::mesh::Coordinate;
use crate::tiles::{Lie, Place};

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
    /// How many times as much as is asked for it leaves, about.
    pub leaves: f64,
    /// And how many times as much the threshold of the sweep before would leave: how dense that has left what is at this
    /// one's cuts, for what is asked for.
    pub before: f64,
    pub search: Search,
}

impl<S: Coordinate> Mill<'_, S> {
    /// Finds a threshold that leaves [`SPARE_AT_END`] times what is asked for of what another one has left.
    pub(super) fn trial(&self, between: &Between<S>, lie: Lie, last: Threshold, learnt: &Search) -> Result<Found> {
        let tiles: Vec<(u64, Place)> = between.mesh.tiles(lie).into_iter().collect();
        let every = (tiles.len() / LEAST_TILES).clamp(1, ONE_IN);
        let some: Vec<_> = tiles.into_iter().skip(every / 2).step_by(every).collect();
        let before: u64 = some.iter().map(|(_, place)| place.faces()).sum();
        let asked = self.asked as f64 * before as f64 / between.faces.max(1) as f64;
        let leaves = |threshold: Threshold| -> Result<f64> {
            let mut left = 0;
            for (tile, place) in &some {
                self.run.progress.check()?;
                let loaded = between.mesh.load(lie, *tile, place)?;
                let held = (loaded.locked, Vec::new());
                left += self.part(loaded.mesh, held, between.faces, threshold, false)?.mesh.faces.len();
            }
            Ok(left as f64 / asked)
        };
        let threshold = last.among(between.faces, self.asked);
        let mut found = Found { threshold, leaves: 0.0, before: 0.0, search: learnt.anew() };
        for turn in 0..TURNS {
            found.leaves = leaves(found.threshold)?;
            if turn == 0 {
                found.before = found.leaves;
            }
            let times = found.leaves / SPARE_AT_END;
            found.search.tried(found.threshold.strength(), times);
            if (times - 1.0).abs() < NEAR_ENOUGH || turn + 1 == TURNS {
                break;
            }
            found.threshold = found.threshold.of_strength(found.search.next());
        }
        Ok(found)
    }
}
