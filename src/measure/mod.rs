//! Measuring: how far two meshes are from each other, both ways, with only the smaller one in memory.
//!
//! From points spread over each mesh, exact distances to the nearest triangle of the other: the sampled `E_avg` and `E_max`
//! of Garland's thesis (equations 2.8 and 2.7) and the mean, root mean square and largest distance of each way. Points are
//! samples spread evenly over the area, and vertices at an even stride. As in the thesis, `E_avg` and `E_max` are taken over
//! all of them, each counting once; mean and RMS are taken over the area's samples alone, so that they are those of the
//! surface, however its vertices are spread.
//!
//! The smaller mesh is *held*: loaded, welded, under a tree of boxes over its triangles ([`Tree`]). The larger one *streams*
//! past twice:
//!
//! 1. its area and extent are added up, and a point is kept of every so many faces;
//! 2. every face draws its own samples, whose nearest triangles the tree finds: the way from the larger to the smaller. And
//!    every 64 faces that follow one another are a *patch*, which goes down a tree of the held mesh's points (*probes*), each
//!    of which knows the nearest it has met: the way from the smaller to the larger. That begins with the distance to the
//!    points that were kept, so that a patch meets the few probes in its neighbourhood and no others.
//!
//! **Promises.** Every distance is measured in doubles between positions as the files have them; single precision only rules
//! out what cannot be nearest. The figures depend on the two files, the number of samples and the seed: which is held, and
//! so which is read in which order, changes nothing but where samples fall, and threads and memory change nothing at all,
//! since least and largest numbers do not depend on an order and sums are exact (`tally.rs`). Distances that rounding alone
//! can make, below 2⁻⁴⁶ of the largest coordinate, are 0, so equal files give zeros.
//!
//! **Does not promise** the largest distance of the surfaces, only that of the points measured, and says nothing of which
//! side or sheet the nearest triangle belongs to. Vertices that a streamed soup repeats count as often as it has them.
//!
//! **Memory**, in bytes ([`Needs`] adds them up before anything is read):
//!
//! | | held throughout | more, for a while |
//! |---|--:|--:|
//! | held mesh, a vertex | 12 (24 in doubles) | 10 to 16 while it is welded |
//! | held mesh, a face | 12 | |
//! | tree, a face | 13.4 | 16 while it is built |
//! | probes, each | 42 | 40 while they are made |
//! | points kept of the larger mesh, each | | 48 |
//! | chosen vertices of the larger mesh | ⅛ each | |
//! | its positions, a vertex | 12 (24), where they fit; else on scratch | |
//! | a worker | 2.3 MiB, and the windows of a streaming pass | |

mod heatmap;
mod pass;
mod patch;
mod probes;
mod sample;
mod sizing;
mod tally;

pub use heatmap::Scale;
pub use sizing::{Needs, bytes_per_worker};

use crate::error::{Error, Result};
use crate::facets::{Stream, Stride};
use crate::mesh::boxes::Origin;
use crate::mesh::{Coordinate, Extent, Frame, IndexedMesh, Tree};
use crate::progress::Stage;
use crate::read::{Crew, Scalar, Scan, load};
use crate::scratch::Scratch;
use pass::{Kept, Measuring, Survey};
use probes::{Points, Probes};
use sample::{Spread, area_of};
use tally::{Sum, Tally};

/// Vertices of a mesh that are measured at most when nothing is said.
pub const MOST_VERTICES: u64 = 200_000;

/// Samples over the area of each mesh when nothing is said.
pub const DEFAULT_SAMPLES: u64 = 1_000_000;

/// What is measured, and within what.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Options {
    /// Samples over the area of each mesh, about.
    pub samples: u64,
    /// Vertices of each mesh that are measured, at most: [`MOST_VERTICES`] unless every one is asked for.
    pub most_vertices: u64,
    /// The same seed draws the same samples.
    pub seed: u64,
    /// Whether the deviation of every vertex of the held mesh is kept.
    pub shades: bool,
    /// Bytes that all arrays may take together.
    pub array_bytes: u64,
}

impl Options {
    fn stride(&self, vertices: u64) -> Stride {
        Stride::new(vertices, self.most_vertices)
    }
}

/// Two meshes, and which of them is held.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// The first; its diagonal is what shares are of.
    pub a: &'a Scan,
    /// The second.
    pub b: &'a Scan,
}

impl<'a> Pair<'a> {
    /// Whether the first is held: it has fewer faces than the second.
    pub fn holds_a(&self) -> bool {
        self.a.triangle_count() < self.b.triangle_count()
    }

    /// The smaller one.
    pub fn held(&self) -> &'a Scan {
        if self.holds_a() { self.a } else { self.b }
    }

    /// The other.
    pub fn streamed(&self) -> &'a Scan {
        if self.holds_a() { self.b } else { self.a }
    }
}

/// How far two meshes are from each other, in the file's units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Length of the diagonal of the first mesh's box.
    pub diagonal: f64,
    /// From the first to the second.
    pub a_to_b: Way,
    /// From the second to the first.
    pub b_to_a: Way,
}

