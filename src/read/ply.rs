//! PLY files: where each element lies, how many triangles the polygons make, and the streaming passes.
//!
//! Where every record of an element has the same length, its chunks are decoded by all workers side by side. Faces have
//! one length only when all of them are triangles. That is taken for true when the size of the file says so and a look at
//! the list counts agrees ([`Ply::look_like_triangles`]); each count is checked again as it is decoded. Otherwise the
//! faces are counted one by one when the file is opened, and decoded in order by the claiming thread.

use super::ascii::Ascii;
use super::attribute::Attribute;
use super::cursor::Cursor;
use super::map::Input;
use super::ply_binary::{BadFace, Binary, TriangleRecord, VertexRecord, decode_column};
use super::ply_header::{self, Element, Header, Role, Shape};
use super::ply_records::{Counted, Records, Row};
use super::stream::{CHUNK, Crew, Numbering, Run, pump_decoded};
use super::{CarriedChunk, CarriedStep, Format, TriangleChunk, TriangleStep, VertexChunk, VertexStep};
use crate::error::{Error, Item, Result};
use crate::mesh::columns::Column;
use crate::mesh::columns::Number;
use crate::progress::Progress;
use ply_rs::ply::Encoding;

/// A face section up to this size is looked through completely before its faces are taken for triangles.
const LOOK_AT_ALL_BYTES: u64 = 64 << 20;

/// Of a larger one, this many runs of [`LOOK_RUN`] faces are looked at.
const LOOK_RUNS: u64 = 256;
const LOOK_RUN: u64 = 256;

/// Vertices with what they carry that are decoded in order at a time: as many bytes as a chunk of positions.
const ROWS: usize = CHUNK / 8;

/// An open PLY file.
#[derive(Debug)]
pub(super) struct Ply {
    pub encoding: Encoding,
    pub vertex: Element,
    pub face: Element,
    pub vertex_offset: u64,
    pub face_offset: u64,
    /// Where all vertex records have one length.
    pub vertex_run: Option<(Run, VertexRecord)>,
    /// Where all faces are triangles.
    pub triangle_run: Option<(Run, TriangleRecord)>,
    pub triangles: u64,
    /// Polygons of fewer than three corners.
    pub short_polygons: u64,
    pub trailing: u64,
    /// Files that the header names as textures.
    pub textures: Vec<String>,
}

impl Ply {
    /// Reads the header, checks it against the size of the file, and finds and counts what it does not say.
    pub fn open(input: &Input, progress: &Progress) -> Result<Self> {
        Self::with_header(input, progress, ply_header::read(input)?)
    }

    /// Checks a header, of this format or one that has the same records.
    pub fn with_header(input: &Input, progress: &Progress, header: Header) -> Result<Self> {
        let find = |kind| header.elements.iter().position(|e| e.kind == kind);
        let refuse = |what: &str| Error::input(input.path(), what);
        let vertex = find("vertex").ok_or_else(|| refuse("has no vertex: the header names no element `vertex`"))?;
        let face = find("face").ok_or_else(|| refuse("has no faces: the header names no element `face`"))?;
        let mut ply = Ply {
            encoding: header.encoding,
            vertex: header.elements[vertex].clone(),
            face: header.elements[face].clone(),
            vertex_offset: 0,
            face_offset: 0,
            vertex_run: None,
            triangle_run: None,
            triangles: 0,
            short_polygons: 0,
            trailing: 0,
            textures: header.textures,
        };
        ply.check_elements().map_err(|what| refuse(&what))?;
        let mut at = header.payload;
        for (i, element) in header.elements.iter().enumerate() {
            check_room(input, element, ply.encoding, at)?;
            if i == vertex {
                ply.vertex_offset = at;
            }
            at = if i == face {
                ply.face_offset = at;
                ply.open_faces(input, progress, &header.elements[i + 1..])?
            } else {
                ply.end_of(input, progress, element, at)?
            };
        }
        ply.trailing = ply.trailing_from(input, progress, at)?;
        ply.vertex_run = ply.vertex_record().map(|record| {
            let run = Run { offset: ply.vertex_offset, count: ply.vertex.count, stride: record.stride };
            (run, record)
        });
        Ok(ply)
    }

