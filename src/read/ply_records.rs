//! PLY records read one after the other: text, and binary records of unequal length.
//!
//! What a record is made of is the same in both encodings; how a number is taken from the file is a [`Values`]. Where
//! every record has the same length nothing of this is used: see `ply_binary`.

use super::cursor::Cursor;
use super::ply_header::{Element, MOST_COLUMNS, Property, Role, Shape};
use crate::error::{Error, Item, Result};
use crate::mesh::columns::Number;
use std::path::Path;

/// The most corners of a polygon: far beyond what any tool writes, and a bound on what one record makes us hold.
pub(super) const MAX_CORNERS: u64 = 65_536;

/// What becomes of a face: its corners, its numbers, the numbers of a list that it has.
pub(super) type LabelledStep<'a> = dyn FnMut(&[u32], &[f64], &[f64]) + 'a;

/// A position, and what is carried with it.
pub(super) type Row = [f64; 3 + MOST_COLUMNS];

/// Why a number could not be taken.
#[derive(Debug)]
pub(super) enum Fault {
    /// The file ends first.
    End,
    /// What is at this byte is not what should be.
    Wrong(u64, String),
    /// Nothing to do with the record.
    Failed(Error),
}

impl From<Error> for Fault {
    fn from(error: Error) -> Self {
        Fault::Failed(error)
    }
}

/// Numbers in the order of the file.
pub(super) trait Values<'a> {
    /// Begins where the cursor is.
    fn new(cursor: Cursor<'a>) -> Self;
    /// The byte that is next.
    fn at(&self) -> u64;
    /// One number.
    fn number(&mut self, kind: Number) -> Result<f64, Fault>;
    /// One whole number.
    fn integer(&mut self, kind: Number) -> Result<i64, Fault>;
    /// `n` indices, each below `limit`, appended to `corners`.
    fn indices(&mut self, kind: Number, n: usize, limit: u64, corners: &mut Vec<u32>) -> Result<(), Fault>;
    /// Passes over `n` numbers.
    fn skip(&mut self, kind: Number, n: u64) -> Result<(), Fault>;
    /// Passes over at most `most` counts of 0, where that can be done faster than one by one.
    fn skip_zeros(&mut self, count: Number, most: u64) -> Result<u64, Fault>;
}

/// An index that no vertex has.
pub(super) fn no_such_vertex(index: i64, vertices: u64) -> String {
    format!("index {index}, but the file has {vertices} vertices")
}

/// The records of one element.
pub(super) struct Records<'a, V> {
    file: &'a Path,
    element: &'a Element,
    values: V,
    /// The next record.
    ordinal: u64,
    vertices: u64,
    corners: Vec<u32>,
    bare_list: Option<Number>,
}

/// What [`Records::count`] found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Counted {
    /// Triangles of all polygons.
    pub triangles: u64,
    /// Polygons that make at least one.
    pub polygons: u64,
    /// Whether every polygon is one triangle.
    pub all_triangles: bool,
    /// One past the last byte.
    pub end: u64,
}

