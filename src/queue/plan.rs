//! What a night will do, in full, before any of it is done.

use super::expand::{Excluded, Found, expand};
use super::glance::Glance;
use super::process::{available_bytes, free_bytes};
use super::template::{Named, fixed_folder};
use crate::budget::{MIB, Size};
use crate::error::{Error, Result};
use crate::job::{Count, DEFAULT_MEMORY, Job, JobFile, Layer, Order, ScanTable, Scans, TimeOfDay, cores};
use crate::pipeline::{Effort, Forecast, forecast};
use crate::progress::Progress;
use crate::report::Mode;
use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// What the process that watches takes, its report included.
const WATCHER_BYTES: u64 = 48 * MIB;

/// Samples that results are measured with when a night's job file does not say: enough for E_avg to 1 % or so, in a fifth of
/// a second.
const SAMPLES: Count = Count(30_000);

/// Tries after the first when nothing is said.
const RETRIES: u32 = 2;

/// A scan of fewer bytes is small: it is reduced by one thread while others are reduced beside it.
const SMALL_BYTES: u64 = 64 * MIB;

/// What the command line says of a night.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PlanOptions {
    /// Every so-manieth scan alone.
    pub shard: Option<Shard>,
    /// Scans whose path contains this alone, whatever the ledger says of them.
    pub only: Option<String>,
}

/// One of several parts of a night: scans `number`, `number + of`, …
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    /// From 1.
    pub number: usize,
    /// How many there are.
    pub of: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("`{text}` is not a shard: write it like 2/8, from 1/8 to 8/8");
        let (number, of) = text.split_once('/').ok_or_else(wrong)?;
        match (number.parse(), of.parse()) {
            (Ok(number), Ok(of)) if (1..=of).contains(&number) => Ok(Shard { number, of }),
            _ => Err(wrong()),
        }
    }
}

/// One scan and all that is to be made of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// The scan.
    pub scan: PathBuf,
    /// What is done with it, in full.
    pub job: JobFile,
    /// The meshes, the finest first.
    pub outputs: Vec<PathBuf>,
    /// Bound on the peak resident set of the process that does it.
    pub budget: Size,
    /// Size of the scan; 0 where there is none.
    pub bytes: u64,
    /// What its first bytes tell.
    pub glance: Glance,
    /// Tells options apart that make other bytes.
    pub options: String,
}

/// Why a plan cannot work.
#[derive(Debug, Clone, PartialEq)]
pub struct Problem {
    /// The scan that is concerned, where it is one.
    pub scan: Option<PathBuf>,
    /// What is wrong.
    pub what: String,
}

/// What is known of a scan once it is opened.
pub type TaskFacts = Result<(Forecast, f64)>;

/// A night, planned.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The job file.
    pub job_file: PathBuf,
    /// Where the ledger, the reports and their pictures are.
    pub folder: PathBuf,
    /// The scans, in the order of their names.
    pub tasks: Vec<Task>,
    /// Bound on the peak resident set of all processes together.
    pub memory: Size,
    /// Scans that are reduced side by side, at most.
    pub workers: usize,
    /// Threads of all together.
    pub threads: usize,
    /// Which scans come first.
    pub order: Order,
    /// Seconds that one scan may take.
    pub scan_seconds: Option<f64>,
    /// When the night is over.
    pub stop_at: Option<TimeOfDay>,
    /// Tries after the first, of what may pass.
    pub retries: u32,
    /// Whether a scan that memory did not suffice for is tried with half its budget.
    pub retry_with_less: bool,
    /// Whether pictures are taken.
    pub pictures: bool,
    /// What the command line says.
    pub options: PlanOptions,
}

impl JobFile {
    /// Whether it is a queue of scans that a ledger is kept of; otherwise it is one scan and one mesh.
    pub fn is_night(&self) -> bool {
        let Scans::One(scan) = &self.scan else { return true };
        let plain = |input: &PathBuf| input.is_file() || !input.to_string_lossy().contains(['*', '?', '[']);
        let output = scan.output.as_ref().is_some_and(|output| output.to_string_lossy().contains('{'));
        let one = scan.input.len() == 1 && scan.input.iter().all(|input| plain(input) && !input.is_dir());
        self.night.is_some() || !one || output || scan.faces.len() > 1 || scan.ratio.len() > 1
    }
}

