//! A job: what was said ([`JobFile`], from a file or the command line) and what will be done ([`Job`], resolved).

mod comparison;
mod file;
mod inspection;
mod night;
mod points;
mod quantity;
mod rendering;
mod scans;

pub use comparison::{Comparison, ComparisonSaid};
pub use file::{ClusterTable, CollapseTable, JobFile, RefitTable, ReportTable, RunTable};
pub use inspection::{Inspection, InspectionSaid};
pub use night::{NightTable, Order, Span, TimeOfDay};
pub use points::read_points;
pub use quantity::{Compactness, Count, Degrees, Length, MinComponent, Pairs, Ratio, Rounds, Threads, Weight};
pub use rendering::{DEFAULT_WIDTH, Rendering, RenderingSaid};
pub use scans::{ScanTable, Scans};

use std::path::{Path, PathBuf};

use crate::budget::{MIB, Size};
use crate::cluster::Representative;
use crate::collapse::{Features, Placement, Policies, Primitive, Topology};
use crate::error::{Error, Result};
use crate::measure::DEFAULT_SAMPLES;
use crate::scratch::{DEFAULT_QUOTA, Scratch};
use crate::write::{Format, is_stdout};

/// The budget when none is said: the same on every machine, so that the bytes of a result do not depend on it.
pub const DEFAULT_MEMORY: Size = Size(512 * MIB);

/// How strongly feature edges are held when nothing is said.
pub const DEFAULT_FEATURE_WEIGHT: f64 = 1.0;

/// Rounds of refit when nothing is said: the first one gives most, and takes about a tenth of the time.
pub const DEFAULT_REFIT_ROUNDS: u32 = 1;

/// How far to reduce.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// To the first count at or below this many faces.
    Faces(u64),
    /// To this share of the scan's faces, above 0 and up to 1.
    Ratio(f64),
    /// To as few faces as keep the estimated largest distance, both ways, within this length in the scan's units.
    MaxError(f64),
}

/// What is said in layers, one over another.
pub trait Layer {
    /// This, and where it says nothing what is below it.
    fn over(self, below: Self) -> Self;
}

/// One more mesh of the same scan.
#[derive(Debug, Clone, PartialEq)]
pub struct Level {
    /// How far to reduce.
    pub target: Target,
    /// The mesh to write.
    pub output: PathBuf,
    /// In which format.
    pub format: Format,
}

impl Target {
    /// The larger, the more is kept.
    fn fineness(self) -> f64 {
        match self {
            Target::Faces(n) => n as f64,
            Target::Ratio(r) => r,
            Target::MaxError(x) => -x,
        }
    }

    /// The count that is asked of a scan of `scan_faces` faces; `None` where a distance is asked instead.
    pub fn faces(self, scan_faces: u64) -> Option<u64> {
        match self {
            Target::Faces(n) => Some(n),
            Target::Ratio(r) => Some(share_of(scan_faces, r)),
            Target::MaxError(_) => None,
        }
    }
}

impl std::fmt::Display for Target {
    /// As a person would write it, and as part of a file's name: `2M`, `1500`, `10pct`, `0.05`.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match *self {
            Target::Faces(n) if n > 0 && n.is_multiple_of(1_000_000) => write!(f, "{}M", n / 1_000_000),
            Target::Faces(n) if n > 0 && n.is_multiple_of(1000) => write!(f, "{}k", n / 1000),
            Target::Faces(n) => write!(f, "{n}"),
            // Not by multiplication: 0.07 times 100 has a tail.
            Target::Ratio(r) => write!(f, "{}pct", format!("{r}e2").parse().unwrap_or(100.0 * r)),
            Target::MaxError(x) => write!(f, "{x}"),
        }
    }
}

/// `⌊faces × ratio⌋` of the ratio as it is written in decimals: 29 % of 100 is 29, though `100.0 * 0.29` is below it.
fn share_of(faces: u64, ratio: f64) -> u64 {
    let written = ratio.to_string();
    let (whole, decimals) = written.split_once('.').unwrap_or((&written, ""));
    let digits: Option<u128> = format!("{whole}{decimals}").parse().ok();
    let scale = u32::try_from(decimals.len()).ok().and_then(|n| 10u128.checked_pow(n));
    let share = match (digits.and_then(|d| d.checked_mul(u128::from(faces))), scale) {
        (Some(product), Some(scale)) => product / scale,
        // A ratio with more than 38 decimals: no scan has a face's worth of difference there.
        _ => (faces as f64 * ratio) as u128,
    };
    u64::try_from(share).unwrap_or(faces).min(faces)
}

