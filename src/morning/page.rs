//! `report.html`.

use super::escape;
use super::plots::{memory_plot, time_plot};
use super::words::{disk, length, memory, short_count, span};
use crate::error::Result;
use crate::measure::Scale;
use crate::queue::{NightReport, Row, Status, Totals, local_time};
use serde_json::Value;
use std::fmt::Write;
use std::path::{Path, PathBuf};

const STYLE: &str = include_str!("page.css");
const SCRIPT: &str = include_str!("page.js");

/// Columns: word, whether it can be sorted by, and whether it is of words.
const COLUMNS: [(&str, bool, bool); 9] = [
    ("", false, true),
    ("Scan", true, true),
    ("Faces before", true, false),
    ("after", true, false),
    ("Size", true, false),
    ("Time", true, false),
    ("Memory", true, false),
    ("Deviation", true, false),
    ("Warnings", true, false),
];

/// Scans that did not go as asked that are shown at once; the others unfold.
const SHOWN_TROUBLES: usize = 12;

/// Up to so many scans are shown as pictures at first, more as a list.
const SHOWN_PICTURES: usize = 60;

/// Writes the page, piece by piece: pictures are read from below `folder` one at a time.
pub(super) fn write(report: &NightReport, folder: &Path, put: &mut dyn FnMut(&str) -> Result<()>) -> Result<()> {
    let page = Page { report, folder, common: common_folder(report) };
    put(&page.head())?;
    put(&page.troubles())?;
    put(&page.plots())?;
    put(&page.table_head())?;
    // What did not go as asked has been told.
    for reduced in [true, false] {
        for (number, row) in report.rows.iter().enumerate().filter(|(_, row)| row.report.is_some() == reduced) {
            put(&page.row(number, row))?;
        }
    }
    put("</table></section>")?;
    put(&page.foot())
}

/// The folder that all scans are in: what is said once need not be said in every row.
fn common_folder(report: &NightReport) -> PathBuf {
    let mut folders = report.rows.iter().filter_map(|row| row.scan.parent());
    let Some(first) = folders.next() else { return PathBuf::new() };
    folders.fold(first.to_path_buf(), |common, folder| {
        common.components().zip(folder.components()).take_while(|(a, b)| a == b).map(|(a, _)| a).collect()
    })
}

struct Page<'a> {
    report: &'a NightReport,
    folder: &'a Path,
    common: PathBuf,
}

