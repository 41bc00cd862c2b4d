//! Results that are too large for clustering: collapsed tile by tile on scratch (`tiles`), by one cost for all.
//!
//! 1. The scan is cut up.
//! 2. A *pilot*, pieces from all over the scan in memory together, is collapsed by one cost after another until the share of faces is
//!    left that is wanted, and a little more: that cost is for all tiles. A quota for each would thin rough parts and flat
//!    ones alike.
//! 3. A first sweep collapses every tile of the scan to that cost. Vertices at the cuts stay, as dense as they were. Samples
//!    of the scan go along, each near a vertex.
//! 4. A second sweep, whose tiles are shifted by half, does the same to what is left, so that it thins what was cut before, and
//!    tells what it would collapse next.
//! 5. Of those collapses, none of which touches another, the cheapest are taken that bring the count to the one asked for.
//!    Each tile is refitted to its samples, and they are joined.
//!
//! Where the second sweep leaves too much another follows; where it leaves too little all is begun again, with a lower cost.

use super::{Clock, Intermediate, Run, Source, read_crew};
use crate::collapse::{self, Carried, Collapsed, Part, Proposal, collapse};
use crate::error::{Error, Result};
use crate::facets::{Stream, Stride};
use crate::mesh::samples::{Lattice, SurfaceSample};
use crate::mesh::{Coordinate, Frame, IndexedMesh, SurfaceSamples, Wedges, widen};
use crate::plan::TilePlan;
use crate::progress::Stage;
use crate::refit::{Aim, Held, refit};
use crate::scratch::{Scratch, ScratchFile};
use crate::tiles::{self, Blocks, Cut, Lie, Partition, SampleStore};
use glam::DVec3;
use rustc_hash::FxHashMap;
use std::collections::BTreeMap;
use std::time::Instant;

/// How many times as many faces as are asked for the sweeps are to leave for the last collapses. The pilot is within a tenth.
const SPARE: f64 = 1.25;
/// How near to that the pilot is to come.
const NEAR_ENOUGH: f64 = 0.03;
/// Collapses of the pilot, at most.
const PILOT_TURNS: u32 = 12;
/// Faces of the pilot, about.
const PILOT_FACES: u64 = 1_500_000;
/// Faces of a piece, if tiles have so many: enough for its cut border not to matter.
const PIECE_FACES: u64 = 20_000;
/// The cost of a collapse goes with the cube of the area that a face stands for.
const COST_POWER: f64 = 3.0;
/// What a collapse costs, about, for the square of the area of a face that is left: where the search begins.
const FIRST_COST: f64 = 1e-3;
/// The part of a piece, on either side, where its cut border is felt.
const RIM: f64 = 0.15;
/// Sweeps, and beginnings, at most.
const MOST_SWEEPS: u32 = 12;

/// What was counted.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct TileStats {
    /// Tiles of the last sweep.
    pub tiles: u64,
    /// Faces of the scan that repeat a corner.
    pub repeated_corner_faces: u64,
    /// The largest estimated error, in the frame.
    pub error: f64,
    /// Seconds of cutting up the scan.
    pub cut_seconds: f64,
    /// Seconds of the last step: what was left to choose, refit, joining.
    pub refit_seconds: f64,
}

/// What stays the same from sweep to sweep.
struct Mill<'a, S> {
    run: &'a Run<'a>,
    plan: TilePlan,
    asked: u64,
    frame: Frame,
    blocks: Blocks,
    lattice: Lattice,
    scan: Partition<S>,
    cut: Cut,
}

/// What all tiles go by.
#[derive(Debug, Clone, Copy)]
struct Threshold {
    cost: f32,
    /// Whether next to nothing costs anything, so that tiles are held to their share.
    held_to_share: bool,
}

/// A mesh between two sweeps.
struct Between<S> {
    mesh: Partition<S>,
    samples: SampleStore<S>,
    faces: u64,
}

/// Tiles after a sweep that told what it would do next.
struct Tiled<S> {
    file: ScratchFile,
    tiles: Vec<Kept>,
    proposals: Vec<Offer<S>>,
    faces: u64,
    error: f64,
}