impl<'a, V: Values<'a>> Records<'a, V> {
    /// The records of `element`, of which the first begins at the cursor; `vertices` bounds the indices of faces.
    pub fn new(file: &'a Path, element: &'a Element, cursor: Cursor<'a>, vertices: u64) -> Self {
        let bare_list = match element.properties[..] {
            [Property { shape: Shape::List { count, .. }, .. }] => Some(count),
            _ => None,
        };
        Records { file, element, values: V::new(cursor), ordinal: 0, vertices, corners: Vec::new(), bare_list }
    }

    /// Passes over all records; counts the triangles that they make if they are faces.
    pub fn count(mut self) -> Result<Counted> {
        let mut counted = Counted { triangles: 0, polygons: 0, all_triangles: true, end: 0 };
        if !self.element.properties.is_empty() {
            while self.pass_empty_lists()? {
                let begin = self.values.at();
                let n = self.count_one().map_err(|fault| self.error(begin, fault))?;
                counted.triangles += n.saturating_sub(2);
                counted.polygons += u64::from(n > 2);
                counted.all_triangles &= n == 3;
                self.ordinal += 1;
            }
            counted.all_triangles &= self.element.count > 0 && counted.triangles == self.element.count;
        }
        counted.end = self.values.at();
        Ok(counted)
    }

    fn count_one(&mut self) -> Result<u64, Fault> {
        let mut corners = 0;
        for property in &self.element.properties {
            match property.shape {
                Shape::Scalar(kind) => self.values.skip(kind, 1)?,
                Shape::List { count, item } => {
                    let n = list_length(&mut self.values, count)?;
                    if property.role == Role::Corners {
                        corners = check_corners(n, self.values.at())?;
                    }
                    self.values.skip(item, n)?;
                }
            }
        }
        Ok(corners)
    }

    /// Appends vertices until there are `most` or no more; returns the bytes gone through.
    pub fn vertices(&mut self, most: usize, out: &mut Vec<[f64; 3]>) -> Result<u64> {
        let from = self.values.at();
        while out.len() < most && self.ordinal < self.element.count {
            let begin = self.values.at();
            out.push(self.vertex().map_err(|fault| self.error(begin, fault))?);
            self.ordinal += 1;
        }
        Ok(self.values.at() - from)
    }

    /// Appends vertices with the numbers of these properties behind their positions, until there are `most` or no more;
    /// returns the bytes gone through.
    pub fn rows(&mut self, wanted: &[usize], most: usize, out: &mut Vec<Row>) -> Result<u64> {
        let from = self.values.at();
        while out.len() < most && self.ordinal < self.element.count {
            let begin = self.values.at();
            out.push(self.row(wanted).map_err(|fault| self.error(begin, fault))?);
            self.ordinal += 1;
        }
        Ok(self.values.at() - from)
    }

    fn row(&mut self, wanted: &[usize]) -> Result<Row, Fault> {
        let mut row = Row::default();
        let mut next = 0;
        for (i, property) in self.element.properties.iter().enumerate() {
            match (property.shape, property.role) {
                (Shape::Scalar(kind), Role::Axis(axis)) => row[axis] = self.values.number(kind)?,
                (Shape::Scalar(kind), _) if wanted.get(next) == Some(&i) => {
                    row[3 + next] = self.values.number(kind)?;
                    next += 1;
                }
                (Shape::Scalar(kind), _) => self.values.skip(kind, 1)?,
                (Shape::List { count, item }, _) => {
                    let n = list_length(&mut self.values, count)?;
                    self.values.skip(item, n)?;
                }
            }
        }
        Ok(row)
    }

    fn vertex(&mut self) -> Result<[f64; 3], Fault> {
        let mut position = [0.0; 3];
        for property in &self.element.properties {
            match (property.shape, property.role) {
                (Shape::Scalar(kind), Role::Axis(axis)) => position[axis] = self.values.number(kind)?,
                (Shape::Scalar(kind), _) => self.values.skip(kind, 1)?,
                (Shape::List { count, item }, _) => {
                    let n = list_length(&mut self.values, count)?;
                    self.values.skip(item, n)?;
                }
            }
        }
        Ok(position)
    }

    /// Appends the triangles of further faces until there are at least `enough` or no more; returns the bytes gone through.
    pub fn triangles(&mut self, enough: usize, out: &mut Vec<[u32; 3]>) -> Result<u64> {
        let from = self.values.at();
        while out.len() < enough && self.pass_empty_lists()? {
            let begin = self.values.at();
            self.face(&[], None, &mut Vec::new(), &mut Vec::new()).map_err(|fault| self.error(begin, fault))?;
            self.ordinal += 1;
            match self.corners[..] {
                [a, b, c] => out.push([a, b, c]),
                [a, b, c, d] => out.extend([[a, b, c], [a, c, d]]),
                [first, ref rest @ ..] => out.extend(rest.windows(2).map(|pair| [first, pair[0], pair[1]])),
                [] => {}
            }
        }
        Ok(self.values.at() - from)
    }

    /// Goes through all faces with numbers of theirs: corners, the numbers of these properties, those of a list.
    pub fn labelled(mut self, wanted: &[usize], list: Option<usize>, each: &mut LabelledStep<'_>) -> Result<()> {
        let (mut labels, mut values) = (Vec::new(), Vec::new());
        while self.pass_empty_lists()? {
            let begin = self.values.at();
            let read = self.face(wanted, list, &mut labels, &mut values);
            read.map_err(|fault| self.error(begin, fault))?;
            self.ordinal += 1;
            each(&self.corners, &labels, &values);
        }
        Ok(())
    }

    /// Reads a face: its corners, the numbers of `wanted` properties and those of a `list`.
    #[inline(always)]
    fn face(
        &mut self,
        wanted: &[usize],
        list: Option<usize>,
        labels: &mut Vec<f64>,
        values: &mut Vec<f64>,
    ) -> Result<(), Fault> {
        self.corners.clear();
        labels.clear();
        values.clear();
        for (i, property) in self.element.properties.iter().enumerate() {
            match property.shape {
                Shape::Scalar(kind) if wanted.contains(&i) => labels.push(self.values.number(kind)?),
                Shape::Scalar(kind) => self.values.skip(kind, 1)?,
                Shape::List { count, item } => {
                    let n = list_length(&mut self.values, count)?;
                    if property.role == Role::Corners {
                        let n = check_corners(n, self.values.at())? as usize;
                        self.values.indices(item, n, self.vertices, &mut self.corners)?;
                    } else if list == Some(i) && n <= 2 * MAX_CORNERS {
                        for _ in 0..n {
                            values.push(self.values.number(item)?);
                        }
                    } else {
                        self.values.skip(item, n)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// Passes over records that are an empty list and nothing else; whether another record follows.
    #[inline(always)]
    fn pass_empty_lists(&mut self) -> Result<bool> {
        if let Some(count) = self.bare_list {
            let begin = self.values.at();
            let left = self.element.count - self.ordinal;
            self.ordinal += self.values.skip_zeros(count, left).map_err(|fault| self.error(begin, fault))?;
        }
        Ok(self.ordinal < self.element.count)
    }

    #[cold]
    fn error(&self, begin: u64, fault: Fault) -> Error {
        let item = Item { kind: self.element.kind, ordinal: self.ordinal };
        let (byte, what) = match fault {
            Fault::Failed(error) => return error,
            Fault::Wrong(byte, what) => (byte, what),
            Fault::End => {
                (begin, format!("the file ends within it, but the header promises {} of its kind", self.element.count))
            }
        };
        Error::input_at(self.file, item, byte, what)
    }
}

#[inline(always)]
fn list_length<'a>(values: &mut impl Values<'a>, kind: Number) -> Result<u64, Fault> {
    let byte = values.at();
    let n = values.integer(kind)?;
    u64::try_from(n).map_err(|_| Fault::Wrong(byte, format!("a list of {n} values")))
}

fn check_corners(n: u64, byte: u64) -> Result<u64, Fault> {
    if n > MAX_CORNERS {
        return Err(Fault::Wrong(byte, format!("a polygon of {n} corners; at most {MAX_CORNERS} are read")));
    }
    Ok(n)
}
