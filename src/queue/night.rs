//! A run of a plan: scans are given to workers, watched, tried again where that makes sense, and written down.

use super::clock::{self, Deadline};
use super::crew::{Event, FromWorker, Order, ToWorker, Worker, cause_of_death};
use super::ledger::{Fingerprint, Ledger, Lock, Record, shard_name};
use super::plan::{PICTURES, Plan, Problem, Task};
use super::process::{out_of_memory_kills, rss_bytes};
use super::report::{NightReport, Row, Status, Trouble};
use super::schedule::{self, Pace, Standing, Try, Waiting};
use crate::budget::Size;
use crate::error::{Error, Result};
use crate::job::Threads;
use crate::pipeline::PortraitAsked;
use crate::write::sweep;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

/// How often processes are looked at.
const TICK: Duration = Duration::from_millis(100);

/// How long a worker that was told to stop may take: what it leaves when it is ended then, is swept.
const PATIENCE: Duration = Duration::from_secs(1);

/// What a scan may take beyond its budget before it is ended: less is the measure's own coarseness.
const GRACE: f64 = 1.02;

/// Waits before another try: the first, and by how much each further one is longer.
const BACK_OFF: Duration = Duration::from_secs(1);
const BACK_OFF_FACTOR: u32 = 5;

/// How sure it must be that a scan is done by the end of the night.
const MARGIN: f64 = 1.25;

/// Pictures of all scans together take about so much, so that the report keeps to 20 MB with 1,000 scans; base64 adds a
/// third.
const PICTURES_BYTES: usize = 13 << 20;
const PICTURE_BYTES: std::ops::RangeInclusive<usize> = 4_000..=90_000;

/// Points of the curve of memory, at most.
const POINTS: usize = 800;

/// Who is told how a night goes.
pub trait Watcher {
    /// A scan is finished, or another try is made.
    fn finished(&mut self, row: &Row, again: bool);
    /// How far it is; several times a second.
    fn standing(&mut self, standing: &Standing);
    /// The signal that asks the run to end, if one has come.
    fn signal(&self) -> Option<i32>;
}

/// A run under way.
pub struct Night<'a> {
    plan: &'a Plan,
    ledger: Ledger,
    _lock: Lock,
    waiting: Waiting,
    crew: Vec<Post>,
    events: Receiver<Event>,
    speak: Sender<Event>,
    hired: u64,
    began: Instant,
    deadline: Option<Deadline>,
    pace: Pace,
    resident: Curve,
    finished: usize,
    failed: usize,
    scans: usize,
    ending: Option<String>,
}

/// A worker and what it does.
struct Post {
    worker: Worker,
    task: Option<Doing>,
}

/// A scan that is being reduced.
struct Doing {
    this: Try,
    budget: u64,
    began: Instant,
    began_at: f64,
    oom_kills: u64,
    /// Its results and its picture as they were before it began, where they were.
    before: Vec<(PathBuf, Option<Fingerprint>)>,
    stage: (String, u64, u64),
    stage_began: Instant,
    /// Why it is to end, and since when it knows.
    ending: Option<(Trouble, Instant)>,
    result: Option<Box<FromWorker>>,
}

