//! STL files: binary ones here, text in `stl_ascii`.

use super::map::Input;
use super::stl_ascii;
use super::stream::{CHUNK, Crew, Run, Slots, pump_decoded};
use super::{Format, SoupChunk, SoupStep};
use crate::error::{Error, Item, Result};
use crate::progress::Progress;

/// Where the faces of a binary file begin: 80 bytes of anything and the count.
pub(super) const HEAD_BYTES: u64 = 84;

/// Normal, three corners, two bytes of anything.
const FACE_BYTES: usize = 50;

/// The corners within a face.
const CORNERS: std::ops::Range<usize> = 12..48;

/// An open STL file.
#[derive(Debug)]
pub(super) struct Stl {
    pub faces: u64,
    pub trailing: u64,
    /// The faces of a binary file.
    pub run: Option<Run>,
}

impl Stl {
    /// Tells binary from text, and counts.
    ///
    /// A binary file's first 80 bytes may be anything, "solid" included, so its size decides first. One that is longer
    /// than its count says has trailing bytes, unless it reads as text or the rest outweighs the faces.
    pub fn open(input: &Input, progress: &Progress, head: &[u8]) -> Result<Self> {
        let promised = match head.last_chunk::<4>() {
            Some(count) if head.len() as u64 == HEAD_BYTES => Some(u64::from(u32::from_le_bytes(*count))),
            _ => None,
        };
        let size = promised.map(|n| HEAD_BYTES + n * FACE_BYTES as u64);
        let named_stl = super::has_extension(input.path(), "stl");
        match (promised, size) {
            (Some(faces), Some(size)) if size == input.len() => Self::binary(input, faces, 0),
            _ if stl_ascii::looks_like_text(input)? => {
                let (faces, trailing) = stl_ascii::count(input, progress)?;
                Ok(Stl { faces, trailing, run: None })
            }
            (Some(faces), Some(size)) if size < input.len() && (named_stl || size > input.len() / 2) => {
                Self::binary(input, faces, input.len() - size)
            }
            (Some(faces), Some(size)) if named_stl => Err(truncated(input, faces, size)),
            _ => Err(foreign(input)),
        }
    }

    /// Whether a file is exactly as long as its count of faces says, which nothing but a binary STL is.
    pub fn fits(input: &Input, head: &[u8]) -> bool {
        let count = head.get(80..84).and_then(|count| count.first_chunk());
        let faces = count.map(|count| u64::from(u32::from_le_bytes(*count)));
        faces.is_some_and(|n| n > 0 && HEAD_BYTES + n * FACE_BYTES as u64 == input.len())
    }

    fn binary(input: &Input, faces: u64, trailing: u64) -> Result<Self> {
        if faces == 0 {
            return Err(Error::input(input.path(), "has no faces: the header counts 0"));
        }
        let run = Run { offset: HEAD_BYTES, count: faces, stride: FACE_BYTES };
        Ok(Stl { faces, trailing, run: Some(run) })
    }

    /// What the format is called.
    pub fn format(&self) -> Format {
        if self.run.is_some() { Format::StlBinary } else { Format::StlAscii }
    }

    /// Where a corner (three a face) begins.
    pub fn corner_byte(&self, corner: u64) -> Option<u64> {
        self.run.map(|run| run.byte(corner / 3) + CORNERS.start as u64 + corner % 3 * 12)
    }

    /// Streams the faces.
    pub fn soup<W: Send>(
        &self,
        input: &Input,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, SoupChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        let Some(run) = &self.run else {
            let slots = Slots::new(crew, worker);
            self.soup_in_order(input, crew, &|worker, chunk| step(&mut slots.of(worker), chunk))?;
            return Ok(slots.into_inner());
        };
        let local = || (worker(), Vec::new());
        let locals = run.pump(input, crew, local, |(mine, triangles), first, bytes| {
            run.bites(first, bytes).try_for_each(|(first, bytes)| {
                if !decode(bytes, triangles) {
                    return Err(not_finite(input, run, first, triangles));
                }
                step(mine, SoupChunk { first, triangles })
            })
        })?;
        Ok(locals.into_iter().map(|(mine, _)| mine).collect())
    }

    fn soup_in_order(&self, input: &Input, crew: &Crew<'_>, step: &SoupStep<'_>) -> Result<()> {
        let mut facets = stl_ascii::Facets::new(input, crew.progress);
        let mut fill = |out: &mut Vec<_>| {
            let from = facets.at();
            while out.len() < CHUNK
                && let Some(triangle) = facets.next()?
            {
                out.push(triangle);
            }
            Ok(facets.at() - from)
        };
        pump_decoded(crew, &mut fill, &|worker, first, triangles| step(worker, SoupChunk { first, triangles }))
    }
}

/// Decodes whole faces; whether all corners are finite.
pub(super) fn decode(faces: &[u8], out: &mut Vec<[[f64; 3]; 3]>) -> bool {
    out.clear();
    let mut finite = true;
    out.extend(faces.as_chunks::<FACE_BYTES>().0.iter().map(|face| {
        let corners: [[u32; 3]; 3] = bytemuck::pod_read_unaligned(&face[CORNERS]);
        corners.map(|corner| {
            corner.map(|bits| {
                let x = f32::from_bits(u32::from_le(bits));
                finite &= x.is_finite();
                f64::from(x)
            })
        })
    }));
    finite
}

#[cold]
fn not_finite(input: &Input, run: &Run, first: u64, triangles: &[[[f64; 3]; 3]]) -> Error {
    let numbers = triangles.as_flattened().as_flattened();
    let bad = numbers.iter().position(|x| !x.is_finite()).unwrap_or(0);
    let item = Item { kind: "face", ordinal: first + bad as u64 / 9 };
    let byte = run.byte(item.ordinal) + CORNERS.start as u64 + (bad as u64 % 9) * 4;
    Error::input_at(input.path(), item, byte, format!("coordinate {}, expected a finite number", numbers[bad]))
}

fn truncated(input: &Input, faces: u64, size: u64) -> Error {
    let whole = input.len().saturating_sub(HEAD_BYTES) / FACE_BYTES as u64;
    let item = Item { kind: "face", ordinal: whole };
    let what = format!("the file ends at byte {}, but its {faces} faces need {size} bytes", input.len());
    Error::input_at(input.path(), item, HEAD_BYTES + whole * FACE_BYTES as u64, what)
}

fn foreign(input: &Input) -> Error {
    Error::input(input.path(), "is not a mesh as PLY, STL, OBJ, OFF or glTF have it")
}
