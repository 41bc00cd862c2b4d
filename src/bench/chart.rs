//! Both machines' times against faces, on logarithmic axes, as SVG.

use super::Table63;
use std::fmt::Write;

const WIDTH: f64 = 860.0;
const HEIGHT: f64 = 560.0;
const LEFT: f64 = 76.0;
const RIGHT: f64 = 24.0;
const ABOVE: f64 = 64.0;
const BELOW: f64 = 58.0;
/// Where the lines' names begin.
const KEY: f64 = 376.0;

const STYLE: &str = "text{font:13px system-ui,-apple-system,'Segoe UI',Roboto,sans-serif;fill:#454d57}\
     .title{font-size:17px;font-weight:600;fill:#1d2126}.tick{stroke:#e4e7ea}.minor{stroke:#f2f3f5}\
     .axis{stroke:#9aa3ad}.end{text-anchor:end}.middle{text-anchor:middle}polyline{fill:none;stroke-width:2.2}";

/// Points of one kind.
struct Series {
    name: String,
    colour: &'static str,
    dashed: bool,
    points: Vec<(f64, f64)>,
}

impl Table63 {
    /// The chart.
    pub fn svg(&self) -> String {
        let series = self.series();
        let all = || series.iter().flat_map(|series| &series.points);
        let axes = Axes { x: decades(all().map(|point| point.0)), y: decades(all().map(|point| point.1)) };
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" \
             aria-label=\"Seconds against faces, in Garland’s thesis and here\"><style>{STYLE}</style>\
             <rect width=\"{WIDTH}\" height=\"{HEIGHT}\" fill=\"#fff\"/>\
             <text class=\"title\" x=\"{LEFT}\" y=\"30\">Seconds to reduce, by faces</text>\
             <text x=\"{LEFT}\" y=\"50\">Table 6.3: complete decimation, files not counted; larger scans to a 500th, \
             reading and clustering counted</text>"
        );
        axes.draw(&mut svg);
        let series_count = series.len();
        for (i, series) in series.iter().enumerate() {
            series.draw(&axes, &mut svg);
            // Where times are short and models large is room.
            let y = HEIGHT - BELOW - 16.0 - 22.0 * (series_count - 1 - i) as f64;
            let dash = if series.dashed { " stroke-dasharray=\"7 5\"" } else { "" };
            _ = write!(
                svg,
                "<line x1=\"{:.0}\" x2=\"{:.0}\" y1=\"{:.1}\" y2=\"{:.1}\" stroke=\"{}\" stroke-width=\"2.2\"{dash}/>\
                 <text x=\"{:.0}\" y=\"{y:.1}\">{}</text>",
                KEY,
                KEY + 28.0,
                y - 4.5,
                y - 4.5,
                series.colour,
                KEY + 36.0,
                series.name
            );
        }
        svg + "</svg>\n"
    }

    fn series(&self) -> Vec<Series> {
        let of = |name: String, colour, dashed, points: Vec<(f64, f64)>| Series { name, colour, dashed, points };
        let here = |i: usize| self.models.iter().map(move |row| (row.faces as f64, row.complete[i].total())).collect();
        let thesis = self.models.iter().map(|row| (row.thesis.faces as f64, row.thesis.total())).collect();
        let power = |p: f64| format!("faces to the power of {p:.2}");
        let mut series = vec![
            of(format!("Garland 1999, 200 MHz: {}", power(self.exponents.thesis)), "#b3352b", false, thesis),
            of(format!("meshmill, one thread: {}", power(self.exponents.one_thread)), "#2b6a6c", false, here(0)),
            of(
                format!("meshmill, {} threads: {}", self.threads, power(self.exponents.all_threads)),
                "#5fb0a6",
                true,
                here(1),
            ),
        ];
        if !self.continued.is_empty() {
            let memory = crate::budget::Size(self.continued[0].memory_budget_bytes);
            let points = self.continued.iter().map(|row| (row.faces as f64, row.total())).collect();
            let grows = self.exponents.continued.map_or(String::new(), |p| format!(": {}", power(p)));
            series.push(of(
                format!("meshmill within {memory}, {} threads{grows}", self.threads),
                "#3b4a8c",
                false,
                points,
            ));
        }
        series
    }
}

