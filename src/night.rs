//! `meshmill run` of many scans, as it is seen: the plan, how it goes, and what came of it.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use crate::cli::{MergeArgs, ReportArgs, ReportCommand, RunArgs, WorkerArgs};
use crate::terminal::NightScreen;
use crate::{Saying, conclude, signals, tell_stderr, tell_stdout, working};
use meshmill::budget::Size;
use meshmill::job::{JobFile, Span};
use meshmill::progress::Progress;
use meshmill::queue::{Night, NightReport, Plan, PlanOptions, Problem, Row, Standing, Status, Totals, Watcher};
use meshmill::report::{Mode, count, json};
use meshmill::{Error, Result, morning, queue};

/// Runs, or shows, what a job file says of many scans.
pub fn run(said: JobFile, args: &RunArgs, in_json: bool) -> ExitCode {
    let options = PlanOptions { shard: args.shard, only: args.only.clone() };
    let plan = match Plan::of(said, &args.job, options) {
        Ok(plan) => plan,
        Err(error) => return conclude(Err(in_file(error, &args.job)), in_json),
    };
    let problems = plan.check();
    if args.dry_run {
        return conclude(working(|progress| dry_run(&plan, &problems, progress)), in_json);
    }
    if !problems.is_empty() && !args.keep_going {
        return conclude(Err(refusal(&plan, &problems)), in_json);
    }
    match go(&plan, &problems) {
        Ok((report, page, signal)) => {
            let said = Said { in_json, keep_going: args.keep_going };
            finish(&plan, &report, &page, signal, said)
        }
        Err(error) => conclude(Err(error), in_json),
    }
}

/// What is wrong with a job file names it.
fn in_file(error: Error, job: &Path) -> Error {
    match error {
        Error::Usage { what, file: None } => {
            Error::Usage { what: format!("{}: {what}", job.display()), file: Some(job.into()) }
        }
        other => other,
    }
}

fn refusal(plan: &Plan, problems: &[Problem]) -> Error {
    let lines: Vec<_> = problems.iter().map(|problem| problem_line(plan, problem)).collect();
    let what = format!(
        "{}: nothing was begun, since this cannot work:\n{}\n--keep-going begins what can be done",
        plan.job_file.display(),
        lines.join("\n")
    );
    Error::Usage { what, file: Some(plan.job_file.clone()) }
}

fn problem_line(plan: &Plan, problem: &Problem) -> String {
    let scan = problem.scan.as_deref().map_or(String::new(), |scan| format!("{}: ", plan.name(scan).display()));
    format!("  {scan}{}", problem.what)
}

fn go(plan: &Plan, problems: &[Problem]) -> Result<(NightReport, PathBuf, Option<i32>)> {
    let signal = signals()?;
    let night = Night::begin(plan, problems)?;
    if night.finished() > 0 {
        tell_stderr(&format!("{} of {} finished before", night.finished(), count(plan.tasks.len() as u64, "scan")));
    }
    let mut screen = Screen { screen: NightScreen::new(plan), signal };
    let (report, signal) = night.run(&mut screen)?;
    screen.screen.clear();
    let page = morning::write(&report, &plan.folder, plan.options.shard)?;
    Ok((report, page, signal))
}

struct Screen<'a> {
    screen: NightScreen<'a>,
    signal: Arc<AtomicUsize>,
}

impl Watcher for Screen<'_> {
    fn finished(&mut self, row: &Row, again: bool) {
        self.screen.finished(row, again);
    }

    fn standing(&mut self, standing: &Standing) {
        self.screen.standing(standing);
    }

    fn signal(&self) -> Option<i32> {
        Some(self.signal.load(Relaxed) as i32).filter(|number| *number != 0)
    }
}

/// What the command line says of how a night ends.
struct Said {
    in_json: bool,
    keep_going: bool,
}