/// A job with every default filled in and every value checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// The scan to read.
    pub input: PathBuf,
    /// The mesh to write.
    pub output: PathBuf,
    /// In which format.
    pub format: Format,
    /// How far to reduce.
    pub target: Target,
    /// Further meshes, each coarser than the one before it.
    pub coarser: Vec<Level>,
    /// Bound on the whole process's peak resident set.
    pub memory: Size,
    /// Worker threads, at least 1; changes nothing in the result.
    pub threads: usize,
    /// Folder for spills; [`Job::scratch_folder`] fills in the default.
    pub scratch: Option<PathBuf>,
    /// What may be in it at one time.
    pub scratch_quota: Size,
    /// How clustering places a cell's vertex.
    pub representative: Representative,
    /// How the collapse is steered; lengths are in the scan's units.
    pub policies: Policies,
    /// A list of points: the vertices nearest to them stay where they are.
    pub lock_vertices: Option<PathBuf>,
    /// Whether the result gets what the scan's vertices carry.
    pub carry: bool,
    /// Rounds of refit.
    pub refit_rounds: u32,
    /// Whether the result is measured against the scan.
    pub verify: bool,
    /// Samples over the area of each that it is measured with, at most.
    pub samples: u64,
}

impl JobFile {
    /// Fills in the defaults of a job of one scan and one mesh.
    pub fn resolve(self) -> Result<Job> {
        let output = match &self.scan {
            Scans::One(scan) => scan.output.clone(),
            Scans::Several(_) => None,
        };
        let output = output.ok_or_else(|| Error::usage("a job of one scan says where its mesh goes"))?;
        self.resolve_to(vec![output])
    }

    /// Fills in the defaults of a job of one scan, whose meshes go there: one for each target, the finest first.
    pub fn resolve_to(self, outputs: Vec<PathBuf>) -> Result<Job> {
        let Scans::One(scan) = self.scan else { return Err(Error::usage("more than one scan")) };
        let mut targets = scan.targets().map_err(Error::usage)?;
        let [input] = &scan.input[..] else { return Err(Error::usage("more than one scan")) };
        if targets.len() != outputs.len() {
            return Err(Error::usage("one mesh is written for each target"));
        }
        let target = targets.remove(0);
        let mut outputs = outputs.into_iter();
        let output = outputs.next().unwrap_or_default();
        let format_of = |output: &Path| scan.format.map_or_else(|| Format::of(output), Ok);
        let level = |(target, output): (Target, PathBuf)| {
            let format = format_of(&output)?;
            Ok(Level { target, output, format })
        };
        let coarser = targets.into_iter().zip(outputs).map(level).collect::<Result<_>>()?;

        let policies = self.collapse.policies();
        if self.collapse.feature_weight.is_some() && self.collapse.feature_angle.is_none() {
            return Err(Error::usage(
                "`feature_weight` says how strongly edges are held: say `feature_angle`, from which on",
            ));
        }
        let serial = policies.pair_distance.is_some() || policies.primitive == Primitive::Face;
        if serial && (scan.max_error.is_some() || policies.topology == Topology::Preserve) {
            let what = "a pair distance and primitive `face` work on the way to a count of faces";
            return Err(Error::usage(format!("{what}: they go with neither `max_error` nor topology `preserve`")));
        }
        if policies.primitive == Primitive::Face && (policies.compactness > 0.0 || policies.valence_penalty > 0.0) {
            let what =
                "penalties are on collapses of edges: say primitive `edge`, or no compactness and valence penalty";
            return Err(Error::usage(what));
        }
        let refit_rounds = match self.refit.rounds {
            Some(Rounds(n)) if n > 0 && policies.placement == Placement::Endpoint => {
                let what = "placement `endpoint` leaves vertices where they are in the scan, and refit moves them";
                return Err(Error::usage(format!("{what}: say `refit` 0 or another placement")));
            }
            Some(Rounds(n)) => n,
            None if policies.placement == Placement::Endpoint => 0,
            None => DEFAULT_REFIT_ROUNDS,
        };
        let format = format_of(&output)?;
        if is_stdout(&output) {
            let taken = [(self.report.json, "the report in JSON"), (self.report.verify, "what `verify` measures")];
            if let Some((_, what)) = taken.into_iter().find(|(asked, _)| *asked == Some(true)) {
                return Err(Error::usage(format!(
                    "{what} and the mesh cannot both go to standard output: name a file"
                )));
            }
        }
        Ok(Job {
            format,
            target,
            coarser,
            input: input.clone(),
            output,
            memory: self.run.memory.unwrap_or(DEFAULT_MEMORY),
            threads: self.run.threads.map_or_else(cores, |Threads(n)| n),
            scratch: self.run.scratch,
            scratch_quota: self.run.scratch_quota.unwrap_or(DEFAULT_QUOTA),
            representative: self.cluster.representative.unwrap_or_default(),
            policies,
            lock_vertices: self.collapse.lock_vertices,
            carry: scan.carry.unwrap_or(true),
            refit_rounds,
            verify: self.report.verify.unwrap_or(false),
            samples: self.report.samples.map_or(DEFAULT_SAMPLES, |Count(n)| n),
        })
    }
}

