//! Results that are too large for clustering: collapsed tile by tile on scratch (`tiles`), by one cost for all.
//!
//! 1. The scan is cut up.
//! 2. A *pilot*, pieces from all over the scan in memory together, is collapsed by one cost after another until the
//!    share of faces is
//!    left that is wanted, and a little more: that cost is for all tiles. A quota for each would thin rough parts and flat
//!    ones alike.
//! 3. A first sweep collapses every tile of the scan to that cost. Vertices at the cuts stay, as dense as they were.
//!    Samples
//!    of the scan go along, each near a vertex.
//! 4. A second sweep, whose tiles are shifted by half, does the same to what is left, so that it thins what was cut
//!    before, and
//!    tells what it would collapse next.
//! 5. Of those collapses, none of which touches another, the cheapest are taken that bring the count to the one asked
//!    for.
//!    Each tile is refitted to its samples, and they are joined.
//!
//! Where the sweeps leave more than a tenth too much two others follow, to a higher cost: what is at the cuts of the
//! last one, which the one before it has thinned to the same cost, is then hardly denser than the rest. Where one of
//! these leaves too little, the one before it counts; where the first ones do, all is begun again, with a lower cost.

mod kept;
mod pilot;

use super::{Clock, Intermediate, Run, Source, read_crew};
use crate::collapse::{self, Carried, Collapsed, Part, collapse};
use crate::error::{Error, Result};
use crate::facets::{Stream, Stride};
use crate::mesh::samples::{Lattice, SurfaceSample};
use crate::mesh::{Coordinate, Frame, IndexedMesh, SurfaceSamples, Wedges};
use crate::plan::TilePlan;
use crate::progress::Stage;
use crate::refit::{Aim, Held, refit};
use crate::tiles::{self, Blocks, Cut, Lie, Partition, SampleStore};
use kept::{Joined, Tiled, apply};
use std::time::Instant;

/// How many times as many faces as are asked for the first sweeps are to leave. The pilot is within a tenth.
const SPARE: f64 = 1.25;
/// How many the last sweep is to leave, and at most: vertices at its cuts are as dense as it left them, and must not
/// stand out.
const SPARE_AT_END: f64 = 1.05;
const NEAR_END: f64 = 1.1;
/// The cost of a collapse goes with the cube of the area that a face stands for.
const COST_POWER: f64 = 3.0;
/// The share of a flat tile's faces that sweeps after the first leave: what was cut before is denser than that.
const FLOOR_AGAIN: f64 = 0.95;
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
    /// Collapses that cost more are not done.
    cost: f32,
    /// The share of a part's faces that stays whatever they cost: 0 but where so much of a scan is flat that cost does
    /// not tell where to stop.
    floor: f64,
}

impl Threshold {
    /// That of a sweep after the first, which finds tiles at their floor.
    fn again(self) -> Self {
        Threshold { floor: if self.floor > 0.0 { FLOOR_AGAIN } else { 0.0 }, ..self }
    }

    /// Another one, after this has left so many times as much as was wanted.
    fn after(self, times: f64) -> Self {
        match self.floor > 0.0 {
            true => Threshold { floor: (self.floor / times.clamp(0.5, 1.5)).min(1.0), ..self },
            false => Threshold { cost: self.cost * (times.powf(COST_POWER) as f32).max(1e-6), ..self },
        }
    }
}

