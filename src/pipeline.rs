//! read → cluster → collapse → write → measure: the order in which a scan goes through the mill.

mod coat;
mod compare;
mod effort;
mod forecast;
mod inspect;
mod levels;
mod portrait;
mod render;
mod tiled;

pub use compare::compare;
pub use effort::Effort;
pub use forecast::{Forecast, forecast};
pub use inspect::inspect;
pub use portrait::PortraitAsked;
pub use render::render;

use crate::carry::{self, carry};
use crate::cluster::{ClusterOptions, ClusterStats, cluster};
use crate::collapse::{self, Carried, Collapsed, collapse};
use crate::cores::on_threads;
use crate::error::{Error, Result};
use crate::job::{Job, Level, Target, read_points};
use crate::mesh::columns::Columns;
use crate::mesh::{Coordinate, Frame, IndexedMesh, SampleFile};
use crate::plan::{Ask, Cells, LOW_RATIO, Purse, Way, most_threads};
use crate::progress::{Progress, Stage};
use crate::read::{Crew, LoadReport, Scalar, Scan, load};
use crate::refit::{self, Aim, Held, refit};
use crate::report::{DeviationFigures, Failure, MeshFile, Mode, Report, Timeline, Warning, peak_rss_bytes};
use crate::scratch::Scratch;
use crate::write;
use coat::{Outfit, steering};
use glam::DVec3;
use portrait::Portrait;
use std::path::Path;
use std::time::Instant;
use tiled::TileStats;

/// Reduces one scan as `job` says, and reports.
pub fn reduce(job: &Job, progress: &Progress) -> Result<Report> {
    reduce_and_portray(job, None, progress)
}

/// The same, and takes a picture of it where one is asked for.
pub fn reduce_and_portray(job: &Job, portrait: Option<&PortraitAsked>, progress: &Progress) -> Result<Report> {
    let threads = job.threads.min(most_threads(job.memory.0));
    on_threads(threads, || {
        let begun = Instant::now();
        progress.begin(Stage::Read, 0);
        let out = write::Target::prepare_as(&job.output, job.format, Some(&job.input))?;
        let prepare = |level: &Level| write::Target::prepare_as(&level.output, level.format, Some(&job.input));
        let coarser = job.coarser.iter().map(prepare).collect::<Result<Vec<_>>>()?;
        let scratch = job.scratch();
        let scan = Scan::open_in(&job.input, &scratch, progress)?;
        let asked = job.target.faces(scan.triangle_count());
        let purse = Purse::new(job.memory.0, threads, ask(job, &scan, asked));
        let locked = job.lock_vertices.as_deref().map_or(Ok(Vec::new()), read_points)?;
        let run = Run { job, portrait, threads, progress, scan: &scan, scratch, purse, begun, locked };
        match scan.scalar() {
            Scalar::F32 => run.through::<f32>(out, coarser),
            Scalar::F64 => run.through::<f64>(out, coarser),
        }
    })
}

/// What a job that asks for so many faces of a scan is to be paid.
fn ask(job: &Job, scan: &Scan, asked: Option<u64>) -> Ask {
    let target = asked.unwrap_or(0);
    Ask {
        target,
        refit_rounds: job.refit_rounds,
        tail_bytes: collapse::tail_bytes(target, &job.policies),
        shade_bytes: if job.carry { shade_bytes(&job.policies, scan) } else { 0 },
        coat_bytes: if job.carry { coat_bytes(scan) } else { 0 },
        carry_bytes: if job.carry { carry_bytes(scan, target) } else { 0 },
        is_chain: !job.coarser.is_empty(),
    }
}

/// Bytes a vertex that what steers takes.
fn shade_bytes(policies: &collapse::Policies, scan: &Scan) -> u64 {
    steering(policies, scan).len() as u64 * collapse::SHADE_BYTES
}

/// What carrying over all that the vertices of a scan carry takes.
fn carry_bytes(scan: &Scan, target: u64) -> u64 {
    let faces = target.min(scan.triangle_count());
    match scan.columns().len() as u64 {
        0 => 0,
        columns => carry::bytes(faces, faces / 2, columns),
    }
}

/// Who streams a scan within a budget.
fn read_crew<'a>(purse: &Purse, progress: &'a Progress) -> Crew<'a> {
    Crew { workers: purse.workers, progress }
}

