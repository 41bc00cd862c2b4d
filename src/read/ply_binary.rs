//! Binary PLY payloads: tight loops over records of one length, and [`Binary`] values for all others.

use super::cursor::Cursor;
use super::ply_records::{Fault, Values, no_such_vertex};
use crate::mesh::columns::Number;

/// Calls `$body` with `$get` bound to a function from the first bytes of a slice to the number of that kind.
macro_rules! with_kind {
    ($kind:expr, $big:expr, |$get:ident| $body:expr) => {
        match ($kind, $big) {
            (Number::I8, _) => with_kind!(@ i8, from_ne_bytes, $get, $body),
            (Number::U8, _) => with_kind!(@ u8, from_ne_bytes, $get, $body),
            (Number::I16, false) => with_kind!(@ i16, from_le_bytes, $get, $body),
            (Number::I16, true) => with_kind!(@ i16, from_be_bytes, $get, $body),
            (Number::U16, false) => with_kind!(@ u16, from_le_bytes, $get, $body),
            (Number::U16, true) => with_kind!(@ u16, from_be_bytes, $get, $body),
            (Number::I32, false) => with_kind!(@ i32, from_le_bytes, $get, $body),
            (Number::I32, true) => with_kind!(@ i32, from_be_bytes, $get, $body),
            (Number::U32, false) => with_kind!(@ u32, from_le_bytes, $get, $body),
            (Number::U32, true) => with_kind!(@ u32, from_be_bytes, $get, $body),
            (Number::F32, false) => with_kind!(@ f32, from_le_bytes, $get, $body),
            (Number::F32, true) => with_kind!(@ f32, from_be_bytes, $get, $body),
            (Number::F64, false) => with_kind!(@ f64, from_le_bytes, $get, $body),
            (Number::F64, true) => with_kind!(@ f64, from_be_bytes, $get, $body),
        }
    };
    (@ $type:ty, $from:ident, $get:ident, $body:expr) => {{
        #[inline(always)]
        fn $get(bytes: &[u8]) -> $type {
            let mut number = [0; size_of::<$type>()];
            number.copy_from_slice(&bytes[..size_of::<$type>()]);
            <$type>::$from(number)
        }
        $body
    }};
}

/// Where the coordinates are in vertex records of one length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct VertexRecord {
    pub stride: usize,
    pub big: bool,
    /// Offset and type of x, y and z.
    pub axes: [(usize, Number); 3],
}

impl VertexRecord {
    /// Decodes whole records.
    pub fn decode(&self, records: &[u8], out: &mut Vec<[f64; 3]>) {
        out.clear();
        let [(x, kind), (y, ykind), (z, zkind)] = self.axes;
        let together = ykind == kind && zkind == kind && y == x + kind.bytes() && z == y + kind.bytes();
        match (kind, together && !self.big, self.stride) {
            (Number::F32, true, 12) => out.extend(records.as_chunks::<12>().0.iter().map(|r| xyz_f32(r))),
            (Number::F32, true, stride) => out.extend(records.chunks_exact(stride).map(|r| xyz_f32(&r[x..x + 12]))),
            _ => self.decode_by_axis(records, out),
        }
    }

    /// One coordinate of all records after the other, so that types are told apart once a chunk.
    #[expect(clippy::useless_conversion, reason = "one expression for every type of number")]
    fn decode_by_axis(&self, records: &[u8], out: &mut Vec<[f64; 3]>) {
        out.resize(records.len() / self.stride, [0.0; 3]);
        for (axis, (offset, kind)) in self.axes.into_iter().enumerate() {
            with_kind!(kind, self.big, |get| {
                for (position, record) in out.iter_mut().zip(records.chunks_exact(self.stride)) {
                    position[axis] = get(&record[offset..]).into();
                }
            });
        }
    }
}

