//! The `meshmill` program: arguments in, exit code out. Nothing else prints.

mod cli;
mod heap;
mod night;
mod terminal;

use clap::Parser;
use clap::error::ErrorKind;
use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicUsize;
use std::time::Instant;

use cli::{BenchArgs, BenchCommand, Cli, Command, CompareArgs, InspectArgs, RenderArgs, RunArgs, SynthArgs};
use meshmill::bench::{Table63Options, table_6_3};
use meshmill::job::{ComparisonSaid, DEFAULT_MEMORY, InspectionSaid, JobFile, RenderingSaid, cores};
use meshmill::progress::Progress;
use meshmill::queue::this_program;
use meshmill::report::{ComparisonReport, Failure, MeshFile, Synthesis, json};
use meshmill::write::{WholeFile, is_stdout};
use meshmill::{Error, Result, pipeline, synth};

fn main() -> ExitCode {
    let args: Vec<OsString> = std::env::args_os().collect();
    match Cli::try_parse_from(&args) {
        Ok(Cli { command: Command::Reduce(args) }) => bounded((*args).into()),
        Ok(Cli { command: Command::Run(args) }) => run(args),
        Ok(Cli { command: Command::Compare(args) }) => compare(args),
        Ok(Cli { command: Command::Inspect(args) }) => inspect(args),
        Ok(Cli { command: Command::Synth(args) }) => make_scan(&args),
        Ok(Cli { command: Command::Render(args) }) => render(args),
        Ok(Cli { command: Command::Report(args) }) => night::merge(args),
        Ok(Cli { command: Command::Bench(args) }) => bench(args),
        Ok(Cli { command: Command::Worker(args) }) => {
            // Of many scans with budgets of their own.
            heap::bound(DEFAULT_MEMORY.0);
            night::work(&args)
        }
        Err(error) => refuse(&error, asks_for_json(&args)),
    }
}

/// What a finished command says: to scripts and to people.
struct Saying {
    object: String,
    lines: Vec<String>,
    /// Why what was asked was not met, though there is a result.
    unmet: Option<String>,
    /// Whether stdout has the result itself: words then go to stderr.
    stdout_is_taken: bool,
    /// The exit code then.
    code: u8,
}

impl Saying {
    fn new(object: String, lines: Vec<String>) -> Self {
        Saying { object, lines, unmet: None, stdout_is_taken: false, code: 1 }
    }
}

/// Reduces one scan, with the heap bound by its budget.
fn bounded(said: JobFile) -> ExitCode {
    heap::bound(said.run.memory.unwrap_or(DEFAULT_MEMORY).0);
    reduce(said)
}

fn reduce(said: JobFile) -> ExitCode {
    let in_json = said.report.json == Some(true);
    let stdout_is_taken = said.scan.tables().iter().any(|table| table.output.as_deref().is_some_and(is_stdout));
    let outcome = said.resolve().and_then(|job| working(|progress| pipeline::reduce(&job, progress)));
    let saying = outcome.map(|report| Saying {
        object: json(&report),
        lines: report.lines(),
        unmet: report.unmet.as_ref().map(|unmet| unmet.message().into()),
        stdout_is_taken,
        code: 1,
    });
    conclude(saying, in_json)
}

fn run(args: RunArgs) -> ExitCode {
    match JobFile::read(&args.job) {
        Ok(mut said) => {
            let in_json = args.json || said.report.json == Some(true);
            said.report.json = Some(in_json);
            if said.is_night() {
                return night::run(said, &args, in_json);
            }
            if args.shard.is_some() || args.only.is_some() {
                let what = "--shard and --only are for many scans, and this job file has one";
                return conclude(Err(Error::Usage { what: what.into(), file: Some(args.job) }), in_json);
            }
            match args.dry_run {
                true => conclude(dry_run(said), in_json),
                // What came through a pipe cannot be read again.
                false if args.job.is_file() => bounded(said),
                false => reduce(said),
            }
        }
        Err(error) => conclude(Err(error), args.json),
    }
}

