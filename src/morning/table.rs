//! `report.csv`: a line a result, or a line a scan that has none.

use crate::queue::{NightReport, Row, local_time};
use serde_json::Value;

const COLUMNS: [&str; 27] = [
    "scan",
    "status",
    "result",
    "scan_faces",
    "scan_vertices",
    "scan_bytes",
    "faces",
    "vertices",
    "bytes",
    "mode",
    "began",
    "seconds",
    "tries",
    "peak_rss_bytes",
    "memory_budget_bytes",
    "error_estimate",
    "e_avg",
    "e_max",
    "mean",
    "rms",
    "max",
    "diagonal",
    "warnings",
    "error_code",
    "error",
    "repeat",
    "blake3",
];

/// The table, as RFC 4180 has it.
pub(super) fn csv(report: &NightReport) -> String {
    let mut text = COLUMNS.join(",") + "\r\n";
    for row in &report.rows {
        for level in 0..row.outputs.len().max(1) {
            let cells = cells(row, level);
            text += &cells.map(|cell| quoted(&cell)).join(",");
            text += "\r\n";
        }
    }
    text
}

fn cells(row: &Row, level: usize) -> [String; 27] {
    let of = |pointer: &str| row.fact(pointer).map_or(String::new(), plain);
    let base = if level == 0 { String::new() } else { format!("/coarser/{}", level - 1) };
    let result = |key: &str| of(&format!("{base}/{key}"));
    let output = row.outputs.get(level);
    let print = output.and_then(|output| output.print.as_ref());
    let some = |x: Option<u64>| x.map_or(String::new(), |x| x.to_string());
    let error = |of: fn(&crate::queue::Trouble) -> &str| row.error.as_ref().map_or(String::new(), |e| of(e).into());
    [
        row.scan.display().to_string(),
        row.status.word().into(),
        output.map_or(String::new(), |output| output.path.display().to_string()),
        of("/input/faces"),
        of("/input/vertices"),
        some(row.input.as_ref().map(|input| input.bytes)),
        result("output/faces"),
        result("output/vertices"),
        some(print.map(|print| print.bytes)),
        of("/mode"),
        if row.tries > 0 { local_time(row.began) } else { String::new() },
        format!("{:.3}", row.seconds),
        row.tries.to_string(),
        some(row.peak_rss_bytes),
        row.budget.to_string(),
        result("error_estimate"),
        result("deviation/e_avg"),
        result("deviation/e_max"),
        result("deviation/mean"),
        result("deviation/rms"),
        result("deviation/max"),
        result("deviation/diagonal"),
        row.all_warnings().join("; "),
        error(|e| &e.code),
        error(|e| &e.message),
        row.repeat.clone(),
        print.and_then(|print| print.blake3.clone()).unwrap_or_default(),
    ]
}

fn plain(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), String::from)
}

fn quoted(cell: &str) -> String {
    // A cell that a spreadsheet would take for a formula is not to be one.
    let formula = cell.starts_with(['=', '+', '@']) || cell.starts_with('-') && cell.parse::<f64>().is_err();
    let cell = if formula { format!("'{cell}") } else { cell.into() };
    if cell.contains([',', '"', '\n', '\r']) { format!("\"{}\"", cell.replace('"', "\"\"")) } else { cell }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_survive_commas_quotes_and_spreadsheets() {
        assert_eq!(quoted("a,b"), "\"a,b\"");
        assert_eq!(quoted("say \"hi\""), "\"say \"\"hi\"\"\"");
        assert_eq!((quoted("=1+1"), quoted("-1.5"), quoted("-x")), ("'=1+1".into(), "-1.5".into(), "'-x".into()));
    }
}
