//! A picture: what was said on the command line, and what will be done.

use std::path::PathBuf;

use super::{DEFAULT_MEMORY, Threads, cores};
use crate::budget::Size;
use crate::error::{Error, Result};

/// Pixels of one mesh's picture, across, when nothing is said.
pub const DEFAULT_WIDTH: usize = 640;

/// The widest and highest picture: what a JPEG can have is more, what anybody looks at is less.
const MOST_PIXELS: usize = 16_384;

/// A picture as it was said.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RenderingSaid {
    /// The meshes, side by side.
    pub meshes: Vec<PathBuf>,
    /// The picture to write.
    pub output: PathBuf,
    /// Pixels of one mesh's picture, across.
    pub width: Option<usize>,
    /// Pixels down; by the shape of the first mesh where nothing is said.
    pub height: Option<usize>,
    /// A second row, closer by this factor.
    pub zoom: Option<f64>,
    /// What is in the middle of that row.
    pub at: Option<[f64; 3]>,
    /// Whether the edges of triangles are drawn.
    pub edges: bool,
    /// Bound on the peak resident set.
    pub memory: Option<Size>,
    /// Worker threads.
    pub threads: Option<Threads>,
}

/// A picture with every default filled in.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendering {
    /// The meshes, side by side; the first decides where they are seen from.
    pub meshes: Vec<PathBuf>,
    /// The picture to write: a PNG.
    pub output: PathBuf,
    /// Pixels of one mesh's picture, across.
    pub width: usize,
    /// Pixels down; by the shape of the first mesh where nothing is said.
    pub height: Option<usize>,
    /// A second row, closer by this factor.
    pub zoom: Option<f64>,
    /// What is in the middle of that row; where most is to be seen when nothing is said.
    pub at: Option<[f64; 3]>,
    /// Whether the edges of triangles are drawn.
    pub edges: bool,
    /// Bound on the whole process's peak resident set.
    pub memory: Size,
    /// Worker threads, at least 1; changes nothing in the picture.
    pub threads: usize,
}

impl RenderingSaid {
    /// Fills in the defaults.
    pub fn resolve(self) -> Result<Rendering> {
        let extension = self.output.extension().map(|e| e.to_ascii_lowercase());
        if extension.as_deref() != Some("png".as_ref()) {
            return Err(Error::usage(format!("{}: a picture's name ends in .png", self.output.display())));
        }
        let width = self.width.unwrap_or(DEFAULT_WIDTH);
        let across = width.saturating_mul(self.meshes.len());
        for (pixels, what) in [(across, "wide"), (self.height.unwrap_or(1), "high")] {
            if !(1..=MOST_PIXELS).contains(&pixels) {
                return Err(Error::usage(format!("a picture is 1 to {MOST_PIXELS} pixels {what}, not {pixels}")));
            }
        }
        if let Some(zoom) = self.zoom.filter(|z| !(z.is_finite() && *z > 0.0)) {
            return Err(Error::usage(format!("`{zoom}` is not a factor to zoom by: it is above 0, like 6")));
        }
        Ok(Rendering {
            meshes: self.meshes,
            output: self.output,
            width,
            height: self.height,
            zoom: self.zoom,
            at: self.at,
            edges: self.edges,
            memory: self.memory.unwrap_or(DEFAULT_MEMORY),
            threads: self.threads.map_or_else(cores, |Threads(n)| n),
        })
    }
}