/// A mesh between two sweeps.
struct Between<S> {
    mesh: Partition<S>,
    samples: SampleStore<S>,
    faces: u64,
    /// The largest estimated errors of the sweeps that have made it, together.
    error: f64,
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
        let extent = scan.extent(&crew)?;
        let frame = Frame::around::<S>(&extent);
        let Some(blocks) = tiles::blocks(scan, &crew, (frame, &extent), plan.faces)? else {
            let what =
                format!("{}: so many faces lie together that no tile of them fits this budget", scan.path().display());
            return Err(Error::Budget { what, needed_bytes: run.purse.in_core_budget::<S>(scan) });
        };
        let partition = Partition::new(blocks, plan.writer_bytes, &run.scratch)?;
        let stream = Stream::<S>::open(scan, &crew, &run.scratch, frame, Stride::new(1, 1), plan.position_bytes)?;
        let cutters = stream.faces(&crew, false, || partition.writer())?;
        let cut = Cut::sum(cutters.into_iter().map(|cutter| cutter.finish()).collect::<Result<Vec<_>>>()?);
        let lattice = Lattice::over(frame.place(extent.min), frame.place(extent.max));
        Ok(Mill { run, plan, asked, frame, blocks, lattice, scan: partition, cut })
    }

    /// All sweeps, until one more choice gives the count.
    fn grind(&self) -> Result<Tiled<S>> {
        self.run.progress.begin(Stage::Collapse, self.cut.faces.saturating_sub(self.asked));
        let mut threshold = self.pilot()?;
        let mut between = self.first_sweep(threshold)?;
        let mut lie = Lie::Shifted;
        let mut before: Option<Tiled<S>> = None;
        // Whether the last two sweeps went to the same cost, so that what is at the cuts of one was thinned by the other.
        let mut is_even = true;
        for _ in 0..MOST_SWEEPS {
            let tiled = self.sweep(between, threshold.again(), lie)?;
            let times = |spare: f64| tiled.faces as f64 / (spare * self.asked as f64);
            let is_within_reach = tiled.faces.saturating_sub(tiled.removable()) <= self.asked;
            let is_flat = threshold.floor > 0.0;
            if let Some(before) = before.filter(|_| tiled.faces < self.asked) {
                return Ok(before);
            }
            if tiled.faces < self.asked || is_flat && !is_within_reach {
                threshold = threshold.after(times(SPARE));
                between = self.first_sweep(threshold)?;
                (lie, is_even, before) = (Lie::Shifted, true, None);
                continue;
            }
            let is_near = is_within_reach && (is_flat || times(NEAR_END) <= 1.0);
            if is_near && is_even {
                return Ok(tiled);
            }
            is_even = is_near;
            if !is_near {
                threshold = threshold.after(times(SPARE_AT_END).max(1.05));
            }
            between = self.put_back(&tiled)?;
            lie = lie.other();
            before = Some(tiled).filter(|_| is_within_reach);
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
        let least = (threshold.floor * mesh.faces.len() as f64).ceil() as usize;
        let options = collapse::Options {
            policies: self.run.job.policies.in_frame(self.frame),
            part: Some(Part { most_cost: threshold.cost, least, proposes }),
            ..collapse::Options::to(target)
        };
        collapse(mesh, Some(Carried { homes, locked, ..Carried::default() }), &options, &self.run.progress.unseen())
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
            between.error = between.error.max(collapsed.error_estimate);
            between.add(&self.blocks, &collapsed.mesh, &samples)?;
        }
        Ok(between)
    }

    fn nothing_between(&self) -> Result<Between<S>> {
        let bytes = self.plan.writer_bytes;
        let samples = SampleStore::new(bytes, &self.run.scratch)?;
        Ok(Between { mesh: Partition::new(self.blocks, bytes, &self.run.scratch)?, samples, faces: 0, error: 0.0 })
    }

    /// Collapses the tiles of what another sweep has left, and asks what would be next.
    fn sweep(&self, between: Between<S>, threshold: Threshold, lie: Lie) -> Result<Tiled<S>> {
        let mut tiled = Tiled::new(&self.run.scratch)?;
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
        tiled.error += between.error;
        Ok(tiled)
    }

    /// Cuts up again what a sweep has left, for another one.
    fn put_back(&self, tiled: &Tiled<S>) -> Result<Between<S>> {
        let mut between = Between { error: tiled.error, ..self.nothing_between()? };
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
        let mut joined = Joined::new(&self.run.scratch)?;
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