    /// What is read of vertices and faces must be there and of a type that makes sense.
    fn check_elements(&self) -> Result<(), String> {
        for (axis, name) in ["x", "y", "z"].iter().enumerate() {
            match self.vertex.find(Role::Axis(axis)) {
                Some((_, Shape::Scalar(_))) => {}
                Some(_) => return Err(format!("vertex property `{name}` is a list, expected a number")),
                None => return Err(format!("vertices have no property `{name}`")),
            }
        }
        match self.face.find(Role::Corners) {
            None => return Err("faces have no list property `vertex_indices` or `vertex_index`".into()),
            Some((_, Shape::Scalar(_))) => return Err("the face property of vertex indices is not a list".into()),
            Some((_, Shape::List { item, .. })) if !item.is_integer() => {
                return Err("vertex indices are fractional numbers, expected an integer type".into());
            }
            Some(_) => {}
        }
        let lists = self.vertex.properties.iter().chain(&self.face.properties);
        for property in lists {
            if let Shape::List { count, .. } = property.shape
                && !count.is_integer()
            {
                return Err("a list has a fractional number as its count, expected an integer type".into());
            }
        }
        if self.vertex.count == 0 {
            return Err("has no vertex: the header counts 0".into());
        }
        if self.face.count == 0 {
            return Err("has no faces: the header counts 0".into());
        }
        Ok(())
    }

    /// Finds out whether the faces are triangles and how many triangles they make; returns where they end.
    fn open_faces(&mut self, input: &Input, progress: &Progress, later: &[Element]) -> Result<u64> {
        let record = self.triangle_record();
        let run = record.map(|r| Run { offset: self.face_offset, count: self.face.count, stride: r.stride });
        if let (Some(record), Some(run)) = (record, run)
            && sizes_agree(input, &run, later)
            && self.look_like_triangles(input, progress, &run, &record)?
        {
            self.triangle_run = Some((run, record));
            self.triangles = run.count;
            return Ok(run.byte(run.count));
        }
        let counted = self.count(input, progress, &self.face, self.face_offset)?;
        self.triangles = counted.triangles;
        self.short_polygons = self.face.count - counted.polygons;
        if counted.triangles == 0 {
            return Err(Error::input(input.path(), "has no usable face: every polygon has fewer than three corners"));
        }
        if counted.all_triangles {
            self.triangle_run = run.zip(record);
        }
        Ok(counted.end)
    }