/// Decodes a number of each of whole records of one length into every so many-th place.
#[expect(clippy::useless_conversion, reason = "one expression for every type of number")]
pub(super) fn decode_column(records: &[u8], stride: usize, at: (usize, Number, bool), out: &mut [f64], every: usize) {
    let (offset, kind, big) = at;
    with_kind!(kind, big, |get| {
        for (value, record) in out.iter_mut().step_by(every).zip(records.chunks_exact(stride)) {
            *value = get(&record[offset..]).into();
        }
    });
}

#[inline(always)]
fn xyz_f32(bytes: &[u8]) -> [f64; 3] {
    let xyz: [f32; 3] = bytemuck::pod_read_unaligned(bytes);
    xyz.map(|c| f64::from(f32::from_bits(u32::from_le(c.to_bits()))))
}

/// Where the corners are in face records of one length: those of a file of triangles only.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TriangleRecord {
    pub stride: usize,
    pub big: bool,
    /// Offset of the list's count.
    pub offset: usize,
    pub count: Number,
    pub index: Number,
}

/// What is wrong with a face.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BadFace {
    /// Which record of those decoded.
    pub record: usize,
    /// The byte within the record.
    pub byte: usize,
    pub what: String,
}

impl TriangleRecord {
    /// Whether all of these whole records have lists of three.
    pub fn all_triangles(&self, records: &[u8]) -> bool {
        let (three, size) = self.three();
        let list = self.offset..self.offset + size;
        match size {
            1 => records.chunks_exact(self.stride).fold(true, |all, r| all & (r[self.offset] == 3)),
            _ => records.chunks_exact(self.stride).all(|r| r[list.clone()] == three[..size]),
        }
    }

    /// The count of a triangle as it is in the file.
    fn three(&self) -> ([u8; 4], usize) {
        let size = self.count.bytes();
        let mut three = [0; 4];
        three[if self.big { size - 1 } else { 0 }] = 3;
        (three, size)
    }

    /// Decodes whole records, checking that each is a triangle of vertices that exist.
    pub fn decode(&self, records: &[u8], vertices: u64, out: &mut Vec<[u32; 3]>) -> Result<(), BadFace> {
        out.clear();
        let limit = vertices.min(self.index.index_limit());
        let common = self.count.bytes() == 1 && self.index.bytes() == 4 && !self.big;
        let sound = match (common, self.stride) {
            (true, 13) => {
                let (mut sound, mut largest) = (true, 0);
                out.extend(records.as_chunks::<13>().0.iter().map(|r| triangle(r, &mut sound, &mut largest)));
                sound && u64::from(largest) < limit
            }
            (true, stride) => {
                let (mut sound, mut largest) = (true, 0);
                let list = self.offset..self.offset + 13;
                let records = records.chunks_exact(stride).map(|r| &r[list.clone()]);
                out.extend(records.map(|r| triangle(r, &mut sound, &mut largest)));
                sound && u64::from(largest) < limit
            }
            _ => self.all_triangles(records) && self.decode_by_corner(records, limit, out),
        };
        if sound { Ok(()) } else { Err(self.find_bad(records, vertices)) }
    }

    fn decode_by_corner(&self, records: &[u8], limit: u64, out: &mut Vec<[u32; 3]>) -> bool {
        out.resize(records.len() / self.stride, [0; 3]);
        let mut sound = true;
        for corner in 0..3 {
            let offset = self.corner_offset(corner);
            with_kind!(self.index, self.big, |get| {
                for (triangle, record) in out.iter_mut().zip(records.chunks_exact(self.stride)) {
                    // A negative number becomes one at or above the limit of its kind.
                    let index = get(&record[offset..]) as i64 as u64;
                    sound &= index < limit;
                    triangle[corner] = index as u32;
                }
            });
        }
        sound
    }

    fn corner_offset(&self, corner: usize) -> usize {
        self.offset + self.count.bytes() + corner * self.index.bytes()
    }

