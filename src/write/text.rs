//! ASCII PLY and OBJ: every number in as few digits as read back to the same one.

use super::encode::Contents;
use super::{Clothes, Format, Sink};
use crate::error::Result;
use crate::mesh::coat::Patch;
use crate::mesh::columns::{Meaning, Number};
use crate::mesh::{Coordinate, widen};
use std::fmt;
use std::io::Write;

/// About what an element takes, for showing progress.
pub(super) const VERTEX_BYTES: u64 = 32;
/// The same of a face.
pub(super) const FACE_BYTES: u64 = 24;

/// A coordinate as it was stored.
struct Digits<S>(S);

impl<S: Coordinate> fmt::Display for Digits<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let x = self.0.widen();
        // Where people and old readers can do without one, no exponent.
        let plain = x == 0.0 || (1e-5..1e9).contains(&x.abs());
        match (S::DOUBLE, plain) {
            (true, true) => write!(f, "{x}"),
            (true, false) => write!(f, "{x:e}"),
            (false, true) => write!(f, "{}", x as f32),
            (false, false) => write!(f, "{:e}", x as f32),
        }
    }
}

/// A number behind a space.
fn put(number: Number, value: f64, line: &mut Vec<u8>) {
    let _ = match number {
        Number::F64 => write!(line, " {}", Digits(value)),
        Number::F32 => write!(line, " {}", Digits(value as f32)),
        _ => write!(line, " {}", value as i64),
    };
}

/// Vertices and faces, behind the header.
pub(super) fn elements<S: Coordinate, W: Write>(
    contents: &Contents<'_, S>,
    format: Format,
    sink: &mut Sink<'_, W>,
) -> Result<()> {
    let Contents { mesh, frame, carried, clothes, library, .. } = *contents;
    let colour = if format == Format::Obj { carried.find::<3>(Meaning::Colour) } else { None };
    let (vertex, face, base) = if format == Format::Obj { ("v ", "f", 1) } else { ("", "3", 0) };
    let mut line = Vec::with_capacity(128);
    if let Some(library) = library {
        sink.put(format!("mtllib {library}\n").as_bytes())?;
    }
    // Writing to memory does not fail.
    for (v, p) in mesh.positions.iter().enumerate() {
        let [x, y, z] = frame.place_back(widen(*p)).to_array().map(|x| Digits(S::narrow(x)));
        line.clear();
        let _ = write!(line, "{vertex}{x} {y} {z}");
        if let Some(at) = colour {
            for c in at {
                let _ = write!(line, " {}", Digits(carried.columns[c].brightness(carried.of(v)[c]) as f32));
            }
        } else if format == Format::PlyAscii {
            for (column, value) in carried.columns.iter().zip(carried.of(v)) {
                put(column.number, *value, &mut line);
            }
        }
        line.push(b'\n');
        sink.put(&line)?;
    }
    if let Some(clothes) = clothes.filter(|_| format == Format::Obj) {
        return dressed(contents, &clothes, sink);
    }
    let columns = if format == Format::PlyAscii { contents.face_columns() } else { Vec::new() };
    let mut values = Vec::new();
    for (f, corners) in mesh.faces.iter().enumerate() {
        let [a, b, c] = corners.map(|v| u64::from(v) + base);
        line.clear();
        let _ = write!(line, "{face} {a} {b} {c}");
        if !columns.is_empty() {
            contents.face_values(f, &mut values);
            columns.iter().zip(&values).for_each(|(column, x)| put(column.number, *x, &mut line));
        }
        line.push(b'\n');
        sink.put(&line)?;
    }
    Ok(())
}

/// What corners carry, and faces that name it, those of a patch together.
fn dressed<S: Coordinate, W: Write>(
    contents: &Contents<'_, S>,
    clothes: &Clothes<'_>,
    sink: &mut Sink<'_, W>,
) -> Result<()> {
    let Clothes { dress, coat, .. } = clothes;
    let columns = &dress.columns;
    let uv = columns.find::<2>(Meaning::Texture);
    let normal = columns.find::<3>(Meaning::Normal);
    let mut line = Vec::with_capacity(128);
    for (word, at) in [("vt", uv.as_ref().map(|at| &at[..])), ("vn", normal.as_ref().map(|at| &at[..]))] {
        let Some(at) = at else { continue };
        for wedge in 0..dress.vertices.len() {
            line.clear();
            line.extend(word.as_bytes());
            for c in at {
                let _ = write!(line, " {}", Digits(columns.of(wedge)[*c] as f32));
            }
            line.push(b'\n');
            sink.put(&line)?;
        }
    }
    let mut order: Vec<u32> = (0..dress.corners.len() as u32).collect();
    order.sort_by_key(|f| dress.patches[*f as usize]);
    let mut now = None;
    for f in order {
        let (wedges, face) = (dress.corners[f as usize], contents.mesh.faces[f as usize]);
        let patch = &coat.patches[dress.patches[f as usize] as usize];
        line.clear();
        if now.map(|now: &Patch| now.group) != Some(patch.group)
            && let Some(name) = patch.group.and_then(|g| coat.groups.get(g as usize))
        {
            let word = if name.starts_with("o ") { "" } else { "g " };
            let _ = writeln!(line, "{word}{name}");
        }
        if now.map(|now| now.material) != Some(patch.material)
            && let Some(name) = patch.material.and_then(|m| coat.materials.get(m as usize))
        {
            let _ = writeln!(line, "usemtl {name}");
        }
        now = Some(patch);
        line.push(b'f');
        for (v, w) in face.into_iter().zip(wedges) {
            let (v, w) = (u64::from(v) + 1, u64::from(w) + 1);
            let _ = match (uv.is_some(), normal.is_some()) {
                (true, true) => write!(line, " {v}/{w}/{w}"),
                (true, false) => write!(line, " {v}/{w}"),
                (false, true) => write!(line, " {v}//{w}"),
                (false, false) => write!(line, " {v}"),
            };
        }
        line.push(b'\n');
        sink.put(&line)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_read_back_to_the_same_number() {
        for (x, text) in
            [(0.1f32, "0.1"), (-0.0, "-0"), (1e-30, "1e-30"), (1.5e10, "1.5e10"), (16_777_216.0, "16777216")]
        {
            assert_eq!(Digits(x).to_string(), text);
        }
        assert_eq!(Digits(4_512_345.123_456_789f64).to_string(), "4512345.123456789");
        let mut bits = 7u64;
        for _ in 0..20_000 {
            bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            let (x, y) = (f64::from_bits(bits), f32::from_bits((bits >> 32) as u32));
            if x.is_finite() {
                assert_eq!(Digits(x).to_string().parse(), Ok(x));
            }
            if y.is_finite() {
                assert_eq!(Digits(y).to_string().parse(), Ok(y));
            }
        }
    }
}
