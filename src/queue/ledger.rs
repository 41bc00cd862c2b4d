//! The night's memory: a line for every scan that is begun and for every one that is finished, checked and synced.
//!
//! A line is the first sixteen digits of the BLAKE3 hash of its JSON, a space, and the JSON. A line that is not what its
//! hash says (the last one of a machine that lost its power) is passed over. Several ledgers in a folder, of shards, are
//! read together; each is written by the one run that holds its lock.

use super::clock;
use super::plan::{Plan, Shard, Task};
use super::report::{Row, Status};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Seek, SeekFrom, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How long a run waits for the workers of one that was killed: they end when their pipe does.
const PATIENCE: Duration = Duration::from_secs(30);

/// What a line says.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub(super) enum Record {
    /// A run begins.
    Began {
        /// Seconds since 1970.
        at: f64,
        /// The program's.
        version: String,
        /// Bound on all processes.
        memory: u64,
    },
    /// A scan begins.
    Scan {
        /// Seconds since 1970.
        at: f64,
        /// The scan.
        scan: PathBuf,
        /// Its budget.
        budget: u64,
        /// Tells options apart.
        options: String,
        /// Which try this is.
        tries: u32,
    },
    /// A scan is finished, one way or the other.
    Finished(Box<Row>),
    /// A run ends: what was resident while it ran, seconds since 1970 and bytes of all processes.
    Ended {
        /// Seconds since 1970.
        at: f64,
        /// At the peaks of stretches of time.
        memory: Vec<(f64, u64)>,
    },
}

/// A file as it was.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fingerprint {
    /// Its size.
    pub bytes: u64,
    /// When it was last changed, nanoseconds since 1970.
    pub modified: i64,
    /// The BLAKE3 hash of its contents; `None` where nothing was made of it.
    pub blake3: Option<String>,
}

impl Fingerprint {
    /// By size and time alone.
    pub(super) fn glance(path: &Path) -> std::io::Result<Fingerprint> {
        let found = std::fs::metadata(path)?;
        let modified = found.mtime().saturating_mul(1_000_000_000).saturating_add(found.mtime_nsec());
        Ok(Fingerprint { bytes: found.len(), modified, blake3: None })
    }

    /// With the contents.
    pub(super) fn thorough(path: &Path) -> std::io::Result<Fingerprint> {
        Ok(Fingerprint { blake3: Some(hash_of(path)?), ..Self::glance(path)? })
    }

    /// Whether the file still is what it was: by size and time, or else by its contents.
    fn still(&self, path: &Path) -> bool {
        let Ok(now) = Self::glance(path) else { return false };
        let same_time = now.modified == self.modified;
        now.bytes == self.bytes && (same_time || self.blake3.is_some() && hash_of(path).ok() == self.blake3)
    }
}

fn hash_of(path: &Path) -> std::io::Result<String> {
    let mut file = File::open(path)?;
    let mut hash = blake3::Hasher::new();
    let mut bytes = vec![0; 1 << 18];
    loop {
        match file.read(&mut bytes)? {
            0 => return Ok(hash.finalize().to_hex().to_string()),
            n => hash.update(&bytes[..n]),
        };
    }
}

/// Locks that only one run at a time has: dropped, or the process ended anyhow, they are free.
#[derive(Debug)]
pub struct Lock {
    _files: Vec<File>,
}

impl Lock {
    /// Of a night's folder: a run as a whole, or of a shard. Waits for workers of a run that was killed.
    pub fn take(folder: &Path, shard: Option<Shard>) -> Result<Lock> {
        let whole = open_lock(&folder.join(".night.lock"))?;
        let mut files = Vec::new();
        match shard {
            None => take_now(&whole, folder, "")?,
            Some(Shard { number, of }) => {
                // Shards run side by side, but not beside a run of the whole.
                whole.try_lock_shared().or_else(|error| refused(error, folder, ""))?;
                let own = open_lock(&folder.join(format!(".night.{number}-of-{of}.lock")))?;
                take_now(&own, folder, &format!(" with --shard {number}/{of}"))?;
                files.push(own);
            }
        }
        files.push(whole);
        wait_for_workers(folder, shard)?;
        Ok(Lock { _files: files })
    }

    /// What a worker holds while it lives.
    pub(super) fn of_worker(folder: &Path, shard: &str) -> Result<Lock> {
        let file = open_lock(&workers_lock(folder, shard))?;
        // Where locks do not exist, nobody waits for one.
        let _ = file.lock_shared();
        Ok(Lock { _files: vec![file] })
    }
}

fn workers_lock(folder: &Path, shard: &str) -> PathBuf {
    folder.join(format!(".workers{shard}.lock"))
}

/// The part of a file's name that tells shards apart.
pub(super) fn shard_name(shard: Option<Shard>) -> String {
    shard.map_or(String::new(), |Shard { number, of }| format!(".{number}-of-{of}"))
}

fn open_lock(path: &Path) -> Result<File> {
    let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path);
    file.map_err(Error::io(path, "cannot open"))
}

fn take_now(file: &File, folder: &Path, which: &str) -> Result<()> {
    file.try_lock().or_else(|error| refused(error, folder, which))
}

fn refused(error: TryLockError, folder: &Path, which: &str) -> Result<()> {
    match error {
        TryLockError::WouldBlock => {
            let folder = folder.display();
            Err(Error::usage(format!("{folder}: another run{which} is at work here; wait for it, or end it")))
        }
        // A file system without locks: the user is alone with the promise to run it once.
        TryLockError::Error(_) => Ok(()),
    }
}

