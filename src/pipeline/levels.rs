//! Further, coarser meshes of the same scan: each goes on from the one before it.
//!
//! The collapse of a coarser level begins with the finer one, refitted, and so costs what that one's faces cost. What it is
//! refitted to is ten times its size, as if it were alone: the finer mesh where that is large enough; else what the finer
//! one was refitted to, whose vertices are followed through both collapses.

use super::{Clock, Run, mesh_file};
use crate::collapse::{Collapsed, collapse};
use crate::error::Result;
use crate::job::Level;
use crate::mesh::{Coordinate, Frame, IndexedMesh, Reference};
use crate::refit::refit;
use crate::report::{LevelReport, Timeline, Warning};
use crate::write;
use glam::DVec3;

/// A finished level, from which the next one goes on.
pub(super) struct Chain<'a, S> {
    pub(super) mesh: IndexedMesh<S>,
    pub(super) frame: Frame,
    /// What it was refitted to.
    pub(super) reference: Option<Reference<S>>,
    /// Its estimated error, in the frame.
    pub(super) error: f64,
    /// Points whose vertices stay, in the frame.
    pub(super) locked: &'a [DVec3],
}

/// A reference that has fewer faces than this many times a level's is too coarse for it where there is a finer one.
const FINE_ENOUGH: usize = 8;

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
            let output = mesh_file(&level.output, chain.mesh.faces.len(), chain.mesh.positions.len());
            out.write_mesh(&chain.mesh, chain.frame, self.progress)?;
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
        let Chain { mesh, frame, reference: before, error, locked: points } = chain;
        let asked = level.target.faces(self.scan.triangle_count());
        let (faces, vertices) = (mesh.faces.len(), mesh.positions.len());
        let refits = self.job.refit_rounds > 0;
        let mut options = self.collapse_options(asked, faces, frame, points);
        options.keep_reference = refits && (options.keep_reference || before.is_some());
        // Pieces that are too small have gone.
        options.policies.min_component = None;
        let Collapsed { mut mesh, error_estimate, reference, locked, .. } =
            collapse(mesh, None, &options, self.progress)?;
        self.check(asked, faces, mesh.faces.len())?;
        seconds.collapse += clock.lap();
        let reference = reference.map(|kept| match before {
            Some(before) if kept.mesh.faces.len() < FINE_ENOUGH * mesh.faces.len() => {
                followed(before, kept, faces, vertices)
            }
            _ => kept,
        });
        if let Some(reference) = &reference {
            refit(&mut mesh, reference, self.job.refit_rounds, &locked, self.progress)?;
        }
        seconds.refit += clock.lap();
        Ok(Chain { mesh, frame, reference, error: error + error_estimate, locked: points })
    }
}

/// The finer reference, its vertices followed to where `kept` says that those of the mesh between went, if that was kept
/// as it came into the collapse.
fn followed<S: Coordinate>(mut finer: Reference<S>, kept: Reference<S>, faces: usize, vertices: usize) -> Reference<S> {
    if (kept.mesh.faces.len(), kept.homes.len()) != (faces, vertices) {
        return kept;
    }
    for home in finer.homes.iter_mut().filter(|home| **home != u32::MAX) {
        *home = kept.homes[*home as usize];
    }
    finer
}