impl Series {
    fn draw(&self, axes: &Axes, svg: &mut String) {
        let mut points: Vec<(f64, f64)> =
            self.points.iter().filter(|(_, y)| *y > 0.0).map(|(x, y)| (axes.x(*x), axes.y(*y))).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let line: String = points.iter().map(|(x, y)| format!("{x:.1},{y:.1} ")).collect();
        let dash = if self.dashed { " stroke-dasharray=\"7 5\"" } else { "" };
        _ = write!(svg, "<polyline points=\"{}\" stroke=\"{}\"{dash}/>", line.trim_end(), self.colour);
        for (x, y) in points {
            _ = write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"{}\"/>", self.colour);
        }
    }
}

/// Powers of ten around all numbers that are above zero.
fn decades(numbers: impl Iterator<Item = f64>) -> [i32; 2] {
    let logs = numbers.filter(|x| *x > 0.0).map(f64::log10);
    let [low, high] = logs.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], x| [a.min(x), b.max(x)]);
    if low > high { [0, 1] } else { [low.floor() as i32, (high.ceil() as i32).max(low.floor() as i32 + 1)] }
}

struct Axes {
    x: [i32; 2],
    y: [i32; 2],
}

impl Axes {
    fn x(&self, x: f64) -> f64 {
        LEFT + (WIDTH - LEFT - RIGHT) * share(x, self.x)
    }

    fn y(&self, y: f64) -> f64 {
        HEIGHT - BELOW - (HEIGHT - ABOVE - BELOW) * share(y, self.y)
    }

    fn draw(&self, svg: &mut String) {
        let (bottom, right) = (HEIGHT - BELOW, WIDTH - RIGHT);
        for decade in self.x[0]..=self.x[1] {
            for digit in 1..10 {
                let at = f64::from(digit) * 10f64.powi(decade);
                let x = self.x(at);
                if x > right + 0.1 {
                    break;
                }
                let class = if digit == 1 { "tick" } else { "minor" };
                _ = write!(svg, "<line class=\"{class}\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{ABOVE}\" y2=\"{bottom}\"/>");
            }
            let x = self.x(10f64.powi(decade));
            _ = write!(svg, "<text class=\"middle\" x=\"{x:.1}\" y=\"{}\">{}</text>", bottom + 20.0, faces(decade));
        }
        for decade in self.y[0]..=self.y[1] {
            let y = self.y(10f64.powi(decade));
            _ = write!(svg, "<line class=\"tick\" x1=\"{LEFT}\" x2=\"{right}\" y1=\"{y:.1}\" y2=\"{y:.1}\"/>");
            _ = write!(svg, "<text class=\"end\" x=\"{}\" y=\"{:.1}\">{}</text>", LEFT - 8.0, y + 4.5, time(decade));
        }
        _ = write!(
            svg,
            "<polyline class=\"axis\" points=\"{LEFT},{ABOVE} {LEFT},{bottom} {right},{bottom}\"/>\
             <text class=\"middle\" x=\"{}\" y=\"{}\">faces of the model</text>",
            (LEFT + right) / 2.0,
            HEIGHT - 14.0
        );
    }
}

fn share(x: f64, [low, high]: [i32; 2]) -> f64 {
    (x.log10() - f64::from(low)) / f64::from(high - low)
}

fn faces(decade: i32) -> String {
    let unit = ["", " k", " M", " G"].get(decade.max(0) as usize / 3).copied().unwrap_or(" T");
    format!("{}{unit}", 10u32.pow(decade.max(0) as u32 % 3))
}

fn time(decade: i32) -> String {
    match decade {
        ..-3 => format!("{} µs", 10u32.pow((decade + 6).max(0) as u32)),
        -3..0 => format!("{} ms", 10u32.pow((decade + 3) as u32)),
        _ => format!("{} s", 10u64.pow(decade as u32)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decades_hold_all_numbers_and_read_well() {
        assert_eq!(decades([0.0, 3.0, 250.0].into_iter()), [0, 3]);
        assert_eq!(decades([10.0].into_iter()), [1, 2]);
        assert_eq!([3, 5, 9].map(faces), ["1 k", "100 k", "1 G"]);
        assert_eq!([-4, -2, 0, 2].map(time), ["100 µs", "10 ms", "1 s", "100 s"]);
    }
}