impl Plan {
    /// Plans what a job file says.
    pub fn of(said: JobFile, job_file: &Path, options: PlanOptions) -> Result<Plan> {
        let here = absolute(job_file.parent().unwrap_or(Path::new(".")));
        let mut said = said;
        said.move_paths(absolute);
        let night = said.night.clone().unwrap_or_default();
        let folder = night.folder.clone().map_or_else(|| default_folder(&said.scan), Ok)?;
        let threads = said.run.threads.map_or_else(cores, |threads| threads.0);
        let mut tasks = Tasks { said: &said, here: &here, folder: &folder }.all()?;
        if tasks.is_empty() {
            return Err(Error::Usage { what: no_scan(job_file), file: Some(job_file.into()) });
        }
        if let Some(Shard { number, of }) = options.shard {
            tasks = tasks.into_iter().skip(number - 1).step_by(of).collect();
        }
        if let Some(only) = options.only.as_ref().filter(|only| !tasks.iter().any(|task| task.is_named(only))) {
            return Err(Error::usage(format!("{}: no scan's path contains `{only}`", job_file.display())));
        }
        let most_budget = tasks.iter().map(|task| task.budget.0).max().unwrap_or(DEFAULT_MEMORY.0);
        let wanted = night.workers.map_or(threads, |workers| workers.0);
        let (memory, workers) = shared(night.memory, most_budget, wanted)?;
        Ok(Plan {
            job_file: job_file.into(),
            folder,
            tasks,
            memory,
            workers,
            threads,
            order: night.order.unwrap_or_default(),
            scan_seconds: night.scan_time.map(|span| span.seconds),
            stop_at: night.stop_at,
            retries: night.retries.map_or(RETRIES, |Count(n)| n.min(100) as u32),
            retry_with_less: night.retry_with_less.unwrap_or(false),
            pictures: night.pictures.unwrap_or(true),
            options,
        })
    }

