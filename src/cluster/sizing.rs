//! How large cells should be: from a sample, corrected by what a pass has counted.
//!
//! A plane of area `A` crosses about `A (|nx| + |ny| + |nz|) / h²` cells of side `h`; of the cells that a surface
//! crosses, those without a vertex stay empty, which for `V` vertices spread over `C` cells leaves `C (1 − e^(−V/C))`.
//! That is summed over the faces of the sample, since a scan may be dense here and coarse there, and since a stray face
//! of any size has then no more than its share of the vertices. Only basic arithmetic is used: the same on every
//! machine.

use super::table::CellTable;
use crate::mesh::Frame;
use crate::read::{Layout, Sample, Scan};
use glam::DVec3;

/// Share of the wanted cells that are aimed at: what a count from a sample of blocks is off by, on scans.
const FILL: f64 = 0.99;

/// Faces of the sample are taken together where the largest is at most this many times as large as the smallest.
const ALIKE: f64 = 1.2;

/// The least area of a face, as a share of its longest edge's square: a sliver crosses as many cells as the edge does.
const SLIVER: f64 = 1e-3;

/// A face of more than so many cells' area counts as one of that area where the mean weight of cells is estimated.
const LARGEST: f64 = 64.0;

/// What is known of a scan's surface, in the frame.
#[derive(Debug, Clone)]
pub(super) struct Sizing {
    /// Areas of the sample's faces.
    areas: Vec<f64>,
    /// The same by the 1-norm of their normals, which is what counts for cells: means of groups, and how many are in each.
    crossed: Vec<(f64, f64)>,
    /// Faces of the scan for one of the sample.
    scale: f64,
    /// Vertices for each face.
    vertices: f64,
    /// What counts have shown `crossed` to be off by.
    correction: f64,
    learnt: bool,
    cells: f64,
    blocks: f64,
}

impl Sizing {
    /// From a sample of a scan, for `cells` cells.
    pub(super) fn of(sample: &Sample, frame: Frame, scan: &Scan, cells: usize) -> Self {
        let (mut areas, mut crossed) = (Vec::new(), Vec::new());
        for triangle in &sample.triangles {
            let [a, b, c] = triangle.map(|p| frame.place(DVec3::from(p)));
            let cross = 0.5 * (b - a).cross(c - a);
            let longest_sq = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
            if longest_sq.is_finite() && cross.is_finite() {
                areas.push(cross.length());
                crossed.push(cross.abs().element_sum().max(SLIVER * longest_sq));
            }
        }
        crossed.sort_unstable_by(f64::total_cmp);
        let faces = scan.triangle_count() as f64;
        let vertices = match scan.layout() {
            Layout::Indexed => scan.vertex_count() as f64,
            // As on a closed surface.
            Layout::Soup => 0.5 * faces,
        };
        Sizing {
            crossed: groups(&crossed),
            scale: faces / (areas.len() as f64).max(1.0),
            areas,
            vertices: (vertices / faces.max(1.0)).clamp(1e-3, 3.0),
            correction: 1.0,
            learnt: false,
            cells: cells as f64,
            blocks: CellTable::block_capacity(cells) as f64,
        }
    }

    /// The side of cells, in the frame, at least `finest` and at most `longest`: the least whose cells and blocks are
    /// expected to fill the table as they should.
    pub(super) fn side(&self, finest: f64, longest: f64) -> f64 {
        let fits =
            |side: f64| self.occupied(side) <= FILL * self.cells && self.occupied(4.0 * side) <= FILL * self.blocks;
        if fits(finest) {
            return finest;
        }
        let (mut low, mut high) = (finest, longest.max(finest));
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if fits(middle) { high = middle } else { low = middle }
        }
        high
    }

    /// How many cells of a side are expected to hold a vertex.
    pub(super) fn occupied(&self, side: f64) -> f64 {
        self.occupied_if(side, self.correction)
    }

    fn occupied_if(&self, side: f64, correction: f64) -> f64 {
        let factor = correction / (side * side);
        let cells = |(crossed, faces): &(f64, f64)| faces * holding(crossed * factor, self.vertices);
        self.scale * self.crossed.iter().map(cells).sum::<f64>()
    }

    /// The surface in cells of a side. A few faces of enormous size do not count for more than many.
    pub(super) fn area(&self, side: f64) -> f64 {
        self.scale * self.areas.iter().map(|area| (area / (side * side)).min(LARGEST)).sum::<f64>()
    }

    /// Learns that at `side`, `cells` cells and `blocks` blocks hold a vertex.
    pub(super) fn learn(&mut self, side: f64, cells: f64, blocks: f64) {
        self.learnt = true;
        // A soup does not say how many vertices it has.
        let faces = self.scale * self.areas.len() as f64;
        self.vertices = self.vertices.max(1.2 * cells / faces.max(1.0));
        // Each count says how much surface there is at its scale; what matters is the one that is nearer its limit.
        self.correction = if blocks / self.blocks > cells / self.cells {
            self.correction_for(4.0 * side, blocks)
        } else {
            self.correction_for(side, cells)
        };
    }

    /// Whether more is known than what the sample says.
    pub(super) fn has_learnt(&self) -> bool {
        self.learnt
    }

    /// Expects a factor more cells.
    pub(super) fn expect(&mut self, factor: f64) {
        self.correction *= factor;
    }

    /// The correction under which `occupied` cells of `side` are expected.
    fn correction_for(&self, side: f64, occupied: f64) -> f64 {
        let (mut low, mut high) = (1e-12f64, 1e12f64);
        for _ in 0..60 {
            let middle = (low * high).sqrt();
            if self.occupied_if(side, middle) < occupied { low = middle } else { high = middle }
        }
        high
    }
}

/// Means of groups of numbers in ascending order that are alike, and how many are in each.
fn groups(numbers: &[f64]) -> Vec<(f64, f64)> {
    let mut groups = Vec::new();
    let mut rest = numbers;
    while let Some(first) = rest.first() {
        let (group, others) = rest.split_at(rest.partition_point(|x| *x <= ALIKE * first));
        groups.push((group.iter().sum::<f64>() / group.len() as f64, group.len() as f64));
        rest = others;
    }
    groups
}

/// How many of `cells` cells hold one of `vertices` vertices or more: `C (1 − e^(−V/C))`.
fn holding(cells: f64, vertices: f64) -> f64 {
    let each = vertices / cells.max(f64::MIN_POSITIVE);
    if each < 1e-2 { vertices * (1.0 - 0.5 * each) } else { cells * (1.0 - decay(each)) }
}

/// `e^−x` for x ≥ 0 within a thousandth, by ten squarings.
fn decay(x: f64) -> f64 {
    let mut y = 1.0 / (1.0 + x / 1024.0);
    for _ in 0..10 {
        y *= y;
    }
    y
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_learnt_is_what_is_expected() {
        let crossed = vec![(1e-6, 640.0), (4e-6, 300.0), (1e3, 2.0)];
        let mut sizing = Sizing {
            areas: vec![1e-6; 900],
            crossed,
            scale: 50.0,
            vertices: 0.5,
            correction: 1.0,
            learnt: false,
            cells: 1000.0,
            blocks: 100.0,
        };
        for (side, cells) in [(0.01, 700.0), (0.001, 9000.0), (0.02, 100.0)] {
            sizing.learn(side, cells, cells / 20.0);
            assert!((sizing.occupied(side) / cells - 1.0).abs() < 1e-6, "{side}");
        }
        let side = sizing.side(1e-6, 1.0);
        assert!((990.0 - sizing.occupied(side)).abs() < 1.0 || sizing.occupied(4.0 * side) > 98.0);
    }
}