fn wait_for_workers(folder: &Path, shard: Option<Shard>) -> Result<()> {
    let file = open_lock(&workers_lock(folder, &shard_name(shard)))?;
    let begun = Instant::now();
    loop {
        match file.try_lock() {
            Err(TryLockError::WouldBlock) if begun.elapsed() < PATIENCE => {
                std::thread::sleep(Duration::from_millis(20));
            }
            Err(TryLockError::WouldBlock) => {
                let what = "workers of a run that was killed are still at work here; end them";
                return Err(Error::usage(format!("{}: {what}", folder.display())));
            }
            _ => return Ok(()),
        }
    }
}

/// What is known of scans that were finished, and the file to which more is added.
#[derive(Debug)]
pub struct Ledger {
    path: PathBuf,
    file: File,
    /// By their first result.
    rows: BTreeMap<PathBuf, Row>,
    /// First results of scans that were finished in this run.
    fresh: BTreeSet<PathBuf>,
    memory: Vec<(f64, u64)>,
    began: f64,
}

impl Ledger {
    /// Reads the ledgers of a plan's folder and opens its own. Its [`Lock`] must be held.
    pub fn open(plan: &Plan) -> Result<Ledger> {
        let path = plan.folder.join(format!("ledger{}.jsonl", shard_name(plan.options.shard)));
        let mut file = OpenOptions::new()
            .read(true)
            .append(true)
            .create(true)
            .open(&path)
            .map_err(Error::io(&path, "cannot open the ledger"))?;
        // What was cut off must not run into what follows.
        let torn = file.seek(SeekFrom::End(-1)).is_ok() && {
            let mut last = [0];
            file.read_exact(&mut last).is_ok() && last != *b"\n"
        };
        let mut ledger = Ledger {
            path,
            file,
            rows: BTreeMap::new(),
            fresh: BTreeSet::new(),
            memory: Vec::new(),
            began: clock::now(),
        };
        ledger.read_all(&plan.folder)?;
        if torn {
            ledger.file.write_all(b"\n").map_err(Error::io(&ledger.path, "cannot write the ledger"))?;
        }
        Ok(ledger)
    }

    fn read_all(&mut self, folder: &Path) -> Result<()> {
        let entries = std::fs::read_dir(folder).map_err(Error::io(folder, "cannot read this folder"))?;
        for entry in entries.flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            if !(name.starts_with("ledger") && name.ends_with(".jsonl")) {
                continue;
            }
            let path = entry.path();
            let bytes = std::fs::read(&path).map_err(Error::io(&path, "cannot read the ledger"))?;
            for record in bytes.split(|byte| *byte == b'\n').filter_map(read_line) {
                self.take(record);
            }
        }
        Ok(())
    }

    fn take(&mut self, record: Record) {
        match record {
            Record::Finished(row) => {
                let Some(first) = row.outputs.first().map(|output| output.path.clone()) else { return };
                let older = self.rows.get(&first).is_none_or(|known| known.began <= row.began);
                if older {
                    self.rows.insert(first, *row);
                }
            }
            Record::Ended { memory, .. } => self.memory.extend(memory),
            Record::Began { at, .. } => self.began = self.began.min(at),
            Record::Scan { .. } => {}
        }
    }

    /// Adds a line and waits until it is on the disk.
    pub(super) fn write(&mut self, record: Record) -> Result<()> {
        // Rows are of words and numbers: they always become JSON.
        let text = serde_json::to_string(&record).unwrap_or_default();
        let line = format!("{} {text}\n", digest(text.as_bytes()));
        let refuse = || Error::io(&self.path, "cannot write the ledger");
        self.file.write_all(line.as_bytes()).map_err(refuse())?;
        self.file.sync_data().map_err(refuse())?;
        if let Record::Finished(row) = &record {
            self.fresh.extend(row.outputs.first().map(|output| output.path.clone()));
        }
        self.take(record);
        Ok(())
    }

    /// What is true of a task: what this run found, or what the ledger says and still holds.
    pub(super) fn standing(&self, task: &Task) -> Option<&Row> {
        let fresh = task.outputs.first().is_some_and(|output| self.fresh.contains(output));
        self.row(task).filter(|_| fresh || self.has_finished(task))
    }

    /// What the ledger says of a task, whether or not it still holds.
    pub(super) fn row(&self, task: &Task) -> Option<&Row> {
        self.rows.get(task.outputs.first()?).filter(|row| row.scan == task.scan)
    }

    /// Whether the task is finished: with these options, from the file that is still there, into files that still are.
    pub(super) fn has_finished(&self, task: &Task) -> bool {
        let Some(row) = self.row(task) else { return false };
        let outputs: Vec<_> = row.outputs.iter().map(|output| &output.path).collect();
        let same = row.options == task.options && outputs.iter().copied().eq(&task.outputs);
        let input = row.input.as_ref().is_some_and(|input| input.still(&task.scan));
        let whole = || row.outputs.iter().all(|out| out.print.as_ref().is_some_and(|print| print.still(&out.path)));
        same && input
            && match row.status {
                Status::Done | Status::Unmet => whole(),
                Status::Failed => row.error.as_ref().is_some_and(|error| error.is_lasting()),
                Status::NotBegun => false,
            }
    }

    /// What was resident in runs that ended, and when the first began.
    pub(super) fn memory(&self) -> &[(f64, u64)] {
        &self.memory
    }

    /// When the first run began.
    pub(super) fn began(&self) -> f64 {
        self.began
    }
}

fn digest(text: &[u8]) -> String {
    blake3::hash(text).to_hex()[..16].into()
}

fn read_line(line: &[u8]) -> Option<Record> {
    let (hash, text) = line.split_at_checked(16)?;
    let text = text.strip_prefix(b" ")?;
    (digest(text).as_bytes() == hash).then(|| serde_json::from_slice(text).ok())?
}