    /// A scan as people know it: below the job file's folder where it is there.
    pub fn name<'a>(&self, path: &'a Path) -> &'a Path {
        let here = absolute(self.job_file.parent().unwrap_or(Path::new(".")));
        path.strip_prefix(here).unwrap_or(path)
    }

    /// The command that goes on with this night.
    pub fn command(&self) -> String {
        let shard = self.options.shard.map_or(String::new(), |Shard { number, of }| format!(" --shard {number}/{of}"));
        format!("meshmill run {}{shard}", quoted(&self.job_file))
    }

    /// What cannot work, before anything starts: results that would overwrite one another or a scan, folders that cannot
    /// be written, disks that are too small. With [`PlanOptions::only`], of those scans alone.
    pub fn check(&self) -> Vec<Problem> {
        let mut problems = self.collisions();
        let mut folders: BTreeMap<PathBuf, Vec<&Task>> = BTreeMap::new();
        for task in self.meant() {
            for output in &task.outputs {
                let folder = existing(output.parent().unwrap_or(Path::new("/")));
                folders.entry(folder).or_default().push(task);
            }
            if let Some(scratch) = &task.job.run.scratch {
                folders.entry(existing(scratch)).or_default().push(task);
            }
        }
        for (folder, tasks) in folders {
            let Err(error) = tempfile::tempfile_in(&folder) else { continue };
            let scans: BTreeSet<&Path> = tasks.iter().map(|task| task.scan.as_path()).collect();
            problems.extend(scans.into_iter().map(|scan| {
                let what = format!("cannot write into {}: {error}", folder.display());
                Problem { scan: Some(scan.into()), what }
            }));
        }
        problems.extend(self.small_disks());
        if let Err(error) = tempfile::tempfile_in(existing(&self.folder)) {
            let what = format!("cannot write the ledger into {}: {error}", self.folder.display());
            problems.push(Problem { scan: None, what });
        }
        problems
    }

    /// The scans that are asked for.
    fn meant(&self) -> impl Iterator<Item = &Task> {
        let only = self.options.only.as_deref();
        self.tasks.iter().filter(move |task| only.is_none_or(|only| task.is_named(only)))
    }

    /// Disks on which there is less room than all results together take that are still to be made, and the spills of as
    /// many scans as run side by side.
    fn small_disks(&self) -> Vec<Problem> {
        struct Disk {
            folder: PathBuf,
            results: u64,
            there: u64,
            spills: Vec<u64>,
        }
        let mut disks: BTreeMap<u64, Disk> = BTreeMap::new();
        let mut of = |folder: &Path, add: &dyn Fn(&mut Disk)| {
            let folder = existing(folder);
            let Ok(found) = std::fs::metadata(&folder) else { return };
            let disk = Disk { folder, results: 0, there: 0, spills: Vec::new() };
            add(disks.entry(found.dev()).or_insert(disk));
        };
        for task in self.meant() {
            for output in &task.outputs {
                let there = std::fs::metadata(output).map_or(0, |found| found.len());
                of(output.parent().unwrap_or(Path::new("/")), &|disk| {
                    disk.results += task.output_bytes() / task.outputs.len() as u64;
                    disk.there += there;
                });
            }
            let beside = task.outputs.first().and_then(|output| output.parent());
            if let Some(scratch) = task.job.run.scratch.as_deref().or(beside) {
                of(scratch, &|disk| disk.spills.push(task.spill_bytes()));
            }
        }
        let too_small = |mut disk: Disk| {
            disk.spills.sort_unstable_by(|a, b| b.cmp(a));
            let spills: u64 = disk.spills.iter().take(self.workers).sum();
            // What is there already is replaced.
            let needed = disk.results.saturating_sub(disk.there).saturating_add(spills);
            let free = free_bytes(&disk.folder).filter(|free| *free < needed)?;
            let (results, spills, free) = (Size(disk.results), Size(spills), Size(free));
            let folder = disk.folder.display();
            let what = format!(
                "{folder}: the results on this disk take about {results} and spills {spills} at one time, and {free} are free"
            );
            Some(Problem { scan: None, what })
        };
        disks.into_values().filter_map(too_small).collect()
    }

    fn collisions(&self) -> Vec<Problem> {
        let mut makers: BTreeMap<&Path, &Task> = BTreeMap::new();
        let scans: BTreeMap<&Path, ()> = self.tasks.iter().map(|task| (task.scan.as_path(), ())).collect();
        let mut problems = Vec::new();
        for task in &self.tasks {
            for output in &task.outputs {
                let mut say = |what: String| problems.push(Problem { scan: Some(task.scan.clone()), what });
                if scans.contains_key(output.as_path()) {
                    say(format!("its result {} would overwrite a scan", self.name(output).display()));
                } else if let Some(other) = makers.insert(output, task) {
                    let (output, other) = (self.name(output).display(), self.name(&other.scan).display());
                    say(format!("its result {output} is that of {other}, too: use {{stem}}, {{dir}} and {{faces}}"));
                }
            }
        }
        problems.retain(|problem| self.meant().any(|task| Some(&task.scan) == problem.scan.as_ref()));
        problems
    }

    /// Opens a scan: what is expected of it, and seconds.
    pub fn forecast(&self, task: &Task, progress: &Progress) -> TaskFacts {
        let found = forecast(&task.resolved()?, self.pictures, progress)?;
        let seconds = found.effort.seconds(self.threads_of(task));
        Ok((found, seconds))
    }

    /// Threads that reduce a scan: small scans are reduced side by side, a big one has all. Neither changes a byte.
    pub(super) fn threads_of(&self, task: &Task) -> usize {
        if task.is_small() && self.workers > 1 { 1 } else { self.threads }
    }

    /// Seconds that a scan will take, from what a glance at it tells.
    pub(super) fn expected_seconds(&self, task: &Task) -> f64 {
        // One that cannot be resolved takes no time.
        let Ok(job) = task.resolved() else { return 0.0 };
        let Glance { faces, coloured } = task.glance;
        Effort::of(&job, faces, task.likely_mode(), coloured, self.pictures).seconds(self.threads_of(task))
    }
}

/// How the night's memory is shared: the bound on all, and how many scans run side by side.
fn shared(said: Option<Size>, budget: u64, wanted: usize) -> Result<(Size, usize)> {
    let fit = |bytes: u64| (bytes.saturating_sub(WATCHER_BYTES) / budget) as usize;
    if let Some(Size(bytes)) = said {
        return match fit(bytes) {
            0 => {
                let (least, budget) = (Size(budget + WATCHER_BYTES), Size(budget));
                let what =
                    format!("[night] memory: a scan's budget of {budget} takes {least} with the process that watches");
                Err(Error::usage(format!("{what}: say {least} or more, or less memory under [run]")))
            }
            workers => Ok((Size(bytes), wanted.min(workers))),
        };
    }
    let available = available_bytes().map_or(usize::MAX, |bytes| fit(bytes / 5 * 4));
    let workers = wanted.min(available).max(1);
    Ok((Size(WATCHER_BYTES + workers as u64 * budget), workers))
}

