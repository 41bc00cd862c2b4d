//! A worker: a process that takes tasks from its stdin, one after another, and tells of them on its stdout, a line of JSON
//! each. It ends when its stdin does, so none outlives the run that started it for long.

use super::crew::{FromWorker, Order, ToWorker};
use super::ledger::{Fingerprint, Lock};
use super::process::{peak_bytes, reset_peak};
use super::report::{OutputFile, Trouble};
use crate::error::{Error, Result};
use crate::pipeline::reduce_and_portray;
use crate::progress::Progress;
use serde_json::Value;
use std::io::{BufRead, ErrorKind, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

/// What a worker that is to stop is told, as a signal's number: SIGTERM.
const STOP: usize = 15;

/// How long a worker that is to stop may take before it is ended where it stands.
const PATIENCE: Duration = Duration::from_secs(10);

/// How often progress is told.
const PERIOD: Duration = Duration::from_millis(250);

/// Works for the run in this folder until stdin ends. `shard` tells runs side by side apart.
pub fn work(folder: &Path, shard: &str) -> Result<()> {
    let _alive = Lock::of_worker(folder, shard)?;
    let stop = Arc::new(AtomicUsize::new(0));
    let orders = listen(Arc::clone(&stop));
    for order in orders {
        let done = AtomicBool::new(false);
        let progress = Progress::cancelled_by(Arc::clone(&stop));
        let outcome = std::thread::scope(|scope| {
            let teller = scope.spawn(|| {
                while !done.load(Relaxed) {
                    let (stage, steps, total) = progress.now();
                    tell(&FromWorker::Progress { stage: stage.word().into(), steps, total });
                    std::thread::park_timeout(PERIOD);
                }
            });
            let outcome = reduce(&order, &progress);
            done.store(true, Relaxed);
            teller.thread().unpark();
            outcome
        });
        tell(&outcome);
    }
    Ok(())
}

/// A thread that hears orders; when nobody speaks any more, the work that is under way is to stop.
fn listen(stop: Arc<AtomicUsize>) -> Receiver<Order> {
    let (sender, orders) = channel();
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines() {
            match line.ok().and_then(|line| serde_json::from_str(&line).ok()) {
                Some(ToWorker::Reduce(order)) => {
                    if sender.send(*order).is_err() {
                        return;
                    }
                }
                Some(ToWorker::Stop) => stop.store(STOP, Relaxed),
                None => break,
            }
        }
        drop(sender);
        stop.store(STOP, Relaxed);
        std::thread::sleep(PATIENCE);
        std::process::exit(1);
    });
    orders
}

fn tell(message: &FromWorker) {
    // Messages are of words and numbers. If nobody listens any more, stdin has ended, too.
    let text = serde_json::to_string(message).unwrap_or_default();
    let mut stdout = std::io::stdout().lock();
    let _ = writeln!(stdout, "{text}").and_then(|()| stdout.flush());
}

fn reduce(order: &Order, progress: &Progress) -> FromWorker {
    reset_peak();
    let before = Fingerprint::glance(&order.scan).ok();
    let mut input = before.clone();
    let mut outputs = Vec::new();
    let outcome = attempt(order, progress, &mut input, &mut outputs);
    let (report, error) = match outcome {
        Ok(report) => {
            let unmet = report["error"]["message"].as_str().map(|message| Trouble::new("unmet", message, false));
            (Some(report), unmet)
        }
        Err(error) => (None, Some(trouble(&error))),
    };
    FromWorker::Finished { report, error, input, outputs, peak: peak_bytes() }
}

fn attempt(
    order: &Order,
    progress: &Progress,
    input: &mut Option<Fingerprint>,
    outputs: &mut Vec<OutputFile>,
) -> Result<Value> {
    let folders =
        order.outputs.iter().map(|output| output.as_path()).chain(order.portrait.iter().map(|p| p.output.as_path()));
    for folder in folders.filter_map(Path::parent) {
        std::fs::create_dir_all(folder).map_err(Error::io(folder, "cannot make this folder"))?;
    }
    let job = order.job.clone().resolve_to(order.outputs.clone())?;
    let report = reduce_and_portray(&job, order.portrait.as_ref(), progress)?;
    let read = Fingerprint::thorough(&order.scan).map_err(Error::io(&order.scan, "cannot read"))?;
    let glance = |print: &Fingerprint| (print.bytes, print.modified);
    if input.as_ref().map(glance) != Some(glance(&read)) {
        return Err(Error::Io {
            file: order.scan.clone(),
            action: "the result cannot be trusted",
            source: std::io::Error::other("another program changed the scan while it was read"),
        });
    }
    *input = Some(read);
    for path in &order.outputs {
        let print = Fingerprint::thorough(path).map_err(Error::io(path, "cannot read what was written"))?;
        outputs.push(OutputFile { path: path.clone(), print: Some(print) });
    }
    // What is reported always becomes JSON.
    Ok(serde_json::to_value(&report).unwrap_or_default())
}

fn trouble(error: &Error) -> Trouble {
    let may_pass = match error {
        Error::Io { source, .. } => !matches!(
            source.kind(),
            ErrorKind::NotFound
                | ErrorKind::PermissionDenied
                | ErrorKind::ReadOnlyFilesystem
                | ErrorKind::NotADirectory
                | ErrorKind::IsADirectory
                | ErrorKind::QuotaExceeded
        ),
        _ => false,
    };
    Trouble::new(error.code(), error.to_string(), may_pass)
}
