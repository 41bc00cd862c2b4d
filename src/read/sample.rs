//! A sample of a scan's triangles, for choosing a grid before anything is streamed.
//!
//! Where records have one length the sample is read past the map, run by run, which costs a few reads a run; anything else
//! costs a pass over the file. Memory is that of the sample.

use super::ply::face_error;
use super::stl::{self, Stl};
use super::stream::Run;
use super::{Body, Crew, Scan};
use crate::error::Result;

/// Consecutive triangles taken together: enough to see whether neighbours in the file are neighbours in space.
const RUN: u64 = 64;

/// Vertices in a block, as [`Sample::blocks_per_triangle`] counts them.
const BLOCK: u32 = 512;

/// Into how many parts vertices are cut for [`Sample::wide_triangles`].
const PARTS: u64 = 256;

/// Vertices that lie this close together are read at once.
const GAP_BYTES: u64 = 4096;

/// A separate read costs about as much as streaming through this many bytes.
const READ_COSTS_BYTES: u64 = 4096;

/// Triangles picked evenly over a scan.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sample {
    /// The corners of those that are finite.
    pub triangles: Vec<[[f64; 3]; 3]>,
    /// How scattered the vertices of consecutive triangles are: distinct blocks of 512 consecutive vertex numbers that
    /// runs of 64 triangles touch, divided by the triangles. About 0.05 for a scan in coherent order, up to 3 for a
    /// shuffled one, 0 for a soup.
    pub blocks_per_triangle: f64,
    /// How scattered the vertices of one triangle are: the share of triangles with two that are further apart in number
    /// than a 256th of all vertices. Nearly 0 where vertices are in a sensible order, nearly 1 where they are shuffled, 0 for
    /// a soup.
    pub wide_triangles: f64,
}

impl Scan {
    /// Picks about `triangles` triangles in runs of 64, spread evenly over the file; all of them if there are no more.
    pub fn sample(&self, crew: &Crew<'_>, triangles: usize) -> Result<Sample> {
        let runs = Runs::new(self.triangle_count(), triangles as u64);
        match &self.body {
            Body::Stl(stl) => Ok(Sample { triangles: self.sample_soup(crew, stl, &runs)?, ..Sample::default() }),
            _ => {
                let corners = self.sample_corners(crew, &runs)?;
                let mut vertices = corners.as_flattened().to_vec();
                vertices.sort_unstable();
                vertices.dedup();
                let positions = self.positions(crew, &vertices)?;
                let at = |v: u32| vertices.binary_search(&v).map_or([f64::NAN; 3], |i| positions[i]);
                let triangles = corners.iter().map(|t| t.map(at)).filter(is_finite).collect();
                let blocks_per_triangle = runs.blocks_per_triangle(&corners);
                let is_wide = |t: &&[u32; 3]| {
                    u64::from(t[0].max(t[1]).max(t[2]) - t[0].min(t[1]).min(t[2])) * PARTS > self.vertex_count()
                };
                let wide_triangles = corners.iter().filter(is_wide).count() as f64 / (corners.len() as f64).max(1.0);
                Ok(Sample { triangles, blocks_per_triangle, wide_triangles })
            }
        }
    }

    fn sample_soup(&self, crew: &Crew<'_>, stl: &Stl, runs: &Runs) -> Result<Vec<[[f64; 3]; 3]>> {
        let Some(run) = &stl.run else {
            let picked = self.soup(crew, Vec::new, |picked, chunk| {
                runs.pick(chunk.first, chunk.triangles, picked);
                Ok(())
            })?;
            return Ok(in_order(picked));
        };
        let (mut bytes, mut decoded, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
        for (first, len) in runs.iter() {
            crew.progress.check()?;
            self.read_records(run, first, len, &mut bytes)?;
            stl::decode(&bytes, &mut decoded);
            triangles.extend(decoded.iter().copied().filter(is_finite));
        }
        Ok(triangles)
    }

    fn sample_corners(&self, crew: &Crew<'_>, runs: &Runs) -> Result<Vec<[u32; 3]>> {
        let Some((run, record)) = self.ply().and_then(|ply| ply.triangle_run.as_ref()) else {
            let picked = self.triangles(crew, Vec::new, |picked, chunk| {
                runs.pick(chunk.first, chunk.triangles, picked);
                Ok(())
            })?;
            return Ok(in_order(picked));
        };
        let (mut bytes, mut decoded, mut triangles) = (Vec::new(), Vec::new(), Vec::new());
        for (first, len) in runs.iter() {
            crew.progress.check()?;
            self.read_records(run, first, len, &mut bytes)?;
            record
                .decode(&bytes, self.vertex_count(), &mut decoded)
                .map_err(|bad| face_error(&self.input, run, first, bad))?;
            triangles.extend_from_slice(&decoded);
        }
        Ok(triangles)
    }

    /// The positions of these vertices, which are in ascending order: by separate reads if those are cheaper than a pass.
    fn positions(&self, crew: &Crew<'_>, vertices: &[u32]) -> Result<Vec<[f64; 3]>> {
        let Some((run, record)) = self.ply().and_then(|ply| ply.vertex_run.as_ref()) else {
            return self.positions_by_pass(crew, vertices);
        };
        let near = (GAP_BYTES / run.stride as u64).max(1) as u32;
        let groups = || vertices.chunk_by(|a, b| b - a <= near).flat_map(|group| group.chunks(1024));
        if groups().count() as u64 * READ_COSTS_BYTES > run.count.saturating_mul(run.stride as u64) {
            return self.positions_by_pass(crew, vertices);
        }
        let (mut bytes, mut decoded) = (Vec::new(), Vec::new());
        let mut positions = Vec::with_capacity(vertices.len());
        for group in groups() {
            crew.progress.check()?;
            let (first, last) = (group[0], group[group.len() - 1]);
            self.read_records(run, first.into(), u64::from(last - first) + 1, &mut bytes)?;
            record.decode(&bytes, &mut decoded);
            positions.extend(group.iter().map(|v| decoded[(v - first) as usize]));
        }
        Ok(positions)
    }

    fn positions_by_pass(&self, crew: &Crew<'_>, vertices: &[u32]) -> Result<Vec<[f64; 3]>> {
        let picked = self.vertices(crew, Vec::new, |picked: &mut Vec<(u64, [f64; 3])>, chunk| {
            let end = chunk.first + chunk.positions.len() as u64;
            let from = vertices.partition_point(|&v| u64::from(v) < chunk.first);
            let here = vertices[from..].iter().map(|&v| u64::from(v)).take_while(|v| *v < end);
            picked.extend(here.map(|v| (v, chunk.positions[(v - chunk.first) as usize])));
            Ok(())
        })?;
        Ok(in_order(picked))
    }

    fn read_records(&self, run: &Run, first: u64, len: u64, bytes: &mut Vec<u8>) -> Result<()> {
        bytes.resize(len as usize * run.stride, 0);
        self.input.read_at(bytes, run.byte(first))
    }
}

fn is_finite(triangle: &[[f64; 3]; 3]) -> bool {
    triangle.as_flattened().iter().all(|x| x.is_finite())
}

/// What the workers picked, in the order of the file.
fn in_order<T>(picked: Vec<Vec<(u64, T)>>) -> Vec<T> {
    let mut picked: Vec<_> = picked.into_iter().flatten().collect();
    picked.sort_unstable_by_key(|(ordinal, _)| *ordinal);
    picked.into_iter().map(|(_, what)| what).collect()
}

/// The runs that a sample consists of.
struct Runs {
    total: u64,
    runs: u64,
}

impl Runs {
    fn new(total: u64, asked: u64) -> Self {
        Runs { total, runs: if asked >= total { total.div_ceil(RUN) } else { (asked / RUN).max(1) } }
    }

