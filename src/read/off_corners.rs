//! What corners and faces of an OFF carry: texture coordinates of vertices, which may break off where several are at one
//! place, and colours of faces. Read in order.

use super::FaceStep;
use super::ascii::number;
use super::lines::{Dialect, Line, words};
use super::map::Input;
use super::off::{Off, OffText};
use super::ply_corners::Labels;
use crate::error::Result;
use crate::mesh::coat::{Coat, Corners, NOTHING};
use crate::progress::Progress;

/// Values and labels.
pub(super) fn coat(text: &OffText, input: &Input, progress: &Progress) -> Result<Coat> {
    let mut coat = Coat { face_columns: text.dialect.face_columns(), ..Coat::default() };
    let mut labels = Labels::default();
    let (at, mut values, mut ordinals) = (text.dialect.texture(), Vec::new(), 0u64..);
    text.in_order(input, progress, |line| {
        match text.dialect.sort(line, ordinals.next().unwrap_or(0)) {
            Line::Vertex(vertex) => {
                if let Some(at) = at {
                    let mut more = words(vertex).skip(3 + at);
                    let mut next = || more.next().and_then(|word| number(word, true)).map_or(f32::NAN, |x| x as f32);
                    coat.uvs.push([next(), next()]);
                }
            }
            Line::Face(face) => {
                face_numbers(&text.dialect, face, &mut values);
                labels.number(&values);
            }
            Line::Other => {}
        }
        Ok(())
    })?;
    coat.patches = labels.into_patches(text.total.triangles, &mut coat.face_columns);
    Ok(coat)
}

/// The numbers behind the corners of a face; none where it has none, though others do.
fn face_numbers(dialect: &Off, face: &[u8], values: &mut Vec<f64>) {
    values.clear();
    let corners = dialect.count(face).unwrap_or(0) as usize;
    let mut more = words(face).skip(corners.saturating_add(1));
    values.extend(dialect.of_faces.iter().map(|(_, factor)| {
        let x = more.next().and_then(|word| number(word, false)).unwrap_or(0.0);
        (factor * x).round().clamp(0.0, 255.0)
    }));
}

/// Triangles, in the order of the file.
pub(super) fn corners(
    text: &OffText,
    coat: &Coat,
    input: &Input,
    progress: &Progress,
    step: &mut dyn FnMut(Corners),
) -> Result<()> {
    let (mut labels, mut values, mut polygon, mut ordinals) = (Labels::default(), Vec::new(), Vec::new(), 0u64..);
    text.in_order(input, progress, |line| {
        if let Line::Face(face) = text.dialect.sort(line, ordinals.next().unwrap_or(0)) {
            polygon.clear();
            text.dialect.corners(face, text.total.vertices, text.total.vertices, &mut polygon)?;
            let patch = if coat.face_columns.is_empty() {
                0
            } else {
                face_numbers(&text.dialect, face, &mut values);
                labels.number(&values)
            };
            if let [a, rest @ ..] = &polygon[..] {
                for pair in rest.windows(2) {
                    let vertices = [*a, pair[0], pair[1]];
                    let uvs = if coat.uvs.is_empty() { [NOTHING; 3] } else { vertices };
                    step(Corners { vertices, uvs, normals: [NOTHING; 3], patch });
                }
            }
        }
        Ok(())
    })
}

/// Goes through the colours of faces, with how many triangles each is.
pub(super) fn face_values(text: &OffText, input: &Input, progress: &Progress, each: &mut FaceStep<'_>) -> Result<()> {
    let (mut values, mut ordinals) = (Vec::new(), 0u64..);
    text.in_order(input, progress, |line| {
        if let Line::Face(face) = text.dialect.sort(line, ordinals.next().unwrap_or(0)) {
            face_numbers(&text.dialect, face, &mut values);
            each((text.dialect.count(face)? as usize).saturating_sub(2), &values);
        }
        Ok(())
    })
}
