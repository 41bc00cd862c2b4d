//! What is said about what is in a scan.

use serde::Serialize;
use std::path::PathBuf;

use super::{Mode, count, grouped, lossy, significant};
use crate::budget::Size;
use crate::inspect::{Findings, Unsaid};
use crate::mesh::Extent;
use crate::read::{Attribute, Carrier, Compression};

/// What is in a scan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InspectionReport {
    /// As it was named.
    #[serde(serialize_with = "lossy")]
    pub path: PathBuf,
    /// In words.
    pub format: String,
    /// How it is compressed, if it is.
    pub compression: Option<Compression>,
    /// Size, unpacked.
    pub bytes: u64,
    /// Faces, as the file counts them.
    pub faces: u64,
    /// Triangles that they make.
    pub triangles: u64,
    /// Vertices; of an STL, three a face.
    pub vertices: u64,
    /// What coordinates must be stored in to lose nothing: `float` or `double`.
    pub coordinates: &'static str,
    /// What a length of one is, where the format says so.
    pub unit: Option<&'static str>,
    /// What it carries beside positions and faces.
    pub attributes: Vec<Attribute>,
    /// The box that it fills.
    pub extent: Option<BoxFigures>,
    /// Counts of what it is made of and of what is wrong with it.
    #[serde(flatten)]
    pub surface: SurfaceFigures,
    /// What could not be said within the budget.
    pub unsaid: Vec<UnsaidFigure>,
    /// What a reduction would take.
    pub reduction: ReductionFigures,
    /// Worker threads.
    pub threads: usize,
    /// What `--memory` allowed.
    pub memory_budget_bytes: u64,
    /// The process's peak resident set; `None` where the system does not say.
    pub peak_rss_bytes: Option<u64>,
    /// Most bytes that spills and what was unpacked took on disk.
    pub scratch_bytes: u64,
    /// Wall-clock seconds.
    pub seconds: f64,
}

/// A box in the file's units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BoxFigures {
    /// Least coordinates.
    pub min: [f64; 3],
    /// Largest coordinates.
    pub max: [f64; 3],
    /// Length of the diagonal.
    pub diagonal: f64,
}

impl BoxFigures {
    /// Of an extent; `None` of one without a vertex in it.
    pub fn of(extent: &Extent) -> Option<BoxFigures> {
        let (min, max) = (extent.min, extent.max);
        min.is_finite().then(|| BoxFigures { min: min.to_array(), max: max.to_array(), diagonal: extent.diagonal() })
    }
}

/// Counts; `null` is what could not be said.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[allow(missing_docs)]
pub struct SurfaceFigures {
    /// Whether vertices at one place count as one.
    pub welded: bool,
    pub components: Option<u64>,
    pub borders: Option<u64>,
    pub border_edges: Option<u64>,
    pub nonmanifold_edges: Option<u64>,
    pub nonmanifold_vertices: Option<u64>,
    pub duplicate_vertices: Option<u64>,
    pub unreferenced_vertices: Option<u64>,
    pub repeated_corner_faces: u64,
    pub flat_faces: Option<u64>,
    pub short_polygons: u64,
    pub trailing_bytes: u64,
}

impl SurfaceFigures {
    /// What was found, and what the file says of itself.
    pub fn of(found: &Findings, short_polygons: u64, trailing_bytes: u64) -> SurfaceFigures {
        SurfaceFigures {
            welded: found.welded,
            components: found.components,
            borders: found.borders,
            border_edges: found.border_edges,
            nonmanifold_edges: found.nonmanifold_edges,
            nonmanifold_vertices: found.nonmanifold_vertices,
            duplicate_vertices: found.duplicate_vertices,
            unreferenced_vertices: found.unreferenced_vertices,
            repeated_corner_faces: found.repeated_corner_faces,
            flat_faces: found.flat_faces,
            short_polygons,
            trailing_bytes,
        }
    }
}

/// What could not be said, and a budget that would do.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct UnsaidFigure {
    /// What it is.
    pub what: &'static str,
    /// A `--memory` with which it can be said.
    pub memory_bytes: Option<u64>,
}

impl UnsaidFigure {
    /// With the whole budget in place of a stage's arrays.
    pub fn of(unsaid: &Unsaid, budget: impl Fn(u64) -> u64) -> UnsaidFigure {
        UnsaidFigure { what: unsaid.what, memory_bytes: unsaid.needed_bytes.map(budget) }
    }
}

/// What a reduction would take, as the program plans it; its time is an estimate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ReductionFigures {
    /// Faces of the result.
    pub faces: u64,
    /// How it would go within `--memory`; `null` where it would be refused.
    pub mode: Option<Mode>,
    /// About so many seconds on two cores.
    pub seconds: Option<f64>,
    /// The least budget in which the scan is collapsed as a whole.
    pub in_core_bytes: u64,
    /// The least budget that is not refused.
    pub least_bytes: u64,
}

