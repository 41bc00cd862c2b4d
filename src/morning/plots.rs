//! The night over time: when each scan ran, and what was resident.

use super::escape;
use super::words::{memory, span};
use crate::queue::{NightReport, Row, Status, local_time};
use std::fmt::Write;
use std::path::Path;

const WIDTH: f64 = 1000.0;
const HEIGHT: f64 = 190.0;
/// Room for words, left and below.
const LEFT: f64 = 70.0;
const BELOW: f64 = 24.0;
const ABOVE: f64 = 10.0;

/// Seconds that ticks may be apart.
const TICKS: [f64; 14] =
    [1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0, 7200.0, 14400.0, 86400.0];

/// What is resident of all processes, below the night's bound.
pub(super) fn memory_plot(report: &NightReport) -> String {
    let axis = Axis::of(report);
    let top = report.memory.max(report.peak_rss_bytes).max(1) as f64 * 1.08;
    let y = |bytes: u64| ABOVE + (HEIGHT - ABOVE - BELOW) * (1.0 - bytes as f64 / top);
    let mut svg = axis.begin("Memory of all processes over the night");
    let bottom = y(0);
    let mut curve = String::new();
    let mut last: Option<f64> = None;
    for &(at, bytes) in &report.resident {
        let x = axis.x(at);
        // Between two runs of a night nothing is resident.
        match last.filter(|last| x - last < 0.05 * WIDTH) {
            None => {
                if let Some(last) = last {
                    _ = write!(curve, "L{last:.1} {bottom:.1}");
                }
                _ = write!(curve, "M{x:.1} {bottom:.1}L{x:.1} {:.1}", y(bytes));
            }
            Some(_) => _ = write!(curve, "L{x:.1} {:.1}", y(bytes)),
        }
        last = Some(x);
    }
    if let Some(last) = last {
        _ = write!(curve, "L{last:.1} {bottom:.1}");
    }
    _ = write!(svg, "<path class=\"area\" d=\"{curve}\"/>");
    let (limit, peak) = (y(report.memory), y(report.peak_rss_bytes));
    let right = WIDTH;
    _ = write!(
        svg,
        "<line class=\"limit\" x1=\"{LEFT}\" x2=\"{right}\" y1=\"{limit:.1}\" y2=\"{limit:.1}\"/>\
         <text class=\"word end\" x=\"{x:.1}\" y=\"{limit_text:.1}\">{}</text>\
         <text class=\"word end\" x=\"{x:.1}\" y=\"{peak_text:.1}\">{}</text>\
         <text class=\"word end\" x=\"{x:.1}\" y=\"{bottom:.1}\">0</text>",
        memory(report.memory),
        memory(report.peak_rss_bytes),
        x = LEFT - 6.0,
        limit_text = limit + 4.0,
        peak_text = (peak + 4.0).max(limit + 20.0),
    );
    svg + "</svg>"
}

/// A bar a scan, in as many lanes as ran side by side.
pub(super) fn time_plot(report: &NightReport, name: &dyn Fn(&Path) -> String) -> String {
    let axis = Axis::of(report);
    let mut rows: Vec<&Row> = report.rows.iter().filter(|row| row.tries > 0).collect();
    rows.sort_by(|a, b| a.began.total_cmp(&b.began));
    let mut lanes: Vec<f64> = Vec::new();
    let mut placed = Vec::new();
    for row in &rows {
        let lane = lanes.iter().position(|end| *end <= row.began + 0.05).unwrap_or(lanes.len());
        if lane == lanes.len() {
            lanes.push(0.0);
        }
        lanes[lane] = row.began + row.seconds;
        placed.push(lane);
    }
    let high = (HEIGHT - ABOVE - BELOW) / lanes.len().max(1) as f64;
    let mut svg = axis.begin("Scans over the night");
    for (row, lane) in rows.iter().zip(placed) {
        let (from, to) = (axis.x(row.began), axis.x(row.began + row.seconds));
        let class = match row.status {
            Status::Done => "done",
            Status::Unmet => "unmet",
            _ => "failed",
        };
        let title = format!("{}: {}, {}", name(&row.scan), row.status.word(), span(row.seconds));
        _ = write!(
            svg,
            "<rect class=\"{class}\" x=\"{from:.2}\" y=\"{:.1}\" width=\"{:.2}\" height=\"{:.1}\" rx=\"1.5\">\
             <title>{}</title></rect>",
            ABOVE + lane as f64 * high + 0.06 * high,
            (to - from - 0.6).max(1.2),
            0.88 * high,
            escape(&title)
        );
    }
    for lane in 0..lanes.len().min(9) {
        let y = ABOVE + (lane as f64 + 0.5) * high + 4.0;
        _ = write!(svg, "<text class=\"word end\" x=\"{:.1}\" y=\"{y:.1}\">{}</text>", LEFT - 6.0, lane + 1);
    }
    svg + "</svg>"
}

struct Axis {
    from: f64,
    to: f64,
}

impl Axis {
    fn of(report: &NightReport) -> Axis {
        let times = report.rows.iter().filter(|row| row.tries > 0);
        let from = times.clone().map(|row| row.began).chain(report.resident.iter().map(|p| p.0));
        let to = times.map(|row| row.began + row.seconds).chain(report.resident.iter().map(|p| p.0));
        let from = from.fold(report.began.max(report.ended - 1.0), f64::min);
        Axis { from, to: to.fold(from + 1.0, f64::max) }
    }

    fn x(&self, at: f64) -> f64 {
        LEFT + (WIDTH - LEFT) * ((at - self.from) / (self.to - self.from)).clamp(0.0, 1.0)
    }

    fn begin(&self, label: &str) -> String {
        let mut svg = format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{label}\">");
        let length = self.to - self.from;
        let step = TICKS.into_iter().find(|step| length / step <= 9.0).unwrap_or(length / 6.0);
        for i in 0..=(length / step) as u64 {
            let at = self.from + i as f64 * step;
            let x = self.x(at);
            let time = local_time(at);
            let word = if step < 60.0 { &time[11..] } else { &time[11..16] };
            _ = write!(
                svg,
                "<line class=\"tick\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{ABOVE}\" y2=\"{:.1}\"/>\
                 <text class=\"word{}\" x=\"{x:.1}\" y=\"{:.1}\">{word}</text>",
                HEIGHT - BELOW,
                if x > WIDTH - 60.0 {
                    " end"
                } else if i > 0 {
                    " middle"
                } else {
                    ""
                },
                HEIGHT - 6.0
            );
        }
        svg
    }
}
