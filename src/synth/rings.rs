//! The mesh of the figure: rings of vertices from the foot to the crown, zipped to one another.
//!
//! A ring of `n` vertices is as long as it has edges, so that edges are about equally long everywhere; between rings of
//! `a` and `b` edges lie `a + b` triangles; both ends are a ring of one vertex and no edge. The sum over all rings gives
//! any even number of faces exactly.

use super::figure::{Figure, Footing, Level};
use glam::DVec3;

/// Levels of the sweep that are measured to place the rings.
const LEVELS: usize = 1024;
/// Angles at which a level is measured.
const ANGLES: usize = 128;

/// The figure's rings for a number of faces.
pub(super) struct Rings {
    /// Number of the first vertex of each ring, and behind the last the number of vertices.
    first: Vec<u64>,
    sweep: Sweep,
    /// Mean edge length.
    pub(super) edge: f64,
}

/// How long the figure is along and around, measured.
struct Sweep {
    /// The way from the foot to each level.
    way: Vec<f64>,
    around: Vec<f64>,
    /// For each level the angles, in quarter turns, at which shares of its length end.
    angles: Vec<[f64; ANGLES + 1]>,
}

/// One ring, prepared for its vertices.
pub(super) struct Ring {
    level: Level,
    angles: [f64; ANGLES + 1],
    count: u64,
    phase: u64,
}

impl Rings {
    /// The rings for `faces` (even, at least 100) faces.
    pub(super) fn new(figure: &Figure, faces: u64) -> Rings {
        let sweep = Sweep::measure(figure);
        // V = F / 2 + 2 on a closed surface without handles; the two ends are vertices.
        let vertices = faces / 2;
        // Equilateral triangles of edge e have two thirds of √3 e² of area a vertex.
        let edge = (sweep.area() / vertices as f64 * (2.0 / 3f64.sqrt())).sqrt();
        let row = edge * (3f64.sqrt() / 2.0);
        let length = sweep.way[LEVELS];
        let rings = ((length / row + 0.5) as u64).saturating_sub(1).clamp(1, vertices / 3);

        // Every ring has three vertices, and beyond these as many as its length has a share in.
        let spare = vertices - 3 * rings;
        let share = |ring: u64| {
            let (at, t) = sweep.locate(length * ring as f64 / (rings + 1) as f64);
            (mix(sweep.around[at], sweep.around[at + 1], t) - 3.0 * edge).max(0.0)
        };
        let total: f64 = (1..=rings).map(share).sum();
        let mut first = Vec::with_capacity(rings as usize + 3);
        first.extend([0, 1]);
        let mut sum = 0.0;
        for ring in 1..=rings {
            sum += share(ring);
            let spent = if ring == rings { spare } else { ((spare as f64 * (sum / total)) as u64).min(spare) };
            first.push(1 + 3 * ring + spent);
        }
        first.push(vertices + 2);
        Rings { first, sweep, edge }
    }

    /// Rings, both ends included.
    pub(super) fn len(&self) -> usize {
        self.first.len() - 1
    }

    /// Number of vertices.
    pub(super) fn vertices(&self) -> u64 {
        self.first[self.len()]
    }

    /// Number of the first vertex of a ring.
    pub(super) fn first(&self, ring: usize) -> u64 {
        self.first[ring]
    }

    /// Number of vertices of a ring.
    pub(super) fn count(&self, ring: usize) -> u64 {
        self.first[ring + 1] - self.first[ring]
    }

    /// Triangles between a ring and the next.
    pub(super) fn strip(&self, ring: usize) -> Strip {
        let edges = |ring: usize| if ring == 0 || ring + 1 == self.len() { 0 } else { self.count(ring) };
        Strip { below: edges(ring), above: edges(ring + 1), phase: (ring & 1) as u64 }
    }

    /// A ring, prepared.
    pub(super) fn ring(&self, figure: &Figure, ring: usize) -> Ring {
        let way = self.sweep.way[LEVELS] * ring as f64 / (self.len() - 1) as f64;
        let (at, t) = self.sweep.locate(way);
        let (low, high) = (&self.sweep.angles[at], &self.sweep.angles[at + 1]);
        Ring {
            level: figure.level(if ring + 1 == self.len() { 1.0 } else { (at as f64 + t) / LEVELS as f64 }),
            angles: std::array::from_fn(|i| mix(low[i], high[i], t)),
            count: self.count(ring),
            phase: (ring & 1) as u64,
        }
    }
}

impl Ring {
    /// The smooth figure under vertex `j` of the ring. Every other ring is turned by half an edge.
    #[inline]
    pub(super) fn footing(&self, figure: &Figure, j: u64) -> Footing {
        let t = (2 * j + self.phase) as f64 / (2 * self.count) as f64 * ANGLES as f64;
        let at = t as usize;
        figure.footing(&self.level, mix(self.angles[at], self.angles[at + 1], t - at as f64))
    }
}

