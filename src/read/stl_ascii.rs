//! STL in words: `solid name`, facets of three vertices, `endsolid name`; as many solids as there are.

use super::ascii::{Words, number};
use super::cursor::Cursor;
use super::map::Input;
use super::ply_header::shown;
use super::ply_records::Fault;
use crate::error::{Error, Item, Result};
use crate::progress::Progress;

/// How much of the beginning is looked at to tell text from binary.
const LOOK_BYTES: u64 = 512;

/// Whether the file begins with `solid` and goes on as text.
pub(super) fn looks_like_text(input: &Input) -> Result<bool> {
    let mut begin = vec![0; input.len().min(LOOK_BYTES) as usize];
    input.read_at(&mut begin, 0)?;
    let text = begin.trim_ascii_start();
    let solid = text.len() >= 5 && text[..5].eq_ignore_ascii_case(b"solid");
    let control = |b: &u8| *b < 0x20 && !b.is_ascii_whitespace() && *b != 0x0b;
    Ok(solid && text.get(5).is_none_or(u8::is_ascii_whitespace) && !begin.iter().any(control))
}

/// Facets, and bytes behind the last solid.
pub(super) fn count(input: &Input, progress: &Progress) -> Result<(u64, u64)> {
    let mut facets = Facets::new(input, progress);
    while facets.pass()? {}
    if facets.ordinal == 0 {
        return Err(Error::input(input.path(), "has no faces: no facet in any solid"));
    }
    Ok((facets.ordinal, input.len() - facets.end))
}

/// The facets of a file, in order.
pub(super) struct Facets<'a> {
    input: &'a Input,
    words: Words<'a>,
    in_solid: bool,
    /// The next facet.
    ordinal: u64,
    /// One past the last solid.
    end: u64,
}

impl<'a> Facets<'a> {
    /// From the beginning of the file.
    pub fn new(input: &'a Input, progress: &'a Progress) -> Self {
        Facets { input, words: Words::new(Cursor::new(input, progress, 0)), in_solid: false, ordinal: 0, end: 0 }
    }

    /// The byte that is next.
    pub fn at(&self) -> u64 {
        self.words.at()
    }

    /// The next facet's corners.
    pub fn next(&mut self) -> Result<Option<[[f64; 3]; 3]>> {
        let found = self.enter().and_then(|more| if more { self.corners().map(Some) } else { Ok(None) });
        self.finish(found)
    }

    /// Passes over the next facet; whether there was one.
    fn pass(&mut self) -> Result<bool> {
        let found = self.enter().and_then(|more| if more { self.pass_corners().map(Some) } else { Ok(None) });
        Ok(self.finish(found)?.is_some())
    }

    fn finish<T>(&mut self, found: Result<Option<T>, Fault>) -> Result<Option<T>> {
        let item = Item { kind: "face", ordinal: self.ordinal };
        match found {
            Ok(found) => {
                self.ordinal += u64::from(found.is_some());
                Ok(found)
            }
            Err(Fault::Failed(error)) => Err(error),
            Err(Fault::Wrong(byte, what)) => Err(Error::input_at(self.input.path(), item, byte, what)),
            Err(Fault::End) => {
                let what = "the file ends here, expected `endsolid` at the end of the solid";
                Err(Error::input_at(self.input.path(), item, self.input.len(), what))
            }
        }
    }

    /// Goes on to just behind the next `facet`; false behind the last solid.
    fn enter(&mut self) -> Result<bool, Fault> {
        loop {
            if !self.in_solid {
                match self.words.peek()? {
                    Some(word) if word.eq_ignore_ascii_case(b"solid") => {}
                    None => {
                        self.end = self.input.len();
                        return Ok(false);
                    }
                    Some(_) => {
                        self.end = self.words.at();
                        return Ok(false);
                    }
                }
                self.words.skip_line()?;
                self.in_solid = true;
            }
            let (at, word) = self.words.next()?.ok_or(Fault::End)?;
            if word.eq_ignore_ascii_case(b"facet") {
                return Ok(true);
            }
            if !word.eq_ignore_ascii_case(b"endsolid") {
                return Err(unexpected(at, word, "`facet` or `endsolid`"));
            }
            self.words.skip_line()?;
            self.in_solid = false;
        }
    }

    fn corners(&mut self) -> Result<[[f64; 3]; 3], Fault> {
        self.open_loop()?;
        let mut corners = [[0.0; 3]; 3];
        for corner in &mut corners {
            self.keyword("vertex")?;
            for coordinate in corner {
                *coordinate = self.coordinate()?;
            }
        }
        self.close_loop()?;
        Ok(corners)
    }

    fn pass_corners(&mut self) -> Result<(), Fault> {
        self.open_loop()?;
        for _ in 0..3 {
            self.keyword("vertex")?;
            for _ in 0..3 {
                self.words.next()?.ok_or(Fault::End)?;
            }
        }
        self.close_loop()
    }

    fn open_loop(&mut self) -> Result<(), Fault> {
        self.keyword("normal")?;
        for _ in 0..3 {
            self.words.next()?.ok_or(Fault::End)?;
        }
        self.keyword("outer")?;
        self.keyword("loop")
    }

    fn close_loop(&mut self) -> Result<(), Fault> {
        self.keyword("endloop")?;
        self.keyword("endfacet")
    }

    fn keyword(&mut self, expected: &str) -> Result<(), Fault> {
        match self.words.next()? {
            Some((_, word)) if word.eq_ignore_ascii_case(expected.as_bytes()) => Ok(()),
            Some((at, word)) => Err(unexpected(at, word, &format!("`{expected}`"))),
            None => Err(Fault::End),
        }
    }

    fn coordinate(&mut self) -> Result<f64, Fault> {
        let (at, word) = self.words.next()?.ok_or(Fault::End)?;
        match number(word, true) {
            Some(x) if x.is_finite() => Ok(x),
            _ => Err(unexpected(at, word, "a finite number")),
        }
    }
}

#[cold]
fn unexpected(at: u64, word: &[u8], expected: &str) -> Fault {
    Fault::Wrong(at, format!("`{}`, expected {expected}", shown(&String::from_utf8_lossy(word))))
}
