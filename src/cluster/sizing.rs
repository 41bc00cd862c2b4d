//! How large cells should be: from a sample, corrected by what a pass has counted.
//!
//! A plane of area `A` crosses about `A (|nx| + |ny| + |nz|) / h²` cells of side `h`; of the cells that a surface
//! crosses, those without a vertex stay empty, which for `V` vertices spread over `C` cells leaves `C (1 − e^(−V/C))`.
//! The side is chosen so that this fills most of the table. Only basic arithmetic is used: the same on every machine.

use super::grid::{Grid, cell_key};
use super::table::{CellTable, block_key, mix};
use crate::error::Result;
use crate::mesh::Frame;
use crate::read::{Crew, Layout, Sample, Scan};
use glam::DVec3;
use rustc_hash::FxHashSet;

/// Share of the table that should fill. The sample's estimate is within 10 % on scans; the rest is margin.
const FILL: f64 = 0.78;
/// A table that is less full than this is worth another pass over the vertices.
pub(super) const SPARSE: f64 = 0.55;

/// What is known of a scan's surface, in the frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizing {
    /// Estimated area.
    pub(super) area: f64,
    /// Estimated area, each part by the 1-norm of its normal: what counts for cells. Corrected by counts.
    crossed: f64,
    vertices: f64,
    cells: f64,
    blocks: f64,
}

impl Sizing {
    /// From a sample of a scan with `triangles` faces and `vertices` vertices, for a table of `cells` cells.
    pub(super) fn of(sample: &Sample, frame: Frame, triangles: u64, vertices: u64, cells: usize) -> Self {
        let (mut area, mut crossed) = (0.0, 0.0);
        for triangle in &sample.triangles {
            let [a, b, c] = triangle.map(|p| DVec3::from(p.map(|x| frame.to_frame(x))));
            let cross = 0.5 * (b - a).cross(c - a);
            if cross.is_finite() {
                area += cross.length();
                crossed += cross.abs().element_sum();
            }
        }
        let scale = triangles as f64 / (sample.triangles.len() as f64).max(1.0);
        Sizing {
            area: area * scale,
            crossed: crossed * scale,
            vertices: (vertices as f64).max(1.0),
            cells: cells as f64,
            blocks: CellTable::block_capacity(cells) as f64,
        }
    }

    /// The side of cells, in the frame: the least whose cells and blocks are expected to fill the table as they should.
    pub(super) fn side(&self) -> f64 {
        let fits =
            |side: f64| self.occupied(side) <= FILL * self.cells && self.occupied(4.0 * side) <= FILL * self.blocks;
        let (mut low, mut high) = (Grid::finest(), 1.0);
        if fits(low) {
            return low;
        }
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if fits(middle) { high = middle } else { low = middle }
        }
        high
    }

    /// How many cells of a side are expected to hold a vertex.
    pub(super) fn occupied(&self, side: f64) -> f64 {
        let crossed = (self.crossed / (side * side)).max(1.0);
        crossed * (1.0 - decay(self.vertices / crossed))
    }

    /// Learns that at `side`, `cells` cells and `blocks` blocks hold a vertex.
    pub(super) fn learn(&mut self, side: f64, cells: f64, blocks: f64) {
        let by_cells = self.crossed_by(cells) * side * side;
        let by_blocks = self.crossed_by(blocks) * 16.0 * side * side;
        // Each count says how much surface there is at its scale; what matters is the one that is nearer its limit.
        self.crossed = if blocks / self.blocks > cells / self.cells { by_blocks } else { by_cells };
    }

    /// Makes room for a factor more of survivors.
    pub(super) fn coarsen(&mut self, factor: f64) {
        self.crossed *= factor;
    }

    /// The number of cells that must be crossed for `occupied` to hold a vertex.
    fn crossed_by(&self, occupied: f64) -> f64 {
        let (mut low, mut high) = (occupied, occupied * 64.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            let holds = middle * (1.0 - decay(self.vertices / middle));
            if holds < occupied { low = middle } else { high = middle }
        }
        high
    }
}

/// `e^−x` for x ≥ 0 within a thousandth, by ten squarings.
fn decay(x: f64) -> f64 {
    let mut y = 1.0 / (1.0 + x / 1024.0);
    for _ in 0..10 {
        y *= y;
    }
    y
}

/// Counts distinct cells and blocks of a grid that overflowed its table, from a sample of keys chosen by hash. In fixed
/// memory, and the same whatever the order of vertices.
pub(super) fn count(scan: &Scan, crew: &Crew, grid: &Grid, cells: usize) -> Result<(f64, f64)> {
    // About 8192 keys for a table's worth, so that a count is within 2 %.
    let shift = (cells / 8192).max(1).ilog2();
    let chosen = |key: u64| mix(key) >> 20 & ((1 << shift) - 1) == 0;
    let add = |(cells, blocks): &mut (FxHashSet<u64>, FxHashSet<u64>), p: &[f64; 3]| {
        if let Some(steps) = grid.steps(*p) {
            let (cell, block) = (cell_key(steps), block_key(steps));
            if chosen(cell) {
                cells.insert(cell);
            }
            if chosen(block) {
                blocks.insert(block);
            }
        }
    };
    let sets = match scan.layout() {
        Layout::Indexed => scan.vertices(crew, Default::default, |sets, chunk| {
            chunk.positions.iter().for_each(|p| add(sets, p));
            Ok(())
        })?,
        Layout::Soup => scan.soup(crew, Default::default, |sets, chunk| {
            chunk.triangles.as_flattened().iter().for_each(|p| add(sets, p));
            Ok(())
        })?,
    };
    let union = |mut a: FxHashSet<u64>, b: FxHashSet<u64>| {
        a.extend(b);
        a
    };
    let (cells, blocks) = (sets.into_iter())
        .fold((FxHashSet::default(), FxHashSet::default()), |a, b| (union(a.0, b.0), union(a.1, b.1)));
    let scale = f64::from(1u32 << shift);
    Ok((cells.len() as f64 * scale, blocks.len() as f64 * scale))
}
