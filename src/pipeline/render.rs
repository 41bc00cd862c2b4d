//! Meshes side by side in one picture, seen by the same camera.

use super::{on_threads, read_crew};
use crate::error::{Error, Result};
use crate::job::Rendering;
use crate::picture::{Camera, FINE, Picture, Plate, draw_scan};
use crate::plan::{Ask, Purse, most_threads, streaming_budget};
use crate::progress::{Progress, Stage};
use crate::read::Scan;
use crate::report::{MeshFile, RenderReport, peak_rss_bytes};
use crate::write::WholeFile;
use glam::DVec3;
use std::time::Instant;

/// The part of a picture in which the place to zoom in on is looked for, over the part that is then seen.
const LOOKED_AT: f64 = 1.0;

/// Takes the picture that `rendering` says, and reports.
pub fn render(rendering: &Rendering, progress: &Progress) -> Result<RenderReport> {
    let threads = rendering.threads.min(most_threads(rendering.memory.0));
    on_threads(threads, || {
        let begun = Instant::now();
        let mut out = None;
        for path in &rendering.meshes {
            match &mut out {
                None => out = Some(WholeFile::prepare(&rendering.output, Some(path))?),
                Some(out) => out.check_is_not(path)?,
            }
        }
        let Some(out) = out else { return Err(Error::usage("no mesh to take a picture of")) };
        let scans = rendering.meshes.iter().map(|path| Scan::open(path, progress)).collect::<Result<Vec<_>>>()?;
        let picture = Studio::new(rendering, threads, progress).picture(&scans)?;
        let bytes = out.write(&picture.png(), progress)?;
        Ok(RenderReport {
            meshes: scans.iter().map(mesh_file).collect(),
            picture: rendering.output.clone(),
            width: picture.width,
            height: picture.height,
            bytes,
            peak_rss_bytes: peak_rss_bytes(),
            seconds: begun.elapsed().as_secs_f64(),
        })
    })
}

struct Studio<'a> {
    rendering: &'a Rendering,
    purse: Purse,
    progress: &'a Progress,
}

impl<'a> Studio<'a> {
    fn new(rendering: &'a Rendering, threads: usize, progress: &'a Progress) -> Self {
        Studio { rendering, purse: Purse::new(rendering.memory.0, threads, Ask::default()), progress }
    }

    /// A column a mesh, a row a camera.
    fn picture(&self, scans: &[Scan]) -> Result<Picture> {
        let Rendering { width, zoom, at, .. } = *self.rendering;
        let camera = Camera::of_scan(&scans[0], &read_crew(&self.purse, self.progress))?;
        let height = self.rendering.height.unwrap_or_else(|| height_of(&camera, width));
        let mut cameras = vec![camera];
        let room = self.room(width, height, if zoom.is_some() { 2 } else { 1 })?;
        if let (Some(by), Some(at)) = (zoom, at) {
            cameras.push(camera.zoomed(DVec3::from(at), by));
        }
        let rows = if zoom.is_some() { 2 } else { 1 };
        let mut picture = Picture::empty(width * scans.len(), height * rows);
        for (column, scan) in scans.iter().enumerate() {
            let mut plates = self.taken(scan, &cameras, [width, height], room)?;
            // The first picture tells where to zoom in.
            if let (Some(by), 1) = (zoom, cameras.len()) {
                let place = plates[0].most_detailed(LOOKED_AT / by).unwrap_or(camera.centre());
                cameras.push(camera.zoomed(place, by));
                plates.extend(self.taken(scan, &cameras[1..], [width, height], room)?);
            }
            for (row, plate) in plates.iter().enumerate() {
                picture.put(&plate.develop(), width * column, height * row);
            }
        }
        Ok(picture)
    }

    fn taken(&self, scan: &Scan, cameras: &[Camera], [width, height]: [usize; 2], room: u64) -> Result<Vec<Plate>> {
        let plate = |camera: &Camera| Plate::new(*camera, width, height, FINE).with_edges(self.rendering.edges);
        let plates: Vec<_> = cameras.iter().map(plate).collect();
        self.progress.begin(Stage::Render, scan.bytes());
        draw_scan(scan, &plates, &read_crew(&self.purse, self.progress), room)?;
        Ok(plates)
    }

    /// What plates and picture leave for positions.
    fn room(&self, width: usize, height: usize, rows: u64) -> Result<u64> {
        let meshes = self.rendering.meshes.len() as u64;
        // The picture, and its PNG at worst.
        let printed = 2 * 3 * (width * height) as u64 * rows * meshes;
        let needed = rows * Plate::bytes(width, height, FINE) + printed;
        self.purse.while_streaming().checked_sub(needed).ok_or_else(|| Error::Budget {
            what: format!("a picture of {width} × {height} pixels cannot be taken within this budget"),
            needed_bytes: streaming_budget(needed),
        })
    }
}

/// As high as the shape needs, within reason.
pub(super) fn height_of(camera: &Camera, width: usize) -> usize {
    ((width as f64 / camera.aspect()).round() as usize).clamp(width.div_ceil(2), 3 * width / 2).max(1)
}

fn mesh_file(scan: &Scan) -> MeshFile {
    MeshFile { path: scan.path().into(), faces: scan.face_count(), vertices: scan.vertex_count() }
}
