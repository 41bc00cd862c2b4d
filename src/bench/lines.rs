//! The tables, as text.

use super::{BYTES_A_VERTEX, ContinuedRow, Floor, Group, ModelRow, Seconds, Table63};
use crate::budget::Size;
use crate::report::{Mode, count};

impl Table63 {
    /// Everything, for people.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = self.table();
        lines.extend(self.curves());
        lines.extend(self.beside());
        lines.extend(self.further());
        lines
    }

    /// Table 6.3.
    fn table(&self) -> Vec<String> {
        let threads = count(self.threads as u64, "thread");
        let mut lines = vec![
            "Table 6.3: seconds of complete decimation to 0 faces, without input and output".into(),
            format!(
                "{:12} {:>10} {:>8} {:>8} {:>8} | {:>10} {:>8} {:>8} {:>8} {:>6} | {:>8}",
                "",
                "faces",
                "init.",
                "simpl.",
                "total",
                "faces",
                "init.",
                "simpl.",
                "total",
                "÷",
                format!("{threads}")
            ),
        ];
        for ModelRow { thesis, file, faces, complete: [one, all], .. } in &self.models {
            lines.push(format!(
                "{:12} {:>10} {:>8} {:>8} {:>8} | {:>10} {:>8} {:>8} {:>8} {:>6} | {:>8}{}",
                thesis.model,
                thesis.faces,
                seconds(thesis.initialisation),
                seconds(thesis.simplification),
                seconds(thesis.total()),
                faces,
                seconds(one.initialisation),
                seconds(one.simplification),
                seconds(one.total()),
                format!("{:.0}", thesis.total() / one.total().max(1e-9)),
                seconds(all.total()),
                if file.is_none() { "  made" } else { "" }
            ));
        }
        lines.push(format!(
            "time grows like faces to the power of {:.2} in the thesis; here {:.2} on one thread, {:.2} on {threads} (Figure 6.5)",
            self.exponents.thesis, self.exponents.one_thread, self.exponents.all_threads
        ));
        lines
    }

    /// Figures 6.2 to 6.4 and 6.6.
    fn curves(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (group, title) in [
            (Group::Small, "Figure 6.2: seconds by output size, small models, one thread, refit where there is one"),
            (Group::Medium, "Figure 6.3: medium models"),
            (Group::Large, "Figure 6.4: large models"),
        ] {
            lines.extend([String::new(), title.to_string()]);
            let rows = self.models.iter().filter(|row| row.group == group);
            lines.extend(rows.map(|row| curve_line(row.thesis.model, &row.curve)));
        }
        lines.extend([String::new(), "Figure 6.6: placement policies on the bunny, one thread".into()]);
        lines.extend(self.policies.iter().map(|policy| curve_line(policy.policy, &policy.curve)));
        lines
    }

    fn beside(&self) -> Vec<String> {
        vec![
            String::new(),
            format!(
                "memory: {:.0} bytes a vertex at the peak of the largest model; {BYTES_A_VERTEX} in the thesis (Table 6.2)",
                self.bytes_a_vertex
            ),
            floor_line(&self.floor),
        ]
    }

    fn further(&self) -> Vec<String> {
        let Some(first) = self.continued.first() else { return Vec::new() };
        let mut lines = vec![
            String::new(),
            format!(
                "Further: within {}, {}; read and cluster, collapse and refit; writing not counted",
                Size(first.memory_budget_bytes),
                count(self.threads as u64, "thread")
            ),
            format!(
                "{:>12} {:>9} {:11} {:>8} {:>8} {:>8} {:>8} {:>9} {:>9} {:>10}",
                "faces", "to", "", "init.", "simpl.", "total", "ns/face", "peak", "scratch", "floor 1, 2"
            ),
        ];
        lines.extend(self.continued.iter().map(further_line));
        if let Some(exponent) = self.exponents.continued {
            lines.push(format!("out of core time grows like faces to the power of {exponent:.2}"));
        }
        lines
    }
}

fn further_line(row: &ContinuedRow) -> String {
    let mode = if row.mode == Mode::InCore { "in core" } else { "out of core" };
    let floor = |of: fn(&Floor) -> f64| row.floor.as_ref().map_or("–".into(), |floor| seconds(of(floor)));
    format!(
        "{:>12} {:>9} {mode:11} {:>8} {:>8} {:>8} {:>8.0} {:>9} {:>9} {}, {}",
        row.faces,
        row.target,
        seconds(row.initialisation()),
        seconds(row.simplification()),
        seconds(row.total()),
        1e9 * row.total() / row.faces.max(1) as f64,
        row.peak_rss_bytes.map_or("–".into(), |bytes| Size(bytes).to_string()),
        Size(row.scratch_bytes).to_string(),
        floor(|floor| floor.one_thread),
        floor(|floor| floor.two_threads),
    )
}

fn floor_line(floor: &Floor) -> String {
    let rate =
        |seconds: f64| format!("{} s ({:.0} M a second)", self::seconds(seconds), floor.faces as f64 / seconds / 1e6);
    format!(
        "floor: a pass that reads the corners of {} in the mapped file and adds up areas: {} on one thread, {} on two",
        count(floor.faces, "face"),
        rate(floor.one_thread),
        rate(floor.two_threads)
    )
}

/// Totals by output size, the model itself first.
fn curve_line(name: &str, curve: &[Seconds]) -> String {
    let begin = curve.first().map(|first| format!("init. {}", seconds(first.initialisation)));
    let points = curve.iter().map(|point| format!("{}: {}", point.faces, seconds(point.total())));
    let points: Vec<String> = begin.into_iter().chain(points).collect();
    format!("{name:18} {}", points.join("  "))
}

/// Three digits.
fn seconds(x: f64) -> String {
    match x {
        x if x >= 100.0 => format!("{x:.0}"),
        x if x >= 10.0 => format!("{x:.1}"),
        x if x >= 1.0 => format!("{x:.2}"),
        x if x >= 0.1 => format!("{x:.3}"),
        _ => format!("{x:.4}"),
    }
}
