//! The two bytes that a face of a binary STL has to spare: a colour or a label.

use super::FaceStep;
use super::map::Input;
use super::stl::Stl;
use crate::error::Result;
use crate::mesh::coat::{Coat, Corners, NOTHING, Patch};
use crate::mesh::columns::{Column, Meaning, Number};
use crate::progress::Progress;
use rustc_hash::FxHashMap;

/// What the bytes are called.
pub const NAME: &str = "attribute";

/// Faces that are looked at to tell whether the bytes say anything.
const LOOKED_AT: u64 = 256;

/// More labels than this are noise.
const MOST_LABELS: usize = 4096;

impl Stl {
    /// Whether the first faces have something in their bytes.
    pub fn is_coated(&self, input: &Input) -> bool {
        let Some(run) = &self.run else { return false };
        let mut bytes = vec![0; (LOOKED_AT.min(run.count) as usize) * run.stride];
        input.read_at(&mut bytes, run.offset).is_ok() && bytes.chunks(run.stride).any(|face| face[48..50] != [0, 0])
    }

    /// Labels.
    pub fn coat(&self, input: &Input, progress: &Progress) -> Result<Coat> {
        let mut labels: Vec<u16> = Vec::new();
        let mut seen = vec![false; 1 << 16];
        self.labels(input, progress, &mut |label| {
            if !std::mem::replace(&mut seen[usize::from(label)], true) {
                labels.push(label);
            }
        })?;
        let mut coat = Coat::default();
        if labels.len() > MOST_LABELS {
            labels = vec![0];
        } else {
            coat.face_columns = Self::face_columns();
        }
        let patch = |label: u16| Patch { labels: vec![f64::from(label).to_bits()], ..Patch::default() };
        coat.patches = labels.into_iter().map(patch).collect();
        Ok(coat)
    }

    /// What its faces carry.
    pub fn face_columns() -> Vec<Column> {
        vec![Column { name: NAME.into(), number: Number::U16, meaning: Meaning::Other }]
    }

    /// Goes through the labels of faces.
    pub fn face_values(&self, input: &Input, progress: &Progress, each: &mut FaceStep<'_>) -> Result<()> {
        self.labels(input, progress, &mut |label| each(1, &[f64::from(label)]))
    }

    fn labels(&self, input: &Input, progress: &Progress, each: &mut dyn FnMut(u16)) -> Result<()> {
        let Some(run) = &self.run else { return Ok(()) };
        let mut first = 0;
        while first < run.count {
            progress.check()?;
            let (window, records) = run.window(input, first)?;
            window.chunks(run.stride).for_each(|face| each(u16::from_le_bytes([face[48], face[49]])));
            first += records as u64;
        }
        Ok(())
    }

    /// Triangles, in the order of the file.
    pub fn corners(
        &self,
        coat: &Coat,
        input: &Input,
        progress: &Progress,
        step: &mut dyn FnMut(Corners),
    ) -> Result<()> {
        let labels = coat.patches.iter().enumerate();
        let numbers: FxHashMap<u64, u32> =
            labels.filter_map(|(i, patch)| Some((*patch.labels.first()?, i as u32))).collect();
        let mut first = 0u32;
        self.labels(input, progress, &mut |label| {
            let patch = numbers.get(&f64::from(label).to_bits()).copied().unwrap_or(0);
            let vertices = [0, 1, 2].map(|i| first.wrapping_add(i));
            first = first.wrapping_add(3);
            step(Corners { vertices, uvs: [NOTHING; 3], normals: [NOTHING; 3], patch });
        })
    }
}
