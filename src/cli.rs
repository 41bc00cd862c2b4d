//! The command line, as typed: what each word means is `job`'s business.

use clap::{Args, Parser, Subcommand};
use std::path::PathBuf;

use meshmill::budget::Size;
use meshmill::collapse::{FoldCheck, Placement, Primitive, Quadrics, Topology, Weighting};
use meshmill::job::{
    CollapseTable, Compactness, ComparisonSaid, Count, Degrees, InspectionSaid, JobFile, Length, MinComponent, Pairs,
    Ratio, RefitTable, RenderingSaid, ReportTable, Rounds, RunTable, ScanTable, Scans, Threads, Weight,
};
use meshmill::queue::Shard;
use meshmill::write::{Format, is_stdout};
use serde::Deserialize;
use serde::de::value::{Error as WordError, StrDeserializer};

/// Reduces huge meshes to the face count you ask for, in fixed memory
#[derive(Debug, Parser)]
#[command(version, subcommand_required = true, arg_required_else_help = true)]
#[command(
    after_help = "Exit codes: 0 done as asked; 1 a scan failed or an ask was not met; 2 the command or job file is \
                        wrong, or the budget too small; 130 and 143 after SIGINT and SIGTERM."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Reduce one scan
    Reduce(Box<ReduceArgs>),
    /// Reduce what a job file says
    Run(RunArgs),
    /// Measure how far two meshes are from each other, both ways
    Compare(CompareArgs),
    /// Say what is in a scan: counts, attributes, extent, defects, and what a reduction would take
    Inspect(InspectArgs),
    /// Make a realistic scan of any size
    Synth(SynthArgs),
    /// Take a picture of meshes, side by side, seen by the same camera
    Render(RenderArgs),
    /// Work on reports of nights
    Report(ReportArgs),
    /// Measure how fast this machine reduces, beside what is printed of others
    Bench(BenchArgs),
    /// Reduce what stdin says: how `run` works
    #[command(hide = true)]
    Worker(WorkerArgs),
}

/// `meshmill reduce`
#[derive(Debug, Args)]
pub struct ReduceArgs {
    /// The scan: PLY, STL, OBJ, OFF, GLB or glTF 2, also as .gz or .zst; - for standard input
    #[arg(value_name = "IN")]
    input: PathBuf,

    /// The mesh to write: .ply, .stl, .obj or .glb; - for standard output
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,

    /// Write ply, ply-ascii, stl, obj, glb or glb-quantised [default: by OUT's extension; ply to standard output]
    #[arg(long, value_name = "WHICH", value_parser = word::<Format>)]
    format: Option<Format>,

    /// Leave out what the scan's vertices carry beside their positions: colours, normals, any other number
    #[arg(long)]
    no_carry: bool,

    #[command(flatten)]
    target: TargetArgs,

    /// Bound on the whole process's peak resident memory, like 512MiB or 2GiB [default: 512MiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    memory: Option<Size>,

    /// Rounds in which the result moves closer to the scan: 0 for none, 3 to 5 for the closest [default: 1]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    refit: Option<Rounds>,

    #[command(flatten)]
    collapse: CollapseArgs,

    /// Worker threads; the result does not depend on them [default: the cores]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    threads: Option<Threads>,

    /// Folder for spills and for what is unpacked [default: OUT's folder]
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,

    /// The most that may be in that folder at one time [default: 256GiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    scratch_quota: Option<Size>,

    /// Measure the result against the scan, as `compare` does, and report it; with --max-error, exit with 1 where the
    /// measured distance is larger
    #[arg(long)]
    verify: bool,

    /// Samples over the area of each that --verify draws at most, like 200k or 1M [default: 1M]
    #[arg(long, value_name = "N", allow_negative_numbers = true, requires = "verify")]
    samples: Option<Count>,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    json: bool,
}

/// How far to reduce: one of three.
#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct TargetArgs {
    /// At most this many faces, like 140000, 500k or 2.5M
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    faces: Option<Count>,

    /// At most this share of the scan's faces, like 0.1 or 10%
    #[arg(long, value_name = "R", allow_negative_numbers = true)]
    ratio: Option<Ratio>,

    /// As few faces as keep this distance, in the scan's units, as estimated
    #[arg(long, value_name = "LENGTH", allow_negative_numbers = true)]
    max_error: Option<Length>,
}

/// The policies of the collapse.
#[derive(Debug, Args)]
#[command(next_help_heading = "Policies")]
struct CollapseArgs {
    /// Quadrics that place and price: current or accumulated (the thesis's) [default: current]
    #[arg(long, value_name = "WHICH", value_parser = word::<Quadrics>)]
    quadrics: Option<Quadrics>,