/// Says what came of a night.
fn finish(plan: &Plan, report: &NightReport, page: &Path, signal: Option<i32>, said: Said) -> ExitCode {
    let complete = report.is_complete(plan.options.only.as_deref());
    let mut lines = vec![totals_line(&report.totals)];
    for row in report.rows.iter().filter(|row| matches!(row.status, Status::Failed | Status::Unmet)) {
        let why = row.error.as_ref().map_or("", |error| error.message.as_str());
        let why = why.strip_prefix(&format!("{}: ", row.scan.display())).unwrap_or(why);
        lines.push(format!("{:8} {}: {why}", row.status.word(), plan.name(&row.scan).display()));
    }
    let (peak, bound) = (Size(report.peak_rss_bytes), Size(report.memory));
    lines.push(format!("memory   {peak} at the peak of all processes, of {bound}"));
    lines.push(format!("report   {}", page.display()));
    if report.totals.not_begun > 0 {
        let keep_going = if said.keep_going { " --keep-going" } else { "" };
        lines.push(format!("resume   {}{keep_going}", plan.command()));
    }
    let words = lines.join("\n");
    let code = match signal {
        Some(signal) => 128u8.wrapping_add(signal as u8),
        None => u8::from(!complete),
    };
    if said.in_json {
        tell_stderr(&words);
        return tell_stdout(&json(report), code);
    }
    tell_stdout(&words, code)
}

fn totals_line(totals: &Totals) -> String {
    let others = [(totals.failed, "failed"), (totals.unmet, "not as asked"), (totals.not_begun, "not begun")];
    let others: String = others.iter().filter(|(n, _)| *n > 0).map(|(n, word)| format!(", {n} {word}")).collect();
    format!("scans    {} of {} done{others}", totals.done, totals.scans)
}

/// The plan, in full.
fn dry_run(plan: &Plan, problems: &[Problem], progress: &Progress) -> Result<Saying> {
    let mut rows = Vec::new();
    let mut lines =
        vec![format!("plan     {}, results and report in {}", plan.job_file.display(), plan.folder.display())];
    let (mut seconds, mut output_bytes, mut scratch_bytes) = (0.0, 0, 0);
    for task in &plan.tasks {
        progress.check()?;
        let name = plan.name(&task.scan).display();
        let outputs: Vec<String> = task.outputs.iter().map(|path| plan.name(path).display().to_string()).collect();
        let mut row = serde_json::json!({
            "scan": task.scan, "bytes": task.bytes, "outputs": task.outputs, "memory_budget_bytes": task.budget.0,
        });
        match plan.forecast(task, progress) {
            Ok((forecast, expected)) => {
                seconds += expected;
                output_bytes += forecast.output_bytes;
                scratch_bytes = forecast.scratch_bytes.max(scratch_bytes);
                let mode = if forecast.mode == Mode::InCore { "in core" } else { "out of core" };
                lines.push(format!(
                    "scan     {name}: {}, {}, {mode}, {}, {} → {}",
                    count(forecast.faces, "face"),
                    Size(task.bytes),
                    about(expected),
                    task.budget,
                    outputs.join(", ")
                ));
                row["faces"] = forecast.faces.into();
                row["mode"] = serde_json::to_value(forecast.mode).unwrap_or_default();
                row["expected_seconds"] = expected.into();
                row["output_bytes"] = forecast.output_bytes.into();
                row["scratch_bytes"] = forecast.scratch_bytes.into();
            }
            Err(error @ Error::Interrupted { .. }) => return Err(error),
            Err(error) => {
                lines.push(format!("will fail {error}"));
                row["error"] = serde_json::json!({ "code": error.code(), "message": error.to_string() });
            }
        }
        rows.push(row);
    }
    let expected_seconds = seconds / plan.workers as f64;
    lines.push(format!(
        "in all   {}, {} side by side within {}, {}",
        count(plan.tasks.len() as u64, "scan"),
        plan.workers,
        plan.memory,
        about(expected_seconds),
    ));
    let order = serde_json::to_value(plan.order).unwrap_or_default();
    let limit = plan.scan_seconds.map_or(String::new(), |seconds| format!(", each within {}", Span { seconds }));
    lines.push(format!(
        "order    {}{limit}, {} after a failure that may pass",
        order.as_str().unwrap_or(""),
        tries(plan)
    ));
    let scratch = Size(scratch_bytes * plan.workers as u64);
    lines.push(format!("disk     about {} of results, {scratch} of scratch at one time", Size(output_bytes)));
    if let Some(time) = plan.stop_at {
        lines.push(format!("stop at  {time}"));
    }
    lines.extend(problems.iter().map(|problem| format!("refused{}", problem_line(plan, problem))));
    let problem = |problem: &Problem| serde_json::json!({ "scan": problem.scan, "what": problem.what });
    let object = serde_json::json!({
        "plan": {
            "folder": plan.folder, "workers": plan.workers, "memory_bytes": plan.memory.0,
            "expected_seconds": expected_seconds, "output_bytes": output_bytes,
            "scratch_bytes": scratch_bytes * plan.workers as u64, "scans": rows,
            "problems": problems.iter().map(problem).collect::<Vec<_>>(),
        }
    });
    let mut saying = Saying::new(json(&object), lines);
    if !problems.is_empty() {
        saying.unmet = Some("the plan cannot work as it is".into());
        saying.code = 2;
    }
    Ok(saying)
}