fn compare(args: CompareArgs) -> ExitCode {
    let in_json = args.json;
    let stdout_is_taken = args.shades_to_stdout();
    if in_json && stdout_is_taken {
        let what = "the report in JSON and the heat map cannot both go to standard output: name a file";
        return conclude(Err(Error::usage(what)), true);
    }
    let comparison = ComparisonSaid::from(args).resolve();
    let outcome = working(|progress| pipeline::compare(&comparison, progress));
    let saying = |report: ComparisonReport| Saying { stdout_is_taken, ..Saying::new(json(&report), report.lines()) };
    conclude(outcome.map(saying), in_json)
}

fn inspect(args: InspectArgs) -> ExitCode {
    let in_json = args.json;
    let inspection = InspectionSaid::from(args).resolve();
    let outcome = working(|progress| pipeline::inspect(&inspection, progress));
    conclude(outcome.map(|report| Saying::new(json(&report), report.lines())), in_json)
}

fn render(args: RenderArgs) -> ExitCode {
    let in_json = args.json;
    let outcome = RenderingSaid::from(args).resolve();
    let outcome = outcome.and_then(|rendering| working(|progress| pipeline::render(&rendering, progress)));
    conclude(outcome.map(|report| Saying::new(json(&report), vec![report.line()])), in_json)
}

/// The thesis's models are in a folder of their own among others.
fn thesis_models() -> Option<PathBuf> {
    let folder = PathBuf::from(std::env::var_os("MESHMILL_MODELS")?);
    Some(Some(folder.join("table63")).filter(|inner| inner.is_dir()).unwrap_or(folder))
}

fn bench(args: BenchArgs) -> ExitCode {
    let BenchCommand::Table63(args) = args.command;
    let outcome = working(|progress| {
        let options = Table63Options {
            program: this_program()?,
            models: args.models.clone().or_else(thesis_models),
            continued: args.continued.iter().map(|faces| faces.0).collect(),
            memory: args.memory,
            threads: args.threads.map_or_else(cores, |threads| threads.0),
            runs: args.runs.into(),
            scratch: args.scratch.clone(),
            most_faces: args.most_faces.map_or(u64::MAX, |faces| faces.0),
        };
        let files = match &args.output {
            Some(folder) => {
                let file = |name: &str| WholeFile::prepare(&folder.join(name), None);
                Some((file("table-6.3.json")?, file("table-6.3.svg")?))
            }
            None => None,
        };
        let table = table_6_3(&options, progress)?;
        if let Some((object, chart)) = files {
            object.write(format!("{}\n", json(&table)).as_bytes(), progress)?;
            chart.write(table.svg().as_bytes(), progress)?;
        }
        Ok(Saying::new(json(&table), table.lines()))
    });
    conclude(outcome, args.json)
}

/// The job in full, as a job file that can be run from anywhere.
fn dry_run(said: JobFile) -> Result<Saying> {
    #[derive(serde::Serialize)]
    struct Resolved {
        job: JobFile,
    }
    let in_json = said.report.json;
    let mut job = said.resolve()?.said();
    job.report.json = in_json;
    job.move_paths(|path| {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.into());
        PathBuf::from(path.to_string_lossy().into_owned())
    });
    let text = toml::to_string(&job).map_err(|e| Error::usage(format!("the job cannot be shown: {e}")))?;
    Ok(Saying::new(json(&Resolved { job }), text.trim_end().lines().map(String::from).collect()))
}

fn make_scan(args: &SynthArgs) -> ExitCode {
    let begun = Instant::now();
    if args.json && is_stdout(&args.output) {
        let what = "the report in JSON and the scan cannot both go to standard output: name a file";
        return conclude(Err(Error::usage(what)), true);
    }
    let outcome = working(|progress| synth::synth(&args.output, args.faces.0, args.seed, progress)).map(|made| {
        let stdout_is_taken = is_stdout(&args.output);
        let output = MeshFile { path: args.output.clone(), faces: made.faces, vertices: made.vertices };
        let seconds = begun.elapsed().as_secs_f64();
        let made = Synthesis { output, bytes: made.bytes, seed: args.seed, seconds };
        Saying { stdout_is_taken, ..Saying::new(json(&made), vec![made.line()]) }
    });
    conclude(outcome, args.json)
}

