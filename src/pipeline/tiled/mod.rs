//! Results that are too large for clustering: collapsed tile by tile on scratch (`tiles`), by one cost for all.
//!
//! 1. The scan is cut up.
//! 2. A *pilot*, pieces from all over the scan in memory together, is collapsed by one cost after another until the
//!    share of faces is left that is wanted, and a fifth more: that cost is for all tiles. A quota for each would thin
//!    rough parts and flat ones alike.
//! 3. A first sweep collapses every tile of the scan to that cost. Vertices at the cuts stay, as dense as they were.
//!    Samples of the scan go along, each near a vertex.
//! 4. The next sweep's tiles are shifted by half, so that it thins what was cut before. Some of them are *tried* first,
//!    for the cost that leaves a little more than is asked for. That sweep tells what it would collapse next.
//! 5. Of those collapses, none of which touches another, the cheapest are taken that bring the count to the one asked
//!    for. Each tile is refitted to its samples, and they are joined.
//!
//! So the scan is swept once and what is left of it once, as a rule. Where the pilot was so far off that
//! the vertices at the last sweep's cuts would stand out, another sweep evens them; where it was so far off to the
//! other side that too little is left, all is begun again, with what was learnt.

mod kept;
mod line;
mod pilot;
mod search;
mod trial;

use super::{Clock, Intermediate, Run, Source, read_crew};
use crate::collapse::{self, Carried, Collapsed, Part, collapse};
use crate::error::{Error, Result};
use crate::facets::{Stream, Stride};
use crate::mesh::samples::{Lattice, SurfaceSample};
use crate::mesh::{Coordinate, Frame, IndexedMesh, SurfaceSamples, Wedges};
use crate::plan::TilePlan;
use crate::progress::Stage;
use crate::refit::{Aim, Held, refit};
use crate::tiles::{self, Blocks, Cut, Lie, Partition, Place, SampleStore};
use kept::{Joined, Kept, Offer, Tiled, apply};
use line::{Done, Line, Waiting};
use search::Search;
use std::marker::PhantomData;
use std::time::Instant;
use trial::Found;

/// How many times as many faces as are asked for the first sweep is to leave, but for what is at its cuts. On scans of
/// 1.2 to 28 M faces it has left 0.98 to 1.06 times that; 1.18 times on one of 600,000 in small tiles.
const SPARE: f64 = 1.2;
/// How many times as many it has to leave: a little below one what is at the cuts is enough to make up for it.
const LEAST_SPARE: f64 = 0.95;
/// How many the last sweep is to leave, and at most, so that the last step does not choose among what costs far more.
const SPARE_AT_END: f64 = 1.05;
const NEAR_END: f64 = 1.12;
/// How many times as dense as is asked for vertices at the last sweep's cuts may be: 1.14 times as close together.
const MOST_AT_CUTS: f64 = 1.3;
/// Below this a cost is none.
const LEAST_COST: f64 = f32::MIN_POSITIVE as f64;
/// Beginnings, sweeps after one, and last sweeps, at most. The last beginning has a floor, which always leaves enough.
const MOST_BEGINNINGS: u32 = 3;
const MOST_SWEEPS: u32 = 8;
const MOST_LAST_SWEEPS: u32 = 4;

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
    cut: Cut,
    scalar: PhantomData<S>,
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
    fn is_flat(self) -> bool {
        self.floor > 0.0
    }

    /// The same for what has so many faces of which so many are asked for: there floors are other shares.
    fn among(self, faces: u64, asked: u64) -> Self {
        let floor = (SPARE_AT_END * asked as f64 / faces.max(1) as f64).min(1.0);
        Threshold { floor: if self.is_flat() { floor } else { 0.0 }, ..self }
    }

    /// The stronger, the less is left.
    fn strength(self) -> f64 {
        if self.is_flat() { 1.0 / self.floor } else { f64::from(self.cost) }
    }

    /// Another one of so much.
    fn of_strength(self, strength: f64) -> Self {
        match self.is_flat() {
            true => Threshold { floor: (1.0 / strength).min(1.0), ..self },
            false => Threshold { cost: strength as f32, ..self },
        }
    }

    /// A search among such.
    fn search(self) -> Search {
        if self.is_flat() { Search::of_floor() } else { Search::of_cost() }
    }
}

/// A tile that was collapsed, and its samples.
type Sampled<S> = (Collapsed<S>, Vec<SurfaceSample>);

impl<S: Coordinate> Done for Sampled<S> {
    fn faces(&self) -> u64 {
        self.0.mesh.faces.len() as u64
    }
}

/// A tile that is as it will be, and its locked vertices.
impl<S: Coordinate> Done for (IndexedMesh<S>, Vec<u32>) {
    fn faces(&self) -> u64 {
        self.0.faces.len() as u64
    }
}

