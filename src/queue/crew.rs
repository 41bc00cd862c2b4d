//! The workers of a run: processes, what they are told, and what is heard of them.

use super::ledger::Fingerprint;
use super::process::{rss_bytes, signal_name, this_program};
use super::report::{OutputFile, Trouble};
use crate::error::{Error, Result};
use crate::job::JobFile;
use crate::pipeline::PortraitAsked;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex};

/// What a worker is told.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum ToWorker {
    /// To reduce a scan.
    Reduce(Box<Order>),
    /// To stop what it does.
    Stop,
}

/// A scan to reduce.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Order {
    pub(super) scan: PathBuf,
    pub(super) job: JobFile,
    pub(super) outputs: Vec<PathBuf>,
    pub(super) portrait: Option<PortraitAsked>,
}

/// What is heard of a worker.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum FromWorker {
    /// How far it is.
    Progress { stage: String, steps: u64, total: u64 },
    /// It is done with a scan.
    Finished {
        report: Option<Value>,
        error: Option<Trouble>,
        input: Option<Fingerprint>,
        outputs: Vec<OutputFile>,
        peak: Option<u64>,
    },
}

/// Something happened to a worker.
#[derive(Debug)]
pub(super) enum Event {
    /// It spoke.
    Heard(u64, Box<FromWorker>),
    /// Its pipe ended.
    Gone(u64),
}

/// Bytes of a worker's last words that are kept.
const LAST_WORDS: usize = 2000;

/// A worker that waits while more than so much is resident has kept too much of what it did.
const BLOATED_BYTES: u64 = 40 << 20;

/// A process that reduces scans.
#[derive(Debug)]
pub(super) struct Worker {
    pub(super) number: u64,
    child: Child,
    stdin: Option<ChildStdin>,
    last_words: Arc<Mutex<VecDeque<u8>>>,
}

impl Worker {
    /// Starts one, of this same program, that speaks to `events`.
    pub(super) fn start(number: u64, folder: &Path, shard: &str, events: Sender<Event>) -> Result<Worker> {
        let program = this_program()?;
        let mut command = Command::new(&program);
        command.arg("worker").arg(folder).arg(format!("--shard-name={shard}"));
        // A process group of its own: Ctrl-C is for the run, which tells its workers.
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).process_group(0);
        let mut child = command.spawn().map_err(Error::io(&program, "cannot be started"))?;
        let stdin = child.stdin.take();
        let last_words = Arc::new(Mutex::new(VecDeque::new()));
        if let Some(stdout) = child.stdout.take() {
            std::thread::spawn(move || {
                for line in BufReader::new(stdout).lines().map_while(|line| line.ok()) {
                    let Ok(message) = serde_json::from_str(&line) else { continue };
                    if events.send(Event::Heard(number, Box::new(message))).is_err() {
                        return;
                    }
                }
                // If nobody hears it, the run is over.
                let _ = events.send(Event::Gone(number));
            });
        }
        if let Some(stderr) = child.stderr.take() {
            let words = Arc::clone(&last_words);
            std::thread::spawn(move || keep_last(stderr, &words));
        }
        Ok(Worker { number, child, stdin, last_words })
    }

    /// Tells it something. If it cannot hear any more, that is noticed by its pipe.
    pub(super) fn tell(&mut self, message: &ToWorker) {
        // Orders are of words and numbers.
        let text = serde_json::to_string(message).unwrap_or_default();
        if let Some(stdin) = &mut self.stdin {
            let _ = writeln!(stdin, "{text}").and_then(|()| stdin.flush());
        }
    }

    /// Ends it where it stands.
    pub(super) fn kill(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
    }

    /// What is resident of it.
    pub(super) fn rss_bytes(&self) -> u64 {
        rss_bytes(self.child.id()).unwrap_or(0)
    }

    /// Whether it holds more than a new one would.
    pub(super) fn is_bloated(&self) -> bool {
        self.rss_bytes() > BLOATED_BYTES
    }

    /// Waits for its end: how that came, and its last words.
    pub(super) fn end(mut self) -> (Option<ExitStatus>, String) {
        drop(self.stdin.take());
        let status = self.child.wait().ok();
        let words = self.last_words.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let (front, back) = words.as_slices();
        let text = String::from_utf8_lossy(&[front, back].concat()).trim().to_string();
        (status, text)
    }
}

fn keep_last(mut stderr: impl Read, words: &Mutex<VecDeque<u8>>) {
    let mut bytes = [0; 512];
    while let Ok(n) = stderr.read(&mut bytes) {
        if n == 0 {
            return;
        }
        let mut words = words.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        words.extend(&bytes[..n]);
        let over = words.len().saturating_sub(LAST_WORDS);
        words.drain(..over);
    }
}

/// What a worker died of that nobody had told to.
pub(super) fn cause_of_death(status: Option<ExitStatus>, last_words: &str, starved: bool) -> Trouble {
    let Some(status) = status else { return Trouble::new("crash", "its process was lost", false) };
    match status.signal() {
        Some(7) => {
            let what = "its process was ended by SIGBUS: the scan was cut short while it was read, or the disk under it failed";
            Trouble::new("io", what, true)
        }
        Some(9) if starved => {
            let what = "its process was killed by the kernel, which was out of memory: something else took more than it should, \
                        or the machine (or its memory cgroup) has less than [night] memory";
            Trouble::new("memory", what, false)
        }
        Some(signal) => {
            let what = format!("its process was ended by {}", signal_name(signal));
            Trouble::new("crash", with_words(what, last_words), signal == 9 || signal == 15)
        }
        None => {
            let what = format!("its process ended with exit code {}", status.code().unwrap_or(-1));
            Trouble::new("crash", with_words(what, last_words), false)
        }
    }
}

fn with_words(what: String, last_words: &str) -> String {
    if last_words.is_empty() { what } else { format!("{what}: {last_words}") }
}