    /// Where merged vertices go: optimal, line, endpoint-or-midpoint or endpoint [default: optimal]
    #[arg(long, value_name = "WHERE", value_parser = word::<Placement>)]
    placement: Option<Placement>,

    /// What faces count by: area, angle or uniform [default: area]
    #[arg(long, value_name = "HOW", value_parser = word::<Weighting>)]
    weighting: Option<Weighting>,

    /// How strongly open borders are held in place [default: 1]
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    boundary_weight: Option<Weight>,

    /// Vertices on borders stay where they are
    #[arg(long)]
    lock_border: bool,

    /// The vertices nearest to the points in this file stay where they are: x y z a line
    #[arg(long, value_name = "FILE")]
    lock_vertices: Option<PathBuf>,

    /// Hold edges whose faces' normals are this many degrees apart or more
    #[arg(long, value_name = "DEGREES", allow_negative_numbers = true)]
    feature_angle: Option<Degrees>,

    /// How strongly such edges are held [default: 1]
    #[arg(long, value_name = "W", allow_negative_numbers = true, requires = "feature_angle")]
    feature_weight: Option<Weight>,

    /// Drop pieces of fewer faces than this, or of less area: 100 or area=0.5 (in the scan's units, squared)
    #[arg(long, value_name = "FACES|AREA", allow_negative_numbers = true)]
    min_component: Option<MinComponent>,

    /// What tells that a face would fold over: normals, planes, both or off [default: normals]
    #[arg(long, value_name = "WHICH", value_parser = word::<FoldCheck>)]
    fold_check: Option<FoldCheck>,

    /// Avoid faces less compact than this, from 0 (any) to 1 (equilateral only) [default: 0]
    #[arg(long, value_name = "C", allow_negative_numbers = true)]
    compactness: Option<Compactness>,

    /// Avoid vertices of more than 8 faces: 0 for not, 1 for clearly [default: 0]
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    valence_penalty: Option<Weight>,

    /// How much vertices' colours steer against shape: 0 for not at all [default: 1]
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    colour_weight: Option<Weight>,

    /// How much texture coordinates steer, where the scan fits the budget [default: 1]
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    texture_weight: Option<Weight>,

    /// How much normals steer: 0 for not at all [default: 1]
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    normal_weight: Option<Weight>,

    /// simplify: holes close, handles and pieces vanish; preserve: they stay [default: simplify]
    #[arg(long, value_name = "WHAT", value_parser = word::<Topology>)]
    topology: Option<Topology>,

    /// Vertices of different pieces, or on borders, may merge when closer than this: a length, or auto
    #[arg(long, value_name = "LENGTH|auto", allow_negative_numbers = true)]
    pair_distance: Option<Pairs>,

    /// What collapses among the last faces, within five times the target: edge or face [default: edge]
    #[arg(long, value_name = "WHICH", value_parser = word::<Primitive>)]
    primitive: Option<Primitive>,
}

/// One of the words that a job file takes.
fn word<T: for<'de> Deserialize<'de>>(text: &str) -> Result<T, WordError> {
    T::deserialize(StrDeserializer::new(text))
}

/// `meshmill run`
#[derive(Debug, Args)]
pub struct RunArgs {
    /// The job file; the paths in it are relative to its folder
    #[arg(value_name = "JOB.toml")]
    pub job: PathBuf,

    /// Do nothing, but print what would be done: of one scan the job with every default filled in, of many the plan
    #[arg(long)]
    pub dry_run: bool,

    /// Of many scans every N-th alone, beginning with the I-th, for an array of machines or processes
    #[arg(long, value_name = "I/N")]
    pub shard: Option<Shard>,

    /// Of many scans those alone whose path contains this, though they are done
    #[arg(long, value_name = "TEXT")]
    pub only: Option<String>,

    /// Of many scans begin those that can be done, though others cannot
    #[arg(long)]
    pub keep_going: bool,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    pub json: bool,
}