/// Tiles of a partition.
fn waiting<'a>(places: impl IntoIterator<Item = &'a Place>) -> Vec<Waiting<&'a Place>> {
    places.into_iter().map(|place| Waiting { faces: place.count, place }).collect()
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
        let (mill, scan) = Mill::cut_up(self, asked, plan)?;
        let cut_seconds = clock.lap();
        if mill.cut.faces == 0 {
            return Err(Error::input(self.scan.path(), "has no usable face: none has three distinct corners"));
        }
        let tiled = mill.grind(scan)?;
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
    fn cut_up(run: &'a Run<'a>, asked: u64, plan: TilePlan) -> Result<(Self, Partition<S>)> {
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
        Ok((Mill { run, plan, asked, frame, blocks, lattice, cut, scalar: PhantomData }, partition))
    }

    /// All sweeps, until one more choice gives the count.
    fn grind(&self, mut scan: Partition<S>) -> Result<Tiled<S>> {
        self.run.progress.begin(Stage::Collapse, self.cut.faces.saturating_sub(self.asked));
        let (mut between, mut found) = self.begin(&mut scan)?;
        drop(scan);
        let mut lie = Lie::Shifted;
        for _ in 0..MOST_SWEEPS {
            if found.is_last {
                return self.end(&mut between, lie, found);
            }
            let next = self.sweep(&mut between, lie, found.threshold)?;
            let times = self.times(next.faces);
            if times < SPARE_AT_END {
                found.correct(times);
                continue;
            }
            (between, lie) = (next, lie.other());
            found = self.trial(&mut between, lie, found.threshold, found.learnt())?;
        }
        Err(self.unmet())
    }

    /// The first sweep, and what the next one is to be: all again where it has left too little.
    fn begin(&self, scan: &mut Partition<S>) -> Result<(Between<S>, Found)> {
        let (mut threshold, search) = self.pilot(scan)?;
        let mut search = search.anew();
        for turn in 1..=MOST_BEGINNINGS {
            let mut between = self.first_sweep(scan, threshold)?;
            let found = self.trial(&mut between, Lie::Shifted, threshold, &search)?;
            let times = self.times(between.faces);
            let without_cuts = if threshold.is_flat() { times } else { found.before };
            if times >= SPARE_AT_END && without_cuts >= LEAST_SPARE {
                return Ok((between, found));
            }
            search.tried(threshold.strength(), without_cuts / SPARE);
            threshold = threshold.of_strength(search.next().max(LEAST_COST));
            if turn + 1 == MOST_BEGINNINGS {
                threshold.floor = self.floor();
                search = threshold.search();
            }
        }
        Err(self.unmet())
    }

    /// The share of a part's faces that is to stay where cost does not tell where to stop.
    fn floor(&self) -> f64 {
        SPARE * self.asked as f64 / self.cut.faces as f64
    }

    /// The last sweep: again, by what it has left, where that was not enough, or too much for the last step.
    fn end(&self, between: &mut Between<S>, lie: Lie, mut found: Found) -> Result<Tiled<S>> {
        for turn in 1..=MOST_LAST_SWEEPS {
            let tiled = self.last_sweep(between, lie, found.threshold)?;
            let is_within_reach = tiled.faces.saturating_sub(tiled.removable()) <= self.asked;
            let times = self.times(tiled.faces);
            let is_near = times <= NEAR_END || found.threshold.is_flat() || turn == MOST_LAST_SWEEPS;
            if tiled.faces >= self.asked && is_within_reach && is_near {
                return Ok(tiled);
            }
            found.correct(times);
        }
        Err(self.unmet())
    }

    /// How many times as many as are asked for.
    fn times(&self, faces: u64) -> f64 {
        faces as f64 / self.asked.max(1) as f64
    }

    fn unmet(&self) -> Error {
        let what = format!("{} faces cannot be reached in tiles", self.asked);
        Error::Unmet { file: self.run.job.input.clone(), what }
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
    fn first_sweep(&self, scan: &mut Partition<S>, threshold: Threshold) -> Result<Between<S>> {
        let mut between = self.nothing_between()?;
        let rate = self.plan.samples as f64 / self.cut.area().max(f64::MIN_POSITIVE);
        let tiles = scan.tiles(Lie::Straight);
        if let Some(tile) = tiles.places.iter().find(|tile| tile.count > self.plan.faces) {
            let path = self.run.scan.path().display();
            let what = format!("{path}: a tile has {} faces, more than fit this budget", tile.count);
            return Err(Error::Budget { what, needed_bytes: self.run.purse.in_core_budget::<S>(self.run.scan) });
        }
        let load = |place: &&Place| {
            let loaded = tiles.load(place)?;
            let samples = tiles::draw(&loaded.mesh, &self.lattice, rate);
            Ok((loaded, samples))
        };
        let collapse = |(loaded, samples)| self.tile(loaded, samples, self.cut.faces, threshold, false);
        let line = Line { face_bytes: self.plan.first_face_bytes, ..self.line() };
        let put = |(collapsed, samples): Sampled<S>| between.add(&self.blocks, &collapsed, &samples);
        line.run(&waiting(&tiles.places), load, collapse, put)?;
        Ok(between)
    }

    /// What memory holds of tiles after the first sweep, beside what one that is put away is sorted in.
    fn line(&self) -> Line {
        let face_bytes = self.plan.later_face_bytes;
        let bytes = self.plan.bytes.saturating_sub(self.plan.writer_bytes);
        Line { bytes, face_bytes, done_face_bytes: face_bytes }
    }

    /// Collapses the tiles of what another sweep has left.
    fn sweep(&self, between: &mut Between<S>, lie: Lie, threshold: Threshold) -> Result<Between<S>> {
        let mut next = self.nothing_between()?;
        self.each(between, lie, threshold, false, |(collapsed, samples)| next.add(&self.blocks, &collapsed, &samples))?;
        next.error += between.error;
        Ok(next)
    }

    /// The same, and asks what would be next.
    fn last_sweep(&self, between: &mut Between<S>, lie: Lie, threshold: Threshold) -> Result<Tiled<S>> {
        let mut tiled = Tiled::new(&self.run.scratch)?;
        self.each(between, lie, threshold, true, |(collapsed, samples)| tiled.keep(collapsed, &samples))?;
        tiled.error += between.error;
        Ok(tiled)
    }

    fn nothing_between(&self) -> Result<Between<S>> {
        let bytes = self.plan.writer_bytes;
        let samples = SampleStore::new(bytes, &self.run.scratch)?;
        Ok(Between { mesh: Partition::new(self.blocks, bytes, &self.run.scratch)?, samples, faces: 0, error: 0.0 })
    }

    /// Gives every tile of what a sweep has left, collapsed, to `take`.
    fn each(
        &self,
        between: &mut Between<S>,
        lie: Lie,
        threshold: Threshold,
        proposes: bool,
        take: impl FnMut(Sampled<S>) -> Result<()> + Send,
    ) -> Result<()> {
        let (faces, tiles, samples) = (between.faces, between.mesh.tiles(lie), between.samples.tiles(lie));
        let load = |place: &&Place| {
            let loaded = tiles.load(place)?;
            let samples = samples.load(place.number, &loaded)?;
            Ok((loaded, samples))
        };
        let collapse = |(loaded, samples)| self.tile(loaded, samples, faces, threshold, proposes);
        self.line().run(&waiting(&tiles.places), load, collapse, take)
    }

    /// Collapses a tile of a mesh of `whole` faces; samples go where their vertices go.
    fn tile(
        &self,
        tile: tiles::Tile<S>,
        mut samples: Vec<SurfaceSample>,
        whole: u64,
        threshold: Threshold,
        proposes: bool,
    ) -> Result<Sampled<S>> {
        let tiles::Tile { mesh, locked, .. } = tile;
        let before = mesh.faces.len();
        let homes = samples.iter().map(|sample| sample.near).collect();
        let collapsed = self.part(mesh, (locked, homes), whole, threshold, proposes)?;
        samples.iter_mut().zip(&collapsed.homes).for_each(|(sample, home)| sample.near = *home);
        samples.retain(|sample| sample.near != u32::MAX);
        self.run.progress.add((before - collapsed.mesh.faces.len()) as u64);
        Ok((collapsed, samples))
    }

    /// Does the cheapest of what is left to do, refits, and joins the tiles.
    fn finish(&self, mut tiled: Tiled<S>) -> Result<IndexedMesh<S>> {
        let chosen = tiled.choose(self.asked);
        self.run.progress.begin(Stage::Refit, tiled.tiles.len() as u64);
        let unseen = self.run.progress.unseen();
        let mut joined = Joined::new(&self.run.scratch)?;
        let mut offers = chosen.as_slice();
        let mut tiles = Vec::with_capacity(tiled.tiles.len());
        for (number, kept) in tiled.tiles.iter().enumerate() {
            let (mine, rest) = offers.split_at(offers.partition_point(|offer| offer.tile as usize <= number));
            offers = rest;
            tiles.push(Waiting { faces: kept.faces(), place: (kept, mine) });
        }
        let area = self.cut.area() / (self.plan.samples as f64).max(1.0);
        let load = |(kept, mine): &(&Kept, &[Offer<S>])| {
            self.run.progress.check()?;
            let (mut mesh, mut locked, mut samples) = tiled.load(kept)?;
            apply(&mut mesh, &mut locked, &mut samples, mine);
            Ok((mesh, locked, SurfaceSamples::sorted(samples, self.lattice, area)))
        };
        let fit = |(mut mesh, locked, samples): (IndexedMesh<S>, Vec<u32>, SurfaceSamples)| {
            let aim = Aim { reference: None, samples: Some(&samples) };
            let held = Held { locked: &locked, wedges: &mut Wedges::default() };
            refit(&mut mesh, &aim, self.run.job.refit_rounds, held, &unseen)?;
            self.run.progress.add(1);
            Ok((mesh, locked))
        };
        self.line().run(&tiles, load, fit, |(mesh, locked)| joined.add(&mesh, &locked))?;
        drop((tiled, chosen));
        joined.into_mesh()
    }
}

impl<S: Coordinate> Between<S> {
    fn add(&mut self, blocks: &Blocks, collapsed: &Collapsed<S>, samples: &[SurfaceSample]) -> Result<()> {
        self.error = self.error.max(collapsed.error_estimate);
        self.faces += self.mesh.add(&collapsed.mesh)?.faces;
        self.samples.add(blocks, &collapsed.mesh, samples)
    }
}