/// Where a tile is on scratch, and how much of it there is.
struct Kept {
    offset: u64,
    vertices: usize,
    faces: usize,
    locked: usize,
    samples: usize,
}

/// A collapse that could be done in a tile.
struct Offer<S> {
    tile: u32,
    proposal: Proposal<S>,
}

impl Run<'_> {
    /// Reduces in tiles, to the end.
    pub(super) fn tiled<S: Coordinate>(&self, asked: u64, plan: TilePlan) -> Result<Intermediate<S>> {
        let mut clock = Clock::new(Instant::now());
        let mill = Mill::cut_up(self, asked, plan)?;
        let cut_seconds = clock.lap();
        if mill.cut.faces == 0 {
            return Err(Error::input(self.scan.path(), "has no usable face: none has three distinct corners"));
        }
        let tiled = mill.grind()?;
        clock.lap();
        let stats = TileStats {
            tiles: tiled.tiles.len() as u64,
            repeated_corner_faces: self.scan.triangle_count() - mill.cut.faces,
            error: tiled.error,
            cut_seconds,
            refit_seconds: 0.0,
        };
        let mesh = mill.finish(tiled)?;
        let source = Source::Tiled(TileStats { refit_seconds: clock.lap(), ..stats });
        Ok(Intermediate { mesh, frame: mill.frame, carried: None, outfit: None, samples: None, source })
    }
}

impl<'a, S: Coordinate> Mill<'a, S> {
    fn cut_up(run: &'a Run<'a>, asked: u64, plan: TilePlan) -> Result<Self> {
        let (scan, crew) = (run.scan, read_crew(&run.purse, run.progress));
        run.progress.begin(Stage::Read, 3 * scan.bytes());
        let extent = tiles::extent(scan, &crew)?;
        let frame = Frame::of(&extent);
        let Some(blocks) = tiles::blocks(scan, &crew, (frame, &extent), plan.faces)? else {
            let what =
                format!("{}: so many faces lie together that no tile of them fits this budget", scan.path().display());
            return Err(Error::Budget { what, needed_bytes: run.purse.in_core_budget::<S>(scan) });
        };
        let partition = Partition::new(blocks, plan.writer_bytes, &run.scratch)?;
        let stream = Stream::<S>::open(scan, &crew, &run.scratch, frame, Stride::new(1, 1), plan.position_bytes)?;
        let cutters = stream.faces(&crew, false, || partition.writer())?;
        let cut = Cut::sum(cutters.into_iter().map(|cutter| cutter.finish()).collect::<Result<Vec<_>>>()?);
        let place = |p: DVec3| DVec3::from(p.to_array().map(|x| frame.to_frame(x)));
        let lattice = Lattice::over(place(extent.min), place(extent.max));
        Ok(Mill { run, plan, asked, frame, blocks, lattice, scan: partition, cut })
    }

    fn scratch(&self) -> &Scratch {
        &self.run.scratch
    }

    /// All sweeps, until one more choice gives the count.
    fn grind(&self) -> Result<Tiled<S>> {
        let mut threshold = self.pilot()?;
        self.run.progress.begin(Stage::Collapse, self.cut.faces.saturating_sub(self.asked));
        let mut between = self.first_sweep(threshold)?;
        let mut lie = Lie::Shifted;
        for _ in 0..MOST_SWEEPS {
            let tiled = self.sweep(&between, threshold, lie)?;
            let removable: u64 = tiled.proposals.iter().map(|offer| u64::from(offer.proposal.faces)).sum();
            let off = tiled.faces as f64 / (SPARE * self.asked as f64);
            if tiled.faces < self.asked {
                threshold.cost *= (off.powf(COST_POWER) as f32).max(1e-6);
                between = self.first_sweep(threshold)?;
                lie = Lie::Shifted;
            } else if tiled.faces.saturating_sub(removable) > self.asked {
                threshold.cost *= off.max(1.05).powf(COST_POWER) as f32;
                between = self.put_back(tiled)?;
                lie = lie.other();
            } else {
                return Ok(tiled);
            }
        }
        let what = format!("{} faces cannot be reached in tiles", self.asked);
        Err(Error::Unmet { file: self.run.job.input.clone(), what })
    }

