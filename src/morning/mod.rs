//! The morning: a night's report as files that people and scripts read.
//!
//! `report.html` is one file that needs nothing else, neither network nor pictures beside it; `report.json` has all facts and
//! `report.csv` a line a result. What is written into the page passes through `escape`: names of files are not to be
//! trusted with markup.

mod page;
mod plots;
mod table;
mod words;

use crate::error::Result;
use crate::progress::Progress;
use crate::queue::{NightReport, Shard};
use crate::report::json;
use crate::write::WholeFile;
use std::path::{Path, PathBuf};

/// Writes the three files into `folder`; those of a shard have its number in their names. Where the page is.
pub fn write(report: &NightReport, folder: &Path, shard: Option<Shard>) -> Result<PathBuf> {
    let part = shard.map_or(String::new(), |Shard { number, of }| format!(".{number}-of-{of}"));
    let progress = Progress::default();
    let file = |ending: &str| WholeFile::prepare(&folder.join(format!("report{part}.{ending}")), None);
    let text = format!("{}\n", json(report));
    file("json")?.write(text.as_bytes(), &progress)?;
    file("csv")?.write(table::csv(report).as_bytes(), &progress)?;
    let html = file("html")?;
    html.write_by(&progress, |sink| page::write(report, folder, &mut |text| sink.put(text.as_bytes())))?;
    Ok(folder.join(format!("report{part}.html")))
}

/// Text as HTML has it, within elements and in quoted attributes.
fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            c => escaped.push(c),
        }
    }
    escaped
}
