//! A few dozen faces that followed one another, under boxes of their own: what streams past the probes.

use crate::facets::Facet;
use crate::mesh::boxes::{Aabb, Four, Lanes, Origin, loosen};
use crate::mesh::triangle::distance_sq;
use glam::DVec3;

/// Faces in a patch, at most: four to the power of [`LEVELS`].
pub(super) const FACES: usize = 64;

/// Levels of boxes above a face's own.
const LEVELS: usize = 3;

/// Faces under boxes: four boxes of faces in one of the next level, and so on up to the whole.
pub(super) struct Patch {
    corners: [[DVec3; 3]; FACES],
    /// What a box holds, side by side: level 0 has 16 fours of faces' boxes, level 1 four, level 2 one.
    fours: [[Four; FACES / 4]; LEVELS],
    boxes: [[Aabb; FACES]; LEVELS + 1],
    /// What it costs to meet each part, as an area, and whether its four parts are cheaper one by one.
    costs: [[Cost; FACES]; LEVELS + 1],
}

#[derive(Debug, Clone, Copy, Default)]
struct Cost {
    area: f32,
    divide: bool,
}

/// A box of a patch: of a single face on level 0, of all on level [`LEVELS`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Part {
    level: usize,
    index: usize,
}

impl Default for Patch {
    fn default() -> Self {
        Patch {
            corners: [[DVec3::ZERO; 3]; FACES],
            fours: [[Four::default(); FACES / 4]; LEVELS],
            boxes: [[Aabb::EMPTY; FACES]; LEVELS + 1],
            costs: [[Cost::default(); FACES]; LEVELS + 1],
        }
    }
}

impl Patch {
    /// Takes up other faces, at most [`FACES`]. To bring a part to the probes costs as much as meeting those on an area
    /// of `errand`.
    pub(super) fn fill(&mut self, faces: &[Facet], origin: &Origin, errand: f32) {
        for (face, facet) in faces.iter().enumerate() {
            self.corners[face] = facet.corners;
            let [a, b, c] = facet.corners;
            self.boxes[0][face] = origin.around([origin.about(a), origin.about(b), origin.about(c)]);
        }
        self.boxes[0][faces.len()..].fill(Aabb::EMPTY);
        for (cost, of) in self.costs[0].iter_mut().zip(&self.boxes[0]) {
            cost.area = errand + of.diagonal_sq();
        }
        let mut count = FACES;
        for level in 0..LEVELS {
            count /= 4;
            let (below, above) = self.boxes.split_at_mut(level + 1);
            for (index, boxes) in below[level].as_chunks::<4>().0[..count].iter().enumerate() {
                self.fours[level][index] = Four::new(*boxes);
                above[0][index] = boxes.iter().copied().fold(Aabb::EMPTY, Aabb::union);
            }
            let (below, above) = self.costs.split_at_mut(level + 1);
            for (index, costs) in below[level].as_chunks::<4>().0[..count].iter().enumerate() {
                let together = errand + self.boxes[level + 1][index].diagonal_sq();
                let apart: f32 = costs.iter().map(|cost| cost.area).sum();
                above[0][index] = Cost { area: apart.min(together), divide: apart < together };
            }
        }
    }

    /// Gives `take` the parts that are best met each by itself: the whole, where its faces lie together; single faces,
    /// where they have nothing to do with each other.
    pub(super) fn compact_parts(&self, take: &mut impl FnMut(Part)) {
        self.divide(Part { level: LEVELS, index: 0 }, take);
    }

    fn divide(&self, part: Part, take: &mut impl FnMut(Part)) {
        if self.boxes[part.level][part.index].min.x == f32::INFINITY {
            return;
        }
        if !self.costs[part.level][part.index].divide {
            return take(part);
        }
        let below = 4 * part.index..4 * part.index + 4;
        below.for_each(|index| self.divide(Part { level: part.level - 1, index }, take));
    }

    /// The box of a part.
    pub(super) fn around(&self, part: Part) -> Aabb {
        self.boxes[part.level][part.index]
    }

    /// The least of `best` and the squared distances from `p` to the faces of a part; `at` is where `p` is about the origin.
    #[inline]
    pub(super) fn nearest(&self, part: Part, p: DVec3, at: &Lanes, mut best: f64) -> f64 {
        if part.level == 0 {
            return best.min(distance_sq(p, self.corners[part.index]));
        }
        self.descend(part, p, at, &mut best);
        best
    }

    fn descend(&self, part: Part, p: DVec3, at: &Lanes, best: &mut f64) {
        let level = part.level - 1;
        let gaps = self.fours[level][part.index].gaps_sq(at);
        for (lane, gap) in gaps.iter().enumerate() {
            if *gap <= loosen(*best) {
                let index = 4 * part.index + lane;
                if level == 0 {
                    *best = best.min(distance_sq(p, self.corners[index]));
                } else {
                    self.descend(Part { level, index }, p, at, best);
                }
            }
        }
    }
}