    /// Looks at the list counts of a face section whose size is that of triangles: all of them in a file of moderate size,
    /// else runs of them spread evenly, read past the map. A polygon of another size shifts all that follow it, so only
    /// a stretch shorter than the gaps between the runs can be overlooked; decoding then refuses it.
    fn look_like_triangles(
        &self,
        input: &Input,
        progress: &Progress,
        run: &Run,
        record: &TriangleRecord,
    ) -> Result<bool> {
        if run.count.saturating_mul(run.stride as u64) <= LOOK_AT_ALL_BYTES {
            let mut first = 0;
            while first < run.count {
                progress.check()?;
                let (window, records) = run.window(input, first)?;
                if !record.all_triangles(&window) {
                    return Ok(false);
                }
                first += records as u64;
            }
            return Ok(true);
        }
        let mut bytes = vec![0; (LOOK_RUN.min(run.count) as usize) * run.stride];
        let last = run.count - LOOK_RUN.min(run.count);
        for i in 0..LOOK_RUNS {
            progress.check()?;
            let first = (u128::from(last) * u128::from(i) / u128::from(LOOK_RUNS - 1)) as u64;
            input.read_at(&mut bytes, run.byte(first))?;
            if !record.all_triangles(&bytes) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn is_ascii(&self) -> bool {
        self.encoding == Encoding::Ascii
    }

    fn is_big(&self) -> bool {
        self.encoding == Encoding::BinaryBigEndian
    }

    fn vertex_record(&self) -> Option<VertexRecord> {
        if self.is_ascii() || self.vertex.lists() > 0 {
            return None;
        }
        let axis = |axis| match self.vertex.find(Role::Axis(axis)) {
            Some((offset, Shape::Scalar(kind))) => Some((offset, kind)),
            _ => None,
        };
        let axes = [axis(0)?, axis(1)?, axis(2)?];
        Some(VertexRecord { stride: self.vertex.bytes_with(0) as usize, big: self.is_big(), axes })
    }

    fn triangle_record(&self) -> Option<TriangleRecord> {
        if self.is_ascii() || self.face.lists() != 1 {
            return None;
        }
        let Some((offset, Shape::List { count, item })) = self.face.find(Role::Corners) else { return None };
        let stride = self.face.bytes_with(3) as usize;
        Some(TriangleRecord { stride, big: self.is_big(), offset, count, index: item })
    }

    fn end_of(&self, input: &Input, progress: &Progress, element: &Element, at: u64) -> Result<u64> {
        if !self.is_ascii() && element.lists() == 0 {
            return Ok(at + element.count * element.bytes_with(0));
        }
        Ok(self.count(input, progress, element, at)?.end)
    }

    fn count(&self, input: &Input, progress: &Progress, element: &Element, at: u64) -> Result<Counted> {
        let (path, cursor) = (input.path(), Cursor::new(input, progress, at));
        match self.encoding {
            Encoding::Ascii => Records::<Ascii<'_>>::new(path, element, cursor, 0).count(),
            Encoding::BinaryBigEndian => Records::<Binary<'_, true>>::new(path, element, cursor, 0).count(),
            Encoding::BinaryLittleEndian => Records::<Binary<'_, false>>::new(path, element, cursor, 0).count(),
        }
    }

    /// Bytes behind the last element; of a text, those from the first that is no white space.
    fn trailing_from(&self, input: &Input, progress: &Progress, at: u64) -> Result<u64> {
        let mut cursor = Cursor::new(input, progress, at);
        if self.is_ascii() {
            super::ascii::skip_space(&mut cursor)?;
        }
        Ok(cursor.left())
    }

    /// Vertices as the header counts them.
    pub fn vertex_count(&self) -> u64 {
        self.vertex.count
    }

    /// Polygons as the header counts them.
    pub fn face_count(&self) -> u64 {
        self.face.count
    }

    /// The type that holds all coordinates.
    pub fn fits_f32(&self) -> bool {
        self.vertex.properties.iter().all(|p| match (p.role, p.shape) {
            (Role::Axis(_), Shape::Scalar(kind)) => kind.fits_f32(),
            _ => true,
        })
    }

    /// What vertices and faces carry beside positions and corners.
    pub fn attributes(&self) -> Vec<Attribute> {
        [self.vertex.attributes(), self.face.attributes()].concat()
    }

    /// What the format is called.
    pub fn format(&self) -> Format {
        match self.encoding {
            Encoding::Ascii => Format::PlyAscii,
            Encoding::BinaryBigEndian => Format::PlyBigEndian,
            Encoding::BinaryLittleEndian => Format::PlyLittleEndian,
        }
    }

    /// Streams vertices of one length.
    pub fn vertices_in_run<W: Send>(
        &self,
        (run, record): &(Run, VertexRecord),
        input: &Input,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, VertexChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        let local = || (worker(), Vec::new());
        let locals = run.pump(input, crew, local, |(mine, positions), first, bytes| {
            record.decode(bytes, positions);
            step(mine, VertexChunk { first, positions })
        })?;
        Ok(locals.into_iter().map(|(mine, _)| mine).collect())
    }

    /// Streams vertices that must be read in order.
    pub fn vertices_in_order(&self, input: &Input, crew: &Crew<'_>, step: &VertexStep<'_>) -> Result<()> {
        let (path, cursor) = (input.path(), Cursor::new(input, crew.progress, self.vertex_offset));
        let step = &|worker, first, positions: &[_]| step(worker, VertexChunk { first, positions });
        match self.encoding {
            Encoding::Ascii => {
                let mut records = Records::<Ascii<'_>>::new(path, &self.vertex, cursor, 0);
                pump_decoded(crew, &mut |out| records.vertices(CHUNK, out), step)
            }
            Encoding::BinaryBigEndian => {
                let mut records = Records::<Binary<'_, true>>::new(path, &self.vertex, cursor, 0);
                pump_decoded(crew, &mut |out| records.vertices(CHUNK, out), step)
            }
            Encoding::BinaryLittleEndian => {
                let mut records = Records::<Binary<'_, false>>::new(path, &self.vertex, cursor, 0);
                pump_decoded(crew, &mut |out| records.vertices(CHUNK, out), step)
            }
        }
    }

    /// Numbers that vertices carry.
    pub fn columns(&self) -> Vec<Column> {
        self.vertex.columns().into_iter().map(|(_, column)| column).collect()
    }

    /// Streams the vertices with what they carry.
    pub fn carried(&self, input: &Input, crew: &Crew<'_>, step: &CarriedStep<'_>) -> Result<()> {
        let wanted: Vec<usize> = self.vertex.columns().into_iter().map(|(i, _)| i).collect();
        let columns = wanted.len();
        let Some((run, record)) = &self.vertex_run else {
            let (path, cursor) = (input.path(), Cursor::new(input, crew.progress, self.vertex_offset));
            let step = &|worker, first, rows: &[Row]| {
                let positions: Vec<[f64; 3]> = rows.iter().map(|row| [row[0], row[1], row[2]]).collect();
                let values: Vec<f64> = rows.iter().flat_map(|row| &row[3..3 + columns]).copied().collect();
                step(worker, CarriedChunk { first, positions: &positions, values: &values, columns })
            };
            return match self.encoding {
                Encoding::Ascii => {
                    let mut records = Records::<Ascii<'_>>::new(path, &self.vertex, cursor, 0);
                    pump_decoded(crew, &mut |out| records.rows(&wanted, ROWS, out), step)
                }
                Encoding::BinaryBigEndian => {
                    let mut records = Records::<Binary<'_, true>>::new(path, &self.vertex, cursor, 0);
                    pump_decoded(crew, &mut |out| records.rows(&wanted, ROWS, out), step)
                }
                Encoding::BinaryLittleEndian => {
                    let mut records = Records::<Binary<'_, false>>::new(path, &self.vertex, cursor, 0);
                    pump_decoded(crew, &mut |out| records.rows(&wanted, ROWS, out), step)
                }
            };
        };
        let numbers = Numbering::default();
        let places: Vec<(usize, Number)> = wanted
            .iter()
            .filter_map(|i| match self.vertex.properties[*i].shape {
                Shape::Scalar(kind) => Some((self.vertex.offset_of(*i), kind)),
                Shape::List { .. } => None,
            })
            .collect();
        let local = || (numbers.next(), Vec::new(), Vec::new());
        run.pump(input, crew, local, |(worker, positions, values), first, bytes| {
            record.decode(bytes, positions);
            values.clear();
            values.resize(positions.len() * columns, 0.0);
            for (c, (offset, kind)) in places.iter().enumerate() {
                decode_column(bytes, run.stride, (*offset, *kind, record.big), &mut values[c..], columns);
            }
            step(*worker, CarriedChunk { first, positions, values, columns })
        })?;
        Ok(())
    }

    /// Streams faces that are all triangles.
    pub fn triangles_in_run<W: Send>(
        &self,
        (run, record): &(Run, TriangleRecord),
        input: &Input,
        crew: &Crew<'_>,
        worker: impl Fn() -> W + Sync,
        step: impl Fn(&mut W, TriangleChunk<'_>) -> Result<()> + Sync,
    ) -> Result<Vec<W>> {
        let local = || (worker(), Vec::new());
        let locals = run.pump(input, crew, local, |(mine, triangles), first, bytes| {
            run.bites(first, bytes).try_for_each(|(first, bytes)| {
                record.decode(bytes, self.vertex.count, triangles).map_err(|bad| face_error(input, run, first, bad))?;
                step(mine, TriangleChunk { first, triangles })
            })
        })?;
        Ok(locals.into_iter().map(|(mine, _)| mine).collect())
    }

    /// Streams faces that must be read in order.
    pub fn triangles_in_order(&self, input: &Input, crew: &Crew<'_>, step: &TriangleStep<'_>) -> Result<()> {
        let (path, vertices) = (input.path(), self.vertex.count);
        let cursor = Cursor::new(input, crew.progress, self.face_offset);
        let step = &|worker, first, triangles: &[_]| step(worker, TriangleChunk { first, triangles });
        match self.encoding {
            Encoding::Ascii => {
                let mut records = Records::<Ascii<'_>>::new(path, &self.face, cursor, vertices);
                pump_decoded(crew, &mut |out| records.triangles(CHUNK, out), step)
            }
            Encoding::BinaryBigEndian => {
                let mut records = Records::<Binary<'_, true>>::new(path, &self.face, cursor, vertices);
                pump_decoded(crew, &mut |out| records.triangles(CHUNK, out), step)
            }
            Encoding::BinaryLittleEndian => {
                let mut records = Records::<Binary<'_, false>>::new(path, &self.face, cursor, vertices);
                pump_decoded(crew, &mut |out| records.triangles(CHUNK, out), step)
            }
        }
    }
}

/// The error for a face that could not be decoded, in a chunk that begins with face `first`.
pub(super) fn face_error(input: &Input, run: &Run, first: u64, bad: BadFace) -> Error {
    let ordinal = first + bad.record as u64;
    let byte = run.byte(ordinal) + bad.byte as u64;
    Error::input_at(input.path(), Item { kind: "face", ordinal }, byte, bad.what)
}

/// Whether the file is exactly as long as triangles make it.
fn sizes_agree(input: &Input, run: &Run, later: &[Element]) -> bool {
    let mut end = u128::from(run.offset) + u128::from(run.count) * run.stride as u128;
    for element in later {
        if element.lists() > 0 && element.count > 0 {
            return false;
        }
        end += u128::from(element.count) * u128::from(element.bytes_with(0));
    }
    end == u128::from(input.len())
}

/// Checks that the file is long enough for the records that the header promises, at their shortest.
fn check_room(input: &Input, element: &Element, encoding: Encoding, at: u64) -> Result<()> {
    let (record, left) = match encoding {
        // A character and a space a value, and no space behind the last one.
        Encoding::Ascii => (2 * element.properties.len() as u64, input.len().saturating_sub(at) + 1),
        _ => (element.bytes_with(0), input.len().saturating_sub(at)),
    };
    if u128::from(element.count) * u128::from(record) <= u128::from(left) {
        return Ok(());
    }
    let item = Item { kind: element.kind, ordinal: left / record };
    let at_least = if element.lists() > 0 || encoding == Encoding::Ascii { "at least " } else { "" };
    let what = format!(
        "the file ends at byte {}, but the header promises {} of its kind, of {at_least}{record} bytes each",
        input.len(),
        element.count
    );
    Err(Error::input_at(input.path(), item, at + record * (left / record), what))
}