/// Distances from the points of one mesh to the other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Way {
    /// Samples over the area.
    pub area_samples: u64,
    /// Vertices measured.
    pub vertices: u64,
    /// Mean distance, over the area's samples.
    pub mean: f64,
    /// Root mean square, over the area's samples.
    pub rms: f64,
    /// The largest distance of all points.
    pub max: f64,
    /// Where that is.
    pub farthest: [f64; 3],
    /// The mean square, over all points.
    pub mean_square: f64,
}

impl Way {
    /// Points in all.
    pub fn samples(&self) -> u64 {
        self.area_samples + self.vertices
    }
}

impl Deviation {
    /// The mean squared distance over the points of both meshes (the thesis's equation 2.8).
    pub fn e_avg(&self) -> f64 {
        let of = |way: &Way| if way.samples() == 0 { 0.0 } else { way.mean_square * way.samples() as f64 };
        (of(&self.a_to_b) + of(&self.b_to_a)) / self.samples() as f64
    }

    /// The largest distance of all points of both meshes (equation 2.7).
    pub fn e_max(&self) -> f64 {
        self.a_to_b.max.max(self.b_to_a.max)
    }

    /// The mean of both ways' means.
    pub fn mean(&self) -> f64 {
        0.5 * (self.a_to_b.mean + self.b_to_a.mean)
    }

    /// The root of the mean of both ways' mean squares.
    pub fn rms(&self) -> f64 {
        (0.5 * (self.a_to_b.rms.powi(2) + self.b_to_a.rms.powi(2))).sqrt()
    }

    /// Points in all.
    pub fn samples(&self) -> u64 {
        self.a_to_b.samples() + self.b_to_a.samples()
    }
}

/// What a measurement leaves.
#[derive(Debug)]
pub struct Measured<S> {
    /// The figures.
    pub deviation: Deviation,
    /// The mesh that was held.
    pub mesh: IndexedMesh<S>,
    /// Its frame.
    pub frame: Frame,
    /// The deviation of each of its vertices, in the file's units, where [`Options::shades`] asks for them.
    pub shades: Vec<f64>,
}

/// Measures two meshes. `S` should be the scalar of the one that is held.
pub fn measure<S: Coordinate>(pair: Pair, crew: &Crew, scratch: &Scratch, options: &Options) -> Result<Measured<S>> {
    let needs = Needs::of::<S>(&pair, options);
    needs.check(options.array_bytes)?;
    let (held, streamed) = (pair.held(), pair.streamed());
    crew.progress.begin(Stage::Measure, held.bytes() + 2 * streamed.bytes());
    let most_vertices = needs.most_vertices(options.array_bytes);
    let Some((mesh, frame, loaded)) = load::<S>(held, crew, most_vertices)? else {
        return Err(needs.too_many_vertices());
    };
    let run = Run { pair, crew, scratch, options, needs, mesh: &mesh, frame, extent: loaded.extent };
    let found = match streamed.scalar() {
        Scalar::F32 => run.against::<f32>()?,
        Scalar::F64 => run.against::<f64>()?,
    };
    let Found { deviation, shades } = found;
    Ok(Measured { deviation, mesh, frame, shades })
}

/// A measurement under way.
struct Run<'a, S> {
    pair: Pair<'a>,
    crew: &'a Crew<'a>,
    scratch: &'a Scratch,
    options: &'a Options,
    needs: Needs,
    mesh: &'a IndexedMesh<S>,
    frame: Frame,
    /// The held mesh's box, in the file's units.
    extent: Extent,
}

struct Found {
    deviation: Deviation,
    shades: Vec<f64>,
}