impl Sweep {
    fn measure(figure: &Figure) -> Sweep {
        let mut sweep = Sweep { way: vec![0.0], around: Vec::new(), angles: Vec::new() };
        let mut before: Option<[DVec3; ANGLES]> = None;
        for at in 0..=LEVELS {
            let level = figure.level(at as f64 / LEVELS as f64);
            let points: [DVec3; ANGLES] = std::array::from_fn(|i| figure.footing(&level, quarters(i)).smooth);
            let (around, angles) = spread(&points);
            sweep.around.push(around);
            sweep.angles.push(angles);
            if let Some(before) = before {
                let step: f64 = points.iter().zip(&before).map(|(p, q)| p.distance(*q)).sum();
                sweep.way.push(sweep.way[at - 1] + step / ANGLES as f64);
            }
            before = Some(points);
        }
        sweep
    }

    /// The level before `way` from the foot, and how far it is to the next.
    fn locate(&self, way: f64) -> (usize, f64) {
        let at = self.way.partition_point(|&w| w <= way).clamp(1, LEVELS) - 1;
        (at, ((way - self.way[at]) / (self.way[at + 1] - self.way[at])).clamp(0.0, 1.0))
    }

    fn area(&self) -> f64 {
        let strip = |i: usize| (self.way[i + 1] - self.way[i]) * (self.around[i] + self.around[i + 1]) / 2.0;
        (0..LEVELS).map(strip).sum()
    }
}

/// A closed line's length, and the angles at which equal shares of it end.
fn spread(points: &[DVec3; ANGLES]) -> (f64, [f64; ANGLES + 1]) {
    let mut way = [0.0; ANGLES + 1];
    for i in 0..ANGLES {
        way[i + 1] = way[i] + points[i].distance(points[(i + 1) % ANGLES]);
    }
    let around = way[ANGLES];
    let mut angles: [f64; ANGLES + 1] = std::array::from_fn(quarters);
    // A ring of no length, at the ends, is spread evenly.
    if around > 1e-9 {
        let mut at = 0;
        for (i, angle) in angles.iter_mut().enumerate().take(ANGLES).skip(1) {
            let goal = around * i as f64 / ANGLES as f64;
            while way[at + 1] < goal {
                at += 1;
            }
            *angle = quarters(at) + (goal - way[at]) / (way[at + 1] - way[at]) * quarters(1);
        }
    }
    (around, angles)
}

fn quarters(i: usize) -> f64 {
    i as f64 * (4.0 / ANGLES as f64)
}

#[inline]
fn mix(a: f64, b: f64, t: f64) -> f64 {
    a + (b - a) * t
}

/// The triangles between two rings, in the order of their edges' midpoints.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strip {
    below: u64,
    above: u64,
    /// 1 when the ring below is turned by half an edge, 0 when the one above is.
    phase: u64,
}

/// A corner: whether it is on the ring above, and its number there.
pub(super) type Corner = (bool, u64);

impl Strip {
    /// Number of triangles.
    pub(super) fn len(&self) -> u64 {
        self.below + self.above
    }

    /// Whether edge `i` below comes before edge `k` above.
    #[inline]
    fn below_first(&self, i: u64, k: u64) -> bool {
        (2 * i + 1 + self.phase) * self.above <= (2 * k + 2 - self.phase) * self.below
    }

    /// Edges below among the first `t` triangles.
    fn split(&self, t: u64) -> u64 {
        let (mut low, mut high) = (t.saturating_sub(self.above), t.min(self.below));
        while low < high {
            let i = (low + high) / 2;
            if self.below_first(i, t - 1 - i) { low = i + 1 } else { high = i }
        }
        low
    }

    /// Hands triangles `from..to` of the strip to `each`, outward side counter-clockwise.
    #[inline]
    pub(super) fn triangles(&self, from: u64, to: u64, mut each: impl FnMut([Corner; 3])) {
        let mut i = self.split(from);
        let mut k = from - i;
        let next = |i: u64, n: u64| if i + 1 >= n { 0 } else { i + 1 };
        // Behind the last edge comes the first vertex again.
        let closed = |i: u64, n: u64| if i == n { 0 } else { i };
        for _ in from..to {
            let (a, b) = (closed(i, self.below), closed(k, self.above));
            if k == self.above || (i < self.below && self.below_first(i, k)) {
                each([(false, a), (false, next(a, self.below)), (true, b)]);
                i += 1;
            } else {
                each([(false, a), (true, next(b, self.above)), (true, b)]);
                k += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_is_the_same_in_pieces() {
        for (below, above) in [(3, 3), (0, 5), (6, 0), (7, 4), (4, 11), (100, 101), (64, 64)] {
            for phase in [0, 1] {
                let strip = Strip { below, above, phase };
                let mut whole = Vec::new();
                strip.triangles(0, strip.len(), |t| whole.push(t));
                for piece in [1, 3, 7] {
                    let mut pieces = Vec::new();
                    for from in (0..strip.len()).step_by(piece) {
                        strip.triangles(from, strip.len().min(from + piece as u64), |t| pieces.push(t));
                    }
                    assert_eq!(pieces, whole, "{strip:?} in pieces of {piece}");
                }
            }
        }
    }
}