impl Page<'_> {
    fn name(&self, scan: &Path) -> String {
        scan.strip_prefix(&self.common).unwrap_or(scan).display().to_string()
    }

    fn head(&self) -> String {
        let NightReport { totals, began, ended, .. } = self.report;
        let job = self.report.job.file_stem().unwrap_or_default().to_string_lossy();
        let others = [(totals.failed, "failed"), (totals.unmet, "not as asked"), (totals.not_begun, "not begun")];
        let others: String = others.iter().filter(|(n, _)| *n > 0).map(|(n, word)| format!(", {n} {word}")).collect();
        let verdict = format!("{} of {} scans done{others}", totals.done, totals.scans);
        let bad = if totals.done < totals.scans { " bad" } else { "" };
        let ramp = Scale::ramp(9).map(|[r, g, b]| format!("rgb({r} {g} {b})")).collect::<Vec<_>>().join(",");
        let early = self.report.ended_early.as_ref().map_or(String::new(), |why| format!(", ended by {why}"));
        let mut html = format!(
            "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
             <title>{title}</title><link rel=\"icon\" href=\"data:,\"><style>{}</style></head><body><main>\
             <header><h1>{title}</h1><p class=\"sub\">{} to {} ({}{})</p>\
             <p class=\"verdict{bad}\">{verdict}</p>{bar}</header><section class=\"cards\">",
            STYLE.replace("RAMP", &ramp),
            local_time(*began),
            local_time(*ended),
            span(ended - began),
            escape(&early),
            title = escape(&format!("{job}: {} scans", totals.scans)),
            bar = verdict_bar(totals),
        );
        let peak = self.report.peak_rss_bytes;
        let (middle, largest) = self.deviations();
        for (value, what) in [
            (
                format!("{} → {}", short_count(totals.faces), short_count(totals.result_faces)),
                "faces, before and after the finest reduction",
            ),
            (format!("{} → {}", disk(totals.bytes), disk(totals.result_bytes)), "on disk, before and after"),
            (
                middle.map_or("–".into(), |share| format!("{} %", length(100.0 * share))),
                &match largest {
                    Some(largest) => format!(
                        "of the diagonal: RMS deviation, the median of all scans; the largest is {} %",
                        length(100.0 * largest)
                    ),
                    None => "of the diagonal: deviation; none was measured".into(),
                },
            ),
            (span(totals.seconds), &format!("of work, {} side by side", self.report.workers)),
            (memory(peak), &format!("at the peak of all processes, of {}", memory(self.report.memory))),
        ] {
            _ = write!(html, "<div class=\"card\"><b>{value}</b><span>{what}</span></div>");
        }
        html + "</section>"
    }

    /// The median and the largest RMS deviation, as shares of each scan's diagonal.
    fn deviations(&self) -> (Option<f64>, Option<f64>) {
        let mut shares: Vec<f64> =
            self.report.rows.iter().filter_map(|row| row.number("/deviation/shares/rms")).collect();
        shares.sort_by(f64::total_cmp);
        (shares.get(shares.len() / 2).copied(), shares.last().copied())
    }

    /// What did not go as asked, worst first.
    fn troubles(&self) -> String {
        let of = |status: Status| {
            self.report.rows.iter().enumerate().filter(move |(_, row)| row.status == status).collect::<Vec<_>>()
        };
        let mut html = String::new();
        for (status, title, class) in [
            (Status::Failed, "Failed", ""),
            (Status::Unmet, "Done, but not as asked", " unmet"),
            (Status::NotBegun, "Not begun", " waits"),
        ] {
            let rows = of(status);
            if rows.is_empty() {
                continue;
            }
            let of = rows.len();
            _ = write!(html, "<section><h2>{title}<span class=\"many\">{of}</span></h2>");
            for (i, (number, row)) in rows.into_iter().enumerate() {
                if i == SHOWN_TROUBLES {
                    _ = write!(html, "<details><summary>{} more</summary>", of - i);
                }
                let (code, message) = match &row.error {
                    Some(error) => (error.code.as_str(), error.message.as_str()),
                    None => ("waits", "The run ended before its turn; the same command goes on with it."),
                };
                // Its name is said above.
                let message = message.strip_prefix(&format!("{}: ", row.scan.display())).unwrap_or(message);
                let tries = if row.tries > 1 { format!(", {} tries", row.tries) } else { String::new() };
                _ = write!(
                    html,
                    "<div class=\"trouble{class}\"><h3><a data-scan href=\"#s{number}\" style=\"color:inherit\">{}</a>\
                     <span class=\"tag\">{}{tries}</span></h3><p>{}</p><code>{}</code></div>",
                    escape(&self.name(&row.scan)),
                    escape(code),
                    escape(message),
                    escape(&row.repeat),
                );
            }
            html += if of > SHOWN_TROUBLES { "</details></section>" } else { "</section>" };
        }
        html
    }

    fn plots(&self) -> String {
        let name = |path: &Path| self.name(path);
        format!(
            "<section><h2>The night</h2><div class=\"plots\"><figure><figcaption>Scans, by worker</figcaption>{}</figure>\
             <figure><figcaption>Memory of all processes; dashed, the bound</figcaption>{}</figure></div></section>",
            time_plot(self.report, &name),
            memory_plot(self.report)
        )
    }

    fn table_head(&self) -> String {
        let mut html = String::from(
            "<section><h2>Scans</h2><div class=\"tools\"><input id=\"search\" type=\"search\" placeholder=\"Find a scan\" \
             aria-label=\"Find a scan\"><label>by <select id=\"sort\">",
        );
        for (i, (word, _, text)) in COLUMNS.iter().enumerate().filter(|(_, column)| column.1) {
            let down = if *text { "up" } else { "down" };
            _ = write!(html, "<option value=\"{i} {down}\">{word}</option>");
        }
        let pictured = self.report.rows.iter().filter(|row| row.picture.is_some()).count();
        let cards = (1..=SHOWN_PICTURES).contains(&pictured);
        _ = write!(
            html,
            "</select></label><span class=\"views-as\" role=\"group\" aria-label=\"Show as\">\
             <button data-as=\"list\" aria-pressed=\"{}\">List</button>\
             <button data-as=\"cards\" aria-pressed=\"{cards}\">Pictures</button></span>\
             <span id=\"found\" aria-live=\"polite\"></span></div><table class=\"scans{}\"><thead><tr>",
            !cards,
            if cards { " cards" } else { "" }
        );
        for (word, sorts, text) in COLUMNS {
            let class = if text { " class=\"left\"" } else { "" };
            let word = if sorts { format!("<button>{word}</button>") } else { word.into() };
            _ = write!(html, "<th{class} scope=\"col\">{word}</th>");
        }
        html + "</tr></thead>"
    }

    fn row(&self, number: usize, row: &Row) -> String {
        let name = self.name(&row.scan);
        let (before, after) = (row.number("/input/faces"), row.number("/output/faces"));
        let rms = row.number("/deviation/rms");
        let share = row.number("/deviation/shares/rms");
        let warnings = row.all_warnings();
        let key = |x: Option<f64>| x.map_or(String::new(), |x| x.to_string());
        let bytes = row.input.as_ref().map(|input| input.bytes);
        let keys = [
            String::new(),
            escape(&name),
            key(before),
            key(after),
            key(bytes.map(|bytes| bytes as f64)),
            if row.tries > 0 { row.seconds.to_string() } else { String::new() },
            key(row.peak_rss_bytes.map(|bytes| bytes as f64)),
            key(share),
            warnings.len().to_string(),
        ];
        let class = match row.status {
            Status::Done => "done",
            Status::Unmet => "unmet",
            Status::Failed => "failed",
            Status::NotBegun => "not-begun",
        };
        let mut html = format!("<tbody id=\"s{number}\" class=\"{class}\"");
        for (i, key) in keys.iter().enumerate() {
            _ = write!(html, " data-k{i}=\"{key}\"");
        }
        let views = row.fact("/portrait/views").and_then(Value::as_array).map_or(2, Vec::len);
        let picture = self.picture(row, &name).unwrap_or_default();
        _ = write!(
            html,
            " style=\"--n:{views}\"><tr class=\"row\" tabindex=\"0\" aria-expanded=\"false\">\
             <td class=\"left pic\">{}</td>\
             <td class=\"left\"><span class=\"name\">{}</span><small class=\"state\">{}</small></td>",
            if picture.is_empty() { String::new() } else { format!("<span class=\"thumb\">{picture}</span>") },
            escape(&name),
            row.status.word()
        );
        let cell = |label: &str, value: Option<String>, small: Option<String>| {
            let small = small.map_or(String::new(), |small| format!("<small>{small}</small>"));
            let value = value.unwrap_or("<span class=\"none\">–</span>".into());
            format!("<td data-label=\"{label}\">{value}{small}</td>")
        };
        let count = |x: f64| short_count(x as u64);
        let percent =
            before.zip(after).filter(|(before, _)| *before > 0.0).map(|(before, after)| 100.0 * after / before);
        html += &cell("Faces before", before.map(count), None);
        html += &cell("after", after.map(count), percent.map(|p| format!("{} %", length(p))));
        let written = Some(row.output_bytes()).filter(|bytes| *bytes > 0).map(|bytes| format!("→ {}", disk(bytes)));
        html += &cell("Size", bytes.map(disk), written);
        html += &cell("Time", (row.tries > 0).then(|| span(row.seconds)), None);
        let peak = row.peak_rss_bytes.map(|peak| {
            let full = (100.0 * peak as f64 / row.budget.max(1) as f64).min(100.0);
            format!("{}<span class=\"meter\"><i style=\"width:{full:.0}%\"></i></span>", memory(peak))
        });
        html += &cell("Memory", peak, Some(format!("of {}", memory(row.budget))));
        let share = share.map(|share| format!("{} % of the diagonal", length(100.0 * share)));
        html += &cell("Deviation", rms.map(length), share);
        let none = if warnings.is_empty() { " class=\"zero\"" } else { "" };
        _ = write!(html, "<td data-label=\"Warnings\"{none}>{}</td>", warnings.len());
        html + "</tr>" + &self.more(row, &warnings, views) + "</tbody>"
    }

    fn more(&self, row: &Row, warnings: &[String], views: usize) -> String {
        let mut html = format!("<tr class=\"more\"><td colspan=\"{}\">", COLUMNS.len());
        if row.picture.is_some() {
            html += "<div class=\"strip\"><div class=\"views\">";
            let words = row.fact("/portrait/views").and_then(Value::as_array).into_iter().flatten();
            for view in words.filter_map(Value::as_str).take(views) {
                _ = write!(html, "<span>{}</span>", escape(view));
            }
            html += "</div></div>";
            if let Some(top) = row.number("/portrait/deviation_top") {
                _ = write!(html, "<p class=\"scale\">0 <i></i> {} and more, in the scan's units</p>", length(top));
            }
        }
        if let Some(error) = &row.error {
            _ = write!(html, "<p>{}: {}</p>", escape(&error.code), escape(&error.message));
        }
        html += &levels(row);
        html += "<div class=\"facts\">";
        let number = |pointer: &str| row.number(pointer);
        let seconds = |stage: &str| number(&format!("/seconds/{stage}")).filter(|s| *s > 0.0).map(span);
        for (word, value) in [
            ("mode", row.fact("/mode").and_then(Value::as_str).map(String::from)),
            ("cells", number("/cells").map(|n| short_count(n as u64))),
            ("intermediate : result", number("/ratio").map(|r| format!("{r:.1}"))),
            ("read", seconds("read")),
            ("cluster", seconds("cluster")),
            ("collapse", seconds("collapse")),
            ("refit", seconds("refit")),
            ("write", seconds("write")),
            ("measure", seconds("measure")),
            ("pictures", seconds("render")),
            ("scratch", number("/scratch_bytes").filter(|n| *n > 0.0).map(|n| disk(n as u64))),
            ("began", (row.tries > 0).then(|| local_time(row.began))),
            ("tries", (row.tries > 1).then(|| row.tries.to_string())),
            ("points measured", number("/deviation/samples").map(|n| short_count(n as u64))),
        ] {
            if let Some(value) = value {
                _ = write!(html, "<div><span>{word}</span>{}</div>", escape(&value));
            }
        }
        html += "</div>";
        if !warnings.is_empty() {
            html += "<ul class=\"warnings\">";
            for warning in warnings {
                _ = write!(html, "<li>{}</li>", escape(warning));
            }
            html += "</ul>";
        }
        _ = write!(html, "<p></p><code>{}</code>", escape(&row.repeat));
        html + "</td></tr>"
    }

    /// The picture itself, within the page.
    fn picture(&self, row: &Row, name: &str) -> Option<String> {
        // One that is gone since is not shown.
        let bytes = std::fs::read(self.folder.join(row.picture.as_ref()?)).ok()?;
        let (alt, data) = (escape(&format!("{name}, before and after")), base64(&bytes));
        Some(format!("<img loading=\"lazy\" alt=\"{alt}\" src=\"data:image/jpeg;base64,{data}\">"))
    }

    fn foot(&self) -> String {
        format!(
            "<footer>meshmill {} · scans in {} · job {}</footer></main><script>{SCRIPT}</script></body></html>\n",
            env!("CARGO_PKG_VERSION"),
            escape(&self.common.display().to_string()),
            escape(&self.report.job.display().to_string())
        )
    }
}