/// `meshmill compare`
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// The mesh whose diagonal shares are of, such as a scan, in any format that `reduce` reads
    #[arg(value_name = "A")]
    a: PathBuf,

    /// The mesh to hold against it, such as the scan reduced
    #[arg(value_name = "B")]
    b: PathBuf,

    /// Samples over the area of each mesh, like 200k or 1M [default: 1M]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    samples: Option<Count>,

    /// Measure every vertex, not 200,000 of each mesh at most
    #[arg(long)]
    every_vertex: bool,

    /// Draws other samples; the same seed draws the same
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,

    /// Bound on the whole process's peak resident memory, like 512MiB or 2GiB [default: 512MiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    memory: Option<Size>,

    /// Worker threads; the result does not depend on them [default: the cores]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    threads: Option<Threads>,

    /// Folder for spills and for what is unpacked [default: the heat map's folder, or the one the program runs in]
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,

    /// The most that may be in that folder at one time [default: 256GiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    scratch_quota: Option<Size>,

    /// Write the smaller mesh with the deviation of its vertices as colours and as a property, binary PLY
    #[arg(long, value_name = "OUT.ply")]
    heatmap: Option<PathBuf>,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    pub json: bool,
}

/// `meshmill inspect`
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// The scan, in any format that `reduce` reads
    #[arg(value_name = "IN")]
    input: PathBuf,

    /// Say what a reduction to this many faces would take
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    faces: Option<Count>,

    /// Say what a reduction to this share of the faces would take [default: 1%]
    #[arg(long, value_name = "R", allow_negative_numbers = true, conflicts_with = "faces")]
    ratio: Option<Ratio>,

    /// Bound on the whole process's peak resident memory: what it has no room for is not said [default: 512MiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    memory: Option<Size>,

    /// Worker threads; what is found does not depend on them [default: the cores]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    threads: Option<Threads>,

    /// Folder for spills and for what is unpacked [default: the one the program runs in]
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,

    /// The most that may be in that folder at one time [default: 256GiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    scratch_quota: Option<Size>,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    pub json: bool,
}

impl From<InspectArgs> for InspectionSaid {
    fn from(args: InspectArgs) -> Self {
        let InspectArgs { input, faces, ratio, memory, threads, scratch, scratch_quota, json: _ } = args;
        InspectionSaid { input, faces, ratio, memory, threads, scratch, scratch_quota }
    }
}

/// `meshmill synth`
#[derive(Debug, Args)]
pub struct SynthArgs {
    /// The scan to write, binary: .ply or .stl; - for standard output
    #[arg(value_name = "OUT")]
    pub output: PathBuf,

    /// This many faces, like 500k or 28M (one fewer where that is odd)
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub faces: Count,

    /// The same seed and count give the same bytes
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub seed: u64,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    pub json: bool,
}

impl CompareArgs {
    /// Whether the heat map goes to standard output.
    pub fn shades_to_stdout(&self) -> bool {
        self.heatmap.as_deref().is_some_and(is_stdout)
    }
}

/// `meshmill render`
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Meshes: PLY or STL, binary or ASCII; the first decides where all are seen from
    #[arg(value_name = "MESH", required = true)]
    meshes: Vec<PathBuf>,

    /// The picture to write: .png
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,

    /// Pixels of each mesh's picture, across [default: 640]
    #[arg(long, value_name = "PIXELS")]
    width: Option<usize>,

    /// Pixels of each mesh's picture, down [default: by the first mesh's shape]
    #[arg(long, value_name = "PIXELS")]
    height: Option<usize>,

    /// A second row of pictures, closer by this factor
    #[arg(long, value_name = "FACTOR", allow_negative_numbers = true)]
    zoom: Option<f64>,

    /// What is in the middle of the second row: X,Y,Z [default: where most is to be seen]
    #[arg(long, value_name = "X,Y,Z", value_parser = place, allow_hyphen_values = true, requires = "zoom")]
    at: Option<[f64; 3]>,

    /// Draw the edges of triangles
    #[arg(long)]
    edges: bool,

    /// Bound on the whole process's peak resident memory, like 512MiB or 2GiB [default: 512MiB]
    #[arg(long, value_name = "SIZE", allow_negative_numbers = true)]
    memory: Option<Size>,

    /// Worker threads; the picture does not depend on them [default: the cores]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    threads: Option<Threads>,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    pub json: bool,
}

/// `meshmill report`
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// What to do.
    #[command(subcommand)]
    pub command: ReportCommand,
}

/// What to do with reports.
#[derive(Debug, Subcommand)]
pub enum ReportCommand {
    /// Join the reports of shards
    Merge(MergeArgs),
}

/// `meshmill report merge`
#[derive(Debug, Args)]
pub struct MergeArgs {
    /// Reports of shards: report.1-of-8.json and so on
    #[arg(value_name = "REPORT.json", required = true)]
    pub reports: Vec<PathBuf>,

    /// The folder for report.html, report.json and report.csv [default: the first report's]
    #[arg(short, long, value_name = "DIR")]
    pub output: Option<PathBuf>,

    /// One JSON object on stdout; words go to stderr
    #[arg(long)]
    pub json: bool,
}

