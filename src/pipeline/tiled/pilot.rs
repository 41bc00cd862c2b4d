//! The cost down to which all tiles are collapsed, from pieces of the scan.

use super::search::Search;
use super::{LEAST_COST, Mill, SPARE, Threshold};
use crate::error::Result;
use crate::mesh::{Coordinate, IndexedMesh, widen};
use crate::tiles::{self, Partition};
use glam::DVec3;

/// How near to what is wanted the pilot is to come.
const NEAR_ENOUGH: f64 = 0.03;
/// Collapses of the pilot, at most.
const TURNS: u32 = 12;
/// Faces of the pilot, about.
const PILOT_FACES: u64 = 1_500_000;
/// Faces of a piece, if tiles have so many: enough for its cut border not to matter, and few enough for pieces to be
/// many. With 20,000 a pilot was 18 % off where it is 2 % off with these.
const PIECE_FACES: u64 = 6_000;
// Cubes of 2³ blocks hold fewer where blocks are small.
const _: () = assert!(8 * tiles::FEW_FACES < PIECE_FACES);
/// What a collapse costs, about, for the square of the area of a face that is left: where the search begins.
const FIRST_COST: f64 = 1e-3;
/// The part of a piece, on either side, where its cut border is felt.
const RIM: f64 = 0.15;

/// Pieces of a scan, to try thresholds on.
struct Pilot<'a, 'b, S> {
    mill: &'a Mill<'b, S>,
    mesh: IndexedMesh<S>,
    /// How many there are along the side of a block.
    pieces: f64,
    /// Faces that are to be left of each that is there, away from where pieces were cut.
    wanted: f64,
}

impl<'a, 'b, S: Coordinate> Pilot<'a, 'b, S> {
    fn of(mill: &'a Mill<'b, S>, scan: &mut Partition<S>) -> Result<Self> {
        let (mesh, pieces) = mill.pieces(scan)?;
        let before = mill.inner(&mesh, pieces).max(1) as f64;
        let wanted = SPARE * mill.asked as f64 / mill.cut.faces as f64 * before;
        Ok(Pilot { mill, mesh, pieces, wanted })
    }

    /// How many times as much as is wanted two sweeps leave; one with a floor, which leaves a second nothing to do.
    fn times(&self, threshold: Threshold) -> Result<f64> {
        let Pilot { mill, mesh, .. } = self;
        mill.run.progress.check()?;
        let first = mill.part(mesh.clone(), Default::default(), mill.cut.faces, threshold, false)?.mesh;
        if threshold.is_flat() {
            return Ok(mill.inner(&first, self.pieces) as f64 / self.wanted);
        }
        let whole = (mill.cut.faces as f64 * first.faces.len() as f64 / mesh.faces.len().max(1) as f64) as u64;
        let second = mill.part(first, Default::default(), whole, threshold, false)?.mesh;
        Ok(mill.inner(&second, self.pieces) as f64 / self.wanted)
    }

    /// Looks from the threshold `first` on, until one costs nothing.
    fn search(&self, first: Threshold) -> Result<(Threshold, Search)> {
        let (mut threshold, mut search) = (first, first.search());
        for _ in 0..TURNS {
            if !threshold.is_flat() && f64::from(threshold.cost) < LEAST_COST {
                break;
            }
            let times = self.times(threshold)?;
            search.tried(threshold.strength(), times);
            if (times - 1.0).abs() < NEAR_ENOUGH {
                break;
            }
            threshold = threshold.of_strength(search.next());
        }
        Ok((threshold, search))
    }
}

impl<S: Coordinate> Mill<'_, S> {
    /// Finds the cost down to which everything is to be collapsed; where what costs nothing is more than is to go, the
    /// share that is to stay. With what is known of how much either leaves.
    pub(super) fn pilot(&self, scan: &mut Partition<S>) -> Result<(Threshold, Search)> {
        let pilot = Pilot::of(self, scan)?;
        let area = self.cut.area() / (self.asked as f64).max(1.0);
        let cost = (FIRST_COST * area * area).max(LEAST_COST);
        let found = pilot.search(Threshold { cost: cost as f32, floor: 0.0 })?;
        if f64::from(found.0.cost) >= LEAST_COST {
            return Ok(found);
        }
        pilot.search(Threshold { cost: LEAST_COST as f32, floor: self.floor() })
    }

    /// Pieces from all over the scan, cubes of it, and how many of them there are along the side of a block.
    fn pieces(&self, scan: &mut Partition<S>) -> Result<(IndexedMesh<S>, f64)> {
        let wanted = PILOT_FACES.min(self.plan.faces / 2).max(1);
        let of_each = |count: usize| self.cut.faces / (count as u64).max(1);
        // A surface is in four of the eight parts of a block.
        let (side, pieces) = if self.blocks.are_small() {
            (4, 0.25)
        } else if of_each(4 * scan.cubes(1).len()) >= PIECE_FACES {
            (1, 2.0)
        } else {
            let enough = |side: &u32| of_each(scan.cubes(*side).len()) >= PIECE_FACES;
            let side = [1, 2].into_iter().find(enough).unwrap_or(4);
            (side, 1.0 / f64::from(side))
        };
        let cubes = scan.cubes(side);
        let parts = if pieces > 1.0 { 4 } else { 1 };
        let every = (self.cut.faces / parts / wanted).clamp(1, cubes.len().max(1) as u64) as usize;
        let mut soup: Vec<[[S; 3]; 3]> = Vec::new();
        for (cube, faces) in cubes.into_iter().skip(every / 2).step_by(every) {
            let mut faces = scan.soup(&faces)?;
            if pieces > 1.0 {
                self.keep_a_part(cube, &mut faces);
            }
            soup.extend(faces);
        }
        Ok((tiles::welded(soup, &self.blocks).0, pieces))
    }

    /// Keeps the faces in one of the eight parts of a block: drawn, by how many each has.
    fn keep_a_part(&self, block: u64, faces: &mut Vec<[[S; 3]; 3]>) {
        let part = |face: &[[S; 3]; 3]| {
            let within = self.blocks.within(centroid(face.map(widen)), 1.0);
            within.to_array().iter().fold(0, |part, x| part << 1 | usize::from(*x >= 0.5))
        };
        let mut counts = [0u64; 8];
        faces.iter().for_each(|face| counts[part(face)] += 1);
        let mut drawn = (block.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 16) % (faces.len() as u64).max(1);
        let mut chosen = 0;
        while chosen < 7 && drawn >= counts[chosen] {
            drawn -= counts[chosen];
            chosen += 1;
        }
        faces.retain(|face| part(face) == chosen);
    }

    /// Faces of pieces that are away from where these were cut.
    fn inner(&self, mesh: &IndexedMesh<S>, pieces: f64) -> usize {
        let is_inner = |face: &&[u32; 3]| {
            let within = self.blocks.within(centroid(face.map(|v| widen(mesh.positions[v as usize]))), pieces);
            within.cmpge(DVec3::splat(RIM)).all() && within.cmple(DVec3::splat(1.0 - RIM)).all()
        };
        mesh.faces.iter().filter(is_inner).count()
    }
}

fn centroid([a, b, c]: [DVec3; 3]) -> DVec3 {
    (a + b + c) / 3.0
}