    /// The first record that [`decode`](Self::decode) would not have.
    #[cold]
    fn find_bad(&self, records: &[u8], vertices: u64) -> BadFace {
        for (record, bytes) in records.chunks_exact(self.stride).enumerate() {
            if !self.all_triangles(bytes) {
                let what = "a list count that is not 3, where the size of the file says that every face is a triangle";
                return BadFace { record, byte: self.offset, what: what.into() };
            }
            for corner in 0..3 {
                let byte = self.corner_offset(corner);
                let index = with_kind!(self.index, self.big, |get| get(&bytes[byte..]) as i64);
                if index < 0 || index as u64 >= vertices {
                    return BadFace { record, byte, what: no_such_vertex(index, vertices) };
                }
            }
        }
        BadFace { record: 0, byte: 0, what: "the bytes of the file changed while they were read".into() }
    }
}

#[inline(always)]
fn triangle(list: &[u8], sound: &mut bool, largest: &mut u32) -> [u32; 3] {
    *sound &= list[0] == 3;
    let corners: [u32; 3] = bytemuck::pod_read_unaligned(&list[1..13]);
    let corners = corners.map(u32::from_le);
    *largest = (*largest).max(corners[0]).max(corners[1]).max(corners[2]);
    corners
}

/// Binary values one after the other.
pub(super) struct Binary<'a, const BIG: bool>(Cursor<'a>);

impl<const BIG: bool> Binary<'_, BIG> {
    #[inline(always)]
    fn take(&mut self, len: usize) -> Result<&[u8], Fault> {
        if self.0.left() < len as u64 {
            return Err(Fault::End);
        }
        let bytes = self.0.bytes(len)?;
        Ok(&bytes[..len])
    }
}

impl<'a, const BIG: bool> Values<'a> for Binary<'a, BIG> {
    fn new(cursor: Cursor<'a>) -> Self {
        Binary(cursor)
    }

    fn at(&self) -> u64 {
        self.0.at
    }

    #[inline]
    #[expect(clippy::useless_conversion, reason = "one expression for every type of number")]
    fn number(&mut self, kind: Number) -> Result<f64, Fault> {
        let bytes = self.take(kind.bytes())?;
        let number = with_kind!(kind, BIG, |get| get(bytes).into());
        self.0.at += kind.bytes() as u64;
        Ok(number)
    }

    #[inline]
    fn integer(&mut self, kind: Number) -> Result<i64, Fault> {
        let bytes = self.take(kind.bytes())?;
        let number = with_kind!(kind, BIG, |get| get(bytes) as i64);
        self.0.at += kind.bytes() as u64;
        Ok(number)
    }

    fn indices(&mut self, kind: Number, n: usize, limit: u64, corners: &mut Vec<u32>) -> Result<(), Fault> {
        let (at, size, from) = (self.0.at, kind.bytes(), corners.len());
        let bytes = self.take(n * size)?;
        let mut sound = true;
        with_kind!(kind, BIG, |get| {
            corners.extend((0..n).map(|i| {
                let index = get(&bytes[i * size..]) as i64 as u64;
                sound &= index < limit;
                index as u32
            }));
        });
        if !sound {
            let index = |i: usize| with_kind!(kind, BIG, |get| get(&bytes[i * size..]) as i64);
            let bad = (0..corners.len() - from).find(|&i| index(i) < 0 || index(i) as u64 >= limit).unwrap_or(0);
            return Err(Fault::Wrong(at + (bad * size) as u64, no_such_vertex(index(bad), limit)));
        }
        self.0.at += (n * size) as u64;
        Ok(())
    }

    #[inline]
    fn skip(&mut self, kind: Number, n: u64) -> Result<(), Fault> {
        let bytes = n * kind.bytes() as u64;
        if self.0.left() < bytes {
            return Err(Fault::End);
        }
        self.0.at += bytes;
        Ok(())
    }

    #[inline]
    fn skip_zeros(&mut self, count: Number, most: u64) -> Result<u64, Fault> {
        let size = count.bytes();
        let mut skipped = 0;
        while skipped < most {
            let bytes = self.0.bytes(size)?;
            if bytes.first() != Some(&0) {
                break;
            }
            let whole = (bytes.len() / size) as u64;
            let most_here = whole.min(most - skipped);
            let here = (zeros(bytes) / size) as u64;
            let here = here.min(most_here);
            self.0.at += here * size as u64;
            skipped += here;
            if here < most_here || here == 0 {
                break;
            }
        }
        Ok(skipped)
    }
}