impl<'a> Night<'a> {
    /// Takes the folder, and finds what is left to do.
    ///
    /// Scans that a problem is known of are written down as refused, and not begun.
    pub fn begin(plan: &'a Plan, problems: &[Problem]) -> Result<Night<'a>> {
        std::fs::create_dir_all(&plan.folder).map_err(Error::io(&plan.folder, "cannot make this folder"))?;
        let lock = Lock::take(&plan.folder, plan.options.shard)?;
        sweep_all(plan);
        let mut ledger = Ledger::open(plan)?;
        let refused: BTreeMap<&Path, &str> =
            problems.iter().filter_map(|problem| Some((problem.scan.as_deref()?, problem.what.as_str()))).collect();
        let (mut left, mut finished, mut failed) = (Vec::new(), 0, 0);
        for (i, task) in plan.tasks.iter().enumerate() {
            if let Some(only) = &plan.options.only {
                left.extend(task.is_named(only).then_some(i));
            } else if let Some(what) = refused.get(task.scan.as_path()) {
                let mut row = Row::of(plan, task);
                row.status = Status::Failed;
                row.error = Some(Trouble::new("refused", *what, false));
                ledger.write(Record::Finished(Box::new(row)))?;
                (finished, failed) = (finished + 1, failed + 1);
            } else if ledger.has_finished(task) {
                finished += 1;
                failed += usize::from(ledger.row(task).is_some_and(|row| row.status != Status::Done));
            } else {
                left.push(i);
            }
        }
        let scans = finished + left.len();
        let version = env!("CARGO_PKG_VERSION").to_string();
        ledger.write(Record::Began { at: clock::now(), version, memory: plan.memory.0 })?;
        let (speak, events) = channel();
        Ok(Night {
            waiting: Waiting::new(plan, left.into_iter()),
            finished,
            failed,
            scans,
            plan,
            ledger,
            _lock: lock,
            crew: Vec::new(),
            events,
            speak,
            hired: 0,
            began: Instant::now(),
            deadline: plan.stop_at.map(Deadline::next),
            pace: Pace::default(),
            resident: Curve::default(),
            ending: None,
        })
    }

    /// Scans that were finished before this run.
    pub fn finished(&self) -> usize {
        self.finished
    }

    /// Goes on until all is done, the night is over, or a signal comes; the report, and that signal.
    pub fn run(mut self, watcher: &mut dyn Watcher) -> Result<(NightReport, Option<i32>)> {
        let mut signal = None;
        loop {
            if signal.is_none() {
                signal = watcher.signal();
                if let Some(number) = signal {
                    self.stop_all(number);
                }
            }
            while self.ending.is_none() && self.give_next()? {}
            if self.crew.iter().all(|post| post.task.is_none()) && (self.ending.is_some() || self.nothing_waits()) {
                break;
            }
            match self.events.recv_timeout(TICK) {
                Ok(event) => self.take(event, watcher)?,
                Err(RecvTimeoutError::Timeout) => self.watch(),
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if self.resident.is_due() {
                self.watch();
                watcher.standing(&self.standing());
            }
        }
        for post in self.crew.drain(..) {
            post.worker.end();
        }
        sweep_all(self.plan);
        let resident = self.resident.points();
        self.ledger.write(Record::Ended { at: clock::now(), memory: resident })?;
        Ok((NightReport::of(self.plan, &self.ledger, Vec::new(), self.ending), signal))
    }

    /// Nothing is left that could still begin.
    fn nothing_waits(&mut self) -> bool {
        if self.waiting.iter().next().is_none() {
            return true;
        }
        let over =
            self.deadline.is_some() && !self.waiting.iter().any(|t| self.fits_the_night(&self.plan.tasks[t.task]));
        if over {
            self.ending = self.plan.stop_at.map(|time| format!("stop_at = {time}"));
        }
        over
    }

    fn stop_all(&mut self, signal: i32) {
        self.ending = Some(format!("signal {signal}"));
        for post in &mut self.crew {
            if let Some(doing) = &mut post.task {
                doing.ending.get_or_insert((Trouble::new("interrupted", "the run was ended", false), Instant::now()));
                post.worker.tell(&ToWorker::Stop);
            }
        }
    }

    /// Whether a scan would be done before the night is over.
    fn fits_the_night(&self, task: &Task) -> bool {
        let seconds = MARGIN * self.pace.correct(self.plan.expected_seconds(task));
        self.deadline.as_ref().is_none_or(|deadline| seconds < deadline.seconds_left())
    }

    /// Gives a scan to a worker, if one is free and one may begin.
    fn give_next(&mut self) -> Result<bool> {
        let busy = self.crew.iter().filter(|post| post.task.is_some()).count();
        if busy >= self.plan.workers {
            return Ok(false);
        }
        let doing = self.crew.iter().filter_map(|post| post.task.as_ref());
        let big_runs = doing.clone().any(|doing| !self.plan.tasks[doing.this.task].is_small());
        let mut waiting = std::mem::take(&mut self.waiting);
        let next = waiting.next(self.plan, big_runs, |task, _| self.fits_the_night(task));
        self.waiting = waiting;
        let Some(this) = next else { return Ok(false) };
        let post = self.free_post()?;
        let task = &self.plan.tasks[this.task];
        let budget = this.less.unwrap_or(task.budget.0);
        let order = self.order(task, budget);
        let tries = this.tries + 1;
        let (scan, options, at) = (task.scan.clone(), task.options.clone(), clock::now());
        let made = task.outputs.iter().chain(order.portrait.iter().map(|portrait| &portrait.output));
        let before = made.map(|path| (path.clone(), Fingerprint::glance(path).ok())).collect();
        self.ledger.write(Record::Scan { at, scan, budget, options, tries })?;
        let now = Instant::now();
        let post = &mut self.crew[post];
        post.task = Some(Doing {
            this,
            budget,
            began: now,
            began_at: at,
            oom_kills: out_of_memory_kills(),
            before,
            stage: (String::from("read"), 0, 0),
            stage_began: now,
            ending: None,
            result: None,
        });
        post.worker.tell(&ToWorker::Reduce(Box::new(order)));
        Ok(true)
    }

    /// A worker that waits; a new one where there is none, or where it has grown fat.
    fn free_post(&mut self) -> Result<usize> {
        while let Some(at) = self.crew.iter().position(|post| post.task.is_none()) {
            if !self.crew[at].worker.is_bloated() {
                return Ok(at);
            }
            self.crew.remove(at).worker.end();
        }
        self.hired += 1;
        let shard = shard_name(self.plan.options.shard);
        let worker = Worker::start(self.hired, &self.plan.folder, &shard, self.speak.clone())?;
        self.crew.push(Post { worker, task: None });
        Ok(self.crew.len() - 1)
    }

    fn order(&self, task: &Task, budget: u64) -> Order {
        let mut job = task.job.clone();
        job.run.memory = Some(Size(budget));
        job.run.threads = Some(Threads(self.plan.threads_of(task)));
        let portrait = self.plan.pictures.then(|| self.portrait(task));
        Order { scan: task.scan.clone(), job, outputs: task.outputs.clone(), portrait }
    }

    fn portrait(&self, task: &Task) -> PortraitAsked {
        let scans = self.plan.tasks.len() * self.plan.options.shard.map_or(1, |shard| shard.of);
        let most_bytes = (PICTURES_BYTES / scans.max(1)).clamp(*PICTURE_BYTES.start(), *PICTURE_BYTES.end());
        let tile = match most_bytes {
            0..20_000 => 160,
            20_000..45_000 => 240,
            _ => 320,
        };
        PortraitAsked { output: self.plan.folder.join(picture_of(self.plan, task)), tile, most_bytes }
    }

    fn take(&mut self, event: Event, watcher: &mut dyn Watcher) -> Result<()> {
        match event {
            Event::Heard(number, message) => {
                let Some(at) = self.crew.iter().position(|post| post.worker.number == number) else { return Ok(()) };
                let Some(doing) = &mut self.crew[at].task else { return Ok(()) };
                match *message {
                    FromWorker::Progress { stage, steps, total } => {
                        if doing.stage.0 != stage {
                            doing.stage_began = Instant::now();
                        }
                        doing.stage = (stage, steps, total);
                    }
                    finished => {
                        doing.result = Some(Box::new(finished));
                        if let Some(doing) = self.crew[at].task.take() {
                            self.conclude(doing, None, watcher)?;
                        }
                    }
                }
            }
            Event::Gone(number) => {
                let Some(at) = self.crew.iter().position(|post| post.worker.number == number) else { return Ok(()) };
                let Post { worker, task } = self.crew.remove(at);
                let (status, last_words) = worker.end();
                if let Some(doing) = task {
                    let starved = out_of_memory_kills() > doing.oom_kills;
                    self.conclude(doing, Some(cause_of_death(status, &last_words, starved)), watcher)?;
                }
            }
        }
        Ok(())
    }

    /// A try is over: it is written down, or made again.
    fn conclude(&mut self, doing: Doing, death: Option<Trouble>, watcher: &mut dyn Watcher) -> Result<()> {
        let task = &self.plan.tasks[doing.this.task];
        let told = doing.ending.map(|(trouble, _)| trouble);
        let mut row = Row::of(self.plan, task);
        row.began = doing.began_at;
        row.seconds = doing.began.elapsed().as_secs_f64();
        row.tries = doing.this.tries + 1;
        row.budget = doing.budget;
        let mut error = death;
        if let Some(FromWorker::Finished { report, error: found, input, outputs, peak }) = doing.result.map(|r| *r) {
            row.report = report;
            row.input = input;
            row.peak_rss_bytes = peak;
            if !outputs.is_empty() {
                row.outputs = outputs;
            }
            error = found;
        }
        // What it was told to end for is why it ended.
        row.error = match (row.report.is_some(), told) {
            (false, Some(told)) => Some(told),
            _ => error,
        };
        row.status = match (&row.report, &row.error) {
            (Some(_), None) => Status::Done,
            (Some(_), Some(_)) => Status::Unmet,
            (None, _) => Status::Failed,
        };
        if row.report.is_none() && take_back(&doing.before) {
            row.warnings.push("what was already written of it was removed".into());
        }
        if row.error.as_ref().is_some_and(|error| error.code == "interrupted") {
            // It was not its fault: the next run begins it again.
            return Ok(());
        }
        if row.fact("/portrait").is_some() {
            row.picture = Some(picture_of(self.plan, task));
        }
        if let Some(less) = doing.this.less {
            let (less, budget) = (Size(less), task.budget);
            row.warnings.push(format!(
                "reduced within {less}, not {budget}: the system had not enough memory, and the result is another one for it"
            ));
        } else if row.tries > 1 && row.status == Status::Done {
            row.warnings.push(format!("done at try {}: what failed before has passed", row.tries));
        }
        if let Some(again) = self.another_try(&doing.this, &row) {
            watcher.finished(&row, true);
            self.waiting.put_back(again);
            return Ok(());
        }
        if row.status != Status::Failed {
            self.pace.add(self.plan.expected_seconds(task), row.seconds);
        }
        self.finished += 1;
        self.failed += usize::from(row.status != Status::Done);
        watcher.finished(&row, false);
        self.ledger.write(Record::Finished(Box::new(row)))
    }

    fn another_try(&self, this: &Try, row: &Row) -> Option<Try> {
        let error = row.error.as_ref().filter(|_| row.status == Status::Failed && self.ending.is_none())?;
        let tries = this.tries + 1;
        if error.code == "memory" && self.plan.retry_with_less && this.less.is_none() {
            return Some(Try { tries, after: None, less: Some(row.budget / 2), ..*this });
        }
        if !error.may_pass || tries > self.plan.retries {
            return None;
        }
        let wait = BACK_OFF * BACK_OFF_FACTOR.saturating_pow(this.tries.min(6));
        Some(Try { tries, after: Some(Instant::now() + wait), ..*this })
    }

    /// Looks at what is resident, and at the time: who takes too much of either is ended.
    fn watch(&mut self) {
        let own = rss_bytes(std::process::id()).unwrap_or(0);
        let sizes: Vec<u64> = self.crew.iter().map(|post| post.worker.rss_bytes()).collect();
        let total = own + sizes.iter().sum::<u64>();
        self.resident.add(clock::now(), total);
        let (limit, scan_seconds) = (self.plan.memory, self.plan.scan_seconds);
        let mut over = total > limit.0;
        for (post, &size) in self.crew.iter_mut().zip(&sizes) {
            let Some(doing) = &mut post.task else { continue };
            if let Some((_, since)) = &doing.ending {
                if since.elapsed() > PATIENCE {
                    post.worker.kill();
                }
                continue;
            }
            let budget = Size(doing.budget);
            if size as f64 > GRACE * doing.budget as f64 {
                let what = format!("more was resident, {}, than its budget of {budget}", Size(size));
                doing.ending = Some((Trouble::new("memory", what, false), Instant::now()));
                post.worker.kill();
                over = false;
            } else if scan_seconds.is_some_and(|most| doing.began.elapsed().as_secs_f64() > most) {
                let what =
                    format!("it took longer than the {} s that [night] scan_time allows", scan_seconds.unwrap_or(0.0));
                doing.ending = Some((Trouble::new("time", what, false), Instant::now()));
                post.worker.tell(&ToWorker::Stop);
            }
        }
        if over {
            self.end_the_largest(&sizes, limit);
        }
    }

    /// All within their budgets, and yet too much.
    fn end_the_largest(&mut self, sizes: &[u64], limit: Size) {
        let posts = self.crew.iter_mut().zip(sizes).filter(|(post, _)| post.task.is_some());
        let Some((post, size)) = posts.max_by_key(|(_, size)| **size) else { return };
        let what =
            format!("all processes together held more than the night's {limit}; of them it held most, {}", Size(*size));
        if let Some(doing) = &mut post.task {
            doing.ending.get_or_insert((Trouble::new("memory", what, true), Instant::now()));
        }
        post.worker.kill();
    }

    fn standing(&self) -> Standing {
        let mut left = 0.0;
        let running: Vec<_> = self
            .crew
            .iter()
            .filter_map(|post| post.task.as_ref())
            .map(|doing| {
                let task = &self.plan.tasks[doing.this.task];
                let seconds = doing.began.elapsed().as_secs_f64();
                let expected = self.pace.correct(self.plan.expected_seconds(task));
                let (stage, steps, total) = &doing.stage;
                left += (expected - seconds).max(0.0);
                schedule::Running {
                    scan: self.plan.name(&task.scan).display().to_string(),
                    stage: stage.clone(),
                    share: if *total > 0 { (*steps as f64 / *total as f64).min(1.0) } else { 0.0 },
                    seconds,
                    seconds_left: (expected > seconds).then_some(expected - seconds),
                }
            })
            .collect();
        let waiting: f64 = self.waiting.iter().map(|t| self.plan.expected_seconds(&self.plan.tasks[t.task])).sum();
        left += self.pace.correct(waiting);
        Standing {
            finished: self.finished,
            failed: self.failed,
            scans: self.scans,
            seconds: self.began.elapsed().as_secs_f64(),
            seconds_left: Some(left / self.plan.workers.max(1) as f64),
            rss_bytes: self.resident.last(),
            running,
        }
    }
}

/// Removes what a try has written that did not come to its end: a result beside a row that says that there is none would be
/// taken for one. What was there before, and is there still, stays. Whether there was anything.
fn take_back(before: &[(PathBuf, Option<Fingerprint>)]) -> bool {
    let is_new = |(path, was): &&(PathBuf, Option<Fingerprint>)| {
        let is = Fingerprint::glance(path).ok();
        is.is_some() && is != *was
    };
    // What cannot be removed is done again and replaced.
    before.iter().filter(is_new).filter(|(path, _)| std::fs::remove_file(path).is_ok()).count() > 0
}

/// A scan's picture, in the night's folder: named by its first result, which no other scan has.
fn picture_of(plan: &Plan, task: &Task) -> PathBuf {
    let result = task.outputs.first().map(|path| path.strip_prefix(&plan.folder).unwrap_or(path).to_string_lossy());
    let result = result.unwrap_or_default();
    Path::new(PICTURES).join(format!("{}.jpg", &blake3::hash(result.as_bytes()).to_hex()[..16]))
}

/// Removes what killed workers left in the folders that results go to.
fn sweep_all(plan: &Plan) {
    let outputs = plan.tasks.iter().flat_map(|task| &task.outputs);
    let folders: BTreeSet<&Path> = outputs.filter_map(|output| output.parent()).collect();
    folders.into_iter().for_each(sweep);
    sweep(&plan.folder);
    sweep(&plan.folder.join(PICTURES));
}

/// What was resident, by stretches of time that grow with the night.
#[derive(Debug)]
struct Curve {
    points: Vec<(f64, u64)>,
    /// Seconds a point.
    stretch: f64,
    seen: Option<Instant>,
    last: u64,
}

impl Default for Curve {
    fn default() -> Self {
        Curve { points: Vec::new(), stretch: 0.5, seen: None, last: 0 }
    }
}

impl Curve {
    fn is_due(&self) -> bool {
        self.seen.is_none_or(|seen| seen.elapsed() >= TICK)
    }

    fn add(&mut self, at: f64, bytes: u64) {
        (self.seen, self.last) = (Some(Instant::now()), bytes);
        match self.points.last_mut() {
            Some((begun, most)) if at < *begun + self.stretch => *most = bytes.max(*most),
            _ => self.points.push((at, bytes)),
        }
        if self.points.len() > POINTS {
            self.points =
                self.points.chunks(2).map(|two| (two[0].0, two.iter().map(|p| p.1).max().unwrap_or(0))).collect();
            self.stretch *= 2.0;
        }
    }

    fn last(&self) -> u64 {
        self.last
    }

    fn points(&self) -> Vec<(f64, u64)> {
        self.points.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_night_keeps_its_peaks_in_few_points() {
        let mut curve = Curve::default();
        for i in 0..20_000u64 {
            curve.add(i as f64 * 0.3, if i == 7777 { 1 << 40 } else { i });
        }
        assert!(curve.points.len() <= POINTS && curve.points.len() > POINTS / 4);
        assert_eq!(curve.points.iter().map(|p| p.1).max(), Some(1 << 40));
        assert!(curve.points.is_sorted_by(|a, b| a.0 < b.0));
    }
}
