//! ASCII PLY and OBJ: every number in as few digits as read back to the same one.

use super::encode::Contents;
use super::{Format, Sink};
use crate::error::Result;
use crate::mesh::Coordinate;
use crate::mesh::columns::{Meaning, Number};
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

/// Vertices and faces, behind the header.
pub(super) fn elements<S: Coordinate, W: Write>(
    contents: &Contents<'_, S>,
    format: Format,
    sink: &mut Sink<'_, W>,
) -> Result<()> {
    let Contents { mesh, frame, carried } = *contents;
    let colour = if format == Format::Obj { carried.find::<3>(Meaning::Colour) } else { None };
    let (vertex, face, base) = if format == Format::Obj { ("v ", "f", 1) } else { ("", "3", 0) };
    let mut line = Vec::with_capacity(128);
    // Writing to memory does not fail.
    for (v, p) in mesh.positions.iter().enumerate() {
        let [x, y, z] = p.map(|x| Digits(S::narrow(frame.to_file(x.widen()))));
        line.clear();
        let _ = write!(line, "{vertex}{x} {y} {z}");
        if let Some(at) = colour {
            for c in at {
                let _ = write!(line, " {}", Digits(carried.columns[c].brightness(carried.of(v)[c]) as f32));
            }
        } else if format == Format::PlyAscii {
            for (column, value) in carried.columns.iter().zip(carried.of(v)) {
                let _ = match column.number {
                    Number::F64 => write!(line, " {}", Digits(*value)),
                    Number::F32 => write!(line, " {}", Digits(*value as f32)),
                    _ => write!(line, " {}", *value as i64),
                };
            }
        }
        line.push(b'\n');
        sink.put(&line)?;
    }
    for corners in &mesh.faces {
        let [a, b, c] = corners.map(|v| u64::from(v) + base);
        line.clear();
        let _ = writeln!(line, "{face} {a} {b} {c}");
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