    /// Collapses a part of a mesh of `whole` faces.
    fn part(
        &self,
        mesh: IndexedMesh<S>,
        (locked, homes): (Vec<u32>, Vec<u32>),
        whole: u64,
        threshold: Threshold,
        proposes: bool,
    ) -> Result<Collapsed<S>> {
        let share = self.asked as f64 / whole.max(1) as f64;
        let target = (share * mesh.faces.len() as f64).ceil() as usize;
        let least = if threshold.held_to_share { (SPARE * share * mesh.faces.len() as f64).ceil() as usize } else { 0 };
        let options = collapse::Options {
            policies: self.run.job.policies.in_frame(self.frame),
            part: Some(Part { most_cost: threshold.cost, least, proposes }),
            ..collapse::Options::to(target)
        };
        collapse(mesh, Some(Carried { homes, locked, ..Carried::default() }), &options, &self.run.progress.unseen())
    }

    /// Finds the cost down to which everything is to be collapsed.
    fn pilot(&self) -> Result<Threshold> {
        let (mesh, pieces) = self.pieces()?;
        let before = self.inner(&mesh, pieces).max(1) as f64;
        let wanted = SPARE * self.asked as f64 / self.cut.faces as f64;
        let area = self.cut.area() / (self.asked as f64).max(1.0);
        let mut cost = (FIRST_COST * area * area).max(f64::from(f32::MIN_POSITIVE));
        let (mut low, mut high) = (0.0f64, f64::INFINITY);
        for _ in 0..PILOT_TURNS {
            self.run.progress.check()?;
            let threshold = Threshold { cost: cost as f32, held_to_share: false };
            let first = self.part(mesh.clone(), Default::default(), self.cut.faces, threshold, false)?.mesh;
            let whole = (self.cut.faces as f64 * first.faces.len() as f64 / mesh.faces.len().max(1) as f64) as u64;
            let second = self.part(first, Default::default(), whole, threshold, false)?.mesh;
            let off = self.inner(&second, pieces) as f64 / before / wanted;
            if (off - 1.0).abs() < NEAR_ENOUGH {
                break;
            }
            (low, high) = if off > 1.0 { (cost, high) } else { (low, cost) };
            let next = cost * off.powf(COST_POWER).clamp(1e-4, 1e4);
            cost = if next <= low || next >= high {
                (low.max(1e-6 * high) * high.min(1e6 * low.max(f64::MIN_POSITIVE))).sqrt()
            } else {
                next
            };
            if cost < f64::from(f32::MIN_POSITIVE) {
                return Ok(Threshold { cost: f32::MIN_POSITIVE, held_to_share: true });
            }
        }
        Ok(Threshold { cost: cost as f32, held_to_share: false })
    }