impl CollapseTable {
    /// What was said, the rest by default.
    fn policies(&self) -> Policies {
        let usual = Policies::default();
        Policies {
            quadrics: self.quadrics.unwrap_or(usual.quadrics),
            placement: self.placement.unwrap_or(usual.placement),
            weighting: self.weighting.unwrap_or(usual.weighting),
            boundary_weight: self.boundary_weight.map_or(usual.boundary_weight, |Weight(w)| w),
            lock_border: self.lock_border.unwrap_or(usual.lock_border),
            features: self.feature_angle.map(|Degrees(angle)| {
                let weight = self.feature_weight.map_or(DEFAULT_FEATURE_WEIGHT, |Weight(w)| w);
                Features { angle, weight }
            }),
            min_component: self.min_component.map(|MinComponent(least)| least),
            fold_check: self.fold_check.unwrap_or(usual.fold_check),
            compactness: self.compactness.map_or(usual.compactness, |Compactness(c)| c),
            valence_penalty: self.valence_penalty.map_or(usual.valence_penalty, |Weight(w)| w),
            colour_weight: self.colour_weight.map_or(usual.colour_weight, |Weight(w)| w),
            texture_weight: self.texture_weight.map_or(usual.texture_weight, |Weight(w)| w),
            normal_weight: self.normal_weight.map_or(usual.normal_weight, |Weight(w)| w),
            topology: self.topology.unwrap_or(usual.topology),
            pair_distance: self.pair_distance.map(|Pairs(distance)| distance),
            primitive: self.primitive.unwrap_or(usual.primitive),
        }
    }
}

impl From<Policies> for CollapseTable {
    fn from(policies: Policies) -> Self {
        CollapseTable {
            quadrics: Some(policies.quadrics),
            placement: Some(policies.placement),
            weighting: Some(policies.weighting),
            boundary_weight: Some(Weight(policies.boundary_weight)),
            lock_border: Some(policies.lock_border),
            lock_vertices: None,
            feature_angle: policies.features.map(|features| Degrees(features.angle)),
            feature_weight: policies.features.map(|features| Weight(features.weight)),
            min_component: policies.min_component.map(MinComponent),
            fold_check: Some(policies.fold_check),
            compactness: Some(Compactness(policies.compactness)),
            valence_penalty: Some(Weight(policies.valence_penalty)),
            colour_weight: Some(Weight(policies.colour_weight)),
            texture_weight: Some(Weight(policies.texture_weight)),
            normal_weight: Some(Weight(policies.normal_weight)),
            topology: Some(policies.topology),
            pair_distance: policies.pair_distance.map(Pairs),
            primitive: Some(policies.primitive),
        }
    }
}

/// The cores that this process may use.
pub fn cores() -> usize {
    crate::cores::count().min(Threads::MOST)
}

impl Job {
    /// The folder for spills: the one that was said, otherwise the target's.
    pub fn scratch_folder(&self) -> &Path {
        match (&self.scratch, self.output.parent()) {
            (Some(folder), _) => folder,
            (None, Some(folder)) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        }
    }

    /// Where spills go, and how much of them.
    pub fn scratch(&self) -> Scratch {
        Scratch::in_folder(self.scratch_folder()).with_quota(self.scratch_quota.0).with_memory(self.memory.0)
    }

