//! Further, coarser meshes of the same scan: each goes on from the one before it.
//!
//! The collapse of a coarser level begins with the finer one, refitted, and so costs what that one's faces cost. What it is
//! refitted to is the finer mesh where that is [`FINE_ENOUGH`]; else one of those before it, whose vertices are followed
//! through the collapses between.

use super::coat::Outfit;
use super::{Clock, Run, mesh_file};
use crate::collapse::{Carried, Collapsed, collapse};
use crate::error::Result;
use crate::job::Level;
use crate::mesh::{Coordinate, Frame, IndexedMesh, Reference, Shades, Wedges};
use crate::refit::{Aim, Held, refit};
use crate::report::{LevelReport, Timeline, Warning};
use crate::write;
use glam::DVec3;

/// A finished level, from which the next one goes on.
pub(super) struct Chain<'a, S> {
    pub(super) mesh: IndexedMesh<S>,
    pub(super) frame: Frame,
    /// What it can be refitted to, or a coarser one after it: the finest first.
    pub(super) references: Vec<Reference<S>>,
    /// Its estimated error, in the frame.
    pub(super) error: f64,
    /// Points whose vertices stay, in the frame.
    pub(super) locked: &'a [DVec3],
    /// Its seams.
    pub(super) wedges: Wedges,
    /// Numbers that steer, and what a full range of one is worth here and at each level after it.
    pub(super) shades: Shades,
    pub(super) lengths: Vec<f64>,
    /// What the scan wears.
    pub(super) outfit: Option<&'a Outfit<S>>,
}

/// Faces of a reference for each of the result's, from which on a finer one gains nothing: it lies closer to the scan than
/// what a collapse alone would have kept, since it was refitted itself.
const FINE_ENOUGH: usize = 4;

/// From how many times a coarser level's target on the current faces choose, and pairs go, not groups. The level above is
/// smooth: it was refitted, and its quadrics know no noise. With the 5 of a scan levels take 1.3 times as
/// long and end up to 8 % closer than made alone; with 1 they are up to 20 % farther, with 2 at most 3.2 % (femur, bunny, 1.2 M).
const LAST_FACTOR: usize = 2;

/// Below so many faces each matters, and all of them cost next to nothing: cow 400 of 1,500 is half as far again with 2.
const FEW_FACES: usize = 1000;

impl Run<'_> {
    /// Reduces further, to every coarser level.
    pub(super) fn coarser<S: Coordinate>(
        &self,
        mut chain: Chain<S>,
        outs: Vec<write::Target>,
        clock: &mut Clock,
        seconds: &mut Timeline,
        warnings: &mut Vec<Warning>,
    ) -> Result<Vec<LevelReport>> {
        let mut reports = Vec::new();
        for (level, out) in self.job.coarser.iter().zip(outs) {
            chain = self.next(chain, level, clock, seconds)?;
            if S::DOUBLE && out.loses_doubles() {
                warnings.push(Warning::StlLosesDoubles { vertices: chain.mesh.positions.len() as u64 });
            }
            let voted = self.voted(out.format(), chain.outfit, &chain.mesh, chain.frame)?;
            let (wanted, _) = self.columns(out.format(), chain.outfit, &voted);
            let carried = self.carried(&wanted, &chain.mesh, chain.frame)?;
            let dressed = self.dressed(chain.outfit, &chain.mesh, &chain.wedges, out.format())?;
            seconds.carry += clock.lap();
            let clothes = dressed.as_ref().map(|d| d.clothes());
            let vertices = chain.mesh.positions.len();
            let vertices = dressed.as_ref().map_or(vertices, |d| d.vertices(out.format(), vertices));
            let output = mesh_file(&level.output, chain.mesh.faces.len(), vertices);
            let load = write::Load { vertices: &carried, faces: &voted, clothes };
            out.write_carrying(&chain.mesh, chain.frame, load, self.progress)?;
            seconds.write += clock.lap();
            let error_estimate = Some(chain.frame.to_file(chain.error));
            reports.push(LevelReport { output, error_estimate, deviation: None });
        }
        Ok(reports)
    }

    fn next<'a, S: Coordinate>(
        &self,
        chain: Chain<'a, S>,
        level: &Level,
        clock: &mut Clock,
        seconds: &mut Timeline,
    ) -> Result<Chain<'a, S>> {
        let Chain { mesh, frame, mut references, error, locked: points, wedges, mut shades, mut lengths, outfit } =
            chain;
        let asked = level.target.faces(self.scan.triangle_count());
        let (faces, vertices) = (mesh.faces.len(), mesh.positions.len());
        let refits = self.job.refit_rounds > 0;
        let mut options = self.collapse_options(asked, faces, frame, points, false);
        options.keep_reference = refits && (options.keep_reference || !references.is_empty());
        if options.target >= FEW_FACES {
            (options.last_factor, options.tail_faces) = (LAST_FACTOR, FEW_FACES / 4);
        }
        // Pieces that are too small have gone.
        options.policies.min_component = None;
        if let [here, there, ..] = lengths[..] {
            shades.scale(there / here);
            lengths.remove(0);
        }
        let carries = !(wedges.is_empty() && shades.is_empty());
        let carried = carries.then(|| Carried { wedges, shades, ..Carried::default() });
        let Collapsed { mut mesh, error_estimate, reference, locked, mut wedges, shades, .. } =
            collapse(mesh, carried, &options, self.progress)?;
        self.check(asked, faces, mesh.faces.len())?;
        seconds.collapse += clock.lap();
        match reference {
            // Kept as it came in: all that it stands for has gone where it has.
            Some(kept) if (kept.mesh.faces.len(), kept.homes.len()) == (faces, vertices) => {
                references.iter_mut().for_each(|finer| follow(finer, &kept));
                references.push(kept);
            }
            Some(kept) => references = vec![kept],
            None => references.clear(),
        }
        let enough = |reference: &&Reference<S>| reference.mesh.faces.len() >= FINE_ENOUGH * mesh.faces.len();
        if let Some(reference) = references.iter().rev().find(enough).or(references.first()) {
            let aim = Aim { reference: Some(reference), samples: None };
            let held = Held { locked: &locked, wedges: &mut wedges };
            refit(&mut mesh, &aim, self.job.refit_rounds, held, self.progress)?;
        }
        seconds.refit += clock.lap();
        let error = error + error_estimate;
        Ok(Chain { mesh, frame, references, error, locked: points, wedges, shades, lengths, outfit })
    }
}

/// Follows the vertices of a finer reference to where those of the mesh that it stood for went.
fn follow<S: Coordinate>(finer: &mut Reference<S>, kept: &Reference<S>) {
    for home in finer.homes.iter_mut().filter(|home| **home != u32::MAX) {
        *home = kept.homes[*home as usize];
    }
}