    /// The first triangle of run `i`. Runs do not overlap.
    fn start(&self, i: u64) -> u64 {
        if self.runs == self.total.div_ceil(RUN) {
            return i * RUN;
        }
        let last = u128::from(self.total - RUN);
        match self.runs {
            1 => (last / 2) as u64,
            runs => (last * u128::from(i) / u128::from(runs - 1)) as u64,
        }
    }

    /// First triangle and length of each run.
    fn iter(&self) -> impl Iterator<Item = (u64, u64)> + '_ {
        (0..self.runs).map(|i| (self.start(i), RUN.min(self.total - self.start(i))))
    }

    /// Takes what of a chunk is in a run.
    fn pick<T: Copy>(&self, first: u64, chunk: &[T], picked: &mut Vec<(u64, T)>) {
        let end = first + chunk.len() as u64;
        let (mut low, mut high) = (0, self.runs);
        while low < high {
            let middle = low.midpoint(high);
            if self.start(middle) + RUN <= first { low = middle + 1 } else { high = middle }
        }
        let from = |i: u64| self.start(i).clamp(first, end);
        let to = |i: u64| (self.start(i) + RUN).clamp(first, end);
        for i in (low..self.runs).take_while(|&i| self.start(i) < end) {
            picked.extend((from(i)..to(i)).map(|ordinal| (ordinal, chunk[(ordinal - first) as usize])));
        }
    }

    fn blocks_per_triangle(&self, corners: &[[u32; 3]]) -> f64 {
        let (mut blocks, mut begin) = (0, 0);
        let mut touched = Vec::new();
        for (_, len) in self.iter() {
            let run = &corners[begin..(begin + len as usize).min(corners.len())];
            begin += run.len();
            touched.clear();
            touched.extend(run.as_flattened().iter().map(|v| v / BLOCK));
            touched.sort_unstable();
            touched.dedup();
            blocks += touched.len();
        }
        blocks as f64 / (corners.len() as f64).max(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_within_the_scan_and_apart() {
        for total in [1, 2, 63, 64, 65, 127, 128, 129, 1_000, 4_096, 65_537] {
            for asked in [1, 63, 64, 100, 128, 129, 1_000, 4_095, 4_096, 70_000] {
                let runs: Vec<_> = Runs::new(total, asked).iter().collect();
                assert!(runs.iter().all(|(first, len)| *len > 0 && first + len <= total), "{total} {asked}");
                assert!(runs.windows(2).all(|w| w[0].0 + w[0].1 <= w[1].0), "{total} {asked}: {runs:?}");
                let picked: u64 = runs.iter().map(|r| r.1).sum();
                assert!(picked <= asked.max(RUN) && (asked < total || picked == total), "{total} {asked}");
            }
        }
    }

    #[test]
    fn picking_from_chunks_is_picking_from_the_whole() {
        let all: Vec<u64> = (0..5_000).collect();
        for asked in [1, 64, 640, 2_000, 5_000] {
            let runs = Runs::new(5_000, asked);
            let naive: Vec<u64> = runs.iter().flat_map(|(first, len)| first..first + len).collect();
            for size in [1, 7, 64, 100, 4_999, 5_000] {
                let mut picked = Vec::new();
                for (i, chunk) in all.chunks(size).enumerate() {
                    runs.pick((i * size) as u64, chunk, &mut picked);
                }
                assert_eq!(in_order(vec![picked]), naive, "{asked} by {size}");
            }
        }
    }
}
