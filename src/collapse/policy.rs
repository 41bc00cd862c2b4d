//! The policies: what can be chosen of the collapse, and what is when nothing is said.

use crate::mesh::Frame;
use serde::{Deserialize, Serialize};

/// Everything that can be chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Policies {
    /// Which quadrics place and price.
    pub quadrics: Quadrics,
    /// Where merged vertices go.
    pub placement: Placement,
    /// How much each face's plane counts.
    pub weighting: Weighting,
    /// Weight of border edges against area: a border edge's squared length times this is the weight of the squared distance
    /// to its line. 0 lets borders shrink (4 times E_avg on a terrain), 10 costs 3 % of E_avg on the bunny.
    pub boundary_weight: f64,
    /// Whether vertices on borders stay where they are.
    pub lock_border: bool,
    /// Edges that are held like borders.
    pub features: Option<Features>,
    /// Pieces smaller than this are dropped before anything else.
    pub min_component: Option<Least>,
    /// What tells that a face would fold over.
    pub fold_check: FoldCheck,
    /// Compactness below which faces are penalised (eq. 3.20); 0 for none.
    pub compactness: f64,
    /// Penalty on vertices of more than eight faces; 0 for none.
    pub valence_penalty: f64,
    /// How much colours steer against shape; 0 for not at all. Who makes the shades applies it.
    pub colour_weight: f64,
    /// The same of texture coordinates.
    pub texture_weight: f64,
    /// The same of normals.
    pub normal_weight: f64,
    /// Whether holes may close, handles vanish, pieces go.
    pub topology: Topology,
    /// How close two vertices without an edge must be to merge all the same; `None` where only edges collapse.
    pub pair_distance: Option<PairDistance>,
    /// What collapses.
    pub primitive: Primitive,
}

/// What normals count when nothing is said. Against 0, by their RMS error and E_avg:
///
/// | | 0.1 | 0.3 | 1 | 3 |
/// |---|--:|--:|--:|--:|
/// | femur, 1 % | 1.01, 1.03 | 1.01, 1.01 | 0.87, 1.07 | 0.77, 1.52 |
/// | femur, 10 % | 1.01, 1.01 | 0.99, 1.01 | 0.89, 1.11 | 0.74, 1.97 |
/// | bunny, 1,600 | 0.99, 0.99 | 0.96, 0.99 | 0.77, 1.10 | 0.61, 1.91 |
/// | bunny, 6,945 | 1.00, 1.00 | 0.98, 1.00 | 0.85, 1.07 | 0.64, 1.57 |
/// | the same with normals of a smoothed bunny, 1,600 | 0.99, 1.00 | 0.96, 0.96 | 0.81, 1.02 | 0.60, 1.31 |
/// | the same, 6,945 | 0.99, 0.99 | 0.97, 0.99 | 0.91, 1.02 | 0.74, 1.08 |
const NORMAL_WEIGHT: f64 = 1.0;

impl Default for Policies {
    fn default() -> Self {
        Policies {
            quadrics: Quadrics::default(),
            placement: Placement::default(),
            weighting: Weighting::default(),
            boundary_weight: 1.0,
            lock_border: false,
            features: None,
            min_component: None,
            fold_check: FoldCheck::default(),
            compactness: 0.0,
            valence_penalty: 0.0,
            colour_weight: 1.0,
            texture_weight: 1.0,
            normal_weight: NORMAL_WEIGHT,
            topology: Topology::default(),
            pair_distance: None,
            primitive: Primitive::default(),
        }
    }
}

/// Which quadrics place merged vertices and price collapses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quadrics {
    /// Those learnt from the scan down to five times the target; from there on those of the current faces, advised by the
    /// learnt ones.
    #[default]
    Current,
    /// Those learnt from the scan, all the way (thesis §3.4).
    Accumulated,
}

/// Where merged vertices go (thesis §3.5).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Placement {
    /// Where the quadric is least (eq. 3.17).
    #[default]
    Optimal,
    /// At the best place on the edge.
    Line,
    /// At the best of the edge's ends and its middle.
    EndpointOrMidpoint,
    /// At the better end: the result's vertices are the scan's (subset placement).
    Endpoint,
}

