//! The policies: what can be chosen of the collapse, and what is when nothing is said.

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
    /// to its line. 0 lets borders shrink, 10 costs 45 % of E_avg on the bunny.
    pub boundary_weight: f64,
}

impl Default for Policies {
    fn default() -> Self {
        Policies {
            quadrics: Quadrics::default(),
            placement: Placement::default(),
            weighting: Weighting::default(),
            boundary_weight: 1.0,
        }
    }
}

/// Which quadrics place merged vertices and price collapses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Quadrics {
    /// Those learnt from the scan down to ten times the target; from there on those of the current faces, advised by the
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

impl Policies {
    /// Whether groups know too little: they weigh what vertices have learnt and go to the optimal place, nothing else.
    pub(super) fn by_pairs(&self) -> bool {
        self.placement != Placement::Optimal
    }

    /// A policy that needs the scan itself: clusters have merged its vertices by area, wherever they lay.
    pub fn needs_the_scan(&self) -> Option<&'static str> {
        let kept = [
            ("placement endpoint", self.placement == Placement::Endpoint),
            ("weighting other than by area", self.weighting != Weighting::Area),
        ];
        kept.into_iter().find_map(|(name, is)| is.then_some(name))
    }
}