impl<S: Coordinate> Run<'_, S> {
    fn against<T: Coordinate>(&self) -> Result<Found> {
        let (streamed, crew, options) = (self.pair.streamed(), self.crew, self.options);
        let tree = Tree::build(self.mesh);
        crew.progress.check()?;
        let mut probes = self.probes()?;
        crew.progress.check()?;

        let spare = self.needs.spare(options.array_bytes, self.mesh);
        let stride = options.stride(streamed.vertex_count());
        let stream = Stream::<T>::open(streamed, crew, self.scratch, self.frame, stride, spare.positions)?;
        let kept = Kept::new(streamed.triangle_count(), spare.points);
        let survey = stream.faces(crew, false, || Survey::new(self.origin(), kept))?;
        let Survey { area, extent, points, .. } = Survey::merged(survey);
        if points.is_empty() {
            return Err(Error::input(streamed.path(), "has no usable face: none has three distinct corners"));
        }
        let extent = self.in_file_units(&extent);
        self.check_extents(&extent)?;
        probes.begin_with(&Points::new(points), || crew.progress.check().is_ok());
        crew.progress.check()?;

        let nothing_sq = self.nothing_sq(&extent);
        let spread = Spread::new(options.samples, area.value(), options.seed);
        let passes = stream.faces(crew, true, || Measuring::new(&tree, &probes, self.origin(), spread, nothing_sq))?;
        let mut from_streamed = Tally::new(nothing_sq);
        passes.iter().for_each(|pass| from_streamed.merge(&pass.tally));
        let (from_held, shades) = self.tally(&probes, nothing_sq);
        Ok(Found { deviation: self.deviation(&from_held, &from_streamed, &extent), shades })
    }

    fn origin(&self) -> Origin {
        Origin::of(&Extent { min: self.frame.place(self.extent.min), max: self.frame.place(self.extent.max) })
    }

    fn in_file_units(&self, extent: &Extent) -> Extent {
        Extent { min: self.frame.place_back(extent.min), max: self.frame.place_back(extent.max) }
    }

    /// Vertices first (those that are chosen; all of them, if shades are asked for), then samples of the area.
    fn probes(&self) -> Result<Probes> {
        let mesh = self.mesh;
        let stride = self.options.stride(mesh.positions.len() as u64);
        let chosen = |v: &u32| self.options.shades || stride.takes((*v).into());
        let mut points = Vec::with_capacity(self.needs.probes(mesh.positions.len() as u64) as usize);
        points.extend((0..mesh.positions.len() as u32).filter(chosen).map(|v| mesh.at(v)));
        let mut area = Sum::default();
        let corners = |face: &[u32; 3]| face.map(|v| mesh.at(v));
        for [a, b, c] in mesh.faces.iter().map(corners) {
            area.add(area_of(b - a, c - a));
        }
        let spread = Spread::new(self.options.samples, area.value(), self.options.seed);
        for (number, face) in (0u32..).zip(&mesh.faces) {
            if number.is_multiple_of(4096) {
                self.crew.progress.check()?;
            }
            spread.over(number, corners(face), |p| points.push(p));
        }
        self.crew.progress.check()?;
        Ok(Probes::new(points, area.value(), self.origin()))
    }

    /// What the probes have found; with shades, the deviation of each vertex as well.
    fn tally(&self, probes: &Probes, nothing_sq: f64) -> (Tally, Vec<f64>) {
        let vertices = self.mesh.positions.len() as u64;
        let stride = self.options.stride(vertices);
        let shades = self.options.shades;
        let first_sample = if shades { vertices } else { stride.rank(vertices) };
        let mut tally = Tally::new(nothing_sq);
        let mut deviations = vec![0.0; if shades { vertices as usize } else { 0 }];
        for (id, p, distance_sq) in probes.results() {
            let is_vertex = u64::from(id) < first_sample;
            if is_vertex && shades {
                deviations[id as usize] = self.frame.to_file(tally.settle(distance_sq).sqrt());
            }
            if !is_vertex || !shades || stride.takes(id.into()) {
                tally.add(is_vertex, p.to_array(), distance_sq);
            }
        }
        (tally, deviations)
    }

    /// The square of the largest distance that rounding can make of none.
    fn nothing_sq(&self, other: &Extent) -> f64 {
        let largest = |extent: &Extent| extent.min.abs().max(extent.max.abs()).max_element();
        let nothing = self.frame.to_frame(largest(other).max(largest(&self.extent))) / (1u64 << 46) as f64;
        nothing * nothing
    }

    /// Squares of distances must stay within the range of doubles.
    fn check_extents(&self, other: &Extent) -> Result<()> {
        let far = self.extent.union(*other).size().max_element();
        if self.frame.to_frame(far) < 1e100 {
            return Ok(());
        }
        let what = format!(
            "is so far from {}, or so much larger, that squared distances overflow",
            self.pair.held().path().display()
        );
        Err(Error::input(self.pair.streamed().path(), what))
    }

    fn deviation(&self, from_held: &Tally, from_streamed: &Tally, streamed: &Extent) -> Deviation {
        let [from_held, from_streamed] = [from_held, from_streamed].map(|tally| self.way(tally));
        if self.pair.holds_a() {
            Deviation { diagonal: self.extent.diagonal(), a_to_b: from_held, b_to_a: from_streamed }
        } else {
            Deviation { diagonal: streamed.diagonal(), a_to_b: from_streamed, b_to_a: from_held }
        }
    }

    fn way(&self, tally: &Tally) -> Way {
        let length = |x: f64| self.frame.to_file(x);
        let (area, vertices) = (&tally.area, &tally.vertices);
        let n = area.count as f64;
        let samples = (area.count + vertices.count) as f64;
        let mean_square = (area.squares.value() + vertices.squares.value()) / samples;
        Way {
            area_samples: area.count,
            vertices: vertices.count,
            mean: length(area.lengths.value() / n),
            rms: length((area.squares.value() / n).sqrt()),
            max: length(tally.farthest.map_or(f64::NAN, |farthest| farthest.distance_sq.sqrt())),
            farthest: tally.farthest.map_or([f64::NAN; 3], |farthest| farthest.at).map(length),
            mean_square: length(length(mean_square)),
        }
    }
}

#[cfg(test)]
mod tests;