/// `meshmill bench`
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// What to measure.
    #[command(subcommand)]
    pub command: BenchCommand,
}

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Complete decimation of the twelve models of Garland's thesis, and of larger scans
    #[command(name = "table-6.3")]
    Table63(Table63Args),
}

/// `meshmill bench table-6.3`
#[derive(Debug, Args)]
pub struct Table63Args {
    /// The folder of the models, bunny.ply and so on; what is not there is made [default: table63 below MESHMILL_MODELS]
    #[arg(long, value_name = "DIR")]
    pub models: Option<PathBuf>,

    /// Go on with larger scans, like 5M,28M,100M; they are made, 19 bytes a face, one at a time
    #[arg(long = "continue", value_name = "FACES", value_delimiter = ',', allow_negative_numbers = true)]
    pub continued: Vec<Count>,

    /// Bound on resident memory for larger scans
    #[arg(long, value_name = "SIZE", default_value = "1GiB", allow_negative_numbers = true)]
    pub memory: Size,

    /// Threads of the second column, and of larger scans [default: the cores]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub threads: Option<Threads>,

    /// Runs that medians are of
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u8).range(1..=99))]
    pub runs: u8,

    /// Models of this many faces at most: larger ones are made smaller, for a try
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub most_faces: Option<Count>,

    /// Folder for what is made
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub scratch: PathBuf,

    /// Write table-6.3.json and table-6.3.svg into this folder
    #[arg(short, long, value_name = "DIR")]
    pub output: Option<PathBuf>,

    /// One JSON object on stdout; progress and words go to stderr
    #[arg(long)]
    pub json: bool,
}

/// `meshmill worker`
#[derive(Debug, Args)]
pub struct WorkerArgs {
    /// The night's folder
    pub folder: PathBuf,

    /// Tells runs side by side apart
    #[arg(long, default_value = "")]
    pub shard_name: String,
}

/// Three coordinates.
fn place(text: &str) -> Result<[f64; 3], String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|x| x.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
    numbers.and_then(|xs| xs.try_into().ok()).ok_or_else(|| format!("`{text}` is not a place: write it like 1.5,0,-2"))
}

impl From<RenderArgs> for RenderingSaid {
    fn from(args: RenderArgs) -> Self {
        let RenderArgs { meshes, output, width, height, zoom, at, edges, memory, threads, json: _ } = args;
        RenderingSaid { meshes, output, width, height, zoom, at, edges, memory, threads }
    }
}

impl From<CompareArgs> for ComparisonSaid {
    fn from(args: CompareArgs) -> Self {
        let CompareArgs { a, b, samples, every_vertex, seed, memory, threads, scratch, .. } = args;
        let CompareArgs { scratch_quota, heatmap, .. } = args;
        ComparisonSaid { a, b, samples, every_vertex, seed, memory, threads, scratch, scratch_quota, heatmap }
    }
}

impl From<ReduceArgs> for JobFile {
    fn from(args: ReduceArgs) -> Self {
        let TargetArgs { faces, ratio, max_error } = args.target;
        let carry = args.no_carry.then_some(false);
        JobFile {
            scan: Scans::One(Box::new(ScanTable {
                input: vec![args.input],
                output: Some(args.output),
                format: args.format,
                carry,
                faces: faces.into_iter().collect(),
                ratio: ratio.into_iter().collect(),
                max_error,
                ..Default::default()
            })),
            run: RunTable {
                memory: args.memory,
                threads: args.threads,
                scratch: args.scratch,
                scratch_quota: args.scratch_quota,
            },
            collapse: args.collapse.into(),
            refit: RefitTable { rounds: args.refit },
            report: ReportTable { json: Some(args.json), verify: Some(args.verify), samples: args.samples },
            ..Default::default()
        }
    }
}

impl From<CollapseArgs> for CollapseTable {
    fn from(args: CollapseArgs) -> Self {
        CollapseTable {
            quadrics: args.quadrics,
            placement: args.placement,
            weighting: args.weighting,
            boundary_weight: args.boundary_weight,
            lock_border: args.lock_border.then_some(true),
            lock_vertices: args.lock_vertices,
            feature_angle: args.feature_angle,
            feature_weight: args.feature_weight,
            min_component: args.min_component,
            fold_check: args.fold_check,
            compactness: args.compactness,
            valence_penalty: args.valence_penalty,
            colour_weight: args.colour_weight,
            texture_weight: args.texture_weight,
            normal_weight: args.normal_weight,
            topology: args.topology,
            pair_distance: args.pair_distance,
            primitive: args.primitive,
        }
    }
}