/// An expected time.
fn about(seconds: f64) -> String {
    match seconds {
        s if s < 1.0 => "less than 1 s".into(),
        s if s < 120.0 => format!("about {s:.0} s"),
        s if s < 7200.0 => format!("about {:.0} min", s / 60.0),
        s => format!("about {:.1} h", s / 3600.0),
    }
}

fn tries(plan: &Plan) -> String {
    match plan.retries {
        1 => "1 more try".into(),
        n => format!("{n} more tries"),
    }
}

/// `meshmill report merge`
pub fn merge(args: ReportArgs) -> ExitCode {
    let ReportCommand::Merge(args) = args.command;
    let outcome = merged(&args).map(|(report, page)| {
        let lines = vec![totals_line(&report.totals), format!("report   {}", page.display())];
        Saying::new(json(&report), lines)
    });
    conclude(outcome, args.json)
}

fn merged(args: &MergeArgs) -> Result<(NightReport, PathBuf)> {
    let read = |path: &PathBuf| -> Result<NightReport> {
        let bytes = std::fs::read(path).map_err(Error::io(path, "cannot read the report"))?;
        let mut report: NightReport = serde_json::from_slice(&bytes)
            .map_err(|error| Error::input(path, format!("is not the report of a night: {error}")))?;
        let folder = std::path::absolute(path.parent().unwrap_or(Path::new("."))).unwrap_or_default();
        for picture in report.rows.iter_mut().filter_map(|row| row.picture.as_mut()) {
            *picture = folder.join(&picture);
        }
        Ok(report)
    };
    let reports = args.reports.iter().map(read).collect::<Result<Vec<_>>>()?;
    let report = queue::merge(reports)?;
    let folder = match (&args.output, args.reports[0].parent()) {
        (Some(folder), _) => folder.clone(),
        (None, Some(folder)) if !folder.as_os_str().is_empty() => folder.into(),
        _ => PathBuf::from("."),
    };
    std::fs::create_dir_all(&folder).map_err(Error::io(&folder, "cannot make this folder"))?;
    let page = morning::write(&report, &folder, None)?;
    Ok((report, page))
}

/// `meshmill worker`
pub fn work(args: &WorkerArgs) -> ExitCode {
    match queue::work(&args.folder, &args.shard_name) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            tell_stderr(&error.to_string());
            ExitCode::from(error.exit_code())
        }
    }
}