/// How many of all went which way, as a bar.
fn verdict_bar(totals: &Totals) -> String {
    let parts =
        [("done", totals.done), ("unmet", totals.unmet), ("failed", totals.failed), ("waits", totals.not_begun)];
    let parts: String = parts
        .iter()
        .filter(|(_, n)| *n > 0)
        .map(|(class, n)| format!("<i class=\"{class}\" style=\"flex:{n}\"></i>"))
        .collect();
    format!("<div class=\"bar\" aria-hidden=\"true\">{parts}</div>")
}

/// A line a result.
fn levels(row: &Row) -> String {
    let mut html = String::from(
        "<table class=\"levels\"><tr><th class=\"left\">Result</th><th>Faces</th><th>Size</th><th>RMS</th><th>largest</th></tr>",
    );
    for (i, output) in row.outputs.iter().enumerate() {
        let base = if i == 0 { String::new() } else { format!("/coarser/{}", i - 1) };
        let number = |key: &str| row.number(&format!("{base}/{key}"));
        let cell = |value: Option<String>| value.unwrap_or("–".into());
        _ = write!(
            html,
            "<tr><td class=\"left\" style=\"overflow-wrap:anywhere\">{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(&output.path.file_name().unwrap_or_default().to_string_lossy()),
            cell(number("output/faces").map(|n| short_count(n as u64))),
            cell(output.print.as_ref().map(|print| disk(print.bytes))),
            cell(number("deviation/rms").map(length)),
            cell(number("deviation/max").map(length)),
        );
    }
    html + "</table>"
}

fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for three in bytes.chunks(3) {
        let bits = three.iter().fold(0u32, |bits, byte| bits << 8 | u32::from(*byte)) << (8 * (3 - three.len()));
        for i in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * i) & 63) as usize];
            text.push(if i <= three.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_is_that_of_the_standard() {
        for (bytes, text) in [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")] {
            assert_eq!(base64(bytes.as_bytes()), text);
        }
    }

    #[test]
    fn markup_in_names_stays_text() {
        assert_eq!(escape("<b a='1'>\"&"), "&lt;b a=&#39;1&#39;&gt;&quot;&amp;");
    }
}