impl Task {
    /// The job as it is run.
    pub fn resolved(&self) -> Result<Job> {
        self.job.clone().resolve_to(self.outputs.clone())
    }

    /// Whether the scan's path contains this.
    pub(super) fn is_named(&self, only: &str) -> bool {
        self.scan.to_string_lossy().contains(only)
    }

    /// Whether it is reduced by one thread, beside others.
    pub(super) fn is_small(&self) -> bool {
        self.bytes < SMALL_BYTES
    }

    /// Whether it has to be clustered, as far as its size tells: about 110 bytes a face decide whether it fits.
    fn likely_mode(&self) -> Mode {
        if self.glance.faces.saturating_mul(110) < self.budget.0 { Mode::InCore } else { Mode::OutOfCore }
    }

    /// About what its spills take: a vertex, of which there is half a one a face, takes 15 where faces come in a sensible
    /// order. Soup has none.
    fn spill_bytes(&self) -> u64 {
        let spills = self.likely_mode() == Mode::OutOfCore && !is_stl(&self.scan);
        let bytes = if spills { self.glance.faces.saturating_mul(15) / 2 } else { 0 };
        self.job.run.scratch_quota.map_or(bytes, |Size(quota)| bytes.min(quota))
    }

    /// About what the results take.
    fn output_bytes(&self) -> u64 {
        let scan = &self.job.scan.tables()[0];
        let faces: u64 = scan.faces.iter().map(|Count(n)| *n).sum();
        let ratio: f64 = scan.ratio.iter().map(|ratio| ratio.0).sum();
        let bytes_a_face = if self.outputs.first().is_some_and(|path| is_stl(path)) { 50 } else { 19 };
        (faces.saturating_mul(bytes_a_face)).saturating_add((ratio * self.bytes as f64) as u64).min(2 * self.bytes)
    }
}

fn is_stl(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("stl"))
}

/// The scans of a job file, one by one.
struct Tasks<'a> {
    said: &'a JobFile,
    here: &'a Path,
    folder: &'a Path,
}

impl Tasks<'_> {
    fn all(&self) -> Result<Vec<Task>> {
        let mut found: BTreeMap<PathBuf, (Found, ScanTable)> = BTreeMap::new();
        for table in self.said.scan.tables() {
            let exclude = Excluded::new(&table.exclude, self.here)?;
            for input in &table.input {
                for scan in expand(input, &exclude)? {
                    let path = absolute(&scan.path);
                    // What is said later goes over what was said before; the first to find a scan says what is mirrored.
                    let (first, below) = found.remove(&path).unwrap_or((scan, ScanTable::default()));
                    found.insert(path, (first, table.clone().over(below)));
                }
            }
        }
        // What lies in the night's own folder is a report's, not a scan.
        found.retain(|path, (scan, _)| !scan.searched || !path.starts_with(self.folder.join(PICTURES)));
        let tasks: Result<Vec<_>> =
            found.into_iter().map(|(path, (scan, table))| self.task(path, &scan, table)).collect();
        let tasks = tasks?;
        // A pattern that finds scans also finds results of others that lie beside them.
        let makers: BTreeMap<PathBuf, PathBuf> = tasks
            .iter()
            .flat_map(|(task, _)| task.outputs.iter().map(|output| (output.clone(), task.scan.clone())))
            .collect();
        let is_result = |task: &Task| makers.get(&task.scan).is_some_and(|maker| *maker != task.scan);
        Ok(tasks.into_iter().filter(|(task, searched)| !(*searched && is_result(task))).map(|(task, _)| task).collect())
    }

    fn task(&self, path: PathBuf, found: &Found, table: ScanTable) -> Result<(Task, bool)> {
        let name = path.strip_prefix(self.here).unwrap_or(&path).display().to_string();
        let wrong = |what: String| Error::usage(format!("{name}: {what}"));
        let targets = table.targets().map_err(wrong)?;
        let template = table.output.clone().ok_or_else(|| wrong("nothing says where its mesh goes".into()))?;
        if path.to_str().is_none() {
            return Err(wrong("its name is not Unicode; rename it".into()));
        }
        let named = Named { scan: &path, dir: &found.dir };
        let outputs = targets.iter().map(|target| named.output(&template, *target)).collect::<Result<Vec<_>>>()?;
        if table.format.is_none() {
            outputs.iter().try_for_each(|output| crate::write::Format::of(output).map(|_| ()))?;
        }
        let said = self.said.clone();
        let mut job = JobFile {
            run: table.run.clone().over(said.run),
            cluster: table.cluster.clone().over(said.cluster),
            collapse: table.collapse.clone().over(said.collapse),
            refit: table.refit.clone().over(said.refit),
            report: table.report.clone().over(said.report),
            night: None,
            scan: Scans::One(Box::new(ScanTable {
                input: vec![path.clone()],
                output: outputs.first().cloned(),
                format: table.format,
                carry: table.carry,
                faces: table.faces,
                ratio: table.ratio,
                max_error: table.max_error,
                ..Default::default()
            })),
        };
        job.report.json = None;
        job.report.verify.get_or_insert(true);
        job.report.samples.get_or_insert(SAMPLES);
        let resolved = job.clone().resolve_to(outputs.clone()).map_err(|error| wrong(error.to_string()))?;
        let bytes = std::fs::metadata(&path).map_or(0, |found| found.len());
        let options = options_of(&resolved);
        let budget = resolved.memory;
        let glance = Glance::at(&path, bytes);
        Ok((Task { scan: path, job, outputs, budget, bytes, glance, options }, found.searched))
    }
}

