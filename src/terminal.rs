//! Progress as it is shown: a bar with the time left on a terminal, a line every 30 seconds without one.
//!
//! Shown from a thread of its own that only reads counters, so it cannot hold up the work or change its result.

use indicatif::{ProgressBar, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::{Duration, Instant};

use meshmill::progress::{Progress, Stage};
use meshmill::queue::{Plan, Row, Running, Standing, Status};

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

/// A night as it is shown: on a terminal a line for the night and one for each scan under way; without one a line of JSON
/// for each scan that is finished and every 30 seconds.
pub struct NightScreen<'a> {
    plan: &'a Plan,
    /// On a terminal.
    bars: Option<ProgressBar>,
    last_line: Instant,
    shown: Instant,
}

impl<'a> NightScreen<'a> {
    /// Nothing is shown yet.
    pub fn new(plan: &'a Plan) -> Self {
        let bars = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(None, indicatif::ProgressDrawTarget::stderr());
            if let Ok(style) = ProgressStyle::with_template("{msg}") {
                bar.set_style(style);
            }
            bar
        });
        NightScreen { plan, bars, last_line: Instant::now(), shown: Instant::now() }
    }

    /// A scan is finished, or is tried again.
    pub fn finished(&mut self, row: &Row, again: bool) {
        let name = self.plan.name(&row.scan).display();
        let why = row.error.as_ref().map_or("", |error| error.message.as_str());
        if let Some(bars) = &self.bars {
            match (again, row.status) {
                (true, _) => bars.println(format!("again    {name}: {why}")),
                (false, Status::Done) => bars.println(format!("done     {name}, {:.1} s", row.seconds)),
                (false, status) => bars.println(format!("{:8} {name}: {why}", status.word())),
            }
            return;
        }
        let event = if again { "again" } else { "finished" };
        let error = row.error.as_ref().map(|error| serde_json::json!({ "code": error.code, "message": error.message }));
        log(&serde_json::json!({
            "event": event, "scan": row.scan, "status": row.status, "seconds": row.seconds, "tries": row.tries,
            "peak_rss_bytes": row.peak_rss_bytes, "error": error,
        }));
    }

    /// How far the night is.
    pub fn standing(&mut self, standing: &Standing) {
        if let Some(bars) = &self.bars {
            if self.shown.elapsed() >= BAR_PERIOD {
                self.shown = Instant::now();
                bars.set_message(lines(standing).join("\n"));
                bars.tick();
            }
        } else if self.last_line.elapsed() >= LINE_PERIOD {
            self.last_line = Instant::now();
            let running = |scan: &Running| {
                serde_json::json!({
                    "scan": scan.scan, "stage": scan.stage, "share": scan.share, "seconds": scan.seconds,
                    "seconds_left": scan.seconds_left,
                })
            };
            log(&serde_json::json!({
                "event": "progress", "finished": standing.finished, "failed": standing.failed, "scans": standing.scans,
                "seconds": standing.seconds, "seconds_left": standing.seconds_left, "rss_bytes": standing.rss_bytes,
                "running": standing.running.iter().map(running).collect::<Vec<_>>(),
            }));
        }
    }

    /// Nothing more is shown.
    pub fn clear(&self) {
        if let Some(bars) = &self.bars {
            bars.finish_and_clear();
        }
    }
}

/// One line for the night, one for each scan.
fn lines(standing: &Standing) -> Vec<String> {
    let left = |seconds: Option<f64>| seconds.map_or(String::new(), |s| format!(", about {} left", clock(s)));
    let failed = if standing.failed > 0 { format!(", {} of them failed", standing.failed) } else { String::new() };
    let Standing { finished, scans, seconds, seconds_left, .. } = standing;
    let night = format!("night    {finished} of {scans}{failed}; {} so far{}", clock(*seconds), left(*seconds_left));
    let scan = |scan: &Running| {
        let share = (100.0 * scan.share).floor();
        let so_far = clock(scan.seconds);
        format!("{:8} {} {share:.0} %; {so_far} so far{}", scan.stage, scan.scan, left(scan.seconds_left))
    };
    std::iter::once(night).chain(standing.running.iter().map(scan)).collect()
}

/// `1:02:03`, `2:03`.
fn clock(seconds: f64) -> String {
    let whole = seconds.max(0.0) as u64;
    let (hours, minutes, seconds) = (whole / 3600, whole / 60 % 60, whole % 60);
    if hours > 0 { format!("{hours}:{minutes:02}:{seconds:02}") } else { format!("{minutes}:{seconds:02}") }
}

/// A closed stderr is no reason to stop.
fn log(line: &serde_json::Value) {
    let _ = writeln!(std::io::stderr(), "{line}");
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
    fn a_night_is_a_line_and_a_line_for_each_scan() {
        let running = Running {
            scan: "a/b.ply".into(),
            stage: "collapse".into(),
            share: 0.418,
            seconds: 61.0,
            seconds_left: Some(30.0),
        };
        let mut standing = Standing {
            finished: 7,
            failed: 0,
            scans: 40,
            seconds: 3723.0,
            seconds_left: Some(600.0),
            rss_bytes: 0,
            running: vec![running],
        };
        assert_eq!(
            lines(&standing),
            [
                "night    7 of 40; 1:02:03 so far, about 10:00 left",
                "collapse a/b.ply 41 %; 1:01 so far, about 0:30 left"
            ]
        );
        (standing.failed, standing.seconds_left) = (2, None);
        assert_eq!(lines(&standing)[0], "night    7 of 40, 2 of them failed; 1:02:03 so far");
    }

    #[test]
    fn showing_ends_with_the_work() {
        let begun = Instant::now();
        assert_eq!(showing(&Progress::default(), || 7), 7);
        assert!(begun.elapsed() < WATCH_PERIOD);
    }
}