impl InspectionReport {
    /// Plain lines.
    pub fn lines(&self) -> Vec<String> {
        let packed = self.compression.map_or(String::new(), |c| format!(", packed with {c}"));
        let polygons = if self.faces == self.triangles {
            String::new()
        } else {
            format!(" ({})", count(self.triangles, "triangle"))
        };
        let mut lines = vec![
            format!("scan       {}: {}{packed}, {}", self.path.display(), self.format, count(self.bytes, "byte")),
            format!(
                "counts     {}{polygons}, {}, coordinates in {}s",
                count(self.faces, "face"),
                count(self.vertices, "vertex"),
                self.coordinates
            ),
        ];
        for (carrier, word) in [(Carrier::Vertex, "vertices"), (Carrier::Face, "faces"), (Carrier::Corner, "corners")] {
            let named = self.attributes.iter().filter(|a| a.carrier == carrier);
            let named: Vec<String> = named.map(|a| format!("{} ({})", a.name, a.kind)).collect();
            if !named.is_empty() {
                lines.push(format!("carried    by {word}: {}", named.join(", ")));
            }
        }
        if let Some(BoxFigures { min, max, diagonal }) = self.extent {
            let unit = self.unit.map_or("unit not given".into(), |unit| format!("in {unit}s"));
            let sides = [0, 1, 2].map(|axis| significant(max[axis] - min[axis]));
            let [x, y, z] = [0, 1, 2].map(|axis| format!("{} to {}", min[axis], max[axis]));
            lines.push(format!(
                "extent     {} by {} by {}, diagonal {}, {unit}",
                sides[0],
                sides[1],
                sides[2],
                significant(diagonal)
            ));
            lines.push(format!("           from {x}; {y}; {z}"));
        }
        lines.extend(self.surface_lines());
        if !self.unsaid.is_empty() {
            let most = self.unsaid.iter().filter_map(|unsaid| unsaid.memory_bytes).max();
            let remedy = most.map_or(String::new(), |bytes| format!("; --memory {} would do", Size(bytes)));
            let what: Vec<&str> = self.unsaid.iter().map(|unsaid| unsaid.what).collect();
            lines.push(format!(
                "not said   {}: no room within {}{remedy}",
                what.join(", "),
                Size(self.memory_budget_bytes)
            ));
        }
        lines.push(self.reduction_line());
        let peak = self.peak_rss_bytes.map_or("unknown".into(), |bytes| Size(bytes).to_string());
        let scratch = Size(self.scratch_bytes);
        lines.push(format!("inspected  in {:.2} s, {peak} of memory at the peak, {scratch} of scratch", self.seconds));
        lines
    }

    fn surface_lines(&self) -> Vec<String> {
        let s = &self.surface;
        let surface = [
            (s.components, "component"),
            (s.borders, "border"),
            (s.border_edges, "border edge"),
            (s.nonmanifold_edges, "non-manifold edge"),
            (s.nonmanifold_vertices, "non-manifold vertex"),
        ];
        let surface: Vec<String> = surface.into_iter().filter_map(|(n, noun)| n.map(|n| count(n, noun))).collect();
        let defects = [
            (Some(s.repeated_corner_faces), "face", " with a repeated corner"),
            (s.flat_faces, "face", " without area"),
            (Some(s.short_polygons), "polygon", " of fewer than three corners"),
            (s.duplicate_vertices, "vertex", " at the place of another"),
            (s.unreferenced_vertices, "vertex", " that no face uses"),
            (Some(s.trailing_bytes), "byte", " behind the last element"),
        ];
        let defects = defects.into_iter().filter_map(|(n, noun, what)| Some((n.filter(|n| *n > 0)?, noun, what)));
        let defects: Vec<String> = defects.map(|(n, noun, what)| count(n, noun) + what).collect();
        let apart = if s.welded { "" } else { " (as the faces number them: vertices at one place count as apart)" };
        let mut lines = vec![format!("surface    {}{apart}", surface.join(", "))];
        if !defects.is_empty() {
            lines.push(format!("defects    {}", defects.join(", ")));
        }
        lines
    }

    fn reduction_line(&self) -> String {
        let r = &self.reduction;
        let here = match (r.mode, r.seconds) {
            (Some(mode), Some(seconds)) => {
                let mode = if mode == Mode::InCore { "in core" } else { "out of core" };
                format!("{mode}, about {} s on two cores", significant(seconds))
            }
            _ => "refused".into(),
        };
        format!(
            "reduction  to {} faces within {}: {here}; {} at the least, {} in core",
            grouped(r.faces),
            Size(self.memory_budget_bytes),
            Size(r.least_bytes),
            Size(r.in_core_bytes)
        )
    }
}