/// A word for what decides the bytes of the results: all but where they go and who makes them.
fn options_of(job: &Job) -> String {
    let mut said = job.said();
    said.run.threads = None;
    said.run.scratch = None;
    said.run.scratch_quota = None;
    for table in said.scan.tables_mut() {
        table.input.clear();
        table.output = None;
    }
    let locked = job.lock_vertices.as_ref().and_then(|path| std::fs::read(path).ok()).unwrap_or_default();
    // Tables of words and numbers always become JSON.
    let text = serde_json::to_string(&said).unwrap_or_default();
    let mut hash = blake3::Hasher::new();
    hash.update(env!("CARGO_PKG_VERSION").as_bytes()).update(text.as_bytes()).update(&locked);
    hash.finalize().to_hex()[..16].into()
}

/// Where pictures are in a night's folder.
pub(super) const PICTURES: &str = "pictures";

/// The folder that all results have in common.
fn default_folder(scans: &Scans) -> Result<PathBuf> {
    let template = scans.tables().iter().find_map(|table| table.output.as_ref());
    template
        .map(|template| fixed_folder(template))
        .ok_or_else(|| Error::usage("nothing says where results go: `output` is missing in every [[scan]]".to_string()))
}

fn no_scan(job_file: &Path) -> String {
    format!("{}: no scan is found by any `input`", job_file.display())
}

/// A path as a shell takes it.
pub(super) fn quoted(path: &Path) -> String {
    let text = path.to_string_lossy();
    let plain = |c: char| c.is_alphanumeric() || "/._-+=@%,:".contains(c);
    if !text.is_empty() && text.chars().all(plain) { text.into() } else { format!("'{}'", text.replace('\'', r"'\''")) }
}

/// The path from the root, with nothing followed.
fn absolute(path: &Path) -> PathBuf {
    // The folder of a bare file name is the empty path.
    let path = if path.as_os_str().is_empty() { Path::new(".") } else { path };
    let path = std::path::absolute(path).unwrap_or_else(|_| path.into());
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            std::path::Component::ParentDir => {
                plain.pop();
            }
            part => plain.push(part),
        }
    }
    plain
}

/// The folder, or the nearest above it that exists.
fn existing(folder: &Path) -> PathBuf {
    folder.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/")).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_quoted_where_a_shell_would_take_them_apart() {
        for (path, text) in [("/a/night-1.toml", "/a/night-1.toml"), ("/a b/it's", r"'/a b/it'\''s'"), ("", "''")] {
            assert_eq!(quoted(Path::new(path)), text);
        }
    }
}