    /// Pieces from all over the scan, cubes of it, and how many of them there are along the side of a block.
    fn pieces(&self) -> Result<(IndexedMesh<S>, f64)> {
        let wanted = PILOT_FACES.min(self.plan.faces / 2).max(1);
        let by_block = self.scan.by_block();
        let cubes = |side: u32| {
            let mut cubes: BTreeMap<u64, Vec<tiles::Run>> = BTreeMap::new();
            by_block.iter().for_each(|(block, runs)| cubes.entry(tiles::cube(*block, side)).or_default().extend(runs));
            cubes
        };
        let of_each = |count: usize| self.cut.faces / (count as u64).max(1);
        // A surface is in four of the eight parts of a block.
        let (cubes, pieces) = if of_each(4 * by_block.len()) >= PIECE_FACES {
            (cubes(1), 2.0)
        } else {
            let cubes_of = |side: u32| (cubes(side), 1.0 / f64::from(side));
            let enough = |(cubes, _): &(BTreeMap<u64, Vec<tiles::Run>>, f64)| of_each(cubes.len()) >= PIECE_FACES;
            [1, 2].into_iter().map(cubes_of).find(enough).unwrap_or_else(|| cubes_of(4))
        };
        let parts = if pieces > 1.0 { 4 } else { 1 };
        let every = (self.cut.faces / parts / wanted).max(1) as usize;
        let mut soup: Vec<[[S; 3]; 3]> = Vec::new();
        for (cube, runs) in cubes.into_iter().skip(every / 2).step_by(every) {
            let mut faces = self.scan.soup(&runs)?;
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

    /// Collapses the tiles of the scan.
    fn first_sweep(&self, threshold: Threshold) -> Result<Between<S>> {
        let mut between = self.nothing_between()?;
        let rate = self.plan.samples as f64 / self.cut.area().max(f64::MIN_POSITIVE);
        let lie = Lie::Straight;
        for (tile, place) in self.scan.tiles(lie) {
            if place.faces() > self.plan.faces {
                let path = self.run.scan.path().display();
                let what = format!("{path}: a tile has {} faces, more than fit this budget", place.faces());
                return Err(Error::Budget { what, needed_bytes: self.run.purse.in_core_budget::<S>(self.run.scan) });
            }
            let tiles::Tile { mesh, locked, .. } = self.scan.load(lie, tile, &place)?;
            let mut samples = tiles::draw(&mesh, &self.lattice, rate);
            let homes = samples.iter().map(|sample| sample.near).collect();
            let collapsed = self.part(mesh, (locked, homes), self.cut.faces, threshold, false)?;
            follow(&mut samples, &collapsed.homes);
            self.run.progress.add(place.faces() - collapsed.mesh.faces.len() as u64);
            between.add(&self.blocks, &collapsed.mesh, &samples)?;
        }
        Ok(between)
    }

    fn nothing_between(&self) -> Result<Between<S>> {
        let bytes = self.plan.writer_bytes;
        let samples = SampleStore::new(bytes, self.scratch())?;
        Ok(Between { mesh: Partition::new(self.blocks, bytes, self.scratch())?, samples, faces: 0 })
    }

    /// Collapses the tiles of what another sweep has left, and asks what would be next.
    fn sweep(&self, between: &Between<S>, threshold: Threshold, lie: Lie) -> Result<Tiled<S>> {
        let mut tiled =
            Tiled { file: self.scratch().file()?, tiles: Vec::new(), proposals: Vec::new(), faces: 0, error: 0.0 };
        let samples_of = between.samples.tiles(lie);
        for (tile, place) in between.mesh.tiles(lie) {
            let loaded = between.mesh.load(lie, tile, &place)?;
            let mut samples = between.samples.load(samples_of.of(tile), &loaded)?;
            let homes = samples.iter().map(|sample| sample.near).collect();
            let tiles::Tile { mesh, locked, .. } = loaded;
            let collapsed = self.part(mesh, (locked, homes), between.faces, threshold, true)?;
            follow(&mut samples, &collapsed.homes);
            self.run.progress.add(place.faces() - collapsed.mesh.faces.len() as u64);
            tiled.keep(collapsed, &samples)?;
        }
        Ok(tiled)
    }

    /// Cuts up again what a sweep has left, for another one.
    fn put_back(&self, tiled: Tiled<S>) -> Result<Between<S>> {
        let mut between = self.nothing_between()?;
        for kept in &tiled.tiles {
            let (mesh, _, samples) = tiled.load(kept)?;
            between.add(&self.blocks, &mesh, &samples)?;
        }
        Ok(between)
    }

    /// Does the cheapest of what is left to do, refits, and joins the tiles.
    fn finish(&self, mut tiled: Tiled<S>) -> Result<IndexedMesh<S>> {
        let chosen = tiled.choose(self.asked);
        self.run.progress.begin(Stage::Refit, tiled.tiles.len() as u64);
        let unseen = self.run.progress.unseen();
        let mut joined = Joined::new(self.scratch())?;
        let mut offers = chosen.as_slice();
        for (number, kept) in tiled.tiles.iter().enumerate() {
            self.run.progress.check()?;
            let (mine, rest) = offers.split_at(offers.partition_point(|offer| offer.tile as usize <= number));
            offers = rest;
            let (mut mesh, mut locked, mut samples) = tiled.load(kept)?;
            apply(&mut mesh, &mut locked, &mut samples, mine);
            let area = self.cut.area() / (self.plan.samples as f64).max(1.0);
            let samples = SurfaceSamples::sorted(samples, self.lattice, area);
            let aim = Aim { reference: None, samples: Some(&samples) };
            let held = Held { locked: &locked, wedges: &mut Wedges::default() };
            refit(&mut mesh, &aim, self.run.job.refit_rounds, held, &unseen)?;
            joined.add(&mesh, &locked)?;
            self.run.progress.add(1);
        }
        drop(tiled);
        joined.into_mesh()
    }
}

impl<S: Coordinate> Between<S> {
    fn add(&mut self, blocks: &Blocks, mesh: &IndexedMesh<S>, samples: &[SurfaceSample]) -> Result<()> {
        self.faces += self.mesh.add(mesh)?.faces;
        self.samples.add(blocks, mesh, samples)
    }
}

/// Samples go where their vertices went.
fn follow(samples: &mut Vec<SurfaceSample>, homes: &[u32]) {
    samples.iter_mut().zip(homes).for_each(|(sample, home)| sample.near = *home);
    samples.retain(|sample| sample.near != u32::MAX);
}

fn centroid([a, b, c]: [DVec3; 3]) -> DVec3 {
    (a + b + c) / 3.0
}

impl<S: Coordinate> Tiled<S> {
    fn keep(&mut self, collapsed: Collapsed<S>, samples: &[SurfaceSample]) -> Result<()> {
        let Collapsed { mesh, locked, proposals, error_estimate, .. } = collapsed;
        let offset = self.file.length();
        let mut end = offset;
        let sections: [&[u8]; 4] = [
            bytemuck::cast_slice(samples),
            bytemuck::cast_slice(&mesh.positions),
            bytemuck::cast_slice(&mesh.faces),
            bytemuck::cast_slice(&locked),
        ];
        for section in sections {
            self.file.write_all_at(section, end)?;
            end += section.len() as u64;
        }
        let tile = self.tiles.len() as u32;
        self.proposals.extend(proposals.into_iter().map(|proposal| Offer { tile, proposal }));
        self.faces += mesh.faces.len() as u64;
        self.error = self.error.max(error_estimate);
        let (vertices, faces) = (mesh.positions.len(), mesh.faces.len());
        self.tiles.push(Kept { offset, vertices, faces, locked: locked.len(), samples: samples.len() });
        Ok(())
    }

    fn load(&self, kept: &Kept) -> Result<(IndexedMesh<S>, Vec<u32>, Vec<SurfaceSample>)> {
        let mut samples: Vec<SurfaceSample> = bytemuck::zeroed_vec(kept.samples);
        let mut positions: Vec<[S; 3]> = bytemuck::zeroed_vec(kept.vertices);
        let mut faces: Vec<[u32; 3]> = bytemuck::zeroed_vec(kept.faces);
        let mut locked: Vec<u32> = bytemuck::zeroed_vec(kept.locked);
        let mut at = kept.offset;
        let sections: [&mut [u8]; 4] = [
            bytemuck::cast_slice_mut(&mut samples),
            bytemuck::cast_slice_mut(&mut positions),
            bytemuck::cast_slice_mut(&mut faces),
            bytemuck::cast_slice_mut(&mut locked),
        ];
        for section in sections {
            self.file.read_exact_at(section, at)?;
            at += section.len() as u64;
        }
        Ok((IndexedMesh { positions, faces }, locked, samples))
    }

    /// The cheapest collapses that leave at most `asked` faces, by tile.
    fn choose(&mut self, asked: u64) -> Vec<Offer<S>> {
        let mut offers = std::mem::take(&mut self.proposals);
        let hash = |offer: &Offer<S>| {
            let place = u64::from(offer.tile) << 32 | u64::from(offer.proposal.keeps);
            (place.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32, offer.tile, offer.proposal.keeps)
        };
        offers.sort_unstable_by_key(|offer| (offer.proposal.cost.to_bits(), hash(offer)));
        let mut left = self.faces;
        offers.retain(|offer| {
            let wanted = left > asked;
            if wanted {
                left -= u64::from(offer.proposal.faces);
            }
            wanted
        });
        offers.sort_unstable_by_key(|offer| (offer.tile, offer.proposal.keeps));
        offers
    }
}

/// Does the collapses that were chosen.
fn apply<S: Coordinate>(
    mesh: &mut IndexedMesh<S>,
    locked: &mut Vec<u32>,
    samples: &mut [SurfaceSample],
    offers: &[Offer<S>],
) {
    let mut becomes: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    for Offer { proposal, .. } in offers {
        becomes[proposal.goes as usize] = proposal.keeps;
        mesh.positions[proposal.keeps as usize] = proposal.spot;
    }
    for corner in mesh.faces.as_flattened_mut() {
        *corner = becomes[*corner as usize];
    }
    mesh.faces.retain(|&[a, b, c]| a != b && b != c && c != a);
    let mut numbers = vec![u32::MAX; becomes.len()];
    mesh.faces.as_flattened().iter().for_each(|v| numbers[*v as usize] = 0);
    let mut kept = 0;
    for (v, number) in numbers.iter_mut().enumerate().filter(|(_, number)| **number == 0) {
        mesh.positions[kept as usize] = mesh.positions[v];
        *number = kept;
        kept += 1;
    }
    mesh.positions.truncate(kept as usize);
    let now = |v: u32| numbers[becomes[v as usize] as usize];
    mesh.faces.as_flattened_mut().iter_mut().for_each(|v| *v = numbers[*v as usize]);
    locked.iter_mut().for_each(|v| *v = now(*v));
    locked.retain(|v| *v != u32::MAX);
    samples.iter_mut().for_each(|sample| sample.near = now(sample.near));
}

/// The result as it grows, on scratch: tiles share the vertices at their cuts.
struct Joined<S> {
    positions: ScratchFile,
    faces: ScratchFile,
    vertices: u32,
    shared: FxHashMap<[u64; 3], u32>,
    scalar: std::marker::PhantomData<S>,
}

impl<S: Coordinate> Joined<S> {
    fn new(scratch: &Scratch) -> Result<Self> {
        let (positions, faces) = (scratch.file()?, scratch.file()?);
        Ok(Joined { positions, faces, vertices: 0, shared: FxHashMap::default(), scalar: std::marker::PhantomData })
    }

    fn add(&mut self, mesh: &IndexedMesh<S>, locked: &[u32]) -> Result<()> {
        let mut numbers = vec![u32::MAX; mesh.positions.len()];
        let key = |v: u32| mesh.positions[v as usize].map(|x| (x.widen() + 0.0).to_bits());
        for &v in locked {
            numbers[v as usize] = self.shared.get(&key(v)).copied().unwrap_or(u32::MAX);
        }
        let mut fresh = Vec::with_capacity(mesh.positions.len());
        for (number, position) in numbers.iter_mut().zip(&mesh.positions).filter(|(number, _)| **number == u32::MAX) {
            *number = self.vertices;
            self.vertices += 1;
            fresh.push(*position);
        }
        locked.iter().for_each(|&v| {
            self.shared.insert(key(v), numbers[v as usize]);
        });
        let faces: Vec<[u32; 3]> = mesh.faces.iter().map(|face| face.map(|v| numbers[v as usize])).collect();
        self.positions.write_all_at(bytemuck::cast_slice(&fresh), self.positions.length())?;
        self.faces.write_all_at(bytemuck::cast_slice(&faces), self.faces.length())
    }

    fn into_mesh(self) -> Result<IndexedMesh<S>> {
        let mut positions: Vec<[S; 3]> = bytemuck::zeroed_vec(self.vertices as usize);
        let mut faces: Vec<[u32; 3]> = bytemuck::zeroed_vec((self.faces.length() / 12) as usize);
        self.positions.read_exact_at(bytemuck::cast_slice_mut(&mut positions), 0)?;
        self.faces.read_exact_at(bytemuck::cast_slice_mut(&mut faces), 0)?;
        Ok(IndexedMesh { positions, faces })
    }
}
