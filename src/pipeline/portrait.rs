//! A scan and what it became, in one picture: before, after, and how far it is, from the same camera, and closer.

use super::{Run, read_crew};
use crate::error::{Error, Result};
use crate::measure::{Measured, Scale};
use crate::mesh::Coordinate;
use crate::picture::{COARSE, Camera, Picture, Plate, draw_mesh, draw_scan};
use crate::progress::Stage;
use crate::read::Scan;
use crate::report::PortraitFile;
use crate::write::WholeFile;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The picture that is to be taken of a reduction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PortraitAsked {
    /// The JPEG to write.
    pub output: PathBuf,
    /// Pixels of each view's side.
    pub tile: usize,
    /// Size of the file, at most.
    pub most_bytes: usize,
}

/// How much closer the second row is.
const ZOOM: f64 = 5.0;

/// Meshes that are shown, at most: of many levels the finest.
const MOST_RESULTS: usize = 3;

/// The least pixels of a view's side that show anything.
const LEAST_TILE: usize = 64;

/// A picture under way: columns of two views.
pub(super) struct Portrait<'a> {
    asked: &'a PortraitAsked,
    tile: usize,
    cameras: [Camera; 2],
    room: u64,
    views: Vec<(&'static str, [Picture; 2])>,
    top: Option<f64>,
}

impl<'a> Portrait<'a> {
    /// Takes the views of the scan and of the meshes that were made of it.
    pub(super) fn begun(run: &Run, asked: &'a PortraitAsked, results: &[&Path]) -> Result<Self> {
        // The other half is what allocators keep of the reduction before.
        let room = run.purse.while_streaming() / 2;
        let views = (results.len().min(MOST_RESULTS) + 2) as u64;
        // Plates, and the pictures: as they are taken, put together, and encoded.
        let bytes = |tile: usize| 2 * Plate::bytes(tile, tile, COARSE) + views * 12 * (tile * tile) as u64;
        let tile = std::iter::successors(Some(asked.tile), |tile| Some(tile / 2))
            .take_while(|tile| *tile >= LEAST_TILE)
            .find(|tile| bytes(*tile) <= room / 2);
        let Some(tile) = tile else {
            return Err(Error::Budget { what: "no picture fits".into(), needed_bytes: 2 * bytes(LEAST_TILE) });
        };
        run.progress.begin(Stage::Render, run.scan.bytes());
        let camera = Camera::of_scan(run.scan, &read_crew(&run.purse, run.progress))?;
        let mut portrait =
            Portrait { asked, tile, cameras: [camera; 2], room: room - bytes(tile), views: Vec::new(), top: None };
        let finest = Scan::open_in(results[0], &run.scratch, run.progress)?;
        let [whole, _] = portrait.plates();
        draw_scan(&finest, std::slice::from_ref(&whole), &read_crew(&run.purse, run.progress), portrait.room)?;
        portrait.cameras[1] = camera.zoomed(whole.most_detailed(1.0 / ZOOM).unwrap_or(camera.centre()), ZOOM);
        drop(whole);
        portrait.take(run, "before", run.scan)?;
        portrait.take(run, "after", &finest)?;
        for result in results.iter().take(MOST_RESULTS).skip(1) {
            portrait.take(run, "coarser", &Scan::open_in(result, &run.scratch, run.progress)?)?;
        }
        Ok(portrait)
    }

    fn plates(&self) -> [Plate; 2] {
        self.cameras.map(|camera| Plate::new(camera, self.tile, self.tile, COARSE))
    }

    fn take(&mut self, run: &Run, what: &'static str, scan: &Scan) -> Result<()> {
        let plates = self.plates();
        draw_scan(scan, &plates, &read_crew(&run.purse, run.progress), self.room)?;
        self.views.push((what, [plates[0].develop(), plates[1].develop()]));
        Ok(())
    }

    /// Adds the view of a mesh coloured by its deviation.
    pub(super) fn show_deviation<S: Coordinate>(&mut self, measured: &Measured<S>) {
        let plates = self.plates();
        let scale = Scale::of(&measured.shades);
        let colour = |v: u32| scale.colour(measured.shades[v as usize]);
        draw_mesh(&measured.mesh, measured.frame, &plates, Some(&colour));
        self.views.push(("deviation", [plates[0].develop(), plates[1].develop()]));
        self.top = Some(scale.top());
    }

    /// Puts the views together and writes them.
    pub(super) fn finish(self, run: &Run) -> Result<PortraitFile> {
        let mut picture = Picture::empty(self.tile * self.views.len(), 2 * self.tile);
        for (column, (_, rows)) in self.views.iter().enumerate() {
            for (row, view) in rows.iter().enumerate() {
                picture.put(view, column * self.tile, row * self.tile);
            }
        }
        let out = WholeFile::prepare(&self.asked.output, None)?;
        out.write(&picture.jpeg(self.asked.most_bytes), run.progress)?;
        Ok(PortraitFile {
            path: self.asked.output.clone(),
            views: self.views.iter().map(|(what, _)| *what).collect(),
            zoom: ZOOM,
            deviation_top: self.top,
        })
    }
}