/// Bytes a vertex that what corners carry adds where the scan is collapsed as it is.
fn coat_bytes(scan: &Scan) -> u64 {
    if !scan.has_coat() {
        return 0;
    }
    let vertices = scan.vertex_count().max(1);
    let wedges = scan.coat_values().max(vertices);
    let steering = 8 * collapse::SHADE_BYTES * wedges;
    (carry::coat_bytes(scan.triangle_count(), wedges, vertices) + steering).div_ceil(vertices)
}

/// One reduction under way.
struct Run<'a> {
    job: &'a Job,
    portrait: Option<&'a PortraitAsked>,
    threads: usize,
    progress: &'a Progress,
    scan: &'a Scan,
    scratch: Scratch,
    purse: Purse,
    begun: Instant,
    /// Points in the scan's units: the vertices nearest to them stay.
    locked: Vec<DVec3>,
}

/// What goes into the collapse.
struct Intermediate<S> {
    mesh: IndexedMesh<S>,
    frame: Frame,
    carried: Option<Carried>,
    outfit: Option<Outfit<S>>,
    samples: Option<SampleFile>,
    source: Source,
}

/// Where it came from.
enum Source {
    Loaded(LoadReport),
    Clustered(ClusterStats),
    /// Reduced to the end.
    Tiled(TileStats),
}