/// Works under a progress that is shown and that SIGINT and SIGTERM end.
fn working<T>(work: impl FnOnce(&Progress) -> Result<T>) -> Result<T> {
    let progress = Progress::cancelled_by(signals()?);
    terminal::showing(&progress, || work(&progress))
}

/// The number of the signal that asked the program to end, once one has; 0 until then.
fn signals() -> Result<Arc<AtomicUsize>> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    let signal = Arc::new(AtomicUsize::new(0));
    for number in [SIGINT, SIGTERM] {
        signal_hook::flag::register_usize(number, Arc::clone(&signal), number as usize)
            .map_err(Error::io(Path::new("signals"), "cannot be handled"))?;
    }
    Ok(signal)
}

/// Says how it went: with `--json` one object is all that stdout gets.
fn conclude(outcome: Result<Saying>, in_json: bool) -> ExitCode {
    match outcome {
        Ok(Saying { lines, stdout_is_taken: true, .. }) => {
            tell_stderr(&lines.join("\n"));
            ExitCode::SUCCESS
        }
        Ok(Saying { object, lines, unmet, code, .. }) => {
            let words = lines.join("\n");
            let code = if unmet.is_some() { code } else { 0 };
            if in_json {
                tell_stderr(&words);
            }
            let code = tell_stdout(if in_json { &object } else { &words }, code);
            if let Some(message) = unmet {
                tell_stderr(&format!("meshmill: {message}"));
            }
            code
        }
        Err(error) => {
            tell_stderr(&format!("meshmill: {error}"));
            let code = error.exit_code();
            if in_json { tell_stdout(&json(&Failure::from(&error)), code) } else { ExitCode::from(code) }
        }
    }
}

/// Help and version as asked, or what is wrong with the command line.
fn refuse(error: &clap::Error, in_json: bool) -> ExitCode {
    // A closed stdout or stderr is no reason to fail: nobody listens.
    let _ = error.print();
    match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => ExitCode::SUCCESS,
        _ if in_json => {
            let text = error.render().to_string();
            let text = text.split("\n\nUsage:").next().unwrap_or_default();
            let text = text.strip_prefix("error: ").unwrap_or(text).trim();
            let error = Error::usage(text);
            tell_stdout(&json(&Failure::from(&error)), error.exit_code())
        }
        _ => ExitCode::from(2),
    }
}

/// Whether a command line that could not be parsed asks for JSON.
fn asks_for_json(args: &[OsString]) -> bool {
    args.iter().skip(1).take_while(|arg| *arg != "--").any(|arg| arg == "--json")
}

/// Prints, and gives the exit code: a reader that went away changes nothing, a full disk under stdout does.
fn tell_stdout(text: &str, code: u8) -> ExitCode {
    let mut stdout = std::io::stdout().lock();
    match writeln!(stdout, "{text}").and_then(|()| stdout.flush()) {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => {
            tell_stderr(&format!("meshmill: cannot write to stdout: {e}"));
            ExitCode::from(code.max(1))
        }
        _ => ExitCode::from(code),
    }
}

/// Prints; where nobody can hear, that is no reason to fail.
fn tell_stderr(text: &str) {
    let _ = writeln!(std::io::stderr(), "{text}");
}

#[cfg(test)]
mod tests {
    use super::*;
    use signal_hook::{consts::SIGTERM, low_level::raise};

    #[test]
    fn a_signal_ends_the_work_with_its_exit_code() {
        let error = working(|progress| {
            progress.check()?;
            raise(SIGTERM).map_err(Error::io(Path::new("test"), "cannot raise"))?;
            progress.check()
        })
        .unwrap_err();
        assert_eq!(error.exit_code(), 143);
    }

    #[test]
    fn json_is_asked_for_before_the_names_of_files() {
        let args = |words: &[&str]| words.iter().map(OsString::from).collect::<Vec<_>>();
        assert!(asks_for_json(&args(&["meshmill", "reduce", "--json"])));
        assert!(!asks_for_json(&args(&["--json", "reduce", "--", "--json"])));
    }
}