/// How much each face's plane counts at its corners (thesis §3.4.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Weighting {
    /// By its area: the sum does not depend on how a region is meshed.
    #[default]
    Area,
    /// By its area, shared among its corners as their angles are.
    Angle,
    /// All alike, as in the first quadric simplification: finely meshed parts count more.
    Uniform,
}

/// Edges where the surface bends sharply are held in place by planes through them, perpendicular to their faces, as
/// borders are (thesis §3.6); spikes keep their tips (§4.5.2).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Features {
    /// From this angle between the normals of an edge's faces on, in degrees: 0 in a plane, near 180 at a spike.
    pub angle: f64,
    /// Weight of its planes, as a factor of the edge's squared length.
    pub weight: f64,
}

/// The least that a piece of the surface may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Least {
    /// So many faces.
    Faces(u64),
    /// This area, in squares of the unit that coordinates have.
    Area(f64),
}

/// What tells that a face would fold over (thesis §3.7).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FoldCheck {
    /// Its normal turns too far.
    #[default]
    Normals,
    /// Its corner crosses the plane through the opposite edge that is perpendicular to it (Fig. 3.15). Faces with two and
    /// three corners that move at once are checked by their normals.
    Planes,
    /// Either.
    Both,
    /// Nothing does: faces fold.
    Off,
}

/// What collapses at a time among the last faces: within five times the target, and 50,000 above it at least.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Primitive {
    /// An edge: its two ends.
    #[default]
    Edge,
    /// A face: its three corners (thesis §3.8).
    Face,
}

/// How close vertices of different pieces, or on borders, must be to merge without an edge between them (thesis §3.2.1).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PairDistance {
    /// Closer than this: τ. The bones of a foot at 250 faces, by accumulated quadrics, have 0.6 of the E_avg that they have
    /// without at a τ of 0.8 % of the diagonal, and no less at 1.2 %: the choice matters.
    Within(f64),
    /// Closer than a quarter of the mean length of the edges at one of them.
    Auto,
}

/// What the collapse may do to topology.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Topology {
    /// Simplify it: holes close, handles vanish, pieces go (thesis §3.1).
    #[default]
    Simplify,
    /// Preserve it: collapses keep the link condition; pieces, borders and handles stay, and no edge gets a third face.
    Preserve,
}

impl Policies {
    /// Whether groups know too little: they weigh what vertices have learnt and go to the optimal place, nothing else.
    pub(super) fn by_pairs(&self) -> bool {
        self.placement != Placement::Optimal
            || self.lock_border
            || self.fold_check != FoldCheck::Normals
            || self.penalises()
            || self.topology == Topology::Preserve
    }

    /// Whether the heap does more than edges, and begins sooner.
    pub(super) fn ends_serially(&self) -> bool {
        self.pair_distance.is_some() || self.primitive == Primitive::Face
    }

    /// Whether there are penalties.
    #[inline(always)]
    pub(super) fn penalises(&self) -> bool {
        self.compactness > 0.0 || self.valence_penalty > 0.0
    }

    /// The same with lengths in a frame.
    pub fn in_frame(self, frame: Frame) -> Self {
        let least = |least| match least {
            Least::Area(area) => Least::Area(frame.to_frame(frame.to_frame(area))),
            faces => faces,
        };
        let pair_distance = self.pair_distance.map(|distance| match distance {
            PairDistance::Within(distance) => PairDistance::Within(frame.to_frame(distance)),
            PairDistance::Auto => PairDistance::Auto,
        });
        Policies { min_component: self.min_component.map(least), pair_distance, ..self }
    }

    /// A policy that needs the scan itself: clusters have merged its vertices by area, wherever they lay.
    pub fn needs_the_scan(&self) -> Option<&'static str> {
        let kept = [
            ("placement endpoint", self.placement == Placement::Endpoint),
            ("weighting other than by area", self.weighting != Weighting::Area),
            ("locking the border", self.lock_border),
            ("a feature angle", self.features.is_some()),
            ("a least component", self.min_component.is_some()),
            ("preserving topology", self.topology == Topology::Preserve),
        ];
        kept.into_iter().find_map(|(name, is)| is.then_some(name))
    }
}
