//! Progress as it is shown: a bar with the time left on a terminal, a line every 30 seconds without one.
//!
//! Shown from a thread of its own that only reads counters, so it cannot hold up the work or change its result.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use meshmill::progress::{Progress, Stage};

const BAR_PERIOD: Duration = Duration::from_millis(100);
const LINE_PERIOD: Duration = Duration::from_secs(30);
/// How closely a stage's beginning is known without a bar.
const WATCH_PERIOD: Duration = Duration::from_millis(500);

/// Does `work` while showing its progress on stderr.
pub fn showing<T>(progress: &Progress, work: impl FnOnce() -> T) -> T {
    std::thread::scope(|scope| {
        let (working, done) = std::sync::mpsc::channel::<()>();
        scope.spawn(move || match std::io::stderr().is_terminal() {
            true => show_bar(progress, &done),
            false => show_lines(progress, &done),
        });
        let result = work();
        drop(working);
        result
    })
}

/// Waits; true once the work is done.
fn done_within(period: Duration, done: &Receiver<()>) -> bool {
    !matches!(done.recv_timeout(period), Err(RecvTimeoutError::Timeout))
}

fn show_bar(progress: &Progress, done: &Receiver<()>) {
    let bar = ProgressBar::hidden();
    if let Ok(style) = ProgressStyle::with_template("{prefix:8} [{wide_bar}] {percent:>3} %, {eta} left") {
        bar.set_style(style.progress_chars("=> "));
    }
    let mut shown = None;
    while !done_within(BAR_PERIOD, done) {
        let (stage, steps, total) = progress.now();
        if shown.is_none() {
            bar.set_draw_target(indicatif::ProgressDrawTarget::stderr());
        }
        if shown != Some((stage, total)) {
            shown = Some((stage, total));
            bar.set_prefix(stage.word());
            bar.set_length(total.max(1));
            bar.reset();
        }
        bar.set_position(steps.min(total));
    }
    bar.finish_and_clear();
}

fn show_lines(progress: &Progress, done: &Receiver<()>) {
    let begun = Instant::now();
    let (mut stage, mut stage_begun) = (progress.now().0, begun);
    let mut last_line = begun;
    while !done_within(WATCH_PERIOD, done) {
        let (stage_now, steps, total) = progress.now();
        if stage_now != stage {
            (stage, stage_begun) = (stage_now, Instant::now());
        }
        if last_line.elapsed() >= LINE_PERIOD {
            last_line = Instant::now();
            let line = line(stage, steps, total, stage_begun.elapsed(), begun.elapsed());
            // A closed stderr is no reason to stop.
            let _ = writeln!(std::io::stderr(), "{line}");
        }
    }
}

/// `cluster: 40 %, about 45 s left in this stage; 95 s so far`
fn line(stage: Stage, steps: u64, total: u64, in_stage: Duration, so_far: Duration) -> String {
    let word = stage.word();
    let so_far = so_far.as_secs();
    if steps == 0 || total == 0 {
        return format!("{word}: {so_far} s so far");
    }
    let share = steps.min(total) as f64 / total as f64;
    let left = in_stage.as_secs_f64() * (1.0 / share - 1.0);
    format!("{word}: {:.0} %, about {left:.0} s left in this stage; {so_far} s so far", (100.0 * share).floor())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_stage_share_and_time_left() {
        let seconds = Duration::from_secs;
        assert_eq!(
            line(Stage::Cluster, 40, 100, seconds(30), seconds(95)),
            "cluster: 40 %, about 45 s left in this stage; 95 s so far"
        );
        assert_eq!(
            line(Stage::Write, 101, 100, seconds(3), seconds(60)),
            "write: 100 %, about 0 s left in this stage; 60 s so far"
        );
        assert_eq!(line(Stage::Read, 0, 100, seconds(30), seconds(30)), "read: 30 s so far");
        assert_eq!(line(Stage::Read, 5, 0, seconds(30), seconds(30)), "read: 30 s so far");
    }

    #[test]
    fn showing_ends_with_the_work() {
        let begun = Instant::now();
        assert_eq!(showing(&Progress::default(), || 7), 7);
        assert!(begun.elapsed() < WATCH_PERIOD);
    }
}
