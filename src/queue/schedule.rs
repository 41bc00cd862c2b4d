//! Which scan is next, and how long all will take.

use super::plan::{Plan, Task};
use crate::job::Order;
use std::time::Instant;

/// Tasks that wait.
#[derive(Debug, Default)]
pub(super) struct Waiting {
    /// Numbers of tasks, the next ones first.
    tasks: Vec<Try>,
}

/// A task that waits for its next try.
#[derive(Debug, Clone, Copy)]
pub(super) struct Try {
    /// Its number in the plan.
    pub(super) task: usize,
    /// Tries that it has had.
    pub(super) tries: u32,
    /// Not before then.
    pub(super) after: Option<Instant>,
    /// With so much memory, if not with its own budget.
    pub(super) less: Option<u64>,
}

impl Waiting {
    /// These tasks of a plan, in its order.
    pub(super) fn new(plan: &Plan, tasks: impl Iterator<Item = usize>) -> Waiting {
        let mut tasks: Vec<Try> = tasks.map(|task| Try { task, tries: 0, after: None, less: None }).collect();
        match plan.order {
            Order::BigFirst => tasks.sort_by_key(|t| std::cmp::Reverse(plan.tasks[t.task].bytes)),
            Order::SmallFirst => tasks.sort_by_key(|t| plan.tasks[t.task].bytes),
            Order::Name => {}
        }
        Waiting { tasks }
    }

    /// Takes the next one that may begin and that `fits`. While a big scan runs, small ones go first beside it: two big ones
    /// share the same cores, and leave none idle only where no small one is left.
    pub(super) fn next(&mut self, plan: &Plan, big_runs: bool, fits: impl Fn(&Task, &Try) -> bool) -> Option<Try> {
        let now = Instant::now();
        let ready = |t: &Try| t.after.is_none_or(|after| after <= now) && fits(&plan.tasks[t.task], t);
        let small = |t: &Try| plan.tasks[t.task].is_small();
        let beside = self.tasks.iter().position(|t| big_runs && small(t) && ready(t));
        let at = beside.or_else(|| self.tasks.iter().position(ready))?;
        Some(self.tasks.remove(at))
    }

    /// Waits again.
    pub(super) fn put_back(&mut self, again: Try) {
        self.tasks.push(again);
    }

    /// Tasks that wait.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Try> {
        self.tasks.iter()
    }
}

/// How far a run is.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Standing {
    /// Scans that are finished, in this run or before it.
    pub finished: usize,
    /// Of those, scans that failed or were not reduced as asked.
    pub failed: usize,
    /// Scans in all.
    pub scans: usize,
    /// Seconds since this run began.
    pub seconds: f64,
    /// Seconds until all is done, as far as can be told.
    pub seconds_left: Option<f64>,
    /// What is resident of all processes.
    pub rss_bytes: u64,
    /// Scans that are under way: name, stage, share of the stage, seconds so far, seconds left.
    pub running: Vec<Running>,
}

/// A scan under way.
#[derive(Debug, Clone, PartialEq)]
pub struct Running {
    /// Its path.
    pub scan: String,
    /// The stage's word.
    pub stage: String,
    /// How far the stage is, 0 to 1.
    pub share: f64,
    /// Seconds so far.
    pub seconds: f64,
    /// Seconds left, as far as can be told.
    pub seconds_left: Option<f64>,
}

/// What scans took, against what was expected of them.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Pace {
    expected: f64,
    took: f64,
}

impl Pace {
    /// One more is done.
    pub(super) fn add(&mut self, expected: f64, took: f64) {
        self.expected += expected;
        self.took += took;
    }

    /// Seconds that something will take of which so many are expected. One scan says little of others: what was expected
    /// counts for a minute.
    pub(super) fn correct(&self, expected: f64) -> f64 {
        expected * (self.took + 60.0) / (self.expected + 60.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pace_follows_what_scans_take() {
        let mut pace = Pace::default();
        assert_eq!(pace.correct(10.0), 10.0);
        pace.add(600.0, 1200.0);
        assert!((pace.correct(10.0) - 10.0 * 1260.0 / 660.0).abs() < 1e-9);
    }
}