impl Run<'_> {
    fn through<S: Coordinate>(&self, out: write::Target, coarser: Vec<write::Target>) -> Result<Report> {
        let asked = self.job.target.faces(self.scan.triangle_count());
        if let (true, Some(asked)) = (self.job.verify, asked) {
            compare::check_verifiable::<S>(asked, self)?;
        }
        let mut clock = Clock::new(self.begun);
        let mut seconds = Timeline::default();
        let opened = clock.lap();
        let Intermediate { mesh, frame, carried, outfit, samples, source } = self.intermediate::<S>(asked)?;
        match source {
            Source::Loaded(_) => seconds.read = opened + clock.lap(),
            Source::Clustered(_) => (seconds.read, seconds.cluster) = (opened, clock.lap()),
            Source::Tiled(ref stats) => {
                seconds.read = opened + stats.cut_seconds;
                seconds.collapse = clock.lap() - stats.cut_seconds - stats.refit_seconds;
                seconds.refit = stats.refit_seconds;
            }
        }
        let faces = mesh.faces.len();
        let points: Vec<DVec3> = self.locked.iter().map(|p| frame.place(*p)).collect();
        let options = self.collapse_options(asked, faces, frame, &points, samples.is_some());
        let lengths = self.lengths(&mesh, carried.as_ref(), asked);
        let collapsed = match source {
            Source::Tiled(ref stats) => Collapsed::done(mesh, stats.error),
            _ => collapse(mesh, carried, &options, self.progress)?,
        };
        let Collapsed { mut mesh, error_estimate, irregularities, reference, homes, dropped, locked, .. } = collapsed;
        let (mut wedges, shades) = (collapsed.wedges, collapsed.shades);
        if dropped.faces == faces as u64 {
            let what = "every piece is smaller than the least component asked for".into();
            return Err(Error::Unmet { file: self.job.input.clone(), what });
        }
        self.check(asked, faces, mesh.faces.len())?;
        seconds.collapse += clock.lap();
        let most = self.purse.samples_at_once(mesh.faces.len() as u64);
        let file = samples;
        let samples = file.as_ref().map(|file| file.load(most, &homes)).transpose()?;
        let aim = Aim { reference: reference.as_ref(), samples: samples.as_ref() };
        let held = Held { locked: &locked, wedges: &mut wedges };
        // The system takes a while to give up a large file.
        rayon::join(|| refit(&mut mesh, &aim, self.job.refit_rounds, held, self.progress), || drop(file)).0?;
        drop(samples);
        seconds.refit += clock.lap();

        let mut warnings = self.warnings(asked, &source, faces);
        if dropped.pieces > 0 {
            warnings.push(Warning::SmallPieces { pieces: dropped.pieces, faces: dropped.faces });
        }
        // What is irregular in the mesh that clustering made says nothing of the scan.
        if matches!(source, Source::Loaded(_)) {
            warnings.extend(irregular(&irregularities));
        }
        if S::DOUBLE && out.loses_doubles() {
            warnings.push(Warning::StlLosesDoubles { vertices: mesh.positions.len() as u64 });
        }
        warnings.extend(collapsed.seams_gave_way.then_some(Warning::SeamsGaveWay));
        let voted = self.voted(out.format(), outfit.as_ref(), &mesh, frame)?;
        let (wanted, lost) = self.columns(out.format(), outfit.as_ref(), &voted);
        if outfit.is_none() && self.left_seams_out(out.format(), &lost) {
            warnings.push(Warning::SeamsLeftOut { needed_bytes: self.purse.in_core_budget::<S>(self.scan) });
        }
        if !lost.is_empty() {
            warnings.push(Warning::NotCarried { names: lost });
        }
        let carried = self.carried(&wanted, &mesh, frame)?;
        let dressed = self.dressed(outfit.as_ref(), &mesh, &wedges, out.format())?;
        seconds.carry = clock.lap();
        let vertices =
            dressed.as_ref().map_or(mesh.positions.len(), |d| d.vertices(out.format(), mesh.positions.len()));
        let output = mesh_file(&self.job.output, mesh.faces.len(), vertices);
        let clothes = dressed.as_ref().map(|d| d.clothes());
        let load = write::Load { vertices: &carried, faces: &voted, clothes };
        out.write_carrying(&mesh, frame, load, self.progress)?;
        drop((dressed, voted));
        seconds.write = clock.lap();
        let (mode, cells, ratio) = match &source {
            Source::Loaded(_) => (Mode::InCore, None, None),
            Source::Clustered(stats) => {
                let ratio = faces as f64 / output.faces.max(1) as f64;
                (Mode::OutOfCore, Some(stats.occupied_cells), Some(ratio))
            }
            Source::Tiled(_) => (Mode::OutOfCore, None, None),
        };
        let tiles = if let Source::Tiled(stats) = &source { Some(stats.tiles) } else { None };
        let references = reference.filter(|_| !coarser.is_empty()).into_iter().collect();
        let outfit = outfit.as_ref();
        let (error, locked) = (error_estimate, &points[..]);
        let chain = levels::Chain { mesh, frame, references, error, locked, wedges, shades, lengths, outfit };
        let mut coarser = self.coarser(chain, coarser, &mut clock, &mut seconds, &mut warnings)?;
        let mut portrait = self.begin_portrait(&mut warnings)?;
        seconds.render = clock.lap();
        let mut deviation = None;
        if self.job.verify {
            deviation = Some(self.verify(&self.job.output, portrait.as_mut())?);
            for level in &mut coarser {
                level.deviation = Some(self.verify(&level.output.path, None)?);
            }
            seconds.measure = clock.lap();
        }
        let portrait = portrait.map(|portrait| portrait.finish(self)).transpose()?;
        seconds.render += clock.lap();
        seconds.total = self.begun.elapsed().as_secs_f64();
        let unmet = deviation.as_ref().and_then(|found| self.exceeded(found));
        Ok(Report {
            input: MeshFile {
                path: self.job.input.clone(),
                faces: self.scan.face_count(),
                vertices: self.scan.vertex_count(),
            },
            output,
            coarser,
            mode,
            cells,
            tiles,
            ratio,
            threads: self.threads,
            memory_budget_bytes: self.job.memory.0,
            peak_rss_bytes: peak_rss_bytes(),
            scratch_bytes: self.scratch.bytes(),
            seconds,
            error_estimate: Some(frame.to_file(error_estimate)),
            deviation,
            portrait,
            warnings,
            unmet,
        })
    }

    /// Takes pictures where they are asked for. One that cannot be taken is no reason to fail.
    fn begin_portrait(&self, warnings: &mut Vec<Warning>) -> Result<Option<Portrait<'_>>> {
        let Some(asked) = self.portrait else { return Ok(None) };
        let coarser = self.job.coarser.iter().map(|level| level.output.as_path());
        let results: Vec<_> = std::iter::once(self.job.output.as_path()).chain(coarser).collect();
        match Portrait::begun(self, asked, &results) {
            Ok(portrait) => Ok(Some(portrait)),
            Err(error @ Error::Interrupted { .. }) => Err(error),
            Err(error) => {
                warnings.push(Warning::NoPicture { why: error.to_string() });
                Ok(None)
            }
        }
    }

    /// The scan itself, welded, where it fits the budget; otherwise what clustering makes of it.
    fn intermediate<S: Coordinate>(&self, asked: Option<u64>) -> Result<Intermediate<S>> {
        if let Some(most_vertices) = self.purse.in_core::<S>(self.scan) {
            self.progress.begin(Stage::Read, self.scan.bytes());
            let crew = Crew { workers: 1, progress: self.progress };
            if let Some(loaded) = load(self.scan, &crew, most_vertices)? {
                return self.loaded(loaded, asked);
            }
        }
        let locks = self.job.lock_vertices.as_ref().map(|_| "locking vertices");
        if let Some(policy) = self.job.policies.needs_the_scan().or(locks) {
            let path = self.scan.path().display();
            let what = format!("{path}: {policy} cannot be kept where the scan has to be clustered first");
            return Err(Error::Budget { what, needed_bytes: self.purse.in_core_budget::<S>(self.scan) });
        }
        match self.purse.way::<S>(self.scan, asked)? {
            Way::Clustered(cells) => self.clustered(asked, cells),
            Way::Tiled(plan) => self.tiled(asked.unwrap_or(0), plan),
        }
    }

    /// Clusters, into more cells where the mesh that comes out is smaller than what is asked for.
    fn clustered<S: Coordinate>(&self, asked: Option<u64>, mut cells: Cells) -> Result<Intermediate<S>> {
        let crew = Crew { workers: self.purse.workers, progress: self.progress };
        loop {
            let (raw_faces, spill_resident_bytes, limit) = self.purse.cluster_options::<S>(self.scan, cells.wanted);
            let options = ClusterOptions {
                representative: self.job.representative,
                cells: cells.wanted,
                enough_cells: cells.enough(),
                raw_faces,
                spill_resident_bytes,
                samples: self.purse.samples_beside(self.scan, cells.wanted, spill_resident_bytes),
                boundary_weight: self.job.policies.boundary_weight,
                limit,
            };
            self.progress.begin(Stage::Cluster, 0);
            let clustered = cluster::<S>(self.scan, &crew, &self.scratch, &options)?;
            if clustered.stats.repeated_corner_faces == self.scan.triangle_count() {
                return Err(Error::input(self.scan.path(), "has no usable face: none has three distinct corners"));
            }
            let faces = clustered.mesh.faces.len() as u64;
            let enough = asked.unwrap_or(0);
            if faces < enough && cells.wanted < cells.most {
                let factor = 1.2 * enough as f64 / faces.max(1) as f64;
                cells.wanted = ((cells.wanted as f64 * factor) as usize).min(cells.most);
                continue;
            }
            if faces < enough {
                let path = self.scan.path().display();
                let what =
                    format!("{path}: clustered within this budget, {faces} faces are left of the {enough} asked for");
                return Err(Error::Budget { what, needed_bytes: self.purse.in_core_budget::<S>(self.scan) });
            }
            let shades = self.mean_shades(&clustered.mesh, clustered.frame, asked)?;
            return Ok(Intermediate {
                mesh: clustered.mesh,
                frame: clustered.frame,
                carried: Some(Carried {
                    quadrics: clustered.quadrics,
                    homes: clustered.homes,
                    shades,
                    ..Carried::default()
                }),
                outfit: None,
                samples: clustered.samples,
                source: Source::Clustered(clustered.stats),
            });
        }
    }

    fn collapse_options<'p>(
        &self,
        asked: Option<u64>,
        faces: usize,
        frame: Frame,
        locked: &'p [DVec3],
        sampled: bool,
    ) -> collapse::Options<'p> {
        let max_error = match self.job.target {
            Target::MaxError(length) => frame.to_frame(length),
            _ => f64::INFINITY,
        };
        let target = asked.unwrap_or(0).try_into().unwrap_or(usize::MAX);
        collapse::Options {
            target,
            max_error,
            policies: self.job.policies.in_frame(frame),
            locked,
            last_factor: collapse::LAST_FACTOR,
            tail_faces: collapse::TAIL_FACES,
            keep_reference: self.purse.keeps_reference(sampled) && target.saturating_mul(refit::LEAST_RATIO) <= faces,
            part: None,
        }
    }

    /// What the result's vertices carry.
    fn carried<S: Coordinate>(&self, wanted: &[usize], mesh: &IndexedMesh<S>, frame: Frame) -> Result<Columns> {
        if wanted.is_empty() {
            return Ok(Columns::default());
        }
        let crew = Crew { workers: self.purse.workers, progress: self.progress };
        carry(self.scan, wanted, mesh, frame, &crew)
    }

    /// Measures a file that was written.
    fn verify(&self, output: &Path, portrait: Option<&mut Portrait>) -> Result<DeviationFigures> {
        let found = compare::verify(self, output, portrait).map_err(|error| self.unverified(error))?;
        Ok((&found).into())
    }

    /// The result is there, whatever became of its measurement.
    fn unverified(&self, error: Error) -> Error {
        let file = self.job.output.clone();
        match error {
            Error::Budget { what, needed_bytes } => {
                Error::Budget { what: format!("{} is written, but not measured: {what}", file.display()), needed_bytes }
            }
            Error::Interrupted { signal, .. } => {
                Error::Interrupted { signal, left: "the result is written, but not measured" }
            }
            other => Error::Unmet { file, what: format!("is written, but cannot be measured: {other}") },
        }
    }

    /// The measured distance, where it is beyond the one that was asked for.
    fn exceeded(&self, found: &DeviationFigures) -> Option<Failure> {
        let Target::MaxError(length) = self.job.target else { return None };
        // Also true of what is not a number.
        if found.max <= length {
            return None;
        }
        let what = format!("is written, but {} from the scan at its farthest, and {length} was asked for", found.max);
        Some(Failure::from(&Error::Unmet { file: self.job.output.clone(), what }))
    }

    /// Whether what was asked was reached.
    fn check(&self, asked: Option<u64>, before: usize, after: usize) -> Result<()> {
        match asked {
            Some(asked) if after as u64 > asked && after < before => {
                let what = format!("{asked} faces cannot be reached: the smallest count is {after}");
                Err(Error::Unmet { file: self.job.input.clone(), what })
            }
            _ => Ok(()),
        }
    }

    fn warnings(&self, asked: Option<u64>, source: &Source, faces: usize) -> Vec<Warning> {
        let mut warnings = Vec::new();
        let mut say = |n: u64, warning: fn(u64) -> Warning| {
            if n > 0 {
                warnings.push(warning(n));
            }
        };
        say(self.scan.trailing_bytes(), |bytes| Warning::TrailingBytes { bytes });
        say(self.scan.short_polygons(), |faces| Warning::ShortPolygons { faces });
        match source {
            Source::Loaded(report) => {
                say(report.repeated_corner_faces, |faces| Warning::RepeatedCornerFaces { faces });
                say(report.flat_faces, |faces| Warning::FlatFaces { faces });
                say(report.unreferenced_vertices, |vertices| Warning::UnreferencedVertices { vertices });
                say(report.duplicate_vertices, |vertices| Warning::DuplicateVertices { vertices });
                if let Some(asked) = asked.filter(|&n| n >= faces as u64) {
                    warnings.push(Warning::TargetAboveScan { asked, have: faces as u64 });
                }
            }
            Source::Clustered(stats) => {
                say(stats.repeated_corner_faces, |faces| Warning::RepeatedCornerFaces { faces });
                say(stats.flat_faces, |faces| Warning::FlatFaces { faces });
                say(stats.unreferenced_vertices.unwrap_or(0), |vertices| Warning::UnreferencedVertices { vertices });
                if stats.overflows > 0 {
                    warnings.push(Warning::CoarsenedGrid { times: stats.overflows, cells: stats.occupied_cells });
                }
                let ratio = faces as f64 / asked.unwrap_or(0).max(1) as f64;
                if asked.is_some() && ratio < LOW_RATIO {
                    warnings.push(Warning::LowRatio { ratio });
                }
            }
            Source::Tiled(stats) => {
                say(stats.repeated_corner_faces, |faces| Warning::RepeatedCornerFaces { faces });
            }
        }
        warnings
    }
}

fn irregular(found: &collapse::Irregularities) -> impl Iterator<Item = Warning> {
    let edges = (found.nonmanifold_edges > 0).then_some(Warning::NonManifoldEdges { edges: found.nonmanifold_edges });
    let vertices = found.nonmanifold_vertices;
    edges.into_iter().chain((vertices > 0).then_some(Warning::NonManifoldVertices { vertices }))
}

fn mesh_file(path: &Path, faces: usize, vertices: usize) -> MeshFile {
    MeshFile { path: path.into(), faces: faces as u64, vertices: vertices as u64 }
}

/// Seconds between laps.
struct Clock(Instant);

impl Clock {
    fn new(begun: Instant) -> Self {
        Clock(begun)
    }

    fn lap(&mut self) -> f64 {
        let seconds = self.0.elapsed().as_secs_f64();
        self.0 = Instant::now();
        seconds
    }
}