    /// The job file that says this job in full: nothing is left to a default.
    pub fn said(&self) -> JobFile {
        let input = vec![self.input.clone()];
        let (format, carry) = (Some(self.format), Some(self.carry));
        let mut scan = ScanTable { input, output: Some(self.output.clone()), format, carry, ..Default::default() };
        for target in std::iter::once(self.target).chain(self.coarser.iter().map(|level| level.target)) {
            match target {
                Target::Faces(n) => scan.faces.push(Count(n)),
                Target::Ratio(r) => scan.ratio.push(Ratio(r)),
                Target::MaxError(x) => scan.max_error = Some(Length(x)),
            }
        }
        JobFile {
            scan: Scans::One(scan.into()),
            night: None,
            run: RunTable {
                memory: Some(self.memory),
                threads: Some(Threads(self.threads)),
                scratch: Some(self.scratch_folder().into()),
                scratch_quota: Some(self.scratch_quota),
            },
            cluster: ClusterTable { representative: Some(self.representative) },
            collapse: CollapseTable { lock_vertices: self.lock_vertices.clone(), ..self.policies.into() },
            refit: RefitTable { rounds: Some(Rounds(self.refit_rounds)) },
            report: ReportTable { verify: Some(self.verify), samples: Some(Count(self.samples)), json: None },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(rest: &str) -> Job {
        JobFile::parse(&format!("[scan]\ninput = 'in/a.ply'\noutput = 'out/b.ply'\n{rest}")).unwrap().resolve().unwrap()
    }

    #[test]
    fn defaults_are_filled_in() {
        let job = job("faces = '140k'");
        assert_eq!((job.target, job.memory), (Target::Faces(140_000), Size(512 << 20)));
        assert!(job.threads >= 1);
        assert_eq!(job.scratch_folder(), Path::new("out"));
        assert_eq!((job.representative, job.policies), (Representative::Quadric, Policies::default()));
    }

    #[test]
    fn what_is_said_is_kept() {
        let job = job("ratio = '10%'\n[run]\nmemory = '1.5GiB'\nthreads = 3\nscratch = 's'\n[cluster]\n\
                       representative = 'mean'\n[collapse]\nboundary_weight = 4\nquadrics = 'accumulated'\n\
                       placement = 'endpoint-or-midpoint'\nweighting = 'angle'\nlock_border = true\n\
                       lock_vertices = 'horns.txt'\nfeature_angle = 40\nmin_component = 'area=0.5'\nfold_check = 'both'\n\
                       compactness = 0.2\nvalence_penalty = 1\ntopology = 'preserve'\n[refit]\nrounds = 0");
        assert_eq!((job.target, job.memory, job.threads), (Target::Ratio(0.1), Size(3 << 29), 3));
        assert_eq!((job.scratch_folder(), job.policies.boundary_weight), (Path::new("s"), 4.0));
        assert_eq!(job.policies.placement, Placement::EndpointOrMidpoint);
        assert_eq!(job.refit_rounds, 0);
        assert_eq!(job.representative, Representative::Mean);
        assert_eq!(job.said().resolve().unwrap(), job);
    }

    #[test]
    fn policies_that_contradict_one_another_are_refused() {
        for policies in [
            "faces = 9\n[collapse]\npair_distance = 'auto'\ntopology = 'preserve'",
            "max_error = 9\n[collapse]\npair_distance = 0.5",
            "faces = 9\n[collapse]\nfeature_weight = 3",
            "max_error = 9\n[collapse]\nprimitive = 'face'",
            "faces = 9\n[collapse]\nprimitive = 'face'\ncompactness = 0.5",
        ] {
            let said = JobFile::parse(&format!("[scan]\ninput = 'a'\noutput = 'b'\n{policies}")).unwrap();
            assert_eq!(said.resolve().unwrap_err().exit_code(), 2, "{policies}");
        }
    }

    #[test]
    fn vertices_that_stay_are_not_refitted() {
        assert_eq!(job("faces = 9\n[collapse]\nplacement = 'endpoint'").refit_rounds, 0);
        let both =
            "[scan]\ninput = 'a'\noutput = 'b'\nfaces = 9\n[collapse]\nplacement = 'endpoint'\n[refit]\nrounds = 1";
        assert_eq!(JobFile::parse(both).unwrap().resolve().unwrap_err().exit_code(), 2);
    }

    #[test]
    fn a_share_is_rounded_down_from_its_decimals() {
        for (faces, ratio, share) in
            [(100, 0.29, 29), (69_451, 0.1, 6945), (5, 1.0, 5), (3, 0.333, 0), (u64::MAX, 1.0, u64::MAX)]
        {
            assert_eq!(Target::Ratio(ratio).faces(faces), Some(share), "{ratio} of {faces}");
        }
        assert_eq!(Target::Ratio(1e-300).faces(1 << 40), Some(0));
        assert_eq!(Target::Ratio(f64::from_bits(1.0f64.to_bits() - 1)).faces(u64::MAX), Some(u64::MAX - 1845));
        assert_eq!(Target::MaxError(1.0).faces(9), None);
    }
}