/// Zero bytes at the beginning.
fn zeros(bytes: &[u8]) -> usize {
    const LANES: usize = 64;
    let (blocks, _) = bytes.as_chunks::<LANES>();
    let whole = blocks.iter().take_while(|b| b.iter().fold(0, |any, byte| any | byte) == 0).count() * LANES;
    whole + bytes[whole..].iter().take_while(|&&b| b == 0).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Records of `before` bytes, a count, three indices and `behind` bytes.
    fn record(before: usize, behind: usize, count: Number, index: Number, big: bool) -> TriangleRecord {
        let stride = before + count.bytes() + 3 * index.bytes() + behind;
        TriangleRecord { stride, big, offset: before, count, index }
    }

    fn put(bytes: &mut [u8], at: usize, kind: Number, big: bool, number: i64) {
        let (le, len) = (number.to_le_bytes(), kind.bytes());
        let place = &mut bytes[at..at + len];
        place.copy_from_slice(&le[..len]);
        if big {
            place.reverse();
        }
    }

    fn encode(record: &TriangleRecord, faces: &[(i64, [i64; 3])]) -> Vec<u8> {
        let mut bytes = vec![3; record.stride * faces.len()];
        for (bytes, (count, corners)) in bytes.chunks_mut(record.stride).zip(faces) {
            put(bytes, record.offset, record.count, record.big, *count);
            for (corner, v) in corners.iter().enumerate() {
                put(bytes, record.corner_offset(corner), record.index, record.big, *v);
            }
        }
        bytes
    }

    #[test]
    fn every_layout_of_triangles_is_decoded_or_refused_at_the_right_byte() {
        const INTEGERS: [Number; 6] = [Number::I8, Number::U8, Number::I16, Number::U16, Number::I32, Number::U32];
        let sound: Vec<(i64, [i64; 3])> = (0..40).map(|i| (3, [i, i + 1, (i * 7) % 42])).collect();
        for count in INTEGERS {
            for index in INTEGERS {
                for (big, before, behind) in [(false, 0, 0), (true, 0, 0), (false, 2, 3), (true, 1, 0)] {
                    let record = record(before, behind, count, index, big);
                    let mut out = Vec::new();
                    record.decode(&encode(&record, &sound), 42, &mut out).unwrap();
                    assert_eq!(out, sound.iter().map(|(_, t)| t.map(|v| v as u32)).collect::<Vec<_>>());

                    let mut bad = sound.clone();
                    bad[17].1[1] = 42;
                    let refused = record.decode(&encode(&record, &bad), 42, &mut out).unwrap_err();
                    assert_eq!((refused.record, refused.byte), (17, record.corner_offset(1)));
                    assert_eq!(refused.what, "index 42, but the file has 42 vertices");
                    bad[9] = (4, [0; 3]);
                    let refused = record.decode(&encode(&record, &bad), 42, &mut out).unwrap_err();
                    assert_eq!((refused.record, refused.byte), (9, before));
                    assert!(refused.what.starts_with("a list count that is not 3"));
                }
            }
        }
    }

    #[test]
    fn a_negative_index_is_none_however_many_vertices_there_are() {
        for index in [Number::I8, Number::I16, Number::I32] {
            let record = record(0, 0, Number::U8, index, false);
            let refused = record.decode(&encode(&record, &[(3, [0, 1, -2])]), u64::MAX, &mut Vec::new()).unwrap_err();
            assert!(refused.what.starts_with("index -2, but"), "{}", refused.what);
        }
    }

    #[test]
    fn zeros_are_counted_to_the_byte() {
        for len in 0..300 {
            for first in 0..len {
                let mut bytes = vec![0; len];
                bytes[first] = 1;
                assert_eq!(zeros(&bytes), first);
            }
            assert_eq!(zeros(&vec![0; len]), len);
        }
    }
}
